//! The exact sphere test, in f64.
//!
//! With l = o - c and the foot q = l - (l.d / d.d) d of the perpendicular from the centre to the ray, the ray is inside where
//! |t - t_c| <= h, t_c = -l.d / d.d, h^2 = (r^2 - q.q) / d.d. Taking the discriminant from the foot avoids the cancellation of
//! l.l - r^2 for far origins (Haines, Guenther, Akenine-Moller, "Precision Improvements for Ray/Sphere Intersection",
//! Ray Tracing Gems 2019).
//!
//! *Error.* Inputs are f32, so exact. Let e = 2^-53, u = 2^-24, M = max(|o|_inf, largest coordinate of the forest), so that |l| <=
//! 2 sqrt(3) M and r <= M for a ray that comes near. q is off by at most 12 e |l| < 42 e M, so r^2 - q.q by less than 2 r 42 e M + 4 e r^2
//! < 100 e M^2, and its root by less than 10 sqrt(e) M < 1.8 u M (reached where the ray grazes; elsewhere by far less). So
//! the hit lies within 1.8 u M of the sphere, and after rounding t to f32, |t - T| |d| <= 1.8 u M + 2 sqrt(3) u M < 6 u M: less than
//! what [`super::setup`] allows for triangles, so boxes around spheres are conservative too.

use crate::ray::Ray;
use crate::real::f32;

/// Nearest `t` with `tmin < t <= tmax` at which the ray meets the sphere, from inside or outside.
#[inline(always)]
pub(super) fn intersect(ray: &Ray, tmin: f32, tmax: f32, center: [f32; 3], radius: f32) -> Option<f32> {
    let d = ray.d.map(f64::from);
    let l: [f64; 3] = std::array::from_fn(|k| f64::from(ray.o[k]) - f64::from(center[k]));
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let dd = dot(d, d);
    let middle = -dot(l, d) / dd;
    let foot: [f64; 3] = std::array::from_fn(|k| l[k] + middle * d[k]);
    let r = f64::from(radius);
    let inside = r * r - dot(foot, foot);
    if inside < 0.0 {
        return None;
    }
    let half = (inside / dd).sqrt();
    [middle - half, middle + half].into_iter().map(|t| t as f32).find(|&t| tmin < t && t <= tmax)
}
