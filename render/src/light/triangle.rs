//! A triangle that emits evenly from its front.

use super::facing::Facing;
use crate::math::gamma;
use crate::real::{Vec3, f32, narrow, wide};

/// A triangle, sampled uniformly by area.
#[derive(Clone, Copy, Debug)]
pub struct TriangleLight {
    pub(crate) p0: Vec3,
    pub(crate) e1: Vec3,
    pub(crate) e2: Vec3,
    /// Unit normal of the front; its cosine is taken with it.
    pub(crate) normal: Vec3,
    pub(crate) area: f32,
    /// Bound of the error of a sampled point, as a length.
    pub(crate) error: f32,
}

/// Error of a direction: what snapping and normalising turn it by, in radians (the former below 1e-7, the latter below gamma(3)).
const TURN: f32 = 1e-7 + gamma(3);

/// Of a point that is uniform over a triangle for two numbers in [0, 1): barycentric coordinates of the second and third vertex.
#[inline(always)]
pub(super) fn barycentric(u: [f32; 2]) -> [f32; 2] {
    let root = u[0].sqrt();
    [root * (1.0 - u[1]), root * u[1]]
}

/// Least cosine at a light's corner that its weight is made with, and least weight of a corner over the largest: what is seen edge on from one corner may
/// be seen well from between the corners.
const GRAZING: f32 = 1.0 / 32.0;
const SMALLEST: f32 = 1.0 / 8.0;
/// Area over squared distance of a corner, from and up to which nearer and farther make no difference: a corner nearer than a sixteenth of the light's size says little
/// of the rest; and a light so far away looks the same from all corners.
const NEAREST: f32 = 256.0;
const FARTHEST: f32 = 1.0 / (1u64 << 60) as f32;

impl TriangleLight {
    /// From its vertices, counter-clockwise from the front.
    pub fn new(v: [[f32; 3]; 3]) -> TriangleLight {
        let v = v.map(Vec3::from);
        let (e1, e2) = (v[1] - v[0], v[2] - v[0]);
        // in f64: the cross product of a thin triangle cancels
        let n = wide(e1).cross(wide(e2));
        let length = n.length();
        let bound = v[0].abs().max(v[1].abs()).max(v[2].abs());
        TriangleLight {
            p0: v[0],
            e1,
            e2,
            normal: if length > 0.0 { narrow(n / length) } else { Vec3::ZERO },
            area: (0.5 * length) as f32,
            error: bound.length() * gamma(8),
        }
    }

    /// Area.
    pub fn area(&self) -> f32 {
        self.area
    }

    /// Direction from `o`, limit of the shadow ray, density in solid angle.
    #[inline(always)]
    pub(super) fn sample(&self, o: Vec3, u: [f32; 2]) -> Option<(Vec3, f32, f32)> {
        let (d, tmax, pdf, ok) = self.sample_or_not(o, u);
        ok.then_some((d, tmax, pdf))
    }

    /// The same without branches; the last says whether the rest counts.
    #[inline(always)]
    pub(crate) fn sample_or_not(&self, o: Vec3, u: [f32; 2]) -> (Vec3, f32, f32, bool) {
        let [s, t] = barycentric(u);
        let p = self.p0 + self.e1 * s + self.e2 * t;
        let way = p - o;
        let distance2 = way.length_squared();
        let distance = distance2.sqrt();
        let d = way * (1.0 / distance);
        let cos = -d.dot(self.normal);
        let ok = (cos > 0.0) & (distance2 < f32::INFINITY);
        // The ray meets the light's plane nearer than the point by at most (error of the points) / cos + (turn) x distance x tan; the
        // ray test's own error grows with the light's distance and size (see math::offset).
        let origin_error = o.x.abs().max(o.y.abs()).max(o.z.abs()) * gamma(4);
        let slack = (self.error + origin_error + distance * TURN) / cos + distance * gamma(24);
        (d, (distance - slack).max(0.0), distance2 / (cos * self.area), ok)
    }

    /// Two numbers for [`TriangleLight::sample`] that are no longer uniform, but denser where more of the light arrives at a surface; and what a sample of
    /// them counts for, the uniform density over theirs.
    ///
    /// Density is bilinear over the square of the two numbers, in proportion to both cosines over the squared distance at its corners, which are the
    /// triangle's, the first twice (as Hart et al. 2020, "Practical Product Sampling by Fitting and Composing Warps", section 4, do for rectangles).
    #[inline(always)]
    pub(crate) fn warp(&self, o: Vec3, facing: Facing, u: [f32; 2]) -> ([f32; 2], f32) {
        let way = self.p0 - o;
        let corner = |way: Vec3| {
            let distance2 = way.length_squared();
            let distance = distance2.sqrt();
            // limits keep numbers of any size within what f32 holds; of NaN, in the light's plane or at its corner, the limit is taken
            let share = self.area / distance2;
            let share = if share < NEAREST { share } else { NEAREST };
            let share = if share > FARTHEST { share } else { FARTHEST };
            let emitted = -way.dot(self.normal) / distance;
            let arriving = way.dot(facing.normal) / distance;
            let emitted = if emitted > GRAZING { emitted } else { GRAZING };
            let arriving = if arriving > GRAZING { arriving } else { GRAZING };
            emitted * arriving * share
        };
        let (a, b, c) = (corner(way), corner(way + self.e1), corner(way + self.e2));
        let largest = if a > b { a } else { b };
        let largest = if largest > c { largest } else { c };
        let scale = 1.0 / largest;
        let of_largest = |x: f32| if x * scale > SMALLEST { x * scale } else { SMALLEST };
        let (a, b, c) = (of_largest(a), of_largest(b), of_largest(c));
        // the marginal of the second number, then the first one given it
        let y = linear(a + b, a + c, u[1]);
        let far = b + (c - b) * y;
        let x = linear(a, far, u[0]);
        let density = a + (far - a) * x;
        ([x, y], 0.25 * (2.0 * a + b + c) / density)
    }

    /// Density in solid angle of the direction that met the front at distance `t` and cosine `cos`.
    #[inline(always)]
    pub(super) fn pdf(&self, t: f32, cos: f32) -> f32 {
        t * t / (cos * self.area)
    }
}

/// A number in [0, 1) whose density goes linearly from `a` at 0 to `b` at 1, both above 0, by one that is uniform (pbrt-v4, section A.4.1).
#[inline(always)]
fn linear(a: f32, b: f32, u: f32) -> f32 {
    let root = (a * a + (b * b - a * a) * u).sqrt();
    let x = u * (a + b) / (a + root);
    if x < BELOW_1 { x } else { BELOW_1 }
}

/// The largest f32 below 1.
const BELOW_1: f32 = 1.0 - f32::EPSILON / 2.0;
