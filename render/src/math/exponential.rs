//! Exponential, logarithm and error function in plain f32 operations without branches, so that loops over them become vector code and every
//! machine computes the same bits. In the build with f64 they are libm's.

use crate::real::f32;

/// `e^x` for x <= 0, relative error below 2e-7 where it is above 2^-125; 0 from x = -87 down.
#[cfg(not(feature = "double"))]
#[inline(always)]
pub fn exp_down(x: f32) -> f32 {
    use std::f32::consts::LOG2_E;
    // 1.5 x 2^23: its last place is 1, so the sum's low bits are the nearest integer
    const MAGIC: f32 = 12_582_912.0;
    // ln 2 in two parts, the first short, so that its product with n is exact
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    let within = x > -87.0;
    let x = if within { x } else { 0.0 };
    let shifted = x * LOG2_E + MAGIC;
    let n = shifted - MAGIC;
    let r = (x - n * LN_2[0]) - n * LN_2[1];
    // Taylor to r^7: |r| < 0.35, the rest is below 6e-9
    let tail = 8.333_333e-3 + r * (1.388_888_9e-3 + r * 1.984_127e-4);
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (1.666_666_7e-1 + r * (4.166_666_8e-2 + r * tail))));
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23));
    if within { p * power } else { 0.0 }
}

#[cfg(feature = "double")]
pub fn exp_down(x: f32) -> f32 {
    libm::exp(x)
}

/// `ln x` for normal x > 0, relative error below 3e-7, near 1 too.
#[cfg(not(feature = "double"))]
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    use std::f32::consts::{LN_2, SQRT_2};
    let bits = x.to_bits();
    let m = f32::from_bits((bits & 0x7f_ffff) | 0x3f80_0000);
    let large = m > SQRT_2;
    let m = if large { 0.5 * m } else { m };
    let exponent = (bits >> 23) as i32 - 127 + i32::from(large);
    // 2 artanh s by its series to s^9: |s| < 0.172, the rest is below 1e-9 of it
    let f = m - 1.0;
    let s = f / (2.0 + f);
    let z = s * s;
    let series = 2.0 * s * (1.0 + z * (3.333_333_4e-1 + z * (2.0e-1 + z * (1.428_571_5e-1 + z * 1.111_111_1e-1))));
    exponent as f32 * LN_2 + series
}

#[cfg(feature = "double")]
pub fn ln(x: f32) -> f32 {
    libm::log(x)
}

/// `erf x` for x >= 0, given `e^(-x^2)`: absolute error below 7e-7 (Abramowitz and Stegun, 7.1.26: 1.5e-7; the rest is rounding, of
/// `x^2` most of it).
#[cfg(not(feature = "double"))]
#[inline(always)]
pub fn erf_up(x: f32, e: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x);
    let p = 2.548_296e-1 + t * (-2.844_967_4e-1 + t * (1.421_413_7 + t * (-1.453_152 + t * 1.061_405_4)));
    1.0 - p * t * e
}

#[cfg(feature = "double")]
pub fn erf_up(x: f32, _: f32) -> f32 {
    libm::erf(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_are_what_they_say() {
        let mut worst = [0.0f64; 3];
        for i in 0..2_000_000 {
            let x = i as f32 * (87.5 / 2e6);
            let (e, exact) = (f64::from(exp_down(-x)), libm::exp(-f64::from(x)));
            if x < 86.6 {
                worst[0] = worst[0].max((e / exact - 1.0).abs());
            }
            assert!((0.0..=1.0).contains(&e) && (e - exact).abs() < 1e-7, "e^-{x}: {e} {exact}");
            let y = x * 0.1;
            let found = f64::from(erf_up(y, exp_down(-y * y)));
            worst[1] = worst[1].max((found - libm::erf(f64::from(y))).abs());
            // over the exponents, and about 1
            for z in [f32::from_bits(0x0080_0000 + i * 1060), 1.0 + (i as f32 - 1e6) * 1e-7] {
                let exact = libm::log(f64::from(z));
                worst[2] = worst[2].max((f64::from(ln(z)) - exact).abs() / exact.abs().max(1e-30));
            }
        }
        println!("{worst:?}");
        assert!(worst[0] < 2e-7 && worst[1] < 7e-7 && worst[2] < 3e-7, "{worst:?}");
        assert_eq!([exp_down(0.0), exp_down(-87.5), exp_down(f32::NEG_INFINITY), ln(1.0)], [1.0, 0.0, 0.0, 0.0]);
    }
}
