//! Orthonormal frames.

use crate::real::{Vec3, f32};

/// A right-handed orthonormal frame; local z is the normal.
#[derive(Clone, Copy, Debug)]
pub struct Basis {
    /// Local x.
    pub s: Vec3,
    /// Local y.
    pub t: Vec3,
    /// Local z.
    pub n: Vec3,
}

impl Basis {
    /// The frame of a unit normal, with tangents of no meaning (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
    #[inline(always)]
    pub fn new(n: Vec3) -> Basis {
        let sign = f32::copysign(1.0, n.z);
        let a = -1.0 / (sign + n.z);
        let b = n.x * n.y * a;
        Basis {
            s: Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
            t: Vec3::new(b, sign + n.y * n.y * a, -n.y),
            n,
        }
    }

    /// The frame whose local x is the part of `tangent` at right angles to `n`; that of [`Basis::new`] when there is none.
    pub fn with_tangent(n: Vec3, tangent: Vec3) -> Basis {
        let across = |v: Vec3| v - n * n.dot(v);
        let s = across(tangent);
        let length2 = s.length_squared();
        // less than 1e-4 of the tangent is mostly rounding
        if !(length2 > 1e-8 * tangent.length_squared()) || !length2.is_finite() {
            return Basis::new(n);
        }
        // once more: of the first difference only some digits may be left
        let s = across(s / length2.sqrt());
        let s = s / s.length();
        Basis { s, t: n.cross(s), n }
    }

    /// World to local.
    #[inline(always)]
    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.s.dot(v), self.t.dot(v), self.n.dot(v))
    }

    /// Local to world.
    #[inline(always)]
    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.s * v.x + self.t * v.y + self.n * v.z
    }
}
