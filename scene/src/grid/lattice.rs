//! The planes of a grid: where cells begin and end.

/// Most cells along an axis: a lattice of 256^3 takes 64 MiB to look up.
pub const MAX_SUBDIV: u32 = 256;

/// Closer to a plane than this, in cells, rounding may put a point on the wrong side.
const NEAR_PLANE: f64 = 1.0 / (1u64 << 40) as f64;

/// Cells per unit of a flat inner box beside outer layers: any difference of two f32 that is not 0 becomes more than one cell.
const STEEP: f64 = 1e60;

/// `subdiv`^3 equal cells over an inner box, and one more layer of cells on each side where the whole box is wider:
/// a lamp far above a scene gets a cell of its own and does not stretch those of the scene. Plane `k` of an axis is a
/// pure function of `k` ([`Lattice::plane`]), never a running sum, so every part of the program means the same cell by
/// the same number.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    subdiv: u32,
    lo: [f64; 3],
    hi: [f64; 3],
    inner_lo: [f64; 3],
    inner_hi: [f64; 3],
    /// Of the inner cells.
    width: [f64; 3],
    per_unit: [f64; 3],
    /// 1 where a layer lies below the inner cells of an axis, else 0.
    below: [u32; 3],
    /// Inner cells that exist along an axis: 1 where the inner box is flat.
    inner: [u32; 3],
    /// All cells that exist along an axis.
    count: [u32; 3],
    /// Step of the index along y.
    stride: u32,
}

impl Lattice {
    /// A lattice over the box; refuses boxes that are not finite or inside out, and subdivisions out of range.
    pub fn new(subdiv: u32, lo: [f32; 3], hi: [f32; 3]) -> Result<Lattice, String> {
        Lattice::around(subdiv, [lo, hi], lo, hi)
    }

    /// A lattice whose equal cells are those of the inner box; it must lie in `lo..hi`.
    pub fn around(subdiv: u32, inner: [[f32; 3]; 2], lo: [f32; 3], hi: [f32; 3]) -> Result<Lattice, String> {
        if subdiv == 0 || subdiv > MAX_SUBDIV {
            return Err(format!("subdivision {subdiv} is not in 1..={MAX_SUBDIV}"));
        }
        for [lo, hi] in [inner, [lo, hi]] {
            if (0..3).any(|a| !(lo[a].is_finite() && hi[a].is_finite() && lo[a] <= hi[a])) {
                return Err(format!("the box {lo:?}..{hi:?} is no box"));
            }
        }
        if (0..3).any(|a| inner[0][a] < lo[a] || inner[1][a] > hi[a]) {
            return Err(format!("the inner box {inner:?} is not inside {lo:?}..{hi:?}"));
        }
        let [inner_lo, inner_hi] = inner.map(|corner| corner.map(f64::from));
        let (lo, hi) = (lo.map(f64::from), hi.map(f64::from));
        // halves of two f32 cannot overflow in f64
        let width: [f64; 3] = std::array::from_fn(|a| (inner_hi[a] - inner_lo[a]) / f64::from(subdiv));
        let below: [u32; 3] = std::array::from_fn(|a| u32::from(lo[a] < inner_lo[a]));
        let above: [u32; 3] = std::array::from_fn(|a| u32::from(inner_hi[a] < hi[a]));
        let per_unit = std::array::from_fn(|a| match width[a] {
            // a flat inner box still tells what is below it from what is above
            0.0 if below[a] + above[a] > 0 => STEEP,
            0.0 => 0.0,
            w => w.recip(),
        });
        let inner = width.map(|w| if w == 0.0 { 1 } else { subdiv });
        let count: [u32; 3] = std::array::from_fn(|a| below[a] + inner[a] + above[a]);
        let stride = if below == [0; 3] && above == [0; 3] { subdiv } else { subdiv + 2 };
        Ok(Lattice { subdiv, lo, hi, inner_lo, inner_hi, width, per_unit, below, inner, count, stride })
    }

    /// Inner cells along each axis.
    pub fn subdiv(&self) -> u32 {
        self.subdiv
    }

    /// Number of lattice indices, the cube of [`Lattice::stride`].
    pub fn len(&self) -> usize {
        (self.stride as usize).pow(3)
    }

    /// Cells along an axis that indices have room for: `subdiv`, and 2 more when there are outer layers.
    pub fn stride(&self) -> u32 {
        self.stride
    }

    /// Never: a lattice has at least one cell.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Cells that exist along an axis.
    pub fn count(&self, axis: usize) -> u32 {
        self.count[axis]
    }

    /// Width of an inner cell.
    pub fn width(&self, axis: usize) -> f64 {
        self.width[axis]
    }

    /// The inner box.
    pub fn inner(&self) -> ([f64; 3], [f64; 3]) {
        (self.inner_lo, self.inner_hi)
    }

    /// Whether a box reaches into an outer layer: exactly what [`Lattice::number`] says of its corners.
    #[inline]
    pub fn reaches_out(&self, lo: &[f32; 3], hi: &[f32; 3]) -> bool {
        (0..3).any(|a| {
            (self.below[a] > 0 && f64::from(lo[a]) < self.inner_lo[a])
                || (self.below[a] + self.inner[a] < self.count[a] && f64::from(hi[a]) >= self.inner_hi[a])
        })
    }

    /// The cell with these coordinates among the inner ones.
    #[inline]
    pub fn from_inner(&self, at: [u32; 3]) -> [u32; 3] {
        std::array::from_fn(|a| at[a] + self.below[a])
    }

    /// Largest absolute coordinate of the box.
    pub fn magnitude(&self) -> f64 {
        (0..3).map(|a| self.lo[a].abs().max(self.hi[a].abs())).fold(0.0, f64::max)
    }

    /// The box.
    pub fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        (self.lo, self.hi)
    }

    /// Coordinate of plane `k` of an axis, `k` in `0..=count`; ascending in `k`, exact at the ends of both boxes.
    #[inline]
    pub fn plane(&self, axis: usize, k: u32) -> f64 {
        if k >= self.count[axis] {
            self.hi[axis]
        } else if k < self.below[axis] {
            self.lo[axis]
        } else if k - self.below[axis] >= self.inner[axis] {
            self.inner_hi[axis]
        } else {
            self.inner_lo[axis] + f64::from(k - self.below[axis]) * self.width[axis]
        }
    }

    /// The cell number along an axis with `plane(k) <= x < plane(k + 1)`; points outside the box count as in its
    /// outermost cells.
    #[inline]
    pub fn number(&self, axis: usize, x: f64) -> u32 {
        let place = (x - self.inner_lo[axis]) * self.per_unit[axis];
        // the cast saturates
        let k = (place as u32).min(self.inner[axis] - 1);
        // inside, `place` is below 2^9 and rounded three times: off by less than 2^-42. Far from planes that changes nothing
        let within = place - f64::from(k);
        let near = k + self.below[axis];
        if within > NEAR_PLANE && within < 1.0 - NEAR_PLANE { near } else { self.number_near_plane(axis, x, near) }
    }

    #[cold]
    fn number_near_plane(&self, axis: usize, x: f64, near: u32) -> u32 {
        let last = self.count[axis] - 1;
        let mut k = near;
        while k > 0 && x < self.plane(axis, k) {
            k -= 1;
        }
        while k < last && x >= self.plane(axis, k + 1) {
            k += 1;
        }
        k
    }

    /// The cell that a box lies in alone, if there is one.
    #[inline]
    pub fn only_cell(&self, lo: &[f32; 3], hi: &[f32; 3]) -> Option<[u32; 3]> {
        let first: [u32; 3] = std::array::from_fn(|a| self.number(a, f64::from(lo[a])));
        let last: [u32; 3] = std::array::from_fn(|a| self.number(a, f64::from(hi[a])));
        (first == last).then_some(first)
    }

    /// [`Lattice::number`] but for rounding: off by one when `x` is within a few ulp of a plane.
    #[inline]
    pub fn nearby(&self, axis: usize, x: f64) -> u32 {
        let place = (x - self.inner_lo[axis]) * self.per_unit[axis];
        // the cast saturates: NaN 0
        if place < 0.0 { 0 } else { self.below[axis].saturating_add(place as u32).min(self.count[axis] - 1) }
    }

    /// Lattice index of a cell.
    #[inline]
    pub fn index(&self, at: [u32; 3]) -> u32 {
        at[0] + self.stride * (at[1] + self.stride * at[2])
    }

    /// Coordinates of a lattice index, `None` when there is no such cell.
    pub fn coordinates(&self, index: u32) -> Option<[u32; 3]> {
        let n = self.stride;
        let at = [index % n, index / n % n, index / n / n];
        (0..3).all(|a| at[a] < self.count[a]).then_some(at)
    }

    /// Box of a cell.
    #[inline]
    pub fn cell_box(&self, at: [u32; 3]) -> ([f64; 3], [f64; 3]) {
        (std::array::from_fn(|a| self.plane(a, at[a])), std::array::from_fn(|a| self.plane(a, at[a] + 1)))
    }

    /// Box of a cell, rounded outwards to f32.
    pub fn cell_box_f32(&self, at: [u32; 3]) -> ([f32; 3], [f32; 3]) {
        let (lo, hi) = self.cell_box(at);
        (lo.map(round_down), hi.map(round_up))
    }
}

/// Largest f32 that is not above `x` (`x` finite and within the range of f32).
#[inline]
pub fn round_down(x: f64) -> f32 {
    let y = x as f32;
    if f64::from(y) > x { y.next_down() } else { y }
}

/// Least f32 that is not below `x` (`x` finite and within the range of f32).
#[inline]
pub fn round_up(x: f64) -> f32 {
    let y = x as f32;
    if f64::from(y) < x { y.next_up() } else { y }
}
