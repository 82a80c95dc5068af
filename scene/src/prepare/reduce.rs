//! Overlap reduction's second step: groups of cells joined to copied splits.

use rayon::prelude::*;

use super::PrepareError;
use super::build::build_split;
use super::building::{Building, at_once};
use super::incidence::ABSENT;
use super::progress::{PrepareProgress, Stage};
use super::records::Records;

impl Building<'_> {
    /// Joins groups in their order while their distinct primitives are at most `capacity`, builds the splits and hands the
    /// cells over to them.
    pub(super) fn reduce(&mut self, capacity: u64, progress: &dyn PrepareProgress) -> Result<(), PrepareError> {
        let Some(groups) = self.groups else { return Ok(()) };
        progress.begin(Stage::Reducing, Some(u64::from(groups.count)));
        let mut new_owner = vec![ABSENT; groups.count as usize];
        let mut next = self.splits.len() as u32;
        let mut filling = Records::default();
        let mut full = Vec::new();
        for group in 0..groups.count as usize {
            let mut records = Records::default();
            for &chunk in &self.parts[group] {
                self.spool.load(chunk, &mut records).map_err(|e| self.spool_error(e))?;
            }
            if filling.len() > 0 && filling.union_len(&records) as u64 > capacity {
                full.push(std::mem::take(&mut filling));
                next += 1;
                if full.len() == at_once(capacity) {
                    self.copied_splits(&mut full)?;
                }
            }
            filling = if filling.len() == 0 { records } else { filling.union(&records) };
            new_owner[group] = next;
            progress.advance(1);
        }
        if filling.len() > 0 {
            full.push(filling);
        }
        self.copied_splits(&mut full)?;
        for (n, &group) in groups.of_cell.iter().enumerate() {
            if group != ABSENT {
                self.owners[n] = vec![new_owner[group as usize]];
            }
        }
        Ok(())
    }

    fn copied_splits(&mut self, full: &mut Vec<Records>) -> Result<(), PrepareError> {
        let first = self.splits.len() as u32;
        let numbered: Vec<(u32, Records)> = (first..).zip(full.drain(..)).collect();
        let blocks = &self.blocks;
        let done: Vec<_> =
            numbered.into_par_iter().map(|(split, records)| build_split(split, &records, true, blocks)).collect();
        for built in done {
            let built = built?;
            self.splits.push(built.entry);
            self.tree += built.tree;
        }
        Ok(())
    }
}
