//! Light: area emitters of shapes, lights without extent, and the sky.

use super::Converter;
use super::daylight::Daylight;
use super::shape::is_similarity;
use super::xml::{ObjectId, malformed};
use crate::ImportError;
use crate::description::{Affine, Beam, Environment, Place, Slide, TextureKind};
use crate::import::vector::{cofactors, normalize};

impl Converter<'_> {
    /// Radiance of an area emitter inside a shape, and the texture that it is multiplied by.
    pub(super) fn area_emitter(&mut self, id: ObjectId) -> Result<([f32; 3], Option<u32>), ImportError> {
        let object = &self.document.objects[id];
        let mut texture = None;
        let radiance = match object.plugin.as_str() {
            "area" => {
                let textured = match self.property(id, "radiance") {
                    Some(p) => self.texture_of(p, "radiance 1")?,
                    None => None,
                };
                match textured {
                    Some(number) => {
                        texture = number;
                        [1.0; 3]
                    }
                    None => self.radiance(id)?.unwrap_or([1.0; 3]),
                }
            }
            plugin => {
                self.unsupported(
                    &object.place,
                    format!("emitter \"{plugin}\" of a shape"),
                    "an area emitter of radiance 1",
                );
                object.properties.iter().for_each(|p| p.used.set(true));
                [1.0; 3]
            }
        };
        self.ignore(id, &["sampling_weight"]);
        self.leave(id);
        Ok((radiance, texture))
    }

    /// An emitter of the scene itself.
    pub(super) fn scene_emitter(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let environment = match object.plugin.as_str() {
            "constant" => Environment::Constant(self.radiance(id)?.unwrap_or([1.0; 3])),
            "envmap" => self.envmap(id)?,
            plugin @ ("point" | "spot" | "directional") => {
                let beam = self.beam(id, plugin)?;
                self.out.beams.extend(beam);
                self.ignore(id, &["sampling_weight"]);
                self.leave(id);
                return Ok(());
            }
            plugin @ ("sky" | "sun" | "sunsky") => {
                let Daylight { sky, sun, beam } = self.daylight(id, plugin)?;
                self.leave(id);
                self.out.beams.extend(beam);
                if sun.is_some() && self.out.sun.is_some() && !self.options.substitute {
                    return malformed(&object.place, "a second sun: a scene has one");
                }
                self.out.sun = self.out.sun.take().or(sun);
                match sky {
                    Some(sky) => return self.environment(sky, &object.place),
                    None => return Ok(()),
                }
            }
            plugin => {
                self.unsupported(&object.place, format!("emitter \"{plugin}\""), "no light");
                object.properties.iter().for_each(|p| p.used.set(true));
                return Ok(());
            }
        };
        // a constant sky is the same from everywhere
        self.ignore(id, &["sampling_weight", "to_world"]);
        self.leave(id);
        self.environment(environment, &object.place)
    }

    fn environment(&mut self, environment: Environment, place: &Place) -> Result<(), ImportError> {
        if self.out.environment.is_some() && !self.options.substitute {
            return malformed(place, "a second environment emitter: a scene has one sky");
        }
        self.out.environment.get_or_insert(environment);
        Ok(())
    }

    /// Mitsuba's `envmap`: a picture by latitude and longitude.
    fn envmap(&mut self, id: ObjectId) -> Result<Environment, ImportError> {
        let object = &self.document.objects[id];
        let Some((name, at)) = self.string(id, "filename")? else {
            return malformed(&object.place, "an envmap without a filename");
        };
        if !self.document.exists(name, at) {
            let what = format!("envmap file \"{name}\" (there is no such file)");
            self.unsupported(at, what, "a constant sky of radiance 1");
            object.properties.iter().for_each(|p| p.used.set(true));
            return Ok(Environment::Constant([1.0; 3]));
        }
        let path = self.document.resolve(name, at)?;
        let scale = self.float(id, "scale")?.unwrap_or(1.0);
        if !(scale > 0.0 && scale <= f64::from(f32::MAX)) {
            return malformed(&object.place, format!("scale {scale} should be above 0 and fit a float"));
        }
        let to_world = self.transform(id, "to_world")?;
        if !is_similarity(&to_world) {
            return malformed(&object.place, "the to_world of an envmap should be a rotation");
        }
        // how Mitsuba samples it, and keeps it
        self.ignore(id, &["mis_compensation", "cache"]);
        Ok(Environment::Map { path, place: object.place.clone(), scale: scale as f32, to_world })
    }

    /// A light without extent; `None` if it is black.
    fn beam(&mut self, id: ObjectId, plugin: &str) -> Result<Option<Beam>, ImportError> {
        let place = &self.document.objects[id].place;
        let map = self.transform(id, "to_world")?;
        let unit = |v: [f64; 3], what: &str| match normalize(v) {
            Some(unit) => Ok(unit),
            None => malformed(place, format!("the {plugin} light's {what} leaves it no direction")),
        };
        let finite = |p: [f64; 3]| match p.iter().all(|x| x.is_finite()) {
            true => Ok(p),
            false => malformed(place, "the light's position is too far away for floating point"),
        };
        let along = map.vector([0.0, 0.0, 1.0]);
        let beam = match plugin {
            "point" => {
                let position = match self.point(id, "position")? {
                    Some(_) if self.property(id, "to_world").is_some() => {
                        return malformed(place, "both position and to_world: give one of them");
                    }
                    Some(p) => p,
                    None => map.point([0.0; 3]),
                };
                let intensity = self.light(id, "intensity")?.unwrap_or([1.0; 3]);
                Beam::Point { position: finite(position)?, intensity }
            }
            "spot" => {
                let cutoff = self.float(id, "cutoff_angle")?.unwrap_or(20.0);
                if !(cutoff > 0.0 && cutoff <= 180.0) {
                    return malformed(
                        place,
                        format!("cutoff_angle {cutoff} should be above 0 and at most 180 degrees"),
                    );
                }
                let beam = self.float(id, "beam_width")?.unwrap_or(cutoff * 0.75);
                if !(0.0..=cutoff).contains(&beam) {
                    return malformed(place, format!("beam_width {beam} should lie between 0 and the cutoff_angle"));
                }
                let intensity = self.light(id, "intensity")?.unwrap_or([1.0; 3]);
                // an edge as sharp as floats have it
                let beam = beam.min(cutoff * (1.0 - 1e-6));
                let position = finite(map.point([0.0; 3]))?;
                let textured = match self.property(id, "texture") {
                    Some(p) => match self.texture_of(p, "no picture")? {
                        // a lamp has no mesh
                        Some(Some(n))
                            if matches!(self.out.textures[n as usize].kind, TextureKind::Attribute { .. }) =>
                        {
                            self.unsupported(&p.place, "mesh_attribute as the texture of a spot", "no picture");
                            None
                        }
                        Some(number) => number,
                        None => {
                            self.unsupported(&p.place, "this texture of a spot", "no picture");
                            None
                        }
                    },
                    None => None,
                };
                let slide = match textured {
                    None => None,
                    Some(_) if cutoff >= 90.0 => {
                        return malformed(
                            place,
                            format!("cutoff_angle {cutoff} should be below 90 degrees with a texture"),
                        );
                    }
                    Some(texture) => match inverse(&map) {
                        Some(to_local) => Some(Slide { texture, to_local }),
                        None => return malformed(place, "the to_world of a spot with a texture cannot be inverted"),
                    },
                };
                Beam::Spot { position, axis: unit(along, "to_world")?, intensity, beam, cutoff, slide }
            }
            _ => {
                let direction = match self.point(id, "direction")? {
                    Some(_) if self.property(id, "to_world").is_some() => {
                        return malformed(place, "both direction and to_world: give one of them");
                    }
                    Some(d) => unit(d, "direction")?,
                    None => unit(along, "to_world")?,
                };
                let irradiance = self.light(id, "irradiance")?.unwrap_or([1.0; 3]);
                Beam::Directional { direction, irradiance }
            }
        };
        let (Beam::Point { intensity: light, .. }
        | Beam::Spot { intensity: light, .. }
        | Beam::Directional { irradiance: light, .. }) = &beam;
        Ok(light.iter().any(|v| *v > 0.0).then_some(beam))
    }

    fn radiance(&mut self, id: ObjectId) -> Result<Option<[f32; 3]>, ImportError> {
        self.light(id, "radiance")
    }

    /// Radiance, intensity or irradiance.
    pub(super) fn light(&mut self, id: ObjectId, name: &str) -> Result<Option<[f32; 3]>, ImportError> {
        let Some(rgb) = self.color(id, name, 1.0)? else { return Ok(None) };
        if rgb.iter().any(|v| *v < 0.0 || *v > f64::from(f32::MAX)) {
            return malformed(
                &self.document.objects[id].place,
                format!("{name} {rgb:?} should be at least 0 and fit a float"),
            );
        }
        Ok(Some(rgb.map(|v| v as f32)))
    }
}

/// The inverse of a map's linear part.
fn inverse(map: &Affine) -> Option<[[f64; 3]; 3]> {
    let determinant = map.determinant();
    let of = cofactors(map);
    let rows = [0, 1, 2].map(|r| [0, 1, 2].map(|c| of[c][r] / determinant));
    rows.iter().flatten().all(|x| x.is_finite()).then_some(rows)
}
