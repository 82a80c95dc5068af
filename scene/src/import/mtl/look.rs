//! From the statements of a material to ours.
//!
//! - Any of the extensions (`Pr Pm Ps Pc Pcr aniso map_Pr map_Pm`): `principled` (its parameters have these meanings).
//! - `illum` 4, 6 and 7 ("glass on", "refraction on"): a dielectric of index `Ni`.
//! - `illum` 3 and 5 ("ray trace on") without any diffuse part: a mirror of `Ks`.
//! - `Ks` and an `illum` with highlights, or none: the modified Phong model with exponent `Ns`, as Mitsuba 0.6 has it.
//! - Else diffuse.
//!
//! `d` is what it is in the source, "the amount this material dissolves into the background": opacity.

use super::statement::{Map, Statement};
use super::{Entry, Libraries, Part};
use crate::ImportError;
use crate::description::{
    Amount, Bsdf, Detail, Distribution, Material, Principled, Relief, ReliefKind, Slot, TexelFilter, Texture,
    TextureKind, Textured,
};
use crate::image;
use crate::import::DEFAULT_ALBEDO;

/// Index of refraction of glass that does not say its own.
const GLASS: f64 = 1.5;
/// Phong exponent of a highlight that does not say its own: Mitsuba's.
const EXPONENT: f64 = 30.0;
/// Largest exponent.
const MOST_EXPONENT: f64 = 1e6;
/// Least roughness of a rough surface; below it is smooth.
const SMOOTH: f64 = 1e-3;

/// What the statements say, the last of each kind.
#[derive(Default)]
struct Said {
    diffuse: Option<[f64; 3]>,
    specular: Option<[f64; 3]>,
    emission: Option<[f64; 3]>,
    filter: Option<[f64; 3]>,
    exponent: Option<f64>,
    index: Option<f64>,
    opacity: Option<f64>,
    illum: Option<u32>,
    roughness: Option<f64>,
    metallic: Option<f64>,
    sheen: Option<f64>,
    clearcoat: Option<f64>,
    clearcoat_roughness: Option<f64>,
    anisotropic: Option<f64>,
    map_diffuse: Option<u32>,
    map_specular: Option<u32>,
    map_emission: Option<u32>,
    map_opacity: Option<u32>,
    map_roughness: Option<u32>,
    map_metallic: Option<u32>,
    relief: Option<Relief>,
}

impl Libraries<'_> {
    /// A material of a library as a part of the mesh.
    pub(super) fn part(&mut self, entry: Entry) -> Result<Part, ImportError> {
        let mut said = Said::default();
        for statement in &entry.statements {
            self.hear(statement, &mut said)?;
        }
        let (bsdf, detail) = self.surface(&entry, &said);
        let mut material = Material::new(&entry.name, bsdf, true);
        if material.bsdf.transmits() {
            material.two_sided = false;
        }
        if detail != Detail::default() {
            material.detail = Some(Box::new(detail));
        }
        let shines = |rgb: &[f32; 3]| rgb.iter().any(|v| *v > 0.0);
        let factor = said.emission.map(|rgb| rgb.map(|v| v as f32)).filter(shines);
        // some exporters write a map beside an emission of 0, which would be none
        let emission = factor.or(said.map_emission.map(|_| [1.0; 3]));
        let emission_texture = said.map_emission.filter(|_| emission.is_some());
        Ok(Part { name: entry.name, place: entry.place, material, emission, emission_texture })
    }

    fn hear(&mut self, s: &Statement, said: &mut Said) -> Result<(), ImportError> {
        match s.keyword.as_str() {
            "kd" => said.diffuse = self.reflectance(s)?.or(said.diffuse),
            "ks" => said.specular = self.reflectance(s)?.or(said.specular),
            "tf" => said.filter = self.reflectance(s)?.or(said.filter),
            "ke" => {
                let rgb = self.color(s)?;
                if rgb.is_some_and(|rgb| rgb.iter().any(|v| *v > f64::from(f32::MAX))) {
                    return s.fail("the radiance should fit a float");
                }
                said.emission = rgb.or(said.emission);
            }
            "ns" => said.exponent = Some(self.at_most(s, MOST_EXPONENT)?),
            "ni" => {
                let index = s.positive()?;
                if !(0.1..=10.0).contains(&index) {
                    return s.fail(format_args!("the index of refraction {index} should lie between 0.1 and 10"));
                }
                said.index = Some(index);
            }
            "d" => {
                let mut plain =
                    Statement { rest: s.rest.clone(), keyword: "d".into(), place: s.place.clone(), rest_at: s.rest_at };
                if let Some(rest) = s.rest.strip_prefix("-halo") {
                    self.unsupported(&s.place, "d -halo (opacity by angle)", "the same opacity from everywhere");
                    plain.rest = rest.trim().into();
                    plain.rest_at += s.rest.len() - plain.rest.len();
                }
                said.opacity = Some(self.at_most(&plain, 1.0)?);
            }
            "tr" => said.opacity = Some(1.0 - self.at_most(s, 1.0)?),
            "illum" => match s.rest.trim().parse() {
                Ok(n) if n <= 10 => said.illum = Some(n),
                _ => return s.fail(format_args!("\"{}\" is no illumination model (0 to 10)", s.rest.trim())),
            },
            "pr" => said.roughness = Some(self.at_most(s, 1.0)?),
            "pm" => said.metallic = Some(self.at_most(s, 1.0)?),
            "ps" => said.sheen = Some(self.at_most(s, 1.0)?),
            "pc" => said.clearcoat = Some(self.at_most(s, 1.0)?),
            "pcr" => said.clearcoat_roughness = Some(self.at_most(s, 1.0)?),
            "aniso" => said.anisotropic = Some(self.at_most(s, 1.0)?),
            "map_kd" => said.map_diffuse = self.texture(s, false)?.map(|t| t.0),
            "map_ks" => said.map_specular = self.texture(s, false)?.map(|t| t.0),
            "map_ke" => said.map_emission = self.texture(s, false)?.map(|t| t.0),
            "map_d" => {
                said.map_opacity = self.texture(s, true)?.map(|t| t.0);
                if let Some(n) = said.map_opacity
                    && let TextureKind::Image { path, .. } = &self.out.textures[n as usize].kind
                    && image::has_alpha(path)
                {
                    let text = "map_d of a picture with an alpha channel: its luminance is the opacity, not its alpha";
                    self.note(&s.place, text.into());
                }
            }
            "map_pr" => said.map_roughness = self.texture(s, true)?.map(|t| t.0),
            "map_pm" => said.map_metallic = self.texture(s, true)?.map(|t| t.0),
            "map_bump" | "bump" => {
                if let Some((texture, bump, channels)) = self.texture(s, true)? {
                    if channels == 3 {
                        let text = format!(
                            "{} of a picture with colours is read as heights: name a normal map by norm",
                            s.keyword
                        );
                        self.note(&s.place, text);
                    }
                    said.relief =
                        Some(Relief { kind: ReliefKind::Bump(bump), texture, mirrored: true, shadowed: true });
                }
            }
            "norm" | "map_norm" => {
                if let Some((texture, ..)) = self.texture(s, true)? {
                    said.relief = Some(Relief { kind: ReliefKind::Normals, texture, mirrored: true, shadowed: true });
                }
            }
            // of a light that is everywhere, and of other programs' ways to render
            "ka" | "map_ka" | "km" | "sharpness" | "map_aat" | "anisor" => {
                let text = format!("{} is passed over: it is nothing that is computed here", s.keyword);
                self.note(&s.place, text);
            }
            other => {
                let what = format!("{} in a material library", super::super::source::show(other.as_bytes()));
                self.unsupported(&s.place, what, "nothing");
            }
        }
        Ok(())
    }

    fn surface(&mut self, entry: &Entry, said: &Said) -> (Bsdf, Detail) {
        let mut detail = Detail { relief: said.relief, ..Detail::default() };
        let grey = DEFAULT_ALBEDO.map(f64::from);
        // a map is multiplied by the colour beside it, which is 1 unless given
        let or_map = |color: Option<[f64; 3]>, map: Option<u32>, none| {
            color.unwrap_or(if map.is_some() { [1.0; 3] } else { none })
        };
        let diffuse = or_map(said.diffuse, said.map_diffuse, grey).map(|v| v as f32);
        let specular = or_map(said.specular, said.map_specular, [0.0; 3]).map(|v| v as f32);
        let mut paint = |slot, texture: Option<u32>, scale| {
            detail.textured.extend(texture.map(|texture| Textured { slot, texture, scale }));
        };
        let extended =
            [said.roughness, said.metallic, said.sheen, said.clearcoat, said.clearcoat_roughness, said.anisotropic];
        let illum = said.illum.unwrap_or(2);
        let is_glass = matches!(illum, 4 | 6 | 7);
        let is_black = |rgb: [f32; 3]| rgb == [0.0; 3];
        let extends = extended.iter().any(Option::is_some) || said.map_roughness.or(said.map_metallic).is_some();
        self.note_unused(entry, said, is_glass, extends);
        let bsdf = if is_glass {
            let index = said.index.unwrap_or(GLASS);
            if said.index.is_none() {
                self.note(&entry.place, format!("glass \"{}\" without Ni has the index {GLASS}", entry.name));
            }
            let eta = index as f32;
            let (reflect, transmit) = ([1.0; 3], said.filter.unwrap_or([1.0; 3]).map(|v| v as f32));
            // roughness is the square root of alpha, as in `principled`
            let alpha = said.roughness.unwrap_or(0.0) * said.roughness.unwrap_or(0.0);
            if alpha > SMOOTH && eta != 1.0 {
                let (distribution, alpha) = (Distribution::Ggx, [alpha as f32; 2]);
                Bsdf::RoughDielectric { distribution, alpha, eta, reflect, transmit }
            } else {
                Bsdf::Dielectric { eta, reflect, transmit }
            }
        } else if extends {
            paint(Slot::Diffuse, said.map_diffuse, diffuse);
            // a map replaces the number: exporters write what their number is while it is not used, 0 for metal
            paint(Slot::Roughness, said.map_roughness, [1.0; 3]);
            paint(Slot::Metallic, said.map_metallic, [1.0; 3]);
            let number = |x: Option<f64>, default: f64| x.unwrap_or(default) as f32;
            Bsdf::Principled(Principled {
                base_color: diffuse,
                // an index of 1 is what exporters write who do not know one
                eta: said.index.filter(|i| *i > 1.0).unwrap_or(GLASS) as f32,
                roughness: number(said.roughness, 0.5),
                anisotropic: number(said.anisotropic, 0.0),
                metallic: number(said.metallic, 0.0),
                spec_trans: 0.0,
                spec_tint: 0.0,
                sheen: number(said.sheen, 0.0),
                sheen_tint: 0.0,
                clearcoat: number(said.clearcoat, 0.0),
                clearcoat_gloss: 1.0 - number(said.clearcoat_roughness, 0.0),
                flatness: 0.0,
            })
        } else if matches!(illum, 3 | 5) && !is_black(specular) && said.diffuse == Some([0.0; 3]) {
            paint(Slot::Specular, said.map_specular, specular);
            Bsdf::Conductor { eta: [0.0; 3], k: [1.0; 3], specular }
        } else if illum >= 2 && !is_black(specular) {
            paint(Slot::Diffuse, said.map_diffuse, diffuse);
            paint(Slot::Specular, said.map_specular, specular);
            Bsdf::Phong { diffuse, specular, exponent: said.exponent.unwrap_or(EXPONENT) as f32 }
        } else {
            paint(Slot::Diffuse, said.map_diffuse, diffuse);
            Bsdf::Diffuse { reflectance: diffuse }
        };
        // what glass lets pass is its own affair, and it has two sides of its own
        if let Some(relief) = detail.relief.as_mut().filter(|_| is_glass) {
            relief.mirrored = false;
        }
        if !is_glass {
            detail.opacity = match (said.map_opacity, said.opacity) {
                (Some(texture), _) => Amount::Texture(texture),
                (None, opacity) => Amount::Constant(opacity.unwrap_or(1.0) as f32),
            };
        } else if said.map_diffuse.or(said.map_specular).or(said.map_opacity).is_some() {
            self.unsupported(&entry.place, format!("a map on the glass \"{}\"", entry.name), "clear glass");
        }
        (bsdf, detail)
    }

    /// What the model that was chosen has no place for.
    fn note_unused(&mut self, entry: &Entry, said: &Said, is_glass: bool, extends: bool) {
        let highlight = said.specular.is_some() || said.map_specular.is_some() || said.exponent.is_some();
        let others = [said.metallic, said.sheen, said.clearcoat, said.clearcoat_roughness, said.anisotropic];
        let found = [
            (extends && !is_glass && highlight, "Ks, map_Ks and Ns say nothing beside Pr, Pm, Ps, Pc, Pcr, aniso"),
            (!is_glass && said.filter.is_some(), "Tf is passed over: illum (4, 6 or 7) does not say glass"),
            (
                !is_glass && !extends && said.index.is_some_and(|i| i != 1.0),
                "Ni is passed over where neither illum (4, 6 or 7) says glass nor Pr, Pm, .. say a coat",
            ),
            (
                said.illum == Some(9),
                "illum 9 (glass without reflections) is read as a surface with a highlight and its d",
            ),
            (is_glass && others.iter().any(Option::is_some), "Pm, Ps, Pc, Pcr and aniso say nothing of glass"),
            (is_glass && said.opacity.is_some_and(|d| d < 1.0), "d says nothing of glass: Tf is what passes"),
            (is_glass && (said.diffuse.is_some() || highlight), "Kd, Ks and Ns say nothing of glass"),
        ];
        for (_, text) in found.iter().filter(|(unused, _)| *unused) {
            self.note(&entry.place, (*text).into());
        }
    }

    /// A colour; one that is not RGB is unsupported.
    fn color(&mut self, s: &Statement) -> Result<Option<[f64; 3]>, ImportError> {
        let color = s.color()?;
        if color.is_none() {
            self.unsupported(&s.place, format!("{} as a spectrum or in XYZ", s.keyword), "the default colour");
        }
        Ok(color)
    }

    /// A colour that is brought into [0, 1].
    fn reflectance(&mut self, s: &Statement) -> Result<Option<[f64; 3]>, ImportError> {
        let color = self.color(s)?;
        if color.is_some_and(|rgb| rgb.iter().any(|v| *v > 1.0)) {
            self.note(&s.place, format!("{} {} is more than all light: it is brought to 1", s.keyword, s.rest));
        }
        Ok(color.map(|rgb| rgb.map(|v| v.min(1.0))))
    }

    /// A number from 0 that is brought to at most `most`.
    fn at_most(&mut self, s: &Statement, most: f64) -> Result<f64, ImportError> {
        let x = s.positive()?;
        if x > most {
            self.note(&s.place, format!("{} {x} is brought to {most}, the largest that there is", s.keyword));
        }
        Ok(x.min(most))
    }

    /// Number of the texture of a statement, its `-bm`, and the channels of its file; `None` where the file is missing or no image.
    fn texture(&mut self, s: &Statement, raw: bool) -> Result<Option<(u32, f32, u8)>, ImportError> {
        let Map { file, to_uv, wrap, bump, unread } = s.map()?;
        for option in unread {
            self.unsupported(&s.place, format!("{option} of {}", s.keyword), "the texture without it");
        }
        let folder = s.place.file.parent().unwrap_or(std::path::Path::new(""));
        let path = self.file_in(folder, &file, &s.place)?;
        let header = if path.is_file() { image::header(&path, raw) } else { Err("is not there".into()) };
        let header = match header {
            Ok(header) => header,
            Err(why) => {
                self.unsupported(&s.place, format!("texture file \"{file}\" (it {why})"), "no texture");
                return Ok(None);
            }
        };
        let kind = TextureKind::Image { path, raw, wrap, filter: TexelFilter::Bilinear, to_uv };
        let textures = &mut self.out.textures;
        let number = textures.iter().position(|t| t.kind == kind).unwrap_or_else(|| {
            textures.push(Texture { place: s.place.clone(), kind });
            textures.len() - 1
        });
        Ok(Some((number as u32, bump, header.channels)))
    }
}
