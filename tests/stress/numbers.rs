//! What the tests of the kernels share.

use rayherd_render::bvh::{Forest, Kernel, Serial, Tracer, build_block};
use rayherd_render::ray::{Hit, PrimId, Ray};
use rayherd_tests::mutation::Random;

/// Vertices.
pub type Triangle = [[f32; 3]; 3];

/// Rays of one test: `least`, or as the environment says.
pub fn rays(least: u64) -> u64 {
    match std::env::var("RAYHERD_STRESS_RAYS") {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("RAYHERD_STRESS_RAYS is {text:?}: give a number of rays")),
        Err(_) => least,
    }
}

/// How many of a batch the plain kernel takes, in a test of `total` rays: all, or beyond a million one of 64. It is slow, and gives the same bits as the
/// others elsewhere.
pub fn plain_share(total: u64, batch: usize) -> usize {
    if total > 1_000_000 { batch.div_ceil(64) } else { batch }
}

/// In [0, 1), a multiple of 2^-24.
pub fn unit(random: &mut Random) -> f32 {
    (random.bits() >> 40) as f32 / (1 << 24) as f32
}

/// In [-1, 1).
pub fn signed(random: &mut Random) -> f32 {
    unit(random) * 2.0 - 1.0
}

/// In the cube of half side 1.
pub fn point(random: &mut Random) -> [f32; 3] {
    std::array::from_fn(|_| signed(random))
}

/// The kernels that this processor runs.
pub fn kernels() -> Vec<Tracer> {
    [Kernel::Scalar, Kernel::Avx2, Kernel::Avx512].into_iter().filter_map(|k| Tracer::new(k).ok()).collect()
}

/// A forest of blocks; each is a list of (id, triangle) by ascending id.
pub fn forest<'a>(blocks: impl IntoIterator<Item = &'a [(PrimId, Triangle)]>) -> Forest {
    let mut forest = Forest::new(1 << 30).expect("a GiB of addresses");
    for block in blocks {
        let (ids, triangles): (Vec<PrimId>, Vec<Triangle>) = block.iter().copied().unzip();
        let object = build_block(&triangles, &ids, &[], &[], &Serial).expect("sound triangles");
        forest.insert(&object).expect("room");
    }
    forest.finish().expect("room for the top tree");
    forest
}

/// Numbers of a mesh: its triangles with ids from 0.
pub fn numbered(triangles: &[Triangle]) -> Vec<(PrimId, Triangle)> {
    (0..).zip(triangles.iter().copied()).collect()
}

/// Nearest hits.
pub fn closest(tracer: &mut Tracer, forest: &Forest, rays: &[Ray]) -> Vec<Hit> {
    let mut hits = vec![Hit::miss(0.0); rays.len()];
    tracer.closest(forest, rays, &mut hits);
    hits
}

/// Nearest hits by packets of rays, whether they stay together or not.
pub fn together(kernel: Kernel, forest: &Forest, rays: &[Ray]) -> Vec<Hit> {
    let mut hits = vec![Hit::miss(0.0); rays.len()];
    // a new tracer tries it first
    Tracer::new(kernel).expect("a kernel that runs").closest_coherent(forest, rays, &mut hits);
    hits
}

/// Whether there is any hit.
pub fn any(tracer: &mut Tracer, forest: &Forest, rays: &[Ray]) -> Vec<bool> {
    let mut occluded = vec![false; rays.len()];
    tracer.any(forest, rays, &mut occluded);
    occluded
}

/// What a hit says, whatever forest it is of: t, u, v to the bit, and the global id.
pub fn answer(forest: &Forest, hit: &Hit) -> ([u32; 3], Option<PrimId>) {
    ([hit.t, hit.u, hit.v].map(f32::to_bits), hit.is_hit().then(|| forest.prim_id(hit.prim)))
}

/// A ray without limits.
pub fn ray(o: [f32; 3], d: [f32; 3]) -> Ray {
    Ray { o, tmin: 0.0, d, tmax: f32::INFINITY }
}
