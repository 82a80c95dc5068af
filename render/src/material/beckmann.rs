//! Visible normals of Beckmann's distribution: slopes along the projection of the view by inversion of their distribution function, across it
//! normally distributed (Heitz and d'Eon 2014, "Importance Sampling Microfacet-Based BSDFs using the Distribution of Visible Normals"; the
//! parametrisation by erf is Jakob's, 2014, "An Improved Visible Normal Sampling Routine for the Beckmann Distribution"). No branches: loops over it
//! become vector code.

use crate::math::{erf_up, exp_down, ln};
use crate::real::consts::PI;
use crate::real::{Vec3, f32};

/// Largest value of erf that is inverted: 1 - 2^-24.
const MOST: f32 = 0.999_999_94;

/// Visible normal of roughness 1 along the unit direction `w` with z above 0, not of unit length, by two numbers in [0, 1).
#[inline(always)]
pub(super) fn visible_beckmann(w: Vec3, u: [f32; 2]) -> Vec3 {
    let sin2 = w.x * w.x + w.y * w.y;
    let across = erf_inverse(2.0 * u[1] - 1.0);
    let sin = sin2.sqrt();
    // straight from above every slope is visible alike
    let tilted = sin > 1e-4 * w.z;
    let (s, cot) = if tilted { (sin, w.z / sin) } else { (1.0, 1.0) };
    let (visible, any) = (visible_slope(cot, u[0]), erf_inverse(2.0 * u[0] - 1.0));
    let along = if tilted { visible } else { any };
    // rotate from the frame in which w lies in the xz plane
    let (cos_phi, sin_phi) = if tilted { (w.x / s, w.y / s) } else { (1.0, 0.0) };
    Vec3::new(-(cos_phi * along - sin_phi * across), -(sin_phi * along + cos_phi * across), 1.0)
}

/// Slope along the view: P(slope < x) is proportional to the integral to x of (cot - s) exp(-s^2), s < cot, so it is H(x) / H(cot) with
/// H(x) = 1 + erf x + exp(-x^2) / (cot sqrt pi). By b = erf x its derivative is 1 - x / cot, and Newton's steps in b meet no tails: after three
/// the distribution function is met within 2e-6, after four within 3e-7, which is rounding, for views from straight above to 1e-4 above the horizon.
#[inline(always)]
fn visible_slope(cot: f32, u: f32) -> f32 {
    let (tan, norm) = (1.0 / cot, 1.0 / PI.sqrt());
    let e = exp_down(-cot * cot);
    let upper = erf_up(cot, e);
    let most = if upper < MOST { upper } else { MOST };
    // u has 24 bits
    let u = if u > 5e-8 { u } else { 5e-8 };
    let target = u * (1.0 + upper + norm * tan * e);
    // -ln u is the square of what erf takes there (Jakob)
    let v = -ln(u);
    let mut b = upper - (upper + 1.0) * erf_up(v.sqrt(), u);
    // written out: a loop in a loop would not become vector code
    b = step(b, most, norm * tan, tan, target);
    b = step(b, most, norm * tan, tan, target);
    b = step(b, most, norm * tan, tan, target);
    b = step(b, most, norm * tan, tan, target);
    erf_inverse(if b < most { b } else { most })
}

/// One of Newton's steps.
#[inline(always)]
fn step(b: f32, most: f32, factor: f32, tan: f32, target: f32) -> f32 {
    let b = if b < most { b } else { most };
    let b = if b > -MOST { b } else { -MOST };
    let x = erf_inverse(b);
    let value = 1.0 + b + factor * exp_down(-x * x) - target;
    let slope = 1.0 - x * tan;
    b - value / if slope > 1e-6 { slope } else { 1e-6 }
}

/// The inverse of erf, of what is in [-1, 1] (Giles 2012, "Approximating the erfinv function", single precision).
#[inline(always)]
fn erf_inverse(x: f32) -> f32 {
    let x = x.clamp(-MOST, MOST);
    let w = -ln((1.0 - x) * (1.0 + x));
    let (c, t) = (w - 2.5, w.max(0.0).sqrt() - 3.0);
    let p = 2.810_226_4e-8;
    let p = p * c + 3.432_739_4e-7;
    let p = p * c - 3.523_387_7e-6;
    let p = p * c - 4.391_506_5e-6;
    let p = p * c + 2.185_808_7e-4;
    let p = p * c - 1.253_725e-3;
    let p = p * c - 4.177_681_6e-3;
    let p = p * c + 2.466_407_3e-1;
    let p = p * c + 1.501_409_4;
    let q = -2.002_142_6e-4;
    let q = q * t + 1.009_505_6e-4;
    let q = q * t + 1.349_343_2e-3;
    let q = q * t - 3.673_428_4e-3;
    let q = q * t + 5.739_507_7e-3;
    let q = q * t - 7.622_461_3e-3;
    let q = q * t + 9.438_870_5e-3;
    let q = q * t + 1.001_674;
    let q = q * t + 2.832_976_8;
    x * if w < 5.0 { p } else { q }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The distribution function at what a number gives is that number: to rounding, from any view, in the tails too.
    #[test]
    fn slopes_follow_their_distribution_function() {
        let h = |x: f64, cot: f64| cot * libm::erfc(-x) + libm::exp(-x * x) / std::f64::consts::PI.sqrt();
        let numbers = (0..4000).map(|i| (i as f32 + 0.5) / 4000.0);
        let tails = (3..23).flat_map(|k| [0.5f32.powi(k), 1.0 - 0.5f32.powi(k)]);
        let numbers: Vec<f32> = numbers.chain(tails).chain([0.0, 1.0 - f32::EPSILON / 2.0]).collect();
        for k in -16..=16 {
            let cot = 10f32.powf(k as f32 * 0.25);
            let mut worst = 0.0f64;
            for &u in &numbers {
                let x = f64::from(visible_slope(cot, u));
                assert!(x.abs() < 6.0 && x <= f64::from(cot) + 1e-5, "{cot} {u}: {x}");
                let cot = f64::from(cot);
                worst = worst.max((h(x, cot) / h(cot, cot) - f64::from(u)).abs());
            }
            assert!(worst < 5e-7, "{cot}: {worst:e}");
        }
    }
}
