//! Fresnel reflectance of metals.

use crate::real::{Vec3, f32};

/// Unpolarised reflectance of a metal of index `eta + i k` in vacuum at cosine `cos`, times `factor`, per channel (the exact formula: Lagarde,
/// "Memo on Fresnel equations", 2013; Born and Wolf, section 14.2).
#[inline(always)]
pub(super) fn fresnel(cos: f32, eta: &[f32; 3], k: &[f32; 3], factor: &[f32; 3]) -> Vec3 {
    let cos = cos.clamp(0.0, 1.0);
    // written out and without branches: blocks of vertices are compiled from it
    Vec3::new(
        factor[0] * reflectance(cos, eta[0], k[0]),
        factor[1] * reflectance(cos, eta[1], k[1]),
        factor[2] * reflectance(cos, eta[2], k[2]),
    )
}

#[inline(always)]
fn reflectance(cos: f32, eta: f32, k: f32) -> f32 {
    let cos2 = cos * cos;
    let sin2 = 1.0 - cos2;
    let (eta2, k2) = (eta * eta, k * k);
    // a^2 + b^2 and a of the refracted ray's complex cosine times the index, a + i b
    let t = eta2 - k2 - sin2;
    let ab = (t * t + 4.0 * eta2 * k2).max(0.0).sqrt();
    let a = (0.5 * (ab + t)).max(0.0).sqrt();
    let (up, low) = (ab + cos2 - 2.0 * a * cos, ab + cos2 + 2.0 * a * cos);
    let (s, counts) = (up / low, low > 0.0);
    let (up, low) = (ab * cos2 + sin2 * sin2 - 2.0 * a * cos * sin2, ab * cos2 + sin2 * sin2 + 2.0 * a * cos * sin2);
    // both are 0 at perpendicular incidence of a perfect match only
    let p = if low > 0.0 { s * (up / low) } else { s };
    if counts { (0.5 * (s + p)).clamp(0.0, 1.0) } else { 1.0 }
}
