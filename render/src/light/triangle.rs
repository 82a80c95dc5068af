//! A triangle that emits evenly from its front.

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

    /// Density in solid angle of the direction that met the front at distance `t` and cosine `cos`.
    #[inline(always)]
    pub(super) fn pdf(&self, t: f32, cos: f32) -> f32 {
        t * t / (cos * self.area)
    }
}
