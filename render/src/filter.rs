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

#[cfg(test)]
mod tests {
    use super::*;

    /// The offsets are the quantiles of the density, which integrates to 1: the integral up to the offset of a number u is u.
    #[test]
    fn offsets_are_quantiles() {
        for filter in
            [Filter::Box, Filter::Tent { radius: 1.0 }, Filter::Tent { radius: 2.5 }, Filter::Gaussian { stddev: 0.5 }]
        {
            let mut integral = 0.0;
            let mut at: f64 = -5.0;
            let step: f64 = 1.0 / 4096.0;
            for i in 0..200u64 {
                let bits = (i * 0x0147_ae14 + 1000) as u32;
                let u = (f64::from(bits) + 0.5) / 4_294_967_296.0;
                let x = filter.offset(bits);
                // midpoints from where the last one ended
                while at < x {
                    let h = step.min(x - at);
                    integral += h * filter.density(at + 0.5 * h);
                    at += h;
                }
                assert!((integral - u).abs() < 2e-4, "{filter:?}: {integral} up to {x}, not {u}");
            }
            while at < 5.0 {
                integral += step * filter.density(at + 0.5 * step);
                at += step;
            }
            assert!((integral - 1.0).abs() < 2e-4, "{filter:?}: {integral}");
        }
    }

    #[test]
    fn quantiles_are_exact() {
        for i in 1..1000 {
            let u = f64::from(i) / 1000.0;
            let x = truncated_normal(u);
            let cdf = |x: f64| 0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2);
            let found = (cdf(x) - cdf(-CUT)) / (cdf(CUT) - cdf(-CUT));
            assert!((found - u).abs() < 1e-12, "{u}: {found}");
        }
        let ends = [Filter::Gaussian { stddev: 1.0 }.offset(0), Filter::Gaussian { stddev: 1.0 }.offset(u32::MAX)];
        assert!(ends[0] >= -4.0 && ends[0] < -3.9 && ends[1] <= 4.0 && ends[1] > 3.9, "{ends:?}");
    }
}
