//! The small, global part of a prepared scene: materials, shapes, lights. Every task holds it.

use serde::{Deserialize, Serialize};

use crate::material::Material;
use crate::ray::PrimId;

/// Materials, shapes, emitters and sky of a scene, in recentred f32 coordinates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct World {
    /// What shapes refer to.
    pub materials: Vec<Material>,
    /// By shape number, as the attributes of a split name them.
    pub shapes: Vec<ShapeInfo>,
    /// Every primitive that emits, by ascending id.
    pub emissive: Vec<EmissivePrimitive>,
    /// Radiance of a constant sky, if any.
    pub environment: Option<[f32; 3]>,
    /// Lower corner of the scene's box.
    pub lo: [f32; 3],
    /// Upper corner of the scene's box.
    pub hi: [f32; 3],
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
