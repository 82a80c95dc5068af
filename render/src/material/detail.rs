//! What varies over a surface: textures in the place of a material's constants, opacity, relief.
//!
//! A material without any of it has no detail and pays for none. Else a hit looks up what it needs and goes on with a plain [`Bsdf`].

use serde::{Deserialize, Serialize};

use super::{Bsdf, Material, Principled};
use crate::real::{Vec3, f32};
use crate::texture::{At, Texture, Textures};

/// A parameter of a [`Bsdf`] that a texture may give.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Slot {
    /// Albedo: of a diffuse surface, of a plastic's base.
    Diffuse,
    /// Factor on what is reflected by metal, glass or coat.
    Specular,
    /// Factor on what passes through glass.
    Transmit,
    /// Roughness along u and v.
    Alpha,
    /// Roughness along u.
    AlphaU,
    /// Roughness along v.
    AlphaV,
    /// One of [`super::Principled`]'s numbers.
    Roughness,
    /// Likewise.
    Anisotropic,
    /// Likewise.
    Metallic,
    /// Likewise.
    SpecTrans,
    /// Likewise.
    SpecTint,
    /// Likewise.
    Sheen,
    /// Likewise.
    SheenTint,
    /// Likewise.
    Clearcoat,
    /// Likewise.
    ClearcoatGloss,
    /// Likewise.
    Flatness,
}

/// A texture in the place of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Textured {
    /// Which parameter.
    pub slot: Slot,
    /// Index into [`crate::world::World::textures`].
    pub texture: u32,
    /// What its colour is multiplied by; a number by the first.
    #[serde(default = "ones", skip_serializing_if = "is_ones")]
    pub scale: [f32; 3],
}

impl Textured {
    /// A texture as it is.
    pub fn new(slot: Slot, texture: u32) -> Textured {
        Textured { slot, texture, scale: ones() }
    }
}

fn ones() -> [f32; 3] {
    [1.0; 3]
}

fn is_ones(scale: &[f32; 3]) -> bool {
    *scale == ones()
}

/// A number, or a texture that gives it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Amount {
    /// The same everywhere.
    Constant(f32),
    /// Index into [`crate::world::World::textures`].
    Texture(u32),
}

/// What turns the shading normal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Relief {
    /// How the texture says it.
    pub kind: ReliefKind,
    /// Index into [`crate::world::World::textures`].
    pub texture: u32,
    /// Seen from behind it is the mirror image of the front (`twosided` around it), not its other side (inside of it).
    pub mirrored: bool,
    /// Light that comes in flat is dimmed by how far the normal is turned, so that relief does not end light at an edge (Estevez, Lecocq and Stein,
    /// "A microfacet-based shadowing function to solve the bump terminator problem", Ray Tracing Gems, 2019): Mitsuba 3's `use_shadowing_function`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub shadowed: bool,
}

/// How a texture says where the normal points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ReliefKind {
    /// It is a height above the surface, times this.
    Bump(f32),
    /// Its colour c is the normal 2 c - 1 in the frame of dp/du and the shading normal.
    Normals,
}

/// Two materials in the place of one. At each hit one of them is met, by the weight: in the mean that is the weighted sum of both.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Blend {
    /// Probability of the second.
    pub weight: Amount,
    /// Indices into [`crate::world::World::materials`], below the material's own.
    pub parts: [u32; 2],
}

/// What a material has beside its model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detail {
    /// Parameters that vary.
    pub textured: Vec<Textured>,
    /// Probability of meeting the material; else the ray passes as if there were nothing.
    pub opacity: Amount,
    /// What turns the shading normal.
    pub relief: Option<Relief>,
    /// Index into [`crate::world::World::materials`], below the material's own, of what the back side is made of, if it is something else.
    pub back: Option<u32>,
    /// What is met in its place; its own model and relief are of no meaning then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blend: Option<Blend>,
}

impl Default for Detail {
    /// Nothing.
    fn default() -> Self {
        Detail { textured: Vec::new(), opacity: Amount::Constant(1.0), relief: None, back: None, blend: None }
    }
}

impl Detail {
    /// Whether it is textures in the place of parameters and nothing else.
    #[inline(always)]
    pub fn is_paint(&self) -> bool {
        self.relief.is_none() && self.back.is_none() && self.blend.is_none() && self.opacity == Amount::Constant(1.0)
    }

    /// Every texture that it names.
    pub fn textures(&self) -> impl Iterator<Item = u32> {
        let of = |amount: Amount| match amount {
            Amount::Constant(_) => None,
            Amount::Texture(n) => Some(n),
        };
        let weight = self.blend.and_then(|b| of(b.weight));
        let own = self.textured.iter().map(|t| t.texture);
        own.chain(of(self.opacity)).chain(self.relief.map(|r| r.texture)).chain(weight)
    }

    /// Every other material that it names.
    pub fn materials(&self) -> impl Iterator<Item = u32> {
        self.back.into_iter().chain(self.blend.into_iter().flat_map(|b| b.parts))
    }
}

impl Amount {
    /// Its value at a place, brought into [0, 1].
    #[inline]
    pub fn share(self, textures: &[Texture], tiles: &dyn Textures, at: At) -> f32 {
        match self {
            Amount::Constant(x) => x,
            Amount::Texture(n) => share(textures[n as usize].amount(tiles, at)),
        }
    }
}

/// In [0, 1]; 0 for NaN.
#[inline(always)]
pub(super) fn share(x: f32) -> f32 {
    if x > 0.0 { x.min(1.0) } else { 0.0 }
}

/// A colour times a factor, brought into [0, 1].
#[inline(always)]
pub(super) fn scaled(color: Vec3, scale: [f32; 3]) -> [f32; 3] {
    (color * Vec3::from(scale)).to_array().map(share)
}

impl Material {
    /// The model at a place. Colours are brought into [0, 1] and roughness to at most 1.
    #[inline(never)]
    pub fn at(&self, detail: &Detail, textures: &[Texture], tiles: &dyn Textures, at: At) -> Bsdf {
        let mut bsdf = self.bsdf.clone();
        for &Textured { slot, texture, scale } in &detail.textured {
            let texture = &textures[texture as usize];
            match slot {
                Slot::Diffuse | Slot::Specular | Slot::Transmit => {
                    if let Some(place) = bsdf.color_mut(slot) {
                        *place = scaled(texture.color(tiles, at), scale);
                    }
                }
                Slot::Alpha | Slot::AlphaU | Slot::AlphaV => {
                    if let Some(alpha) = bsdf.alpha_mut() {
                        let value = share(texture.amount(tiles, at) * scale[0]);
                        match slot {
                            Slot::AlphaU => alpha[0] = value,
                            Slot::AlphaV => alpha[1] = value,
                            _ => *alpha = [value; 2],
                        }
                    }
                }
                _ => {
                    if let Some(place) = bsdf.number_mut(slot) {
                        *place = share(texture.amount(tiles, at) * scale[0]);
                    }
                }
            }
        }
        bsdf
    }
}

impl Bsdf {
    /// The colour of a slot, where the model has it.
    pub fn color_mut(&mut self, slot: Slot) -> Option<&mut [f32; 3]> {
        match (self, slot) {
            (Bsdf::Diffuse { reflectance: color }, Slot::Diffuse)
            | (Bsdf::Phong { diffuse: color, .. }, Slot::Diffuse)
            | (Bsdf::Phong { specular: color, .. }, Slot::Specular)
            | (Bsdf::Principled(Principled { base_color: color, .. }), Slot::Diffuse)
            | (Bsdf::Plastic { diffuse: color, .. } | Bsdf::RoughPlastic { diffuse: color, .. }, Slot::Diffuse)
            | (Bsdf::Plastic { specular: color, .. } | Bsdf::RoughPlastic { specular: color, .. }, Slot::Specular)
            | (
                Bsdf::Conductor { specular: color, .. } | Bsdf::RoughConductor { specular: color, .. },
                Slot::Specular,
            )
            | (
                Bsdf::Dielectric { reflect: color, .. }
                | Bsdf::ThinDielectric { reflect: color, .. }
                | Bsdf::RoughDielectric { reflect: color, .. },
                Slot::Specular,
            )
            | (
                Bsdf::Dielectric { transmit: color, .. }
                | Bsdf::ThinDielectric { transmit: color, .. }
                | Bsdf::RoughDielectric { transmit: color, .. },
                Slot::Transmit,
            ) => Some(color),
            _ => None,
        }
    }

    /// The number of a slot, where the model has it.
    pub fn number_mut(&mut self, slot: Slot) -> Option<&mut f32> {
        let Bsdf::Principled(p) = self else { return None };
        p.number_mut(slot)
    }

    /// The roughness, where a texture may give it.
    pub fn alpha_mut(&mut self) -> Option<&mut [f32; 2]> {
        match self {
            Bsdf::RoughConductor { alpha, .. } | Bsdf::RoughDielectric { alpha, .. } => Some(alpha),
            _ => None,
        }
    }
}
