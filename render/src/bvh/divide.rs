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
pub(super) struct Bounds {
    lo: Vec4,
    negated: Vec4,
}

impl Bounds {
    /// Of nothing.
    pub const EMPTY: Bounds = Bounds { lo: Vec4::INFINITY, negated: Vec4::INFINITY };

    #[inline(always)]
    pub fn min(self, other: Bounds) -> Bounds {
        Bounds { lo: self.lo.min(other.lo), negated: self.negated.min(other.negated) }
    }
    /// Of some boxes.
    #[inline(always)]
    fn of(items: &[Item]) -> Bounds {
        items.iter().fold(Bounds::EMPTY, |sum, item| sum.min(item.bounds()))
    }
    #[inline(always)]
    pub fn aabb(&self) -> Aabb {
        Aabb { lo: self.lo.truncate().to_array(), hi: (-self.negated).truncate().to_array() }
    }
    #[inline(always)]
    fn negated_extent(&self) -> Vec4 {
        self.lo + self.negated
    }
    /// Half the surface area of the box.
    #[inline(always)]
    pub fn half_area(&self) -> f32 {
        half_area(self.negated_extent().to_array())
    }
}

/// Of a box with this extent or, as it is made of products of two, this negated one.
#[inline(always)]
fn half_area([x, y, z, _]: [f32; 4]) -> f32 {
    x * y + y * z + z * x
}

/// A box and its number.
#[repr(C, align(16))]
#[derive(Clone, Copy, Pod, Zeroable)]
pub(super) struct Item {
    /// Lower corner; then the low 16 bits of the number as a small float, so that vector arithmetic on all lanes meets no denormals and no NaN.
    lo: [f32; 4],
    /// Negated upper corner; then the high 16 bits.
    negated: [f32; 4],
}

impl Item {
    #[inline(always)]
    pub fn new(b: &Aabb, number: u32) -> Item {
        // adding 0 turns -0 into 0: minima and maxima of zeros of either sign differ from one processor to the next. So all zeros of lower corners are
        // 0 and all of negated upper ones -0
        let (lo, hi) = (b.lo, b.hi);
        let (low, high) = ((number & 0xffff) as f32, (number >> 16) as f32);
        Item {
            lo: [lo[0] + 0.0, lo[1] + 0.0, lo[2] + 0.0, low],
            negated: [-(hi[0] + 0.0), -(hi[1] + 0.0), -(hi[2] + 0.0), high],
        }
    }
    pub fn number(&self) -> u32 {
        self.lo[3] as u32 | (self.negated[3] as u32) << 16
    }
    #[inline(always)]
    pub fn bounds(&self) -> Bounds {
        Bounds { lo: Vec4::from_array(self.lo), negated: Vec4::from_array(self.negated) }
    }
    /// Twice the centre.
    #[inline(always)]
    pub fn center(&self) -> Vec4 {
        let Bounds { lo, negated } = self.bounds();
        lo - negated
    }
}

/// Where some boxes were divided: how many are on the left, and both sides' bounds.
pub(super) type Halves = (usize, Bounds, Bounds);

/// Divides two boxes or more, where it costs least, and moves those of the left side to the front.
#[inline(always)]
pub(super) fn divide(items: &mut [Item]) -> Halves {
    match items.len() {
        2 => halve(items),
        3 => all_ways::<3, 8>(items),
        4 => all_ways::<4, 16>(items),
        ALL_WAYS => all_ways::<5, 32>(items),
        // few boxes do not fill many bins
        6 => binned::<4>(items),
        7..=40 => binned::<8>(items),
        _ => binned::<16>(items),
    }
}

/// The first half and the second, as they stand.
#[inline(always)]
pub(super) fn halve(items: &[Item]) -> Halves {
    let (left, right) = items.split_at(items.len() / 2);
    (left.len(), Bounds::of(left), Bounds::of(right))
}

/// The best of all ways to divide N boxes; `SETS` is 2^N.
#[inline(always)]
fn all_ways<const N: usize, const SETS: usize>(items: &mut [Item]) -> Halves {
    let own: [Item; N] = std::array::from_fn(|i| items[i]);
    // by set of boxes: its bounds, and the work it is worth
    let mut bounds = [Bounds::EMPTY; SETS];
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
    (best.count_ones() as usize, bounds[best], bounds[SETS - 1 - best])
}

/// From a doubled centre to its bin on each axis.
struct Bins<const B: usize> {
    start: Vec4,
    scale: Vec4,
}

impl<const B: usize> Bins<B> {
    #[inline(always)]
    fn new(items: &[Item]) -> Self {
        // least and largest; halves in turn, as each waits for the one before
        let both = |(least, most): (Vec4, Vec4), item: &Item| {
            let c = item.center();
            (least.min(c), most.max(c))
        };
        let nothing = (Vec4::INFINITY, Vec4::NEG_INFINITY);
        let (left, right) = items.split_at(items.len() / 2);
        let (mut a, mut b) = (nothing, right[left.len()..].iter().fold(nothing, both));
        for (x, y) in left.iter().zip(right) {
            (a, b) = (both(a, x), both(b, y));
        }
        let start = a.0.min(b.0);
        let extent = a.1.max(b.1) - start;
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
fn binned<const B: usize>(items: &mut [Item]) -> Halves {
    const { assert!(B.is_power_of_two() && B <= 1 << 16) };
    let bins = Bins::<B>::new(items);
    let mut bounds = [[Bounds::EMPTY; B]; 3];
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
        let least = best.map_or(f32::INFINITY, |(cost, ..)| cost);
        if let Some((cost, plane)) = cheapest(&bounds[axis], &counts[axis], least) {
            best = Some((cost, axis, plane));
        }
    }
    // all centres in one bin
    let Some((_, axis, plane)) = best else { return halve(items) };
    let of = |bins: &[Bounds]| bins.iter().fold(Bounds::EMPTY, |sum, bin| sum.min(*bin));
    let (left, right) = bounds[axis].split_at(plane);
    let at = partition(items, |item| bins.is_below(item, axis, plane));
    (at, of(left), of(right))
}

/// The cheapest of the planes between B layers, if it costs less than `least`: its cost, and the first layer on its right. Of each layer the bounds and the
/// number of its boxes.
#[inline(always)]
pub(super) fn cheapest<const B: usize>(bounds: &[Bounds; B], counts: &[u32; B], least: f32) -> Option<(f32, usize)> {
    // of what lies on both sides of the plane below each layer: numbers and negated extents. Of nothing these are infinite, which makes the cost a NaN
    let mut numbers = [[0.0; B]; 2];
    let mut extents = [[[0.0; 4]; B]; 2];
    let (mut sum, mut count) = (Bounds::EMPTY, 0);
    for i in (1..B).rev() {
        (sum, count) = (sum.min(bounds[i]), count + counts[i]);
        (numbers[1][i], extents[1][i]) = (count as f32, sum.negated_extent().to_array());
    }
    let all = (count + counts[0]) as f32;
    let (mut sum, mut count) = (Bounds::EMPTY, 0);
    for i in 1..B {
        (sum, count) = (sum.min(bounds[i - 1]), count + counts[i - 1]);
        (numbers[0][i], extents[0][i]) = (count as f32, sum.negated_extent().to_array());
    }
    let mut costs = [f32::NAN; B];
    for i in 1..B {
        let [left, right] = [0, 1].map(|side| half_area(extents[side][i]) * numbers[side][i]);
        // as in `all_ways`
        let uneven = (numbers[0][i] - numbers[1][i]).abs() / all;
        costs[i] = (left + right) * (1.0 + uneven * 1e-6);
    }
    let mut best = (least, 0);
    for i in 1..B {
        if costs[i] < best.0 {
            best = (costs[i], i);
        }
    }
    (best.1 > 0).then_some(best)
}

/// Moves the items of the left side to the front: their number.
#[inline(always)]
fn partition(items: &mut [Item], is_left: impl Fn(&Item) -> bool) -> usize {
    let mut at = 0;
    for i in 0..items.len() {
        let left = is_left(&items[i]);
        // what stands at the end of the left side comes here, or this stays
        items.swap(i, at);
        at += usize::from(left);
    }
    at
}

#[cfg(test)]
mod tests {
    use super::super::testing::random_boxes;
    use super::*;
    use crate::testing::Rng;

    fn items(rng: &mut Rng, n: usize) -> Vec<Item> {
        let boxes = random_boxes(rng, n, 2.0);
        boxes.iter().enumerate().map(|(i, b)| Item::new(b, (i * 70_001) as u32)).collect()
    }

    fn cost(items: &[Item]) -> f32 {
        Bounds::of(items).aabb().half_area() * items.len() as f32
    }

    fn same(a: &Bounds, b: &Bounds) -> bool {
        (a.lo.truncate(), a.negated.truncate()) == (b.lo.truncate(), b.negated.truncate())
    }

    #[test]
    fn bins_below_a_plane_are_told_without_them() {
        let mut rng = Rng(3);
        let all = items(&mut rng, 200);
        // most lie outside of the range whose bins these are
        let bins = Bins::<8>::new(&all[..20]);
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
            let (at, left, right) = divide(&mut items);
            assert!(0 < at && at < n);
            assert!(same(&left, &Bounds::of(&items[..at])) && same(&right, &Bounds::of(&items[at..])));
            let mut numbers: Vec<u32> = items.iter().map(Item::number).collect();
            numbers.sort_unstable();
            assert!(numbers.into_iter().eq((0..n).map(|i| (i * 70_001) as u32)));
        }
        // nothing to choose
        let mut alike = vec![items(&mut rng, 1)[0]; 64];
        assert_eq!(divide(&mut alike).0, 32);
        assert_eq!(divide(&mut alike[..5]).0, 2);
    }

    /// Of few no way is better, of many no plane between bins by more than its rounding.
    #[test]
    fn nothing_is_cheaper() {
        let mut rng = Rng(2);
        for n in [3, 4, 5] {
            for _ in 0..50 {
                let mut all = items(&mut rng, n);
                let before = all.clone();
                let (at, ..) = divide(&mut all);
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
        let bins = Bins::<16>::new(&all);
        let mut cheapest = f32::INFINITY;
        for axis in 0..3 {
            for plane in 1..16 {
                let (a, b): (Vec<Item>, Vec<Item>) = all.iter().partition(|item| bins.of(item)[axis] < plane);
                if !a.is_empty() && !b.is_empty() {
                    cheapest = cheapest.min(cost(&a) + cost(&b));
                }
            }
        }
        let (at, ..) = divide(&mut all);
        assert!((cost(&all[..at]) + cost(&all[at..]) - cheapest).abs() <= 2e-6 * cheapest);
    }
}
