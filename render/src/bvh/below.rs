//! The nodes of a tree on their way from where they were built to where they are to be.

use std::ops::Range;

use super::binary::BinaryNode;
use crate::memory::zeros;

/// What is below a node, before it is known where all of it is to be.
pub(super) enum Below {
    /// Of few boxes, as it will be: at these places, of which there is one for each box.
    Nodes(Range<usize>),
    /// The same apart, where there are more nodes than boxes.
    Apart(Vec<BinaryNode>),
    /// The children, and what is below them.
    Halves(Box<([BinaryNode; 2], [Below; 2])>),
}

impl Below {
    /// All nodes in a row: the root, its two children, what is below the first, what is below the second. They are moved within the places if there they
    /// fit; fresh memory would cost more than the moves.
    pub fn in_a_row(self, root: BinaryNode, mut places: Vec<BinaryNode>) -> Vec<BinaryNode> {
        let mut plan = Plan::default();
        let len = plan.add(self, 1);
        let mut nodes = if len <= places.len() && plan.fits(places.len()) {
            // those that go to the right make room for each other, then the others close up
            for (range, to) in plan.moves.iter().rev().filter(|(range, to)| *to > range.start) {
                places.copy_within(range.clone(), *to);
            }
            for (range, to) in plan.moves.iter().filter(|(range, to)| *to < range.start) {
                places.copy_within(range.clone(), *to);
            }
            places.truncate(len);
            places.shrink_to_fit();
            places
        } else {
            let mut nodes: Vec<BinaryNode> = zeros(len);
            for (range, to) in plan.moves {
                nodes[to..][..range.len()].copy_from_slice(&places[range]);
            }
            nodes
        };
        for (apart, to) in plan.apart {
            nodes[to..][..apart.len()].copy_from_slice(&apart);
        }
        for (pair, to) in plan.pairs {
            nodes[to..to + 2].copy_from_slice(&pair);
        }
        nodes[0] = BinaryNode { child: u32::from(len > 1), ..root };
        nodes
    }
}

/// What is to be where, from left to right.
#[derive(Default)]
struct Plan {
    moves: Vec<(Range<usize>, usize)>,
    apart: Vec<(Vec<BinaryNode>, usize)>,
    pairs: Vec<([BinaryNode; 2], usize)>,
}

impl Plan {
    /// What is below a node, from `at` on: where that ends.
    fn add(&mut self, below: Below, at: usize) -> usize {
        match below {
            Below::Nodes(range) => {
                let end = at + range.len();
                self.moves.push((range, at));
                end
            }
            Below::Apart(nodes) => {
                let end = at + nodes.len();
                self.apart.push((nodes, at));
                end
            }
            Below::Halves(halves) => {
                let (mut pair, [first, second]) = *halves;
                let below_first = at + 2;
                let below_second = self.add(first, below_first);
                let end = self.add(second, below_second);
                let far = |below: Range<usize>, from| if below.is_empty() { 0 } else { (below.start - from) as u32 };
                pair[0].child = far(below_first..below_second, at);
                pair[1].child = far(below_second..end, at + 1);
                self.pairs.push((pair, at));
                end
            }
        }
    }

    /// Whether nothing goes to where the next has not left, of so many places.
    fn fits(&self, places: usize) -> bool {
        let next = self.moves.iter().skip(1).map(|(range, _)| range.start).chain([places]);
        self.moves.iter().zip(next).all(|((range, to), next)| *to <= range.start || to + range.len() <= next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::layout::Aabb;

    fn node(count: u32) -> BinaryNode {
        BinaryNode { aabb: Aabb::EMPTY, child: 0, count }
    }

    fn nodes(counts: Range<u32>) -> Vec<BinaryNode> {
        counts.map(node).collect()
    }

    fn halves(pair: u32, first: Below, second: Below) -> Below {
        Below::Halves(Box::new(([node(pair), node(pair + 1)], [first, second])))
    }

    /// Whether they fit into their places or not, they lie as they should: numbered from the root on.
    #[test]
    fn nodes_lie_in_a_row() {
        // three parts of 6, 4 and 2 nodes below two pairs
        let expected: Vec<(u32, u32)> =
            (0..17).map(|n| (n, [1, 2, 11, 2, 3].get(n as usize).map_or(0, |c| *c))).collect();
        let expected: Vec<(u32, u32)> = expected
            .into_iter()
            .map(|(n, child)| {
                (
                    n,
                    if n == 4 {
                        7
                    } else if n == 2 {
                        13
                    } else {
                        child
                    },
                )
            })
            .collect();
        for (starts, apart) in [([0, 10, 20], false), ([0, 9, 13], false), ([0, 7, 14], false), ([0, 10, 20], true)] {
            let mut places = vec![node(99); 25];
            places[starts[0]..][..6].copy_from_slice(&nodes(5..11));
            places[starts[1]..][..4].copy_from_slice(&nodes(11..15));
            places[starts[2]..][..2].copy_from_slice(&nodes(15..17));
            let part = |i: usize, len: usize| Below::Nodes(starts[i]..starts[i] + len);
            let second = if apart { Below::Apart(nodes(11..15)) } else { part(1, 4) };
            let below = halves(1, halves(3, part(0, 6), second), part(2, 2));
            let found = below.in_a_row(node(0), places);
            let found: Vec<(u32, u32)> = found.iter().map(|n| (n.count, n.child)).collect();
            assert_eq!(found, expected, "{starts:?} {apart}");
        }
        let alone = Below::Nodes(0..0).in_a_row(node(7), vec![node(99)]);
        assert_eq!((alone.len(), alone[0].count, alone[0].child), (1, 7, 0));
    }
}
