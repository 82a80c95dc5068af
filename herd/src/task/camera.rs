//! Camera rays of the units that a task was given.

use rayherd_render::film::TILE;
use rayherd_render::frame::Frame;
use rayherd_render::path::{PathRay, camera_rays};
use rayherd_render::ray::{PathKey, Ray};
use rayherd_render::skip::{Skip, Skips};

use crate::wave::CameraUnit;

/// Makes camera rays one after the other: tile by tile, pixel by pixel, the samples of a pixel together.
pub struct CameraFeed<'a> {
    frame: &'a Frame,
    units: std::vec::IntoIter<CameraUnit>,
    current: Option<(CameraUnit, Cursor)>,
    /// How often each sample's ray is made: more than once where siblings have one each.
    copies: u32,
    /// Samples whose rays were made so far.
    pub made: u64,
    /// Pixel and sample of those to be made together.
    samples: Vec<[u32; 2]>,
    rays: Vec<Ray>,
}

#[derive(Clone, Copy)]
struct Cursor {
    x: u32,
    y: u32,
    sample: u32,
}

impl<'a> CameraFeed<'a> {
    /// Rays of the units, in their order.
    pub fn new(frame: &'a Frame, units: Vec<CameraUnit>, skips: Skips) -> Self {
        let copies = if skips.makes(Skip::Merged) { 1 } else { frame.split.max(1) };
        let units = units.into_iter();
        CameraFeed { frame, units, current: None, copies, made: 0, samples: Vec::new(), rays: Vec::new() }
    }

    /// Appends rays until `out` has `len` of them (or the siblings of one sample more) or there are none left.
    pub fn fill(&mut self, out: &mut Vec<PathRay>, len: usize) {
        let mut rays = std::mem::take(&mut self.rays);
        rays.clear();
        self.fill_traced(out, &mut rays, len);
        self.rays = rays;
    }

    /// The same, and appends what the kernel takes for each to `rays`.
    pub fn fill_traced(&mut self, out: &mut Vec<PathRay>, rays: &mut Vec<Ray>, len: usize) {
        let wanted = len.saturating_sub(out.len()).div_ceil(self.copies as usize);
        self.samples.clear();
        self.take(wanted);
        self.made += self.samples.len() as u64;
        let first = out.len();
        camera_rays(self.frame, &self.samples, out, rays);
        if self.copies > 1 {
            let (paths, traced) = (out.split_off(first), rays.split_off(rays.len() - self.samples.len()));
            for (path, ray) in paths.into_iter().zip(traced) {
                let sibling = |branch: u32| PathRay { key: PathKey { branch: branch as u16, ..path.key }, ..path };
                out.extend((0..self.copies).map(sibling));
                rays.extend((0..self.copies).map(|_| ray));
            }
        }
    }

    /// Gathers up to `wanted` samples.
    fn take(&mut self, wanted: usize) {
        let width = self.frame.size[0];
        while self.samples.len() < wanted {
            let Some((unit, mut at)) = self.current.take().or_else(|| self.next_unit()) else { return };
            let [(x0, x1), (_, y1)] = tile(self.frame, unit.tile);
            while self.samples.len() < wanted {
                self.samples.push([at.y * width + at.x, at.sample]);
                at.sample += 1;
                if at.sample == unit.end {
                    (at.sample, at.x) = (unit.first, at.x + 1);
                    if at.x == x1 {
                        (at.x, at.y) = (x0, at.y + 1);
                    }
                }
                if at.y == y1 {
                    break;
                }
            }
            if at.y < y1 {
                self.current = Some((unit, at));
            }
        }
    }

    fn next_unit(&mut self) -> Option<(CameraUnit, Cursor)> {
        let unit = self.units.find(|u| u.first < u.end)?;
        let [(x, _), (y, _)] = tile(self.frame, unit.tile);
        Some((unit, Cursor { x, y, sample: unit.first }))
    }
}

/// Ranges of x and y of a film tile.
fn tile(frame: &Frame, tile: u32) -> [(u32, u32); 2] {
    let across = frame.size[0].div_ceil(TILE);
    let range = |i: u32, end: u32| (i * TILE, ((i + 1) * TILE).min(end));
    [range(tile % across, frame.size[0]), range(tile / across, frame.size[1])]
}

/// Number of film tiles of a frame.
pub fn tiles(frame: &Frame) -> u32 {
    frame.size[0].div_ceil(TILE) * frame.size[1].div_ceil(TILE)
}

/// Pixels of a film tile.
pub fn tile_pixels(frame: &Frame, number: u32) -> u32 {
    let [(x0, x1), (y0, y1)] = tile(frame, number);
    (x1 - x0) * (y1 - y0)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use rayherd_render::aov::Aovs;
    use rayherd_render::camera::Camera;
    use rayherd_render::filter::Filter;

    use super::*;

    #[test]
    fn every_sample_of_every_pixel_is_made_once_whatever_the_batch() {
        let size = [70, 33];
        let camera =
            Camera::new(&[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], 40.0, size, [0.0; 3]);
        let frame = Frame {
            camera: camera.unwrap(),
            size,
            filter: Filter::Box,
            seed: 1,
            max_depth: 3,
            rr_depth: 5,
            split: 1,
            hide_emitters: false,
            aovs: Aovs::NONE,
        };
        let units: Vec<CameraUnit> = (0..tiles(&frame)).map(|tile| CameraUnit { tile, first: 2, end: 5 }).collect();
        assert_eq!(units.len(), 6);
        let pixels: u32 = (0..6).map(|t| tile_pixels(&frame, t)).sum();
        assert_eq!(pixels, 70 * 33);
        for len in [1, 7, 4096, 100_000] {
            let mut feed = CameraFeed::new(&frame, units.clone(), Skips::ALL);
            let mut keys = BTreeSet::new();
            let mut out = Vec::new();
            loop {
                out.clear();
                feed.fill(&mut out, len);
                if out.is_empty() {
                    break;
                }
                assert!(out.len() <= len);
                out.iter().for_each(|r| assert!(keys.insert((r.key.pixel, r.key.sample))));
            }
            assert_eq!((keys.len(), feed.made), (70 * 33 * 3, 70 * 33 * 3));
            assert!(keys.iter().all(|k| (2..5).contains(&k.1)));
        }
    }
}
