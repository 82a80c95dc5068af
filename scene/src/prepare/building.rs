//! Splits on their way into the store.

use std::io;
use std::ops::Range;
use std::time::Duration;

use rayon::prelude::*;

use super::PrepareError;
use super::build::{Blocks, build_split};
use super::incidence::{CellBox, ChosenCells, Incidence, incidence};
use super::progress::{PrepareProgress, Stage};
use super::spool::Spool;
use crate::manifest::SplitEntry;
use crate::overlap;

/// Primitives in all splits that are built at one time: some 300 MiB of records, trees and blocks. A larger split is built alone, by all
/// threads together.
pub const AT_ONCE: u64 = 1 << 20;

/// How many splits of at most so many primitives are built at one time: each holds its records and its tree.
pub(super) fn at_once(primitives: u64) -> usize {
    usize::try_from(AT_ONCE / primitives.max(1)).unwrap_or(usize::MAX).clamp(1, rayon::current_num_threads())
}

/// Splits on their way into the store.
pub(super) struct Building<'a> {
    pub blocks: Blocks<'a>,
    pub cells: &'a ChosenCells,
    pub groups: Option<&'a overlap::Groups>,
    pub spool: Spool,
    pub splits: Vec<SplitEntry>,
    /// What is in a cell, by its number.
    pub boxes: Vec<CellBox>,
    /// Who owns a cell, by its number.
    pub owners: Vec<Vec<u32>>,
    /// Chunks of the spool that hold a group's primitives, by ascending split.
    pub parts: Vec<Vec<usize>>,
    pub contested: u64,
    pub tree: Duration,
}

impl Building<'_> {
    pub(super) fn spool_error(&self, source: io::Error) -> PrepareError {
        PrepareError::Spool { folder: self.spool.folder().clone(), source }
    }

    /// The splits that are cut from the source.
    pub(super) fn source_splits(
        &mut self,
        ranges: &[Range<u64>],
        progress: &dyn PrepareProgress,
    ) -> Result<(), PrepareError> {
        progress.begin(Stage::Building, Some(ranges.len() as u64));
        let of_cell = self.groups.map_or(&[][..], |g| &g.of_cell);
        for wave in ranges.chunks(at_once(ranges.iter().map(|r| r.end - r.start).max().unwrap_or(0))) {
            let first = self.splits.len() as u32;
            let work = |(split, range): (u32, &Range<u64>)| -> Result<_, PrepareError> {
                let records = self.spool.range(range).map_err(|e| self.spool_error(e))?;
                let found = incidence(self.cells, of_cell, &records);
                let dealt = records.deal(&found.triangles, &found.spheres);
                Ok((build_split(split, &records, false, &self.blocks)?, found, dealt))
            };
            let numbered: Vec<(u32, &Range<u64>)> = (first..).zip(wave).collect();
            // in order, so that the first error is always the same one
            let done: Vec<_> = numbered.into_par_iter().map(work).collect();
            for result in done {
                let (built, found, dealt) = result?;
                let split = self.splits.len() as u32;
                self.splits.push(built.entry);
                self.tree += built.tree;
                self.note(split, &found);
                for (group, records) in dealt {
                    let chunk = self.spool.push(records).map_err(|e| self.spool_error(e))?;
                    self.parts[group as usize].push(chunk);
                }
            }
            progress.advance(wave.len() as u64);
        }
        Ok(())
    }

    /// Adds what a source split has in the cells.
    fn note(&mut self, split: u32, found: &Incidence) {
        self.contested += found.contested;
        for (number, part) in &found.cells {
            let n = *number as usize;
            self.boxes[n].add(part);
            self.owners[n].push(split);
        }
    }
}
