//! Which cells of the chosen grid a split's primitives lie in, and which of them must be copied.

use super::records::Records;
use crate::grid::Lattice;
use crate::grid::count::{Box3, Counter, Occupied, RUN, box_of};
use crate::grid::lattice::{round_down, round_up};
use crate::grid::touch::{Bounds, sphere_cells, sphere_in_cell, triangle_cells, triangle_in_cell};

/// The occupied cells of the chosen subdivision. A cell's *number* is its place among them.
#[derive(Debug)]
pub(crate) struct ChosenCells {
    pub lattice: Lattice,
    /// Lattice index by number, ascending.
    pub indices: Vec<u32>,
    /// Primitives by number.
    pub primitives: Vec<u32>,
    /// Whether several splits claim the cell, by number.
    pub contested: Vec<bool>,
    /// What was counted, by number.
    pub counted: Vec<Occupied>,
    /// Number by lattice index; [`ABSENT`] where nothing is.
    numbers: Vec<u32>,
}

/// Not a number of a cell, group or split.
pub(crate) const ABSENT: u32 = u32::MAX;

impl ChosenCells {
    pub(crate) fn new(counter: &Counter) -> Self {
        let lattice = counter.lattice().clone();
        let mut cells = ChosenCells {
            numbers: vec![ABSENT; lattice.len()],
            lattice,
            indices: Vec::new(),
            primitives: Vec::new(),
            contested: Vec::new(),
            counted: counter.occupied().collect(),
        };
        for cell in &cells.counted {
            cells.numbers[cell.index as usize] = cells.indices.len() as u32;
            cells.indices.push(cell.index);
            cells.primitives.push(cell.primitives);
            cells.contested.push(cell.owners > 1);
        }
        cells
    }

    pub(crate) fn len(&self) -> usize {
        self.indices.len()
    }

    fn number(&self, at: [u32; 3]) -> usize {
        self.numbers[self.lattice.index(at) as usize] as usize
    }
}

/// Box of what is in a cell; empty when `lo > hi`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CellBox {
    pub lo: [f32; 3],
    pub hi: [f32; 3],
}

impl CellBox {
    pub(crate) const EMPTY: CellBox = CellBox { lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3] };

    pub(crate) fn is_empty(&self) -> bool {
        self.lo[0] > self.hi[0]
    }

    pub(crate) fn add(&mut self, other: &CellBox) {
        for a in 0..3 {
            self.lo[a] = self.lo[a].min(other.lo[a]);
            self.hi[a] = self.hi[a].max(other.hi[a]);
        }
    }

    pub(crate) fn from([lo, hi]: Box3) -> CellBox {
        CellBox { lo, hi }
    }

    fn outwards((lo, hi): Bounds) -> CellBox {
        CellBox { lo: lo.map(round_down), hi: hi.map(round_up) }
    }
}

/// What a split has to do with the grid.
#[derive(Debug)]
pub(crate) struct Incidence {
    /// Numbers of the cells that its primitives lie in, ascending, with the box of what of them is there.
    pub cells: Vec<(u32, CellBox)>,
    /// (triangle, group of copied cells), ascending, each once.
    pub triangles: Vec<(u32, u32)>,
    /// (sphere, group of copied cells), ascending, each once.
    pub spheres: Vec<(u32, u32)>,
    /// Primitives in at least one contested cell.
    pub contested: u64,
}

/// Finds the cells of a split's primitives. `groups` gives by cell number the group that a cell is copied with
/// ([`ABSENT`] if it stays); it is empty when nothing is copied.
pub(crate) fn incidence(cells: &ChosenCells, groups: &[u32], records: &Records) -> Incidence {
    let mut boxes = vec![CellBox::EMPTY; cells.len()];
    let mut out = Incidence { cells: Vec::new(), triangles: Vec::new(), spheres: Vec::new(), contested: 0 };
    let magnitude = cells.lattice.magnitude();
    let mut touched = Vec::new();
    for (first, run) in (0u32..).step_by(RUN).zip(records.triangles.chunks(RUN)) {
        let bounds = box_of(run.as_flattened());
        if let Some(at) = cells.lattice.only_cell(&bounds[0], &bounds[1]) {
            let number = cells.number(at);
            boxes[number].add(&CellBox::from(bounds));
            // a run is copied as its triangles are
            if cells.contested[number] {
                out.contested += run.len() as u64;
            }
            if let Some(&group) = groups.get(number).filter(|g| **g != ABSENT) {
                out.triangles.extend((first..).take(run.len()).map(|i| (i, group)));
            }
            continue;
        }
        for (i, p) in (first..).zip(run) {
            touched.clear();
            let bounds = box_of(p);
            if let Some(at) = cells.lattice.only_cell(&bounds[0], &bounds[1]) {
                let number = cells.number(at);
                touched.push(number);
                boxes[number].add(&CellBox::from(bounds));
            } else {
                let exact = p.map(|v| v.map(f64::from));
                triangle_cells(&cells.lattice, &exact, &mut |at| {
                    touched.push(cells.number(at));
                    if let Some(part) = triangle_in_cell(&exact, &cells.lattice.cell_box(at), magnitude) {
                        boxes[cells.number(at)].add(&CellBox::outwards(part));
                    }
                });
            }
            out.contested += u64::from(copy(cells, groups, &touched, i, &mut out.triangles));
        }
    }
    for (i, s) in records.spheres.iter().enumerate() {
        touched.clear();
        let (center, radius) = (s.center.map(f64::from), f64::from(s.radius));
        sphere_cells(&cells.lattice, center, radius, &mut |at| {
            touched.push(cells.number(at));
            if let Some(part) = sphere_in_cell(center, radius, &cells.lattice.cell_box(at)) {
                boxes[cells.number(at)].add(&CellBox::outwards(part));
            }
        });
        out.contested += u64::from(copy(cells, groups, &touched, i as u32, &mut out.spheres));
    }
    out.cells = (0..).zip(boxes).filter(|(_, b)| !b.is_empty()).collect();
    out
}

/// Notes the groups that a primitive must be copied into; whether any of its cells is contested.
fn copy(cells: &ChosenCells, groups: &[u32], touched: &[usize], primitive: u32, pairs: &mut Vec<(u32, u32)>) -> bool {
    let before = pairs.len();
    let mut contested = false;
    for &number in touched {
        contested |= cells.contested[number];
        if let Some(&group) = groups.get(number).filter(|g| **g != ABSENT) {
            pairs.push((primitive, group));
        }
    }
    if pairs.len() > before + 1 {
        pairs[before..].sort_unstable();
        let mut keep = before + 1;
        for i in before + 1..pairs.len() {
            if pairs[i] != pairs[keep - 1] {
                pairs[keep] = pairs[i];
                keep += 1;
            }
        }
        pairs.truncate(keep);
    }
    contested
}
