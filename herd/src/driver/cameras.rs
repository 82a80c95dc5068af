//! Camera units that were not handed out yet, by the split where they start.

use std::collections::{BTreeMap, VecDeque};

use rayherd_render::film::{PerTile, Samples};
use rayherd_render::frame::Frame;

use crate::task::camera::tile_pixels;
use crate::wave::{CameraUnit, Done};

/// Most samples of a unit, so that a unit is a small part of a task; but a step is cut into at most so many parts, so that the
/// number of units stays bounded.
const UNIT_SAMPLES: u32 = 256;
const STEP_PARTS: u32 = 64;

/// Queues of units, in the order in which steps were added.
pub struct Cameras {
    /// Split where each tile's rays start.
    starts: Vec<u32>,
    /// Pixels of each tile.
    pixels: Vec<u64>,
    queues: BTreeMap<u32, VecDeque<(u64, CameraUnit)>>,
    added: u64,
}

impl Cameras {
    /// Empty queues.
    pub fn new(frame: &Frame, starts: Vec<u32>) -> Self {
        let pixels = (0..starts.len() as u32).map(|t| u64::from(tile_pixels(frame, t))).collect();
        Cameras { starts, pixels, queues: BTreeMap::new(), added: 0 }
    }
    /// Forgets all units.
    pub fn clear(&mut self) {
        self.queues.clear();
    }
    /// Adds what of the samples between two states was not taken.
    pub fn add(&mut self, from: &Samples, to: &Samples, taken: &Done) {
        let ends = |tile: usize| (from.of_tile(tile), to.of_tile(tile));
        let most = (0..self.starts.len()).map(|t| ends(t).1.saturating_sub(ends(t).0)).max().unwrap_or(0);
        let len = UNIT_SAMPLES.max(most.div_ceil(STEP_PARTS));
        for begin in (0..most).step_by(len as usize) {
            for tile in 0..self.starts.len() {
                let (first, end) = ends(tile);
                let first = first.saturating_add(begin);
                for unit in taken.missing(tile as u32, &(first..first.saturating_add(len).min(end))) {
                    self.push_back(unit);
                }
            }
        }
    }
    /// Pixels of each tile.
    pub fn pixels(&self) -> &[u64] {
        &self.pixels
    }
    /// Puts units of a task that was given up first in their queues.
    pub fn give_back(&mut self, units: &[CameraUnit]) {
        for &unit in units.iter().rev() {
            let queue = self.queues.entry(self.starts[unit.tile as usize]).or_default();
            queue.push_front((0, unit));
        }
    }
    /// Camera rays by start split.
    pub fn rays(&self) -> BTreeMap<u32, u64> {
        let sum = |q: &VecDeque<(u64, CameraUnit)>| q.iter().map(|(_, u)| self.unit_rays(u)).sum();
        self.queues.iter().filter(|(_, q)| !q.is_empty()).map(|(&s, q)| (s, sum(q))).collect()
    }
    /// How many units.
    pub fn units(&self) -> usize {
        self.queues.values().map(VecDeque::len).sum()
    }
    /// Whether there are none left.
    pub fn is_empty(&self) -> bool {
        self.queues.values().all(VecDeque::is_empty)
    }
    /// Takes units, oldest first, until there are about `rays` rays, of the given start splits (of all if none are given).
    pub fn take(&mut self, rays: u64, from: &[u32]) -> Vec<CameraUnit> {
        let mut out = Vec::new();
        let mut sum = 0;
        while sum < rays.max(1) {
            let fronts = self.queues.iter().filter(|(s, _)| from.is_empty() || from.contains(s));
            let oldest = fronts.filter_map(|(&s, q)| q.front().map(|f| (f.0, s))).min();
            let Some(unit) = oldest.and_then(|(_, s)| self.queues.get_mut(&s)?.pop_front()) else { break };
            sum += self.unit_rays(&unit.1);
            out.push(unit.1);
        }
        out
    }

    fn push_back(&mut self, unit: CameraUnit) {
        self.added += 1;
        self.queues.entry(self.starts[unit.tile as usize]).or_default().push_back((self.added, unit));
    }
    fn unit_rays(&self, unit: &CameraUnit) -> u64 {
        self.pixels[unit.tile as usize] * u64::from(unit.end - unit.first)
    }
}
