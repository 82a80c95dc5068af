//! What paths are computed in: f32, or f64 in the build that shows what f32 costs (the feature `double`; docs/numerics.md).
//!
//! A file of the path's code takes `f32` and the vectors from here by these names, so that one source is compiled in both. In the plain
//! build they are what they are called, to the letter. What is stored or sent (blocks, texels, the film) keeps the plain `f32`.

pub use numbers::*;

#[cfg(not(feature = "double"))]
mod numbers {
    pub use core::f32::consts;
    pub use core::primitive::f32;

    pub use glam::{Vec3, Vec4};
    pub use libm::{asinf as asin, expm1f as expm1, logf as log, powf as pow};

    /// A float's bits as a signed number.
    pub type Signed = i32;
    /// Place of the sign in a float's bits.
    pub const SIGN: u32 = 31;

    #[inline(always)]
    pub fn wide(v: Vec3) -> glam::DVec3 {
        v.as_dvec3()
    }
    #[inline(always)]
    pub fn narrow(v: glam::DVec3) -> Vec3 {
        v.as_vec3()
    }
}

#[cfg(feature = "double")]
mod numbers {
    pub use core::f64::consts;

    pub use glam::{DVec3 as Vec3, DVec4 as Vec4};
    pub use libm::{asin, expm1, log, pow};

    #[allow(non_camel_case_types)] // stands in for the primitive of this name
    pub type f32 = f64;
    pub type Signed = i64;
    pub const SIGN: u32 = 63;

    #[inline(always)]
    pub fn wide(v: Vec3) -> Vec3 {
        v
    }
    #[inline(always)]
    pub fn narrow(v: Vec3) -> Vec3 {
        v
    }
}

/// What is stored, in every build.
#[allow(unused_qualifications)] // `f32` is another type in the other build
pub type Stored = core::primitive::f32;

/// A stored number, to be computed with.
#[inline(always)]
#[allow(clippy::unnecessary_cast)] // not in the other build
pub const fn real(x: Stored) -> f32 {
    x as f32
}

/// A number that was computed, to be stored.
#[inline(always)]
#[allow(clippy::unnecessary_cast)] // likewise
pub const fn stored(x: f32) -> Stored {
    x as Stored
}
