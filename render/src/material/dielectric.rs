//! Interfaces between two transparent media: smooth, thin (a pane), rough.
//!
//! A rough interface is the model of Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces", with visible normals
//! sampled. Radiance is divided by the square of the relative index when it crosses (Veach 1997, section 5.2), as a path from the
//! camera needs it.

use super::rough::Rough;
use super::{Sampled, Scatter};
use crate::real::{Vec3, f32};

/// Unpolarised reflectance and the cosine of the refracted ray, for a ray at cosine `cos` (in [0, 1]) in a medium from which the other
/// side has index `eta` (Born and Wolf, section 1.5). Total reflection: (1, 0).
#[inline(always)]
pub(super) fn fresnel(cos: f32, eta: f32) -> (f32, f32) {
    // selects, no branches: blocks of vertices are compiled from it
    let straight = cos;
    let cos = cos.clamp(0.0, 1.0);
    let inv = 1.0 / eta;
    let cos2_t = 1.0 - (1.0 - cos * cos) * (inv * inv);
    let passes = cos2_t > 0.0;
    let cos_t = cos2_t.sqrt();
    let s = (cos - eta * cos_t) / (cos + eta * cos_t);
    let p = (eta * cos - cos_t) / (eta * cos + cos_t);
    let (r, cos_t) = if passes { ((0.5 * (s * s + p * p)).min(1.0), cos_t) } else { (1.0, 0.0) };
    if eta == 1.0 { (0.0, straight) } else { (r, cos_t) }
}

/// A smooth interface: a mirror's direction or the refracted one, by their shares of the energy.
pub(super) fn sample_smooth(wo: Vec3, eta: f32, reflect: [f32; 3], transmit: [f32; 3], lobe: f32) -> Option<Sampled> {
    if !(wo.z > 0.0) {
        return None;
    }
    let (r, cos_t) = fresnel(wo.z, eta);
    if lobe < r {
        return Some(Sampled::delta(Vec3::new(-wo.x, -wo.y, wo.z), reflect.into()));
    }
    let inv = 1.0 / eta;
    let wi = Vec3::new(-wo.x * inv, -wo.y * inv, -cos_t);
    (cos_t > 0.0).then(|| Sampled::delta(wi / wi.length(), Vec3::from(transmit) * (inv * inv)))
}

/// A pane with parallel faces, all reflections inside summed: r + t r t + t r^3 t + .. = 2 r / (1 + r); what passes keeps its direction.
pub(super) fn sample_thin(wo: Vec3, eta: f32, reflect: [f32; 3], transmit: [f32; 3], lobe: f32) -> Option<Sampled> {
    if !(wo.z > 0.0) {
        return None;
    }
    let (r, _) = fresnel(wo.z, eta);
    let r = 2.0 * r / (1.0 + r);
    Some(if lobe < r {
        Sampled::delta(Vec3::new(-wo.x, -wo.y, wo.z), reflect.into())
    } else {
        Sampled::delta(-wo, transmit.into())
    })
}

/// A rough interface; `eta` is the index beyond it over the index on the side of `wo`.
pub(super) struct RoughInterface {
    pub rough: Rough,
    pub eta: f32,
    pub reflect: Vec3,
    pub transmit: Vec3,
}

// selects, no branches: blocks of vertices are compiled from these
impl RoughInterface {
    #[inline(always)]
    pub(super) fn eval(&self, wo: Vec3, wi: Vec3) -> Scatter {
        let reflects = wi.z > 0.0;
        let m = wo + wi * if reflects { 1.0 } else { self.eta };
        let length = m.length();
        let m = m / if m.z < 0.0 { -length } else { length };
        let (cos_o, cos_i) = (wo.dot(m), wi.dot(m));
        // facets seen from the back neither reflect nor refract; nor do equal indices bend anything (length 0: NaN)
        let faces = (cos_o > 0.0) & (m.z > 0.0) & ((cos_i > 0.0) == reflects);
        let counts = (wo.z > 0.0) & (wi.z != 0.0) & (length > 0.0) & faces;
        let (r, _) = fresnel(cos_o, self.eta);
        // density of the visible normals over their cosine to `wo`
        let visible = self.rough.density(m) * self.rough.masking(wo) / wo.z;
        let shadowing = self.rough.masking(wi);
        let sum = cos_o + self.eta * cos_i;
        // Walter et al., equation 17
        let jacobian = self.eta * self.eta * -cos_i / (sum * sum);
        let (reflected, bent) = (r * visible / 4.0, (1.0 - r) * visible * cos_o * jacobian);
        let is_bent = (bent > 0.0) & (bent < f32::INFINITY);
        let pick = |a: f32, b: f32| if reflects { a } else { b };
        let pdf = pick(reflected, bent);
        let share = pick(pdf * shadowing, pdf * shadowing / (self.eta * self.eta));
        let color = Vec3::new(
            pick(self.reflect.x, self.transmit.x),
            pick(self.reflect.y, self.transmit.y),
            pick(self.reflect.z, self.transmit.z),
        );
        Scatter { value: color * share, pdf }.only(counts & (reflects | is_bent))
    }

    #[inline(always)]
    pub(super) fn sample(&self, wo: Vec3, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        let (wi, counts) = self.sample_or_not(wo, u, lobe);
        counts.then(|| Sampled::smooth(wi))
    }

    /// The direction, and whether it is one.
    #[inline(always)]
    pub(super) fn sample_or_not(&self, wo: Vec3, u: [f32; 2], lobe: f32) -> (Vec3, bool) {
        let (m, counts) = self.rough.visible_or_not(wo, u);
        let cos = wo.dot(m);
        let (r, cos_t) = fresnel(cos, self.eta);
        let inv = 1.0 / self.eta;
        let (mirrored, bent) = (m * (2.0 * cos) - wo, m * (cos * inv - cos_t) - wo * inv);
        let reflects = lobe < r;
        let pick = |a: f32, b: f32| if reflects { a } else { b };
        let wi = Vec3::new(pick(mirrored.x, bent.x), pick(mirrored.y, bent.y), pick(mirrored.z, bent.z));
        let leaves = (reflects & (wi.z > 0.0)) | (!reflects & (wi.z < 0.0) & (cos_t > 0.0));
        (wi / wi.length(), counts & leaves)
    }
}
