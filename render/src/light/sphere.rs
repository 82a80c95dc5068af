//! A sphere that emits evenly from one side, and the uniform sphere of directions.

use crate::math::{Basis, gamma, sincos_turn};
use crate::real::consts::PI;
use crate::real::{Vec3, f32};

/// Density of [`uniform`].
pub(super) const UNIFORM_PDF: f32 = 1.0 / (4.0 * PI);

/// A direction, uniform over the sphere.
#[inline(always)]
pub(super) fn uniform(u: [f32; 2]) -> Vec3 {
    let z = 1.0 - 2.0 * u[0];
    let r = (4.0 * u[0] * (1.0 - u[0])).max(0.0).sqrt();
    let (s, c) = sincos_turn(u[1]);
    Vec3::new(r * c, r * s, z)
}

/// An exact sphere. From outside the cone of directions that see it is sampled uniformly (pbrt-v4, section 6.2.4); from inside, a flipped one
/// is sampled by area. Who sees its back gets nothing.
#[derive(Clone, Copy, Debug)]
pub struct SphereLight {
    center: Vec3,
    radius: f32,
    flipped: bool,
}

impl SphereLight {
    /// Emits to the outside, or flipped to the inside.
    pub fn new(center: [f32; 3], radius: f32, flipped: bool) -> SphereLight {
        SphereLight { center: center.into(), radius, flipped }
    }

    /// Centre.
    #[inline(always)]
    pub(crate) fn center(&self) -> Vec3 {
        self.center
    }

    /// Radius.
    #[inline(always)]
    pub(crate) fn radius(&self) -> f32 {
        self.radius
    }

    /// Whether it emits to the inside.
    pub(super) fn is_flipped(&self) -> bool {
        self.flipped
    }

    /// Area.
    pub fn area(&self) -> f32 {
        4.0 * PI * self.radius * self.radius
    }

    /// `1 - cos` of the half angle of the cone from a point at squared distance `d2 > radius^2`.
    #[inline(always)]
    fn cone(&self, d2: f32) -> f32 {
        let sin2 = self.radius * self.radius / d2;
        sin2 / (1.0 + (1.0 - sin2).max(0.0).sqrt())
    }

    /// Direction from `o`, limit of the shadow ray, density in solid angle.
    pub(super) fn sample(&self, o: Vec3, u: [f32; 2]) -> Option<(Vec3, f32, f32)> {
        let to_center = self.center - o;
        let d2 = to_center.length_squared();
        let r2 = self.radius * self.radius;
        let outside = d2 > r2;
        if outside == self.flipped {
            return None;
        }
        if outside {
            return Some(self.sample_outside(o, u));
        }
        let n = uniform(u);
        let way = to_center + n * self.radius;
        let t2 = way.length_squared();
        let t = t2.sqrt();
        let d = way / t;
        let cos = n.dot(d);
        if !(cos > 0.0) {
            return None;
        }
        let slack = (self.errors(o) + t * 2e-7) / cos + t * gamma(24);
        Some((d, (t - slack).max(0.0), t2 / (cos * self.area())))
    }

    /// [`SphereLight::sample`] from a point outside: always a direction, without branches.
    #[inline(always)]
    pub(crate) fn sample_outside(&self, o: Vec3, u: [f32; 2]) -> (Vec3, f32, f32) {
        let to_center = self.center - o;
        let d2 = to_center.length_squared();
        let r2 = self.radius * self.radius;
        let distance = d2.sqrt();
        let cone = self.cone(d2);
        let below = u[0] * cone; // 1 - cos of the angle to the axis
        let cos = 1.0 - below;
        let sin2 = below * (2.0 - below);
        let (s, c) = sincos_turn(u[1]);
        let sin = sin2.max(0.0).sqrt();
        let axis = to_center / distance;
        let d = Basis::new(axis).to_world(Vec3::new(sin * c, sin * s, cos));
        // half the chord; at the rim the root is of a number that is all rounding, of size gamma(8) r^2
        let half2 = (r2 - d2 * sin2).max(0.0);
        let uncertain = (half2 + r2 * gamma(16) + distance * self.radius * 4e-7).sqrt();
        let t = distance * cos - uncertain;
        let slack = self.errors(o) + distance * gamma(24);
        (d, (t - slack).max(0.0), 1.0 / (2.0 * PI * cone))
    }

    /// Whether a point sees the side that emits, from outside.
    #[inline(always)]
    pub(crate) fn is_lit_outside(&self, o: Vec3) -> bool {
        !self.flipped & ((self.center - o).length_squared() > self.radius * self.radius)
    }

    /// Of positions, along a ray.
    #[inline(always)]
    fn errors(&self, o: Vec3) -> f32 {
        self.center.abs().max(o.abs()).max_element() * gamma(16)
    }

    /// Outward unit normal where a direction from `o`, which [`SphereLight::sample`] gave, meets it first on the side that emits.
    pub(super) fn normal(&self, o: Vec3, d: Vec3) -> Vec3 {
        let to_center = self.center - o;
        let along = to_center.dot(d);
        let aside = (to_center - d * along).length_squared();
        let half = (self.radius * self.radius - aside).max(0.0).sqrt();
        let t = if self.flipped { along + half } else { along - half };
        let n = d * t - to_center;
        n / n.length()
    }

    /// Density in solid angle, from `o`, of the direction that met the front at distance `t` and cosine `cos`.
    #[inline]
    pub(super) fn pdf(&self, o: Vec3, t: f32, cos: f32) -> f32 {
        let d2 = (self.center - o).length_squared();
        let outside = d2 > self.radius * self.radius;
        if outside == self.flipped {
            0.0
        } else if outside {
            1.0 / (2.0 * PI * self.cone(d2))
        } else {
            t * t / (cos * self.area())
        }
    }
}
