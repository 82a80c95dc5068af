//! The upper part of a tree over many boxes: decided by what lies in the cells of a grid, so that each box moves once.
//!
//! Level by level, as below ([`super::sah`]), each would be read twice and moved once a level, from memory: the levels above [`super::sah`]'s subtrees
//! took as long as half of those below. A cell has the bounds of the boxes whose centres it holds, and what is divided is the list of cells, at any plane
//! between them where the surface area heuristic expects least work.

use glam::Vec4;

use super::divide::{Bounds, Item, cheapest};
use super::layout::Aabb;
use super::sah::Boxes;
use super::{Fork, join};
use crate::memory::zeros;

/// Most cells along an axis.
const ALONG: usize = 64;
/// Boxes of a cell, on average over all of the grid.
const PER_CELL: usize = 32;
/// So many boxes are looked at by one thread.
const CHUNK: usize = 1 << 20;
/// Most tables, of some 10 MB each, that are filled at a time.
const TABLES: usize = 4;
/// Deeper nodes are not divided here.
const MAX_DEPTH: usize = 40;

/// Boxes by the buckets of the upper part.
pub(super) struct Sorted {
    /// Those of a bucket are neighbours, in the order of their numbers; buckets from left to right.
    pub items: Vec<Item>,
    /// What the tree is above them.
    pub top: Upper,
    /// How many boxes each bucket has, and their bounds.
    pub buckets: Vec<(usize, Bounds)>,
    /// Of each box by number, its bucket.
    pub places: Vec<u32>,
}

/// A node of the upper part.
pub(super) enum Upper {
    /// A bucket. What is below it is not decided here.
    Bucket,
    /// Divided; with the number of buckets below.
    Halves(usize, Box<[Upper; 2]>),
}

impl Upper {
    /// Buckets below.
    pub fn buckets(&self) -> usize {
        match self {
            Upper::Bucket => 1,
            Upper::Halves(buckets, _) => *buckets,
        }
    }
}

/// Sorts the boxes into buckets of at most `enough` each, as far as cells tell them apart.
pub(super) fn sort<B: Boxes + ?Sized>(boxes: &B, enough: usize, fork: &dyn Fork) -> Sorted {
    let count = boxes.count();
    let grid = Grid::new(&boxes.bounds(), count);
    let mut places: Vec<u32> = zeros(count);
    let table = Table::fill(boxes, &grid, &mut places, 0, fork, CHUNK.max(count.div_ceil(TABLES)));
    let mut cells = table.cells(&grid);
    let mut division = Division { enough, bucket_of: zeros(grid.cells()), counts: Vec::new() };
    let top = division.divide(&mut cells, 0);
    let Division { bucket_of, counts, .. } = division;
    rename(&mut places, &bucket_of, fork);
    let mut items: Vec<Item> = zeros(count);
    let mut buckets: Vec<(usize, Bounds)> = counts.iter().map(|&n| (n, Bounds::EMPTY)).collect();
    place(&mut items, &mut buckets, 0, boxes, &places, fork);
    Sorted { items, top, buckets, places }
}

/// Equal cells over the centres that there can be, as many along each axis.
struct Grid {
    start: Vec4,
    scale: Vec4,
    along: usize,
}

impl Grid {
    fn new(bounds: &Aabb, boxes: usize) -> Grid {
        let along = (1..ALONG).find(|n| n * n * n * PER_CELL >= boxes).unwrap_or(ALONG);
        // of doubled centres
        let start = bounds.lo.map(|x| 2.0 * x);
        let scale = std::array::from_fn::<_, 3, _>(|c| {
            let extent = 2.0 * bounds.hi[c] - start[c];
            // an axis without extent, or with one too small to divide by, has one cell
            if extent > f32::MIN_POSITIVE * ALONG as f32 { along as f32 / extent } else { 0.0 }
        });
        let four = |[x, y, z]: [f32; 3]| Vec4::new(x, y, z, 0.0);
        Grid { start: four(start), scale: four(scale), along }
    }
    fn cells(&self) -> usize {
        self.along.pow(3)
    }
    /// The cell of a doubled centre.
    #[inline(always)]
    fn of(&self, center: Vec4) -> usize {
        let position = ((center - self.start) * self.scale).to_array();
        // a negative one, of rounding, is 0
        let [x, y, z] = [0, 1, 2].map(|c| (position[c] as usize).min(self.along - 1));
        (z * self.along + y) * self.along + x
    }
    /// Where a cell is.
    fn at(&self, cell: usize) -> [usize; 3] {
        [cell % self.along, cell / self.along % self.along, cell / self.along / self.along]
    }
}

/// How many boxes each cell has, and their bounds.
struct Table {
    counts: Vec<u32>,
    bounds: Vec<Bounds>,
}

impl Table {
    /// Of the boxes from number `first` on, so many by one thread; writes the cell of each.
    fn fill<B: Boxes + ?Sized>(
        boxes: &B,
        grid: &Grid,
        places: &mut [u32],
        first: usize,
        fork: &dyn Fork,
        chunk: usize,
    ) -> Table {
        if places.len() > chunk {
            let (left, right) = places.split_at_mut(places.len() / 2);
            let second = first + left.len();
            let (mut sum, other) = join(
                fork,
                || Table::fill(boxes, grid, left, first, fork, chunk),
                || Table::fill(boxes, grid, right, second, fork, chunk),
            );
            sum.add(&other);
            return sum;
        }
        let mut table = Table { counts: zeros(grid.cells()), bounds: vec![Bounds::EMPTY; grid.cells()] };
        let numbers = first..first + places.len();
        for (place, aabb) in places.iter_mut().zip(boxes.of(numbers)) {
            let item = Item::new(&aabb, 0);
            let cell = grid.of(item.center());
            *place = cell as u32;
            table.counts[cell] += 1;
            table.bounds[cell] = table.bounds[cell].min(item.bounds());
        }
        table
    }

    fn add(&mut self, other: &Table) {
        for (to, from) in self.counts.iter_mut().zip(&other.counts) {
            *to += from;
        }
        for (to, from) in self.bounds.iter_mut().zip(&other.bounds) {
            *to = to.min(*from);
        }
    }

    /// Those that hold something.
    fn cells(&self, grid: &Grid) -> Vec<Cell> {
        let filled = self.counts.iter().zip(&self.bounds).enumerate().filter(|(_, (n, _))| **n > 0);
        filled.map(|(number, (&count, &bounds))| Cell { number, at: grid.at(number), count, bounds }).collect()
    }
}

/// A cell with boxes.
#[derive(Clone, Copy)]
struct Cell {
    number: usize,
    at: [usize; 3],
    count: u32,
    bounds: Bounds,
}

/// The cells on their way into buckets.
struct Division {
    /// A bucket of so many boxes need not be divided.
    enough: usize,
    /// By number of the cell.
    bucket_of: Vec<u32>,
    /// Boxes of each bucket.
    counts: Vec<usize>,
}

impl Division {
    fn divide(&mut self, cells: &mut [Cell], depth: usize) -> Upper {
        let count: usize = cells.iter().map(|c| c.count as usize).sum();
        let plane = if count <= self.enough || depth >= MAX_DEPTH { None } else { best(cells) };
        let Some((axis, plane)) = plane else {
            for cell in cells {
                self.bucket_of[cell.number] = self.counts.len() as u32;
            }
            self.counts.push(count);
            return Upper::Bucket;
        };
        let mut at = 0;
        for i in 0..cells.len() {
            if cells[i].at[axis] < plane {
                cells.swap(i, at);
                at += 1;
            }
        }
        let (left, right) = cells.split_at_mut(at);
        let halves = [self.divide(left, depth + 1), self.divide(right, depth + 1)];
        Upper::Halves(halves[0].buckets() + halves[1].buckets(), Box::new(halves))
    }
}

/// The axis and the first layer of cells on the right, of least expected work; none if all are in one cell.
fn best(cells: &[Cell]) -> Option<(usize, usize)> {
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in 0..3 {
        let (mut bounds, mut counts) = ([Bounds::EMPTY; ALONG], [0; ALONG]);
        for cell in cells {
            let layer = cell.at[axis];
            bounds[layer] = bounds[layer].min(cell.bounds);
            counts[layer] += cell.count;
        }
        let least = best.map_or(f32::INFINITY, |(cost, ..)| cost);
        if let Some((cost, plane)) = cheapest(&bounds, &counts, least) {
            best = Some((cost, axis, plane));
        }
    }
    best.map(|(_, axis, plane)| (axis, plane))
}

/// From cells to buckets.
fn rename(places: &mut [u32], bucket_of: &[u32], fork: &dyn Fork) {
    if places.len() <= CHUNK {
        return places.iter_mut().for_each(|place| *place = bucket_of[*place as usize]);
    }
    let (left, right) = places.split_at_mut(places.len() / 2);
    join(fork, || rename(left, bucket_of, fork), || rename(right, bucket_of, fork));
}

/// Writes the boxes of some buckets, from number `first` on, and their bounds. Each thread looks through all numbers for its own.
fn place<B: Boxes + ?Sized>(
    items: &mut [Item],
    buckets: &mut [(usize, Bounds)],
    first: usize,
    boxes: &B,
    places: &[u32],
    fork: &dyn Fork,
) {
    if items.len() > 2 * CHUNK && buckets.len() > 1 {
        let half = items.len() / 2;
        let mut before = 0;
        let mut ends = buckets.iter().map(|b| {
            before += b.0;
            before
        });
        // the last cut before the middle, with a bucket on each side
        let at = ends.position(|end| end >= half).map_or(1, |i| i.max(1)).min(buckets.len() - 1);
        let (left, right) = buckets.split_at_mut(at);
        let (a, b) = items.split_at_mut(left.iter().map(|b| b.0).sum());
        join(fork, || place(a, left, first, boxes, places, fork), || place(b, right, first + at, boxes, places, fork));
        return;
    }
    let mut next = 0;
    let mut room: Vec<usize> = Vec::with_capacity(buckets.len());
    for bucket in buckets.iter() {
        room.push(next);
        next += bucket.0;
    }
    for (number, &place) in places.iter().enumerate() {
        let bucket = (place as usize).wrapping_sub(first);
        if let Some(to) = room.get_mut(bucket) {
            let item = Item::new(&boxes.one(number), number as u32);
            buckets[bucket].1 = buckets[bucket].1.min(item.bounds());
            items[*to] = item;
            *to += 1;
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
        random_boxes(&mut Rng(4), n, 0.2)
    }

    /// Each box once, in its bucket, whose boxes lie together by number; bounds are theirs, and no bucket is larger than it needs to be.
    fn check(boxes: &[Aabb], enough: usize, sorted: &Sorted) {
        assert_eq!(sorted.top.buckets(), sorted.buckets.len());
        let mut first = 0;
        for (bucket, (count, bounds)) in sorted.buckets.iter().enumerate() {
            let items = &sorted.items[first..first + count];
            let numbers: Vec<u32> = items.iter().map(Item::number).collect();
            let expected = (0..boxes.len() as u32).filter(|&n| sorted.places[n as usize] == bucket as u32);
            assert!(numbers.iter().copied().eq(expected));
            let own = numbers.iter().fold(Aabb::EMPTY, |sum, &n| sum.union(&boxes[n as usize]));
            assert_eq!(bounds.aabb(), own);
            assert!((1..=enough).contains(count));
            first += count;
        }
        assert_eq!(first, boxes.len());
    }

    /// Threads that take turns the other way round.
    struct Backwards;

    impl Fork for Backwards {
        fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
            b();
            a();
        }
    }

    #[test]
    fn each_box_is_in_a_bucket_whoever_does_the_work() {
        let boxes = boxes(3 * CHUNK);
        let enough = 40_000;
        let sorted = sort(&boxes[..], enough, &Serial);
        check(&boxes, enough, &sorted);
        let others = sort(&boxes[..], enough, &Backwards);
        assert!(sorted.items.iter().map(Item::number).eq(others.items.iter().map(Item::number)));
        assert_eq!(sorted.buckets.len(), others.buckets.len());
    }

    #[test]
    fn what_no_plane_tells_apart_is_one_bucket() {
        let mut boxes = vec![Aabb { lo: [1.0; 3], hi: [2.0; 3] }; 1000];
        let sorted = sort(&boxes[..], 10, &Serial);
        check(&boxes, 1000, &sorted);
        assert_eq!(sorted.top.buckets(), 1);
        // far away from all others; flat along an axis
        boxes.push(Aabb { lo: [1e30, 1.0, 1.0], hi: [1e30, 2.0, 1.0] });
        let sorted = sort(&boxes[..], 10, &Serial);
        check(&boxes, 1000, &sorted);
        assert_eq!(sorted.top.buckets(), 2);
    }

    /// Planes between cells are little worse than those between bins: by the areas of all nodes.
    #[test]
    fn cells_divide_as_well_as_bins() {
        let mut boxes = boxes(20_000);
        // most in a corner
        boxes[..15_000].iter_mut().for_each(|b| (b.lo, b.hi) = (b.lo.map(|x| x * 0.1), b.hi.map(|x| x * 0.1)));
        let mut sorted = sort(&boxes[..], 1000, &Serial);
        check(&boxes, 20_000, &sorted);
        let by_bins = areas(&mut sorted.items.clone());
        let by_cells = areas_of(&sorted.top, &sorted.buckets, &mut sorted.items).1;
        assert!(by_cells < 1.02 * by_bins, "{by_cells} {by_bins}");
    }

    fn areas_of(top: &Upper, buckets: &[(usize, Bounds)], items: &mut [Item]) -> (Bounds, f64) {
        let Upper::Halves(_, halves) = top else { return (buckets[0].1, areas(items)) };
        let (first, second) = buckets.split_at(halves[0].buckets());
        let (left, right) = items.split_at_mut(first.iter().map(|b| b.0).sum());
        let (a, b) = (areas_of(&halves[0], first, left), areas_of(&halves[1], second, right));
        let bounds = a.0.min(b.0);
        (bounds, a.1 + b.1 + f64::from(bounds.half_area()))
    }

    /// Sum over the nodes of a tree that is divided by bins.
    fn areas(items: &mut [Item]) -> f64 {
        let bounds = items.iter().fold(Bounds::EMPTY, |sum, item| sum.min(item.bounds()));
        if items.len() < 2 {
            return 0.0;
        }
        let at = super::super::divide::divide(items).0;
        let (left, right) = items.split_at_mut(at);
        areas(left) + areas(right) + f64::from(bounds.half_area())
    }
}
