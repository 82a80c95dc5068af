//! Overlap reduction: which contested cells are copied together.
//!
//! Every contested cell is copied as a whole, and so are the cells that a split would be left with when they hold less than
//! an eighth of it: a whole split is not kept, placed and loaded for them (the paper keeps it). It is done so that afterwards each cell has one owner that holds all of its primitives. The
//! splits they came from are not rewritten: only the contested share of the scene moves.
//!
//! In two steps, as the number of *distinct* primitives in several cells is known only from the primitives. First, cells
//! in Morton order are put in *groups* that hold an eighth of a split or less, and the primitives are dealt to groups
//! while splits are built. Then groups are joined, in the same order, as long as their distinct primitives fit a split. So a copied
//! split is filled to seven eighths or more (but the last), and its cells are neighbours.
//!
//! A cell that alone has more primitives than a split holds becomes a split of its own, larger than asked for: one
//! owner must hold it. Condition 1 makes that rare; it remains where many primitives meet in one point.

use crate::grid::Lattice;
use crate::grid::count::Occupied;

/// Bits of a cell's coordinates, x lowest, interleaved: cells that are close are mostly close in this order.
pub fn morton(at: [u32; 3]) -> u32 {
    // coordinates are below 2^10
    let spread = |x: u32| {
        let x = x & 0x3ff;
        let x = (x | x << 16) & 0x0300_00ff;
        let x = (x | x << 8) & 0x0300_f00f;
        let x = (x | x << 4) & 0x030c_30c3;
        (x | x << 2) & 0x0924_9249
    };
    spread(at[0]) | spread(at[1]) << 1 | spread(at[2]) << 2
}

/// Groups of cells that are copied, in Morton order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Groups {
    /// Group by cell number; `u32::MAX` for a cell that is not copied.
    pub of_cell: Vec<u32>,
    /// Number of groups.
    pub count: u32,
}

/// The cells to be copied, by cell number: contested ones, and those of splits (`sizes` has their primitives) that would be
/// left with less than an eighth.
pub fn copied(cells: &[Occupied], sizes: &[u64]) -> Vec<bool> {
    // a primitive counts in each of its cells: that errs towards keeping a split
    let mut kept = vec![0; sizes.len()];
    for cell in cells.iter().filter(|c| c.owners == 1) {
        kept[cell.last_owner as usize] += u64::from(cell.primitives);
    }
    let leaves = |split: usize| kept[split] * 8 < sizes[split];
    cells.iter().map(|c| c.owners > 1 || leaves(c.last_owner as usize)).collect()
}

/// Puts cells that are copied in groups. By cell number: lattice index, primitives, whether it is copied; `capacity` is
/// what a copied split holds.
pub fn group(lattice: &Lattice, indices: &[u32], primitives: &[u32], copied: &[bool], capacity: u64) -> Groups {
    let mut order: Vec<(u32, usize)> = (0..indices.len())
        .filter(|&n| copied[n])
        .filter_map(|n| lattice.coordinates(indices[n]).map(|at| (morton(at), n)))
        .collect();
    order.sort_unstable();
    let most = capacity.div_ceil(8);
    let mut of_cell = vec![u32::MAX; indices.len()];
    let (mut count, mut filled) = (0, 0);
    for (_, n) in order {
        let size = u64::from(primitives[n]);
        if count == 0 || filled + size > most {
            count += 1;
            filled = 0;
        }
        filled += size;
        of_cell[n] = count - 1;
    }
    Groups { of_cell, count }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn morton_interleaves() {
        for at in [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [257, 256, 257], [5, 200, 77]] {
            let mut slow = 0;
            for bit in 0..9 {
                for (a, x) in at.iter().enumerate() {
                    slow |= (x >> bit & 1) << (3 * bit + a as u32);
                }
            }
            assert_eq!(morton(at), slow, "{at:?}");
        }
    }

    #[test]
    fn a_split_gives_up_its_last_cells_when_they_are_few() {
        let cell = |primitives, owners, last_owner| Occupied { index: 0, primitives, owners, last_owner };
        let cells = [cell(90, 2, 1), cell(6, 1, 0), cell(6, 1, 0), cell(13, 1, 1), cell(100, 1, 2)];
        assert_eq!(copied(&cells, &[100, 100, 100]), [true, true, true, false, false]);
        assert_eq!(copied(&cells, &[96, 105, 100]), [true, false, false, true, false]);
    }

    #[test]
    fn groups_hold_an_eighth_and_follow_the_curve() {
        let lattice = Lattice::new(4, [0.0; 3], [1.0; 3]).unwrap();
        let indices: Vec<u32> = (0..64).collect();
        let contested: Vec<bool> = (0..64).map(|i| i % 3 != 0).collect();
        let primitives: Vec<u32> = (0..64).map(|i| if i == 10 { 1000 } else { 7 }).collect();
        let groups = group(&lattice, &indices, &primitives, &contested, 8 * 20);
        let mut sizes = vec![0; groups.count as usize];
        let mut last = 0;
        let mut order: Vec<usize> = (0..64).collect();
        order.sort_by_key(|&n| morton(lattice.coordinates(n as u32).unwrap()));
        for n in order {
            assert_eq!(contested[n], groups.of_cell[n] != u32::MAX);
            if contested[n] {
                assert!(groups.of_cell[n] >= last);
                last = groups.of_cell[n];
                sizes[last as usize] += primitives[n];
            }
        }
        assert!(sizes.iter().all(|&s| s > 0 && (s <= 20 || s == 1000)), "{sizes:?}");
        assert_eq!(sizes.iter().filter(|&&s| s == 1000).count(), 1);
    }
}
