//! Helpers of this module's tests: random numbers, soups, brute force.

use super::layout::Aabb;
use super::trace::Tracer;
use super::{Forest, Kernel, Serial, Sphere, build_block};
use crate::ray::{Hit, PrimId, Ray};
use crate::testing::Rng;

/// xorshift64*.
pub(super) struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Random {
        Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }
    pub fn bits(&mut self) -> u32 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) as u32
    }
    pub fn below(&mut self, n: usize) -> usize {
        ((u64::from(self.bits()) * n as u64) >> 32) as usize
    }
    /// In [0, 1).
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 8) as f32 / (1 << 24) as f32
    }
    /// In [-1, 1).
    pub fn signed(&mut self) -> f32 {
        self.unit() * 2.0 - 1.0
    }
    pub fn point(&mut self, size: f32) -> [f32; 3] {
        std::array::from_fn(|_| self.signed() * size)
    }
}

/// Boxes around points within 10 units along each axis, at most so large to each side.
pub(super) fn random_boxes(rng: &mut Rng, n: usize, size: f32) -> Vec<Aabb> {
    let mut one = |_| {
        let (p, size) = (rng.vec3(10.0), rng.vec3(size).abs());
        Aabb { lo: (p - size).to_array(), hi: (p + size).to_array() }
    };
    (0..n).map(&mut one).collect()
}

pub(super) type Triangle = [[f32; 3]; 3];

/// A block of triangles with ids from 0.
pub(super) fn block(triangles: &[Triangle], spheres: &[Sphere]) -> Vec<u8> {
    let ids: Vec<PrimId> = (0..(triangles.len() + spheres.len()) as u64).collect();
    let (t, s) = ids.split_at(triangles.len());
    build_block(triangles, t, spheres, s, &Serial).unwrap()
}

/// A finished forest of these objects.
pub(super) fn forest(objects: &[Vec<u8>]) -> Forest {
    let mut forest = Forest::new(1 << 30).unwrap();
    for object in objects {
        forest.insert(object).unwrap();
    }
    forest.finish().unwrap();
    forest
}

/// The kernels that this processor runs.
pub(super) fn kernels() -> Vec<Tracer> {
    let all = [Kernel::Scalar, Kernel::Avx2, Kernel::Avx512];
    let found: Vec<Tracer> = all.into_iter().filter_map(|k| Tracer::new(k).ok()).collect();
    if found.len() < all.len() {
        println!("this processor has only {:?}", found.iter().map(Tracer::kernel).collect::<Vec<_>>());
    }
    found
}

/// A hit without what depends on where its block lies: t, u, v as bits, and the global id.
pub(super) fn identity(forest: &Forest, hit: &Hit) -> ([u32; 3], Option<PrimId>) {
    let id = hit.is_hit().then(|| forest.prim_id(hit.prim));
    ([hit.t.to_bits(), hit.u.to_bits(), hit.v.to_bits()], id)
}

/// Nearest hits by a kernel.
pub(super) fn closest(tracer: &mut Tracer, forest: &Forest, rays: &[Ray]) -> Vec<Hit> {
    let mut hits = vec![Hit::miss(0.0); rays.len()];
    tracer.closest(forest, rays, &mut hits);
    hits
}

/// Nearest hits by a kernel's packets, whether the rays stay together or not.
pub(super) fn together(kernel: Kernel, forest: &Forest, rays: &[Ray]) -> Vec<Hit> {
    let mut hits = vec![Hit::miss(0.0); rays.len()];
    // a new tracer tries it first
    Tracer::new(kernel).unwrap().closest_coherent(forest, rays, &mut hits);
    hits
}

/// Whether there is any hit, by a kernel.
pub(super) fn any(tracer: &mut Tracer, forest: &Forest, rays: &[Ray]) -> Vec<bool> {
    let mut occluded = vec![false; rays.len()];
    tracer.any(forest, rays, &mut occluded);
    occluded
}
