//! The small, global part of a prepared scene: materials, textures, shapes, lights. Every task holds it.

use serde::{Deserialize, Serialize};

use crate::material::Material;
use crate::math::atan2;
use crate::ray::PrimId;
use crate::real::consts::FRAC_1_PI;
use crate::real::{Vec3, f32};
use crate::texture::{At, Bitmap, Texture};

/// Materials, textures, shapes, emitters and sky of a scene, in recentred f32 coordinates.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct World {
    /// What shapes refer to.
    pub materials: Vec<Material>,
    /// What materials refer to; the tiles of all, in this order, are numbered from 0.
    #[serde(default)]
    pub textures: Vec<Texture>,
    /// By shape number, as the attributes of a split name them.
    pub shapes: Vec<ShapeInfo>,
    /// Every primitive that emits, by ascending id.
    pub emissive: Vec<EmissivePrimitive>,
    /// By ascending id: what those of them have whose shape's emission a texture gives.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub glows: Vec<Glow>,
    /// Light from points and single directions, which no ray comes upon.
    pub beams: Vec<Beam>,
    /// The sky, if any.
    pub environment: Option<Environment>,
    /// The sun, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sun: Option<Sun>,
    /// Lower corner of the scene's box.
    pub lo: [f32; 3],
    /// Upper corner of the scene's box.
    pub hi: [f32; 3],
}

impl World {
    /// Number of tiles of all textures.
    pub fn tiles(&self) -> u32 {
        self.textures.iter().map(|t| t.tiles().end).max().unwrap_or(0)
    }

    /// Checks that every number names something that is there, and that textures are what look-ups rely on; the message says what is wrong.
    pub fn check(&self) -> Result<(), String> {
        let mut next = 0;
        for (i, texture) in self.textures.iter().enumerate() {
            let Texture::Bitmap(bitmap) = texture else { continue };
            let sound = bitmap.size.iter().all(|n| (1..=Bitmap::MOST).contains(n))
                && [1, 3].contains(&bitmap.channels)
                && bitmap.first_tile == next
                && bitmap.tiles().end < 1 << 28;
            if !sound {
                return Err(format!("texture {i} has a size, channels or tiles that cannot be"));
            }
            next = bitmap.tiles().end;
        }
        let (materials, textures) = (self.materials.len(), self.textures.len());
        for (i, material) in self.materials.iter().enumerate() {
            let Some(detail) = &material.detail else { continue };
            // of one above itself it may be part in turn, without end
            let above = detail.materials().any(|m| m as usize >= i);
            if above || detail.textures().any(|t| t as usize >= textures) {
                return Err(format!(
                    "material {:?} names a texture that is not there, or a material that is not above it",
                    material.name
                ));
            }
        }
        if self.shapes.iter().any(|s| s.material as usize >= materials)
            || self.emissive.iter().any(|e| e.shape as usize >= self.shapes.len())
        {
            return Err("it names shapes or materials that it lacks".into());
        }
        let slides = self.beams.iter().filter_map(|beam| match beam {
            Beam::Spot { slide: Some(slide), .. } => Some(slide.texture),
            _ => None,
        });
        if self.shapes.iter().filter_map(|s| s.emission_texture).chain(slides).any(|t| t as usize >= textures) {
            return Err("a light names a texture that is not there".into());
        }
        if !self.glows.is_sorted_by(|a, b| a.prim < b.prim) {
            return Err("what its textured lights have is out of order".into());
        }
        Ok(())
    }
}

/// Light from infinitely far away.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Environment {
    /// This radiance from everywhere.
    Constant([f32; 3]),
    /// A picture, which is an object of its own: [`crate::light::SkyMap`].
    Map {
        /// What the picture's values are multiplied by.
        scale: f32,
        /// Rows of the rotation (perhaps mirrored) that turns a direction of the world into one of the picture.
        to_map: [[f32; 3]; 3],
        /// Nothing comes from the picture's lower half (y below 0), not even by interpolation.
        #[serde(default, skip_serializing_if = "is_false")]
        upper: bool,
    },
}

fn is_false(b: &bool) -> bool {
    !b
}

/// A disk that shines evenly from infinitely far away.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Unit vector towards its middle.
    pub direction: [f32; 3],
    /// Unit vector upwards: nothing comes from below the horizon.
    pub up: [f32; 3],
    /// 1 - cos of the angle from its middle to its edge, in (0, 1).
    pub cap: f32,
    /// W/sr/m2.
    pub radiance: [f32; 3],
}

/// Light that arrives at a point from one direction only.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Beam {
    /// A point that shines alike all around.
    Point {
        /// Where it is.
        position: [f32; 3],
        /// Radiant intensity, W/sr.
        intensity: [f32; 3],
    },
    /// A point that shines into a cone.
    Spot {
        /// Where it is.
        position: [f32; 3],
        /// Unit vector along the cone's middle.
        axis: [f32; 3],
        /// Radiant intensity in the inner cone, W/sr.
        intensity: [f32; 3],
        /// Half angle of the inner cone, radians.
        beam: f32,
        /// Half angle beyond which it is dark, radians; from the inner cone on the intensity falls linearly with the angle.
        cutoff: f32,
        /// A picture that it throws.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        slide: Option<Slide>,
    },
    /// Parallel light from infinitely far away.
    Directional {
        /// Unit vector along which it travels.
        direction: [f32; 3],
        /// On a surface that faces it, W/m2.
        irradiance: [f32; 3],
    },
}

/// A texture in front of a spot light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slide {
    /// Index into [`World::textures`]; its colour is a factor of the intensity.
    pub texture: u32,
    /// Rows of the map that turns a direction of the world into the light's: the third is along its axis.
    pub to_local: [[f32; 3]; 3],
    /// Tangent of the cone's half angle: so far along x or y at distance 1 texture coordinates are 0 and 1.
    pub tan: f32,
}

impl Slide {
    /// Texture coordinates of a direction away from the light.
    #[inline]
    pub fn uv(&self, d: Vec3) -> [f32; 2] {
        let [x, y, z] = self.to_local.map(|row| Vec3::from(row).dot(d));
        [x, y].map(|a| 0.5 + 0.5 * a / (z * self.tan))
    }
}

/// What a hit needs to know about its shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShapeInfo {
    /// Name in the source, for reports.
    pub name: String,
    /// Index into [`World::materials`].
    pub material: u32,
    /// Radiance emitted from the front, if any.
    pub emission: Option<[f32; 3]>,
    /// Index into [`World::textures`] of what that is multiplied by.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub emission_texture: Option<u32>,
}

/// A primitive of a shape that emits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EmissivePrimitive {
    /// Its global id.
    pub prim: PrimId,
    /// Its shape.
    pub shape: u32,
    /// Where it is.
    pub geometry: Primitive,
}

/// What a primitive has whose emission a texture gives: enough to look it up at any of its points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Glow {
    /// Its global id.
    pub prim: PrimId,
    /// Texture coordinates of a triangle's vertices.
    pub uv: Option<[[f32; 2]; 3]>,
    /// The mesh's attribute at a triangle's vertices.
    pub attribute: Option<[[f32; 3]; 3]>,
    /// About the mean luminance of the texture on it, by which it is chosen; 0 only if the texture is dark everywhere.
    pub weight: f32,
}

impl Glow {
    /// Where the texture is looked up at a point of a triangle, by its barycentric coordinates of the second and third vertex.
    #[inline]
    pub fn on_triangle(&self, u: f32, v: f32) -> At {
        At {
            uv: self.uv.map_or([u, v], |uv| interpolated(&uv, u, v)),
            attribute: self.attribute.map_or(Vec3::ZERO, |a| interpolated(&a, u, v).into()),
        }
    }
}

/// Values of a triangle's vertices at a point of it.
#[inline(always)]
pub(crate) fn interpolated<const N: usize>([a, b, c]: &[[f32; N]; 3], u: f32, v: f32) -> [f32; N] {
    let w = 1.0 - u - v;
    std::array::from_fn(|k| a[k] * w + b[k] * u + c[k] * v)
}

/// Texture coordinates of a sphere where its outward unit normal is `n`: longitude and colatitude from z, in [0, 1].
pub fn sphere_uv(n: Vec3) -> [f32; 2] {
    let turn = atan2(n.y, n.x) * (0.5 * FRAC_1_PI);
    let v = atan2((n.x * n.x + n.y * n.y).sqrt(), n.z) * FRAC_1_PI;
    [if turn < 0.0 { turn + 1.0 } else { turn }, v]
}

/// Geometry of one primitive, in recentred coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Primitive {
    /// Vertices, counter-clockwise from the front.
    Triangle([[f32; 3]; 3]),
    /// An exact sphere; the front is outside unless flipped.
    Sphere {
        /// Centre.
        center: [f32; 3],
        /// Radius, above 0.
        radius: f32,
        /// Front is inside.
        flipped: bool,
    },
}
