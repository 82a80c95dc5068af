//! Materials of several parts: `principled`, `phong`, `blendbsdf`.

use super::bsdf::{Textures, bsdf_name, detail_of};
use super::xml::{ObjectId, malformed};
use super::{Converter, luminance};
use crate::ImportError;
use crate::description::{Amount, Blend, Bsdf, Material, Principled, Slot, Textured};

/// Largest exponent of a Phong lobe: beyond it a rounded cosine says little.
const LARGEST_EXPONENT: f64 = 1e6;

impl Converter<'_> {
    /// Mitsuba 3's `principled`.
    pub(super) fn principled(&mut self, id: ObjectId, textured: &mut Textures) -> Result<Bsdf, ImportError> {
        let place = &self.document.objects[id].place;
        let base_color = self.paint(id, "base_color", Slot::Diffuse, textured)?.unwrap_or([0.5; 3]);
        let mut number = |name: &str, slot, default| self.share(id, name, slot, default, textured);
        let roughness = number("roughness", Slot::Roughness, 0.5)?;
        let anisotropic = number("anisotropic", Slot::Anisotropic, 0.0)?;
        let metallic = number("metallic", Slot::Metallic, 0.0)?;
        let spec_trans = number("spec_trans", Slot::SpecTrans, 0.0)?;
        let spec_tint = number("spec_tint", Slot::SpecTint, 0.0)?;
        let sheen = number("sheen", Slot::Sheen, 0.0)?;
        let sheen_tint = number("sheen_tint", Slot::SheenTint, 0.0)?;
        let clearcoat = number("clearcoat", Slot::Clearcoat, 0.0)?;
        let clearcoat_gloss = number("clearcoat_gloss", Slot::ClearcoatGloss, 0.0)?;
        let flatness = number("flatness", Slot::Flatness, 0.0)?;
        let passes = spec_trans > 0.0 || textured.iter().any(|t| t.slot == Slot::SpecTrans);
        let eta = match (self.float(id, "eta")?, self.float(id, "specular")?) {
            (Some(_), Some(_)) => return malformed(place, "both eta and specular: give one of them"),
            // no surface that lets light through has an index of just 1
            (Some(1.0), None) if passes => 1.001,
            (Some(eta), None) => eta,
            (None, specular) => {
                let specular = specular.unwrap_or(0.5);
                if !(0.0..=1.0).contains(&specular) {
                    return malformed(place, format!("specular {specular} should lie in [0, 1]"));
                }
                let specular = if passes && specular == 0.0 { 1e-3 } else { specular };
                2.0 / (1.0 - (0.08 * specular).sqrt()) - 1.0
            }
        };
        if !(0.1..=10.0).contains(&eta) {
            return malformed(place, format!("eta {eta} should lie between 0.1 and 10"));
        }
        // how Mitsuba samples the parts
        let rates = ["main_specular_sampling_rate", "clearcoat_sampling_rate", "diffuse_reflectance_sampling_rate"];
        self.ignore(id, &rates);
        Ok(Bsdf::Principled(Principled {
            base_color,
            eta: eta as f32,
            roughness,
            anisotropic,
            metallic,
            spec_trans,
            spec_tint,
            sheen,
            sheen_tint,
            clearcoat,
            clearcoat_gloss,
            flatness,
        }))
    }

    /// `phong` of 0.5 and 0.6.
    pub(super) fn phong(&mut self, id: ObjectId, textured: &mut Textures) -> Result<Bsdf, ImportError> {
        let place = &self.document.objects[id].place;
        let diffuse = self.paint(id, "diffuse_reflectance", Slot::Diffuse, textured)?.unwrap_or([0.5; 3]);
        let specular = self.paint(id, "specular_reflectance", Slot::Specular, textured)?.unwrap_or([0.2; 3]);
        let exponent = self.color(id, "exponent", 30.0)?.unwrap_or([30.0; 3]);
        if exponent != [exponent[0]; 3] {
            return malformed(place, format!("exponent {exponent:?} should be one number"));
        }
        let exponent = exponent[0];
        if !(0.0..=LARGEST_EXPONENT).contains(&exponent) {
            return malformed(place, format!("exponent {exponent} should lie between 0 and {LARGEST_EXPONENT}"));
        }
        Ok(Bsdf::Phong { diffuse, specular, exponent: exponent as f32 })
    }

    /// Two materials by a weight, which is the second's.
    pub(super) fn blend(&mut self, id: ObjectId) -> Result<Material, ImportError> {
        let place = &self.document.objects[id].place;
        if self.property(id, "weight").is_none() {
            return malformed(place, "blendbsdf lacks its weight");
        }
        let mut of_weight = Textures::new();
        // the slot is of no meaning
        let weight = self.share(id, "weight", Slot::Alpha, 0.5, &mut of_weight)?;
        let weight = of_weight.first().map_or(Amount::Constant(weight), |t| Amount::Texture(t.texture));
        let inner = self.nested(id, "bsdf")?;
        let [(first, a), (second, b)] = inner[..] else {
            return malformed(place, format!("blendbsdf needs two materials inside, and has {}", inner.len()));
        };
        let mut parts = [0; 2];
        for (slot, (property, object)) in parts.iter_mut().zip([(first, a), (second, b)]) {
            let mut part = self.bsdf(object, &property.place)?;
            part.name = self.document.objects[object].id.clone().unwrap_or_else(|| bsdf_name(&part).into());
            *slot = self.push_material(part);
        }
        let mut out = Material::new("", Bsdf::Diffuse { reflectance: [0.0; 3] }, false);
        detail_of(&mut out).blend = Some(Blend { weight, parts });
        Ok(out)
    }

    /// A number in [0, 1], or a texture for a slot.
    fn share(
        &mut self,
        id: ObjectId,
        name: &str,
        slot: Slot,
        default: f32,
        textured: &mut Textures,
    ) -> Result<f32, ImportError> {
        let Some(p) = self.property(id, name) else { return Ok(default) };
        if let Some(number) = self.texture_of(p, &default.to_string())? {
            textured.extend(number.map(|texture| Textured::new(slot, texture)));
            return Ok(default);
        }
        let value = luminance(self.color(id, name, default.into())?.unwrap_or([default.into(); 3]));
        if !(0.0..=1.0).contains(&value) {
            return malformed(&p.place, format!("{name} {value} should lie in [0, 1]"));
        }
        Ok(value as f32)
    }
}
