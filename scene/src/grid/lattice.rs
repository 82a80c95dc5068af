//! The planes of a grid: where cells begin and end.

/// Most cells along an axis: a lattice of 256^3 takes 64 MiB to look up.
pub const MAX_SUBDIV: u32 = 256;

/// Closer to a plane than this, in cells, rounding may put a point on the wrong side.
const NEAR_PLANE: f64 = 1.0 / (1u64 << 40) as f64;

/// `subdiv`^3 equal cells over a box. Plane `k` of an axis is a pure function of `k` ([`Lattice::plane`]), never a
/// running sum, so every part of the program means the same cell by the same number.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    subdiv: u32,
    lo: [f64; 3],
    hi: [f64; 3],
    width: [f64; 3],
    per_unit: [f64; 3],
    /// Cells that exist along an axis: 1 where the box is flat.
    count: [u32; 3],
}

impl Lattice {
    /// A lattice over the box; refuses boxes that are not finite or inside out, and subdivisions out of range.
    pub fn new(subdiv: u32, lo: [f32; 3], hi: [f32; 3]) -> Result<Lattice, String> {
        if subdiv == 0 || subdiv > MAX_SUBDIV {
            return Err(format!("subdivision {subdiv} is not in 1..={MAX_SUBDIV}"));
        }
        if (0..3).any(|a| !(lo[a].is_finite() && hi[a].is_finite() && lo[a] <= hi[a])) {
            return Err(format!("the box {lo:?}..{hi:?} is no box"));
        }
        let (lo, hi) = (lo.map(f64::from), hi.map(f64::from));
        // halves of two f32 cannot overflow in f64
        let width: [f64; 3] = std::array::from_fn(|a| (hi[a] - lo[a]) / f64::from(subdiv));
        let flat = width.map(|w| w == 0.0);
        let per_unit = std::array::from_fn(|a| if flat[a] { 0.0 } else { width[a].recip() });
        let count = flat.map(|f| if f { 1 } else { subdiv });
        Ok(Lattice { subdiv, lo, hi, width, per_unit, count })
    }

    /// Cells along each axis.
    pub fn subdiv(&self) -> u32 {
        self.subdiv
    }

    /// Number of lattice indices, `subdiv`^3.
    pub fn len(&self) -> usize {
        (self.subdiv as usize).pow(3)
    }

    /// Never: a lattice has at least one cell.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Cells that exist along an axis: 1 where the box is flat.
    pub fn count(&self, axis: usize) -> u32 {
        self.count[axis]
    }

    /// Width of a cell.
    pub fn width(&self, axis: usize) -> f64 {
        self.width[axis]
    }

    /// Largest absolute coordinate of the box.
    pub fn magnitude(&self) -> f64 {
        (0..3).map(|a| self.lo[a].abs().max(self.hi[a].abs())).fold(0.0, f64::max)
    }

    /// The box.
    pub fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        (self.lo, self.hi)
    }

    /// Coordinate of plane `k` of an axis, `k` in `0..=subdiv`; ascending in `k`, exact at both ends.
    #[inline]
    pub fn plane(&self, axis: usize, k: u32) -> f64 {
        if k >= self.count[axis] { self.hi[axis] } else { self.lo[axis] + f64::from(k) * self.width[axis] }
    }

    /// The cell number along an axis with `plane(k) <= x < plane(k + 1)`; points outside the box count as in its
    /// outermost cells.
    #[inline]
    pub fn number(&self, axis: usize, x: f64) -> u32 {
        let place = (x - self.lo[axis]) * self.per_unit[axis];
        let k = (place as u32).min(self.count[axis] - 1);
        // `place` is below 2^9 and rounded three times: off by less than 2^-42. Far from planes that changes nothing
        let within = place - f64::from(k);
        if within > NEAR_PLANE && within < 1.0 - NEAR_PLANE { k } else { self.number_near_plane(axis, x, k) }
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
        // the cast saturates: below the box 0, NaN 0
        (((x - self.lo[axis]) * self.per_unit[axis]) as u32).min(self.count[axis] - 1)
    }

    /// Lattice index of a cell.
    #[inline]
    pub fn index(&self, at: [u32; 3]) -> u32 {
        at[0] + self.subdiv * (at[1] + self.subdiv * at[2])
    }

    /// Coordinates of a lattice index, `None` when there is no such cell.
    pub fn coordinates(&self, index: u32) -> Option<[u32; 3]> {
        let n = self.subdiv;
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
