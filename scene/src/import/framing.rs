//! Camera and light for what has none: bare meshes, volumes, and XML scenes without a sensor.
//!
//! With `c` the centre and `r` half the diagonal of the bounds, and right, up and back as seen from the camera:
//!
//! - up is +y for PLY, OBJ and XML, +z for STL and volumes (where +z is the patient's head, and the camera stands in front);
//! - the camera looks at `c` from the direction (0.5 right, 0.35 up, 1 back) of the front, from where the corners of the bounds just
//!   lie in the middle 90 % of a field of view of 40 degrees along the image's shorter side;
//! - two square lights of side `r` face `c` from 2.5 `r` away: the key of radiance 20 from (-1 right, 0.9 up, 0.35 back), the
//!   fill of radiance 3 from (1 right, 0.3 up, 0.5 back) of the camera; neither is in its view;
//! - the sky has radiance 0.1.
//!
//! The paper lights its scans by two area lights as well; it does not say where they are.

use super::options::Light;
use super::vector::{add_scaled, dot, look_at, normalize};
use crate::description::Camera;

/// Radiance of the sky.
pub(super) const SKY: [f32; 3] = [0.1; 3];
/// Size of the image of a mesh or volume (the paper's).
pub(super) const SIZE: [u32; 2] = [1024, 1024];
/// Half the field of view along the shorter side, degrees.
const HALF_FOV: f64 = 20.0;
/// Share of the field of view that the bounds fill.
const FILL: f64 = 0.9;

/// Which axis points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Up {
    /// +y; the front is +z.
    Y,
    /// +z; the front is -y.
    Z,
}

/// Camera and lights for a box.
pub(super) struct Frame {
    pub camera: Camera,
    pub lights: [Light; 2],
}

/// The rule of this module. None if the box has no extent.
pub(super) fn frame(bounds: [[f64; 3]; 2], up: Up, size: [u32; 2]) -> Option<Frame> {
    let center = [0, 1, 2].map(|k| bounds[0][k] / 2.0 + bounds[1][k] / 2.0);
    let half = [0, 1, 2].map(|k| bounds[1][k] / 2.0 - bounds[0][k] / 2.0);
    let radius = (half[0] * half[0] + half[1] * half[1] + half[2] * half[2]).sqrt();
    if !(radius > 0.0 && radius.is_finite()) {
        return None;
    }
    let (up, from) = match up {
        Up::Y => ([0.0, 1.0, 0.0], [0.5, 0.35, 1.0]),
        Up::Z => ([0.0, 0.0, 1.0], [0.5, -1.0, 0.35]),
    };
    let from = normalize(from)?;
    let tan = libm::tan(HALF_FOV.to_radians());
    let aspect = f64::from(size[0]) / f64::from(size[1]);
    let tan = [tan * aspect.max(1.0), tan / aspect.min(1.0)];
    let turned = look_at(add_scaled(center, radius, from), center, up)?;
    let column = |c: usize| [0, 1, 2].map(|r| turned.0[r][c]);
    let distance = (0..8).map(|corner| {
        let d = [0, 1, 2].map(|k| if corner >> k & 1 == 1 { half[k] } else { -half[k] });
        let aside = f64::max(dot(d, column(0)).abs() / tan[0], dot(d, column(1)).abs() / tan[1]);
        aside / FILL - dot(d, column(2))
    });
    let origin = add_scaled(center, distance.fold(0.0, f64::max), from);
    let to_world = look_at(origin, center, up)?;
    let fov_x = 2.0 * libm::atan(tan[0]).to_degrees();

    let light = |[right, up, back]: [f64; 3], radiance: f32| {
        // camera space has +x to the left and +z forward
        let towards = normalize(to_world.vector([-right, up, -back]))?;
        let origin = add_scaled(center, 2.5 * radius, towards);
        Some(Light { origin, target: center, size: [radius; 2], radiance: [radiance; 3] })
    };
    let lights = [light([-1.0, 0.9, 0.35], 20.0)?, light([1.0, 0.3, 0.5], 3.0)?];
    Some(Frame { camera: Camera::perspective(to_world, fov_x), lights })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Projection;
    use crate::import::vector::sub;

    #[test]
    fn the_box_is_in_view_and_the_lights_are_not() {
        for up in [Up::Y, Up::Z] {
            for (size, bounds) in [
                ([100, 100], [[-3.0, 10.0, 2.0], [5.0, 11.0, 7.0]]),
                ([160, 90], [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
                ([90, 160], [[-1.0, -9.0, -1.0], [1.0, 9.0, 1.0]]),
                ([160, 90], [[-9.0, -1.0, -1.0], [9.0, 1.0, 1.0]]),
                ([90, 160], [[-1.0, -1.0, -9.0], [1.0, 1.0, 9.0]]),
                ([160, 90], [[0.0, 0.0, 0.0], [9.0, 9.0, 0.0]]),
            ] {
                let Frame { camera, lights } = frame(bounds, up, size).unwrap();
                let column = |c: usize| [0, 1, 2].map(|r| camera.to_world.0[r][c]);
                let Projection::Perspective { fov_x } = camera.projection else { panic!("no pinhole") };
                let tan_x = libm::tan(fov_x.to_radians() / 2.0);
                let tan_y = tan_x * f64::from(size[1]) / f64::from(size[0]);
                // how far from the middle of the view, 1 at its border
                let aside = |p: [f64; 3]| {
                    let d = sub(p, column(3));
                    let z = dot(d, column(2));
                    let share = f64::max(dot(d, column(0)).abs() / tan_x, dot(d, column(1)).abs() / tan_y) / z;
                    if z > 0.0 { share } else { f64::INFINITY }
                };
                let corner = |c: usize| [0, 1, 2].map(|k| bounds[c >> k & 1][k]);
                let farthest = (0..8).map(|c| aside(corner(c))).fold(0.0, f64::max);
                assert!((farthest - FILL).abs() < 1e-9, "{farthest}");
                for light in lights {
                    let shape = light.shape("light".into(), 0).unwrap();
                    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, 0.0)] {
                        assert!(aside(shape.to_world.point([x, y, 0.0])) > 1.0, "{up:?} {size:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_point_cannot_be_framed() {
        assert!(frame([[1.0; 3], [1.0; 3]], Up::Y, SIZE).is_none());
        assert!(frame([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], Up::Y, SIZE).is_none());
    }
}
