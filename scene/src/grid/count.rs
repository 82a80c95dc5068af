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

/// One split's primitives as counting needs them, made once for all candidates.
#[derive(Clone, Debug)]
pub struct Primitives<'a> {
    triangles: &'a [[[f32; 3]; 3]],
    places: Vec<Place>,
    /// Of every [`RUN`] triangles.
    runs: Vec<Place>,
    /// Centre and radius.
    spheres: Vec<([f32; 3], f32)>,
}

/// Lower and upper corner.
pub(crate) type Box3 = [[f32; 3]; 2];

/// Triangles that are looked at together first: neighbours in the file are often neighbours in space.
pub(crate) const RUN: usize = 16;

/// A box as fractions of the grid's inner one, in units of 2^-32, rounded outwards by so much that a plane of any candidate
/// that touches the box lies strictly between its corners, or at one of them. [`OUT`] for one that reaches out of it.
type Place = [[u32; 3]; 2];

/// Inside out: the box of nothing.
const OUT: Place = [[u32::MAX; 3], [0; 3]];

impl<'a> Primitives<'a> {
    /// From vertices, and centres and radii; `lattice` has the boxes (its subdivision does not matter).
    pub fn new(lattice: &Lattice, triangles: &'a [[[f32; 3]; 3]], spheres: Vec<([f32; 3], f32)>) -> Self {
        let (lo, hi) = lattice.inner();
        let units = (1u64 << 32) as f64;
        let scale: [f64; 3] = std::array::from_fn(|a| if hi[a] > lo[a] { units / (hi[a] - lo[a]) } else { 0.0 });
        // a coordinate's fraction is rounded by 4 u, a plane by 3 u M in position: in units of 2^-32 of the box, below
        // 2^-18 and 2^-18 M / extent; and one for the cast
        let m = lattice.magnitude();
        let margin: [f64; 3] = std::array::from_fn(|a| 2.0 + (m * scale[a] * 1e-15).ceil());
        let place = |[low, high]: Box3| -> Place {
            if lattice.reaches_out(&low, &high) {
                return OUT;
            }
            // casts saturate: what is outside by the margin stays at the box's faces
            let from = |x: f32, a: usize| (f64::from(x) - lo[a]) * scale[a];
            [
                std::array::from_fn(|a| (from(low[a], a) - margin[a]) as u32),
                std::array::from_fn(|a| (from(high[a], a) + margin[a]) as u32),
            ]
        };
        Primitives {
            triangles,
            places: triangles.iter().map(|p| place(box_of(p))).collect(),
            runs: triangles.chunks(RUN).map(|run| place(box_of(run.as_flattened()))).collect(),
            spheres,
        }
    }
}

/// The cell of a lattice that a box lies in for certain, if there is one: an integer product for each face instead of
/// a division, and no plane is computed.
#[inline]
fn certain_cell(lattice: &Lattice, [low, high]: &Place) -> Option<[u32; 3]> {
    if low[0] > high[0] {
        return None;
    }
    let subdiv = lattice.subdiv();
    let cell = |q: u32| ((u64::from(q) * u64::from(subdiv)) >> 32) as u32;
    let at = low.map(cell);
    (at == high.map(cell)).then(|| lattice.from_inner(at))
}

/// Box of points.
#[inline]
pub(crate) fn box_of(points: &[[f32; 3]]) -> Box3 {
    let mut out = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for p in points {
        for a in 0..3 {
            out[0][a] = out[0][a].min(p[a]);
            out[1][a] = out[1][a].max(p[a]);
        }
    }
    out
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

/// An occupied cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Occupied {
    /// Its lattice index.
    pub index: u32,
    /// Primitives that overlap it.
    pub primitives: u32,
    /// Number of splits that hold them.
    pub owners: u32,
    /// The last of those splits.
    pub last_owner: u32,
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
    pub fn add(&mut self, split: u32, primitives: &Primitives) {
        let Counter { lattice, cells } = self;
        let mut touch = |at: [u32; 3], primitives: u32| {
            let cell = &mut cells[lattice.index(at) as usize];
            cell.primitives = cell.primitives.saturating_add(primitives);
            if cell.last != split {
                cell.last = split;
                cell.owners += 1;
            }
        };
        let runs = primitives.triangles.chunks(RUN).zip(primitives.places.chunks(RUN)).zip(&primitives.runs);
        for ((run, places), together) in runs {
            if let Some(at) = certain_cell(lattice, together) {
                touch(at, run.len() as u32);
                continue;
            }
            for (p, place) in run.iter().zip(places) {
                match certain_cell(lattice, place) {
                    Some(at) => touch(at, 1),
                    None => triangle_cells(lattice, &p.map(|v| v.map(f64::from)), &mut |at| touch(at, 1)),
                }
            }
        }
        for (center, radius) in &primitives.spheres {
            sphere_cells(lattice, center.map(f64::from), f64::from(*radius), &mut |at| touch(at, 1));
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

    /// Occupied cells by ascending index.
    pub fn occupied(&self) -> impl Iterator<Item = Occupied> + '_ {
        (0..).zip(&self.cells).filter(|(_, c)| c.primitives > 0).map(|(index, c)| Occupied {
            index,
            primitives: c.primitives,
            owners: c.owners,
            last_owner: c.last,
        })
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
        counter.add(0, &Primitives::new(&counter.lattice().clone(), &first, vec![]));
        let second = [small(0.3)];
        let spheres = vec![([0.5, 0.5, 0.5], 0.25)];
        counter.add(1, &Primitives::new(&counter.lattice().clone(), &second, spheres));
        let third = [small(1.3)];
        counter.add(1, &Primitives::new(&counter.lattice().clone(), &third, vec![]));
        let occupied: Vec<_> = counter.occupied().map(|c| (c.index, c.primitives, c.owners, c.last_owner)).collect();
        assert_eq!(occupied, [(0, 5, 2, 1), (1, 2, 2, 1)]);
        let sum = counter.summary();
        assert_eq!((sum.occupied, sum.fullest, sum.pairs, sum.contested_pairs), (2, 5, 7, 7));
    }

    /// The fast way (runs, then boxes, in integers) counts what the plain one does.
    #[test]
    fn runs_count_as_single_triangles_do() {
        let mut state = 3u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            // multiples of 1/16: on planes now and then
            ((state >> 33) % 128) as f32 / 16.0
        };
        let mut triangles = Vec::new();
        let mut at = [4.0f32; 3];
        for i in 0..5000 {
            if i % 40 == 0 {
                at = [next(), next(), next()];
            }
            let mut corner =
                || -> [f32; 3] { std::array::from_fn(|a| (at[a] + (next() - 4.0) / 16.0).clamp(0.0, 8.0)) };
            triangles.push([corner(), corner(), corner()]);
        }
        // also a box that is far from the origin and thin, and one that is flat
        for (shift, squeeze) in [(0.0, 1.0), (1000.0, 1.0), (1000.0, 0.001), (3.0, 0.0)] {
            let moved: Vec<[[f32; 3]; 3]> =
                triangles.iter().map(|p| p.map(|v| [v[0], v[1], v[2] * squeeze + shift])).collect();
            let [lo, hi] = box_of(moved.as_flattened());
            for subdiv in [1, 2, 5, 8, 16, 100] {
                let part = |a: usize, t: f32| lo[a] + t * (hi[a] - lo[a]);
                let inner = |from: f32, to: f32| [from, to].map(|t| std::array::from_fn(|a| part(a, t).min(hi[a])));
                // the last is flat, on a plane that many corners lie in
                for inner in [[lo, hi], inner(0.25, 0.75), inner(0.0, 0.5), inner(0.5, 1.0), inner(0.5, 0.5)] {
                    let lattice = Lattice::around(subdiv, inner, lo, hi).unwrap();
                    let mut fast = Counter::new(lattice.clone());
                    fast.add(7, &Primitives::new(&lattice, &moved, vec![]));
                    let mut plain = vec![0u32; lattice.len()];
                    for p in &moved {
                        let p = p.map(|v| v.map(f64::from));
                        triangle_cells(&lattice, &p, &mut |at| plain[lattice.index(at) as usize] += 1);
                    }
                    let counted: Vec<u32> = fast.cells.iter().map(|c| c.primitives).collect();
                    assert_eq!(counted, plain, "{subdiv}");
                }
            }
        }
    }
}
