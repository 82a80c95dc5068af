//! The records that the whole engine speaks in: rays, hits, and the key of a path's vertex.

use bytemuck::{Pod, Zeroable};

use crate::real::f32;

/// A ray as the kernel takes it: the points `o + t d` with `tmin < t <= tmax`.
///
/// `d` need not be of unit length; `t` is in units of `|d|`. A negative `tmin` counts as 0.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Ray {
    /// Origin, in recentred scene units.
    pub o: [f32; 3],
    /// Hits at or before this are none.
    pub tmin: f32,
    /// Direction.
    pub d: [f32; 3],
    /// Hits after this are none.
    pub tmax: f32,
}

/// The nearest hit of a ray, or none (`prim == MISS`).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(not(feature = "double"), derive(Pod, Zeroable))]
pub struct Hit {
    /// Ray parameter of the hit.
    pub t: f32,
    /// Barycentric coordinate of the second vertex (triangles; 0 for spheres).
    pub u: f32,
    /// Barycentric coordinate of the third vertex (triangles; 0 for spheres).
    pub v: f32,
    /// Slot of the primitive in the forest that was traced, or [`MISS`]. A slot is valid for that forest only.
    pub prim: u32,
    /// Where the primitive's vertices lie in the forest's arena (opaque).
    pub leaf: u32,
    /// Which of that leaf's primitives it is (opaque).
    pub lane: u32,
}

/// `Hit::prim` of a ray that hit nothing.
pub const MISS: u32 = u32::MAX;

impl Hit {
    /// No hit, with `t` at the ray's limit.
    pub const fn miss(tmax: f32) -> Self {
        Hit { t: tmax, u: 0.0, v: 0.0, prim: MISS, leaf: 0, lane: 0 }
    }
    /// Whether something was hit.
    pub const fn is_hit(&self) -> bool {
        self.prim != MISS
    }
}

/// Place of a primitive in the scene's source order: the same number however the scene was cut, shared by copies.
pub type PrimId = u64;

/// Names one vertex of one path; every random number is a function of (seed, key, dimension).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Pod, Zeroable)]
pub struct PathKey {
    /// y * width + x.
    pub pixel: u32,
    /// Index of the sample in its pixel, below 2^24.
    pub sample: u32,
    /// Number of the sibling after splitting at the first hit; 0 before.
    pub branch: u16,
    /// Vertices before this ray: 0 for a camera ray.
    pub vertex: u16,
}
