//! The tree over the blocks of a forest: opened into their upper nodes and put together anew.
//!
//! Benthin, Woop, Wald, Afra, "Improved Two-Level BVHs using Partial Re-Braiding" (2017): where blocks overlap, a tree over
//! their roots alone would send most rays through all of them. The largest nodes of each block are replaced by their
//! children until there are [`ENTRIES`] of them, and the tree is built over these. It consists of ordinary nodes.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use super::check::Tree;
use super::collapse::{Content, Plan};
use super::layout::*;
use super::reinsert::improved;
use super::{Serial, boxes};

/// Entries that a block is opened into, at most: slabs that overlap along a whole axis then cost some per cent.
const ENTRIES: usize = 512;

/// A node or leaf of a block.
#[derive(Clone, Copy)]
struct Entry {
    aabb: Aabb,
    reference: u32,
    /// Stack entries of the block's tree: those below this are no more.
    stack: usize,
}

impl Entry {
    fn is_node(&self) -> bool {
        self.reference & LEAF == 0
    }
}

// the largest first; of equal ones the one further ahead in the arena
impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        let area = |e: &Entry| if e.is_node() { e.aabb.half_area() } else { -1.0 };
        area(self).total_cmp(&area(other)).then(other.reference.cmp(&self.reference))
    }
}
impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Entry {}

/// A top tree, in bytes that are still to be placed.
pub(super) struct Top {
    entries: Vec<Entry>,
}

impl Top {
    /// Opens the trees, two at least, which lie in the arena.
    pub fn open(arena: &[u8], trees: &[Tree]) -> Top {
        let mut entries = Vec::new();
        for tree in trees {
            let root = Entry { aabb: tree.aabb, reference: node_ref(tree.root), stack: tree.stack };
            let mut heap = BinaryHeap::from([root]);
            while heap.len() + WIDTH <= ENTRIES && heap.peek().is_some_and(Entry::is_node) {
                let largest = heap.pop().expect("not empty");
                for slot in 0..WIDTH {
                    let (aabb, reference) = read_slot(arena, offset(largest.reference), slot);
                    if reference != 0 {
                        heap.push(Entry { aabb, reference, stack: tree.stack });
                    }
                }
            }
            entries.extend(heap.into_sorted_vec());
        }
        Top { entries }
    }

    /// Builds the tree in bytes that `place` provides: given their number, a part of the arena and its offset. Returns the
    /// tree; `None` when `place` has no room.
    pub fn build<'a>(&self, place: impl FnOnce(usize) -> Option<(&'a mut [u8], usize)>) -> Option<Tree> {
        let boxes: Vec<Aabb> = self.entries.iter().map(|e| e.aabb).collect();
        let binary = improved(boxes::build(&boxes), 1);
        let plan = Plan::new(&binary, self, &Serial);
        let (out, at) = place(plan.bytes)?;
        let aabb = plan.write(out, at);
        Some(Tree { root: at, aabb, stack: plan.stack })
    }
}

/// A leaf of the top tree is one entry, and its record is what the block already has.
impl Content for Top {
    fn max_leaf(&self) -> u32 {
        1
    }
    fn leaf_bytes(&self, _: &[u32]) -> usize {
        0
    }
    fn stack_below(&self, boxes: &[u32]) -> usize {
        boxes.iter().map(|&i| self.entries[i as usize].stack).max().unwrap_or(0)
    }
    fn write_leaf(&self, boxes: &[u32], _: &mut [u8], _: usize) -> u32 {
        self.entries[boxes[0] as usize].reference
    }
}
