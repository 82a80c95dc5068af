//! The vector kernel for few primitives: a packet of rays at a time through all of them, the plain kernel's answers to the bit.
//!
//! Rays are gathered by the axis of their largest component, so that what they have in common with a triangle needs no choice by
//! lane. A packet goes through the boxes of all leaves and tests what lies in those that any of its rays enters: no stack, no
//! branch by ray, and an answer is the same whatever rays share its packet.
#![allow(unsafe_code)] // intrinsics, and packets of numbers of rays that the caller has

use super::super::few::{Along, Ball, Few};
use super::super::forest::Forest;
use super::super::layout::{Aabb, MAX_COORDINATE};
use super::setup::{DIRECTION_RANGE, NO_DIRECTION, PAD};
use super::triangle::{SMALL_AREA, barycentrics_of_small};
use super::width::{Eight, Sixteen, Width};
use super::{Counters, Kernel, runs};
use crate::ray::{Hit, Ray};

/// Rays of the largest packet.
const MOST: usize = 16;

/// What a packet's rays hit.
#[repr(C, align(64))]
struct Answers {
    t: [f32; MOST],
    u: [f32; MOST],
    v: [f32; MOST],
    /// Ranks of what is hit, infinite where nothing is.
    rank: [f32; MOST],
    /// Boxes entered by rays that count.
    entered: u64,
}

/// Traces rays through a forest's few primitives and tells `done` each ray's number and hit; with `ANY`, only whether there is a hit.
///
/// # Panics
/// When the kernel is none of vectors or the processor cannot run it.
pub(super) fn trace<const ANY: bool>(
    kernel: Kernel,
    forest: &Forest,
    few: &Few,
    rays: &[Ray],
    done: &mut impl FnMut(usize, Hit),
    counters: &mut Counters,
) {
    assert!(runs(kernel));
    let lanes = lanes(kernel).expect("a kernel of vectors");
    let (mut waiting, mut counts) = ([[0u32; MOST]; 3], [0; 3]);
    let mut answers = Answers { t: [0.0; MOST], u: [0.0; MOST], v: [0.0; MOST], rank: [0.0; MOST], entered: 0 };
    let mut packet = |numbers: &mut [u32; MOST], axis: usize, count: usize| {
        // those beyond the count are traced with the others, for nothing
        let last = numbers[count - 1];
        numbers[count..].fill(last);
        let scene = Scene { few, largest: forest.largest(), axis };
        match kernel {
            // SAFETY: the processor has the features, and all numbers are of rays.
            Kernel::Avx512 => unsafe { avx512::<ANY>(&scene, rays, numbers, count, &mut answers) },
            // SAFETY: as above.
            Kernel::Avx2 => unsafe { avx2::<ANY>(&scene, rays, numbers, count, &mut answers) },
            Kernel::Auto | Kernel::Scalar => unreachable!("no vector kernel"),
        }
        for (i, &number) in numbers[..count].iter().enumerate() {
            let ray = number as usize;
            let rank = answers.rank[i];
            done(
                ray,
                if rank == f32::INFINITY {
                    Hit::miss(rays[ray].tmax)
                } else {
                    let place = few.places[rank as usize];
                    Hit {
                        t: answers.t[i],
                        u: answers.u[i],
                        v: answers.v[i],
                        prim: place.slot,
                        leaf: place.leaf,
                        lane: place.lane,
                    }
                },
            );
        }
    };
    for (i, ray) in rays.iter().enumerate() {
        let axis = steepest(ray.d);
        waiting[axis][counts[axis]] = i as u32;
        counts[axis] += 1;
        if counts[axis] == lanes {
            counts[axis] = 0;
            packet(&mut waiting[axis], axis, lanes);
        }
    }
    for axis in 0..3 {
        if counts[axis] > 0 {
            packet(&mut waiting[axis], axis, counts[axis]);
        }
    }
    // a list of boxes is what a node is
    counters.nodes += rays.len() as u64;
    counters.leaves += answers.entered;
}

/// Rays of a kernel's packet, if it has packets.
pub(super) fn lanes(kernel: Kernel) -> Option<usize> {
    match kernel {
        Kernel::Avx512 => Some(Sixteen::LANES),
        Kernel::Avx2 => Some(Eight::LANES),
        Kernel::Auto | Kernel::Scalar => None,
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

/// What all packets along an axis have in common.
struct Scene<'a> {
    few: &'a Few,
    /// Largest magnitude of a coordinate.
    largest: f32,
    axis: usize,
}

/// [`through`] with AVX-512.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn avx512<const ANY: bool>(
    scene: &Scene,
    rays: &[Ray],
    numbers: &[u32; MOST],
    count: usize,
    answers: &mut Answers,
) {
    // SAFETY: the features are enabled.
    unsafe { through::<Sixteen, ANY>(scene, rays, numbers, count, answers) }
}

/// [`through`] with AVX2.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn avx2<const ANY: bool>(
    scene: &Scene,
    rays: &[Ray],
    numbers: &[u32; MOST],
    count: usize,
    answers: &mut Answers,
) {
    // SAFETY: the features are enabled.
    unsafe { through::<Eight, ANY>(scene, rays, numbers, count, answers) }
}

/// Takes a packet through everything.
///
/// # Safety
/// Features of `W` are enabled; the first [`Width::LANES`] numbers are of rays.
#[inline(always)]
unsafe fn through<W: Width, const ANY: bool>(
    scene: &Scene,
    rays: &[Ray],
    numbers: &[u32; MOST],
    count: usize,
    answers: &mut Answers,
) {
    // SAFETY: the features are enabled, numbers and answers have a place for each lane, and a group ends among the triangles.
    unsafe {
        let few = scene.few;
        let mut p = Packet::<W>::start(W::columns(rays.as_ptr(), numbers.as_ptr()), scene.largest, scene.axis);
        let live = (1u32 << count) - 1;
        let triangles = few.along[scene.axis].as_ptr();
        let mut first = 0;
        for group in &few.groups {
            let entered = p.enters(&group.bounds);
            let bits = W::bits(entered);
            if bits != 0 {
                answers.entered += u64::from((bits & live).count_ones());
                for i in first..group.end {
                    p.triangle::<ANY>(entered, &*triangles.add(i));
                }
            }
            first = group.end;
        }
        for ball in &few.balls {
            let entered = p.enters(&ball.bounds);
            let bits = W::bits(entered);
            if bits != 0 {
                answers.entered += u64::from((bits & live).count_ones());
                p.ball::<ANY>(entered, ball);
            }
        }
        W::store(answers.t.as_mut_ptr(), p.tmax);
        W::store(answers.u.as_mut_ptr(), p.u);
        W::store(answers.v.as_mut_ptr(), p.v);
        W::store(answers.rank.as_mut_ptr(), p.rank);
    }
}

/// Rays along one axis, one in each lane. What they are is in [`super::setup::State`]; axes stand in their own order for boxes and in
/// that of the rays for triangles.
struct Packet<W: Width> {
    inverse: [W::F; 3],
    near: [W::F; 3],
    far: [W::F; 3],
    is_negative: [W::Mask; 3],
    origin: [W::F; 3],
    shear: [W::F; 3],
    tmin: W::F,
    /// The rays' limits, then their best hits.
    tmax: W::F,
    u: W::F,
    v: W::F,
    /// Of the best hit, infinite where there is none.
    rank: W::F,
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
    unsafe fn start(columns: [W::F; 8], largest: f32, axis: usize) -> Packet<W> {
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
                u: zero,
                v: zero,
                rank: W::all(f32::INFINITY),
                o,
                d,
            }
        }
    }

    /// Which rays enter a box before their best hit. Conservative: see [`super::setup`].
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    unsafe fn enters(&self, b: &Aabb) -> W::Mask {
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
            W::le(first, last)
        }
    }

    /// Tests a triangle as [`super::triangle::intersect`] does, for the rays that have entered its box.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    unsafe fn triangle<const ANY: bool>(&mut self, entered: W::Mask, triangle: &Along) {
        // SAFETY: the features are enabled.
        unsafe {
            let [a, b, c] = &triangle.vertices;
            let ([ax, ay, az], [bx, by, bz], [cx, cy, cz]) = (self.sheared(a), self.sheared(b), self.sheared(c));
            let (u, v, w) = (edge::<W>(cx, cy, bx, by), edge::<W>(ax, ay, cx, cy), edge::<W>(bx, by, ax, ay));
            let zero = W::all(0.0);
            let least = W::min(W::min(u, v), w);
            let most = W::max(W::max(u, v), w);
            let inside = W::and(W::or(W::le(zero, least), W::le(most, zero)), entered);
            if W::bits(inside) == 0 {
                return;
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
            self.accept::<ANY>(inside, t, bv, bw, triangle.rank);
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

    /// Tests a sphere as [`super::sphere::intersect`] does, for the rays that have entered its box: sums from left to right, and no
    /// fused operations. A nearer hit that is too near gives way to the farther one; where it is too far, the other is farther.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    unsafe fn ball<const ANY: bool>(&mut self, entered: W::Mask, ball: &Ball) {
        // SAFETY: the features are enabled.
        unsafe {
            let zero = W::all_wide(0.0);
            let d = [W::widen(self.d[0]), W::widen(self.d[1]), W::widen(self.d[2])];
            let mut l = d;
            let mut a = 0;
            while a < 3 {
                l[a] = W::sub_wide(W::widen(self.o[a]), W::all_wide(f64::from(ball.sphere.center[a])));
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
            let r = f64::from(ball.sphere.radius);
            let inside = W::sub_wide(W::all_wide(r * r), dot::<W>(foot, foot));
            let meets = W::and(W::le_wide(zero, inside), entered);
            if W::bits(meets) == 0 {
                return;
            }
            // NaN where the ray passes by
            let half = W::sqrt_wide(W::div_wide(inside, dd));
            let near = W::narrow(W::sub_wide(middle, half));
            let far = W::narrow(W::add_wide(middle, half));
            let t = W::select(W::lt(self.tmin, near), near, far);
            self.accept::<ANY>(meets, t, W::all(0.0), W::all(0.0), ball.rank);
        }
    }

    /// Takes hits with `tmin < t <= tmax` where they are nearer than the best so far or, at the same distance, of a lesser rank. With
    /// `ANY` the rays that have one are done.
    ///
    /// # Safety
    /// Features of `W` are enabled.
    #[inline(always)]
    unsafe fn accept<const ANY: bool>(&mut self, mask: W::Mask, t: W::F, u: W::F, v: W::F, rank: f32) {
        // SAFETY: the features are enabled.
        unsafe {
            let rank = W::all(rank);
            let is_less = W::or(W::lt(t, self.tmax), W::and(W::eq(t, self.tmax), W::lt(rank, self.rank)));
            let hits = W::and(W::and(W::lt(self.tmin, t), is_less), mask);
            self.rank = W::select(hits, rank, self.rank);
            if ANY {
                self.tmax = W::select(hits, W::all(-1.0), self.tmax);
                return;
            }
            self.tmax = W::select(hits, t, self.tmax);
            self.u = W::select(hits, u, self.u);
            self.v = W::select(hits, v, self.v);
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
