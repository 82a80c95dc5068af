//! Materials.

use super::Converter;
use super::xml::{ObjectId, Property, Value, malformed};
use crate::ImportError;
use crate::description::{Bsdf, Distribution, Material, Place};
use crate::import::metals;

/// Mitsuba's stand-in where a shape names no material, and ours for unsupported ones.
const DEFAULT_REFLECTANCE: f32 = 0.5;

impl Converter<'_> {
    /// Number of the material of an object; made once.
    pub(super) fn material(&mut self, id: ObjectId, from: &Place) -> Result<u32, ImportError> {
        if let Some(&n) = self.materials.get(&id) {
            return Ok(n);
        }
        let (bsdf, two_sided) = self.bsdf(id, from)?;
        let name = self.document.objects[id].id.clone().unwrap_or_else(|| bsdf_name(&bsdf).into());
        let n = self.push_material(Material { name, bsdf, two_sided });
        self.materials.insert(id, n);
        Ok(n)
    }

    /// The material of a shape without one: grey, or black where the shape emits (Mitsuba's rule).
    pub(super) fn default_material(&mut self, emits: bool) -> u32 {
        let reflectance = if emits { [0.0; 3] } else { [DEFAULT_REFLECTANCE; 3] };
        let name = if emits { "default-emitter" } else { "default" };
        let material = Material { name: name.into(), bsdf: Bsdf::Diffuse { reflectance }, two_sided: false };
        match self.out.materials.iter().position(|m| *m == material) {
            Some(n) => n as u32,
            None => self.push_material(material),
        }
    }

    fn push_material(&mut self, material: Material) -> u32 {
        self.out.materials.push(material);
        self.out.materials.len() as u32 - 1
    }

    fn bsdf(&mut self, id: ObjectId, from: &Place) -> Result<(Bsdf, bool), ImportError> {
        self.enter(id, from)?;
        let object = &self.document.objects[id];
        let place = &object.place;
        let out = match object.plugin.as_str() {
            "twosided" => {
                let inner = self.nested(id, "bsdf")?;
                match inner[..] {
                    [(p, inner)] => (self.bsdf(inner, &p.place)?.0, true),
                    [(p, front), (_, _back)] => {
                        self.unsupported(place, "twosided with two materials", "its front on both sides");
                        (self.bsdf(front, &p.place)?.0, true)
                    }
                    _ => return malformed(place, "twosided needs one or two materials inside"),
                }
            }
            "diffuse" => {
                let reflectance = match self.albedo(id, "reflectance")? {
                    Some(v) => v,
                    // the name in 0.5 and 0.6
                    None => self.albedo(id, "diffuse_reflectance")?.unwrap_or([DEFAULT_REFLECTANCE; 3]),
                };
                (Bsdf::Diffuse { reflectance }, false)
            }
            "conductor" => {
                let (eta, k) = self.index_of_refraction(id)?;
                let specular = self.albedo(id, "specular_reflectance")?.unwrap_or([1.0; 3]);
                (Bsdf::Conductor { eta, k, specular }, false)
            }
            "roughconductor" => {
                let (eta, k) = self.index_of_refraction(id)?;
                let specular = self.albedo(id, "specular_reflectance")?.unwrap_or([1.0; 3]);
                let distribution = self.distribution(id)?;
                let alpha = self.roughness(id)?;
                // how Mitsuba samples the lobe; the estimate is the same
                self.ignore(id, &["sample_visible"]);
                (Bsdf::RoughConductor { distribution, alpha, eta, k, specular }, false)
            }
            plugin @ ("dielectric" | "thindielectric" | "roughdielectric") => (self.transparent(id, plugin)?, false),
            plugin @ ("plastic" | "roughplastic") => (self.plastic(id, plugin)?, false),
            plugin @ ("bumpmap" | "normalmap" | "mask" | "opacity") => {
                self.unsupported(place, format!("bsdf \"{plugin}\""), "the material inside");
                let inner = self.nested(id, "bsdf")?;
                object.properties.iter().for_each(|p| p.used.set(true));
                match inner[..] {
                    [(p, inner), ..] => self.bsdf(inner, &p.place)?,
                    [] => return malformed(place, format!("{plugin} needs a material inside")),
                }
            }
            plugin @ ("roughdiffuse" | "phong" | "ward" | "principled") => {
                self.unsupported(place, format!("bsdf \"{plugin}\""), "diffuse of its diffuse colour, two-sided");
                object.properties.iter().for_each(|p| p.used.set(true));
                let name =
                    |p: &&Property| ["diffuse_reflectance", "reflectance", "base_color"].contains(&p.name.as_str());
                let reflectance = match object.properties.iter().find(name).map(|p| &p.value) {
                    Some(Value::Color(rgb)) => rgb.map(|v| v.clamp(0.0, 1.0) as f32),
                    _ => [DEFAULT_REFLECTANCE; 3],
                };
                (Bsdf::Diffuse { reflectance }, true)
            }
            plugin => {
                self.unsupported(place, format!("bsdf \"{plugin}\""), "grey diffuse, two-sided");
                object.properties.iter().for_each(|p| p.used.set(true));
                (Bsdf::Diffuse { reflectance: [DEFAULT_REFLECTANCE; 3] }, true)
            }
        };
        self.leave(id);
        Ok(out)
    }

    /// A colour in [0, 1].
    pub(super) fn albedo(&mut self, id: ObjectId, name: &str) -> Result<Option<[f32; 3]>, ImportError> {
        let Some(rgb) = self.color(id, name, DEFAULT_REFLECTANCE.into())? else { return Ok(None) };
        if rgb.iter().any(|v| !(0.0..=1.0).contains(v)) {
            let place = &self.document.objects[id].place;
            return malformed(place, format!("{name} {rgb:?} should lie in [0, 1]"));
        }
        Ok(Some(rgb.map(|v| v as f32)))
    }

    /// `eta` and `k`, by name or by value; relative to `ext_eta` where that is given.
    fn index_of_refraction(&mut self, id: ObjectId) -> Result<([f32; 3], [f32; 3]), ImportError> {
        let place = &self.document.objects[id].place;
        let eta = self.color(id, "eta", 0.2)?;
        let k = self.color(id, "k", 3.0)?;
        let material = self.string(id, "material")?;
        let (eta, k) = match (eta, k, material) {
            (None, None, Some((name, at))) if name != "none" => match metals::find(name) {
                Some(metal) => (metal.eta.map(f64::from), metal.k.map(f64::from)),
                None => {
                    self.unsupported(at, format!("material \"{name}\""), "copper");
                    metals::find("Cu").map_or(([0.0; 3], [1.0; 3]), |m| (m.eta.map(f64::from), m.k.map(f64::from)))
                }
            },
            // Mitsuba's default: a perfect mirror
            (eta, k, _) => (eta.unwrap_or([0.0; 3]), k.unwrap_or([1.0; 3])),
        };
        if eta.iter().chain(&k).any(|v| *v < 0.0) {
            return malformed(place, "eta and k should not be negative");
        }
        let outside = match self.property(id, "ext_eta").map(|p| (&p.value, &p.place)) {
            None => 1.0,
            Some((Value::Float(v), _)) if *v > 0.0 => *v,
            Some((Value::String(name), _)) if name == "air" => 1.000277,
            Some((Value::String(name), _)) if name == "vacuum" => 1.0,
            Some((_, at)) => {
                self.unsupported(at, "this ext_eta", "1");
                1.0
            }
        };
        Ok((eta.map(|v| (v / outside) as f32), k.map(|v| (v / outside) as f32)))
    }

    pub(super) fn distribution(&mut self, id: ObjectId) -> Result<Distribution, ImportError> {
        match self.string(id, "distribution")? {
            None => Ok(Distribution::Beckmann),
            Some((name, at)) => match name.to_ascii_lowercase().as_str() {
                "beckmann" => Ok(Distribution::Beckmann),
                "ggx" => Ok(Distribution::Ggx),
                _ => {
                    self.unsupported(at, format!("distribution \"{name}\""), "ggx");
                    Ok(Distribution::Ggx)
                }
            },
        }
    }

    pub(super) fn roughness(&mut self, id: ObjectId) -> Result<[f32; 2], ImportError> {
        let place = &self.document.objects[id].place;
        let mut get = |name: &str| -> Result<Option<f64>, ImportError> { Ok(self.color(id, name, 0.1)?.map(|v| v[0])) };
        let alpha = match (get("alpha")?, get("alpha_u")?, get("alpha_v")?) {
            (alpha, None, None) => [alpha.unwrap_or(0.1); 2],
            (None, Some(u), Some(v)) => [u, v],
            _ => return malformed(place, "give alpha, or both alpha_u and alpha_v"),
        };
        if alpha.iter().any(|a| !(*a > 0.0 && *a <= 1.0)) {
            return malformed(place, format!("roughness {alpha:?} should lie in (0, 1]; use conductor for a mirror"));
        }
        Ok(alpha.map(|a| a as f32))
    }
}

fn bsdf_name(bsdf: &Bsdf) -> &'static str {
    match bsdf {
        Bsdf::Diffuse { .. } => "diffuse",
        Bsdf::Conductor { .. } => "conductor",
        Bsdf::RoughConductor { .. } => "roughconductor",
        Bsdf::Dielectric { .. } => "dielectric",
        Bsdf::ThinDielectric { .. } => "thindielectric",
        Bsdf::RoughDielectric { .. } => "roughdielectric",
        Bsdf::Plastic { .. } => "plastic",
        Bsdf::RoughPlastic { .. } => "roughplastic",
    }
}
