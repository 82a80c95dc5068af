//! What must hold in a manifest before anything uses it.

use std::collections::{BTreeSet, HashMap};

use super::{Manifest, SplitEntry};
use crate::grid::Grid;

/// Most primitives in one split: what a block's 32-bit local index can count, with room for a slot's flag values.
const MOST_IN_SPLIT: u64 = 1 << 31;

impl Manifest {
    /// Checks ranges and relations; the message says which is broken.
    pub(super) fn check(&self) -> Result<(), String> {
        self.settings.check()?;
        if let Some(homes) = &self.homes
            && (homes.is_empty() || homes.iter().collect::<BTreeSet<_>>().len() < homes.len())
        {
            return Err("its blocks lie on no store, or twice on one".to_owned());
        }
        if self.offset.iter().any(|x| !x.is_finite()) {
            return Err("the offset is not finite".to_owned());
        }
        if self.splits.is_empty() {
            return Err("it has no splits".to_owned());
        }
        // far below u32, and sums of object sizes stay below 2^64
        if self.splits.len() >= 1 << 22 {
            return Err("it has too many splits".to_owned());
        }
        if self.tiles.len() >= 1 << 28 {
            return Err("it has too many texture tiles".to_owned());
        }
        if (self.grid.lo, self.grid.hi) != (self.lo, self.hi) {
            return Err("the grid's box is not the scene's".to_owned());
        }
        let mut next_id = 0;
        let mut was_copied = false;
        for (i, split) in self.splits.iter().enumerate() {
            self.check_split(split).map_err(|what| format!("split {i}: {what}"))?;
            if split.copied {
                was_copied = true;
                continue;
            }
            if was_copied {
                return Err(format!("split {i}: it comes from the source but follows a copied one"));
            }
            if split.first_id < next_id {
                return Err(format!("split {i}: it does not follow the source's order"));
            }
            next_id = split.last_id + 1;
        }
        let of_source = || self.splits.iter().filter(|s| !s.copied);
        // each count is below 2^31 and there are fewer than 2^22 of them
        let (triangles, spheres) = of_source().fold((0, 0), |(t, s), split| (t + split.triangles, s + split.spheres));
        if (triangles, spheres) != (self.counts.triangles, self.counts.spheres) {
            return Err("the splits do not hold what was counted".to_owned());
        }
        let grid = Grid::new(&self.grid, self.splits.len() as u32).map_err(|e| e.to_string())?;
        let single = (0..grid.occupied()).all(|c| grid.owners(c).len() == 1);
        if self.settings.overlap_reduction && !single {
            return Err("a cell has several owners after overlap reduction".to_owned());
        }
        if !self.settings.overlap_reduction && was_copied {
            return Err("it has copied splits without overlap reduction".to_owned());
        }
        let mut sizes = HashMap::new();
        if self.objects().any(|o| *sizes.entry(o.hash).or_insert(o.bytes) != o.bytes) {
            return Err("one object has two sizes".to_owned());
        }
        // so that sums of sizes cannot overflow
        if self.objects().any(|o| o.bytes > 1 << 40) {
            return Err("an object is larger than 1 TiB".to_owned());
        }
        Ok(())
    }

    fn check_split(&self, split: &SplitEntry) -> Result<(), String> {
        // no sum overflows: both are below 2^31 when the first two tests pass
        if split.triangles >= MOST_IN_SPLIT || split.spheres >= MOST_IN_SPLIT {
            return Err("it counts too many primitives".to_owned());
        }
        let count = split.triangles + split.spheres;
        if count == 0 || count >= MOST_IN_SPLIT {
            return Err(format!("it counts {count} primitives"));
        }
        if split.first_id > split.last_id || split.last_id >= self.counts.records {
            return Err("its ids are out of range".to_owned());
        }
        if split.last_id - split.first_id < count - 1 {
            return Err("it holds more primitives than ids".to_owned());
        }
        // NaN fails too
        let inside = |a: usize| self.lo[a] <= split.lo[a] && split.lo[a] <= split.hi[a] && split.hi[a] <= self.hi[a];
        if !(0..3).all(inside) {
            return Err("its box is not inside the scene's".to_owned());
        }
        Ok(())
    }
}
