//! The plain kernel: one ray, one box, one primitive at a time. The vector kernels give its answers to the bit.

use super::super::block::read_sphere;
use super::super::forest::Forest;
use super::super::layout::*;
use super::setup::State;
use super::triangle::{Intersection, intersect};
use super::{Counters, accept, sphere};
use crate::ray::{MISS, Ray};
use crate::real::{f32, real};

/// Entry distance and reference of what is still to be visited.
pub(super) type Stack = Vec<(f32, u32)>;

/// Traces one ray through the forest's triangles; the first hit found ends it if `any`.
pub(super) fn triangles(forest: &Forest, state: &mut State, any: bool, stack: &mut Stack, counters: &mut Counters) {
    let arena = forest.arena();
    traverse(arena, forest.root(), state, stack, counters, enter_children, |state, leaf| {
        let (at, n) = (offset(leaf), leaf_len(leaf));
        for i in 0..n {
            if let Some(Intersection { t, uv }) = intersect(state, &read_triangle(arena, at, n, i)) {
                accept(forest, state, t, uv, read_index(arena, leaf, i), leaf, i as u32);
            }
        }
        any && state.prim != MISS
    });
}

/// Traces one ray through the forest's spheres; `state` has the best hit so far.
pub(super) fn spheres(
    forest: &Forest,
    root: u32,
    ray: &Ray,
    state: &mut State,
    any: bool,
    stack: &mut Stack,
    counters: &mut Counters,
) {
    let arena = forest.arena();
    traverse(arena, root, state, stack, counters, enter_children, |state, leaf| {
        let (at, n) = (offset(leaf), leaf_len(leaf));
        for i in 0..n {
            let s = read_sphere(arena, at, n, i);
            if let Some(t) = sphere::intersect(ray, state.tmin, state.tmax, s.center.map(real), real(s.radius)) {
                accept(forest, state, t, [0.0; 2], read_index(arena, leaf, i), leaf, i as u32);
            }
        }
        any && state.prim != MISS
    });
}

/// Visits the leaves whose boxes the ray enters, about nearest first, until `leaf` says that it is enough.
#[inline(always)]
pub(super) fn traverse(
    arena: &[u8],
    root: u32,
    state: &mut State,
    stack: &mut Stack,
    counters: &mut Counters,
    enter: impl Fn(&State, &[u8], usize, &mut Stack),
    mut leaf: impl FnMut(&mut State, u32) -> bool,
) {
    stack.clear();
    stack.push((state.tmin, root));
    while let Some((distance, reference)) = stack.pop() {
        // behind the best hit; at the same distance there may be a smaller id
        if distance > state.tmax {
            continue;
        }
        if reference & LEAF != 0 {
            counters.leaves += 1;
            if leaf(state, reference) {
                return;
            }
            continue;
        }
        counters.nodes += 1;
        let first = stack.len();
        enter(state, arena, offset(reference), stack);
        if stack.len() > first + 1 {
            stack[first..].sort_by(|a, b| b.0.total_cmp(&a.0));
        }
    }
}

/// Pushes those of a node's children that the ray enters, slot by slot.
fn enter_children(state: &State, arena: &[u8], node: usize, stack: &mut Stack) {
    for slot in 0..WIDTH {
        let (aabb, child) = read_slot(arena, node, slot);
        if let Some(entry) = enter(state, &aabb) {
            stack.push((entry, child));
        }
    }
}

/// Where the ray enters a box, if it does before `tmax`. Conservative: see [`super::setup`].
fn enter(state: &State, aabb: &Aabb) -> Option<f32> {
    let (inverse, near, far) = (state.inverse.to_array(), state.near.to_array(), state.far.to_array());
    let (mut first, mut last) = (state.tmin, state.tmax);
    for axis in 0..3 {
        let is_negative = state.near_row[axis] & 32 != 0;
        let (entry, exit) = if is_negative { (aabb.hi[axis], aabb.lo[axis]) } else { (aabb.lo[axis], aabb.hi[axis]) };
        let (entry, exit) = (real(entry), real(exit));
        first = first.max(entry.mul_add(inverse[axis], -near[axis]));
        last = last.min(exit.mul_add(inverse[axis], -far[axis]));
    }
    (first <= last).then_some(first)
}

/// Vertices of the i-th triangle of a leaf of n.
#[inline(always)]
pub(in super::super) fn read_triangle(arena: &[u8], leaf: usize, n: usize, i: usize) -> [[f32; 3]; 3] {
    // written out: closures over arrays become calls
    let at = |row: usize| real(read_f32(arena, leaf + (row * n + i) * 4));
    [[at(0), at(1), at(2)], [at(3), at(4), at(5)], [at(6), at(7), at(8)]]
}
