//! The little vector algebra that importing needs, in f64.

use crate::description::Affine;

/// Inner product.
pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Cross product.
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Difference.
pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Unit vector along `a`; none for a vector without direction.
pub(crate) fn normalize(a: [f64; 3]) -> Option<[f64; 3]> {
    let length = dot(a, a).sqrt();
    (length > 0.0 && length.is_finite()).then(|| a.map(|x| x / length))
}

/// Mitsuba's camera frame: looks along +z from `origin` to `target`, +y towards `up`, +x to the left.
pub(crate) fn look_at(origin: [f64; 3], target: [f64; 3], up: [f64; 3]) -> Option<Affine> {
    let forward = normalize(sub(target, origin))?;
    let left = normalize(cross(up, forward))?;
    let up = cross(forward, left);
    Some(Affine([0, 1, 2].map(|r| [left[r], up[r], forward[r], origin[r]])))
}

/// Transposed cofactors of the linear part: maps normals up to length and, for mirroring maps, sign.
pub(crate) fn cofactors(map: &Affine) -> [[f64; 3]; 3] {
    let [a, b, c] = map.0.map(|r| [r[0], r[1], r[2]]);
    [cross(b, c), cross(c, a), cross(a, b)]
}

/// `a + s b`.
pub(crate) fn add_scaled(a: [f64; 3], s: f64, b: [f64; 3]) -> [f64; 3] {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}
