//! Pixel filters, by sampling: a sample is moved from its pixel's centre by an offset distributed as the filter, and weighs 1. So
//! a sample belongs to one pixel, and no picture depends on how the film is cut.

use serde::{Deserialize, Serialize};

use crate::math::unit;

/// Pixel reconstruction filter; sampled, so that a sample belongs to one pixel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Filter {
    /// Box of the pixel.
    Box,
    /// Tent of the radius, pixels.
    Tent {
        /// Half width.
        radius: f64,
    },
    /// Gaussian, cut at four standard deviations.
    Gaussian {
        /// Standard deviation, pixels.
        stddev: f64,
    },
}

impl Filter {
    /// Offset from the pixel's centre, in pixels, along one axis: the inverse of the filter's distribution function.
    #[inline]
    pub fn offset(&self, bits: u32) -> f64 {
        match *self {
            Filter::Box => f64::from(unit(bits)) - 0.5,
            Filter::Tent { radius } => {
                let u = open_unit(bits);
                radius * if u < 0.5 { (2.0 * u).sqrt() - 1.0 } else { 1.0 - (2.0 * (1.0 - u)).sqrt() }
            }
            Filter::Gaussian { stddev } => stddev * truncated_normal(open_unit(bits)),
        }
    }

    /// The filter's value at an offset along one axis, integrating to 1.
    pub fn density(&self, offset: f64) -> f64 {
        match *self {
            Filter::Box => f64::from(u8::from((-0.5..0.5).contains(&offset))),
            Filter::Tent { radius } => (1.0 - (offset / radius).abs()).max(0.0) / radius,
            Filter::Gaussian { stddev } => {
                let x = offset / stddev;
                if x.abs() > CUT {
                    0.0
                } else {
                    libm::exp(-0.5 * x * x) / (stddev * (2.0 * std::f64::consts::PI).sqrt() * inside())
                }
            }
        }
    }
}

/// Where the Gaussian ends, in standard deviations.
const CUT: f64 = 4.0;

/// Share of the normal distribution within the cut.
fn inside() -> f64 {
    libm::erf(CUT * std::f64::consts::FRAC_1_SQRT_2)
}

/// (bits + 1/2) / 2^32, in (0, 1).
fn open_unit(bits: u32) -> f64 {
    (f64::from(bits) + 0.5) * (1.0 / 4_294_967_296.0)
}

/// Inverse of the distribution function of the normal distribution cut at [`CUT`].
fn truncated_normal(u: f64) -> f64 {
    // of the whole normal distribution: the upper tail that corresponds to u
    let tail = 0.5 * libm::erfc(CUT * std::f64::consts::FRAC_1_SQRT_2);
    normal_quantile(tail + u * inside())
}

/// Quantile of the normal distribution for p in [1e-5, 1 - 1e-5]: an approximation of absolute error 4.5e-4 (Abramowitz and Stegun
/// 26.2.23), then two Newton steps on the distribution function; what remains is below 1e-12.
fn normal_quantile(p: f64) -> f64 {
    let q = p.min(1.0 - p);
    let t = (-2.0 * libm::log(q)).sqrt();
    let mut x =
        t - (2.515_517 + t * (0.802_853 + t * 0.010_328)) / (1.0 + t * (1.432_788 + t * (0.189_269 + t * 0.001_308)));
    for _ in 0..2 {
        // upper tail beyond x against q
        let error = 0.5 * libm::erfc(x * std::f64::consts::FRAC_1_SQRT_2) - q;
        x += error * (2.0 * std::f64::consts::PI).sqrt() * libm::exp(0.5 * x * x);
    }
    if p < 0.5 { -x } else { x }
}
