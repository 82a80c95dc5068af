//! What surfaces are made of: the description of a material, and one BSDF a file.
//!
//! Scattering is computed in a local frame whose z axis is the shading normal on the side of `wo`, the direction back along the ray. Both
//! directions point away from the surface: `wo` has z above 0, and so has what is reflected; what is transmitted has z below 0.

mod beckmann;
mod conductor;
mod detail;
#[cfg(test)]
mod detail_tests;
mod dielectric;
mod diffuse;
mod gloss;
mod phong;
mod plastic;
mod principled;
#[cfg(test)]
mod random_tests;
mod rough;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

pub use detail::{Amount, Blend, Detail, Relief, ReliefKind, Slot, Textured};
pub(crate) use gloss::{Coat, Glass, Kind, Look, Metal};
pub use plastic::Transmittance;
pub use principled::Principled;

use dielectric::RoughInterface;
use phong::Phong;
use plastic::Coated;
use rough::Rough;

use crate::real::{Vec3, f32};

/// Microfacet distribution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Distribution {
    /// Beckmann.
    Beckmann,
    /// GGX (Trowbridge-Reitz).
    Ggx,
}

/// A reflectance model. RGB values are linear Rec. 709 in [0, 1] unless said.
// a coat's table lies in it: the copy that a textured hit makes takes no memory from the heap
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Bsdf {
    /// Lambertian reflection.
    Diffuse {
        /// Albedo.
        reflectance: [f32; 3],
    },
    /// Smooth metal.
    Conductor {
        /// Index of refraction per channel.
        eta: [f32; 3],
        /// Absorption per channel.
        k: [f32; 3],
        /// Factor on the Fresnel reflectance.
        specular: [f32; 3],
    },
    /// Rough metal, isotropic or not, visible normals sampled.
    RoughConductor {
        /// Distribution of normals.
        distribution: Distribution,
        /// Roughness along u and v, in (0, 1].
        alpha: [f32; 2],
        /// Index of refraction per channel.
        eta: [f32; 3],
        /// Absorption per channel.
        k: [f32; 3],
        /// Factor on the Fresnel reflectance.
        specular: [f32; 3],
    },
    /// Smooth interface of a transparent solid.
    Dielectric {
        /// Index inside over outside, above 0.
        eta: f32,
        /// Factor on what is reflected.
        reflect: [f32; 3],
        /// Factor on what passes.
        transmit: [f32; 3],
    },
    /// Thin pane of a transparent solid: what passes keeps its direction.
    ThinDielectric {
        /// Index inside over outside, above 0.
        eta: f32,
        /// Factor on what is reflected.
        reflect: [f32; 3],
        /// Factor on what passes.
        transmit: [f32; 3],
    },
    /// Rough interface of a transparent solid, visible normals sampled.
    RoughDielectric {
        /// Distribution of normals.
        distribution: Distribution,
        /// Roughness along u and v, in (0, 1].
        alpha: [f32; 2],
        /// Index inside over outside, above 0; not 1.
        eta: f32,
        /// Factor on what is reflected.
        reflect: [f32; 3],
        /// Factor on what passes.
        transmit: [f32; 3],
    },
    /// Diffuse base under a smooth coat.
    Plastic {
        /// Index of the coat over the outside, above 0.
        eta: f32,
        /// Albedo of the base.
        diffuse: [f32; 3],
        /// Factor on the coat's reflection.
        specular: [f32; 3],
        /// Light thrown back inside is coloured each time.
        nonlinear: bool,
    },
    /// Diffuse base under a rough coat.
    RoughPlastic {
        /// Distribution of the coat's normals.
        distribution: Distribution,
        /// Roughness of the coat, in (0, 1].
        alpha: f32,
        /// Index of the coat over the outside, above 0.
        eta: f32,
        /// Albedo of the base.
        diffuse: [f32; 3],
        /// Factor on the coat's reflection.
        specular: [f32; 3],
        /// Light thrown back inside is coloured each time.
        nonlinear: bool,
        /// Of this distribution, roughness and index.
        coat: Transmittance,
    },
    /// A diffuse part and a lobe about the mirror's direction.
    Phong {
        /// Factor on the diffuse part.
        diffuse: [f32; 3],
        /// Factor on the lobe.
        specular: [f32; 3],
        /// Of the lobe's cosine, at least 0.
        exponent: f32,
    },
    /// Mitsuba's model of many parameters.
    Principled(Principled),
}

/// What a surface is made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Name in the source (id), for reports.
    pub name: String,
    /// The model.
    pub bsdf: Bsdf,
    /// Whether the back side reflects like the front; a one-sided opaque surface is black from behind.
    pub two_sided: bool,
    /// What varies over the surface, if anything does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<Box<Detail>>,
}

impl Material {
    /// One that is the same everywhere.
    pub fn new(name: impl Into<String>, bsdf: Bsdf, two_sided: bool) -> Self {
        Material { name: name.into(), bsdf, two_sided, detail: None }
    }

    /// Whether every ray from one place goes on the same way.
    #[inline(always)]
    pub fn is_mirror(&self) -> bool {
        self.bsdf.is_mirror() && self.detail.as_ref().is_none_or(|d| d.is_paint())
    }
}

/// What a BSDF does to one pair of directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scatter {
    /// BSDF times the cosine of the angle between `wi` and the normal.
    pub value: Vec3,
    /// Density, in solid angle, with which [`Bsdf::sample`] gives `wi`.
    pub pdf: f32,
}

impl Scatter {
    /// No scattering.
    pub const NONE: Scatter = Scatter { value: Vec3::ZERO, pdf: 0.0 };

    /// None but where `yes`: selects, no branch.
    #[inline(always)]
    fn only(self, yes: bool) -> Scatter {
        let pick = |x: f32| if yes { x } else { 0.0 };
        let Scatter { value, pdf } = self;
        Scatter { value: Vec3::new(pick(value.x), pick(value.y), pick(value.z)), pdf: pick(pdf) }
    }
}

/// A direction sampled from a BSDF.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sampled {
    /// Local unit direction.
    pub wi: Vec3,
    /// Of a single direction, which [`Bsdf::eval`] does not know: BSDF times cosine over its probability. `None` where `eval` says it.
    pub delta: Option<Vec3>,
}

impl Sampled {
    fn smooth(wi: Vec3) -> Sampled {
        Sampled { wi, delta: None }
    }
    fn delta(wi: Vec3, weight: Vec3) -> Sampled {
        Sampled { wi, delta: Some(weight) }
    }
}

impl Bsdf {
    /// Whether it scatters to single directions only, so that sampling lights is of no use.
    #[inline(always)]
    pub fn is_delta(&self) -> bool {
        matches!(self, Bsdf::Conductor { .. } | Bsdf::Dielectric { .. } | Bsdf::ThinDielectric { .. })
    }

    /// Whether every sample is the same direction.
    #[inline(always)]
    pub fn is_mirror(&self) -> bool {
        matches!(self, Bsdf::Conductor { .. })
    }

    /// Whether light passes through; then both sides of the surface count.
    #[inline(always)]
    pub fn transmits(&self) -> bool {
        match self {
            Bsdf::Dielectric { .. } | Bsdf::ThinDielectric { .. } | Bsdf::RoughDielectric { .. } => true,
            Bsdf::Principled(p) => p.spec_trans > 0.0 && p.metallic < 1.0,
            _ => false,
        }
    }

    /// One colour for all of it, as denoisers want it, in [0, 1]: of the diffuse part, or of the base under a coat; of metal what it reflects head-on;
    /// of glass the factor on what passes.
    pub fn color(&self) -> Vec3 {
        match self {
            Bsdf::Diffuse { reflectance: color }
            | Bsdf::Plastic { diffuse: color, .. }
            | Bsdf::RoughPlastic { diffuse: color, .. }
            | Bsdf::Phong { diffuse: color, .. }
            | Bsdf::Principled(Principled { base_color: color, .. })
            | Bsdf::Dielectric { transmit: color, .. }
            | Bsdf::ThinDielectric { transmit: color, .. }
            | Bsdf::RoughDielectric { transmit: color, .. } => Vec3::from(*color),
            Bsdf::Conductor { eta, k, specular } | Bsdf::RoughConductor { eta, k, specular, .. } => {
                conductor::fresnel(1.0, eta, k, specular)
            }
        }
    }

    /// Whether the frame's tangents matter.
    #[inline(always)]
    pub fn is_anisotropic(&self) -> bool {
        match self {
            Bsdf::RoughConductor { alpha, .. } | Bsdf::RoughDielectric { alpha, .. } => alpha[0] != alpha[1],
            Bsdf::Principled(p) => p.anisotropic > 0.0,
            _ => false,
        }
    }

    /// Value and density for a pair of local unit directions; `front`: `wo` is on the surface's front side.
    #[inline(always)]
    pub fn eval(&self, wo: Vec3, wi: Vec3, front: bool) -> Scatter {
        match self {
            Bsdf::Diffuse { reflectance } => diffuse::eval(*reflectance, wo, wi),
            Bsdf::Conductor { .. } | Bsdf::Dielectric { .. } | Bsdf::ThinDielectric { .. } => Scatter::NONE,
            Bsdf::RoughConductor { distribution, alpha, eta, k, specular } => {
                Rough::new(*distribution, *alpha).eval(wo, wi, |cos| conductor::fresnel(cos, eta, k, specular))
            }
            Bsdf::RoughDielectric { .. } => self.interface(front).map_or(Scatter::NONE, |i| i.eval(wo, wi)),
            Bsdf::Plastic { .. } => self.coated().map_or(Scatter::NONE, |c| c.eval_smooth(wo, wi)),
            Bsdf::RoughPlastic { distribution, alpha, coat, .. } => self
                .coated()
                .map_or(Scatter::NONE, |c| c.eval_rough(&Rough::new(*distribution, [*alpha; 2]), coat, wo, wi)),
            Bsdf::Phong { diffuse, specular, exponent } => Phong::new(*diffuse, *specular, *exponent).eval(wo, wi),
            Bsdf::Principled(p) => p.eval(wo, wi, front),
        }
    }

    /// Local `wi` for two numbers and one that chooses between parts, in [0, 1); `None` when it would lie on the wrong side of the surface: that
    /// sample is worth 0.
    #[inline(always)]
    pub fn sample(&self, wo: Vec3, front: bool, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        match self {
            Bsdf::Diffuse { .. } => diffuse::sample(wo, u).map(Sampled::smooth),
            Bsdf::Conductor { eta, k, specular } => (wo.z > 0.0)
                .then(|| Sampled::delta(Vec3::new(-wo.x, -wo.y, wo.z), conductor::fresnel(wo.z, eta, k, specular))),
            Bsdf::RoughConductor { distribution, alpha, .. } => {
                Rough::new(*distribution, *alpha).sample(wo, u).map(Sampled::smooth)
            }
            Bsdf::Dielectric { eta, reflect, transmit } => {
                dielectric::sample_smooth(wo, relative(*eta, front), *reflect, *transmit, lobe)
            }
            Bsdf::ThinDielectric { eta, reflect, transmit } => {
                dielectric::sample_thin(wo, *eta, *reflect, *transmit, lobe)
            }
            Bsdf::RoughDielectric { .. } => self.interface(front)?.sample(wo, u, lobe),
            Bsdf::Plastic { .. } => self.coated()?.sample_smooth(wo, u, lobe),
            Bsdf::RoughPlastic { distribution, alpha, coat, .. } => {
                self.coated()?.sample_rough(&Rough::new(*distribution, [*alpha; 2]), coat, wo, u, lobe)
            }
            Bsdf::Phong { diffuse, specular, exponent } => {
                Phong::new(*diffuse, *specular, *exponent).sample(wo, u, lobe)
            }
            Bsdf::Principled(p) => p.sample(wo, front, u, lobe),
        }
    }

    fn interface(&self, front: bool) -> Option<RoughInterface> {
        let Bsdf::RoughDielectric { distribution, alpha, eta, reflect, transmit } = self else { return None };
        Some(RoughInterface {
            rough: Rough::new(*distribution, *alpha),
            eta: relative(*eta, front),
            reflect: (*reflect).into(),
            transmit: (*transmit).into(),
        })
    }

    fn coated(&self) -> Option<Coated> {
        match self {
            Bsdf::Plastic { eta, diffuse, specular, nonlinear }
            | Bsdf::RoughPlastic { eta, diffuse, specular, nonlinear, .. } => Some(Coated {
                eta: *eta,
                diffuse: (*diffuse).into(),
                specular: (*specular).into(),
                nonlinear: *nonlinear,
            }),
            _ => None,
        }
    }
}

/// Index beyond the surface over the index on this side.
#[inline(always)]
pub(crate) fn relative(eta: f32, front: bool) -> f32 {
    if front { eta } else { 1.0 / eta }
}
