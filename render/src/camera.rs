//! Cameras with Mitsuba's conventions: pinhole, thin lens, parallel projection.

use serde::{Deserialize, Serialize};

use crate::math::{concentric_disk, unit};
use crate::real::f32;

/// A camera, ready to make rays: a point (x, y) of the film in pixels, from the upper left corner, stands for `corner + x right + y down`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// The pinhole or the lens's centre, in recentred coordinates; the film's centre of a parallel projection.
    pub origin: [f32; 3],
    /// Of the film's upper left corner: a direction, not of unit length; of a parallel projection the way there from `origin`.
    pub corner: [f64; 3],
    /// What one pixel to the right adds.
    pub right: [f64; 3],
    /// What one pixel down adds.
    pub down: [f64; 3],
    /// Where a point's rays come from.
    #[serde(default, skip_serializing_if = "Lens::is_pinhole")]
    pub lens: Lens,
}

/// Where the rays to a point of the film come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Lens {
    /// From one point.
    #[default]
    Pinhole,
    /// From a disk; they meet where the pinhole's ray has gone `focus` times its direction.
    Thin {
        /// From the centre to the disk's edge along the camera's x.
        x: [f64; 3],
        /// The same along its y.
        y: [f64; 3],
        /// Distance of what is sharp, along the camera's z.
        focus: f64,
    },
    /// From the film itself, all along this unit direction.
    Parallel {
        /// The camera's z.
        direction: [f32; 3],
    },
}

impl Lens {
    /// Whether it is the plain one.
    pub fn is_pinhole(&self) -> bool {
        *self == Lens::Pinhole
    }
}

/// What a camera is built from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Rows of the camera-to-world matrix: it looks along +z, +y is up, +x is to the left of the picture.
    pub to_world: [[f64; 4]; 3],
    /// What lies between the scene and the film.
    pub projection: Projection,
    /// The film's size in pixels and the part of it that is the picture: x, y, width, height. All of the picture's size if `None`.
    pub crop: Option<([u32; 2], [u32; 4])>,
}

/// What lies between the scene and the film. Angles are full fields of view along x of the whole film, in degrees, in (0, 180).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Projection {
    /// A pinhole.
    Perspective {
        /// Field of view.
        fov_x: f64,
    },
    /// A lens.
    ThinLens {
        /// Field of view.
        fov_x: f64,
        /// Radius of the lens, at least 0.
        aperture: f64,
        /// Distance along z of what is sharp, above 0.
        focus: f64,
    },
    /// Parallel: the film is 2 units of the camera's wide.
    Orthographic,
}

/// Why a camera cannot be built.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// The field of view is out of range.
    #[error("field of view {0} degrees is out of range: give more than 0 and less than 180")]
    FieldOfView(f64),
    /// The lens is out of range.
    #[error("a lens of radius {0} that is sharp at distance {1}: give a radius of at least 0 and a distance above 0")]
    Lens(f64, f64),
    /// The part of the film is empty or not inside.
    #[error("the part of the film that is the picture is empty or reaches beyond it")]
    Crop,
    /// The transform does not span space.
    #[error("the camera's transform is singular or not finite")]
    Singular,
}

impl Camera {
    /// A pinhole camera from the rows of the camera-to-world matrix, the full field of view along x in degrees, the film's size in pixels and
    /// the point of the world that is the origin of recentred coordinates.
    pub fn new(to_world: &[[f64; 4]; 3], fov_x: f64, size: [u32; 2], center: [f64; 3]) -> Result<Camera, CameraError> {
        let view = View { to_world: *to_world, projection: Projection::Perspective { fov_x }, crop: None };
        Camera::of(&view, size, center)
    }

    /// Any camera, for a picture of `size` pixels; `center` is the point of the world that is the origin of recentred coordinates.
    pub fn of(view: &View, size: [u32; 2], center: [f64; 3]) -> Result<Camera, CameraError> {
        let to_world = &view.to_world;
        let column = |c: usize| [to_world[0][c], to_world[1][c], to_world[2][c]];
        let [x, y, z] = [column(0), column(1), column(2)];
        let determinant = x[0] * (y[1] * z[2] - y[2] * z[1]) - y[0] * (x[1] * z[2] - x[2] * z[1])
            + z[0] * (x[1] * y[2] - x[2] * y[1]);
        let origin: [f32; 3] = std::array::from_fn(|i| (to_world[i][3] - center[i]) as f32);
        if determinant == 0.0 || !determinant.is_finite() || origin.iter().any(|o| !o.is_finite()) {
            return Err(CameraError::Singular);
        }
        let tangent = |fov_x: f64| {
            if fov_x > 0.0 && fov_x < 180.0 {
                Ok(libm::tan(fov_x.to_radians() * 0.5))
            } else {
                Err(CameraError::FieldOfView(fov_x))
            }
        };
        let (half_x, lens) = match view.projection {
            Projection::Perspective { fov_x } => (tangent(fov_x)?, Lens::Pinhole),
            Projection::ThinLens { fov_x, aperture, focus } => {
                if !(aperture >= 0.0 && aperture.is_finite() && focus > 0.0 && focus.is_finite()) {
                    return Err(CameraError::Lens(aperture, focus));
                }
                let edge = |axis: [f64; 3]| axis.map(|c| c * aperture);
                let thin = Lens::Thin { x: edge(x), y: edge(y), focus };
                (tangent(fov_x)?, if aperture > 0.0 { thin } else { Lens::Pinhole })
            }
            Projection::Orthographic => {
                let length = (z[0] * z[0] + z[1] * z[1] + z[2] * z[2]).sqrt();
                (1.0, Lens::Parallel { direction: z.map(|c| (c / length) as f32) })
            }
        };
        // of a parallel projection the film lies at the origin, else one unit before it
        let ahead = if matches!(lens, Lens::Parallel { .. }) { 0.0 } else { 1.0 };
        let [width, height] = size.map(f64::from);
        let Some((film, [left, top, columns, rows])) = view.crop else {
            let half_y = half_x * height / width;
            return Ok(Camera {
                origin,
                corner: std::array::from_fn(|i| z[i] * ahead + x[i] * half_x + y[i] * half_y),
                right: std::array::from_fn(|i| -x[i] * (2.0 * half_x / width)),
                down: std::array::from_fn(|i| -y[i] * (2.0 * half_y / height)),
                lens,
            });
        };
        let within =
            |at: u32, length: u32, film: u32| length > 0 && u64::from(at) + u64::from(length) <= u64::from(film);
        if !(within(left, columns, film[0]) && within(top, rows, film[1])) {
            return Err(CameraError::Crop);
        }
        let [film_x, film_y, left, top] = [film[0], film[1], left, top].map(f64::from);
        let half_y = half_x * film_y / film_x;
        // a pixel of the film, then how much of it a pixel of the picture is: 1 unless another size was asked for
        let (across, along) = (2.0 * half_x / film_x, 2.0 * half_y / film_y);
        Ok(Camera {
            origin,
            corner: std::array::from_fn(|i| {
                z[i] * ahead + x[i] * (half_x - left * across) + y[i] * (half_y - top * along)
            }),
            right: std::array::from_fn(|i| -x[i] * (across * f64::from(columns) / width)),
            down: std::array::from_fn(|i| -y[i] * (along * f64::from(rows) / height)),
            lens,
        })
    }

    /// Unit direction through the point (x, y) of the film, in pixels from its upper left corner, of a pinhole.
    #[inline(always)]
    pub fn direction(&self, x: f64, y: f64) -> [f32; 3] {
        // written out: closures over arrays become calls
        let along = |i: usize| self.corner[i] + x * self.right[i] + y * self.down[i];
        normalized([along(0), along(1), along(2)])
    }

    /// Origin and unit direction of a ray through the point (x, y) of the film; `lens` are random bits that choose where it passes the lens, asked
    /// for if that matters.
    #[inline]
    pub fn ray(&self, x: f64, y: f64, lens: impl FnOnce() -> [u32; 2]) -> ([f32; 3], [f32; 3]) {
        let origin = self.origin.map(f64::from);
        let along = |i: usize| self.corner[i] + x * self.right[i] + y * self.down[i];
        match &self.lens {
            Lens::Pinhole => (self.origin, self.direction(x, y)),
            Lens::Thin { x: lens_x, y: lens_y, focus } => {
                let [a, b] = concentric_disk(lens().map(unit)).map(f64::from);
                let moved: [f64; 3] = std::array::from_fn(|i| lens_x[i] * a + lens_y[i] * b);
                let from: [f32; 3] = std::array::from_fn(|i| (origin[i] + moved[i]) as f32);
                (from, normalized(std::array::from_fn(|i| along(i) * focus - moved[i])))
            }
            Lens::Parallel { direction } => (std::array::from_fn(|i| (origin[i] + along(i)) as f32), *direction),
        }
    }
}

#[inline(always)]
fn normalized(d: [f64; 3]) -> [f32; 3] {
    let scale = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    [(d[0] * scale) as f32, (d[1] * scale) as f32, (d[2] * scale) as f32]
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

    const LOOKS_ALONG_Z: [[f64; 4]; 3] = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0]];

    fn view(projection: Projection) -> View {
        View { to_world: LOOKS_ALONG_Z, projection, crop: None }
    }

    /// Rays through a lens start on its disk and meet in the plane of focus where the pinhole's ray passes it; a lens of radius 0 is a pinhole.
    #[test]
    fn a_thin_lens_is_sharp_at_its_focus() {
        let (size, fov_x) = ([200, 100], 90.0);
        let pinhole = Camera::of(&view(Projection::Perspective { fov_x }), size, [0.0; 3]).unwrap();
        let lens = |aperture| Camera::of(&view(Projection::ThinLens { fov_x, aperture, focus: 4.0 }), size, [0.0; 3]);
        assert_eq!(lens(0.0).unwrap(), pinhole);
        let camera = lens(0.5).unwrap();
        let (mut furthest, mut mean) = (0.0f64, [0.0; 2]);
        for i in 0..1000u32 {
            let bits = [i.wrapping_mul(0x9e37_79b9), i.wrapping_mul(0x85eb_ca6b)];
            let (o, d) = camera.ray(30.0, 80.0, || bits);
            let at = [o[0] - 5.0, o[1] - 6.0].map(f64::from);
            assert_eq!(o[2], 7.0);
            furthest = furthest.max(at[0].hypot(at[1]));
            mean = [mean[0] + at[0] / 1000.0, mean[1] + at[1] / 1000.0];
            let sharp = pinhole.direction(30.0, 80.0);
            for axis in 0..2 {
                let here = o[axis] + d[axis] / d[2] * 4.0;
                let there = pinhole.origin[axis] + sharp[axis] / sharp[2] * 4.0;
                assert!((here - there).abs() < 1e-5, "{here} {there}");
            }
        }
        assert!(furthest <= 0.5 + 1e-6 && furthest > 0.48 && mean[0].hypot(mean[1]) < 0.03, "{furthest} {mean:?}");
    }

    /// A parallel projection: 2 units wide before the map, its rays start on the film, +x is left and +y up.
    #[test]
    fn a_parallel_projection() {
        let mut view = view(Projection::Orthographic);
        for row in &mut view.to_world {
            (row[0], row[1], row[2]) = (row[0] * 3.0, row[1] * 3.0, row[2] * 3.0);
        }
        let camera = Camera::of(&view, [200, 100], [1.0, 0.0, 0.0]).unwrap();
        let ray = |x, y| camera.ray(x, y, || panic!("no lens"));
        assert_eq!(ray(100.0, 50.0), ([4.0, 6.0, 7.0], [0.0, 0.0, 1.0]));
        assert_eq!(ray(0.0, 0.0), ([7.0, 7.5, 7.0], [0.0, 0.0, 1.0]));
        assert_eq!(ray(200.0, 100.0), ([1.0, 4.5, 7.0], [0.0, 0.0, 1.0]));
    }

    /// A part of the film sees what the whole film sees there; another size of it the same, finer.
    #[test]
    fn a_crop_is_a_part_of_the_film() {
        for projection in [Projection::Perspective { fov_x: 60.0 }, Projection::Orthographic] {
            let whole = Camera::of(&view(projection), [200, 100], [0.0; 3]).unwrap();
            let crop = View { crop: Some(([200, 100], [30, 20, 50, 60])), ..view(projection) };
            let part = Camera::of(&crop, [50, 60], [0.0; 3]).unwrap();
            let finer = Camera::of(&crop, [100, 240], [0.0; 3]).unwrap();
            for (x, y) in [(0.0, 0.0), (50.0, 0.0), (7.25, 59.5)] {
                let expected = whole.ray(30.0 + x, 20.0 + y, || [0; 2]);
                for found in [part.ray(x, y, || [0; 2]), finer.ray(2.0 * x, 4.0 * y, || [0; 2])] {
                    let close = |a: [f32; 3], b: [f32; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-6);
                    assert!(close(found.0, expected.0) && close(found.1, expected.1), "{found:?} {expected:?}");
                }
            }
            for bad in [[151, 0, 50, 10], [0, 0, 0, 10], [0, 41, 10, 60], [u32::MAX, 0, 2, 2]] {
                let bad = View { crop: Some(([200, 100], bad)), ..view(projection) };
                assert_eq!(Camera::of(&bad, [10, 10], [0.0; 3]), Err(CameraError::Crop));
            }
        }
    }

    #[test]
    fn bad_lenses_are_refused() {
        for (aperture, focus) in [(-1.0, 1.0), (f64::NAN, 1.0), (1.0, 0.0), (1.0, f64::INFINITY)] {
            let bad = Camera::of(&view(Projection::ThinLens { fov_x: 40.0, aperture, focus }), [1, 1], [0.0; 3]);
            assert!(matches!(bad, Err(CameraError::Lens(..))));
        }
    }

    /// A frame with a plain camera is written as it was before there were lenses, so that what was rendered can go on.
    #[test]
    fn a_pinhole_is_written_without_a_lens() {
        let camera = Camera::new(&LOOKS_ALONG_Z, 45.0, [1, 1], [0.0; 3]).unwrap();
        let text = serde_json::to_string(&camera).unwrap();
        assert!(!text.contains("lens"), "{text}");
        assert_eq!(serde_json::from_str::<Camera>(&text).unwrap(), camera);
        let lens = Camera::of(&view(Projection::Orthographic), [1, 1], [0.0; 3]).unwrap();
        assert_eq!(serde_json::from_str::<Camera>(&serde_json::to_string(&lens).unwrap()).unwrap(), lens);
    }
}
