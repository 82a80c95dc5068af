//! A binary tree over boxes, as it lies in memory while a block is built.

use bytemuck::{Pod, Zeroable};

use super::layout::Aabb;

/// A binary tree over boxes.
///
/// Its first nodes are a tree: 0 is the root, and what is below a node lies in a row, its two children, what is below the first, what is below the
/// second. Others may follow, an upper part that stands in place of that tree's ([`super::reinsert`]): below them are nodes of their own and subtrees of
/// the first.
pub(super) struct BinaryTree {
    /// The children of a node are neighbours.
    pub nodes: Vec<BinaryNode>,
    /// Numbers of the boxes. Those below a node of the first tree are a range of it; below another one if they may share a leaf.
    pub order: Vec<u32>,
    /// Of each node of the upper part, where its boxes begin in the order. The first of them is the root.
    upper: Vec<u32>,
}

/// A node of a [`BinaryTree`]. As large and aligned as an item ([`super::divide`]), in whose place it comes.
#[repr(C, align(16))]
#[derive(Clone, Copy, Pod, Zeroable)]
pub(super) struct BinaryNode {
    /// Bounds of the boxes below.
    pub aabb: Aabb,
    /// How many nodes further on its first child is, modulo 2^32; 0 in a leaf.
    pub child: u32,
    /// Number of boxes below.
    pub count: u32,
}

impl BinaryNode {
    #[inline(always)]
    pub fn is_leaf(&self) -> bool {
        self.child == 0
    }
}

/// A node, and where its boxes begin in the tree's order.
#[derive(Clone, Copy, Default)]
pub(super) struct Part {
    pub node: u32,
    pub first: u32,
}

impl BinaryTree {
    /// Without another upper part.
    pub fn new(nodes: Vec<BinaryNode>, order: Vec<u32>) -> Self {
        BinaryTree { nodes, order, upper: Vec::new() }
    }

    /// How many of the nodes are of the first tree.
    #[inline(always)]
    pub fn lower(&self) -> usize {
        self.nodes.len() - self.upper.len()
    }
    /// All of it.
    pub fn root(&self) -> Part {
        match self.upper.first() {
            Some(&first) => Part { node: self.lower() as u32, first },
            None => Part { node: 0, first: 0 },
        }
    }
    #[inline(always)]
    pub fn node(&self, part: Part) -> &BinaryNode {
        &self.nodes[part.node as usize]
    }
    /// The first child of a node that is no leaf.
    #[inline(always)]
    pub fn child(&self, node: u32) -> u32 {
        node.wrapping_add(self.nodes[node as usize].child)
    }
    /// The boxes of a part that may be a leaf.
    #[inline(always)]
    pub fn boxes(&self, part: Part) -> &[u32] {
        &self.order[part.first as usize..][..self.node(part).count as usize]
    }
    /// Both children of a part that is no leaf.
    #[inline(always)]
    pub fn halves(&self, part: Part) -> (Part, Part) {
        let child = self.child(part.node);
        let (first, second) = match (child as usize).checked_sub(self.lower()) {
            Some(at) => (self.upper[at], self.upper[at + 1]),
            None => (part.first, part.first + self.nodes[child as usize].count),
        };
        (Part { node: child, first }, Part { node: child + 1, first: second })
    }
    /// Where what is below a node ends, which is in or above the first tree.
    pub fn end(&self, mut node: u32) -> usize {
        loop {
            let child = self.child(node);
            match [child + 1, child].into_iter().find(|&n| !self.nodes[n as usize].is_leaf()) {
                Some(last) => node = last,
                None => return child as usize + 2,
            }
        }
    }

    /// Room for so many neighbours in the upper part, to be [`put`](BinaryTree::put): the first.
    pub fn add_upper(&mut self, count: usize) -> u32 {
        let at = self.nodes.len();
        self.nodes.resize(at + count, BinaryNode::zeroed());
        self.upper.resize(self.upper.len() + count, 0);
        at as u32
    }
    /// Writes a node of the upper part, whose first child is that node, if it has any.
    pub fn put(&mut self, part: Part, aabb: Aabb, count: u32, child: Option<u32>) {
        let (lower, node) = (self.lower(), part.node);
        let child = child.map_or(0, |child| child.wrapping_sub(node));
        self.nodes[node as usize] = BinaryNode { aabb, child, count };
        self.upper[node as usize - lower] = part.first;
    }
}
