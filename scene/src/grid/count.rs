//! Choosing the subdivision: several candidates are counted in one pass, then the paper's three conditions decide.

use serde::{Deserialize, Serialize};

use super::Lattice;
use super::touch::{sphere_cells, triangle_cells};
use crate::prepare::PrepareSettings;

/// What stopped the search for a subdivision.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StoppedBy {
    /// Condition 2 is met: the share of primitives in contested cells is at or below the threshold.
    Threshold,
    /// Condition 3: occupied cells are several times the splits.
    Several,
    /// The largest subdivision allowed was reached.
    Limit,
}

/// What was counted for one subdivision.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Candidate {
    /// Cells along an axis.
    pub subdiv: u32,
    /// Occupied cells.
    pub occupied: u64,
    /// Most primitives in a cell.
    pub fullest: u64,
    /// (primitive, cell) pairs.
    pub pairs: u64,
    /// Of those, in cells that several splits claim.
    pub contested_pairs: u64,
}

impl Candidate {
    /// Share of primitives in contested cells, a primitive counted in every cell that it overlaps.
    pub fn contested_share(&self) -> f64 {
        if self.pairs == 0 { 0.0 } else { self.contested_pairs as f64 / self.pairs as f64 }
    }
}

/// Tables of all candidates together hold at most this many cells (12 bytes each).
const MOST_CELLS: usize = 24 << 20;

/// One split's primitives as counting needs them.
#[derive(Clone, Copy, Debug)]
pub struct Primitives<'a> {
    /// Vertices.
    pub triangles: &'a [[[f32; 3]; 3]],
    /// Centre and radius.
    pub spheres: &'a [([f32; 3], f32)],
}

/// Subdivisions worth counting for so many splits, ascending: from ceil(cbrt(splits)), the paper's start, to where even
/// a flat sheet of primitives has `several` occupied cells per split and half as many cells again along an axis.
pub fn candidates(splits: u32, settings: &PrepareSettings) -> Vec<u32> {
    let cube = |n: u32| u64::from(n).pow(3);
    let mut n = 1;
    while cube(n) < u64::from(splits) && n < settings.max_subdiv {
        n += 1;
    }
    let wanted = u64::from(splits) * u64::from(settings.several);
    let mut sheet = n;
    while u64::from(sheet).pow(2) < wanted && sheet < settings.max_subdiv {
        sheet += 1;
    }
    let last = (sheet + sheet / 2).min(settings.max_subdiv).max(n);
    let mut out = Vec::new();
    let mut cells = 0;
    while n <= last {
        cells += (n as usize).pow(3);
        if cells > MOST_CELLS && !out.is_empty() {
            break;
        }
        out.push(n);
        // steps of one while they matter, then of an eighth
        n += (n / 8).max(1);
    }
    out
}

/// Counts of one subdivision while splits pass by.
#[derive(Clone, Debug)]
pub struct Counter {
    lattice: Lattice,
    cells: Vec<CellCount>,
}

#[derive(Clone, Copy, Debug)]
struct CellCount {
    primitives: u32,
    /// The split that touched it last.
    last: u32,
    owners: u32,
}

/// No split yet.
const NONE: u32 = u32::MAX;

impl Counter {
    /// Counts nothing yet.
    pub fn new(lattice: Lattice) -> Self {
        let cells = vec![CellCount { primitives: 0, last: NONE, owners: 0 }; lattice.len()];
        Counter { lattice, cells }
    }

    /// Its lattice.
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// Adds a split. Splits come by ascending number, each in one or several calls.
    pub fn add(&mut self, split: u32, primitives: Primitives) {
        let Counter { lattice, cells } = self;
        let mut touch = |at: [u32; 3]| {
            let cell = &mut cells[lattice.index(at) as usize];
            cell.primitives = cell.primitives.saturating_add(1);
            if cell.last != split {
                cell.last = split;
                cell.owners += 1;
            }
        };
        // neighbours in the file are neighbours in space: most triangles lie in the cell of the one before
        let mut inside = Inside::NOWHERE;
        for p in primitives.triangles {
            if inside.holds(p) {
                touch(inside.at);
                continue;
            }
            let p = p.map(|v| v.map(f64::from));
            let mut found = 0;
            let mut only = [0; 3];
            triangle_cells(lattice, &p, &mut |at| {
                found += 1;
                only = at;
                touch(at);
            });
            if found == 1 {
                inside = Inside::new(lattice, only);
            }
        }
        for (center, radius) in primitives.spheres {
            sphere_cells(lattice, center.map(f64::from), f64::from(*radius), &mut touch);
        }
    }

    /// What was counted.
    pub fn summary(&self) -> Candidate {
        let mut sum =
            Candidate { subdiv: self.lattice.subdiv(), occupied: 0, fullest: 0, pairs: 0, contested_pairs: 0 };
        for cell in self.cells.iter().filter(|c| c.primitives > 0) {
            let count = u64::from(cell.primitives);
            sum.occupied += 1;
            sum.fullest = sum.fullest.max(count);
            sum.pairs += count;
            if cell.owners > 1 {
                sum.contested_pairs += count;
            }
        }
        sum
    }

    /// Occupied cells by ascending index: index, primitives, number of owners.
    pub fn occupied(&self) -> impl Iterator<Item = (u32, u32, u32)> + '_ {
        (0..).zip(&self.cells).filter(|(_, c)| c.primitives > 0).map(|(i, c)| (i, c.primitives, c.owners))
    }
}

/// A cell's box in f32, rounded inwards, half open as cells are: what is strictly inside lies in this cell alone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Inside {
    pub(crate) at: [u32; 3],
    lo: [f32; 3],
    hi: [f32; 3],
}

impl Inside {
    /// Holds nothing.
    pub(crate) const NOWHERE: Inside = Inside { at: [0; 3], lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3] };

    pub(crate) fn new(lattice: &Lattice, at: [u32; 3]) -> Self {
        let (lo, hi) = lattice.cell_box(at);
        Inside {
            at,
            lo: std::array::from_fn(|a| super::lattice::round_up(lo[a])),
            hi: std::array::from_fn(|a| super::lattice::round_down(hi[a])),
        }
    }

    #[inline]
    pub(crate) fn holds(&self, p: &[[f32; 3]; 3]) -> bool {
        // no branch per coordinate: the answer is nearly always the same
        let mut all = true;
        for v in p {
            for a in 0..3 {
                all &= v[a] >= self.lo[a] && v[a] < self.hi[a];
            }
        }
        all
    }
}

/// Picks a subdivision by the paper's conditions, from coarse to fine. Returns the index of the chosen candidate.
///
/// 1. A cell with more primitives than a split holds asks for a finer grid, whatever else is true.
/// 2. A share of primitives in contested cells above the threshold asks for a finer grid, unless
/// 3. the occupied cells are `several` times the splits: fine enough.
///
/// When no candidate is left: the coarsest of those with the least crowded fullest cell, as finer ones only made more
/// copies of large primitives.
pub fn choose(candidates: &[Candidate], splits: u32, capacity: u64, settings: &PrepareSettings) -> (usize, StoppedBy) {
    let enough = u64::from(splits) * u64::from(settings.several);
    for (i, c) in candidates.iter().enumerate() {
        if c.fullest > capacity {
            continue;
        }
        if c.occupied >= enough {
            return (i, StoppedBy::Several);
        }
        if c.contested_share() <= settings.overlap_threshold {
            return (i, StoppedBy::Threshold);
        }
    }
    let fits = |c: &Candidate| c.fullest <= capacity;
    let finest = candidates.len().saturating_sub(1);
    if candidates.last().is_some_and(fits) {
        return (finest, StoppedBy::Limit);
    }
    let least = candidates.iter().map(|c| c.fullest).min().unwrap_or(0);
    (candidates.iter().position(|c| c.fullest == least).unwrap_or(finest), StoppedBy::Limit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prepare::Cut;

    fn settings() -> PrepareSettings {
        PrepareSettings { cut: Cut::Splits(32), ..Default::default() }
    }

    fn candidate(subdiv: u32, fullest: u64, occupied: u64, contested: f64) -> Candidate {
        Candidate { subdiv, occupied, fullest, pairs: 1000, contested_pairs: (1000.0 * contested) as u64 }
    }

    #[test]
    fn it_starts_at_the_papers_subdivision_and_reaches_a_sheet() {
        let first = |splits| candidates(splits, &settings())[0];
        assert_eq!([1, 8, 9, 10, 27, 28, 32].map(first), [1, 2, 3, 3, 3, 4, 4]);
        let of_ct = candidates(32, &settings());
        assert!(of_ct.contains(&10) && *of_ct.last().unwrap() >= 23, "{of_ct:?}");
        let many = candidates(100_000, &settings());
        assert!(many.iter().all(|&n| n <= settings().max_subdiv));
        assert!(many.iter().map(|&n| (n as usize).pow(3)).sum::<usize>() <= MOST_CELLS);
        let small = PrepareSettings { max_subdiv: 3, ..settings() };
        assert_eq!(candidates(1000, &small), [3]);
    }

    #[test]
    fn the_three_conditions() {
        let choose = |c: &[Candidate]| choose(c, 32, 100, &settings());
        // condition 2 alone: finer until the share is at the threshold
        let c = [candidate(4, 90, 40, 0.5), candidate(5, 80, 60, 0.2), candidate(6, 70, 80, 0.1)];
        assert_eq!(choose(&c), (1, StoppedBy::Threshold));
        // condition 3 wins over condition 2
        let c = [candidate(4, 90, 40, 0.5), candidate(5, 80, 512, 0.4), candidate(6, 70, 600, 0.1)];
        assert_eq!(choose(&c), (1, StoppedBy::Several));
        // condition 1 wins over both
        let c = [candidate(4, 101, 600, 0.1), candidate(5, 101, 700, 0.1), candidate(6, 100, 800, 0.9)];
        assert_eq!(choose(&c), (2, StoppedBy::Several));
        // nothing is good enough: the finest that a split can hold
        let c = [candidate(4, 90, 40, 0.5), candidate(5, 80, 60, 0.4)];
        assert_eq!(choose(&c), (1, StoppedBy::Limit));
        // a cell stays too full: no finer than helps
        let c = [candidate(4, 400, 40, 0.5), candidate(5, 300, 60, 0.4), candidate(6, 300, 90, 0.4)];
        assert_eq!(choose(&c), (1, StoppedBy::Limit));
        assert_eq!(choose(&[candidate(1, 1, 1, 0.0)]), (0, StoppedBy::Threshold));
    }

    #[test]
    fn a_triangle_counts_in_every_cell_it_overlaps() {
        let lattice = Lattice::new(2, [0.0; 3], [2.0; 3]).unwrap();
        let mut counter = Counter::new(lattice);
        let small = |x: f32| [[x, 0.1, 0.1], [x + 0.2, 0.1, 0.1], [x, 0.3, 0.1]];
        let first = [small(0.1), small(0.2), small(0.9)];
        counter.add(0, Primitives { triangles: &first, spheres: &[] });
        counter.add(1, Primitives { triangles: &[small(0.3)], spheres: &[([0.5, 0.5, 0.5], 0.25)] });
        counter.add(1, Primitives { triangles: &[small(1.3)], spheres: &[] });
        let mut occupied: Vec<_> = counter.occupied().collect();
        occupied.sort();
        assert_eq!(occupied, [(0, 5, 2), (1, 2, 2)]);
        let sum = counter.summary();
        assert_eq!((sum.occupied, sum.fullest, sum.pairs, sum.contested_pairs), (2, 5, 7, 7));
    }
}
