//! A small tree over boxes that are no triangles: the opened nodes of the splits in memory.
//!
//! obvhs builds it (PLOC and reinsertion). Over flat regular grids (walls, height fields) its trees are terrible, so the binned tree is built too, and
//! the one of less expected work is kept.

use glam::Vec3A;
use obvhs::BvhBuildParams;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::ploc::PlocBuilder;

use super::Serial;
use super::binary::{BinaryNode, BinaryTree};
use super::layout::Aabb;
use super::sah;

/// Deeper trees are not kept: what walks them is recursive, and so is the traversal's stack bound.
const MAX_DEPTH: usize = 128;

/// The better of the two trees. Needs at least one box, as [`sah::build`] does.
pub(super) fn build(boxes: &[Aabb]) -> BinaryTree {
    let binned = sah::build(boxes, 1, &Serial);
    // nothing to choose
    if boxes.len() < 3 {
        return binned;
    }
    match agglomerated(boxes) {
        Some(tree) if cost(&tree) < cost(&binned) => tree,
        _ => binned,
    }
}

/// Expected visits of a ray that meets the root: areas of the inner nodes (surface area heuristic; leaves are the same in both).
fn cost(tree: &BinaryTree) -> f64 {
    tree.nodes.iter().filter(|n| !n.is_leaf()).map(|n| f64::from(n.aabb.half_area())).sum()
}

fn agglomerated(boxes: &[Aabb]) -> Option<BinaryTree> {
    let theirs: Vec<obvhs::aabb::Aabb> =
        boxes.iter().map(|b| obvhs::aabb::Aabb::new(Vec3A::from(b.lo), Vec3A::from(b.hi))).collect();
    let p = BvhBuildParams::medium_build();
    let indices = (0..boxes.len() as u32).collect();
    let builder = &mut PlocBuilder::with_capacity(boxes.len());
    let mut bvh = builder.build(p.ploc_search_distance, &theirs, indices, p.sort_precision, p.search_depth_threshold);
    ReinsertionOptimizer::default().run(&mut bvh, p.reinsertion_batch_ratio, None);

    let counts = counts(&bvh)?;
    let blank = BinaryNode { aabb: Aabb::EMPTY, child: 0, count: 0 };
    let nodes = vec![blank; 2 * boxes.len() - 1];
    let mut out = BinaryTree::new(nodes, Vec::with_capacity(boxes.len()));
    copy(&bvh, &counts, boxes, 0, &mut out, 0, 1);
    (out.order.len() == boxes.len()).then_some(out)
}

/// Boxes below each node; `None` for a tree that is too deep, or has leaves of several boxes.
fn counts(bvh: &Bvh2) -> Option<Vec<u32>> {
    let mut counts = vec![0; bvh.nodes.len()];
    let mut stack = vec![(0usize, 0usize, false)];
    while let Some((node, depth, below_done)) = stack.pop() {
        let n = bvh.nodes.get(node)?;
        if n.is_leaf() {
            if n.prim_count != 1 || depth > MAX_DEPTH {
                return None;
            }
            counts[node] = 1;
            continue;
        }
        let child = n.first_index as usize;
        if below_done {
            counts[node] = counts[child] + counts[child + 1];
        } else {
            stack.extend([(node, depth, true), (child, depth + 1, false), (child + 1, depth + 1, false)]);
        }
    }
    Some(counts)
}

/// Copies the subtree of `from` to `to`, with the descendants from `base` on; returns its bounds, those of the boxes themselves.
fn copy(bvh: &Bvh2, counts: &[u32], boxes: &[Aabb], from: usize, out: &mut BinaryTree, to: usize, base: u32) -> Aabb {
    let n = &bvh.nodes[from];
    let count = counts[from];
    let aabb = if n.is_leaf() {
        let index = bvh.primitive_indices[n.first_index as usize];
        out.order.push(index);
        // adding 0 turns -0 into 0, as the binned tree does
        let b = &boxes[index as usize];
        Aabb { lo: b.lo.map(|x| x + 0.0), hi: b.hi.map(|x| x + 0.0) }
    } else {
        let child = n.first_index as usize;
        // the two children, those below the first, those below the second
        let first_below = base + 2;
        let second_below = first_below + 2 * counts[child] - 2;
        let a = copy(bvh, counts, boxes, child, out, base as usize, first_below);
        let b = copy(bvh, counts, boxes, child + 1, out, base as usize + 1, second_below);
        a.union(&b)
    };
    let child = if n.is_leaf() { 0 } else { base - to as u32 };
    out.nodes[to] = BinaryNode { aabb, child, count };
    aabb
}

#[cfg(test)]
mod tests {
    use super::super::testing::random_boxes;
    use super::*;
    use crate::testing::Rng;

    fn check(tree: &BinaryTree, boxes: &[Aabb]) {
        assert_eq!(tree.nodes.len(), 2 * boxes.len() - 1);
        let mut order = tree.order.clone();
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, &n)| i as u32 == n), "each box once");
        // walks in the order of `order`
        let mut next = 0;
        let mut stack = vec![(0usize, 0usize)];
        while let Some((node, depth)) = stack.pop() {
            assert!(depth <= MAX_DEPTH);
            let n = &tree.nodes[node];
            if n.count == 1 {
                let b = &boxes[tree.order[next] as usize];
                assert_eq!((n.aabb.lo, n.aabb.hi), (b.lo, b.hi));
                next += 1;
                continue;
            }
            let child = tree.child(node as u32) as usize;
            let (a, b) = (&tree.nodes[child], &tree.nodes[child + 1]);
            assert_eq!(a.count + b.count, n.count);
            let both = a.aabb.union(&b.aabb);
            assert_eq!((n.aabb.lo, n.aabb.hi), (both.lo, both.hi));
            stack.extend([(child + 1, depth + 1), (child, depth + 1)]);
        }
        assert_eq!(next, boxes.len());
    }

    #[test]
    fn trees_are_whole_and_the_same_each_time() {
        let mut rng = Rng(1);
        for n in [1, 2, 3, 4, 10, 100, 3000] {
            let boxes = random_boxes(&mut rng, n, 2.0);
            let tree = build(&boxes);
            check(&tree, &boxes);
            assert_eq!(build(&boxes).order, tree.order);
            if let Some(theirs) = agglomerated(&boxes) {
                check(&theirs, &boxes);
                assert!(cost(&tree) <= cost(&theirs));
            }
        }
        // boxes all alike
        let boxes = vec![Aabb { lo: [0.0; 3], hi: [1.0, 0.0, 2.0] }; 200];
        check(&build(&boxes), &boxes);
    }

    /// What obvhs must not be used for: the binned tree is kept.
    #[test]
    fn flat_grids_are_binned() {
        let n = 64;
        let cell = |i: usize| {
            let (x, y) = ((i % n) as f32, (i / n) as f32);
            Aabb { lo: [x, y, 0.0], hi: [x + 1.0, y + 1.0, 0.0] }
        };
        let boxes: Vec<Aabb> = (0..n * n).map(cell).collect();
        let tree = build(&boxes);
        check(&tree, &boxes);
        assert!(cost(&tree) <= cost(&sah::build(&boxes[..], 1, &Serial)));
    }
}
