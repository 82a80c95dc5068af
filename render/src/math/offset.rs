//! Error bounds of computed points, and origins of rays that leave a surface without meeting it again.

use crate::real::{SIGN, Signed, Vec3, f32};

/// Bound of the relative error of `n` successive roundings: n u / (1 - n u), u = 2^-24 (Higham 2002, lemma 3.1).
#[inline(always)]
pub const fn gamma(n: u32) -> f32 {
    let nu = n as f32 * (0.5 * f32::EPSILON);
    nu / (1.0 - nu)
}

/// A computed point of a surface, with what is known about its error.
#[derive(Clone, Copy, Debug)]
pub struct Position {
    /// The point.
    pub p: Vec3,
    /// Bound of its absolute error, by component.
    pub error: Vec3,
    /// Bound of the error, along a ray that starts here, with which the ray test sees the surface itself.
    pub test: f32,
}

impl Position {
    /// The point `p0 + u e1 + v e2` of a triangle.
    ///
    /// Error of the point: an edge is rounded once, the product again, their sum and the last sum once each, so
    /// gamma(4) of the edges' share and gamma(1) of p0's; one more each for the second-order terms. That the
    /// barycentrics are rounded moves the point in the plane only.
    ///
    /// Error of the test: the watertight test (Woop et al. 2013) interpolates t from the vertices' depths z_i, measured from the
    /// origin, as sum(e_i z_i) / det. Vertices are translated (1 rounding) and sheared (2), edge functions are
    /// differences of products (3 more), the sums and the quotient 4: below gamma(10) of max |z_i| times (sum |e_i|) / det,
    /// and the latter exceeds 1 only outside the triangle. |z_i| of a triangle that contains the origin is at most
    /// its longest edge times sqrt(3) (the largest component of a unit vector is at least 1 / sqrt(3)). So gamma(18) of the longest edge.
    #[inline(always)]
    pub fn on_triangle(p0: Vec3, e1: Vec3, e2: Vec3, u: f32, v: f32) -> Position {
        let (a, b) = (e1 * u, e2 * v);
        let longest = |e: Vec3| e.x.abs().max(e.y.abs()).max(e.z.abs());
        let extent = longest(e1).max(longest(e2));
        Position {
            p: p0 + (a + b),
            error: (a.abs() + b.abs()) * gamma(5) + p0.abs() * gamma(2),
            test: 2.0 * extent * gamma(18),
        }
    }

    /// The point `center + radius n` of a sphere; `n` is of unit length to within gamma(4).
    ///
    /// The test computes t from b^2 - c with products of the size of the distance to the centre squared; for an origin on
    /// the sphere that is r^2, and its error along the normal is gamma(12) r or less.
    #[inline(always)]
    pub fn on_sphere(center: Vec3, radius: f32, n: Vec3) -> Position {
        let q = n * radius;
        let p = center + q;
        Position {
            p,
            error: q.abs() * gamma(6) + p.abs() * gamma(1),
            test: radius * gamma(12) + center.abs().max_element() * gamma(2),
        }
    }
}

/// Origin of rays that leave `at` on the side of the unit normal `n`: moved along `n` until the error box of the point and the
/// error of the ray test are behind it (pbrt-v4, section 6.8), then each component rounded away from the surface.
#[inline(always)]
pub fn offset_origin(at: &Position, n: Vec3) -> Vec3 {
    let distance = n.abs().dot(at.error) + at.test;
    let away = |p: f32, n: f32| {
        let o = p + n * distance;
        // one ulp up for a positive n, down for a negative one: by the bits, in the direction of o's own sign or against it. At 0 the
        // step would be to the other sign's NaNs: a component of exactly 0 stays.
        let bits = o.to_bits();
        let step = 1 - ((n.to_bits() ^ bits) >> SIGN << 1) as Signed;
        let moved = f32::from_bits(bits.wrapping_add_signed(step));
        if (o == 0.0) | (n == 0.0) { o } else { moved }
    };
    Vec3::new(away(at.p.x, n.x), away(at.p.y, n.y), away(at.p.z, n.z))
}
