//! What a source, or several together, can do: where they are, where they shine, how much. In f64, made once when a scene is opened.

use std::f64::consts::{FRAC_PI_2, PI};

use glam::DVec3;

use super::{Geometry, Source};
use crate::math::luminance;
use crate::real::{Vec3, wide};
use crate::world::Beam;

/// Bounds of sources.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    /// Lower corner of their box.
    pub lo: DVec3,
    /// Upper corner.
    pub hi: DVec3,
    /// Unit vector along the middle of the cone of their normals.
    pub axis: DVec3,
    /// Half angle of that cone; pi for all directions.
    pub normals: f64,
    /// Angle from a normal beyond which it is dark.
    pub emission: f64,
    /// Sum of what each gives off in the direction where it gives most: luminance per steradian.
    pub intensity: f64,
}

impl Bounds {
    /// Of one source; `None` of one that is infinitely far away.
    pub(super) fn new(source: &Source) -> Option<Bounds> {
        let radiance = f64::from(luminance(source.emission));
        let around = |center: Vec3, radius: f64, intensity: f64| Bounds {
            lo: wide(center) - radius,
            hi: wide(center) + radius,
            axis: DVec3::Z,
            normals: PI,
            emission: FRAC_PI_2,
            intensity,
        };
        match &source.geometry {
            Geometry::Triangle(t) => {
                let p = wide(t.p0);
                let (a, b) = (p + wide(t.e1), p + wide(t.e2));
                Some(Bounds {
                    lo: p.min(a).min(b),
                    hi: p.max(a).max(b),
                    axis: wide(t.normal),
                    normals: 0.0,
                    emission: FRAC_PI_2,
                    intensity: radiance * f64::from(t.area()),
                })
            }
            // from all around its disk is seen
            Geometry::Sphere(s) => {
                let radius = f64::from(s.radius());
                Some(around(s.center(), radius, radiance * PI * radius * radius))
            }
            Geometry::Beam(Beam::Point { position, intensity }) => {
                Some(around(Vec3::from(*position), 0.0, f64::from(luminance(Vec3::from(*intensity)))))
            }
            Geometry::Beam(Beam::Spot { position, axis, intensity, beam, cutoff, .. }) => Some(Bounds {
                axis: wide(Vec3::from(*axis)),
                normals: f64::from(*beam),
                emission: f64::from(*cutoff) - f64::from(*beam),
                ..around(Vec3::from(*position), 0.0, f64::from(luminance(Vec3::from(*intensity))))
            }),
            Geometry::Beam(Beam::Directional { .. }) | Geometry::Sky => None,
        }
    }

    /// Of both.
    pub(super) fn union(&self, other: &Bounds) -> Bounds {
        let (axis, normals) = union((self.axis, self.normals), (other.axis, other.normals));
        Bounds {
            lo: self.lo.min(other.lo),
            hi: self.hi.max(other.hi),
            axis,
            normals,
            emission: self.emission.max(other.emission),
            intensity: self.intensity + other.intensity,
        }
    }

    /// Middle of the box.
    pub(super) fn center(&self) -> DVec3 {
        0.5 * (self.lo + self.hi)
    }

    /// Half the diagonal.
    pub(super) fn radius(&self) -> f64 {
        0.5 * (self.hi - self.lo).length()
    }

    /// What sampling these sources as one costs: intensity x squared diagonal x measure of the directions that they shine in (Conty Estevez
    /// and Kulla 2018, section 4.4).
    pub(super) fn cost(&self) -> f64 {
        let normals = self.normals;
        let reach = (normals + self.emission).min(PI);
        let (sin, cos) = (libm::sin(normals), libm::cos(normals));
        let beyond = 2.0 * reach * sin - libm::cos(normals - 2.0 * reach) - 2.0 * normals * sin + cos;
        let measure = 2.0 * PI * (1.0 - cos) + FRAC_PI_2 * beyond;
        self.intensity * measure * (self.hi - self.lo).length_squared()
    }
}

/// The least cone that holds two cones (section 4.2 of the same), each an axis and a half angle.
fn union(a: (DVec3, f64), b: (DVec3, f64)) -> (DVec3, f64) {
    let (wide, narrow) = if a.1 >= b.1 { (a, b) } else { (b, a) };
    // which most are
    if wide.1 >= PI || wide.0 == narrow.0 {
        return wide;
    }
    // by the chord, which keeps small angles exact
    let between = 2.0 * libm::asin((0.5 * (wide.0 - narrow.0).length()).min(1.0));
    if (between + narrow.1).min(PI) <= wide.1 {
        return wide;
    }
    let angle = 0.5 * (wide.1 + between + narrow.1);
    let turned = narrow.0 - wide.0 * wide.0.dot(narrow.0);
    let length = turned.length();
    // opposite axes, or cones that are nearly everything
    if angle >= PI || !(length > 1e-9) {
        return (wide.0, PI);
    }
    let turn = angle - wide.1;
    let axis = wide.0 * libm::cos(turn) + turned * (libm::sin(turn) / length);
    (axis.normalize(), angle)
}
