//! Light: area emitters of shapes, and the sky.

use super::Converter;
use super::xml::{ObjectId, malformed};
use crate::ImportError;

impl Converter<'_> {
    /// Radiance of an area emitter inside a shape.
    pub(super) fn area_emitter(&mut self, id: ObjectId) -> Result<[f32; 3], ImportError> {
        let object = &self.document.objects[id];
        let radiance = match object.plugin.as_str() {
            "area" => self.radiance(id)?.unwrap_or([1.0; 3]),
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
        Ok(radiance)
    }

    /// An emitter of the scene itself.
    pub(super) fn scene_emitter(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let radiance = match object.plugin.as_str() {
            "constant" => self.radiance(id)?.unwrap_or([1.0; 3]),
            plugin @ ("envmap" | "sky" | "sun" | "sunsky") => {
                self.unsupported(&object.place, format!("emitter \"{plugin}\""), "a constant sky of radiance 1");
                object.properties.iter().for_each(|p| p.used.set(true));
                [1.0; 3]
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
        if self.out.environment.is_some() && !self.options.substitute {
            return malformed(&object.place, "a second environment emitter: a scene has one sky");
        }
        self.out.environment.get_or_insert(radiance);
        Ok(())
    }

    fn radiance(&mut self, id: ObjectId) -> Result<Option<[f32; 3]>, ImportError> {
        let Some(rgb) = self.color(id, "radiance", 1.0)? else { return Ok(None) };
        if rgb.iter().any(|v| *v < 0.0 || *v > f64::from(f32::MAX)) {
            return malformed(
                &self.document.objects[id].place,
                format!("radiance {rgb:?} should be at least 0 and fit a float"),
            );
        }
        Ok(Some(rgb.map(|v| v as f32)))
    }
}
