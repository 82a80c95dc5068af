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
