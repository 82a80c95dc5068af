//! What of a grid is not resident: asked on every ray's way, so it is laid out once for a resident set.

use super::boxes::Boxes;
use super::{EMPTY, Grid, SplitSet};

/// What of a grid lies outside a resident set; made by [`Grid::outside`], and good for that grid alone.
#[derive(Clone, Debug, Default)]
pub struct Outside {
    resident: SplitSet,
    /// A bit for each lattice index: whether an owner of the cell is not resident.
    cells: Vec<u64>,
    /// Around the boxes of these cells; inside out where there is none.
    pub(super) lo: [f32; 3],
    pub(super) hi: [f32; 3],
    /// The boxes themselves, where they are few.
    pub(super) boxes: Option<Boxes>,
}

impl Outside {
    /// The splits that it is outside of.
    pub fn resident(&self) -> &SplitSet {
        &self.resident
    }

    /// Whether every cell's owners are resident.
    pub fn is_empty(&self) -> bool {
        self.lo[0] > self.hi[0]
    }

    /// Whether the cell of a lattice index has an owner that is not resident.
    #[inline]
    pub(super) fn has(&self, index: u32) -> bool {
        self.cells[(index / 64) as usize] >> (index % 64) & 1 == 1
    }
}

impl Grid {
    /// What a ray that was tested against `resident` may still have to visit. Takes a bit for each lattice index, and a look at each.
    pub fn outside(&self, resident: &SplitSet) -> Outside {
        let mut cells = vec![0; self.dense.len().div_ceil(64)];
        let (mut lo, mut hi) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        let mut boxes = Vec::new();
        for (index, &number) in (0u32..).zip(&self.dense).filter(|(_, number)| **number != EMPTY) {
            let cell = &self.cells[number as usize];
            if self.owners_of(cell).iter().any(|&s| !resident.contains(s)) {
                cells[(index / 64) as usize] |= 1 << (index % 64);
                lo = std::array::from_fn(|a| lo[a].min(cell.lo[a]));
                hi = std::array::from_fn(|a| hi[a].max(cell.hi[a]));
                if boxes.len() <= Boxes::MOST {
                    boxes.push((self.lattice.coordinates(index).unwrap_or_default(), number, cell.lo, cell.hi));
                }
            }
        }
        Outside { resident: resident.clone(), cells, lo, hi, boxes: Boxes::new(boxes) }
    }
}
