//! Where a ray goes next: the cells in which it can hit something, in a fixed order.
//!
//! # Why no hit is missed
//!
//! What the kernel promises (derived in `rayherd_render::bvh::trace`'s setup; u = 2^-24, M the largest magnitude of a
//! coordinate of the ray's origin and of the scene): a hit reported at `t` on a triangle has a point P of it with
//! |P - (o + T d)| <= 12 u M along every axis, its (1), and |t - T| |d| <= 28 u M along every axis, its (3). So
//! `o + t d` is within 40 u M of P; for spheres it is less. P lies in some cell, its primitive is registered there, and
//! P is in the cell's tight box. Boxes are padded here by 64 u M, so the ray is inside the padded box at `t`: the cell
//! is found, with a lower bound of at most `t`. The arithmetic is f64 on f32 input: its error, below 2^-49 M in
//! position, vanishes in the rest of the pad, and so does a component of the direction that the kernel takes for 0
//! (below 2^-50 of the largest: 2^-49 M over the scene's length).
//!
//! # Order
//!
//! Cells are ordered by (lower bound of t, number). Both are functions of ray and grid alone, not of `tmax` or of
//! what is resident, so *the last cell visited* says all about how far a ray is: that is its [`Progress`]. No sorting
//! and no counting is needed: the next cell is the least key above the last one.

use rayherd_render::ray::Ray;

use super::boxes::Quick;
use super::{Grid, Outside, SplitSet};

/// How far a ray has come on its way through the grid: the last cell it was sent to. Opaque, fits a wire record.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Progress(pub u32);

impl Progress {
    /// No cell yet.
    pub const START: Progress = Progress(0);
}

/// A cell that a ray must still visit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Foreign<'a> {
    /// To be kept with the ray, for the next call.
    pub progress: Progress,
    /// The cell's number.
    pub cell: u32,
    /// No hit in the cell is nearer.
    pub t: f64,
    /// Its owners, ascending.
    pub owners: &'a [u32],
}

/// Pad of boxes relative to the largest coordinate, 64 u: see the module's text.
const PAD: f64 = 1.0 / (1u64 << 18) as f64;

/// Stands in for 1/0: any distance of f32 size times this is beyond every tmax, and 0 times it is no NaN.
const BEYOND: f64 = 1e300;

/// A ray in f64 with what every box test needs.
#[derive(Clone, Copy, Debug)]
pub(super) struct WalkRay {
    pub(super) o: [f64; 3],
    pub(super) d: [f64; 3],
    inverse: [f64; 3],
    pub(super) pad: f64,
    pub(super) tmin: f64,
    tmax: f64,
}

impl WalkRay {
    /// `None` for a ray with NaN or infinity in origin or direction, or without a direction: it hits nothing.
    pub(super) fn new(ray: &Ray, magnitude: f64) -> Option<Self> {
        if ray.d == [0.0; 3] || ray.o.iter().chain(&ray.d).any(|x| !x.is_finite()) {
            return None;
        }
        let (o, d) = (ray.o.map(f64::from), ray.d.map(f64::from));
        let reach = o.iter().fold(magnitude, |m, x| m.max(x.abs()));
        Some(WalkRay {
            o,
            d,
            inverse: d.map(|x| if x == 0.0 { BEYOND } else { x.recip() }),
            pad: reach * PAD,
            tmin: f64::from(ray.tmin).max(0.0),
            tmax: f64::from(ray.tmax),
        })
    }

    /// Where the ray is inside the slab `lo..hi` of an axis, widened by `pad` on both sides.
    #[inline]
    fn slab(&self, axis: usize, lo: f64, hi: f64, pad: f64) -> (f64, f64) {
        let a = ((lo - pad) - self.o[axis]) * self.inverse[axis];
        let b = ((hi + pad) - self.o[axis]) * self.inverse[axis];
        if a <= b { (a, b) } else { (b, a) }
    }

    /// Lower bound of t inside the padded box, at least `tmin`; `None` when the line misses it or it lies before
    /// `tmin`. Does not look at `tmax`.
    #[inline]
    pub(super) fn enter(&self, lo: &[f32; 3], hi: &[f32; 3]) -> Option<f64> {
        let mut near = self.tmin;
        let mut far = f64::INFINITY;
        for a in 0..3 {
            let (n, f) = self.slab(a, f64::from(lo[a]), f64::from(hi[a]), self.pad);
            near = near.max(n);
            far = far.min(f);
        }
        (near <= far).then_some(near)
    }
}

impl Grid {
    /// The next cell after `from` in which `ray` can hit something at or before `ray.tmax` and that has an owner
    /// that is not resident; `None` when there is none: then the best candidate so far is the nearest hit of all.
    ///
    /// A progress that names no cell counts as [`Progress::START`] (nothing is missed). A ray with NaN, or without a
    /// direction, hits nothing.
    pub fn next_foreign(&self, ray: &Ray, from: Progress, outside: &Outside) -> Option<Foreign<'_>> {
        self.next_foreign_counted(ray, from, outside, &mut 0)
    }

    /// The same; adds to `missed` the cells with an owner that is not resident that it came near and whose tight boxes the ray misses: those on its way
    /// from plane to plane, or those of the eights of neighbours that it entered.
    pub fn next_foreign_counted(
        &self,
        ray: &Ray,
        from: Progress,
        outside: &Outside,
        missed: &mut u64,
    ) -> Option<Foreign<'_>> {
        let lattice = self.lattice();
        let walk = WalkRay::new(ray, lattice.magnitude()).filter(|_| !outside.is_empty())?;
        if let Some(boxes) = &outside.boxes
            && let Some(quick) = Quick::new(&walk)
        {
            let last_key = self.key_of(from, &walk);
            let mut best: Option<(f64, u32)> = None;
            let passed = boxes.visit(&quick, walk.tmax, |number| {
                let cell = &self.cells[number as usize];
                if let Some(t) = walk.enter(&cell.lo, &cell.hi) {
                    let key = (t, number);
                    if t <= walk.tmax && last_key.is_none_or(|l| key > l) && best.is_none_or(|b| key < b) {
                        best = Some(key);
                    }
                }
                best.map_or(walk.tmax, |(t, _)| t)
            });
            *missed += if self.tight { passed } else { 0 };
            return best.map(|(t, number)| self.foreign(t, number));
        }
        // the axis that crosses most cells: along it a slab holds few cells of the ray
        let crossed = |a: usize| if lattice.count(a) > 1 { walk.d[a].abs() / lattice.width(a) } else { 0.0 };
        let mut major = 0;
        for a in 1..3 {
            if crossed(a) > crossed(major) {
                major = a;
            }
        }

        // cells are widened by twice the pad of boxes, so that a box that passes its test lies in a visited cell
        let wide = 2.0 * walk.pad;
        let (mut begin, mut end) = (walk.tmin, walk.tmax);
        for a in 0..3 {
            let (n, f) = walk.slab(a, f64::from(outside.lo[a]), f64::from(outside.hi[a]), wide);
            begin = begin.max(n);
            end = end.min(f);
        }
        if begin > end {
            return None;
        }
        let last_key = self.key_of(from, &walk);
        if let Some((t, _)) = last_key {
            begin = begin.max(t);
        }
        if begin > end {
            return None;
        }

        let [minor, other] = [(major + 1) % 3, (major + 2) % 3];
        let forward = walk.d[major] >= 0.0;
        let at_begin = walk.o[major] + begin * walk.d[major];
        let mut k = lattice.nearby(major, if forward { at_begin - wide } else { at_begin + wide });
        let mut best: Option<(f64, u32)> = None;
        loop {
            let (enter, leave) = walk.slab(major, lattice.plane(major, k), lattice.plane(major, k + 1), wide);
            let limit = best.map_or(end, |(t, _)| t);
            if enter > limit {
                break;
            }
            let (a, b) = (enter.max(begin), leave.min(limit));
            if a <= b {
                let (y0, y1) = self.range(minor, &walk, a, b, wide);
                let (z0, z1) = self.range(other, &walk, a, b, wide);
                for z in z0..=z1 {
                    for y in y0..=y1 {
                        let mut at = [0; 3];
                        (at[major], at[minor], at[other]) = (k, y, z);
                        let index = lattice.index(at);
                        if !outside.has(index) {
                            continue;
                        }
                        let number = self.dense[index as usize];
                        let cell = &self.cells[number as usize];
                        let Some(t) = walk.enter(&cell.lo, &cell.hi) else {
                            *missed += u64::from(self.tight);
                            continue;
                        };
                        let key = (t, number);
                        if t <= walk.tmax && last_key.is_none_or(|l| key > l) && best.is_none_or(|b| key < b) {
                            best = Some(key);
                        }
                    }
                }
            }
            if forward {
                k += 1;
                if k == lattice.count(major) {
                    break;
                }
            } else {
                if k == 0 {
                    break;
                }
                k -= 1;
            }
        }
        best.map(|(t, number)| self.foreign(t, number))
    }

    /// The first occupied cell in which `ray` can hit something, whatever is resident.
    pub fn first_cell(&self, ray: &Ray) -> Option<Foreign<'_>> {
        self.next_foreign(ray, Progress::START, &self.everywhere)
    }

    /// The walk's plain twin: every cell is tested. For tests, and for whoever doubts the walk.
    pub fn next_foreign_naive(&self, ray: &Ray, from: Progress, resident: &SplitSet) -> Option<Foreign<'_>> {
        let walk = WalkRay::new(ray, self.lattice().magnitude())?;
        let last_key = self.key_of(from, &walk);
        let mut best: Option<(f64, u32)> = None;
        for (number, cell) in (0..).zip(&self.cells) {
            let Some(t) = walk.enter(&cell.lo, &cell.hi) else { continue };
            let key = (t, number);
            let wanted = t <= walk.tmax && self.owners_of(cell).iter().any(|&s| !resident.contains(s));
            if wanted && last_key.is_none_or(|l| key > l) && best.is_none_or(|b| key < b) {
                best = Some(key);
            }
        }
        best.map(|(t, number)| self.foreign(t, number))
    }

    fn foreign(&self, t: f64, number: u32) -> Foreign<'_> {
        Foreign { progress: Progress(number + 1), cell: number, t, owners: self.owners(number) }
    }

    /// Key of the cell that a progress names.
    fn key_of(&self, from: Progress, walk: &WalkRay) -> Option<(f64, u32)> {
        let number = from.0.checked_sub(1)?;
        let cell = self.cells.get(number as usize)?;
        Some((walk.enter(&cell.lo, &cell.hi)?, number))
    }

    /// Cells of an axis that the widened ray touches between two parameters.
    #[inline]
    fn range(&self, axis: usize, walk: &WalkRay, a: f64, b: f64, wide: f64) -> (u32, u32) {
        let p = walk.o[axis] + a * walk.d[axis];
        let q = walk.o[axis] + b * walk.d[axis];
        let (lo, hi) = if p <= q { (p, q) } else { (q, p) };
        // nearby() is off by a few ulp at most, which is nothing beside the widening
        (self.lattice.nearby(axis, lo - wide), self.lattice.nearby(axis, hi + wide))
    }
}
