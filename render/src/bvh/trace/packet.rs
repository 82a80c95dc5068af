//! Packets: rays that go through a scene together, one in each lane, with the plain kernel's answers to the bit.
//!
//! Rays are dealt by the axis of their largest component, so that what they have in common with a triangle needs no choice by lane. An
//! answer is the same whatever rays share its packet.
#![allow(unsafe_code)] // intrinsics: functions are inlined into entries that enable the features

use super::super::Sphere;
use super::super::forest::Forest;
use super::super::layout::{Aabb, MAX_COORDINATE};
use super::Kernel;
use super::setup::{DIRECTION_RANGE, NO_DIRECTION, PAD};
use super::triangle::{SMALL_AREA, barycentrics_of_small};
use super::width::{Eight, Sixteen, Width};
use crate::ray::Ray;

/// Rays of the largest packet.
pub(super) const MOST: usize = 16;

/// Rays of a kernel's packet, if it has packets.
pub(super) fn lanes(kernel: Kernel) -> Option<usize> {
    match kernel {
        Kernel::Avx512 => Some(Sixteen::LANES),
        Kernel::Avx2 => Some(Eight::LANES),
        Kernel::Auto | Kernel::Scalar => None,
    }
}

/// The rays of a packet.
pub(super) struct Members<'a> {
    pub forest: &'a Forest,
    /// Those of which it is made.
    pub rays: &'a [Ray],
    /// Which of them it has. Numbers beyond the count are those of one of these.
    pub numbers: &'a [u32; MOST],
    /// Of the largest component of their directions.
    pub axis: usize,
    pub count: usize,
}

/// Deals rays into packets and calls `packet` with each.
///
/// # Panics
/// When the kernel has no packets.
pub(super) fn deal(kernel: Kernel, forest: &Forest, rays: &[Ray], mut packet: impl FnMut(&Members)) {
    let lanes = lanes(kernel).expect("a kernel of vectors");
    let (mut waiting, mut counts) = ([[0u32; MOST]; 3], [0; 3]);
    for (i, ray) in rays.iter().enumerate() {
        let axis = steepest(ray.d);
        waiting[axis][counts[axis]] = i as u32;
        counts[axis] += 1;
        if counts[axis] == lanes {
            counts[axis] = 0;
            packet(&Members { forest, rays, numbers: &waiting[axis], axis, count: lanes });
        }
    }
    for (axis, &count) in counts.iter().enumerate() {
        if count > 0 {
            let last = waiting[axis][count - 1];
            waiting[axis][count..].fill(last);
            packet(&Members { forest, rays, numbers: &waiting[axis], axis, count });
        }
    }
}

/// Axis of a direction's largest component, the last of equal ones: as [`super::setup::State::start`] has it.
#[inline(always)]
fn steepest(d: [f32; 3]) -> usize {
    let [x, y, z] = d.map(f32::abs);
    let is_x = (x > y) & (x > z);
    let is_y = !is_x & (y > z);
    2 - 2 * usize::from(is_x) - usize::from(is_y)
}

/// Where rays meet a primitive, whether that counts or not.
pub(super) struct Crossing<W: Width> {
    /// Which rays do.
    pub mask: W::Mask,
    /// Ray parameter.
    pub t: W::F,
    /// Barycentrics of the second and third vertex.
    pub uv: [W::F; 2],
}

/// Rays along one axis, one in each lane. What they are is in [`super::setup::State`]; axes stand in their own order for boxes and in
/// that of the rays for triangles.
pub(super) struct Packet<W: Width> {
    inverse: [W::F; 3],
    near: [W::F; 3],
    far: [W::F; 3],
    is_negative: [W::Mask; 3],
    origin: [W::F; 3],
    shear: [W::F; 3],
    pub tmin: W::F,
    /// The rays' limits, then their best hits.
    pub tmax: W::F,
    /// Barycentrics of the best hits.
    pub uv: [W::F; 2],
    /// Origin and direction as they were given.
    o: [W::F; 3],
    d: [W::F; 3],
}

impl<W: Width> Packet<W> {
    /// [`super::setup::State::start`] on rays that are given by their members.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    pub unsafe fn start(columns: [W::F; 8], largest: f32, axis: usize) -> Packet<W> {
        // SAFETY: the features are enabled.
        unsafe {
            let [ox, oy, oz, tmin, dx, dy, dz, tmax] = columns;
            let (o, d) = ([ox, oy, oz], [dx, dy, dz]);
            let (sx, sy, sz) = (W::abs(dx), W::abs(dy), W::abs(dz));
            let (rx, ry, rz) = (W::abs(ox), W::abs(oy), W::abs(oz));
            let (most_o, most_d) = (W::all(MAX_COORDINATE), W::all(DIRECTION_RANGE.1));
            // NaN makes every comparison false, also one with itself
            let reaches = W::and(W::and(W::le(rx, most_o), W::le(ry, most_o)), W::le(rz, most_o));
            let sizes = W::and(W::and(W::le(sx, most_d), W::le(sy, most_d)), W::le(sz, most_d));
            let steepest = W::max(W::max(sx, sy), sz);
            let ordered = W::and(W::eq(tmin, tmin), W::eq(tmax, tmax));
            let is_steep = W::le(W::all(DIRECTION_RANGE.0), steepest);
            let is_sane = W::and(W::and(reaches, sizes), W::and(ordered, is_steep));

            let least = W::mul(steepest, W::all(NO_DIRECTION));
            let pad = W::mul(W::max(W::max(W::max(rx, ry), rz), W::all(largest)), W::all(PAD));
            let zero = W::all(0.0);
            let mut inverse = [zero; 3];
            let (mut near, mut far) = ([zero; 3], [zero; 3]);
            let mut is_negative = [is_sane; 3];
            let mut straight = d;
            let mut a = 0;
            while a < 3 {
                let is_flat = W::lt(W::abs(d[a]), least);
                let signed = W::select(W::is_negative(d[a]), W::sub(W::all(-0.0), least), least);
                inverse[a] = W::div(W::all(1.0), W::select(is_flat, signed, d[a]));
                straight[a] = W::select(is_flat, zero, d[a]);
                let (center, wide) = (W::mul(o[a], inverse[a]), W::mul(W::abs(inverse[a]), pad));
                near[a] = W::add(center, wide);
                far[a] = W::sub(center, wide);
                is_negative[a] = W::is_negative(inverse[a]);
                a += 1;
            }
            let (x, y, z) = ((axis + 1) % 3, (axis + 2) % 3, axis);
            let shear = [W::mul(straight[x], inverse[z]), W::mul(straight[y], inverse[z]), inverse[z]];
            Packet {
                inverse,
                near,
                far,
                is_negative,
                origin: [o[x], o[y], o[z]],
                shear,
                // zeros are its second operand
                tmin: W::max(tmin, zero),
                tmax: W::select(is_sane, tmax, W::all(-1.0)),
                uv: [zero; 2],
                o,
                d,
            }
        }
    }

    /// Which rays enter a box before their best hit, and where. Conservative: see [`super::setup`].
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    pub unsafe fn enters(&self, b: &Aabb) -> (W::Mask, W::F) {
        // SAFETY: the features are enabled.
        unsafe {
            let (mut first, mut last) = (self.tmin, self.tmax);
            let mut a = 0;
            while a < 3 {
                let (lo, hi) = (W::all(b.lo[a]), W::all(b.hi[a]));
                let entry = W::select(self.is_negative[a], hi, lo);
                let exit = W::select(self.is_negative[a], lo, hi);
                first = W::max(W::fmsub(entry, self.inverse[a], self.near[a]), first);
                last = W::min(W::fmsub(exit, self.inverse[a], self.far[a]), last);
                a += 1;
            }
            (W::le(first, last), first)
        }
    }

    /// Tests a triangle as [`super::triangle::intersect`] does, but for the limits: which of `entered` pass inside, t and the barycentrics of
    /// the second and third vertex. Vertices stand in the order of the rays' axes.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    pub unsafe fn triangle(&self, entered: W::Mask, [a, b, c]: &[[f32; 3]; 3]) -> Option<Crossing<W>> {
        // SAFETY: the features are enabled.
        unsafe {
            let ([ax, ay, az], [bx, by, bz], [cx, cy, cz]) = (self.sheared(a), self.sheared(b), self.sheared(c));
            let (u, v, w) = (edge::<W>(cx, cy, bx, by), edge::<W>(ax, ay, cx, cy), edge::<W>(bx, by, ax, ay));
            let zero = W::all(0.0);
            let least = W::min(W::min(u, v), w);
            let most = W::max(W::max(u, v), w);
            let inside = W::and(W::or(W::le(zero, least), W::le(most, zero)), entered);
            if W::bits(inside) == 0 {
                return None;
            }
            let sum = W::add(W::add(u, v), w);
            let scale = W::div(W::all(1.0), sum);
            let mut barycentrics = [W::mul(u, scale), W::mul(v, scale), W::mul(w, scale)];
            let small = W::bits(W::and(W::lt(W::abs(sum), W::all(SMALL_AREA)), inside));
            if small != 0 {
                let mut stored = [[0.0; MOST]; 9];
                let sheared = [ax, ay, bx, by, cx, cy, barycentrics[0], barycentrics[1], barycentrics[2]];
                let mut i = 0;
                while i < 9 {
                    W::store(stored[i].as_mut_ptr(), sheared[i]);
                    i += 1;
                }
                replace_small(small, &mut stored);
                barycentrics = [W::load(stored[6].as_ptr()), W::load(stored[7].as_ptr()), W::load(stored[8].as_ptr())];
            }
            let [bu, bv, bw] = barycentrics;
            let t = W::mul(W::fmadd(bu, az, W::fmadd(bv, bz, W::mul(bw, cz))), self.shear[2]);
            Some(Crossing { mask: inside, t, uv: [bv, bw] })
        }
    }

    /// A vertex in the rays' space.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    unsafe fn sheared(&self, p: &[f32; 3]) -> [W::F; 3] {
        // SAFETY: the features are enabled.
        unsafe {
            let ([ox, oy, oz], [sx, sy, _]) = (self.origin, self.shear);
            let z = W::sub(W::all(p[2]), oz);
            let x = W::fnmadd(sx, z, W::sub(W::all(p[0]), ox));
            let y = W::fnmadd(sy, z, W::sub(W::all(p[1]), oy));
            [x, y, z]
        }
    }

    /// Tests a sphere as [`super::sphere::intersect`] does, but for the limits: which of `entered` meet it, and where. Sums from left to
    /// right, and no fused operations. A nearer hit that is too near gives way to the farther one; where it is too far, the other is farther.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    pub unsafe fn sphere(&self, entered: W::Mask, sphere: &Sphere) -> Option<Crossing<W>> {
        // SAFETY: the features are enabled.
        unsafe {
            let d = [W::widen(self.d[0]), W::widen(self.d[1]), W::widen(self.d[2])];
            let mut l = d;
            let mut a = 0;
            while a < 3 {
                l[a] = W::sub_wide(W::widen(self.o[a]), W::all_wide(f64::from(sphere.center[a])));
                a += 1;
            }
            let dd = dot::<W>(d, d);
            let middle = W::div_wide(W::sub_wide(W::all_wide(-0.0), dot::<W>(l, d)), dd);
            let mut foot = l;
            let mut a = 0;
            while a < 3 {
                foot[a] = W::add_wide(l[a], W::mul_wide(middle, d[a]));
                a += 1;
            }
            let r = f64::from(sphere.radius);
            let inside = W::sub_wide(W::all_wide(r * r), dot::<W>(foot, foot));
            let mask = W::and(W::le_wide(W::all_wide(0.0), inside), entered);
            if W::bits(mask) == 0 {
                return None;
            }
            // NaN where the ray passes by
            let half = W::sqrt_wide(W::div_wide(inside, dd));
            let near = W::narrow(W::sub_wide(middle, half));
            let far = W::narrow(W::add_wide(middle, half));
            let t = W::select(W::lt(self.tmin, near), near, far);
            Some(Crossing { mask, t, uv: [W::all(0.0); 2] })
        }
    }

    /// Takes hits.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    pub unsafe fn accept(&mut self, hits: W::Mask, at: &Crossing<W>) {
        // SAFETY: the features are enabled.
        unsafe {
            self.tmax = W::select(hits, at.t, self.tmax);
            self.uv = [W::select(hits, at.uv[0], self.uv[0]), W::select(hits, at.uv[1], self.uv[1])];
        }
    }
}

/// The edge function of two sheared vertices: see `difference_of_products` of [`super::triangle`].
///
/// # Safety
/// Features of `W` are enabled.
#[inline(always)]
unsafe fn edge<W: Width>(px: W::F, py: W::F, qx: W::F, qy: W::F) -> W::F {
    // SAFETY: the features are enabled.
    unsafe {
        let product = W::mul(py, qx);
        let error = W::fnmadd(py, qx, product);
        W::add(W::fmsub(px, qy, product), error)
    }
}

/// # Safety
/// Features of `W` are enabled.
#[inline(always)]
unsafe fn dot<W: Width>(a: [W::D; 3], b: [W::D; 3]) -> W::D {
    // SAFETY: the features are enabled.
    unsafe {
        let xy = W::add_wide(W::mul_wide(a[0], b[0]), W::mul_wide(a[1], b[1]));
        W::add_wide(xy, W::mul_wide(a[2], b[2]))
    }
}

/// Puts in place the barycentrics (the last three rows) of triangles of a small projected area: see [`barycentrics_of_small`].
#[cold]
#[inline(never)]
fn replace_small(lanes: u32, rows: &mut [[f32; MOST]; 9]) {
    for i in (0..MOST).filter(|i| lanes >> i & 1 != 0) {
        let [a, b, c] = std::array::from_fn(|v| [rows[2 * v][i], rows[2 * v + 1][i]]);
        // NaN: its t compares false, the test refuses it
        let (u, v, w) = barycentrics_of_small(a, b, c).unwrap_or((f32::NAN, f32::NAN, f32::NAN));
        (rows[6][i], rows[7][i], rows[8][i]) = (u, v, w);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::testing::Random;
    use crate::bvh::trace::setup::State;

    #[test]
    fn axes_are_those_of_the_plain_start() {
        let mut random = Random::new(41);
        for i in 0..30_000 {
            let often = [2, 4, 1000][i % 3];
            let mut number =
                || if random.below(often) == 0 { [0.5, -0.5, 0.0, 1e-9][random.below(4)] } else { random.signed() };
            let d = [number(), number(), number()];
            let state = State::new(&Ray { o: [0.0; 3], tmin: 0.0, d, tmax: 1.0 }, 1.0);
            if state.tmax > 0.0 {
                assert_eq!(steepest(d), state.axes[2] as usize, "{d:?}");
            }
        }
    }
}
