//! Lambertian reflection.

use super::Scatter;
use crate::math::concentric_disk;
use crate::real::consts::FRAC_1_PI;
use crate::real::{Vec3, f32};

#[inline(always)]
pub(super) fn eval(reflectance: [f32; 3], wo: Vec3, wi: Vec3) -> Scatter {
    if !(wo.z > 0.0 && wi.z > 0.0) {
        return Scatter::NONE;
    }
    let pdf = wi.z * FRAC_1_PI;
    Scatter { value: Vec3::from(reflectance) * pdf, pdf }
}

/// Cosine-weighted (Malley's method).
#[inline(always)]
pub(super) fn sample(wo: Vec3, u: [f32; 2]) -> Option<Vec3> {
    let (wi, counts) = sample_or_not(u);
    (wo.z > 0.0 && counts).then_some(wi)
}

/// The direction, and whether it is one.
#[inline(always)]
pub(super) fn sample_or_not(u: [f32; 2]) -> (Vec3, bool) {
    let [x, y] = concentric_disk(u);
    let z2 = 1.0 - x * x - y * y;
    (Vec3::new(x, y, z2.max(0.0).sqrt()), z2 > 0.0)
}
