//! The watertight triangle test, one triangle at a time: what the vector kernels do on eight.
//!
//! Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection" (2013): the vertices are sheared to where the ray is the z
//! axis; it passes inside if the three edge functions at the origin have no two signs. A sheared vertex is a function of
//! ray and vertex, and the sign of an edge function is exact or 0, so two triangles that share an edge can't both
//! refuse a ray that passes between them. A result is a function of ray and vertices alone. These operations are fused,
//! and no others: each x', y' is one subtraction and one fma; an edge function is [`difference_of_products`]; the sum
//! for t has two fma.
//!
//! The bounds on t and the barycentrics are derived in [`super::setup`].

use super::setup::State;
use crate::real::f32;

/// What a ray and a triangle have in common.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Intersection {
    pub t: f32,
    /// Barycentric coordinates of the second and third vertex.
    pub uv: [f32; 2],
}

/// Below this sum of edge functions their products may have lost bits to underflow: 2^-90. An underflow costs up to 2^-148,
/// which is 2^-58 of the sum at worst.
pub(super) const SMALL_AREA: f32 = 1.0 / (1u128 << 90) as f32;

/// Tests a triangle; `v` are its vertices' coordinates in the order of the block's axes.
pub(super) fn intersect(ray: &State, v: &[[f32; 3]; 3]) -> Option<Intersection> {
    let [kx, ky, kz] = ray.axes.map(|k| k as usize);
    let [ox, oy, oz, _] = ray.origin;
    let [sx, sy, sz, _] = ray.shear;
    let [a, b, c] = v.map(|p| {
        let z = p[kz] - oz;
        [(-sx).mul_add(z, p[kx] - ox), (-sy).mul_add(z, p[ky] - oy), z]
    });
    let edge = |p: [f32; 3], q: [f32; 3]| difference_of_products(p[0], q[1], p[1], q[0]);
    let (u, v, w) = (edge(c, b), edge(a, c), edge(b, a));
    if !(min(min(u, v), w) >= 0.0 || max(max(u, v), w) <= 0.0) {
        return None;
    }
    let sum = (u + v) + w;
    let (bu, bv, bw) = if sum.abs() < SMALL_AREA {
        barycentrics_of_small([a[0], a[1]], [b[0], b[1]], [c[0], c[1]])?
    } else {
        let scale = 1.0 / sum;
        (u * scale, v * scale, w * scale)
    };
    let t = bu.mul_add(a[2], bv.mul_add(b[2], bw * c[2])) * sz;
    (ray.tmin < t && t <= ray.tmax).then_some(Intersection { t, uv: [bv, bw] })
}

/// `a b - c d` with a relative error of at most 2u, and with the exact sign or 0.
///
/// Kahan's way, analysed by Jeannerod, Louvet, Muller, "Further analysis of Kahan's algorithm for the accurate computation
/// of 2 x 2 determinants" (2013). The sign holds under underflow too: both fma round monotonically, so the computed
/// fl(ab - w) and fl(w - cd) can add up to more than 0 only if the exact ones do.
fn difference_of_products(a: f32, b: f32, c: f32, d: f32) -> f32 {
    let w = c * d;
    let error = (-c).mul_add(d, w);
    a.mul_add(b, -w) + error
}

/// Barycentrics where f32 products may underflow: in f64, whose products of f32 are exact. `None` when the ray does not
/// pass inside after all, or the triangle is seen exactly from its edge.
#[cold]
pub(super) fn barycentrics_of_small(a: [f32; 2], b: [f32; 2], c: [f32; 2]) -> Option<(f32, f32, f32)> {
    let edge = |p: [f32; 2], q: [f32; 2]| f64::from(p[0]) * f64::from(q[1]) - f64::from(p[1]) * f64::from(q[0]);
    let (u, v, w) = (edge(c, b), edge(a, c), edge(b, a));
    let sum = u + v + w;
    let is_inside = (u >= 0.0 && v >= 0.0 && w >= 0.0) || (u <= 0.0 && v <= 0.0 && w <= 0.0);
    (is_inside && sum != 0.0).then(|| ((u / sum) as f32, (v / sum) as f32, (w / sum) as f32))
}

/// The processor's minimum: the second operand if either is NaN.
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
/// The processor's maximum: the second operand if either is NaN.
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::super::super::testing::Random;
    use super::*;
    use crate::ray::Ray;

    const U: f64 = 1.0 / (1 << 24) as f64;

    /// Barycentrics of the rounded sheared vertices, in f64, where products of f32 are exact.
    fn reference(ray: &State, v: &[[f32; 3]; 3]) -> ([f64; 3], f64) {
        let [kx, ky, kz] = ray.axes.map(|k| k as usize);
        let ([ox, oy, oz, _], [sx, sy, ..]) = (ray.origin, ray.shear);
        let p = v.map(|p| {
            let z = p[kz] - oz;
            [(-sx).mul_add(z, p[kx] - ox), (-sy).mul_add(z, p[ky] - oy)].map(f64::from)
        });
        let edge = |p: [f64; 2], q: [f64; 2]| p[0] * q[1] - p[1] * q[0];
        let e = [edge(p[2], p[1]), edge(p[0], p[2]), edge(p[1], p[0])];
        let sum: f64 = e.iter().sum();
        let b = e.map(|x| x / sum);
        let t =
            (0..3).map(|i| b[i] * (f64::from(v[i][kz]) - f64::from(oz))).sum::<f64>() / f64::from(ray.shear[2]).recip();
        (b, t)
    }

    /// The bounds (2) and (3) of `setup`, for triangles seen from any side, nearly edge-on and as needles along the ray.
    #[test]
    fn distance_and_barycentrics_are_within_their_bounds() {
        let mut random = Random::new(30);
        let (mut hits, mut worst) = (0, 0f64);
        for i in 0..400_000 {
            let o = random.point(1.0);
            let d = random.point(1.0);
            let along = |t: f32, thin: f32, q: [f32; 3]| std::array::from_fn(|c| o[c] + d[c] * t + q[c] * thin);
            let thin = 2f32.powi(-(random.below(26) as i32));
            let flat = random.point(1.0);
            let v: [[f32; 3]; 3] = std::array::from_fn(|_| {
                let (t, q, s) = (random.unit() * 1.5, random.point(1.0), random.signed());
                match i % 3 {
                    // all near the ray: a needle; all near a plane through it: edge-on; anywhere around
                    0 => along(t, thin, q),
                    1 => std::array::from_fn(|c| o[c] + d[c] * t + flat[c] * s + q[c] * thin),
                    _ => along(t, 1.0, q),
                }
            });
            let largest = v.as_flattened().iter().fold(0f32, |m, x| m.max(x.abs()));
            let ray = State::new(&Ray { o, tmin: 0.0, d, tmax: f32::INFINITY }, largest);
            let Some(hit) = intersect(&ray, &v) else { continue };
            hits += 1;
            let (b, t) = reference(&ray, &v);
            for (computed, exact) in [(hit.uv[0], b[1]), (hit.uv[1], b[2])] {
                assert!((f64::from(computed) - exact).abs() <= 8.5 * U * exact.abs(), "{computed} {exact} {v:?}");
            }
            let m = f64::from(o.iter().fold(largest, |m, x| m.max(x.abs())));
            let error = (f64::from(hit.t) - t).abs() / (U * m * f64::from(ray.shear[2].abs()));
            worst = worst.max(error);
            assert!(error <= 28.0, "t is off by {error} u M r: {v:?}");
        }
        assert!(hits > 30_000, "{hits}");
        println!("{hits} hits, t off by {worst:.1} u M r at most");
    }

    /// Scaling by a power of two changes nothing but t, also where products of f32 underflow.
    #[test]
    fn tiny_triangles_are_like_large_ones() {
        let mut random = Random::new(31);
        let mut hits = 0;
        for _ in 0..20_000 {
            let o = random.point(1.0);
            let v: [[f32; 3]; 3] = std::array::from_fn(|_| random.point(1.0));
            let (s, r) = (random.unit(), random.unit());
            let d = std::array::from_fn(|c| {
                v[0][c] + ((v[1][c] - v[0][c]) * s + (v[2][c] - v[0][c]) * (1.0 - s)) * r - o[c]
            });
            let at = |scale: f32| {
                let o = o.map(|x| x * scale);
                let ray = State::new(&Ray { o, tmin: 0.0, d, tmax: f32::INFINITY }, scale);
                intersect(&ray, &v.map(|p| p.map(|x| x * scale)))
            };
            let Some(large) = at(1.0) else { continue };
            hits += 1;
            for exponent in [-30, -45, -60, -80] {
                let scale = 2f32.powi(exponent);
                let small = at(scale).expect("a hit at any scale");
                let near = |a: f32, b: f32| f64::from((a - b).abs()) <= 17.0 * U * f64::from(b.abs());
                assert!(
                    near(small.uv[0], large.uv[0]) && near(small.uv[1], large.uv[1]),
                    "{exponent}: {small:?} {large:?}"
                );
                assert!(
                    f64::from((small.t / scale - large.t).abs()) < 100.0 * U * f64::from(large.t),
                    "{exponent} {small:?} {large:?}"
                );
            }
        }
        assert!(hits > 10_000, "{hits}");
    }

    #[test]
    fn differences_of_products_have_the_exact_sign() {
        let mut random = Random::new(32);
        let mut zeros = 0;
        for i in 0..200_000 {
            let scale = [1.0, 2f32.powi(-60), 2f32.powi(-74), 2f32.powi(30)][i % 4];
            let (a, b) = (random.signed() * scale, random.signed() * scale);
            let c = f32::from_bits(a.to_bits().wrapping_add(random.bits() % 3));
            let d = f32::from_bits(b.to_bits().wrapping_sub(random.bits() % 3));
            let exact = f64::from(a) * f64::from(b) - f64::from(c) * f64::from(d);
            let computed = difference_of_products(a, b, c, d);
            assert!(computed == 0.0 || (computed > 0.0) == (exact > 0.0), "{a:e} {b:e} {c:e} {d:e}");
            assert!(computed != 0.0 || exact.abs() < 2f64.powi(-148), "{a:e} {b:e} {c:e} {d:e}");
            if exact.abs() > 2f64.powi(-100) {
                assert!((f64::from(computed) - exact).abs() <= 2.0 * U * exact.abs());
            }
            zeros += usize::from(exact == 0.0);
        }
        assert!(zeros > 1000, "{zeros}");
    }
}
