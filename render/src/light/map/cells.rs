//! Which part of a sky's picture a sample comes from.
//!
//! Cells of 8 x 8 patches are chosen by their light: their tables lie in the second cache, where those of all patches lie in none. Most
//! cells are even enough that a direction in one is chosen evenly by solid angle; one that is not has tables of its own for its patches'
//! rows and columns. Probabilities are whole numbers of 2^-31, for the row and for the column, all the way down, so the
//! density that both sides of multiple importance sampling see is exact.

use super::choice::{Choice, Guide, WHOLE, before, choose, choose_few, ends};
use crate::memory::prefetch;
use crate::real::f32;

/// Patches along a cell's side.
pub(super) const SIDE: usize = 8;
/// A cell is even where the variance of its patches' light over its squared mean is at most this: the variance of an estimate by its samples
/// is higher by this part of itself at most.
pub(super) const EVEN: f64 = 1.0 / 16.0;

/// The tables.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Cells {
    /// Patches across and down.
    size: [usize; 2],
    /// Cells across.
    across: usize,
    /// Upper ends of the intervals of rows of cells; the last is [`WHOLE`].
    rows: Vec<u32>,
    /// The same of the cells in each row.
    columns: Vec<u32>,
    /// Where to look in `rows`, and in each row of `columns`.
    row_guide: Guide,
    column_guides: Guide,
    cells: Vec<Cell>,
    uneven: Vec<Uneven>,
    /// Cosine of the angle from the top, by upper edge of a row of patches.
    cosines: Vec<f64>,
    /// By row of patches: the density in solid angle of a patch that one pair of numbers of 2^62 chooses.
    density: Vec<f32>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Cell {
    /// Its density.
    Even(f32),
    /// Its place among the uneven ones.
    Uneven(u32),
}

/// Upper ends of the intervals of a cell's rows, in the numbers of its row of cells; and of the columns in each, in the cell's.
#[derive(Clone, Debug, PartialEq)]
struct Uneven {
    rows: [u32; SIDE],
    columns: [[u32; SIDE]; SIDE],
}

/// Where a sample lies.
#[derive(Clone, Copy, Debug)]
pub(in crate::light) struct Spot {
    /// In patches from the left.
    pub(in crate::light) x: f64,
    /// Cosine of the angle from the top.
    pub(in crate::light) cos: f64,
}

impl Cells {
    /// Of so many columns of patches; `cosines` are of the edges of rows from the top, `light` the mean luminance of a patch by column and row.
    pub(super) fn new(width: usize, cosines: Vec<f64>, light: impl Fn(usize, usize) -> f64) -> Cells {
        let size = [width, cosines.len() - 1];
        let [across, down] = size.map(|n| n.div_ceil(SIDE));
        let turns = 2.0 * std::f64::consts::PI / width as f64;
        let solid = |y: usize| turns * (cosines[y] - cosines[y + 1]);
        let span = |cell: usize, of: usize| cell * SIDE..((cell + 1) * SIDE).min(of);
        let (mut of_rows, mut columns) = (Vec::with_capacity(down), Vec::with_capacity(across * down));
        let mut row = vec![0.0; across];
        for cy in 0..down {
            for (cx, weight) in row.iter_mut().enumerate() {
                let of_row = |y| span(cx, size[0]).map(|x| light(x, y)).sum::<f64>() * solid(y);
                *weight = span(cy, size[1]).map(of_row).sum();
            }
            of_rows.push(row.iter().sum());
            columns.extend(ends(&row, WHOLE));
        }
        let rows = ends(&of_rows, WHOLE);
        let (mut cells, mut uneven) = (Vec::with_capacity(across * down), Vec::new());
        for cy in 0..down {
            let count = rows[cy] - before(&rows, cy);
            for cx in 0..across {
                let row = &columns[cy * across..][..across];
                let own = row[cx] - before(row, cx);
                let (xs, ys) = (span(cx, size[0]), span(cy, size[1]));
                let (mut sums, mut area) = ([0.0; 2], 0.0);
                for (x, y) in ys.clone().flat_map(|y| xs.clone().map(move |x| (x, y))) {
                    let l = light(x, y);
                    area += solid(y);
                    sums[0] += l * solid(y);
                    sums[1] += l * l * solid(y);
                }
                cells.push(if sums[1] * area <= (1.0 + EVEN) * sums[0] * sums[0] {
                    Cell::Even((f64::from(count) * f64::from(own) / PAIRS / area) as f32)
                } else {
                    let mut tables = Uneven { rows: [count; SIDE], columns: [[own; SIDE]; SIDE] };
                    let weights: Vec<Vec<f64>> =
                        ys.map(|y| xs.clone().map(|x| light(x, y) * solid(y)).collect()).collect();
                    let sums: Vec<f64> = weights.iter().map(|row| row.iter().sum()).collect();
                    tables.rows[..sums.len()].copy_from_slice(&ends(&sums, count));
                    for (ends_of, row) in tables.columns.iter_mut().zip(&weights) {
                        ends_of[..row.len()].copy_from_slice(&ends(row, own));
                    }
                    uneven.push(tables);
                    Cell::Uneven(uneven.len() as u32 - 1)
                });
            }
        }
        let density = (0..size[1]).map(|y| (1.0 / PAIRS / solid(y)) as f32).collect();
        let (row_guide, column_guides) = (Guide::new(&rows, down), Guide::new(&columns, across));
        Cells { size, across, rows, columns, row_guide, column_guides, cells, uneven, cosines, density }
    }

    /// Whether some direction is ever sampled.
    pub(super) fn shines(&self) -> bool {
        self.rows.last() == Some(&WHOLE)
    }

    /// A row of cells, by a number of 32 random bits.
    #[inline]
    pub(super) fn row(&self, number: u32) -> Choice {
        choose(&self.rows, self.row_guide.range(0, number >> 1), number >> 1)
    }

    /// A cell of the row, likewise.
    #[inline]
    pub(super) fn column(&self, row: &Choice, number: u32) -> Choice {
        let columns = &self.columns[row.at * self.across..][..self.across];
        choose(columns, self.column_guides.range(row.at, number >> 1), number >> 1)
    }

    /// Asks for what [`Cells::spot`] reads.
    #[inline]
    pub(super) fn foresee(&self, row: &Choice, column: &Choice) {
        prefetch(&self.cells[row.at * self.across + column.at]);
    }

    /// Asks for what [`Cells::density`] reads.
    #[inline]
    pub(super) fn foresee_density(&self, x: usize, y: usize) {
        prefetch(&self.cells[y / SIDE * self.across + x / SIDE]);
    }

    /// A place in the cell of a row and a column, by what is left of the numbers that chose them.
    #[inline]
    pub(super) fn spot(&self, row: &Choice, column: &Choice, numbers: [u32; 2]) -> Spot {
        let (left, top) = (column.at * SIDE, row.at * SIDE);
        let (x, y, columns, lines, along, down) = match self.cells[row.at * self.across + column.at] {
            Cell::Even(_) => {
                let [columns, lines] = [self.size[0] - left, self.size[1] - top].map(|n| n.min(SIDE));
                (left, top, columns, lines, column.within(numbers[1]), row.within(numbers[0]))
            }
            Cell::Uneven(at) => {
                let tables = &self.uneven[at as usize];
                let line = choose_few(&tables.rows, row.rest);
                let patch = choose_few(&tables.columns[line.at], column.rest);
                (left + patch.at, top + line.at, 1, 1, patch.within(numbers[1]), line.within(numbers[0]))
            }
        };
        let [above, below] = [y, y + lines].map(|y| self.cosines[y.min(self.size[1])]);
        Spot { x: x as f64 + along * columns as f64, cos: above + (below - above) * down }
    }

    /// Density in solid angle of what [`Cells::spot`] gives, in a patch.
    #[inline]
    pub(super) fn density(&self, x: usize, y: usize) -> f32 {
        match self.cells[y / SIDE * self.across + x / SIDE] {
            Cell::Even(density) => density,
            Cell::Uneven(at) => {
                let tables = &self.uneven[at as usize];
                let (x, row) = (x % SIDE, y % SIDE);
                let line = tables.rows[row] - before(&tables.rows, row);
                let patch = tables.columns[row][x] - before(&tables.columns[row], x);
                line as f32 * patch as f32 * self.density[y]
            }
        }
    }
}

/// Pairs of numbers that choose.
const PAIRS: f64 = WHOLE as f64 * WHOLE as f64;
