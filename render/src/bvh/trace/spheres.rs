//! The vector kernel's spheres: eight boxes and four spheres at a time, the answers of [`scalar::spheres`] to the bit.
#![allow(unsafe_code)] // intrinsics, and unchecked reads of an arena whose references were checked when it was filled

use std::arch::x86_64::*;

use super::super::forest::Forest;
use super::super::layout::*;
use super::setup::State;
use super::vector::{Avx2, Avx512, InstructionSet};
use super::wide::boxes;
use super::{Counters, Kernel, accept, runs, scalar};
use crate::ray::Ray;

/// Traces one ray through the forest's spheres: [`scalar::spheres`].
///
/// # Panics
/// When the kernel is none of vectors or the processor cannot run it.
pub(super) fn trace<const ANY: bool>(
    kernel: Kernel,
    forest: &Forest,
    root: u32,
    ray: &Ray,
    state: &mut State,
    stack: &mut scalar::Stack,
    counters: &mut Counters,
) {
    debug_assert!(runs(kernel));
    match kernel {
        // SAFETY: whoever made the tracer found that the processor has the features.
        Kernel::Avx512 => unsafe { avx512::<ANY>(forest, root, ray, state, stack, counters) },
        // SAFETY: as above.
        Kernel::Avx2 => unsafe { avx2::<ANY>(forest, root, ray, state, stack, counters) },
        Kernel::Auto | Kernel::Scalar => unreachable!("no vector kernel"),
    }
}

/// [`visits`] with AVX-512.
///
/// # Safety
/// The processor has what is enabled here.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn avx512<const ANY: bool>(
    forest: &Forest,
    root: u32,
    ray: &Ray,
    state: &mut State,
    stack: &mut scalar::Stack,
    counters: &mut Counters,
) {
    // SAFETY: the features are enabled.
    unsafe { visits::<Avx512, ANY>(forest, root, ray, state, stack, counters) }
}

/// [`visits`] with AVX2.
///
/// # Safety
/// The processor has what is enabled here.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn avx2<const ANY: bool>(
    forest: &Forest,
    root: u32,
    ray: &Ray,
    state: &mut State,
    stack: &mut scalar::Stack,
    counters: &mut Counters,
) {
    // SAFETY: the features are enabled.
    unsafe { visits::<Avx2, ANY>(forest, root, ray, state, stack, counters) }
}

/// # Safety
/// Features of `I` are enabled.
#[inline(always)]
unsafe fn visits<I: InstructionSet, const ANY: bool>(
    forest: &Forest,
    root: u32,
    ray: &Ray,
    state: &mut State,
    stack: &mut scalar::Stack,
    counters: &mut Counters,
) {
    let arena = forest.arena().as_ptr();
    // SAFETY: the features are enabled; references of the forest's trees lead to whole nodes and leaves.
    let enter = |s: &State, _: &[u8], node: usize, stack: &mut _| unsafe { enter::<I>(s, arena.add(node), stack) };
    let line = Line::of(ray);
    let leaf = |state: &mut State, reference: u32| {
        let n = leaf_len(reference);
        // SAFETY: as above.
        let (mask, ts) = unsafe { four_by_four::<ANY>(arena.add(offset(reference)).cast(), n, &line, state) };
        if ANY {
            state.prim = if mask != 0 { 0 } else { state.prim };
            return mask != 0;
        }
        let mut mask = mask;
        while mask != 0 {
            let i = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            // SAFETY: the lane is below n.
            let slot = unsafe { *arena.add(offset(reference)).cast::<u32>().add(INDEX_ROW * n + i) };
            accept(forest, state, ts[i], [0.0; 2], slot, reference, i as u32);
        }
        false
    };
    scalar::traverse(forest.arena(), root, state, stack, counters, enter, leaf);
}

/// A ray in f64, as [`super::sphere::intersect`] has it.
struct Line {
    o: [f64; 3],
    d: [f64; 3],
    dd: f64,
}

impl Line {
    #[inline(always)]
    fn of(ray: &Ray) -> Line {
        let (o, d) = (ray.o.map(f64::from), ray.d.map(f64::from));
        Line { o, d, dd: d[0] * d[0] + d[1] * d[1] + d[2] * d[2] }
    }
}

/// Tests the n <= 8 spheres of a leaf, as [`super::sphere::intersect`] does: mask of those that are hit, and where.
///
/// A sphere's nearer hit that is too near gives way to the farther one; one that is too far needs no such care, as the other is farther.
///
/// # Safety
/// `leaf` is a leaf of `n` spheres, with 32 readable bytes past its end; AVX2 is enabled.
#[inline(always)]
unsafe fn four_by_four<const ANY: bool>(leaf: *const f32, n: usize, line: &Line, state: &State) -> (u32, [f32; WIDTH]) {
    // SAFETY: rows of n values lie in the leaf; four are read from places below n, at most 12 bytes past a row's end.
    unsafe {
        let all = |x: f64| _mm256_set1_pd(x);
        let [ox, oy, oz] = line.o.map(all);
        let [dx, dy, dz] = line.d.map(all);
        let dd = all(line.dd);
        let (tmin, tmax) = (_mm_set1_ps(state.tmin), _mm_set1_ps(state.tmax));
        // sums from left to right and no fused operations, as the plain one's
        let dot = |ax, ay, az, bx, by, bz| {
            let xy = _mm256_add_pd(_mm256_mul_pd(ax, bx), _mm256_mul_pd(ay, by));
            _mm256_add_pd(xy, _mm256_mul_pd(az, bz))
        };
        let within = |t| _mm_and_ps(_mm_cmplt_ps(tmin, t), _mm_cmple_ps(t, tmax));
        let mut ts = [0.0; WIDTH];
        let mut mask = 0;
        let mut first = 0;
        while first < n {
            let row = |r: usize| _mm256_cvtps_pd(_mm_loadu_ps(leaf.add(r * n + first)));
            let (lx, ly, lz) = (_mm256_sub_pd(ox, row(0)), _mm256_sub_pd(oy, row(1)), _mm256_sub_pd(oz, row(2)));
            let r = row(3);
            let minus = _mm256_xor_pd(dot(lx, ly, lz, dx, dy, dz), all(-0.0));
            let middle = _mm256_div_pd(minus, dd);
            let foot = |l, d| _mm256_add_pd(l, _mm256_mul_pd(middle, d));
            let (fx, fy, fz) = (foot(lx, dx), foot(ly, dy), foot(lz, dz));
            let inside = _mm256_sub_pd(_mm256_mul_pd(r, r), dot(fx, fy, fz, fx, fy, fz));
            let live = (1u32 << (n - first).min(4)) - 1;
            let missed = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(inside, _mm256_setzero_pd())) as u32;
            // most rays pass by all of them, and a root of a quotient is dear
            if missed & live != live {
                // NaN where the ray passes by: within nothing
                let half = _mm256_sqrt_pd(_mm256_div_pd(inside, dd));
                let near = _mm256_cvtpd_ps(_mm256_sub_pd(middle, half));
                let far = _mm256_cvtpd_ps(_mm256_add_pd(middle, half));
                let near_counts = within(near);
                let t = _mm_blendv_ps(far, near, near_counts);
                let hits = _mm_movemask_ps(_mm_or_ps(near_counts, within(far))) as u32 & !missed & live;
                _mm_storeu_ps(ts.as_mut_ptr().add(first), t);
                mask |= hits << first;
                if ANY && mask != 0 {
                    break;
                }
            }
            first += 4;
        }
        (mask, ts)
    }
}

/// Pushes those of a node's children that the ray enters, slot by slot, as the plain kernel does.
///
/// # Safety
/// `node` is a node; features of `I` are enabled.
#[inline(always)]
unsafe fn enter<I: InstructionSet>(state: &State, node: *const u8, stack: &mut scalar::Stack) {
    let (mut distances, mut references) = ([0.0f32; WIDTH], [0u32; WIDTH]);
    // SAFETY: a node; arrays of a vector's size.
    let mut mask = unsafe {
        let (mask, distance, children) = boxes::<I>(node, state);
        _mm256_storeu_ps(distances.as_mut_ptr(), distance);
        _mm256_storeu_si256(references.as_mut_ptr().cast(), children);
        mask
    };
    while mask != 0 {
        let slot = mask.trailing_zeros() as usize;
        mask &= mask - 1;
        stack.push((distances[slot], references[slot]));
    }
}
