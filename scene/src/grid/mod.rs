//! The scheduling grid: which split owns which part of space.
//!
//! `subdiv`^3 cells over the box of what does not emit light, and a layer of cells around them where lamps lie outside. A primitive belongs to every cell that it overlaps; an occupied cell knows
//! the splits that hold its primitives (its *owners*) and the tight box of what is inside it. A ray that may still
//! hit something outside the resident splits finds out here where to go ([`Grid::next_foreign`]).

mod boxes;
pub mod count;
pub mod lattice;
mod outside;
mod splitset;
#[cfg(test)]
mod tests;
pub mod touch;
pub mod walk;

use serde::{Deserialize, Serialize};

pub use count::{Candidate, StoppedBy};
pub use lattice::{Lattice, MAX_SUBDIV};
pub use outside::Outside;
pub use splitset::SplitSet;
pub use walk::{Foreign, Progress};

/// A grid as the manifest holds it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridData {
    /// Cells along each axis of the inner box, 1 to [`MAX_SUBDIV`].
    pub subdiv: u32,
    /// Lower corner of the inner box, recentred: that of what does not emit light.
    pub inner_lo: [f32; 3],
    /// Upper corner of the inner box, recentred; it lies just outside where something lies above it.
    pub inner_hi: [f32; 3],
    /// Lower corner of the scene's box, recentred.
    pub lo: [f32; 3],
    /// Upper corner of the scene's box, recentred.
    pub hi: [f32; 3],
    /// Occupied cells by ascending index.
    pub cells: Vec<CellData>,
}

impl GridData {
    /// Its cells' geometry; the message says what is wrong with its boxes or its subdivision.
    pub fn lattice(&self) -> Result<Lattice, String> {
        Lattice::around(self.subdiv, [self.inner_lo, self.inner_hi], self.lo, self.hi)
    }
}

/// One occupied cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellData {
    /// `x + n (y + n z)`, `n` being the [`Lattice::stride`].
    pub index: u32,
    /// Lower corner of the box that holds every point of its primitives in the cell.
    pub lo: [f32; 3],
    /// Upper corner of that box.
    pub hi: [f32; 3],
    /// Primitives that overlap it.
    pub primitives: u64,
    /// Splits that hold them, ascending; one after overlap reduction.
    pub owners: Vec<u32>,
}

/// Why a grid is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("scheduling grid: {0}")]
pub struct GridError(pub String);

/// A checked grid, ready to be walked.
#[derive(Clone, Debug)]
pub struct Grid {
    lattice: Lattice,
    cells: Vec<Cell>,
    owners: Vec<u32>,
    /// Cell number by lattice index, [`EMPTY`] where there is none.
    dense: Vec<u32>,
    owning: SplitSet,
    /// All occupied cells.
    everywhere: Outside,
    /// Whether cells' boxes are those of what is inside.
    tight: bool,
}

/// What the walk needs of a cell.
#[derive(Clone, Copy, Debug)]
struct Cell {
    lo: [f32; 3],
    hi: [f32; 3],
    first_owner: u32,
    owner_count: u32,
}

/// Marks an empty cell.
const EMPTY: u32 = u32::MAX;

impl Grid {
    /// Checks a grid over `splits` splits and makes it ready. Never panics, whatever the data.
    pub fn new(data: &GridData, splits: u32) -> Result<Grid, GridError> {
        let refuse = |message: String| Err(GridError(message));
        let lattice = data.lattice().map_err(GridError)?;
        if data.cells.is_empty() {
            return refuse("no cell is occupied".to_owned());
        }
        let mut cells = Vec::with_capacity(data.cells.len());
        let mut owners = Vec::new();
        let mut dense = vec![EMPTY; lattice.len()];
        let mut owning = SplitSet::with_capacity(splits);
        let mut last = None;
        for cell in &data.cells {
            if last.is_some_and(|l| cell.index <= l) {
                return refuse(format!("cell {} is out of order", cell.index));
            }
            last = Some(cell.index);
            let Some(at) = lattice.coordinates(cell.index) else {
                return refuse(format!("cell {} lies outside the grid", cell.index));
            };
            let (lo, hi) = lattice.cell_box_f32(at);
            for a in 0..3 {
                // NaN fails too
                if !(lo[a] <= cell.lo[a] && cell.lo[a] <= cell.hi[a] && cell.hi[a] <= hi[a]) {
                    return refuse(format!("the box of cell {} is not inside the cell", cell.index));
                }
            }
            let ascending = cell.owners.windows(2).all(|w| w[0] < w[1]);
            if cell.owners.is_empty() || !ascending || cell.owners.iter().any(|&s| s >= splits) {
                return refuse(format!("the owners of cell {} are no ascending splits", cell.index));
            }
            dense[cell.index as usize] = cells.len() as u32;
            cells.push(Cell {
                lo: cell.lo,
                hi: cell.hi,
                first_owner: owners.len() as u32,
                owner_count: cell.owners.len() as u32,
            });
            owners.extend_from_slice(&cell.owners);
            cell.owners.iter().for_each(|&s| owning.insert(s));
        }
        if owners.len() > u32::MAX as usize {
            return refuse("too many owners".to_owned());
        }
        let mut grid = Grid { lattice, cells, owners, dense, owning, everywhere: Outside::default(), tight: true };
        grid.everywhere = grid.outside(&SplitSet::default());
        Ok(grid)
    }

    /// The same with all of each occupied cell for its box: to see what tight boxes save. Rays that are on their way through the one cannot go on
    /// through the other, as the order of cells is another.
    pub fn with_whole_cells(mut self) -> Grid {
        for (index, &number) in (0..).zip(&self.dense) {
            if let (Some(cell), Some(at)) = (self.cells.get_mut(number as usize), self.lattice.coordinates(index)) {
                (cell.lo, cell.hi) = self.lattice.cell_box_f32(at);
            }
        }
        self.tight = false;
        self.everywhere = self.outside(&SplitSet::default());
        self
    }

    /// Its geometry.
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// Number of occupied cells; a cell's number is its place among them by ascending index.
    pub fn occupied(&self) -> u32 {
        self.cells.len() as u32
    }

    /// Owners of an occupied cell by its number, ascending; none for a number that does not exist.
    pub fn owners(&self, cell: u32) -> &[u32] {
        self.cells.get(cell as usize).map_or(&[], |c| self.owners_of(c))
    }

    /// Tight box of an occupied cell by its number.
    pub fn bounds(&self, cell: u32) -> Option<([f32; 3], [f32; 3])> {
        self.cells.get(cell as usize).map(|c| (c.lo, c.hi))
    }

    /// The splits that own a cell: after overlap reduction some source splits own none.
    pub fn owning(&self) -> &SplitSet {
        &self.owning
    }

    /// What is outside of nothing: every occupied cell.
    pub fn everywhere(&self) -> &Outside {
        &self.everywhere
    }

    /// Whether no ray can ever need another split: every owner is resident. Ask once per resident set, and skip the
    /// walk when it is so.
    pub fn covered_by(&self, resident: &SplitSet) -> bool {
        self.owning.is_subset(resident)
    }

    /// The splits that share a cell with `split`, itself included, ascending: what the paper's system without overlap
    /// reduction loads together.
    pub fn sharing(&self, split: u32) -> Vec<u32> {
        let mut set = SplitSet::default();
        set.insert(split);
        for cell in &self.cells {
            let owners = self.owners_of(cell);
            if owners.binary_search(&split).is_ok() {
                owners.iter().for_each(|&s| set.insert(s));
            }
        }
        set.iter().collect()
    }

    fn owners_of(&self, cell: &Cell) -> &[u32] {
        let first = cell.first_owner as usize;
        &self.owners[first..first + cell.owner_count as usize]
    }
}
