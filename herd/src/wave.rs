//! Which samples come next: a fixed schedule that every run shares, so that a longer run begins with the shorter one.
//!
//! Waves end at 1, 4, 16, 64, .. samples per pixel (anything learned would use only complete waves before its own). A
//! wave is cut into at most three *steps* of about a third, the grain at which a target error is checked and a time
//! limit stops the run. The last step is cut at the samples asked for; nothing in the image depends on where.

use std::ops::Range;

use rayherd_render::film::Samples;
use serde::{Deserialize, Serialize};

/// Most samples per pixel: the sampler repeats after them, and the film's sums are sized for them.
pub const MAX_SPP: u32 = 1 << 24;

/// Samples of one film tile, the grain of camera work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct CameraUnit {
    /// First sample.
    pub first: u32,
    /// One past the last sample.
    pub end: u32,
    /// Number of the tile, row by row.
    pub tile: u32,
}

/// The steps of a run of `spp` samples, in order: they are disjoint and cover `0..spp`.
pub fn steps(spp: u32) -> Vec<Range<u32>> {
    let mut steps = Vec::new();
    let mut first = 0;
    while first < spp {
        let end = step_end(first).min(spp);
        steps.push(first..end);
        first = end;
    }
    steps
}

/// First end of a step that lies after `samples`.
pub fn step_end(samples: u32) -> u32 {
    // the wave w..4w ends after samples; its thirds are 2w, 3w, 4w; the first wave is one sample
    let mut wave = 1;
    while 4 * wave <= samples {
        wave *= 4;
    }
    if samples < 1 { 1 } else { (samples / wave + 1) * wave }
}

/// Whether a step ends there.
pub fn is_step_end(samples: u32) -> bool {
    samples > 0 && step_end(samples - 1) == samples
}

/// Which samples of each tile are done: disjoint ranges by tile, adjacent ones joined.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done(Vec<Vec<(u32, u32)>>);

impl Done {
    /// Nothing is done.
    pub fn none(tiles: u32) -> Self {
        Done(vec![Vec::new(); tiles as usize])
    }
    /// Number of tiles.
    pub fn tiles(&self) -> u32 {
        self.0.len() as u32
    }
    /// Whether it is as [`Done::add`] would have made it, of samples below `end`: what was read may be anything.
    pub fn is_sound(&self, end: u32) -> bool {
        let of_tile = |ranges: &Vec<(u32, u32)>| {
            let apart = ranges.windows(2).all(|w| w[0].1 < w[1].0);
            apart && ranges.iter().all(|r| r.0 < r.1 && r.1 <= end)
        };
        self.0.iter().all(of_tile)
    }
    /// How many samples of a tile are done.
    pub fn samples(&self, tile: u32) -> u32 {
        self.0[tile as usize].iter().map(|r| r.1 - r.0).sum()
    }
    /// Adds a unit; false (and nothing changes) if a sample of it is done already, or the tile does not exist.
    pub fn add(&mut self, unit: CameraUnit) -> bool {
        let Some(ranges) = self.0.get_mut(unit.tile as usize) else { return false };
        let at = ranges.partition_point(|r| r.1 <= unit.first);
        if unit.first >= unit.end || ranges.get(at).is_some_and(|r| r.0 < unit.end) {
            return false;
        }
        ranges.insert(at, (unit.first, unit.end));
        if ranges.get(at + 1).is_some_and(|r| r.0 == unit.end) {
            ranges[at].1 = ranges.remove(at + 1).1;
        }
        if at > 0 && ranges[at - 1].1 == unit.first {
            ranges[at - 1].1 = ranges.remove(at).1;
        }
        true
    }
    /// Takes a unit out again; it must have been added as it is.
    pub fn remove(&mut self, unit: CameraUnit) {
        let ranges = &mut self.0[unit.tile as usize];
        let at = ranges.partition_point(|r| r.1 <= unit.first);
        let (a, b) = ranges.remove(at);
        debug_assert!(a <= unit.first && unit.end <= b);
        if unit.end < b {
            ranges.insert(at, (unit.end, b));
        }
        if a < unit.first {
            ranges.insert(at, (a, unit.first));
        }
    }
    /// What of `samples` is left to do in a tile.
    pub fn missing(&self, tile: u32, samples: &Range<u32>) -> Vec<CameraUnit> {
        let mut left = Vec::new();
        let mut first = samples.start;
        for &(a, b) in &self.0[tile as usize] {
            if a >= samples.end {
                break;
            }
            if a > first {
                left.push(CameraUnit { tile, first, end: a });
            }
            first = first.max(b);
        }
        if first < samples.end {
            left.push(CameraUnit { tile, first, end: samples.end });
        }
        left
    }
    /// Samples that every tile has, counted from 0.
    pub fn complete(&self) -> u32 {
        self.begin().least()
    }
    /// Samples that each tile has, counted from 0.
    pub fn begin(&self) -> Samples {
        Samples::of(self.0.iter().map(|r| r.first().map_or(0, |&(a, b)| if a == 0 { b } else { 0 })).collect())
    }
    /// One past the last sample of each tile.
    pub fn ends(&self) -> Samples {
        Samples::of(self.0.iter().map(|r| r.last().map_or(0, |r| r.1)).collect())
    }
    /// One past the last sample of any tile.
    pub fn reach(&self) -> u32 {
        self.0.iter().filter_map(|r| r.last()).map(|r| r.1).max().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rayherd_render::film::PerTile;

    use super::*;

    #[test]
    fn steps_end_where_waves_end_and_a_longer_run_begins_with_the_shorter() {
        let ends: Vec<u32> = steps(256).iter().map(|r| r.end).collect();
        assert_eq!(ends, [1, 2, 3, 4, 8, 12, 16, 32, 48, 64, 128, 192, 256]);
        let long = steps(MAX_SPP);
        assert_eq!(long.last().unwrap().end, MAX_SPP);
        for spp in [1, 5, 17, 100, 257] {
            let short = steps(spp);
            assert_eq!(short[..short.len() - 1], long[..short.len() - 1]);
            assert_eq!(short.last().unwrap().end, spp);
        }
        assert!(steps(0).is_empty());
    }

    proptest! {
        #[test]
        fn done_is_the_set_of_its_samples(units in prop::collection::vec((0u32..3, 0u32..40, 1u32..9), 0..40)) {
            let mut done = Done::none(3);
            let mut naive = [[false; 64]; 3];
            let mut added = Vec::new();
            for (tile, first, n) in units {
                let unit = CameraUnit { tile, first, end: first + n };
                let cells = &mut naive[tile as usize][first as usize..(first + n) as usize];
                let free = cells.iter().all(|c| !*c);
                prop_assert_eq!(done.add(unit), free);
                if free {
                    cells.fill(true);
                    added.push(unit);
                }
            }
            for tile in 0..3 {
                let missing: u32 = done.missing(tile, &(5..50)).iter().map(|u| u.end - u.first).sum();
                prop_assert_eq!(missing as usize, naive[tile as usize][5..50].iter().filter(|c| !**c).count());
            }
            let complete = (0..3).map(|t| naive[t].iter().take_while(|c| **c).count()).min().unwrap();
            prop_assert_eq!(done.complete() as usize, complete);
            for tile in 0..3 {
                let (begin, end) = (done.begin().of_tile(tile) as usize, done.ends().of_tile(tile) as usize);
                prop_assert_eq!(begin, naive[tile].iter().take_while(|c| **c).count());
                prop_assert_eq!(end, naive[tile].iter().rposition(|c| *c).map_or(0, |last| last + 1));
            }
            while let Some(unit) = added.pop() {
                done.remove(unit);
            }
            prop_assert_eq!(done, Done::none(3));
        }
    }
}
