//! Rough metal: Smith's microfacet model with Beckmann's or the GGX distribution, visible normals sampled.
//!
//! Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"; Heitz 2014, "Understanding the Masking-Shadowing Function";
//! as in Mitsuba, masking and shadowing are independent (separable). Beckmann's masking is the exact one, not a rational fit, so that the
//! density of what is sampled integrates to 1.

use super::beckmann::visible_beckmann;
use super::{Distribution, Scatter};
use crate::math::{erf_up, exp_down, sincos_turn};
use crate::real::consts::PI;
use crate::real::{Vec3, f32};

/// Least roughness; below it use a smooth metal (Mitsuba clamps likewise).
const LEAST: f32 = 1e-4;

/// A distribution of microfacet normals.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rough {
    distribution: Distribution,
    ax: f32,
    ay: f32,
}

/// A pair of directions, but for what the microfacet reflects.
pub(super) struct Lobe {
    /// At the microfacet.
    pub cos: f32,
    pdf: f32,
    value: f32,
    counts: bool,
}

impl Lobe {
    /// Where the microfacet reflects such a share.
    #[inline(always)]
    pub(super) fn reflecting(&self, share: Vec3) -> Scatter {
        Scatter { value: share * self.value, pdf: self.pdf }.only(self.counts)
    }
}

impl Rough {
    #[inline(always)]
    pub(super) fn new(distribution: Distribution, alpha: [f32; 2]) -> Rough {
        Rough { distribution, ax: alpha[0].max(LEAST), ay: alpha[1].max(LEAST) }
    }

    /// What a pair of directions reflects, by Fresnel's reflectance for the cosine at the microfacet.
    #[inline(always)]
    pub(super) fn eval(&self, wo: Vec3, wi: Vec3, fresnel: impl Fn(f32) -> Vec3) -> Scatter {
        let lobe = self.lobe(wo, wi);
        lobe.reflecting(fresnel(lobe.cos))
    }

    // of GGX without branches: blocks of vertices (`path::block`) are compiled from these, and not from what takes a closure, which stays a call
    #[inline(always)]
    pub(super) fn lobe(&self, wo: Vec3, wi: Vec3) -> Lobe {
        let sum = wo + wi;
        let length = sum.length();
        let m = sum / length;
        let cos_m = wo.dot(m);
        let counts = (wo.z > 0.0) & (wi.z > 0.0) & (length > 0.0) & (cos_m > 0.0);
        let go = self.masking(wo);
        // D G1(wo) / (4 cos wo): the Jacobian of the reflection takes the cosine of the visible normals away
        let pdf = self.density(m) * go / (4.0 * wo.z);
        Lobe { cos: cos_m, pdf, value: pdf * self.masking(wi), counts }
    }

    #[inline(always)]
    pub(super) fn sample(&self, wo: Vec3, u: [f32; 2]) -> Option<Vec3> {
        let (wi, counts) = self.sample_or_not(wo, u);
        counts.then_some(wi)
    }

    /// The direction, and whether it is one.
    #[inline(always)]
    pub(super) fn sample_or_not(&self, wo: Vec3, u: [f32; 2]) -> (Vec3, bool) {
        let (m, counts) = self.visible_or_not(wo, u);
        let wi = m * (2.0 * wo.dot(m)) - wo;
        (wi / wi.length(), counts & (wi.z > 0.0))
    }

    /// A microfacet normal of unit length, of density `density(m) masking(wo) (wo . m) / wo.z` in solid angle.
    pub(super) fn visible_normal(&self, wo: Vec3, u: [f32; 2]) -> Option<Vec3> {
        let (m, counts) = self.visible_or_not(wo, u);
        counts.then_some(m)
    }

    /// The normal, and whether it is one.
    #[inline(always)]
    pub(super) fn visible_or_not(&self, wo: Vec3, u: [f32; 2]) -> (Vec3, bool) {
        // to the configuration of roughness 1
        let w = Vec3::new(self.ax * wo.x, self.ay * wo.y, wo.z);
        let w = w / w.length();
        let m = match self.distribution {
            Distribution::Ggx => visible_ggx(w, u),
            Distribution::Beckmann => visible_beckmann(w, u),
        };
        // and back
        let m = Vec3::new(self.ax * m.x, self.ay * m.y, m.z.max(0.0));
        let length = m.length();
        (m / length, (wo.z > 0.0) & (length > 0.0))
    }

    /// D(m).
    #[inline(always)]
    pub(super) fn density(&self, m: Vec3) -> f32 {
        let (x, y) = (m.x / self.ax, m.y / self.ay);
        let slope2 = x * x + y * y;
        let norm = PI * self.ax * self.ay;
        let density = match self.distribution {
            Distribution::Ggx => {
                let t = slope2 + m.z * m.z;
                1.0 / (norm * t * t)
            }
            Distribution::Beckmann => {
                let z2 = m.z * m.z;
                exp_down(-slope2 / z2) / (norm * (z2 * z2))
            }
        };
        if m.z > 0.0 { density } else { 0.0 }
    }

    /// Smith's G1(w) = 1 / (1 + Lambda(w)), for normals on the side of `w`; of `w` below the surface that of its mirror image.
    #[inline(always)]
    pub(super) fn masking(&self, w: Vec3) -> f32 {
        let (x, y) = (self.ax * w.x, self.ay * w.y);
        let tan2 = (x * x + y * y) / (w.z * w.z);
        let masking = match self.distribution {
            Distribution::Ggx => 2.0 / (1.0 + (1.0 + tan2).sqrt()),
            Distribution::Beckmann => {
                let a = 1.0 / tan2.sqrt();
                let e = exp_down(-a * a);
                // Lambda is below 1e-9 from a = 4 on
                if a < 4.0 { 2.0 / (1.0 + erf_up(a, e) + e / (a * PI.sqrt())) } else { 1.0 }
            }
        };
        if tan2 > 0.0 { masking } else { 1.0 }
    }
}

/// Visible normal of GGX of roughness 1 (Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps").
#[inline(always)]
fn visible_ggx(w: Vec3, u: [f32; 2]) -> Vec3 {
    let (s, c) = sincos_turn(u[1]);
    let z = (1.0 - u[0]) * (1.0 + w.z) - w.z;
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(r * c, r * s, z) + w
}
