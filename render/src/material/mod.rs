//! What surfaces are made of: the description of a material, and one BSDF a file.
//!
//! Scattering is computed in a local frame whose z axis is the shading normal on the side of `wo`, the direction back along the ray. Both
//! directions point away from the surface; only reflection exists, so both have z above 0.

mod conductor;
mod diffuse;
mod rough;
#[cfg(test)]
mod tests;

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Microfacet distribution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Distribution {
    /// Beckmann.
    Beckmann,
    /// GGX (Trowbridge-Reitz).
    Ggx,
}

/// A reflectance model. RGB values are linear Rec. 709 in [0, 1] unless said.
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
}

impl Bsdf {
    /// Whether it reflects to single directions: nothing but [`Bsdf::sample`] finds them, and [`Bsdf::delta_weight`] is their weight.
    #[inline(always)]
    pub fn is_delta(&self) -> bool {
        matches!(self, Bsdf::Conductor { .. })
    }

    /// Whether the frame's tangents matter.
    #[inline(always)]
    pub fn is_anisotropic(&self) -> bool {
        matches!(self, Bsdf::RoughConductor { alpha, .. } if alpha[0] != alpha[1])
    }

    /// Value and density for a pair of local unit directions.
    #[inline(always)]
    pub fn eval(&self, wo: Vec3, wi: Vec3) -> Scatter {
        match self {
            Bsdf::Diffuse { reflectance } => diffuse::eval(*reflectance, wo, wi),
            Bsdf::Conductor { .. } => Scatter::NONE,
            Bsdf::RoughConductor { distribution, alpha, eta, k, specular } => {
                rough::Rough::new(*distribution, *alpha).eval(wo, wi, |cos| conductor::fresnel(cos, eta, k, specular))
            }
        }
    }

    /// Local `wi` for two numbers in [0, 1); `None` when it would lie below the surface: that sample is worth 0.
    #[inline(always)]
    pub fn sample(&self, wo: Vec3, u: [f32; 2]) -> Option<Vec3> {
        match self {
            Bsdf::Diffuse { .. } => diffuse::sample(wo, u),
            Bsdf::Conductor { .. } => (wo.z > 0.0).then(|| Vec3::new(-wo.x, -wo.y, wo.z)),
            Bsdf::RoughConductor { distribution, alpha, .. } => rough::Rough::new(*distribution, *alpha).sample(wo, u),
        }
    }

    /// Weight of a delta reflection: BSDF times cosine over the probability.
    pub fn delta_weight(&self, wo: Vec3) -> Vec3 {
        match self {
            Bsdf::Conductor { eta, k, specular } => conductor::fresnel(wo.z, eta, k, specular),
            _ => Vec3::ZERO,
        }
    }
}
