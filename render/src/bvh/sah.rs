//! A binary tree over boxes: top-down, binned surface area heuristic, one box in each leaf.
//!
//! Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007). The place of every node follows from
//! the sizes of the subtrees before it, and bounds are minima and maxima, so the tree is the same however the work was
//! divided. Of equal costs, as regular grids have many, the more even split wins.

use glam::Vec4;

use super::Fork;
use super::layout::Aabb;

/// A binary tree. Node 0 is the root; the descendants of a node with n boxes are 2 n - 2 nodes in a row: its two
/// children, those below the first, those below the second.
pub(super) struct BinaryTree {
    /// `2 n - 1` nodes for n boxes.
    pub nodes: Vec<BinaryNode>,
    /// Numbers of the boxes; those below a node are a range of it.
    pub order: Vec<u32>,
}

/// A node of a [`BinaryTree`].
#[derive(Clone, Copy)]
pub(super) struct BinaryNode {
    /// Bounds of the boxes below.
    pub aabb: Aabb,
    /// Index of the first child, the second follows; meaningless in a leaf.
    pub child: u32,
    /// Number of boxes below; a leaf has 1.
    pub count: u32,
}

/// Below this many boxes a subtree is built by one thread.
const FORK_ABOVE: usize = 1 << 14;
/// From this depth on, ranges are halved: bounds the recursion and the traversal stack.
const MAX_SAH_DEPTH: usize = 64;

/// Builds the tree. Needs 1 to 2^31 boxes, not inverted, with finite coordinates whose areas are finite.
pub(super) fn build(boxes: impl Iterator<Item = Aabb>, fork: &dyn Fork) -> BinaryTree {
    let mut items: Vec<Item> = boxes.enumerate().map(|(i, b)| Item::new(&b, i as u32)).collect();
    assert!(!items.is_empty() && items.len() <= 1 << 31, "1 to 2^31 boxes");
    let blank = BinaryNode { aabb: Aabb::EMPTY, child: 0, count: 0 };
    let mut nodes = vec![blank; 2 * items.len() - 1];
    let (root, below) = nodes.split_first_mut().expect("at least one node");
    let range = items.iter().fold(Range::EMPTY, |r, i| r.with(i));
    Builder { fork }.subtree(&mut items, range, root, below, 1, 0);
    BinaryTree { order: items.iter().map(Item::number).collect(), nodes }
}

/// A box on its way through the partitions.
#[derive(Clone, Copy)]
struct Item {
    /// Lower corner; `w` holds the low 16 bits of the number as a small float, so that vector arithmetic on all four
    /// lanes meets no denormals and no NaN.
    lo: Vec4,
    /// Upper corner; `w` holds the high 16 bits of the number.
    hi: Vec4,
}

impl Item {
    fn new(b: &Aabb, number: u32) -> Item {
        // adding 0 turns -0 into 0: minima and maxima of zeros of either sign differ from one processor to the next
        let v = |p: [f32; 3], w: u32| Vec4::new(p[0] + 0.0, p[1] + 0.0, p[2] + 0.0, w as f32);
        Item { lo: v(b.lo, number & 0xffff), hi: v(b.hi, number >> 16) }
    }
    fn number(&self) -> u32 {
        self.lo.w as u32 | (self.hi.w as u32) << 16
    }
    /// Twice the centre.
    #[inline(always)]
    fn center(&self) -> Vec4 {
        self.lo + self.hi
    }
}

/// Bounds of some boxes and of their (doubled) centres.
#[derive(Clone, Copy)]
struct Range {
    lo: Vec4,
    hi: Vec4,
    center_lo: Vec4,
    center_hi: Vec4,
}

impl Range {
    const EMPTY: Range =
        Range { lo: Vec4::INFINITY, hi: Vec4::NEG_INFINITY, center_lo: Vec4::INFINITY, center_hi: Vec4::NEG_INFINITY };

    #[inline(always)]
    fn with(self, item: &Item) -> Range {
        let c = item.center();
        Range {
            lo: self.lo.min(item.lo),
            hi: self.hi.max(item.hi),
            center_lo: self.center_lo.min(c),
            center_hi: self.center_hi.max(c),
        }
    }
    fn aabb(&self) -> Aabb {
        Aabb { lo: self.lo.truncate().to_array(), hi: self.hi.truncate().to_array() }
    }
}

struct Builder<'a> {
    fork: &'a dyn Fork,
}

impl Builder<'_> {
    /// Builds the subtree of `me` over `items`; its descendants go to `below`, whose first has the index `base`.
    fn subtree(
        &self,
        items: &mut [Item],
        range: Range,
        me: &mut BinaryNode,
        below: &mut [BinaryNode],
        base: u32,
        depth: usize,
    ) {
        *me = BinaryNode { aabb: range.aabb(), child: base, count: items.len() as u32 };
        if items.len() == 1 {
            return;
        }
        let (at, left_range, right_range) = match items.len() {
            2 => halve(items),
            _ if depth >= MAX_SAH_DEPTH => halve(items),
            // few boxes do not fill many bins
            3..=6 => split::<4>(items, &range),
            7..=40 => split::<8>(items, &range),
            _ => split::<16>(items, &range),
        };
        let many = items.len() > FORK_ABOVE;
        let (left, right) = items.split_at_mut(at);
        let (children, rest) = below.split_at_mut(2);
        let (below_left, below_right) = rest.split_at_mut(2 * at - 2);
        let (first, second) = children.split_at_mut(1);
        let (first, second) = (&mut first[0], &mut second[0]);
        let right_base = base + 2 * at as u32;
        let mut a = || self.subtree(left, left_range, first, below_left, base + 2, depth + 1);
        let mut b = || self.subtree(right, right_range, second, below_right, right_base, depth + 1);
        if many {
            self.fork.join(&mut a, &mut b);
        } else {
            a();
            b();
        }
    }
}

/// The first half and the second, as they stand.
fn halve(items: &[Item]) -> (usize, Range, Range) {
    let at = items.len() / 2;
    let bounds = |part: &[Item]| part.iter().fold(Range::EMPTY, |r, i| r.with(i));
    (at, bounds(&items[..at]), bounds(&items[at..]))
}

/// What lies in a bin.
#[derive(Clone, Copy)]
struct Bin {
    lo: Vec4,
    hi: Vec4,
    count: u32,
}

impl Bin {
    const EMPTY: Bin = Bin { lo: Vec4::INFINITY, hi: Vec4::NEG_INFINITY, count: 0 };

    #[inline(always)]
    fn and(self, other: &Bin) -> Bin {
        Bin { lo: self.lo.min(other.lo), hi: self.hi.max(other.hi), count: self.count + other.count }
    }
    /// Half the surface area times the number of boxes.
    fn cost(&self) -> f32 {
        let d = self.hi - self.lo;
        (d.x * d.y + d.y * d.z + d.z * d.x) * self.count as f32
    }
}

/// From a doubled centre to its bin on each axis.
struct Bins<const B: usize> {
    start: Vec4,
    scale: Vec4,
}

impl<const B: usize> Bins<B> {
    fn new(range: &Range) -> Self {
        let extent = range.center_hi - range.center_lo;
        // an axis without extent, or with one too small to divide by, has one bin
        let scale = extent.to_array().map(|x| if x > f32::MIN_POSITIVE * B as f32 { B as f32 / x } else { 0.0 });
        Bins { start: range.center_lo, scale: Vec4::from_array(scale) }
    }
    /// A float of 2^23 + k has k in its low bits, rounded to nearest; half a bin less rounds down.
    #[inline(always)]
    fn of(&self, item: &Item) -> [u32; 4] {
        let position = (item.center() - self.start) * self.scale - 0.5;
        let clamped = position.max(Vec4::ZERO).min(Vec4::splat(B as f32 - 1.0));
        (clamped + 8_388_608.0).to_array().map(|x| x.to_bits() & (B as u32 - 1))
    }
}

/// Splits at the cheapest of B - 1 planes on each axis and partitions: size of the left part, both parts' bounds.
fn split<const B: usize>(items: &mut [Item], range: &Range) -> (usize, Range, Range) {
    const { assert!(B.is_power_of_two() && B <= 1 << 16) };
    let bins = Bins::<B>::new(range);
    let mut filled = [[Bin::EMPTY; B]; 3];
    for item in items.iter() {
        let k = bins.of(item);
        for axis in 0..3 {
            let bin = &mut filled[axis][k[axis] as usize];
            *bin = Bin { lo: bin.lo.min(item.lo), hi: bin.hi.max(item.hi), count: bin.count + 1 };
        }
    }
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in 0..3 {
        let mut right = [(0.0, 0u32); B];
        let mut sum = Bin::EMPTY;
        for i in (1..B).rev() {
            sum = sum.and(&filled[axis][i]);
            right[i] = (if sum.count > 0 { sum.cost() } else { 0.0 }, sum.count);
        }
        let mut sum = Bin::EMPTY;
        for i in 1..B {
            sum = sum.and(&filled[axis][i - 1]);
            if sum.count == 0 || right[i].1 == 0 {
                continue;
            }
            // a millionth of the cost decides between equals and is below what the estimate is worth
            let uneven = sum.count.abs_diff(right[i].1) as f32 / items.len() as f32;
            let cost = (sum.cost() + right[i].0) * (1.0 + uneven * 1e-6);
            if best.is_none_or(|(least, _, _)| cost < least) {
                best = Some((cost, axis, i));
            }
        }
    }
    match best {
        // all centres in one bin
        None => halve(items),
        Some((_, axis, plane)) => partition(items, |item| bins.of(item)[axis] < plane as u32),
    }
}

/// Moves the items of the left side to the front: their number, and both sides' bounds.
#[inline(always)]
fn partition(items: &mut [Item], is_left: impl Fn(&Item) -> bool) -> (usize, Range, Range) {
    let (mut left, mut right) = (Range::EMPTY, Range::EMPTY);
    let (mut i, mut j) = (0, items.len());
    while i < j {
        if is_left(&items[i]) {
            left = left.with(&items[i]);
            i += 1;
        } else {
            j -= 1;
            items.swap(i, j);
            right = right.with(&items[j]);
        }
    }
    (i, left, right)
}
