//! The vector kernel for few primitives: packets of rays through the boxes of all leaves, and what lies in those that any ray of them enters.
//! No stack, no branch by ray.
#![allow(unsafe_code)] // intrinsics, and packets of numbers of rays that the caller has

use super::super::few::Few;
use super::super::forest::Forest;
use super::packet::{Crossing, MOST, Members, Packet, deal};
use super::width::{Eight, Sixteen, Width};
use super::{Counters, Kernel, runs};
use crate::ray::{Hit, Ray};

/// What a packet's rays hit.
#[repr(C, align(64))]
struct Answers {
    t: [f32; MOST],
    uv: [[f32; MOST]; 2],
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
    let mut answers = Answers { t: [0.0; MOST], uv: [[0.0; MOST]; 2], rank: [0.0; MOST], entered: 0 };
    deal(kernel, forest, rays, |of| {
        match kernel {
            // SAFETY: the processor has the features, and all numbers are of rays.
            Kernel::Avx512 => unsafe { avx512::<ANY>(of, few, &mut answers) },
            // SAFETY: as above.
            Kernel::Avx2 => unsafe { avx2::<ANY>(of, few, &mut answers) },
            Kernel::Auto | Kernel::Scalar => unreachable!("no vector kernel"),
        }
        for (i, &number) in of.numbers[..of.count].iter().enumerate() {
            let ray = number as usize;
            let rank = answers.rank[i];
            if rank == f32::INFINITY {
                done(ray, Hit::miss(rays[ray].tmax));
                continue;
            }
            let (place, [u, v]) = (few.places[rank as usize], [answers.uv[0][i], answers.uv[1][i]]);
            done(ray, Hit { t: answers.t[i], u, v, prim: place.slot, leaf: place.leaf, lane: place.lane });
        }
    });
    // a list of boxes is what a node is
    counters.nodes += rays.len() as u64;
    counters.leaves += answers.entered;
}

/// [`through`] with AVX-512.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn avx512<const ANY: bool>(of: &Members, few: &Few, answers: &mut Answers) {
    // SAFETY: the features are enabled.
    unsafe { through::<Sixteen, ANY>(of, few, answers) }
}

/// [`through`] with AVX2.
///
/// # Safety
/// The processor has what is enabled here; the numbers are of rays.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn avx2<const ANY: bool>(of: &Members, few: &Few, answers: &mut Answers) {
    // SAFETY: the features are enabled.
    unsafe { through::<Eight, ANY>(of, few, answers) }
}

/// Takes a packet through everything.
///
/// # Safety
/// Features of `W` are enabled; the first [`Width::LANES`] numbers are of rays.
#[inline(always)]
unsafe fn through<W: Width, const ANY: bool>(of: &Members, few: &Few, answers: &mut Answers) {
    // SAFETY: the features are enabled, numbers and answers have a place for each lane, and a group ends among the triangles.
    unsafe {
        let columns = W::columns(of.rays.as_ptr(), of.numbers.as_ptr());
        let mut p = Packet::<W>::start(columns, of.forest.largest(), of.axis);
        let mut best = W::all(f32::INFINITY);
        let live = (1u32 << of.count) - 1;
        let triangles = few.along[of.axis].as_ptr();
        let mut first = 0;
        for group in &few.groups {
            let (entered, _) = p.enters(&group.bounds);
            let bits = W::bits(entered);
            if bits != 0 {
                answers.entered += u64::from((bits & live).count_ones());
                for i in first..group.end {
                    let triangle = &*triangles.add(i);
                    if let Some(at) = p.triangle(entered, &triangle.vertices) {
                        accept::<W, ANY>(&mut p, &mut best, &at, triangle.rank);
                    }
                }
            }
            first = group.end;
        }
        for ball in &few.balls {
            let (entered, _) = p.enters(&ball.bounds);
            let bits = W::bits(entered);
            if bits != 0 {
                answers.entered += u64::from((bits & live).count_ones());
                if let Some(at) = p.sphere(entered, &ball.sphere) {
                    accept::<W, ANY>(&mut p, &mut best, &at, ball.rank);
                }
            }
        }
        W::store(answers.t.as_mut_ptr(), p.tmax);
        W::store(answers.uv[0].as_mut_ptr(), p.uv[0]);
        W::store(answers.uv[1].as_mut_ptr(), p.uv[1]);
        W::store(answers.rank.as_mut_ptr(), best);
    }
}

/// Takes hits with `tmin < t <= tmax` where they are nearer than the best so far or, at the same distance, of a lesser rank. With
/// `ANY` the rays that have one are done.
///
/// # Safety
/// Features of `W` are enabled.
#[inline(always)]
unsafe fn accept<W: Width, const ANY: bool>(p: &mut Packet<W>, best: &mut W::F, at: &Crossing<W>, rank: f32) {
    // SAFETY: the features are enabled.
    unsafe {
        let rank = W::all(rank);
        let is_less = W::or(W::lt(at.t, p.tmax), W::and(W::eq(at.t, p.tmax), W::lt(rank, *best)));
        let hits = W::and(W::and(W::lt(p.tmin, at.t), is_less), at.mask);
        *best = W::select(hits, rank, *best);
        if ANY {
            p.tmax = W::select(hits, W::all(-1.0), p.tmax);
        } else {
            p.accept(hits, at);
        }
    }
}
