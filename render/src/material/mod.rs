//! What surfaces are made of: the description of a material, and one BSDF a file.

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
