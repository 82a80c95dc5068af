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

use super::collapse::leaf_cost;
use super::layout::Aabb;
use super::sah::{BinaryNode, BinaryTree};

/// Inner nodes that may change: the largest.
const NODES: usize = 4096;
/// How often each is tried; a fourth time gains some tenths of a percent.
const PASSES: usize = 3;
/// Deeper trees are not kept: what walks them is recursive, and so is the traversal's stack bound. [`super::sah`] makes none.
const MAX_DEPTH: usize = 96;

/// The same boxes in a tree of at most the same cost. Of `max_leaf` boxes that may share a leaf, those that best do stay together.
pub(super) fn improved(tree: BinaryTree, max_leaf: u32) -> BinaryTree {
    let mut upper = Upper::of(&tree, NODES, max_leaf);
    let mut moved = false;
    for _ in 0..PASSES {
        moved |= upper.reinsert_all();
    }
    if moved { upper.with_what_is_below(&tree).unwrap_or(tree) } else { tree }
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
    fn of(tree: &BinaryTree, most: usize, max_leaf: u32) -> Upper {
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
            let BinaryNode { child, count, .. } = tree.nodes[whole as usize];
            if count == 1 || (count <= max_leaf && as_leaves(tree, whole).1) {
                continue;
            }
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

    /// The whole tree with this upper part; `None` if it is too deep.
    fn with_what_is_below(&self, tree: &BinaryTree) -> Option<BinaryTree> {
        let mut counts = vec![0; self.nodes.len()];
        if self.count(tree, 0, 0, &mut counts) > MAX_DEPTH {
            return None;
        }
        let blank = BinaryNode { aabb: Aabb::EMPTY, child: 0, count: 0 };
        let mut out = BinaryTree { nodes: vec![blank; tree.nodes.len()], order: Vec::with_capacity(tree.order.len()) };
        self.write(tree, &counts, 0, (0, 1), &mut out);
        Some(out)
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

    /// Writes the subtree of `n` to the node `to`, and its descendants from `below` on.
    fn write(&self, tree: &BinaryTree, counts: &[u32], n: u32, (to, below): (usize, usize), out: &mut BinaryTree) {
        let (node, count) = (self.node(n), counts[n as usize]);
        out.nodes[to] = BinaryNode { aabb: node.aabb, child: below as u32, count };
        if node.child != NONE {
            let second = below + 2 * counts[node.child as usize] as usize;
            self.write(tree, counts, node.child, (below, below + 2), out);
            self.write(tree, counts, node.child + 1, (below + 1, second), out);
            return;
        }
        out.order.extend_from_slice(&tree.order[node.first as usize..][..count as usize]);
        let from = tree.nodes[node.whole as usize].child;
        let descendants = 2 * count as usize - 2;
        for (to, node) in out.nodes[below..][..descendants].iter_mut().zip(tree.nodes.iter().skip(from as usize)) {
            // a leaf's child means nothing
            *to = BinaryNode { child: node.child.wrapping_sub(from).wrapping_add(below as u32), ..*node };
        }
    }
}

/// Levels below a node.
fn height(tree: &BinaryTree, node: u32) -> usize {
    let BinaryNode { child, count, .. } = tree.nodes[node as usize];
    if count == 1 { 0 } else { 1 + height(tree, child).max(height(tree, child + 1)) }
}

/// Least cost of the boxes below a node in leaves, and whether that is one leaf of all.
fn as_leaves(tree: &BinaryTree, node: u32) -> (f32, bool) {
    let BinaryNode { aabb, child, count } = tree.nodes[node as usize];
    let together = leaf_cost(aabb.half_area(), count);
    if count == 1 {
        return (together, true);
    }
    let apart = as_leaves(tree, child).0 + as_leaves(tree, child + 1).0;
    if together <= apart { (together, true) } else { (apart, false) }
}

#[cfg(test)]
mod tests {
    use super::super::{Serial, sah};
    use super::*;
    use crate::testing::Rng;

    fn boxes(rng: &mut Rng, n: usize) -> Vec<Aabb> {
        let one = |i: usize, rng: &mut Rng| {
            // few are large
            let size = rng.vec3(if i.is_multiple_of(7) { 5.0 } else { 0.3 }).abs();
            let p = rng.vec3(10.0);
            Aabb { lo: (p - size).to_array(), hi: (p + size).to_array() }
        };
        (0..n).map(|i| one(i, rng)).collect()
    }

    fn built(boxes: &[Aabb]) -> BinaryTree {
        sah::build(boxes.iter().copied(), &Serial)
    }

    /// Areas of the inner nodes.
    fn cost(tree: &BinaryTree) -> f64 {
        tree.nodes.iter().filter(|n| n.count > 1).map(|n| f64::from(n.aabb.half_area())).sum()
    }

    fn cost_of(upper: &Upper) -> f64 {
        upper.nodes.iter().filter(|n| n.child != NONE).map(|n| f64::from(n.area)).sum()
    }

    fn check(tree: &BinaryTree, boxes: &[Aabb]) {
        assert_eq!(tree.nodes.len(), 2 * boxes.len() - 1);
        let mut order = tree.order.clone();
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, &n)| i as u32 == n), "each box once");
        check_subtree(tree, boxes, 0, 0, 1);
    }

    /// Places, counts, bounds.
    fn check_subtree(tree: &BinaryTree, boxes: &[Aabb], node: usize, first: usize, below: usize) {
        let BinaryNode { aabb, child, count } = tree.nodes[node];
        if count == 1 {
            assert_eq!(aabb, boxes[tree.order[first] as usize]);
            return;
        }
        assert_eq!(child as usize, below);
        let (a, b) = (tree.nodes[below], tree.nodes[below + 1]);
        assert_eq!(a.count + b.count, count);
        assert_eq!(aabb, a.aabb.union(&b.aabb));
        let second = below + 2 * a.count as usize;
        check_subtree(tree, boxes, below, first, below + 2);
        check_subtree(tree, boxes, below + 1, first + a.count as usize, second);
    }

    #[test]
    fn trees_stay_whole_and_get_cheaper() {
        let mut rng = Rng(1);
        for n in [1, 2, 3, 4, 5, 10, 100, 3000, 20_000] {
            let boxes = boxes(&mut rng, n);
            for max_leaf in [1, 8] {
                let tree = improved(built(&boxes), max_leaf);
                check(&tree, &boxes);
                // of sums of as many areas, each rounded
                assert!(cost(&tree) <= cost(&built(&boxes)) * (1.0 + 1e-6));
                assert!(n < 100 || cost(&tree) < 0.97 * cost(&built(&boxes)), "{n}");
                assert_eq!(improved(built(&boxes), max_leaf).order, tree.order);
            }
        }
        // boxes all alike, and a flat grid, have nothing to gain
        let alike = vec![Aabb { lo: [0.0; 3], hi: [1.0, 0.0, 2.0] }; 200];
        assert_eq!(improved(built(&alike), 8).order, built(&alike).order);
        let cell = |i: usize| {
            let (x, y) = ((i % 64) as f32, (i / 64) as f32);
            Aabb { lo: [x, y, 0.0], hi: [x + 1.0, y + 1.0, 0.0] }
        };
        let grid: Vec<Aabb> = (0..64 * 64).map(cell).collect();
        check(&improved(built(&grid), 8), &grid);
    }

    /// Against every place tried in turn.
    #[test]
    fn the_best_place_is_found() {
        let mut rng = Rng(2);
        let (mut found, mut none) = (0, 0);
        for _ in 0..30 {
            let boxes = boxes(&mut rng, 12);
            let upper = Upper::of(&built(&boxes), 100, 1);
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
        let tree = improved(built(&boxes), 8);
        let at = |n: u32| tree.order.iter().position(|&k| k == n).expect("each is there");
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
        let mut upper = Upper::of(&built(&boxes), NODES, 1);
        for _ in 0..20 {
            upper.reinsert_all();
        }
        assert!(upper.with_what_is_below(&built(&boxes)).is_none());
        check(&improved(built(&boxes), 1), &boxes);
    }
}
