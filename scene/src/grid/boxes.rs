//! The boxes of few cells as a tree of eights: a ray that passes by most of them asks a few eights instead of all cells on its way.
//!
//! Boxes are tested in f32, widened by twice the pad of the exact test (see [`super::walk`]), 128 u M. A plane's parameter `(x - (o -+ pad)) / d` is off
//! by the roundings of the shifted origin, of the difference, of the reciprocal and of the product: as if the plane were moved by less than 8 u M, while it was moved
//! out by 64 u M more than the exact test moves it. So whatever passes the exact test passes this one, at no later parameter.

use super::walk::WalkRay;

/// A cell: its place in the lattice, its number, the corners of its box.
pub(super) type Placed = ([u32; 3], u32, [f32; 3], [f32; 3]);

/// Eight boxes, by axis; those that are missing are inside out.
#[derive(Clone, Debug)]
struct Eight {
    lo: [[f32; 8]; 3],
    hi: [[f32; 8]; 3],
}

impl Eight {
    const NONE: Eight = Eight { lo: [[f32::INFINITY; 8]; 3], hi: [[f32::NEG_INFINITY; 8]; 3] };

    /// Around all of them.
    fn whole(&self) -> ([f32; 3], [f32; 3]) {
        let least = |of: &[f32; 8]| of.iter().copied().fold(f32::INFINITY, f32::min);
        let most = |of: &[f32; 8]| of.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        (std::array::from_fn(|a| least(&self.lo[a])), std::array::from_fn(|a| most(&self.hi[a])))
    }

    /// Lower bounds of where a ray enters each, [`MISSED`] where it does not.
    #[inline(always)]
    fn enter(&self, ray: &Quick) -> [f32; 8] {
        let mut near = [ray.tmin; 8];
        let mut far = [f32::INFINITY; 8];
        for a in 0..3 {
            let (first, last) =
                if ray.inverse[a] >= 0.0 { (&self.lo[a], &self.hi[a]) } else { (&self.hi[a], &self.lo[a]) };
            let (at_first, at_last, inverse) = (ray.first[a], ray.last[a], ray.inverse[a]);
            for k in 0..8 {
                let n = (first[k] - at_first) * inverse;
                let f = (last[k] - at_last) * inverse;
                near[k] = if n > near[k] { n } else { near[k] };
                far[k] = if f < far[k] { f } else { far[k] };
            }
        }
        std::array::from_fn(|k| if near[k] <= far[k] { near[k] } else { MISSED })
    }
}

/// Parameter of a box that is not entered: before no limit.
const MISSED: f32 = f32::NAN;

/// A ray in f32.
pub(super) struct Quick {
    /// The origin, moved so that the planes that come first, and those that come last, are moved out.
    first: [f32; 3],
    last: [f32; 3],
    inverse: [f32; 3],
    tmin: f32,
}

impl Quick {
    /// None for a ray with numbers so small or large that f32 would not tell: those of no path.
    pub(super) fn new(ray: &WalkRay) -> Option<Quick> {
        let pad = (2.0 * ray.pad) as f32;
        let largest = ray.d.iter().fold(0.0, |m: f64, d| m.max(d.abs()));
        // the pad is 2^-17 of the largest coordinate
        let usual = (1e-3..=1e3).contains(&largest) && (1e-30..=1e20).contains(&pad);
        usual.then(|| {
            // a slab in which a ray all but stays: far beyond whatever the others say
            let inverse = ray.d.map(|d| if d.abs() < 1e-30 { 1e30f32.copysign(d as f32) } else { d.recip() as f32 });
            let moved = |a: usize, by: f32| ray.o[a] as f32 + if inverse[a] >= 0.0 { by } else { -by };
            Quick {
                first: std::array::from_fn(|a| moved(a, pad)),
                last: std::array::from_fn(|a| moved(a, -pad)),
                inverse,
                // it came from an f32
                tmin: ray.tmin as f32,
            }
        })
    }
}

/// Boxes of cells, eight and eight together.
#[derive(Clone, Debug)]
pub(super) struct Boxes {
    /// Cells of the first level's eights.
    numbers: Vec<u32>,
    /// From the cells up to a single eight.
    levels: Vec<Vec<Eight>>,
}

impl Boxes {
    /// Most cells, four levels of eights: laid out anew for each resident set, they should cost less than the rays that ask them.
    pub(super) const MOST: usize = 8usize.pow(4);

    /// None for no cells, and for too many.
    pub(super) fn new(mut cells: Vec<Placed>) -> Option<Boxes> {
        if cells.is_empty() || cells.len() > Boxes::MOST {
            return None;
        }
        // along a curve, so that eight in a row lie together
        cells.sort_by_cached_key(|c| curve(c.0));
        let numbers = cells.iter().map(|c| c.1).collect();
        let mut levels = vec![eights(cells.iter().map(|c| (c.2, c.3)))];
        while let Some(below) = levels.last().filter(|l| l.len() > 1) {
            levels.push(eights(below.iter().map(Eight::whole)));
        }
        Some(Boxes { numbers, levels })
    }

    /// Calls `visit` for the cells whose boxes a ray may enter at or before the limit that the last call gave back, `limit` at first; in no order. Gives
    /// back how many it came near to and missed.
    #[inline]
    pub(super) fn visit(&self, ray: &Quick, mut limit: f64, mut visit: impl FnMut(u32) -> f64) -> u64 {
        let mut missed = 0;
        // seven of each level above the cells' wait at most, and the one in hand
        let mut waits = [(0u32, 0u32, 0.0f32); 7 * 3 + 1];
        let mut count = 1;
        waits[0] = (self.levels.len() as u32 - 1, 0, ray.tmin);
        while count > 0 {
            count -= 1;
            let (level, at, near) = waits[count];
            if f64::from(near) > limit {
                continue;
            }
            let enters = self.levels[level as usize][at as usize].enter(ray);
            for (k, &near) in (0..8).zip(&enters) {
                // false for what is missed
                if f64::from(near) <= limit {
                    if level == 0 {
                        limit = visit(self.numbers[(8 * at + k) as usize]);
                    } else {
                        waits[count] = (level - 1, 8 * at + k, near);
                        count += 1;
                    }
                } else if level == 0 {
                    missed += u64::from(near.is_nan() && ((8 * at + k) as usize) < self.numbers.len());
                }
            }
        }
        missed
    }
}

fn eights(boxes: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Vec<Eight> {
    let mut out: Vec<Eight> = Vec::new();
    for (i, (lo, hi)) in boxes.enumerate() {
        if i % 8 == 0 {
            out.push(Eight::NONE);
        }
        if let Some(last) = out.last_mut() {
            for a in 0..3 {
                (last.lo[a][i % 8], last.hi[a][i % 8]) = (lo[a], hi[a]);
            }
        }
    }
    out
}

/// Place along Morton's curve.
fn curve(at: [u32; 3]) -> u64 {
    (0..21).map(|bit| (0..3).map(|a| u64::from(at[a] >> bit & 1) << (3 * bit + a)).sum::<u64>()).sum()
}
