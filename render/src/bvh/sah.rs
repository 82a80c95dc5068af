//! A binary tree over boxes: top-down, binned surface area heuristic, boxes that are best in one leaf left together.
//!
//! Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007). The place of every node follows from
//! the sizes of the subtrees before it, and bounds are minima and maxima, so the tree is the same however the work was
//! divided. Of equal costs, as regular grids have many, the more even division wins.

use super::below::Below;
use super::binary::{BinaryNode, BinaryTree};
use super::cells::{self, Sorted, Upper};
use super::collapse::leaf_cost;
use super::divide::{Bounds, Halves, Item, divide, halve};
use super::layout::{Aabb, WIDTH};
use super::{Fork, join, wide};
use crate::memory::zeros;

/// What a tree is built over: 1 to 2^31 boxes, not inverted, with finite coordinates whose areas are finite.
pub(super) trait Boxes: Sync {
    /// How many.
    fn count(&self) -> usize;
    /// Those of some numbers, in order.
    fn of(&self, numbers: std::ops::Range<usize>) -> impl Iterator<Item = Aabb>;
    /// That of one.
    fn one(&self, number: usize) -> Aabb;
    /// A box around all.
    fn bounds(&self) -> Aabb;
}

impl Boxes for [Aabb] {
    fn count(&self) -> usize {
        self.len()
    }
    fn of(&self, numbers: std::ops::Range<usize>) -> impl Iterator<Item = Aabb> {
        self[numbers].iter().copied()
    }
    fn one(&self, number: usize) -> Aabb {
        self[number]
    }
    fn bounds(&self) -> Aabb {
        self.iter().fold(Aabb::EMPTY, |sum, aabb| sum.union(aabb))
    }
}

/// Below this many boxes a subtree is built by one thread.
const FORK_ABOVE: usize = 1 << 14;
/// Above this many, which no cache holds, the upper part is decided by cells.
const CELLS_ABOVE: usize = 1 << 20;
/// From this depth on, ranges are halved: bounds the recursion and the traversal stack.
const MAX_SAH_DEPTH: usize = 64;
/// No node lies deeper: 2^31 boxes can be halved 31 times.
const MAX_DEPTH: usize = MAX_SAH_DEPTH + 31;

/// Builds the tree. Up to `max_leaf` boxes, 1 to [`WIDTH`], are one leaf where that is expected to cost no more than any way to divide them.
pub(super) fn build<B: Boxes + ?Sized>(boxes: &B, max_leaf: u32, fork: &dyn Fork) -> BinaryTree {
    let count = boxes.count();
    assert!((1..=1 << 31).contains(&count), "1 to 2^31 boxes");
    let (mut items, mut order, top, buckets);
    if count > CELLS_ABOVE {
        Sorted { items, top, buckets, places: order } = cells::sort(boxes, 2 * FORK_ABOVE, fork);
    } else {
        (items, order, top) = (zeros(count), zeros(count), Upper::Bucket);
        buckets = vec![(count, fill(&mut items, boxes, 0, fork))];
    }
    let builder = Builder { max_leaf: max_leaf as usize, fork };
    let span = Span { items: &mut items, order: &mut order, first: 0 };
    let (bounds, below) = builder.upper(span, &top, &buckets, 0);
    BinaryTree::new(below.in_a_row(node(&bounds, count), bytemuck::cast_vec(items)), order)
}

/// Writes the boxes from number `first` on: their bounds.
fn fill<B: Boxes + ?Sized>(items: &mut [Item], boxes: &B, first: usize, fork: &dyn Fork) -> Bounds {
    if items.len() <= FORK_ABOVE {
        let mut bounds = Bounds::EMPTY;
        let numbers = first..first + items.len();
        for ((item, number), aabb) in items.iter_mut().zip(numbers.clone()).zip(boxes.of(numbers)) {
            *item = Item::new(&aabb, number as u32);
            bounds = bounds.min(item.bounds());
        }
        return bounds;
    }
    let half = items.len() / 2;
    let (left, right) = items.split_at_mut(half);
    let (a, b) = join(fork, || fill(left, boxes, first, fork), || fill(right, boxes, first + half, fork));
    a.min(b)
}

/// Boxes, and what becomes of them.
struct Span<'a> {
    items: &'a mut [Item],
    /// Their numbers, in the order in which they are left.
    order: &'a mut [u32],
    /// The first of their places. Where they were, nodes are then.
    first: usize,
}

impl<'a> Span<'a> {
    fn split(self, at: usize) -> (Span<'a>, Span<'a>) {
        let ((items, others), (order, rest)) = (self.items.split_at_mut(at), self.order.split_at_mut(at));
        (Span { items, order, first: self.first }, Span { items: others, order: rest, first: self.first + at })
    }
}

/// Builds what is below nodes, in parallel.
struct Builder<'a> {
    max_leaf: usize,
    fork: &'a dyn Fork,
}

impl Builder<'_> {
    /// What is below a node of the upper part, and the bounds of its boxes.
    fn upper(&self, span: Span, top: &Upper, buckets: &[(usize, Bounds)], depth: usize) -> (Bounds, Below) {
        let Upper::Halves(_, halves) = top else {
            let bounds = buckets[0].1;
            return (bounds, self.descend(span, bounds, depth));
        };
        let (first, second) = buckets.split_at(halves[0].buckets());
        let (left, right) = span.split(first.iter().map(|bucket| bucket.0).sum());
        let counts = [left.items.len(), right.items.len()];
        let ((left, a), (right, b)) = join(
            self.fork,
            || self.upper(left, &halves[0], first, depth + 1),
            || self.upper(right, &halves[1], second, depth + 1),
        );
        (left.min(right), Below::Halves(Box::new(([node(&left, counts[0]), node(&right, counts[1])], [a, b]))))
    }

    /// The same below a node of which nothing is known but its bounds.
    fn descend(&self, span: Span, bounds: Bounds, depth: usize) -> Below {
        let count = span.items.len();
        if count <= FORK_ABOVE || depth >= MAX_SAH_DEPTH {
            let Span { items, order, first } = span;
            let nodes = Vec::with_capacity(count);
            let mut subtree = Subtree { nodes, items: &mut *items, bounds, depth, max_leaf: self.max_leaf };
            wide::subtree(&mut subtree, &());
            let nodes = subtree.nodes;
            order.iter_mut().zip(&*items).for_each(|(to, item)| *to = item.number());
            let places: &mut [BinaryNode] = bytemuck::cast_slice_mut(items);
            return match places.get_mut(..nodes.len()) {
                Some(places) => {
                    places.copy_from_slice(&nodes);
                    Below::Nodes(first..first + nodes.len())
                }
                None => Below::Apart(nodes),
            };
        }
        let mut division = Division { items: &mut *span.items, halves: (0, Bounds::EMPTY, Bounds::EMPTY) };
        wide::divide(&mut division, &());
        let (at, left_bounds, right_bounds) = division.halves;
        let (left, right) = span.split(at);
        let (a, b) = join(
            self.fork,
            || self.descend(left, left_bounds, depth + 1),
            || self.descend(right, right_bounds, depth + 1),
        );
        Below::Halves(Box::new(([node(&left_bounds, at), node(&right_bounds, count - at)], [a, b])))
    }
}

/// A node, a leaf so far.
#[inline(always)]
fn node(bounds: &Bounds, count: usize) -> BinaryNode {
    BinaryNode { aabb: bounds.aabb(), child: 0, count: count as u32 }
}

/// Boxes to be divided, and then their halves.
pub(super) struct Division<'a> {
    items: &'a mut [Item],
    halves: Halves,
}

impl Division<'_> {
    #[inline(always)]
    pub(super) fn run(&mut self, _: &()) {
        self.halves = divide(self.items);
    }
}

/// Boxes, and then the nodes below that of all of them.
pub(super) struct Subtree<'a> {
    items: &'a mut [Item],
    bounds: Bounds,
    nodes: Vec<BinaryNode>,
    /// Of the node of all.
    depth: usize,
    max_leaf: usize,
}

/// A node whose descendants are to be built.
#[derive(Clone, Copy)]
struct Pending {
    bounds: Bounds,
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
        let mut pending = Pending { bounds: self.bounds, first: 0, count, at: ROOT, depth: self.depth };
        // what is to the right of the way from the root to where it is
        let mut stack = [pending; MAX_DEPTH];
        let mut waiting = 0;
        loop {
            if pending.count <= self.max_leaf {
                self.few(pending);
            } else {
                let Pending { first, count, at: parent, depth, .. } = pending;
                let items = &mut self.items[first..first + count];
                let (at, left, right) = if depth >= MAX_SAH_DEPTH { halve(items) } else { divide(items) };
                let pair = self.push(parent, [node(&left, at), node(&right, count - at)]);
                let depth = depth + 1;
                stack[waiting] = Pending { bounds: right, first: first + at, count: count - at, at: pair + 1, depth };
                waiting += usize::from(count - at > 1);
                if at > 1 {
                    pending = Pending { bounds: left, first, count: at, at: pair, depth };
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
            let Pending { first, count, depth, .. } = all[i];
            if count > 1 {
                let items = &mut self.items[first..first + count];
                let (at, left, right) = if depth >= MAX_SAH_DEPTH { halve(items) } else { divide(items) };
                let depth = depth + 1;
                all[len] = Pending { bounds: left, first, count: at, at: 0, depth };
                all[len + 1] = Pending { bounds: right, first: first + at, count: count - at, at: 0, depth };
                children[i] = len;
                len += 2;
            }
            i += 1;
        }
        // then from below: what is cheaper as one leaf
        let mut costs = [0.0; MOST];
        for i in (0..len).rev() {
            costs[i] = leaf_cost(all[i].bounds.aabb().half_area(), all[i].count as u32);
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
                let pair = self.push(at, [node(&a.bounds, a.count), node(&b.bounds, b.count)]);
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
    use super::super::testing::random_boxes;
    use super::*;
    use crate::testing::Rng;

    fn boxes(n: usize) -> Vec<Aabb> {
        random_boxes(&mut Rng(1), n, 0.3)
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
                let bounds = fill(&mut items, &boxes(n)[..], 0, &Serial);
                let mut others = items.clone();
                let subtree = |items| Subtree { items, bounds, nodes: Vec::new(), depth: 0, max_leaf };
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
