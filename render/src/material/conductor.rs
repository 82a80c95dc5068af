//! Fresnel reflectance of metals.

use crate::real::{Vec3, f32};

/// Unpolarised reflectance of a metal of index `eta + i k` in vacuum at cosine `cos`, times `factor`, per channel (the exact formula: Lagarde,
/// "Memo on Fresnel equations", 2013; Born and Wolf, section 14.2).
#[inline]
pub(super) fn fresnel(cos: f32, eta: &[f32; 3], k: &[f32; 3], factor: &[f32; 3]) -> Vec3 {
    let cos = cos.clamp(0.0, 1.0);
    Vec3::from_array(std::array::from_fn(|c| factor[c] * reflectance(cos, eta[c], k[c])))
}

fn reflectance(cos: f32, eta: f32, k: f32) -> f32 {
    let cos2 = cos * cos;
    let sin2 = 1.0 - cos2;
    let (eta2, k2) = (eta * eta, k * k);
    // a^2 + b^2 and a of the refracted ray's complex cosine times the index, a + i b
    let t = eta2 - k2 - sin2;
    let ab = (t * t + 4.0 * eta2 * k2).max(0.0).sqrt();
    let a = (0.5 * (ab + t)).max(0.0).sqrt();
    let (up, low) = (ab + cos2 - 2.0 * a * cos, ab + cos2 + 2.0 * a * cos);
    if !(low > 0.0) {
        return 1.0;
    }
    let s = up / low;
    let (up, low) = (ab * cos2 + sin2 * sin2 - 2.0 * a * cos * sin2, ab * cos2 + sin2 * sin2 + 2.0 * a * cos * sin2);
    // both are 0 at perpendicular incidence of a perfect match only
    let p = if low > 0.0 { s * (up / low) } else { s };
    (0.5 * (s + p)).clamp(0.0, 1.0)
}
