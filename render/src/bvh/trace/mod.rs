//! Tracing batches of rays through a forest: nearest hit, or whether there is any.
//!
//! All ways give the same bits. [`scalar`] is the plain one. With vectors, [`lists`] takes a forest of few primitives, [`coherent`] a camera's rays
//! (both in packets, a ray in each lane: [`packet`]), [`wide`] all others: many rays in flight, eight boxes or triangles of one ray at a time.

#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod coherent;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod lists;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod packet;
mod scalar;
mod setup;
mod sphere;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod spheres;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod start;
mod triangle;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod vector;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod wide;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod width;

pub(super) use scalar::read_triangle;
use setup::State;

use super::forest::Forest;
use super::order::Sorter;
use crate::ray::{Hit, MISS, Ray};
use crate::real::{f32, real};

/// Which code traces. All give the same bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// The fastest that this processor can run.
    #[default]
    Auto,
    /// Plain Rust, one ray at a time.
    Scalar,
    /// AVX2 and FMA.
    Avx2,
    /// AVX-512 F, VL, DQ, BW: packets of rays on vectors of 512 bits, single rays on vectors of 256.
    Avx512,
}

/// This processor cannot run the kernel that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this processor cannot run the {0:?} kernel: ask for Auto or Scalar")]
pub struct UnsupportedKernel(pub Kernel);

/// What tracing did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Rays traced.
    pub rays: u64,
    /// Nodes visited.
    pub nodes: u64,
    /// Leaves visited.
    pub leaves: u64,
}

/// Traces rays on one thread; keeps its buffers from batch to batch.
pub struct Tracer {
    kernel: Kernel,
    counters: Counters,
    stack: scalar::Stack,
    sorter: Option<Sorter>,
    #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
    lanes: wide::Lanes,
    #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
    together: Together,
}

/// Packets through the tree.
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
#[derive(Default)]
struct Together {
    stack: Vec<coherent::Entry>,
    /// Batches for which rays are not taken together, as those before them soon parted.
    apart: u32,
}

/// Rays of a packet that enter a node, on average, below which the plain way is faster: a node is tested for a packet in the time of some two
/// visits by single rays, whose ways overlap.
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
const TOGETHER: f64 = 4.0;
/// Rays of a batch from which on it tells whether rays stay together.
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
const TOLD: usize = 8 * packet::MOST;
/// Batches after which rays that parted are tried together again.
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
const APART: u32 = 31;

impl Tracer {
    /// A tracer that runs the kernel.
    ///
    /// # Errors
    /// When this processor cannot.
    pub fn new(kernel: Kernel) -> Result<Tracer, UnsupportedKernel> {
        let kernel = match kernel {
            Kernel::Auto => [Kernel::Avx512, Kernel::Avx2].into_iter().find(|&k| runs(k)).unwrap_or(Kernel::Scalar),
            k if runs(k) => k,
            k => return Err(UnsupportedKernel(k)),
        };
        Ok(Tracer {
            kernel,
            counters: Counters::default(),
            stack: Vec::new(),
            sorter: None,
            #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
            lanes: wide::Lanes::default(),
            #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
            together: Together::default(),
        })
    }

    /// The kernel that runs; never [`Kernel::Auto`].
    pub fn kernel(&self) -> Kernel {
        self.kernel
    }
    /// Whether batches are traced in the order of the rays' origins; at first they aren't. Changes no answer. Worth it for
    /// scrambled batches in large forests only: see `bvh/order.rs`.
    pub fn set_sorting(&mut self, is_on: bool) {
        self.sorter = is_on.then(Sorter::default);
    }
    /// Sums since the tracer was made.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Writes the nearest hit of each ray: the least (t, global id) with `tmin < t <= tmax`, or a miss.
    ///
    /// A ray with a member that is NaN, an infinite origin or direction, an origin beyond
    /// [`super::MAX_COORDINATE`] or a direction whose largest component is not in 2^-30 ..= 2^30 hits nothing.
    ///
    /// # Panics
    /// When there are not as many hits as rays, or the forest was changed and not finished.
    pub fn closest(&mut self, forest: &Forest, rays: &[Ray], hits: &mut [Hit]) {
        assert_eq!(rays.len(), hits.len(), "one hit for each ray");
        self.run::<false>(forest, rays, &mut |i, hit| hits[i] = hit);
    }

    /// [`Tracer::closest`], the same answers: faster for rays most of which go nearly the way of the one before, as those of a camera do.
    ///
    /// # Panics
    /// As [`Tracer::closest`].
    pub fn closest_coherent(&mut self, forest: &Forest, rays: &[Ray], hits: &mut [Hit]) {
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        {
            assert_eq!(rays.len(), hits.len(), "one hit for each ray");
            assert!(forest.is_finished(), "a forest is traced after finish()");
            let is_for_tree = forest.few().is_none() && forest.sphere_root().is_none();
            if is_for_tree && packet::lanes(self.kernel).is_some() && self.together.apart == 0 {
                let Together { stack, apart } = &mut self.together;
                self.counters.rays += rays.len() as u64;
                for (rays, hits) in rays.chunks(MAX_BATCH).zip(hits.chunks_mut(MAX_BATCH)) {
                    let done = &mut |i: usize, hit| hits[i] = hit;
                    let entered = coherent::trace(self.kernel, forest, rays, done, stack, &mut self.counters);
                    // packets that are not full tell little
                    *apart = if rays.len() >= TOLD && entered < TOGETHER { APART } else { 0 };
                }
                return;
            }
            self.together.apart = self.together.apart.saturating_sub(1);
        }
        self.closest(forest, rays, hits);
    }

    /// Writes for each ray whether anything lies at `tmin < t <= tmax`. Which rays hit nothing: see [`Tracer::closest`].
    ///
    /// # Panics
    /// As [`Tracer::closest`].
    pub fn any(&mut self, forest: &Forest, rays: &[Ray], occluded: &mut [bool]) {
        assert_eq!(rays.len(), occluded.len(), "one answer for each ray");
        self.run::<true>(forest, rays, &mut |i, hit: Hit| occluded[i] = hit.is_hit());
    }

    /// Traces and tells `done` each ray's number and hit; with `ANY`, only whether there is one.
    fn run<const ANY: bool>(&mut self, forest: &Forest, rays: &[Ray], done: &mut impl FnMut(usize, Hit)) {
        assert!(forest.is_finished(), "a forest is traced after finish()");
        self.counters.rays += rays.len() as u64;
        // numbers of rays in flight are of 32 bits
        for (i, part) in rays.chunks(MAX_BATCH).enumerate() {
            self.run_part::<ANY>(forest, part, &mut |k, hit| done(i * MAX_BATCH + k, hit));
        }
    }

    fn run_part<const ANY: bool>(&mut self, forest: &Forest, rays: &[Ray], done: &mut impl FnMut(usize, Hit)) {
        let Tracer { kernel, counters, stack, sorter, .. } = self;
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        if let Some(few) = forest.few().filter(|few| packet::lanes(*kernel).is_some_and(|lanes| few.suits(lanes))) {
            lists::trace::<ANY>(*kernel, forest, few, rays, done, counters);
            return;
        }
        // triangles first, then the spheres that are nearer
        let sphere_root = forest.sphere_root();
        let order = match (sorter, forest.bounds()) {
            (Some(sorter), Some(bounds)) => sorter.order(bounds, rays),
            _ => &[],
        };
        match kernel {
            #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
            Kernel::Avx2 | Kernel::Avx512 => {
                let (kernel, mut of_spheres) = (*kernel, Counters::default());
                let mut finish = |i: usize, state: &mut State, meets: bool| {
                    if let Some(root) = sphere_root.filter(|_| meets) {
                        spheres::trace::<ANY>(kernel, forest, root, &rays[i], state, stack, &mut of_spheres);
                    }
                    done(i, state.hit(&rays[i]));
                };
                wide::trace::<ANY>(kernel, &mut self.lanes, forest, rays, order, &mut finish, counters);
                counters.nodes += of_spheres.nodes;
                counters.leaves += of_spheres.leaves;
            }
            _ => {
                for k in 0..rays.len() {
                    let i = order.get(k).map_or(k, |&i| i as usize);
                    let mut state = State::new(&rays[i], real(forest.largest()));
                    scalar::triangles(forest, &mut state, ANY, stack, counters);
                    if let Some(root) = sphere_root.filter(|_| !(ANY && state.prim != MISS)) {
                        scalar::spheres(forest, root, &rays[i], &mut state, ANY, stack, counters);
                    }
                    done(i, state.hit(&rays[i]));
                }
            }
        }
    }
}

/// Rays that are traced as one batch.
const MAX_BATCH: usize = 1 << 24;

/// Whether this processor can run a kernel.
fn runs(kernel: Kernel) -> bool {
    match kernel {
        Kernel::Auto | Kernel::Scalar => true,
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        Kernel::Avx2 => {
            is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2")
                && is_x86_feature_detected!("lzcnt")
                && is_x86_feature_detected!("popcnt")
        }
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        Kernel::Avx512 => {
            runs(Kernel::Avx2)
                && is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw")
        }
        #[cfg(any(not(target_arch = "x86_64"), feature = "double"))]
        Kernel::Avx2 | Kernel::Avx512 => false,
    }
}

/// Takes a hit with `tmin < t <= tmax` if it is nearer than the best so far or, at the same distance, has the smaller id.
#[inline(always)]
fn accept(forest: &Forest, state: &mut State, t: f32, uv: [f32; 2], slot: u32, leaf: u32, lane: u32) {
    if t < state.tmax || (t == state.tmax && (state.prim == MISS || forest.precedes(slot, state.prim))) {
        (state.tmax, state.uv, state.prim, state.leaf, state.lane) = (t, uv, slot, leaf, lane);
    }
}

/// The oracle of tests: every primitive, no tree. Bits of t, u, v and the global id, which is the place in the two lists.
#[cfg(test)]
pub(super) fn brute_force(
    triangles: &[[[f32; 3]; 3]],
    spheres: &[super::Sphere],
    ray: &Ray,
    largest: f32,
) -> ([u32; 3], Option<crate::ray::PrimId>) {
    let state = State::new(ray, largest);
    let mut best = (Hit::miss(ray.tmax), None);
    let of_triangles = triangles.iter().map(|t| triangle::intersect(&state, t).map(|i| (i.t, i.uv)));
    let of_spheres = spheres
        .iter()
        .map(|s| sphere::intersect(ray, state.tmin, state.tmax, s.center, s.radius).map(|t| (t, [0.0; 2])));
    for (id, hit) in of_triangles.chain(of_spheres).enumerate() {
        if let Some((t, [u, v])) = hit
            && (best.1.is_none() || t < best.0.t)
        {
            best = (Hit { t, u, v, ..best.0 }, Some(id as u64));
        }
    }
    ([best.0.t.to_bits(), best.0.u.to_bits(), best.0.v.to_bits()], best.1)
}
