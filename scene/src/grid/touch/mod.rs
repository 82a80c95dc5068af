//! Which cells a primitive overlaps, and where inside a cell it can lie. Conservative: rounding never loses an overlap.
//!
//! Below, u = 2^-53 and M is the lattice's magnitude: every coordinate of a vertex and of a plane is at most M.

#[cfg(test)]
mod tests;

use super::Lattice;

/// A box: lower and upper corner.
pub type Bounds = ([f64; 3], [f64; 3]);

/// Unit roundoff of f64.
const U: f64 = 1.0 / (1u64 << 53) as f64;

/// Calls `emit` with every cell that the triangle overlaps, each once; `p` must lie in the lattice's box.
///
/// May name a cell that the triangle misses by less than 2^-46 M; never leaves out one that it touches.
pub fn triangle_cells(lattice: &Lattice, p: &[[f64; 3]; 3], emit: &mut impl FnMut([u32; 3])) {
    let (lo, hi) = bounds_of(p);
    let first: [u32; 3] = std::array::from_fn(|a| lattice.number(a, lo[a]));
    let last: [u32; 3] = std::array::from_fn(|a| lattice.number(a, hi[a]));
    if (0..3).filter(|&a| first[a] != last[a]).count() <= 1 {
        // the triangle is connected, so it passes through every cell of a row that it fills from end to end
        return every(first, last, emit);
    }
    let sat = Sat::new(p, lattice.magnitude());
    descend(first, last, true, &|a, b| sat.overlaps(&range_box(lattice, a, b)), emit);
}

/// Calls `emit` with every cell that the sphere's surface passes through, each once; its box must lie in the lattice's.
///
/// May name a cell that the surface misses by less than 2^-20 M; never leaves out one that it touches.
pub fn sphere_cells(lattice: &Lattice, center: [f64; 3], radius: f64, emit: &mut impl FnMut([u32; 3])) {
    let first: [u32; 3] = std::array::from_fn(|a| lattice.number(a, center[a] - radius));
    let last: [u32; 3] = std::array::from_fn(|a| lattice.number(a, center[a] + radius));
    let m = lattice.magnitude();
    // d^2 sums three squares of differences below 2 M: error below 3 (2 * 2M * 2uM) + 4u * 12 M^2 < 128 u M^2;
    // r^2 below M^2: error u M^2
    let slack = 256.0 * U * m * m;
    let passes = |a: [u32; 3], b: [u32; 3]| {
        let (lo, hi) = range_box(lattice, a, b);
        let (mut nearest, mut farthest) = (0.0, 0.0);
        for k in 0..3 {
            let (below, above) = (lo[k] - center[k], center[k] - hi[k]);
            let outside = below.max(above).max(0.0);
            // the far plane on either side: -below and -above when the centre is inside
            let across = below.abs().max(above.abs());
            nearest += outside * outside;
            farthest += across * across;
        }
        let square = radius * radius;
        nearest <= square + slack && farthest >= square - slack
    };
    descend(first, last, false, &passes, emit);
}

/// Box of the part of a triangle that lies in a cell: every point of it is inside; `None` when there is none.
///
/// Clips the triangle by the cell's planes, each moved outwards by `margin`. A clip computes a vertex to 16uM (the
/// parameter of the cut to 3u relative, as its two differences are rounded once; the rest are sums below 3M), so after i
/// clips every exact point is within 16uM i of the computed polygon, which the next plane does not cut off when it is
/// moved by as much. Six clips need 96uM; `margin` is 128uM.
pub fn triangle_in_cell(p: &[[f64; 3]; 3], cell: &Bounds, magnitude: f64) -> Option<Bounds> {
    let margin = 128.0 * U * magnitude;
    let (lo, hi) = bounds_of(p);
    // a triangle has three corners and each plane adds at most one
    let mut corners = [[0.0; 3]; 9];
    corners[..3].copy_from_slice(p);
    let mut count = 3;
    for axis in 0..3 {
        for (plane, sign) in [(cell.0[axis] - margin, 1.0), (cell.1[axis] + margin, -1.0)] {
            let outside = if sign > 0.0 { lo[axis] < plane } else { hi[axis] > plane };
            if outside {
                let input = corners;
                count = clip(&input[..count], axis, plane, sign, &mut corners);
            }
        }
    }
    if count == 0 {
        return None;
    }
    let (mut a, mut b) = bounds_of(&corners[..count]);
    for axis in 0..3 {
        a[axis] = (a[axis] - margin).max(lo[axis]).max(cell.0[axis]);
        b[axis] = (b[axis] + margin).min(hi[axis]).min(cell.1[axis]);
        if a[axis] > b[axis] {
            return None;
        }
    }
    Some((a, b))
}

/// Box of a sphere's surface in a cell; `None` when there is none.
pub fn sphere_in_cell(center: [f64; 3], radius: f64, cell: &Bounds) -> Option<Bounds> {
    let a: [f64; 3] = std::array::from_fn(|k| (center[k] - radius).max(cell.0[k]));
    let b: [f64; 3] = std::array::from_fn(|k| (center[k] + radius).min(cell.1[k]));
    (0..3).all(|k| a[k] <= b[k]).then_some((a, b))
}

/// Smallest box around points (at least one).
pub fn bounds_of(points: &[[f64; 3]]) -> Bounds {
    let mut lo = points[0];
    let mut hi = points[0];
    for p in &points[1..] {
        for a in 0..3 {
            lo[a] = lo[a].min(p[a]);
            hi[a] = hi[a].max(p[a]);
        }
    }
    (lo, hi)
}

fn every(first: [u32; 3], last: [u32; 3], emit: &mut impl FnMut([u32; 3])) {
    for z in first[2]..=last[2] {
        for y in first[1]..=last[1] {
            for x in first[0]..=last[0] {
                emit([x, y, z]);
            }
        }
    }
}

/// Halves a range of cells until single ones are left, skipping halves that `test` rules out. The cost is a small
/// multiple of the cells found, not of the range.
fn descend(
    first: [u32; 3],
    last: [u32; 3],
    known: bool,
    test: &impl Fn([u32; 3], [u32; 3]) -> bool,
    emit: &mut impl FnMut([u32; 3]),
) {
    if !known && !test(first, last) {
        return;
    }
    let axis = (0..3).max_by_key(|&a| last[a] - first[a]).unwrap_or(0);
    if first[axis] == last[axis] {
        return emit(first);
    }
    let middle = first[axis] + (last[axis] - first[axis]) / 2;
    let (mut left_end, mut right_begin) = (last, first);
    left_end[axis] = middle;
    right_begin[axis] = middle + 1;
    descend(first, left_end, false, test, emit);
    descend(right_begin, last, false, test, emit);
}

fn range_box(lattice: &Lattice, first: [u32; 3], last: [u32; 3]) -> Bounds {
    (std::array::from_fn(|a| lattice.plane(a, first[a])), std::array::from_fn(|a| lattice.plane(a, last[a] + 1)))
}

/// Sutherland and Hodgman's clip of a convex polygon by `sign * (x[axis] - plane) >= 0`.
fn clip(input: &[[f64; 3]], axis: usize, plane: f64, sign: f64, out: &mut [[f64; 3]; 9]) -> usize {
    let mut count = 0;
    let mut push = |p| {
        // a polygon that rounding made concave could cross a plane more than twice; its corners are dropped only
        // beyond nine, which convex input cannot reach
        if count < out.len() {
            out[count] = p;
            count += 1;
        }
    };
    for (i, p) in input.iter().enumerate() {
        let q = &input[(i + 1) % input.len()];
        let (dp, dq) = (sign * (p[axis] - plane), sign * (q[axis] - plane));
        if dp >= 0.0 {
            push(*p);
        }
        if (dp >= 0.0) != (dq >= 0.0) {
            let t = (plane - p[axis]) / (q[axis] - p[axis]);
            let mut cut: [f64; 3] = std::array::from_fn(|a| p[a] + (q[a] - p[a]) * t);
            cut[axis] = plane;
            push(cut);
        }
    }
    count
}

/// Separating axes of a triangle against boxes (Akenine-Moeller 2001), all but the box's faces, which the range of
/// cells has dealt with.
struct Sat<'a> {
    p: &'a [[f64; 3]; 3],
    /// Nine cross products of edges and coordinate axes, and the normal.
    axes: [[f64; 3]; 10],
    magnitude: f64,
}

impl<'a> Sat<'a> {
    fn new(p: &'a [[f64; 3]; 3], magnitude: f64) -> Self {
        let edge = |i: usize, j: usize| -> [f64; 3] { std::array::from_fn(|a| p[j][a] - p[i][a]) };
        let edges = [edge(0, 1), edge(1, 2), edge(2, 0)];
        let mut axes = [[0.0; 3]; 10];
        for (i, e) in edges.iter().enumerate() {
            axes[3 * i] = [0.0, -e[2], e[1]];
            axes[3 * i + 1] = [e[2], 0.0, -e[0]];
            axes[3 * i + 2] = [-e[1], e[0], 0.0];
        }
        let [a, b, _] = edges;
        axes[9] = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        Sat { p, axes, magnitude }
    }

    /// False only if an axis separates them for certain.
    ///
    /// Any vector may serve as axis, so its own rounding does not matter. With centre c and half width h of the box,
    /// v = p - c is off by 3uM (c by uM, the difference by 2uM), so a projection n.v by |n|_1 (3 + 3 * 2) uM, and the
    /// radius |n|.h by |n|_1 (1 + 3) uM: together below 16 u M |n|_1. Twice that is allowed for.
    fn overlaps(&self, (lo, hi): &Bounds) -> bool {
        let c: [f64; 3] = std::array::from_fn(|a| 0.5 * (lo[a] + hi[a]));
        let h: [f64; 3] = std::array::from_fn(|a| 0.5 * (hi[a] - lo[a]));
        let v = self.p.map(|p| -> [f64; 3] { std::array::from_fn(|a| p[a] - c[a]) });
        let slack = 32.0 * U * self.magnitude;
        self.axes.iter().all(|n| {
            let project = |v: &[f64; 3]| n[0] * v[0] + n[1] * v[1] + n[2] * v[2];
            let [x, y, z] = [project(&v[0]), project(&v[1]), project(&v[2])];
            let (ax, ay, az) = (n[0].abs(), n[1].abs(), n[2].abs());
            let reach = ax * h[0] + ay * h[1] + az * h[2] + (ax + ay + az) * slack;
            // NaN cannot separate
            !(x.min(y).min(z) > reach || x.max(y).max(z) < -reach)
        })
    }
}
