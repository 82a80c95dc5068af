//! Transparent materials and plastics.

use std::collections::BTreeMap;

use super::Converter;
use super::bsdf::Textures;
use super::xml::{ObjectId, Value, malformed};
use crate::ImportError;
use crate::description::{Bsdf, Distribution, Slot, Transmittance};
use crate::import::refraction;

/// Largest ratio of indices; diamond in vacuum has 2.4, and beyond 10 the reflectance of diffuse light is not known well enough.
const LARGEST: f64 = 10.0;

/// Transmittances that were asked for, by whether it is GGX's, and the bits of alpha and eta: of a scene's rough plastics most are alike, and each takes
/// some 20 ms.
#[derive(Default)]
pub(super) struct Coats(BTreeMap<(bool, u32, u32), Transmittance>);

impl Coats {
    fn get(&mut self, distribution: Distribution, alpha: f32, eta: f32) -> Transmittance {
        let asked = (distribution == Distribution::Ggx, alpha.to_bits(), eta.to_bits());
        self.0.entry(asked).or_insert_with(|| Transmittance::new(distribution, alpha, eta)).clone()
    }
}

impl Converter<'_> {
    /// `dielectric`, `thindielectric` and `roughdielectric`.
    pub(super) fn transparent(
        &mut self,
        id: ObjectId,
        plugin: &str,
        textured: &mut Textures,
    ) -> Result<Bsdf, ImportError> {
        let eta = self.relative_index(id, "bk7")?;
        let reflect = self.paint(id, "specular_reflectance", Slot::Specular, textured)?.unwrap_or([1.0; 3]);
        let transmit = self.paint(id, "specular_transmittance", Slot::Transmit, textured)?.unwrap_or([1.0; 3]);
        Ok(match plugin {
            "thindielectric" => Bsdf::ThinDielectric { eta, reflect, transmit },
            // equal indices bend nothing, however rough
            "roughdielectric" if eta != 1.0 => {
                let (distribution, alpha) = (self.distribution(id)?, self.roughness(id, textured)?);
                self.ignore(id, &["sample_visible"]);
                Bsdf::RoughDielectric { distribution, alpha, eta, reflect, transmit }
            }
            "roughdielectric" => {
                // read for what is wrong with them
                self.distribution(id)?;
                self.roughness(id, &mut Textures::new())?;
                self.ignore(id, &["sample_visible"]);
                let place = &self.document.objects[id].place;
                self.note(place, "roughdielectric between equal indices: light passes unbent, whatever its roughness");
                Bsdf::Dielectric { eta, reflect, transmit }
            }
            _ => Bsdf::Dielectric { eta, reflect, transmit },
        })
    }

    /// `plastic` and `roughplastic`.
    pub(super) fn plastic(&mut self, id: ObjectId, plugin: &str, textured: &mut Textures) -> Result<Bsdf, ImportError> {
        let eta = self.relative_index(id, "polypropylene")?;
        let diffuse = self.paint(id, "diffuse_reflectance", Slot::Diffuse, textured)?.unwrap_or([0.5; 3]);
        let specular = self.paint(id, "specular_reflectance", Slot::Specular, textured)?.unwrap_or([1.0; 3]);
        let nonlinear = self.boolean(id, "nonlinear")?.unwrap_or(false);
        if plugin == "plastic" {
            return Ok(Bsdf::Plastic { eta, diffuse, specular, nonlinear });
        }
        let distribution = self.distribution(id)?;
        let place = &self.document.objects[id].place;
        let mut of_alpha = Textures::new();
        let [alpha, other] = self.roughness(id, &mut of_alpha)?;
        if alpha != other {
            return malformed(place, "a rough plastic is isotropic: give alpha");
        }
        if !of_alpha.is_empty() {
            // nor in Mitsuba
            self.unsupported(place, "a texture for the alpha of a roughplastic", "0.1");
        }
        self.ignore(id, &["sample_visible"]);
        let coat = self.coats.get(distribution, alpha, eta);
        Ok(Bsdf::RoughPlastic { distribution, alpha, eta, diffuse, specular, nonlinear, coat })
    }

    /// `int_ior` over `ext_ior` (air), each a number or a name.
    fn relative_index(&mut self, id: ObjectId, inside: &str) -> Result<f32, ImportError> {
        let inside = self.index(id, "int_ior", inside)?;
        let outside = self.index(id, "ext_ior", "air")?;
        let eta = inside / outside;
        if !(1.0 / LARGEST..=LARGEST).contains(&eta) {
            return malformed(
                self.place_of(id, "int_ior"),
                format!("int_ior over ext_ior is {eta}; it should lie between 0.1 and 10"),
            );
        }
        Ok(eta as f32)
    }

    fn index(&mut self, id: ObjectId, property: &str, default: &str) -> Result<f64, ImportError> {
        let Some(p) = self.property(id, property) else { return Ok(refraction::find(default).unwrap_or(1.0)) };
        match &p.value {
            Value::Float(v) => Ok(*v),
            Value::Integer(v) => Ok(*v as f64),
            Value::String(name) => match refraction::find(name) {
                Some(v) => Ok(v),
                None => malformed(
                    &p.place,
                    format!("no index of refraction is known for \"{name}\"; there are {}", refraction::names()),
                ),
            },
            _ => malformed(&p.place, format!("\"{property}\" should be a <float> or a <string>")),
        }
    }
}
