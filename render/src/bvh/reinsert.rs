//! A binary tree made cheaper: its largest subtrees are put where they cost least.
//!
//! A tree that is divided from above keeps what its first planes decided: in a room, upper nodes that hold banisters and lamps besides a
//! wall are larger than they need be. Here each of the largest subtrees is taken out and put beside the node where the areas of all inner
//! nodes sum to least (Bittner, Hapala, Havran, "Fast Insertion-Based Optimization of Bounding Volume Hierarchies", 2013; the search
//! for the place as in Meister, Bittner, "Parallel Reinsertion for Bounding Volume Hierarchy Optimization", 2018, section 3.2, but one
//! subtree after the other, so that each sees where those before it went and the tree is the same on any number of threads).
//!
//! Only nodes near the root are looked at, a fixed number whatever the tree's size: they are what most rays visit. On a staircase of
//! 262,661 triangles that is within a percent of what all nodes gain, in a twentieth of the time.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::binary::{BinaryTree, Part};
use super::layout::Aabb;

/// Inner nodes that may change: the largest.
const NODES: usize = 4096;
/// How often each is tried; a fourth time gains some tenths of a percent.
const PASSES: usize = 3;
/// Deeper trees are not kept: what walks them is recursive, and so is the traversal's stack bound. [`super::sah`] makes none.
const MAX_DEPTH: usize = 96;

/// The same boxes in a tree of at most the same cost. Up to `max_leaf` boxes may share a leaf; those that did in the tree still do.
pub(super) fn improved(tree: BinaryTree, max_leaf: u32) -> BinaryTree {
    let mut upper = Upper::of(&tree, NODES);
    let mut moved = false;
    for _ in 0..PASSES {
        moved |= upper.reinsert_all();
    }
    if moved { upper.on(tree, max_leaf) } else { tree }
}

/// The upper part of a tree. Node 0 is the root, two children are neighbours, those of the largest node come first.
struct Upper {
    nodes: Vec<Node>,
}

#[derive(Clone, Copy)]
struct Node {
    aabb: Aabb,
    /// Half the surface area.
    area: f32,
    /// The first child; [`NONE`] where the upper part ends.
    child: u32,
    /// [`NONE`] of the root.
    parent: u32,
    /// Where the upper part ends: the node of the whole tree.
    whole: u32,
    /// And where its boxes begin in that tree's order.
    first: u32,
}

const NONE: u32 = u32::MAX;

impl Upper {
    /// The largest inner nodes of a tree, at most so many, and their children.
    fn of(tree: &BinaryTree, most: usize) -> Upper {
        let made = |whole: u32, first: u32, parent: u32| {
            let aabb = tree.nodes[whole as usize].aabb;
            Node { aabb, area: aabb.half_area(), child: NONE, parent, whole, first }
        };
        let mut nodes = vec![made(0, 0, NONE)];
        // the largest first, of equal ones the first; areas are not negative, so that their bits order as they do
        let open_of = |area: f32, node: usize| (area.to_bits(), Reverse(node as u32));
        let mut open = BinaryHeap::from([open_of(nodes[0].area, 0)]);
        let mut opened = 0;
        while opened < most
            && let Some((_, Reverse(node))) = open.pop()
        {
            let Node { whole, first, .. } = nodes[node as usize];
            if tree.nodes[whole as usize].is_leaf() {
                continue;
            }
            let child = tree.child(whole);
            opened += 1;
            nodes[node as usize].child = nodes.len() as u32;
            let second = first + tree.nodes[child as usize].count;
            for (whole, first) in [(child, first), (child + 1, second)] {
                let new = made(whole, first, node);
                open.push(open_of(new.area, nodes.len()));
                nodes.push(new);
            }
        }
        Upper { nodes }
    }

    fn node(&self, n: u32) -> &Node {
        &self.nodes[n as usize]
    }
    fn sibling(&self, n: u32) -> u32 {
        let first = self.node(self.node(n).parent).child;
        if n == first { first + 1 } else { first }
    }

    /// Puts every node where it costs least, the largest first; whether any was moved.
    fn reinsert_all(&mut self) -> bool {
        let mut order: Vec<u32> = (1..self.nodes.len() as u32).collect();
        order.sort_by(|&a, &b| self.node(b).area.total_cmp(&self.node(a).area));
        let mut stack = Vec::new();
        let mut moved = false;
        for n in order {
            if let Some((to, _)) = self.best_place(n, &mut stack) {
                self.reinsert(n, to);
                moved = true;
            }
        }
        moved
    }

    /// Beside which node `n` saves most area, and how much; none if it is best where it is. `stack` is empty, and is so again.
    ///
    /// From its parent upwards, the other side of each ancestor is searched as far as that can be better than the best so far: what is
    /// put below a node widens it, and adds a node at least as large as `n`.
    fn best_place(&self, n: u32, stack: &mut Vec<(f32, u32)>) -> Option<(u32, f32)> {
        let Node { aabb, area, parent, .. } = *self.node(n);
        let sibling = self.sibling(n);
        // what is saved without it: its parent, and what the ancestors up to `pivot` shrink by
        let mut saved = self.node(parent).area;
        let (mut best, mut to) = (0.0, None);
        let (mut pivot, mut other, mut without) = (parent, sibling, self.node(sibling).aabb);
        loop {
            stack.push((saved, other));
            while let Some((saved, at)) = stack.pop() {
                if saved - area <= best {
                    continue;
                }
                let node = self.node(at);
                let gain = saved - node.aabb.union(&aabb).half_area();
                if gain > best && at != sibling {
                    (best, to) = (gain, Some(at));
                }
                if node.child != NONE {
                    let below = gain + node.area;
                    stack.extend([(below, node.child), (below, node.child + 1)]);
                }
            }
            if pivot != parent {
                without = without.union(&self.node(other).aabb);
                saved += self.node(pivot).area - without.half_area();
            }
            if pivot == 0 {
                return to.map(|to| (to, best));
            }
            (other, pivot) = (self.sibling(pivot), self.node(pivot).parent);
        }
    }

    /// Takes out `n` and puts it beside `to`, which is none of its ancestors, not below it and not its sibling.
    fn reinsert(&mut self, n: u32, to: u32) {
        let (parent, sibling) = (self.node(n).parent, self.sibling(n));
        let (pair, moved) = (self.node(parent).child, *self.node(n));
        // the sibling takes the parent's place, so that the pair is free
        self.put(parent, *self.node(sibling));
        if parent != 0 {
            self.refit(self.node(parent).parent);
        }
        self.put(pair, *self.node(to));
        self.put(pair + 1, moved);
        self.nodes[to as usize].child = pair;
        self.nodes[pair as usize].parent = to;
        self.nodes[pair as usize + 1].parent = to;
        self.refit(to);
    }

    /// Makes a node what another is, but for its parent.
    fn put(&mut self, at: u32, node: Node) {
        let parent = self.node(at).parent;
        self.nodes[at as usize] = Node { parent, ..node };
        if node.child != NONE {
            self.nodes[node.child as usize].parent = at;
            self.nodes[node.child as usize + 1].parent = at;
        }
    }

    /// Bounds of a node with children and of all above it.
    fn refit(&mut self, mut n: u32) {
        while n != NONE {
            let child = self.node(n).child;
            let aabb = self.node(child).aabb.union(&self.node(child + 1).aabb);
            let node = &mut self.nodes[n as usize];
            (node.aabb, node.area) = (aabb, aabb.half_area());
            n = node.parent;
        }
    }

    /// The whole tree with this upper part in place of its own; as it was if it would be too deep.
    fn on(&self, mut tree: BinaryTree, max_leaf: u32) -> BinaryTree {
        let mut counts = vec![0; self.nodes.len()];
        if self.count(&tree, 0, 0, &mut counts) <= MAX_DEPTH {
            let root = tree.add_upper(1);
            self.write(&mut tree, &counts, (0, root), max_leaf);
        }
        tree
    }

    /// Boxes below each node; the greatest depth below `n`, which is at `depth`, as far as it is at most [`MAX_DEPTH`].
    fn count(&self, tree: &BinaryTree, n: u32, depth: usize, counts: &mut [u32]) -> usize {
        let Node { child, whole, .. } = *self.node(n);
        if depth > MAX_DEPTH {
            return depth;
        }
        if child == NONE {
            counts[n as usize] = tree.nodes[whole as usize].count;
            return depth + height(tree, whole);
        }
        let first = self.count(tree, child, depth + 1, counts);
        let second = self.count(tree, child + 1, depth + 1, counts);
        counts[n as usize] = counts[child as usize] + counts[child as usize + 1];
        first.max(second)
    }

    /// Writes the part of the subtree of `n` that is of this upper part, to the node `to`.
    fn write(&self, tree: &mut BinaryTree, counts: &[u32], (n, to): (u32, u32), max_leaf: u32) {
        let (Node { aabb, child, whole, first, .. }, count) = (*self.node(n), counts[n as usize]);
        if child == NONE {
            let is_leaf = tree.nodes[whole as usize].is_leaf();
            let child = (!is_leaf).then(|| tree.child(whole));
            tree.put(Part { node: to, first }, aabb, count, child);
        } else if count <= max_leaf {
            self.gather(tree, counts, (n, to));
        } else {
            let pair = tree.add_upper(2);
            // it cannot be a leaf, so nobody asks where its boxes are
            tree.put(Part { node: to, first: NONE }, aabb, count, Some(pair));
            self.write(tree, counts, (child, pair), max_leaf);
            self.write(tree, counts, (child + 1, pair + 1), max_leaf);
        }
    }

    /// Writes all of the subtree of `n`, with its boxes in a row at the end of the order: they may share a leaf.
    fn gather(&self, tree: &mut BinaryTree, counts: &[u32], (n, to): (u32, u32)) {
        let Node { aabb, child, whole, first, .. } = *self.node(n);
        if child == NONE {
            copy(tree, Part { node: whole, first }, to);
            return;
        }
        let (first, pair) = (tree.order.len() as u32, tree.add_upper(2));
        self.gather(tree, counts, (child, pair));
        self.gather(tree, counts, (child + 1, pair + 1));
        tree.put(Part { node: to, first }, aabb, counts[n as usize], Some(pair));
    }
}

/// Copies a subtree into the upper part, its boxes in a row at the end of the order.
fn copy(tree: &mut BinaryTree, from: Part, to: u32) {
    let node = *tree.node(from);
    let first = tree.order.len();
    let mut pair = None;
    if node.is_leaf() {
        tree.order.extend_from_within(from.first as usize..(from.first + node.count) as usize);
    } else {
        let ((a, b), child) = (tree.halves(from), tree.add_upper(2));
        copy(tree, a, child);
        copy(tree, b, child + 1);
        pair = Some(child);
    }
    tree.put(Part { node: to, first: first as u32 }, node.aabb, node.count, pair);
}

/// Levels below a node.
fn height(tree: &BinaryTree, node: u32) -> usize {
    if tree.nodes[node as usize].is_leaf() {
        return 0;
    }
    let child = tree.child(node);
    1 + height(tree, child).max(height(tree, child + 1))
}

#[cfg(test)]
mod tests {
    use super::super::testing::random_boxes;
    use super::super::{Serial, sah};
    use super::*;
    use crate::testing::Rng;

    fn boxes(rng: &mut Rng, n: usize) -> Vec<Aabb> {
        // few are large
        (0..n).flat_map(|i| random_boxes(rng, 1, if i.is_multiple_of(7) { 5.0 } else { 0.3 })).collect()
    }

    fn built(boxes: &[Aabb], max_leaf: u32) -> BinaryTree {
        sah::build(boxes, max_leaf, &Serial)
    }

    /// Areas of the inner nodes.
    fn cost(tree: &BinaryTree) -> f64 {
        let mut sum = 0.0;
        let mut parts = vec![tree.root()];
        while let Some(part) = parts.pop() {
            let node = tree.node(part);
            if !node.is_leaf() {
                sum += f64::from(node.aabb.half_area());
                parts.extend(<[Part; 2]>::from(tree.halves(part)));
            }
        }
        sum
    }

    fn cost_of(upper: &Upper) -> f64 {
        upper.nodes.iter().filter(|n| n.child != NONE).map(|n| f64::from(n.area)).sum()
    }

    /// Each box once, counts, bounds, and boxes that may share a leaf in a row: the boxes from left to right.
    fn check(tree: &BinaryTree, boxes: &[Aabb], max_leaf: u32) -> Vec<u32> {
        let found = check_part(tree, boxes, max_leaf, tree.root());
        let mut sorted = found.clone();
        sorted.sort_unstable();
        assert!(sorted.len() == boxes.len() && sorted.iter().enumerate().all(|(i, &n)| i as u32 == n), "each box once");
        found
    }

    fn check_part(tree: &BinaryTree, boxes: &[Aabb], max_leaf: u32, part: Part) -> Vec<u32> {
        let node = tree.node(part);
        let mut found = Vec::new();
        if node.is_leaf() {
            assert!(node.count <= max_leaf);
            found.extend(tree.boxes(part));
            let own = found.iter().fold(Aabb::EMPTY, |sum, &n| sum.union(&boxes[n as usize]));
            assert_eq!(node.aabb, own);
        } else {
            let (a, b) = tree.halves(part);
            assert_eq!(tree.node(a).count + tree.node(b).count, node.count);
            assert_eq!(node.aabb, tree.node(a).aabb.union(&tree.node(b).aabb));
            found = check_part(tree, boxes, max_leaf, a);
            found.extend(check_part(tree, boxes, max_leaf, b));
        }
        assert_eq!(found.len(), node.count as usize);
        if node.count <= max_leaf {
            assert_eq!(found, tree.boxes(part));
        }
        found
    }

    #[test]
    fn trees_stay_whole_and_get_cheaper() {
        let mut rng = Rng(1);
        for n in [1, 2, 3, 4, 5, 10, 100, 3000, 20_000] {
            let boxes = boxes(&mut rng, n);
            for max_leaf in [1, 8] {
                let tree = improved(built(&boxes, max_leaf), max_leaf);
                let found = check(&tree, &boxes, max_leaf);
                // of sums of as many areas, each rounded
                assert!(cost(&tree) <= cost(&built(&boxes, max_leaf)) * (1.0 + 1e-6));
                assert!(n < 100 || cost(&tree) < 0.97 * cost(&built(&boxes, max_leaf)), "{n}");
                assert_eq!(check(&improved(built(&boxes, max_leaf), max_leaf), &boxes, max_leaf), found);
            }
        }
        // boxes all alike, and a flat grid, have nothing to gain
        let alike = vec![Aabb { lo: [0.0; 3], hi: [1.0, 0.0, 2.0] }; 200];
        assert_eq!(improved(built(&alike, 8), 8).order, built(&alike, 8).order);
        let cell = |i: usize| {
            let (x, y) = ((i % 64) as f32, (i / 64) as f32);
            Aabb { lo: [x, y, 0.0], hi: [x + 1.0, y + 1.0, 0.0] }
        };
        let grid: Vec<Aabb> = (0..64 * 64).map(cell).collect();
        check(&improved(built(&grid, 8), 8), &grid, 8);
    }

    /// Against every place tried in turn.
    #[test]
    fn the_best_place_is_found() {
        let mut rng = Rng(2);
        let (mut found, mut none) = (0, 0);
        for _ in 0..30 {
            let boxes = boxes(&mut rng, 12);
            let upper = Upper::of(&built(&boxes, 1), 100);
            let before = cost_of(&upper);
            for n in 1..upper.nodes.len() as u32 {
                let above = |mut of: u32, sought: u32| {
                    while of != NONE && of != sought {
                        of = upper.node(of).parent;
                    }
                    of == sought
                };
                let places = (0..upper.nodes.len() as u32)
                    .filter(|&to| !above(to, n) && !above(n, to) && to != upper.sibling(n));
                let best = places
                    .map(|to| {
                        let mut other = Upper { nodes: upper.nodes.clone() };
                        other.reinsert(n, to);
                        before - cost_of(&other)
                    })
                    .fold(0.0, f64::max);
                let gain = upper.best_place(n, &mut Vec::new()).map_or(0.0, |(_, gain)| f64::from(gain));
                assert!((gain - best).abs() <= 1e-6 * before, "{gain} {best}");
                if gain > 0.0 { found += 1 } else { none += 1 }
            }
        }
        assert!(found > 50 && none > 50, "{found} {none}");
    }

    /// What a leaf holds best stays together.
    #[test]
    fn both_halves_of_a_wall_stay_neighbours() {
        let mut rng = Rng(3);
        let mut boxes = boxes(&mut rng, 500);
        let wall = Aabb { lo: [-12.0, -12.0, 12.0], hi: [12.0; 3] };
        boxes.extend([wall; 2]);
        let tree = improved(built(&boxes, 8), 8);
        let order = check(&tree, &boxes, 8);
        let at = |n: u32| order.iter().position(|&k| k == n).expect("each is there");
        assert_eq!(at(500).abs_diff(at(501)), 1);
    }

    #[test]
    fn a_tree_that_would_be_too_deep_stays() {
        // each lies in all that follow: a chain
        let boxes: Vec<Aabb> = (0..200)
            .map(|i| {
                let size = 1.1f32.powi(i);
                Aabb { lo: [-size; 3], hi: [size; 3] }
            })
            .collect();
        let mut upper = Upper::of(&built(&boxes, 1), NODES);
        for _ in 0..20 {
            upper.reinsert_all();
        }
        assert_eq!(upper.on(built(&boxes, 1), 1).root().node, 0);
        check(&improved(built(&boxes, 1), 1), &boxes, 1);
    }
}
