//! Camera rays by blocks: what [`camera_ray`] does to one sample, in loops that become vector code.

use super::{PathRay, camera_ray, wide};
use crate::filter::Filter;
use crate::frame::Frame;
use crate::math::UnitDir;
use crate::ray::{PathKey, Ray};
use crate::sampler::{Streams, film_numbers};

/// Samples of a block.
const N: usize = 32;

/// Samples by component. Lanes beyond `len` hold what was there before: computed with, never read.
pub(super) struct CameraBlock {
    index: [u32; N],
    keys: [[u32; N]; 2],
    corner: [[f64; N]; 2],
    offset: [[f64; N]; 2],
    dir: [UnitDir; N],
    d: [[f32; 3]; N],
}

/// Appends the camera rays of (pixel, sample) pairs, as [`camera_ray`] makes them, and the same for the kernel. Cheapest where neighbours
/// are samples of one pixel.
pub fn camera_rays(frame: &Frame, samples: &[[u32; 2]], paths: &mut Vec<PathRay>, rays: &mut Vec<Ray>) {
    let mut streams = Streams::new(frame.seed);
    let mut block = CameraBlock {
        index: [0; N],
        keys: [[0; N]; 2],
        corner: [[0.0; N]; 2],
        offset: [[0.0; N]; 2],
        dir: [UnitDir::default(); N],
        d: [[0.0; 3]; N],
    };
    let o = frame.camera.origin;
    let (mut last, mut corner) = (None, [0.0; 2]);
    for part in samples.chunks(N) {
        // a lens is no matter of speed yet
        if part.len() < 4 || !frame.camera.lens.is_pinhole() {
            for &[pixel, sample] in part {
                let path = camera_ray(frame, pixel, sample);
                paths.push(path);
                rays.push(path.ray());
            }
            continue;
        }
        for (i, &[pixel, sample]) in part.iter().enumerate() {
            if last != Some(pixel) {
                last = Some(pixel);
                corner = [pixel % frame.size[0], pixel / frame.size[0]].map(|x| f64::from(x) + 0.5);
            }
            let (index, keys) = streams.film(pixel, sample);
            block.index[i] = index;
            (block.keys[0][i], block.keys[1][i]) = (keys[0], keys[1]);
            (block.corner[0][i], block.corner[1][i]) = (corner[0], corner[1]);
        }
        wide::camera(&mut block, frame);
        for (i, &[pixel, sample]) in part.iter().enumerate() {
            let key = PathKey { pixel, sample, branch: 0, vertex: 0 };
            paths.push(PathRay { o, dir: block.dir[i], key, throughput: [1.0; 3], pdf: 0.0 });
            rays.push(Ray { o, tmin: 0.0, d: block.d[i], tmax: f32::INFINITY });
        }
    }
}

impl CameraBlock {
    /// From keys to directions; inlined into each of its compilations.
    #[inline(always)]
    pub(super) fn phases(&mut self, frame: &Frame) {
        let mut numbers = [[0; N]; 2];
        for i in 0..N {
            let [u, v] = film_numbers(self.index[i], [self.keys[0][i], self.keys[1][i]]);
            (numbers[0][i], numbers[1][i]) = (u, v);
        }
        for axis in 0..2 {
            // the box in a loop of its own, free of the others' calls
            if frame.filter == Filter::Box {
                for i in 0..N {
                    self.offset[axis][i] = Filter::Box.offset(numbers[axis][i]);
                }
            } else {
                for i in 0..N {
                    self.offset[axis][i] = frame.filter.offset(numbers[axis][i]);
                }
            }
        }
        let camera = frame.camera;
        for i in 0..N {
            let x = self.corner[0][i] + self.offset[0][i];
            let y = self.corner[1][i] + self.offset[1][i];
            self.dir[i] = UnitDir::encode(camera.direction(x, y));
        }
        for i in 0..N {
            self.d[i] = self.dir[i].decode();
        }
    }
}
