//! A perspective pinhole camera with Mitsuba's conventions.

use serde::{Deserialize, Serialize};

/// A pinhole camera, ready to make rays: a point (x, y) of the film in pixels, from the upper left corner, is seen along
/// `corner + x right + y down`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// The pinhole, in recentred coordinates.
    pub origin: [f32; 3],
    /// Direction of the film's upper left corner, not of unit length.
    pub corner: [f64; 3],
    /// What one pixel to the right adds.
    pub right: [f64; 3],
    /// What one pixel down adds.
    pub down: [f64; 3],
}

/// Why a camera cannot be built.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// The field of view is out of range.
    #[error("field of view {0} degrees is out of range: give more than 0 and less than 180")]
    FieldOfView(f64),
    /// The transform does not span space.
    #[error("the camera's transform is singular or not finite")]
    Singular,
}

impl Camera {
    /// From the rows of the camera-to-world matrix (looking along +z, +y up, +x to the left of the picture), the full field of view
    /// along x in degrees, the film's size in pixels and the point of the world that is the origin of recentred coordinates.
    pub fn new(to_world: &[[f64; 4]; 3], fov_x: f64, size: [u32; 2], center: [f64; 3]) -> Result<Camera, CameraError> {
        if !(fov_x > 0.0 && fov_x < 180.0) {
            return Err(CameraError::FieldOfView(fov_x));
        }
        let column = |c: usize| [to_world[0][c], to_world[1][c], to_world[2][c]];
        let [x, y, z] = [column(0), column(1), column(2)];
        let determinant = x[0] * (y[1] * z[2] - y[2] * z[1]) - y[0] * (x[1] * z[2] - x[2] * z[1])
            + z[0] * (x[1] * y[2] - x[2] * y[1]);
        let origin: [f32; 3] = std::array::from_fn(|i| (to_world[i][3] - center[i]) as f32);
        if determinant == 0.0 || !determinant.is_finite() || origin.iter().any(|o| !o.is_finite()) {
            return Err(CameraError::Singular);
        }
        let [width, height] = size.map(f64::from);
        let half_x = libm::tan(fov_x.to_radians() * 0.5);
        let half_y = half_x * height / width;
        Ok(Camera {
            origin,
            corner: std::array::from_fn(|i| z[i] + x[i] * half_x + y[i] * half_y),
            right: std::array::from_fn(|i| -x[i] * (2.0 * half_x / width)),
            down: std::array::from_fn(|i| -y[i] * (2.0 * half_y / height)),
        })
    }

    /// Unit direction through the point (x, y) of the film, in pixels from its upper left corner.
    #[inline(always)]
    pub fn direction(&self, x: f64, y: f64) -> [f32; 3] {
        // written out: closures over arrays become calls
        let along = |i: usize| self.corner[i] + x * self.right[i] + y * self.down[i];
        let d = [along(0), along(1), along(2)];
        let scale = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        [(d[0] * scale) as f32, (d[1] * scale) as f32, (d[2] * scale) as f32]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at (5, 6, 7) that looks along +z: +x of the world is at the left of the picture, +y at the top.
    #[test]
    fn orientation_is_mitsubas() {
        let rows = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0]];
        let camera = Camera::new(&rows, 90.0, [200, 100], [1.0, 2.0, 3.0]).unwrap();
        assert_eq!(camera.origin, [4.0; 3]);
        let close = |d: [f32; 3], e: [f64; 3]| {
            let l = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]).sqrt();
            assert!((0..3).all(|i| (f64::from(d[i]) - e[i] / l).abs() < 1e-7), "{d:?} {e:?}");
        };
        close(camera.direction(100.0, 50.0), [0.0, 0.0, 1.0]);
        // the field of view is along x; y has half of it
        close(camera.direction(0.0, 50.0), [1.0, 0.0, 1.0]);
        close(camera.direction(200.0, 50.0), [-1.0, 0.0, 1.0]);
        close(camera.direction(100.0, 0.0), [0.0, 0.5, 1.0]);
        close(camera.direction(0.0, 100.0), [1.0, -0.5, 1.0]);
    }

    /// Far from the origin the camera keeps its place to f32 of the recentred coordinates.
    #[test]
    fn recentring_is_exact() {
        let rows = [[1.0, 0.0, 0.0, 4_000_000.25], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let camera = Camera::new(&rows, 45.0, [1, 1], [4_000_000.0, 0.0, 0.0]).unwrap();
        assert_eq!(camera.origin, [0.25, 0.0, 0.0]);
    }

    #[test]
    fn bad_cameras_are_refused() {
        let good = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        for fov in [0.0, 180.0, -1.0, f64::NAN] {
            assert!(matches!(Camera::new(&good, fov, [1, 1], [0.0; 3]), Err(CameraError::FieldOfView(_))));
        }
        for bad in [0.0, f64::NAN, f64::INFINITY] {
            let mut rows = good;
            rows[1][1] = bad;
            assert!(matches!(Camera::new(&rows, 45.0, [1, 1], [0.0; 3]), Err(CameraError::Singular)));
        }
    }
}
