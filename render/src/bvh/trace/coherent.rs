//! The vector kernel for coherent rays: packets through the triangles' tree, which read a node once for all of their rays.
//!
//! A packet visits what any of its rays enters, the child first that one of them enters first. Rays that do not enter a leaf are tested against
//! its triangles too, which finds nothing new: the answer is the least (t, global id) over all triangles, whatever is tested beside those
//! whose boxes a ray enters.
#![allow(unsafe_code)] // intrinsics, and unchecked reads of an arena whose references were checked when it was filled

use super::super::forest::Forest;
use super::super::layout::*;
use super::packet::{MOST, Members, Packet, deal};
use super::width::{Eight, Sixteen, Width};
use super::{Counters, Kernel, runs};
use crate::memory::prefetch;
use crate::ray::{Hit, Ray};

/// What is still to be visited.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    /// Where the first ray enters.
    distance: f32,
    reference: u32,
    /// Rays that enter, as bits.
    entered: u32,
}

/// What a packet's rays hit, and what was done for it.
#[repr(C, align(64))]
struct Answers {
    t: [f32; MOST],
    uv: [[f32; MOST]; 2],
    /// Bits of references to leaves; 0 where nothing is hit.
    leaf: [f32; MOST],
    /// Places in these leaves, as numbers.
    lane: [f32; MOST],
    /// Nodes and leaves entered by rays that count.
    entered: [u64; 2],
    /// Nodes visited by packets.
    visits: u64,
}

/// Traces rays through a forest of triangles and tells `done` each ray's number and hit. Returns how many rays of a packet entered the
/// nodes that it visited, on average.
///
/// # Panics
/// When the kernel is none of vectors or the processor cannot run it.
pub(super) fn trace(
    kernel: Kernel,
    forest: &Forest,
    rays: &[Ray],
    done: &mut impl FnMut(usize, Hit),
    stack: &mut Vec<Entry>,
    counters: &mut Counters,
) -> f64 {
    assert!(runs(kernel));
    let zero = [0.0; MOST];
    let mut answers = Answers { t: zero, uv: [zero; 2], leaf: zero, lane: zero, entered: [0; 2], visits: 0 };
    deal(kernel, forest, rays, |of| {
        match kernel {
            // SAFETY: the processor has the features, and all numbers are of rays.
            Kernel::Avx512 => unsafe { avx512(of, stack, &mut answers) },
            // SAFETY: as above.
            Kernel::Avx2 => unsafe { avx2(of, stack, &mut answers) },
            Kernel::Auto | Kernel::Scalar => unreachable!("no vector kernel"),
        }
        for (i, &number) in of.numbers[..of.count].iter().enumerate() {
            let (ray, leaf, lane) = (number as usize, answers.leaf[i].to_bits(), answers.lane[i] as u32);
            if leaf == 0 {
                done(ray, Hit::miss(rays[ray].tmax));
                continue;
            }
            let [u, v] = [answers.uv[0][i], answers.uv[1][i]];
            let prim = read_index(forest.arena(), leaf, lane as usize);
            done(ray, Hit { t: answers.t[i], u, v, prim, leaf, lane });
        }
    });
    counters.nodes += answers.entered[0];
    counters.leaves += answers.entered[1];
    answers.entered[0] as f64 / answers.visits.max(1) as f64
}

/// [`through`] with AVX-512.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn avx512(of: &Members, stack: &mut Vec<Entry>, answers: &mut Answers) {
    // SAFETY: the features are enabled.
    unsafe { through::<Sixteen>(of, stack, answers) }
}

/// [`through`] with AVX2.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn avx2(of: &Members, stack: &mut Vec<Entry>, answers: &mut Answers) {
    // SAFETY: the features are enabled.
    unsafe { through::<Eight>(of, stack, answers) }
}

/// Takes a packet through the tree.
///
/// # Safety
/// Features of `W` are enabled; the first [`Width::LANES`] numbers are of rays.
#[inline(always)]
unsafe fn through<W: Width>(of: &Members, stack: &mut Vec<Entry>, answers: &mut Answers) {
    let arena = of.forest.arena().as_ptr();
    let live = (1u32 << of.count) - 1;
    // SAFETY: the features are enabled; numbers and answers have a place for each lane; references of the forest's trees lead to whole nodes
    // and leaves, aligned to 32 bytes.
    unsafe {
        let columns = W::columns(of.rays.as_ptr(), of.numbers.as_ptr());
        let mut p = Packet::<W>::start(columns, of.forest.largest(), of.axis);
        let (x, y, z) = ((of.axis + 1) % 3, (of.axis + 2) % 3, of.axis);
        let all = W::of_bits(!0);
        let (mut best_leaf, mut best_lane) = (W::all(0.0), W::all(0.0));
        stack.clear();
        stack.push(Entry { distance: 0.0, reference: of.forest.root(), entered: !0 });
        while let Some(entry) = stack.pop() {
            // behind every best hit; at the same distance there may be a smaller id
            if W::bits(W::le(W::all(entry.distance), p.tmax)) == 0 {
                continue;
            }
            let record = arena.add(offset(entry.reference));
            let entered = u64::from((entry.entered & live).count_ones());
            if entry.reference & LEAF == 0 {
                answers.entered[0] += entered;
                answers.visits += 1;
                let first = stack.len();
                for slot in 0..WIDTH {
                    let child = *record.add(NODE_REFS).cast::<u32>().add(slot);
                    if child == 0 {
                        continue;
                    }
                    let row = record.cast::<f32>().add(slot);
                    let bounds = Aabb {
                        lo: [*row, *row.add(2 * WIDTH), *row.add(4 * WIDTH)],
                        hi: [*row.add(WIDTH), *row.add(3 * WIDTH), *row.add(5 * WIDTH)],
                    };
                    let (mask, distance) = p.enters(&bounds);
                    let bits = W::bits(mask);
                    if bits != 0 {
                        let record = arena.add(offset(child));
                        // all of it: nothing else is done while a packet waits
                        prefetch(&*record);
                        prefetch(&*record.add(64));
                        prefetch(&*record.add(128));
                        prefetch(&*record.add(192));
                        stack.push(Entry { distance: W::least(mask, distance), reference: child, entered: bits });
                    }
                }
                // the nearest on top
                for i in first + 1..stack.len() {
                    let mut k = i;
                    while k > first && stack[k - 1].distance < stack[k].distance {
                        stack.swap(k - 1, k);
                        k -= 1;
                    }
                }
                continue;
            }
            answers.entered[1] += entered;
            let (n, rows) = (leaf_len(entry.reference), record.cast::<f32>());
            for i in 0..n {
                let a = rows.add(i);
                let (b, c) = (a.add(3 * n), a.add(6 * n));
                let vertices = [
                    [*a.add(x * n), *a.add(y * n), *a.add(z * n)],
                    [*b.add(x * n), *b.add(y * n), *b.add(z * n)],
                    [*c.add(x * n), *c.add(y * n), *c.add(z * n)],
                ];
                let Some(at) = p.triangle(all, &vertices) else { continue };
                let within = W::and(W::lt(p.tmin, at.t), at.mask);
                let mut hits = W::and(W::lt(at.t, p.tmax), within);
                let ties = W::bits(W::and(W::eq(at.t, p.tmax), within));
                if ties != 0 {
                    let mut best = [[0.0; MOST]; 2];
                    W::store(best[0].as_mut_ptr(), best_leaf);
                    W::store(best[1].as_mut_ptr(), best_lane);
                    let here = read_index(of.forest.arena(), entry.reference, i);
                    hits = W::or(hits, W::of_bits(preceding(of.forest, ties, here, &best)));
                }
                if W::bits(hits) != 0 {
                    p.accept(hits, &at);
                    best_leaf = W::select(hits, W::all(f32::from_bits(entry.reference)), best_leaf);
                    best_lane = W::select(hits, W::all(i as f32), best_lane);
                }
            }
        }
        W::store(answers.t.as_mut_ptr(), p.tmax);
        W::store(answers.uv[0].as_mut_ptr(), p.uv[0]);
        W::store(answers.uv[1].as_mut_ptr(), p.uv[1]);
        W::store(answers.leaf.as_mut_ptr(), best_leaf);
        W::store(answers.lane.as_mut_ptr(), best_lane);
    }
}

/// Of the rays whose best hit is as far away as the primitive in a slot, those for which this one goes before.
#[cold]
#[inline(never)]
fn preceding(forest: &Forest, ties: u32, here: u32, best: &[[f32; MOST]; 2]) -> u32 {
    let mut out = 0;
    for i in (0..MOST).filter(|i| ties >> i & 1 != 0) {
        let leaf = best[0][i].to_bits();
        // the same one from another leaf is most of what comes here
        let goes = leaf == 0 || {
            let there = read_index(forest.arena(), leaf, best[1][i] as usize);
            here != there && forest.precedes(here, there)
        };
        out |= u32::from(goes) << i;
    }
    out
}
