//! Boxes on their way through the partitions of a tree that is built from above: in two, where the surface area heuristic expects least work.
//!
//! Bounds are held as minima: a box's lower corner beside the negated upper one. Nothing here branches on where a box lies, as that cannot be foretold.

use bytemuck::{Pod, Zeroable};
use glam::Vec4;

use super::layout::Aabb;

/// From so few boxes on all ways to divide them are tried; they do not fill bins.
const ALL_WAYS: usize = 5;

/// A lower corner and a negated upper one; what their last lanes hold does not matter.
#[derive(Clone, Copy)]
struct Lanes {
    lo: Vec4,
    negated: Vec4,
}

impl Lanes {
    /// Of nothing.
    const EMPTY: Lanes = Lanes { lo: Vec4::INFINITY, negated: Vec4::INFINITY };

    #[inline(always)]
    fn min(self, other: Lanes) -> Lanes {
        Lanes { lo: self.lo.min(other.lo), negated: self.negated.min(other.negated) }
    }
    #[inline(always)]
    fn plus(self, x: f32) -> Lanes {
        Lanes { lo: self.lo + x, negated: self.negated + x }
    }
    /// Half the surface area of the box.
    #[inline(always)]
    fn half_area(&self) -> f32 {
        // the negated extent: products of two
        let d = self.lo + self.negated;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

/// A box and its number.
#[repr(C, align(32))]
#[derive(Clone, Copy, Pod, Zeroable)]
pub(super) struct Item {
    /// Lower corner; then the low 16 bits of the number as a small float, so that vector arithmetic on all lanes meets no denormals and no NaN.
    lo: [f32; 4],
    /// Negated upper corner; then the high 16 bits.
    negated: [f32; 4],
}

impl Item {
    pub fn new(b: &Aabb, number: u32) -> Item {
        // adding 0 turns -0 into 0: minima and maxima of zeros of either sign differ from one processor to the next. So all zeros of lower corners are
        // 0 and all of negated upper ones -0
        let [lo, hi] = [b.lo, b.hi].map(|p| p.map(|x| x + 0.0));
        let [low, high] = [number & 0xffff, number >> 16].map(|half| half as f32);
        Item { lo: [lo[0], lo[1], lo[2], low], negated: [-hi[0], -hi[1], -hi[2], high] }
    }
    pub fn number(&self) -> u32 {
        self.lo[3] as u32 | (self.negated[3] as u32) << 16
    }
    #[inline(always)]
    fn bounds(&self) -> Lanes {
        Lanes { lo: Vec4::from_array(self.lo), negated: Vec4::from_array(self.negated) }
    }
    /// Twice the centre.
    #[inline(always)]
    fn center(&self) -> Vec4 {
        let Lanes { lo, negated } = self.bounds();
        lo - negated
    }
    /// The box of that alone.
    #[inline(always)]
    fn centers(&self) -> Lanes {
        let c = self.center();
        Lanes { lo: c, negated: -c }
    }
}

/// Bounds of some boxes and of their (doubled) centres.
#[derive(Clone, Copy)]
pub(super) struct Range {
    bounds: Lanes,
    centers: Lanes,
}

impl Range {
    pub const EMPTY: Range = Range { bounds: Lanes::EMPTY, centers: Lanes::EMPTY };

    #[inline(always)]
    pub fn with(self, item: &Item) -> Range {
        Range { bounds: self.bounds.min(item.bounds()), centers: self.centers.min(item.centers()) }
    }
    pub fn and(self, other: &Range) -> Range {
        Range { bounds: self.bounds.min(other.bounds), centers: self.centers.min(other.centers) }
    }
    #[inline(always)]
    fn of(items: &[Item]) -> Range {
        items.iter().fold(Range::EMPTY, Range::with)
    }
    #[inline(always)]
    pub fn aabb(&self) -> Aabb {
        let Lanes { lo, negated } = self.bounds;
        Aabb { lo: lo.truncate().to_array(), hi: (-negated).truncate().to_array() }
    }
}

/// Where some boxes were divided: how many are on the left, and both sides' bounds.
pub(super) type Halves = (usize, Range, Range);

/// Divides two boxes or more, where it costs least, and moves those of the left side to the front.
#[inline(always)]
pub(super) fn divide(items: &mut [Item], range: &Range) -> Halves {
    match items.len() {
        2 => halve(items),
        3 => all_ways::<3, 8>(items),
        4 => all_ways::<4, 16>(items),
        ALL_WAYS => all_ways::<5, 32>(items),
        // few boxes do not fill many bins
        6 => binned::<4>(items, range),
        7..=40 => binned::<8>(items, range),
        _ => binned::<16>(items, range),
    }
}

/// The first half and the second, as they stand.
#[inline(always)]
pub(super) fn halve(items: &[Item]) -> Halves {
    let (left, right) = items.split_at(items.len() / 2);
    (left.len(), Range::of(left), Range::of(right))
}

/// The best of all ways to divide N boxes; `SETS` is 2^N.
#[inline(always)]
fn all_ways<const N: usize, const SETS: usize>(items: &mut [Item]) -> Halves {
    let own: [Item; N] = std::array::from_fn(|i| items[i]);
    // by set of boxes: its bounds, and the work it is worth
    let mut bounds = [Lanes::EMPTY; SETS];
    let mut costs = [0.0; SETS];
    for set in 1..SETS - 1 {
        bounds[set] = bounds[set & (set - 1)].min(own[set.trailing_zeros() as usize].bounds());
        costs[set] = bounds[set].half_area() * set.count_ones() as f32;
    }
    // the first box is on the left; of equals the one that comes first, so that all is as it stands where nothing is gained
    let (mut least, mut best) = (f32::INFINITY, 1);
    for set in (1..SETS - 1).step_by(2) {
        let cost = costs[set] + costs[SETS - 1 - set];
        // a millionth of the cost decides between equals and is below what the estimate is worth
        let uneven = set.count_ones().abs_diff(N as u32 - set.count_ones()) as f32 / N as f32;
        let cost = cost * (1.0 + uneven * 1e-6);
        if cost < least {
            (least, best) = (cost, set);
        }
    }
    let mut to = 0;
    for side in [1, 0] {
        for (i, item) in own.iter().enumerate() {
            if best >> i & 1 == side {
                items[to] = *item;
                to += 1;
            }
        }
    }
    let at = best.count_ones() as usize;
    (at, Range::of(&items[..at]), Range::of(&items[at..]))
}

/// From a doubled centre to its bin on each axis.
struct Bins<const B: usize> {
    start: Vec4,
    scale: Vec4,
}

impl<const B: usize> Bins<B> {
    #[inline(always)]
    fn new(range: &Range) -> Self {
        let Lanes { lo: start, negated } = range.centers;
        let extent = -(start + negated);
        // an axis without extent, or with one too small to divide by, has one bin
        let scale = extent.to_array().map(|x| if x > f32::MIN_POSITIVE * B as f32 { B as f32 / x } else { 0.0 });
        Bins { start, scale: Vec4::from_array(scale) }
    }
    /// Whether the bin of an item lies below a plane: what the clamps of [`Bins::of`] change is on the same side.
    #[inline(always)]
    fn is_below(&self, item: &Item, axis: usize, plane: usize) -> bool {
        let (start, scale) = (self.start.to_array()[axis], self.scale.to_array()[axis]);
        let position = (item.lo[axis] - item.negated[axis] - start) * scale - 0.5;
        position + 8_388_608.0 < 8_388_608.0 + plane as f32
    }
    /// A float of 2^23 + k has k in its low bits, rounded to nearest; half a bin less rounds down.
    #[inline(always)]
    fn of(&self, item: &Item) -> [u32; 4] {
        let position = (item.center() - self.start) * self.scale - 0.5;
        let clamped = position.max(Vec4::ZERO).min(Vec4::splat(B as f32 - 1.0));
        (clamped + 8_388_608.0).to_array().map(|x| x.to_bits() & (B as u32 - 1))
    }
}

/// Divides at the cheapest of B - 1 planes on each axis.
#[inline(always)]
fn binned<const B: usize>(items: &mut [Item], range: &Range) -> Halves {
    const { assert!(B.is_power_of_two() && B <= 1 << 16) };
    let bins = Bins::<B>::new(range);
    let mut bounds = [[Lanes::EMPTY; B]; 3];
    let mut counts = [[0u32; B]; 3];
    let mut add = |item: &Item| {
        let k = bins.of(item);
        for axis in 0..3 {
            let bin = k[axis] as usize;
            bounds[axis][bin] = bounds[axis][bin].min(item.bounds());
            counts[axis][bin] += 1;
        }
    };
    // neighbours mostly go to one bin, where each waits for the one before: two that are far apart are taken in turn
    let (first, second) = items.split_at(items.len() / 2);
    for (a, b) in first.iter().zip(second) {
        add(a);
        add(b);
    }
    second[first.len()..].iter().for_each(add);
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in 0..3 {
        let mut right = [(0.0, 0u32); B];
        let (mut sum, mut count) = (Lanes::EMPTY, 0);
        for i in (1..B).rev() {
            (sum, count) = (sum.min(bounds[axis][i]), count + counts[axis][i]);
            right[i] = (if count > 0 { sum.half_area() * count as f32 } else { 0.0 }, count);
        }
        let (mut sum, mut count) = (Lanes::EMPTY, 0);
        for i in 1..B {
            (sum, count) = (sum.min(bounds[axis][i - 1]), count + counts[axis][i - 1]);
            if count == 0 || right[i].1 == 0 {
                continue;
            }
            // as above
            let uneven = count.abs_diff(right[i].1) as f32 / items.len() as f32;
            let cost = (sum.half_area() * count as f32 + right[i].0) * (1.0 + uneven * 1e-6);
            if best.is_none_or(|(least, _, _)| cost < least) {
                best = Some((cost, axis, i));
            }
        }
    }
    // all centres in one bin
    let Some((_, axis, plane)) = best else { return halve(items) };
    let of = |bins: &[Lanes]| bins.iter().fold(Lanes::EMPTY, |sum, bin| sum.min(*bin));
    let (left, right) = bounds[axis].split_at(plane);
    let (left, right) = (of(left), of(right));
    let (at, left_centers, right_centers) = partition(items, |item| bins.is_below(item, axis, plane));
    (at, Range { bounds: left, centers: left_centers }, Range { bounds: right, centers: right_centers })
}

/// Moves the items of the left side to the front: their number, and the bounds of both sides' centres.
#[inline(always)]
fn partition(items: &mut [Item], is_left: impl Fn(&Item) -> bool) -> (usize, Lanes, Lanes) {
    // what is added to what is of no account on a side
    const NO: [f32; 2] = [f32::INFINITY, 0.0];
    let (mut left_sum, mut right_sum) = (Lanes::EMPTY, Lanes::EMPTY);
    let mut at = 0;
    for i in 0..items.len() {
        let item = items[i];
        let (left, centers) = (usize::from(is_left(&item)), item.centers());
        // what stands at the end of the left side comes here, or this stays
        items[i] = items[at];
        items[at] = item;
        left_sum = left_sum.min(centers.plus(NO[left]));
        right_sum = right_sum.min(centers.plus(NO[1 - left]));
        at += left;
    }
    (at, left_sum, right_sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    fn items(rng: &mut Rng, n: usize) -> Vec<Item> {
        let one = |i: usize, rng: &mut Rng| {
            let (p, size) = (rng.vec3(10.0), rng.vec3(2.0).abs());
            Item::new(&Aabb { lo: (p - size).to_array(), hi: (p + size).to_array() }, (i * 70_001) as u32)
        };
        (0..n).map(|i| one(i, rng)).collect()
    }

    fn cost(items: &[Item]) -> f32 {
        Range::of(items).aabb().half_area() * items.len() as f32
    }

    fn same(a: &Range, b: &Range) -> bool {
        let corners = |r: &Range| [r.bounds, r.centers].map(|l| (l.lo.truncate(), l.negated.truncate()));
        corners(a) == corners(b)
    }

    #[test]
    fn bins_below_a_plane_are_told_without_them() {
        let mut rng = Rng(3);
        let all = items(&mut rng, 200);
        // most lie outside of the range whose bins these are
        let bins = Bins::<8>::new(&Range::of(&all[..20]));
        for item in &all {
            for axis in 0..3 {
                for plane in 1..8 {
                    assert_eq!(bins.is_below(item, axis, plane), bins.of(item)[axis] < plane as u32);
                }
            }
        }
    }

    /// Each item is on one side, and bounds are those of the sides.
    #[test]
    fn both_sides_are_told_as_they_are() {
        let mut rng = Rng(1);
        for n in [2, 3, 4, 5, 6, 7, 40, 41, 1000] {
            let mut items = items(&mut rng, n);
            let range = Range::of(&items);
            let (at, left, right) = divide(&mut items, &range);
            assert!(0 < at && at < n);
            assert!(same(&left, &Range::of(&items[..at])) && same(&right, &Range::of(&items[at..])));
            let mut numbers: Vec<u32> = items.iter().map(Item::number).collect();
            numbers.sort_unstable();
            assert!(numbers.into_iter().eq((0..n).map(|i| (i * 70_001) as u32)));
        }
        // nothing to choose
        let mut alike = vec![items(&mut rng, 1)[0]; 64];
        let range = Range::of(&alike);
        assert_eq!(divide(&mut alike, &range).0, 32);
        assert_eq!(divide(&mut alike[..5], &range).0, 2);
    }

    /// Of few no way is better, of many no plane between bins by more than its rounding.
    #[test]
    fn nothing_is_cheaper() {
        let mut rng = Rng(2);
        for n in [3, 4, 5] {
            for _ in 0..50 {
                let mut all = items(&mut rng, n);
                let before = all.clone();
                let range = Range::of(&all);
                let (at, ..) = divide(&mut all, &range);
                let found = cost(&all[..at]) + cost(&all[at..]);
                for set in 1..(1 << n) - 1 {
                    let side =
                        |which| -> Vec<Item> { (0..n).filter(|i| set >> i & 1 == which).map(|i| before[i]).collect() };
                    let other = cost(&side(0)) + cost(&side(1));
                    assert!(found <= other * (1.0 + 2e-6), "{n}: {found} {other}");
                }
            }
        }
        let mut all = items(&mut rng, 500);
        let range = Range::of(&all);
        let bins = Bins::<16>::new(&range);
        let mut cheapest = f32::INFINITY;
        for axis in 0..3 {
            for plane in 1..16 {
                let (a, b): (Vec<Item>, Vec<Item>) = all.iter().partition(|item| bins.of(item)[axis] < plane);
                if !a.is_empty() && !b.is_empty() {
                    cheapest = cheapest.min(cost(&a) + cost(&b));
                }
            }
        }
        let (at, ..) = divide(&mut all, &range);
        assert!((cost(&all[..at]) + cost(&all[at..]) - cheapest).abs() <= 2e-6 * cheapest);
    }
}
