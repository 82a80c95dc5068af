//! Sine and cosine of fractions of a turn, the disk map that needs them, and the angle of a vector: own polynomials, plain f32 operations.

use crate::real::consts::{FRAC_PI_2, FRAC_PI_4};
use crate::real::f32;

/// `(sin x, cos x)` for `|x| <= pi / 4`: Taylor polynomials to x^9 and x^8, remainders 4e-9 and 3e-8 times the first
/// missing term at the end; with rounding below 1.2e-7.
#[cfg(not(feature = "double"))]
#[inline(always)]
fn sincos_small(x: f32) -> (f32, f32) {
    let z = x * x;
    let s = x + x * z * (-1.666_666_7e-1 + z * (8.333_333e-3 + z * (-1.984_127e-4 + z * 2.755_732e-6)));
    let c = 1.0 + z * (-0.5 + z * (4.166_666_8e-2 + z * (-1.388_888_9e-3 + z * 2.480_158_7e-5)));
    (s, c)
}

/// The same, with all digits of f64.
#[cfg(feature = "double")]
fn sincos_small(x: f32) -> (f32, f32) {
    libm::sincos(x)
}

/// `(sin 2 pi u, cos 2 pi u)` for u in [0, 1], absolute error below 2e-7.
#[inline(always)]
pub fn sincos_turn(u: f32) -> (f32, f32) {
    let q = (u * 4.0 + 0.5) as i32;
    let (s, c) = sincos_small((u - q as f32 * 0.25) * (4.0 * FRAC_PI_2));
    // by quarters (s, c), (c, -s), (-s, -c), (-c, s): selects, no branches
    let (a, b) = if q & 1 == 0 { (s, c) } else { (c, s) };
    (if q & 2 == 0 { a } else { -a }, if (q + 1) & 2 == 0 { b } else { -b })
}

/// The angle of (x, y) in (-pi, pi], absolute error below 4e-7; a zero has its sign, as in C. Without branches.
#[cfg(not(feature = "double"))]
#[inline(always)]
pub fn atan2(y: f32, x: f32) -> f32 {
    use crate::real::consts::PI;
    const TAN_EIGHTH: f32 = 0.414_213_57;
    let (a, b) = (y.abs(), x.abs());
    let (low, high) = if a > b { (b, a) } else { (a, b) };
    // from an eighth of a turn down to a sixteenth
    let far = low > TAN_EIGHTH * high;
    let (up, down) = if far { (low - high, low + high) } else { (low, high) };
    let t = up / if down == 0.0 { 1.0 } else { down };
    let z = t * t;
    // of Cephes' atanf (Moshier 1992): 2e-8 of it to tan(pi / 8)
    let series = -3.333_295e-1 + z * (1.997_771_1e-1 + z * (-1.387_768_6e-1 + z * 8.053_744_5e-2));
    let r = t + t * z * series + if far { FRAC_PI_4 } else { 0.0 };
    let r = if a > b { FRAC_PI_2 - r } else { r };
    let r = if x.is_sign_negative() { PI - r } else { r };
    r.copysign(y)
}

#[cfg(feature = "double")]
pub use libm::atan2;

/// The unit square onto the unit disk, keeping areas and strata (Shirley and Chiu 1997).
#[inline(always)]
pub fn concentric_disk(u: [f32; 2]) -> [f32; 2] {
    let (x, y) = (2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0);
    let wide = x.abs() > y.abs();
    let (r, q) = if wide { (x, y) } else { (y, x) };
    // the centre: 0 / 1 for 0 / 0
    let (s, c) = sincos_small(FRAC_PI_4 * (q / if r == 0.0 { 1.0 } else { r }));
    let (along, across) = (r * c, r * s);
    if wide { [along, across] } else { [across, along] }
}
