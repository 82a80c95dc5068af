//! The vector kernel: eight boxes or eight triangles at a time, and many rays in flight.
//!
//! Each of the [`IN_FLIGHT`] rays has its state and its own stack; they advance together in rounds. A round is a sequence
//! of short loops without unpredictable branches, so cache misses and latencies of different rays overlap:
//! 1. a node visit for every ray whose next record is a node: children that are hit are pushed, the nearest on top;
//! 2. a leaf visit for every ray whose next record is a leaf;
//! 3. the hits found are accepted;
//! 4. every ray pops its next record, skipping what lies behind its best hit, and prefetches it;
//! 5. rays that are done are written and replaced by the next of the batch.
//!
//! A stack has two parallel arrays: keys and references. A key is the bits of the entry distance (not negative, so
//! they order like integers) with 7 - slot of the child in the low three bits: it rounds the distance down by less than 8
//! ulp, and of children that begin at the same distance (the ray begins in them) the last slot, the smallest, comes first.
//! An entry is skipped when its key is above `tmax | 7`, so never when its distance is at most `tmax`.
#![allow(unsafe_code)] // intrinsics, and unchecked reads of an arena whose references were checked when it was filled

use std::arch::x86_64::*;

use super::super::forest::Forest;
use super::super::layout::*;
use super::setup::State;
use super::start::start;
use super::triangle::{SMALL_AREA, barycentrics_of_small};
use super::vector::{Avx2, Avx512, InstructionSet, sort4, sort8};
use super::{Counters, Kernel, accept, runs};
use crate::ray::{MISS, Ray};

/// Rays in flight; 32 are 1 to 14 % slower where the tree is larger than the caches, 64 are no faster (docs/benchmarks/tried.md).
const IN_FLIGHT: usize = 48;
/// In the place of a reference: the ray is done. No leaf has it: its eight primitives would pass the arena's end.
const DONE: u32 = u32::MAX;
/// Entries below the bottom of each stack, so that eight can be read at once. Their keys are above every distance.
const BASE: usize = 7;

/// Trees of so many bytes stay in the first cache: what comes next need not be fetched ahead.
const NEAR_BYTES: u64 = 16 << 10;

/// Buffers of the rays in flight.
#[derive(Default)]
pub(super) struct Lanes {
    /// Length of one ray's stack.
    stride: usize,
    states: Vec<State>,
    keys: Vec<i32>,
    references: Vec<u32>,
}

impl Lanes {
    /// Makes room for a forest's traversals.
    fn fit(&mut self, stack: usize) {
        // the entries, those below the bottom, the bottom, and 8 that a store may write above the top; one line more keeps
        // stacks of a power of two from falling into the same cache sets
        let stride = (BASE + 1 + stack + WIDTH).next_multiple_of(8) + 8;
        if self.stride < stride {
            self.stride = stride;
            self.keys = vec![i32::MAX; IN_FLIGHT * stride];
            self.references = vec![DONE; IN_FLIGHT * stride];
        }
        self.states.resize(IN_FLIGHT, State::NOTHING);
    }
}

/// A leaf visit that found something.
#[repr(C, align(32))]
#[derive(Clone, Copy)]
struct Found {
    t: [f32; WIDTH],
    u: [f32; WIDTH],
    v: [f32; WIDTH],
    /// Lanes that are hits.
    mask: u32,
    /// The ray, by its place in flight.
    lane: usize,
}

/// Traces `rays[order[..]]`, or all rays as they stand when `order` is empty, through the triangles, and tells `done` each ray's number and final
/// state, and whether it may meet spheres that count: whether it enters a child of their root.
///
/// # Panics
/// When the kernel is none of this module or the processor cannot run it.
pub(super) fn trace<const ANY: bool>(
    kernel: Kernel,
    lanes: &mut Lanes,
    forest: &Forest,
    rays: &[Ray],
    order: &[u32],
    done: &mut impl FnMut(usize, &mut State, bool),
    counters: &mut Counters,
) {
    assert!(runs(kernel));
    match kernel {
        // SAFETY: the processor has the features.
        Kernel::Avx512 => unsafe { avx512::<ANY, _>(lanes, forest, rays, order, done, counters) },
        // SAFETY: as above.
        Kernel::Avx2 => unsafe { avx2::<ANY, _>(lanes, forest, rays, order, done, counters) },
        Kernel::Auto | Kernel::Scalar => unreachable!("no vector kernel"),
    }
}

/// [`rounds`] with AVX-512.
///
/// # Safety
/// The processor has what is enabled here.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn avx512<const ANY: bool, D: FnMut(usize, &mut State, bool)>(
    lanes: &mut Lanes,
    forest: &Forest,
    rays: &[Ray],
    order: &[u32],
    done: &mut D,
    counters: &mut Counters,
) {
    // SAFETY: the features are enabled.
    unsafe { rounds::<Avx512, ANY, D>(lanes, forest, rays, order, done, counters) }
}

/// [`rounds`] with AVX2.
///
/// # Safety
/// The processor has what is enabled here.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn avx2<const ANY: bool, D: FnMut(usize, &mut State, bool)>(
    lanes: &mut Lanes,
    forest: &Forest,
    rays: &[Ray],
    order: &[u32],
    done: &mut D,
    counters: &mut Counters,
) {
    // SAFETY: the features are enabled.
    unsafe { rounds::<Avx2, ANY, D>(lanes, forest, rays, order, done, counters) }
}

/// # Safety
/// Called where the features of `I` are enabled.
#[inline(always)]
unsafe fn rounds<I: InstructionSet, const ANY: bool, D: FnMut(usize, &mut State, bool)>(
    lanes: &mut Lanes,
    forest: &Forest,
    rays: &[Ray],
    order: &[u32],
    done: &mut D,
    counters: &mut Counters,
) {
    lanes.fit(forest.stack());
    let stride = lanes.stride;
    let arena = forest.arena().as_ptr();
    let (root, largest) = (forest.root(), forest.largest());
    let sphere_root = forest.sphere_root();
    let total = if order.is_empty() { rays.len() } else { order.len() };
    let number = |i: usize| if order.is_empty() { i } else { order[i] as usize };

    let states = lanes.states.as_mut_ptr();
    let (keys, references) = (lanes.keys.as_mut_ptr(), lanes.references.as_mut_ptr());
    let blank = Found { t: [0.0; WIDTH], u: [0.0; WIDTH], v: [0.0; WIDTH], mask: 0, lane: 0 };
    // one more than there are rays: lists are written before it is known whether the entry counts
    let mut found = [blank; IN_FLIGHT + 1];
    let mut inner = [0u8; IN_FLIGHT + 1];
    let mut leaf = [0u8; IN_FLIGHT + 1];
    let mut finished = [0u8; IN_FLIGHT + 1];
    let found = found.as_mut_ptr();
    let (inner, leaf, finished) = (inner.as_mut_ptr(), leaf.as_mut_ptr(), finished.as_mut_ptr());
    let (mut inners, mut leaves) = (0, 0);
    let mut next = 0;
    let mut flying = 0;

    let start = |i: usize, state: &mut State| {
        // SAFETY: the caller has the features.
        unsafe { start(state, &rays[i], largest, root, i as u32, BASE as u32) };
    };
    let is_far = forest.arena_in_use() > NEAR_BYTES;

    // SAFETY, for all that follows: lists have at most `flying` <= IN_FLIGHT entries, plus one that is written and not
    // counted; their entries are below IN_FLIGHT. A stack holds at most forest.stack() entries above its bottom at
    // BASE (the bound was computed when the tree was made or checked), and `fit` made it long enough for that, for eight
    // entries below the top, and for eight above. The bottom's key is below every bound and its reference is DONE, so
    // popping ends there. References other than DONE were checked (or made here) to lead to whole nodes and leaves inside
    // the arena; the arena has 512 readable bytes after the last record, more than a vector past a leaf.
    unsafe {
        while next < total && flying < IN_FLIGHT {
            start(number(next), &mut *states.add(flying));
            *keys.add(flying * stride + BASE) = i32::MIN;
            *references.add(flying * stride + BASE) = DONE;
            *inner.add(flying) = flying as u8;
            flying += 1;
            next += 1;
        }
        inners += flying;
        let seven = _mm256_set1_epi32(7);
        let slots = _mm256_setr_epi32(7, 6, 5, 4, 3, 2, 1, 0);
        while flying > 0 {
            counters.nodes += inners as u64;
            counters.leaves += leaves as u64;
            for i in 0..inners {
                let lane = *inner.add(i) as usize;
                let state = &mut *states.add(lane);
                let (mask, distance, children) = boxes::<I>(arena.add(offset(state.current)), state);
                let top = lane * stride + state.top as usize + 1;
                let (key_top, reference_top) = (keys.add(top).cast(), references.add(top).cast());
                let hits = mask.count_ones();
                if ANY {
                    _mm256_storeu_si256(reference_top, I::compress(mask, children, 0));
                } else {
                    let key =
                        _mm256_or_si256(_mm256_and_si256(_mm256_castps_si256(distance), _mm256_set1_epi32(!7)), slots);
                    let key = I::compress(mask, key, -1);
                    let key =
                        if hits <= 4 { _mm256_castsi128_si256(sort4(_mm256_castsi256_si128(key))) } else { sort8(key) };
                    _mm256_storeu_si256(key_top, key);
                    // the permutation reads the low three bits of each lane only: 7 - slot, so flipped
                    _mm256_storeu_si256(
                        reference_top,
                        _mm256_permutevar8x32_epi32(children, _mm256_xor_si256(key, seven)),
                    );
                }
                state.top += hits;
            }

            let mut founds = 0;
            for i in 0..leaves {
                let lane = *leaf.add(i) as usize;
                if ANY {
                    // which one does not matter: the ray is done
                    let state = &mut *states.add(lane);
                    let is_hit = triangles::<I, ANY>(arena, state).0 != 0;
                    state.prim = if is_hit { 0 } else { state.prim };
                    state.top = if is_hit { BASE as u32 } else { state.top };
                    continue;
                }
                let f = &mut *found.add(founds);
                let (mask, [t, u, v]) = triangles::<I, ANY>(arena, &*states.add(lane));
                _mm256_store_ps(f.t.as_mut_ptr(), t);
                _mm256_store_ps(f.u.as_mut_ptr(), u);
                _mm256_store_ps(f.v.as_mut_ptr(), v);
                (f.mask, f.lane) = (mask, lane);
                founds += usize::from(mask != 0);
            }
            for i in 0..founds {
                let f = &*found.add(i);
                let state = &mut *states.add(f.lane);
                let reference = state.current;
                let n = leaf_len(reference);
                let indices = arena.add(offset(reference) + INDEX_ROW * n * 4).cast::<u32>();
                let mut mask = f.mask;
                while mask != 0 {
                    let k = mask.trailing_zeros() as usize;
                    mask &= mask - 1;
                    accept(forest, state, f.t[k], [f.u[k], f.v[k]], *indices.add(k), reference, k as u32);
                }
            }

            (inners, leaves) = (0, 0);
            let mut finishes = 0;
            for lane in 0..flying {
                let state = &mut *states.add(lane);
                let mut top = state.top as usize;
                if !ANY {
                    let bound = _mm256_set1_epi32(state.tmax.to_bits() as i32 | 7);
                    loop {
                        let eight = _mm256_loadu_si256(keys.add(lane * stride + top - BASE).cast());
                        let behind = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpgt_epi32(eight, bound)));
                        let near = behind as u32 ^ 255;
                        if near != 0 {
                            top -= (near << 24).leading_zeros() as usize;
                            break;
                        }
                        top -= WIDTH;
                    }
                }
                let current = *references.add(lane * stride + top);
                state.top = (top as u32).wrapping_sub(1);
                state.current = current;
                if is_far {
                    // wrapping: DONE leads nowhere, and a prefetch may
                    let record = arena.wrapping_add(offset(current)).cast::<i8>();
                    _mm_prefetch::<_MM_HINT_T0>(record);
                    _mm_prefetch::<_MM_HINT_T0>(record.wrapping_add(64));
                    _mm_prefetch::<_MM_HINT_T0>(record.wrapping_add(128));
                    _mm_prefetch::<_MM_HINT_T0>(record.wrapping_add(192));
                }
                *inner.add(inners) = lane as u8;
                *leaf.add(leaves) = lane as u8;
                *finished.add(finishes) = lane as u8;
                let is_leaf = (current >> 31) as usize;
                let is_done = usize::from(current == DONE);
                inners += 1 - is_leaf;
                leaves += is_leaf - is_done;
                finishes += is_done;
            }

            for i in (0..finishes).rev() {
                let lane = *finished.add(i) as usize;
                let state = &mut *states.add(lane);
                let mut meets = false;
                if let Some(root) = sphere_root.filter(|_| !(ANY && state.prim != MISS)) {
                    meets = boxes::<I>(arena.add(offset(root)), state).0 != 0;
                    // whoever meets some visits the node once more, and counts it
                    counters.nodes += u64::from(!meets & (state.tmin <= state.tmax));
                }
                done(state.ray as usize, state, meets);
                if next < total {
                    if !order.is_empty() {
                        let ahead = order[(next + IN_FLIGHT).min(total - 1)] as usize;
                        _mm_prefetch::<_MM_HINT_T0>(rays.as_ptr().wrapping_add(ahead).cast());
                    }
                    start(number(next), state);
                    next += 1;
                    *inner.add(inners) = lane as u8;
                    inners += 1;
                    continue;
                }
                // nothing is left to start: the last in flight moves to the free place
                flying -= 1;
                if lane != flying {
                    *states.add(lane) = *states.add(flying);
                    let (from, to) = (flying * stride, lane * stride);
                    std::ptr::copy_nonoverlapping(keys.add(from), keys.add(to), stride);
                    std::ptr::copy_nonoverlapping(references.add(from), references.add(to), stride);
                    for k in 0..inners {
                        if *inner.add(k) as usize == flying {
                            *inner.add(k) = lane as u8;
                        }
                    }
                    for k in 0..leaves {
                        if *leaf.add(k) as usize == flying {
                            *leaf.add(k) = lane as u8;
                        }
                    }
                }
            }
        }
    }
}

/// Tests a node's eight boxes: mask of those entered, entry distances, references. Conservative: see [`super::setup`].
///
/// # Safety
/// `node` is a node; features of `I` are enabled.
#[inline(always)]
pub(super) unsafe fn boxes<I: InstructionSet>(node: *const u8, state: &State) -> (u32, __m256, __m256i) {
    // SAFETY: rows are 32 bytes each within the node's 224, and nodes are aligned to 64.
    unsafe {
        let all = |x: f32| _mm256_set1_ps(x);
        let row = |byte: u32| _mm256_load_ps(node.add(byte as usize).cast());
        let [x, y, z] = state.near_row;
        let [rx, ry, rz, _] = state.inverse.to_array();
        let [nx, ny, nz, _] = state.near.to_array();
        let [fx, fy, fz, _] = state.far.to_array();
        let (rx, ry, rz) = (all(rx), all(ry), all(rz));
        let near_x = _mm256_fmsub_ps(row(x), rx, all(nx));
        let near_y = _mm256_fmsub_ps(row(y), ry, all(ny));
        let near_z = _mm256_fmsub_ps(row(z), rz, all(nz));
        let far_x = _mm256_fmsub_ps(row(x ^ 32), rx, all(fx));
        let far_y = _mm256_fmsub_ps(row(y ^ 32), ry, all(fy));
        let far_z = _mm256_fmsub_ps(row(z ^ 32), rz, all(fz));
        let references = _mm256_load_si256(node.add(NODE_REFS).cast());
        // of zeros, the maximum is its second operand: tmin, which is never -0
        let first = _mm256_max_ps(_mm256_max_ps(near_x, near_y), _mm256_max_ps(near_z, all(state.tmin)));
        let last = _mm256_min_ps(_mm256_min_ps(far_x, far_y), _mm256_min_ps(far_z, all(state.tmax)));
        (I::compare::<_CMP_LE_OQ>(first, last), first, references)
    }
}

/// Tests the triangles of the leaf that a ray is at (with `ANY`, only the mask is an answer), as [`super::triangle::intersect`] does: mask of hits; t and the barycentrics of
/// the second and third vertex.
///
/// # Safety
/// The ray's current reference is a leaf in `arena`; features of `I` are enabled.
#[inline(always)]
unsafe fn triangles<I: InstructionSet, const ANY: bool>(arena: *const u8, state: &State) -> (u32, [__m256; 3]) {
    // SAFETY: rows of n values lie in the leaf; eight are read of each, at most 28 bytes past the leaf's end.
    unsafe {
        let leaf = arena.add(offset(state.current)).cast::<f32>();
        let n = leaf_len(state.current);
        let live = (1u32 << n) - 1;
        let all = |x: f32| _mm256_set1_ps(x);
        let [kx, ky, kz] = state.axes.map(|k| k as usize * n);
        let [ox, oy, oz, _] = state.origin.map(all);
        let [sx, sy, sz, _] = state.shear.map(all);
        let vertex = |v: usize| {
            let rows = leaf.add(v * 3 * n);
            let z = _mm256_sub_ps(_mm256_loadu_ps(rows.add(kz)), oz);
            let x = _mm256_fnmadd_ps(sx, z, _mm256_sub_ps(_mm256_loadu_ps(rows.add(kx)), ox));
            let y = _mm256_fnmadd_ps(sy, z, _mm256_sub_ps(_mm256_loadu_ps(rows.add(ky)), oy));
            (x, y, z)
        };
        let (ax, ay, az) = vertex(0);
        let (bx, by, bz) = vertex(1);
        let (cx, cy, cz) = vertex(2);
        let edge = |px, py, qx, qy| {
            let product = _mm256_mul_ps(py, qx);
            let error = _mm256_fnmadd_ps(py, qx, product);
            _mm256_add_ps(_mm256_fmsub_ps(px, qy, product), error)
        };
        let u = edge(cx, cy, bx, by);
        let v = edge(ax, ay, cx, cy);
        let w = edge(bx, by, ax, ay);
        let zero = _mm256_setzero_ps();
        let least = _mm256_min_ps(_mm256_min_ps(u, v), w);
        let most = _mm256_max_ps(_mm256_max_ps(u, v), w);
        let inside = (I::compare::<_CMP_GE_OQ>(least, zero) | I::compare::<_CMP_LE_OQ>(most, zero)) & live;
        // most leaf visits of a shadow ray end here; where hits are wanted the branch is hard to foretell and costs more than it saves
        if ANY && inside == 0 {
            return (0, [zero; 3]);
        }
        let sum = _mm256_add_ps(_mm256_add_ps(u, v), w);
        let scale = _mm256_div_ps(all(1.0), sum);
        let mut barycentrics = [_mm256_mul_ps(u, scale), _mm256_mul_ps(v, scale), _mm256_mul_ps(w, scale)];
        let size = _mm256_andnot_ps(all(-0.0), sum);
        let small = I::compare::<_CMP_LT_OQ>(size, all(SMALL_AREA)) & inside;
        if small != 0 {
            replace_small(small, &[ax, ay, bx, by, cx, cy], &mut barycentrics);
        }
        let [bu, bv, bw] = barycentrics;
        let t = _mm256_mul_ps(_mm256_fmadd_ps(bu, az, _mm256_fmadd_ps(bv, bz, _mm256_mul_ps(bw, cz))), sz);
        let hits = inside & I::compare::<_CMP_LT_OQ>(all(state.tmin), t) & I::compare::<_CMP_LE_OQ>(t, all(state.tmax));
        (hits, [t, bv, bw])
    }
}

/// Puts in place the barycentrics of triangles of a small projected area: see [`barycentrics_of_small`].
#[cold]
#[inline(never)]
fn replace_small(lanes: u32, sheared: &[__m256; 6], barycentrics: &mut [__m256; 3]) {
    // SAFETY: a vector of eight floats and an array of eight are the same bytes.
    let (sheared, barycentrics) = unsafe {
        (
            &*std::ptr::from_ref(sheared).cast::<[[f32; WIDTH]; 6]>(),
            &mut *std::ptr::from_mut(barycentrics).cast::<[[f32; WIDTH]; 3]>(),
        )
    };
    for i in (0..WIDTH).filter(|i| lanes >> i & 1 != 0) {
        let [a, b, c] = std::array::from_fn(|v| [sheared[2 * v][i], sheared[2 * v + 1][i]]);
        // NaN: its t compares false, the test refuses it
        let (u, v, w) = barycentrics_of_small(a, b, c).unwrap_or((f32::NAN, f32::NAN, f32::NAN));
        (barycentrics[0][i], barycentrics[1][i], barycentrics[2][i]) = (u, v, w);
    }
}
