//! The modified Phong model: a diffuse part, and a lobe cos^n about the mirror's direction (Lafortune and Willems 1994, "Using the Modified Phong
//! Reflectance Model for Physically Based Rendering"). Mitsuba 0.5's `phong`.

use super::{Sampled, Scatter, diffuse};
use crate::math::{Basis, sincos_turn};
use crate::real::consts::{FRAC_1_PI, PI};
use crate::real::{Vec3, expm1, f32, log, pow};

/// The model at a point.
pub(super) struct Phong {
    diffuse: Vec3,
    specular: Vec3,
    exponent: f32,
    /// Of the lobe.
    probability: f32,
}

impl Phong {
    /// Where both factors together exceed 1 in a channel both are scaled down, as in Mitsuba 0.5.
    pub(super) fn new(diffuse: [f32; 3], specular: [f32; 3], exponent: f32) -> Phong {
        let (diffuse, specular) = (Vec3::from(diffuse), Vec3::from(specular));
        let most = (diffuse + specular).max_element();
        let scale = if most > 1.0 { 1.0 / most } else { 1.0 };
        let sum = |v: Vec3| v.x + v.y + v.z;
        let (d, s) = (sum(diffuse), sum(specular));
        let probability = if d + s > 0.0 { s / (d + s) } else { 0.0 };
        Phong { diffuse: diffuse * scale, specular: specular * scale, exponent, probability }
    }

    pub(super) fn eval(&self, wo: Vec3, wi: Vec3) -> Scatter {
        if !(wo.z > 0.0 && wi.z > 0.0) {
            return Scatter::NONE;
        }
        let cos = Vec3::new(-wo.x, -wo.y, wo.z).dot(wi);
        let power = if cos > 0.0 { pow(cos.min(1.0), self.exponent) } else { 0.0 };
        let lobe = power * (0.5 / PI);
        let value = (self.diffuse * FRAC_1_PI + self.specular * (lobe * (self.exponent + 2.0))) * wi.z;
        let pdf = self.probability * lobe * (self.exponent + 1.0) + (1.0 - self.probability) * wi.z * FRAC_1_PI;
        Scatter { value, pdf }
    }

    pub(super) fn sample(&self, wo: Vec3, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        if lobe >= self.probability {
            return diffuse::sample(wo, u).map(Sampled::smooth);
        }
        if !(wo.z > 0.0) {
            return None;
        }
        // cos = u^(1 / (n + 1)), and its sine without cancellation
        let sin2 = -expm1(2.0 * log(1.0 - u[0]) / (self.exponent + 1.0));
        let (s, c) = sincos_turn(u[1]);
        let sin = sin2.clamp(0.0, 1.0).sqrt();
        let about = Basis::new(Vec3::new(-wo.x, -wo.y, wo.z));
        let wi = about.to_world(Vec3::new(sin * c, sin * s, (1.0 - sin2).max(0.0).sqrt()));
        (wi.z > 0.0).then(|| Sampled::smooth(wi / wi.length()))
    }
}
