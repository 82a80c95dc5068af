//! Small mathematics that is the same bits on every machine: directions, frames, error bounds, hashes, sine and cosine, exponential and logarithm.

use crate::real::{Vec3, f32};

#[cfg_attr(feature = "double", path = "dir_double.rs")]
mod dir;
mod exponential;
mod frame;
pub mod hash;
mod offset;
#[cfg(test)]
mod tests;
mod trig;

pub use dir::UnitDir;
pub(crate) use exponential::{erf_up, exp_down, ln};
pub use frame::Basis;
pub use offset::{Position, gamma, offset_origin};
pub use trig::{atan2, concentric_disk, sincos_turn};

/// `a` where `yes`, else `b`: no branch.
#[inline(always)]
pub(crate) fn select(yes: bool, a: Vec3, b: Vec3) -> Vec3 {
    let pick = |a: f32, b: f32| if yes { a } else { b };
    Vec3::new(pick(a.x, b.x), pick(a.y, b.y), pick(a.z, b.z))
}

/// Luminance of linear Rec. 709.
#[inline(always)]
pub fn luminance(c: Vec3) -> f32 {
    0.2126 * c.x + 0.7152 * c.y + 0.0722 * c.z
}

/// Maps 32 random bits to [0, 1): the upper 24, so that 1 is never reached.
#[inline(always)]
pub fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 * (1.0 / 16_777_216.0)
}
