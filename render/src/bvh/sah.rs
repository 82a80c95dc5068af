//! A binary tree over boxes: top-down, binned surface area heuristic, boxes that are best in one leaf left together.
//!
//! Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007). The place of every node follows from
//! the sizes of the subtrees before it, and bounds are minima and maxima, so the tree is the same however the work was
//! divided. Of equal costs, as regular grids have many, the more even division wins.

use super::binary::{BinaryNode, BinaryTree};
use super::collapse::leaf_cost;
use super::divide::{Halves, Item, Range, divide, halve};
use super::layout::{Aabb, WIDTH};
use super::{Fork, wide};
use crate::memory::zeros;

/// What a tree is built over: 1 to 2^31 boxes, not inverted, with finite coordinates whose areas are finite.
pub(super) trait Boxes: Sync {
    /// How many.
    fn count(&self) -> usize;
    /// Those of some numbers, in order.
    fn of(&self, numbers: std::ops::Range<usize>) -> impl Iterator<Item = Aabb>;
}

impl Boxes for [Aabb] {
    fn count(&self) -> usize {
        self.len()
    }
    fn of(&self, numbers: std::ops::Range<usize>) -> impl Iterator<Item = Aabb> {
        self[numbers].iter().copied()
    }
}

/// Below this many boxes a subtree is built by one thread.
const FORK_ABOVE: usize = 1 << 14;
/// From this depth on, ranges are halved: bounds the recursion and the traversal stack.
const MAX_SAH_DEPTH: usize = 64;
/// No node lies deeper: 2^31 boxes can be halved 31 times.
const MAX_DEPTH: usize = MAX_SAH_DEPTH + 31;

/// Builds the tree. Up to `max_leaf` boxes, 1 to [`WIDTH`], are one leaf where that is expected to cost no more than any way to divide them.
pub(super) fn build<B: Boxes + ?Sized>(boxes: &B, max_leaf: u32, fork: &dyn Fork) -> BinaryTree {
    let count = boxes.count();
    assert!((1..=1 << 31).contains(&count), "1 to 2^31 boxes");
    let mut items: Vec<Item> = zeros(count);
    let range = fill(&mut items, boxes, 0, fork);
    let below = descend(&mut items, range, 0, max_leaf as usize, fork);
    let mut nodes: Vec<BinaryNode> = zeros(1 + below.len());
    nodes[0] = BinaryNode { aabb: range.aabb(), child: u32::from(below.len() > 0), count: count as u32 };
    below.write(&mut nodes[1..], fork);
    let mut order = zeros(count);
    numbers(&items, &mut order, fork);
    BinaryTree::new(nodes, order)
}

/// Writes the numbers of some boxes.
fn numbers(items: &[Item], out: &mut [u32], fork: &dyn Fork) {
    if items.len() <= FORK_ABOVE {
        return out.iter_mut().zip(items).for_each(|(to, item)| *to = item.number());
    }
    let (left, right) = items.split_at(items.len() / 2);
    let (a, b) = out.split_at_mut(left.len());
    fork.join(&mut || numbers(left, a, fork), &mut || numbers(right, b, fork));
}

/// Writes the boxes from number `first` on: their bounds.
fn fill<B: Boxes + ?Sized>(items: &mut [Item], boxes: &B, first: usize, fork: &dyn Fork) -> Range {
    if items.len() <= FORK_ABOVE {
        let mut range = Range::EMPTY;
        let numbers = first..first + items.len();
        for ((item, number), aabb) in items.iter_mut().zip(numbers.clone()).zip(boxes.of(numbers)) {
            *item = Item::new(&aabb, number as u32);
            range = range.with(item);
        }
        return range;
    }
    let half = items.len() / 2;
    let (left, right) = items.split_at_mut(half);
    let (mut a, mut b) = (Range::EMPTY, Range::EMPTY);
    fork.join(&mut || a = fill(left, boxes, first, fork), &mut || b = fill(right, boxes, first + half, fork));
    a.and(&b)
}

/// What is below a node, before it is known where all of it is to be.
enum Below {
    /// Of few boxes: as it will be; nothing below a leaf.
    Nodes(Vec<BinaryNode>),
    /// The children, and what is below them.
    Halves(Box<([BinaryNode; 2], [Below; 2])>),
}

impl Below {
    /// How many nodes.
    fn len(&self) -> usize {
        match self {
            Below::Nodes(nodes) => nodes.len(),
            Below::Halves(halves) => 2 + halves.1.iter().map(Below::len).sum::<usize>(),
        }
    }

    /// Moves them to where they are to be.
    fn write(self, out: &mut [BinaryNode], fork: &dyn Fork) {
        match self {
            Below::Nodes(nodes) => out.copy_from_slice(&nodes),
            Below::Halves(halves) => {
                let (mut pair, [first, second]) = *halves;
                let (children, rest) = out.split_at_mut(2);
                let (below_first, below_second) = rest.split_at_mut(first.len());
                let far = |below: &[BinaryNode], distance: usize| if below.is_empty() { 0 } else { distance as u32 };
                pair[0].child = far(below_first, 2);
                pair[1].child = far(below_second, 1 + below_first.len());
                children.copy_from_slice(&pair);
                let (mut first, mut second) = (Some(first), Some(second));
                fork.join(
                    &mut || first.take().into_iter().for_each(|below| below.write(below_first, fork)),
                    &mut || second.take().into_iter().for_each(|below| below.write(below_second, fork)),
                );
            }
        }
    }
}

/// Builds what is below a node of these items, in parallel.
fn descend(items: &mut [Item], range: Range, depth: usize, max_leaf: usize, fork: &dyn Fork) -> Below {
    if items.len() <= FORK_ABOVE || depth >= MAX_SAH_DEPTH {
        let mut subtree = Subtree { nodes: Vec::with_capacity(items.len()), items, range, depth, max_leaf };
        wide::subtree(&mut subtree, &());
        return Below::Nodes(subtree.nodes);
    }
    let mut division = Division { items, range, halves: (0, Range::EMPTY, Range::EMPTY) };
    wide::divide(&mut division, &());
    let (at, left_range, right_range) = division.halves;
    let (left, right) = items.split_at_mut(at);
    let pair = [node(&left_range, left.len()), node(&right_range, right.len())];
    let mut below = [Below::Nodes(Vec::new()), Below::Nodes(Vec::new())];
    let [a, b] = &mut below;
    fork.join(&mut || *a = descend(left, left_range, depth + 1, max_leaf, fork), &mut || {
        *b = descend(right, right_range, depth + 1, max_leaf, fork)
    });
    Below::Halves(Box::new((pair, below)))
}

/// A node, a leaf so far.
#[inline(always)]
fn node(range: &Range, count: usize) -> BinaryNode {
    BinaryNode { aabb: range.aabb(), child: 0, count: count as u32 }
}

/// Boxes to be divided, and then their halves.
pub(super) struct Division<'a> {
    items: &'a mut [Item],
    range: Range,
    halves: Halves,
}

impl Division<'_> {
    #[inline(always)]
    pub(super) fn run(&mut self, _: &()) {
        self.halves = divide(self.items, &self.range);
    }
}

/// Boxes, and then the nodes below that of all of them.
pub(super) struct Subtree<'a> {
    items: &'a mut [Item],
    range: Range,
    nodes: Vec<BinaryNode>,
    /// Of the node of all.
    depth: usize,
    max_leaf: usize,
}

/// A node whose descendants are to be built.
#[derive(Clone, Copy)]
struct Pending {
    range: Range,
    first: usize,
    count: usize,
    /// Where it is among the nodes.
    at: usize,
    depth: usize,
}

/// `at` of the node of all boxes, which is not among them.
const ROOT: usize = usize::MAX;

impl Subtree<'_> {
    #[inline(always)]
    pub(super) fn run(&mut self, _: &()) {
        let count = self.items.len();
        let mut pending = Pending { range: self.range, first: 0, count, at: ROOT, depth: self.depth };
        // what is to the right of the way from the root to where it is
        let mut stack = [pending; MAX_DEPTH];
        let mut waiting = 0;
        loop {
            if pending.count <= self.max_leaf {
                self.few(pending);
            } else {
                let Pending { range, first, count, at: parent, depth } = pending;
                let items = &mut self.items[first..first + count];
                let (at, left, right) = if depth >= MAX_SAH_DEPTH { halve(items) } else { divide(items, &range) };
                let pair = self.push(parent, [node(&left, at), node(&right, count - at)]);
                let depth = depth + 1;
                stack[waiting] = Pending { range: right, first: first + at, count: count - at, at: pair + 1, depth };
                waiting += usize::from(count - at > 1);
                if at > 1 {
                    pending = Pending { range: left, first, count: at, at: pair, depth };
                    continue;
                }
            }
            if waiting == 0 {
                return;
            }
            waiting -= 1;
            pending = stack[waiting];
        }
    }

    /// Appends the children of a node: where they are.
    #[inline(always)]
    fn push(&mut self, parent: usize, pair: [BinaryNode; 2]) -> usize {
        let at = self.nodes.len();
        if parent != ROOT {
            self.nodes[parent].child = (at - parent) as u32;
        }
        self.nodes.extend(pair);
        at
    }

    /// Builds what is below a node of so few boxes that they may share a leaf, if they are not to.
    #[inline(always)]
    fn few(&mut self, top: Pending) {
        const MOST: usize = 2 * WIDTH - 1;
        // all the way down first, children after their parents
        let mut all = [top; MOST];
        let mut children = [0; MOST];
        let (mut len, mut i) = (1, 0);
        while i < len {
            let Pending { range, first, count, depth, .. } = all[i];
            if count > 1 {
                let items = &mut self.items[first..first + count];
                let (at, left, right) = if depth >= MAX_SAH_DEPTH { halve(items) } else { divide(items, &range) };
                let depth = depth + 1;
                all[len] = Pending { range: left, first, count: at, at: 0, depth };
                all[len + 1] = Pending { range: right, first: first + at, count: count - at, at: 0, depth };
                children[i] = len;
                len += 2;
            }
            i += 1;
        }
        // then from below: what is cheaper as one leaf
        let mut costs = [0.0; MOST];
        for i in (0..len).rev() {
            costs[i] = leaf_cost(all[i].range.aabb().half_area(), all[i].count as u32);
            let child = children[i];
            if child > 0 {
                let apart = costs[child] + costs[child + 1];
                if costs[i] <= apart { children[i] = 0 } else { costs[i] = apart }
            }
        }
        let mut stack = [(0, top.at); WIDTH];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let (i, at) = stack[waiting];
            let child = children[i];
            if child > 0 {
                let [a, b] = [&all[child], &all[child + 1]];
                let pair = self.push(at, [node(&a.range, a.count), node(&b.range, b.count)]);
                stack[waiting] = (child + 1, pair + 1);
                stack[waiting + 1] = (child, pair);
                waiting += 2;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Serial;
    use super::*;
    use crate::testing::Rng;

    fn boxes(n: usize) -> Vec<Aabb> {
        let mut rng = Rng(1);
        let one = |_| {
            let (p, size) = (rng.vec3(10.0), rng.vec3(0.3).abs());
            Aabb { lo: (p - size).to_array(), hi: (p + size).to_array() }
        };
        (0..n).map(one).collect()
    }

    fn bits(nodes: &[BinaryNode]) -> Vec<[u32; 8]> {
        let of = |n: &BinaryNode| {
            let [a, b, c] = n.aabb.lo.map(f32::to_bits);
            let [d, e, f] = n.aabb.hi.map(f32::to_bits);
            [a, b, c, d, e, f, n.child, n.count]
        };
        nodes.iter().map(of).collect()
    }

    #[test]
    fn vectors_make_the_same_tree() {
        for max_leaf in [1, WIDTH] {
            for n in [1, 2, 8, 9, 300, 5000] {
                let mut items = vec![Item::new(&Aabb::EMPTY, 0); n];
                let range = fill(&mut items, &boxes(n)[..], 0, &Serial);
                let mut others = items.clone();
                let subtree = |items| Subtree { items, range, nodes: Vec::new(), depth: 0, max_leaf };
                let mut plain = subtree(&mut items);
                plain.run(&());
                let mut wide = subtree(&mut others);
                wide::subtree(&mut wide, &());
                assert_eq!(bits(&plain.nodes), bits(&wide.nodes));
                assert!(items.iter().map(Item::number).eq(others.iter().map(Item::number)));
            }
        }
    }

    /// Parts that are built apart lie as they would if one had built all of it: what is below a node is one row.
    #[test]
    fn what_is_below_a_node_lies_in_a_row() {
        let boxes = boxes(3 * FORK_ABOVE);
        let tree = build(&boxes[..], WIDTH as u32, &Serial);
        let mut next = 1;
        let mut parts = vec![tree.root()];
        let mut found = vec![false; boxes.len()];
        while let Some(part) = parts.pop() {
            let node = tree.node(part);
            if node.is_leaf() {
                tree.boxes(part).iter().for_each(|&n| found[n as usize] = true);
                assert!(node.count as usize <= WIDTH);
                continue;
            }
            let (a, b) = tree.halves(part);
            assert_eq!((a.node, b.node), (next, next + 1));
            next += 2;
            parts.extend([b, a]);
        }
        assert_eq!(next as usize, tree.nodes.len());
        assert!(found.iter().all(|&f| f));
    }
}
