//! The small, global part of a prepared scene: materials, textures, shapes, lights. Every task holds it.

use serde::{Deserialize, Serialize};

use crate::material::Material;
use crate::ray::PrimId;
use crate::texture::{Bitmap, Texture};

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
    },
    /// Parallel light from infinitely far away.
    Directional {
        /// Unit vector along which it travels.
        direction: [f32; 3],
        /// On a surface that faces it, W/m2.
        irradiance: [f32; 3],
    },
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
