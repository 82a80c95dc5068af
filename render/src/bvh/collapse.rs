//! From a binary tree to the 8-wide tree of least expected cost, written in the layout of [`super::layout`].
//!
//! Ylitie, Karras, Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (2017), section 3.2:
//! the least cost of each binary subtree as a forest of at most 1..8 roots, by dynamic programming from below.

use std::sync::atomic::{AtomicU32, Ordering};

use super::Fork;
use super::binary::{BinaryNode, BinaryTree, Part};
use super::layout::{Aabb, NODE_ALIGN, NODE_BYTES, WIDTH, node_ref, write_slot};
use crate::memory::zeros;

/// Costs in units of a node visit; measured to be flat around these values.
const NODE_COST: f32 = 1.0;
const LEAF_COST: f32 = 1.0;
const PRIMITIVE_COST: f32 = 0.1;
/// Below this many boxes a subtree is done by one thread.
const FORK_ABOVE: u32 = 1 << 14;

/// Expected cost of a leaf of so many boxes, for its box's half area.
pub(super) fn leaf_cost(area: f32, boxes: u32) -> f32 {
    area * (LEAF_COST + PRIMITIVE_COST * boxes as f32)
}

/// What the boxes of a tree stand for.
pub(super) trait Content: Sync {
    /// How many boxes may share a leaf.
    fn max_leaf(&self) -> u32;
    /// Bytes that the record of a leaf of these boxes takes, a multiple of 32.
    fn leaf_bytes(&self, boxes: &[u32]) -> usize;
    /// Stack entries that a traversal of what stands below a leaf needs.
    fn stack_below(&self, boxes: &[u32]) -> usize;
    /// Writes the record of a leaf with these boxes, and returns the reference to it; `at` is the offset of `out`.
    fn write_leaf(&self, boxes: &[u32], out: &mut [u8], at: usize) -> u32;
}

/// An 8-wide tree that has been decided on but not written.
pub(super) struct Plan<'a, C> {
    tree: &'a BinaryTree,
    content: &'a C,
    fork: &'a dyn Fork,
    /// Per binary node; see [`choose`].
    choices: Vec<Choice>,
    /// Bytes / 64 of the subtree, for each binary node that becomes an 8-wide one.
    sizes: Vec<AtomicU32>,
    /// Bytes of all of it, a multiple of 64.
    pub bytes: usize,
    /// Entries that a traversal's stack can hold at most.
    pub stack: usize,
}

/// How a binary node is best replaced: `[0]` is 1 when, as a single root, it is an inner node and 0 when it is a leaf;
/// `[j]` for a forest of at most j + 1 roots: how many of them the first child gets, with [`FEWER`] set when j are as good.
type Choice = [u8; WIDTH];
const FEWER: u8 = 0x80;

impl<'a, C: Content> Plan<'a, C> {
    /// Decides.
    pub fn new(tree: &'a BinaryTree, content: &'a C, fork: &'a dyn Fork) -> Self {
        let choices = Chooser { tree, max_leaf: content.max_leaf(), fork }.choices();
        let mut sizes = Vec::new();
        sizes.resize_with(tree.nodes.len(), AtomicU32::default);
        let mut plan = Plan { tree, content, fork, choices, sizes, bytes: 0, stack: 0 };
        (plan.bytes, plan.stack) = plan.measure(tree.root());
        plan
    }

    /// Writes the tree into `out` of exactly [`Plan::bytes`] zeros, which lie at offset `at` of the arena: the root's box.
    pub fn write(&self, out: &mut [u8], at: usize) -> Aabb {
        let root = self.tree.root();
        self.write_subtree(root, out, at);
        self.tree.node(root).aabb
    }

    /// Bytes and stack entries of the subtree.
    fn measure(&self, part: Part) -> (usize, usize) {
        let children = self.children(part);
        let others = children.len() - 1;
        let mut stack = children.len();
        let mut bytes = NODE_BYTES;
        let mut inner = Parts::default();
        for &child in children.iter() {
            if self.is_inner(child) {
                inner.push(child);
            } else {
                let boxes = self.boxes(child);
                bytes += self.content.leaf_bytes(boxes);
                stack = stack.max(others + self.content.stack_below(boxes));
            }
        }
        let below = self.measure_all(&inner);
        bytes = bytes.next_multiple_of(NODE_ALIGN) + below.0;
        self.sizes[part.node as usize].store((bytes / NODE_ALIGN) as u32, Ordering::Relaxed);
        (bytes, stack.max(others + below.1))
    }

    /// Sum of the bytes and the most stack entries of some subtrees.
    fn measure_all(&self, parts: &[Part]) -> (usize, usize) {
        match parts {
            [] => (0, 0),
            &[part] => self.measure(part),
            _ => {
                let (left, right) = parts.split_at(parts.len() / 2);
                let (mut a, mut b) = ((0, 0), (0, 0));
                self.both(parts, &mut || a = self.measure_all(left), &mut || b = self.measure_all(right));
                (a.0 + b.0, a.1.max(b.1))
            }
        }
    }

    fn write_subtree(&self, part: Part, out: &mut [u8], at: usize) {
        let children = self.children(part);
        let mut used = NODE_BYTES;
        for (slot, &child) in children.iter().enumerate() {
            if !self.is_inner(child) {
                let boxes = self.boxes(child);
                let bytes = self.content.leaf_bytes(boxes);
                let reference = self.content.write_leaf(boxes, &mut out[used..used + bytes], at + used);
                write_slot(out, 0, slot, &self.node(child).aabb, reference);
                used += bytes;
            }
        }
        used = used.next_multiple_of(NODE_ALIGN);
        let (own, below) = out.split_at_mut(used);
        let mut inner = Parts::default();
        let mut next = at + used;
        for (slot, &child) in children.iter().enumerate() {
            if self.is_inner(child) {
                write_slot(own, 0, slot, &self.node(child).aabb, node_ref(next));
                next += self.bytes_of(child);
                inner.push(child);
            }
        }
        for slot in children.len()..WIDTH {
            write_slot(own, 0, slot, &Aabb::EMPTY, 0);
        }
        self.write_all(&inner, below, at + used);
    }

    fn write_all(&self, parts: &[Part], out: &mut [u8], at: usize) {
        match parts {
            [] => {}
            &[part] => self.write_subtree(part, out, at),
            _ => {
                let (left, right) = parts.split_at(parts.len() / 2);
                let bytes = left.iter().map(|&p| self.bytes_of(p)).sum();
                let (a, b) = out.split_at_mut(bytes);
                self.both(parts, &mut || self.write_all(left, a, at), &mut || self.write_all(right, b, at + bytes));
            }
        }
    }

    /// Runs both, in parallel when the parts are large.
    fn both(&self, parts: &[Part], a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
        if parts.iter().map(|&p| self.node(p).count).sum::<u32>() > FORK_ABOVE {
            self.fork.join(a, b);
        } else {
            a();
            b();
        }
    }

    fn node(&self, part: Part) -> &BinaryNode {
        self.tree.node(part)
    }
    fn is_inner(&self, part: Part) -> bool {
        self.choices[part.node as usize][0] == 1
    }
    fn bytes_of(&self, part: Part) -> usize {
        self.sizes[part.node as usize].load(Ordering::Relaxed) as usize * NODE_ALIGN
    }
    fn boxes(&self, part: Part) -> &[u32] {
        self.tree.boxes(part)
    }

    /// The roots that become the children of an 8-wide node, the largest first.
    fn children(&self, part: Part) -> Parts {
        let mut out = Parts::default();
        if self.is_inner(part) {
            self.roots(part, WIDTH - 1, true, &mut out);
        } else {
            // the whole tree is one leaf
            out.push(part);
        }
        // any-hit visits the last slot first: of the boxes that a ray enters, the smallest is filled best (8 % fewer nodes)
        let mut areas = [0.0; WIDTH];
        for i in 0..out.len {
            let part = out.parts[i];
            let area = self.node(part).aabb.half_area();
            let at = areas[..i].iter().take_while(|&&other| other >= area).count();
            areas.copy_within(at..i, at + 1);
            out.parts.copy_within(at..i, at + 1);
            (areas[at], out.parts[at]) = (area, part);
        }
        out
    }
    /// The best forest of at most j + 1 roots; when `all`, the node itself is not one of them.
    fn roots(&self, part: Part, mut j: usize, all: bool, out: &mut Parts) {
        let choice = &self.choices[part.node as usize];
        while !all && j > 0 && choice[j] & FEWER != 0 {
            j -= 1;
        }
        if j == 0 || self.node(part).is_leaf() {
            out.push(part);
            return;
        }
        let to_first = (choice[j] & !FEWER) as usize;
        let (first, second) = self.tree.halves(part);
        self.roots(first, to_first - 1, false, out);
        self.roots(second, j - to_first, false, out);
    }
}

/// Up to eight parts.
#[derive(Default)]
struct Parts {
    parts: [Part; WIDTH],
    len: usize,
}

impl Parts {
    fn push(&mut self, part: Part) {
        self.parts[self.len] = part;
        self.len += 1;
    }
}

impl std::ops::Deref for Parts {
    type Target = [Part];
    fn deref(&self) -> &[Part] {
        &self.parts[..self.len]
    }
}

struct Chooser<'a> {
    tree: &'a BinaryTree,
    max_leaf: u32,
    fork: &'a dyn Fork,
}

/// A subtree below the upper part, with the choices of its descendants.
struct Hanging<'a> {
    /// Its root, a node of the upper part.
    node: u32,
    below: &'a mut [Choice],
    choice: Choice,
    costs: [f32; WIDTH],
}

impl Chooser<'_> {
    /// Of all nodes that are in the tree.
    fn choices(&self) -> Vec<Choice> {
        let mut choices: Vec<Choice> = zeros(self.tree.nodes.len());
        let lower = self.tree.lower();
        let (below, upper) = choices.split_at_mut(lower);
        if upper.is_empty() {
            let (root, below) = below.split_first_mut().expect("a tree has a root");
            self.costs(0, root, below);
            return choices;
        }
        let mut hanging = self.hanging(below);
        self.all_costs(&mut hanging);
        let mut costs = vec![None; upper.len()];
        for h in hanging {
            let at = h.node as usize - lower;
            (upper[at], costs[at]) = (h.choice, Some(h.costs));
        }
        self.upper_costs(self.tree.root().node as usize, upper, &mut costs);
        choices
    }

    /// The subtrees below the upper part that are no leaves, with their choices among those of the first tree.
    fn hanging<'c>(&self, mut choices: &'c mut [Choice]) -> Vec<Hanging<'c>> {
        let lower = self.tree.lower() as u32;
        let mut roots: Vec<(u32, u32)> = (lower..self.tree.nodes.len() as u32)
            .filter(|&n| !self.tree.nodes[n as usize].is_leaf())
            .map(|n| (self.tree.child(n), n))
            .filter(|&(child, _)| child < lower)
            .collect();
        roots.sort_unstable();
        let mut at = 0;
        let cut = |(child, node): (u32, u32)| {
            let end = self.tree.end(node);
            let (below, rest) = std::mem::take(&mut choices)[child as usize - at..].split_at_mut(end - child as usize);
            (choices, at) = (rest, end);
            Hanging { node, below, choice: Choice::default(), costs: [0.0; WIDTH] }
        };
        roots.into_iter().map(cut).collect()
    }

    /// Finds the costs of some subtrees, in parallel where they are large.
    fn all_costs(&self, hanging: &mut [Hanging]) {
        let boxes = hanging.iter().map(|h| self.tree.nodes[h.node as usize].count).sum::<u32>();
        if hanging.len() > 1 && boxes > FORK_ABOVE {
            let (a, b) = hanging.split_at_mut(hanging.len() / 2);
            self.fork.join(&mut || self.all_costs(a), &mut || self.all_costs(b));
        } else {
            for h in hanging {
                h.costs = self.costs(h.node as usize, &mut h.choice, h.below);
            }
        }
    }

    /// Least costs of a node of the upper part; those of what hangs below it are known.
    fn upper_costs(&self, node: usize, choices: &mut [Choice], known: &mut [Option<[f32; WIDTH]>]) -> [f32; WIDTH] {
        let (n, at) = (&self.tree.nodes[node], node - self.tree.lower());
        if n.is_leaf() {
            return [leaf_cost(n.aabb.half_area(), n.count); WIDTH];
        }
        if let Some(costs) = known[at].take() {
            return costs;
        }
        let child = self.tree.child(node as u32) as usize;
        let a = self.upper_costs(child, choices, known);
        let b = self.upper_costs(child + 1, choices, known);
        choose(n, self.max_leaf, &a, &b, &mut choices[at])
    }

    /// Least cost of the node as a forest of at most 1..8 roots; writes its choice and those of its descendants.
    fn costs(&self, node: usize, choice: &mut Choice, below: &mut [Choice]) -> [f32; WIDTH] {
        let n = &self.tree.nodes[node];
        if n.is_leaf() {
            return [leaf_cost(n.aabb.half_area(), n.count); WIDTH];
        }
        let first = self.tree.child(node as u32) as usize;
        let (children, rest) = below.split_at_mut(2);
        let second = &self.tree.nodes[first + 1];
        // the first child has what lies before the second's children
        let to_first = if second.is_leaf() { rest.len() } else { second.child as usize - 1 };
        let (below_first, below_second) = rest.split_at_mut(to_first);
        let (choice_first, choice_second) = children.split_at_mut(1);
        let (mut a, mut b) = ([0.0; WIDTH], [0.0; WIDTH]);
        let mut left = || a = self.costs(first, &mut choice_first[0], below_first);
        let mut right = || b = self.costs(first + 1, &mut choice_second[0], below_second);
        if n.count > FORK_ABOVE {
            self.fork.join(&mut left, &mut right);
        } else {
            left();
            right();
        }
        choose(n, self.max_leaf, &a, &b, choice)
    }
}

/// The programme's step: from the costs of both children to those of the node.
fn choose(node: &BinaryNode, max_leaf: u32, a: &[f32; WIDTH], b: &[f32; WIDTH], choice: &mut Choice) -> [f32; WIDTH] {
    let mut cost = [f32::INFINITY; WIDTH];
    for j in 1..WIDTH {
        for k in 0..j {
            let both = a[k] + b[j - 1 - k];
            if both < cost[j] {
                cost[j] = both;
                choice[j] = k as u8 + 1;
            }
        }
    }
    let area = node.aabb.half_area();
    let inner = area * NODE_COST + cost[WIDTH - 1];
    let leaf = if node.count <= max_leaf { leaf_cost(area, node.count) } else { f32::INFINITY };
    choice[0] = u8::from(inner < leaf);
    cost[0] = inner.min(leaf);
    for j in 1..WIDTH {
        if cost[j - 1] <= cost[j] {
            cost[j] = cost[j - 1];
            choice[j] |= FEWER;
        }
    }
    cost
}
