//! Rays per second of the ray kernels, by ray set.
//!
//! `kernel rays DIR` makes the ray sets of the scene `DIR/scene.tri` (nine little-endian f32 a triangle, framed like the
//! gyroid of shared/peers): `primary.rays`, `bounce1.rays`, `bounce2.rays`, `shadow.rays`, 32 bytes a ray.
//! `kernel DIR [REPETITIONS] [BLOCKS] [auto]` builds the scene as that many blocks in source order and traces them with every
//! kernel this processor has, interleaved, or with the fastest alone. Figures are medians and bests of thread CPU time.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use rayherd_benches::{median, process_cpu, thread_cpu};
use rayherd_render::bvh::{Forest, Fork, Kernel, Tracer, build_block};
use rayherd_render::ray::{Hit, PrimId, Ray};
use rayherd_render::world::Primitive;

const SETS: [&str; 4] = ["primary", "bounce1", "bounce2", "shadow"];
/// The primary rays once more, as the trace loop traces those of a camera: in its batches, and in packets.
const CAMERA: &str = "camera";
const BATCH: usize = 2048;
const KERNELS: [Kernel; 3] = [Kernel::Avx512, Kernel::Avx2, Kernel::Scalar];

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["rays", dir] => make_rays(Path::new(dir)),
        [dir] => measure(Path::new(dir), 5, 1, &KERNELS),
        [dir, repetitions] => measure(Path::new(dir), repetitions.parse()?, 1, &KERNELS),
        [dir, repetitions, blocks] => measure(Path::new(dir), repetitions.parse()?, blocks.parse()?, &KERNELS),
        [dir, repetitions, blocks, "auto"] => {
            measure(Path::new(dir), repetitions.parse()?, blocks.parse()?, &[Kernel::Auto])
        }
        _ => bail!("usage: kernel rays DIR | kernel DIR [REPETITIONS] [BLOCKS] [auto]"),
    }
}

struct Rayon;

impl Fork for Rayon {
    fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
        rayon::join(a, b);
    }
}

fn read<T: bytemuck::AnyBitPattern>(path: &Path) -> anyhow::Result<Vec<T>> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(bytes.len().is_multiple_of(size_of::<T>()), "{} is cut", path.display());
    Ok(bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect())
}

/// The scene as blocks of source order in a forest.
fn load(dir: &Path, blocks: usize) -> anyhow::Result<Forest> {
    let triangles: Vec<[[f32; 3]; 3]> = read(&dir.join("scene.tri"))?;
    let ids: Vec<PrimId> = (0..triangles.len() as u64).collect();
    let part = triangles.len().div_ceil(blocks.max(1)).max(1);
    let mut forest = Forest::new(triangles.len() as u64 * 80 + (64 << 20))?;
    let (wall, cpu) = (std::time::Instant::now(), process_cpu());
    let mut objects = Vec::new();
    for (t, i) in triangles.chunks(part).zip(ids.chunks(part)) {
        objects.push(build_block(t, i, &[], &[], &Rayon)?);
    }
    let (built, built_cpu) = (wall.elapsed().as_secs_f64(), process_cpu() - cpu);
    let cpu = thread_cpu();
    for object in &objects {
        forest.insert(object)?;
    }
    let inserted = thread_cpu() - cpu;
    forest.finish()?;
    let finished = thread_cpu() - cpu - inserted;
    println!(
        "{} triangles, {} blocks: build wall {built:.2} s, cpu {built_cpu:.2} s; check and insert {inserted:.3} s, top {finished:.3} s; {:.1} bytes a triangle",
        triangles.len(),
        objects.len(),
        forest.bytes_used() as f64 / triangles.len() as f64,
    );
    Ok(forest)
}

fn measure(dir: &Path, repetitions: usize, blocks: usize, kernels: &[Kernel]) -> anyhow::Result<()> {
    let forest = load(dir, blocks)?;
    let mut tracers: Vec<Tracer> = kernels.iter().filter_map(|&k| Tracer::new(k).ok()).collect();
    for set in SETS.into_iter().chain([CAMERA]) {
        let file = if set == CAMERA { SETS[0] } else { set };
        let rays: Vec<Ray> = read(&dir.join(format!("{file}.rays")))?;
        let is_shadow = set == "shadow";
        let mut times = vec![Vec::new(); tracers.len()];
        let mut hits = vec![Hit::miss(0.0); rays.len()];
        let mut occluded = vec![false; rays.len()];
        let mut visits = Vec::new();
        for round in 0..repetitions.max(1) {
            for (tracer, times) in tracers.iter_mut().zip(&mut times) {
                if tracer.kernel() == Kernel::Scalar && round > 0 {
                    continue;
                }
                let (before, cpu) = (tracer.counters(), thread_cpu());
                if is_shadow {
                    tracer.any(&forest, &rays, &mut occluded);
                } else if set == CAMERA {
                    for (rays, hits) in rays.chunks(BATCH).zip(hits.chunks_mut(BATCH)) {
                        tracer.closest_coherent(&forest, rays, hits);
                    }
                } else {
                    tracer.closest(&forest, &rays, &mut hits);
                }
                times.push(thread_cpu() - cpu);
                if round == 0 {
                    let after = tracer.counters();
                    visits.push((after.nodes - before.nodes, after.leaves - before.leaves));
                }
            }
        }
        let n = rays.len() as f64;
        for ((tracer, times), (nodes, leaves)) in tracers.iter().zip(times).zip(visits) {
            let best = times.iter().copied().fold(f64::INFINITY, f64::min);
            println!(
                "{set:<8} {:<7} median {:6.2} best {:6.2} Mrays/s, {:.2} nodes and {:.2} leaves a ray",
                format!("{:?}", tracer.kernel()),
                n / median(times) * 1e-6,
                n / best * 1e-6,
                nodes as f64 / n,
                leaves as f64 / n,
            );
        }
    }
    Ok(())
}

/// A ray set from a camera, two sets of diffuse bounces in the order of the hits before them, and rays to two lights.
fn make_rays(dir: &Path) -> anyhow::Result<()> {
    const SIDE: usize = 1024;
    let forest = load(dir, 1)?;
    let mut tracer = Tracer::new(Kernel::Auto)?;
    let mut state = 7u64;
    let mut unit = || {
        // xorshift64*
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 40) as f32 / (1 << 24) as f32
    };
    let origin = [0.3, 0.4, 2.9];
    let forward = unit_vector(origin.map(|x: f32| -x));
    let right = unit_vector(cross(forward, [0.0, 1.0, 0.0]));
    let up = cross(right, forward);
    let half = 22.5f32.to_radians().tan();
    let mut primary = Vec::with_capacity(SIDE * SIDE);
    for y in 0..SIDE {
        for x in 0..SIDE {
            let a = half * (2.0 * (x as f32 + 0.5) / SIDE as f32 - 1.0);
            let b = half * (1.0 - 2.0 * (y as f32 + 0.5) / SIDE as f32);
            let d = unit_vector(std::array::from_fn(|k| forward[k] + right[k] * a + up[k] * b));
            primary.push(Ray { o: origin, tmin: 0.0, d, tmax: f32::INFINITY });
        }
    }
    let mut bounce = |rays: &[Ray], mut shadow: Option<&mut Vec<Ray>>| -> Vec<Ray> {
        let mut hits = vec![Hit::miss(0.0); rays.len()];
        tracer.closest(&forest, rays, &mut hits);
        let mut out = Vec::new();
        for (ray, hit) in rays.iter().zip(&hits).filter(|(_, h)| h.is_hit()) {
            let Primitive::Triangle([a, b, c]) = forest.primitive(hit) else { continue };
            let mut n = unit_vector(cross(minus(b, a), minus(c, a)));
            if dot(n, ray.d) > 0.0 {
                n = n.map(|x| -x);
            }
            let p: [f32; 3] = std::array::from_fn(|k| ray.o[k] + ray.d[k] * hit.t + n[k] * 1e-4);
            let (angle, s) = (unit() * std::f32::consts::TAU, unit());
            let t = unit_vector(cross(n, if n[0].abs() > 0.9 { [0.0, 1.0, 0.0] } else { [1.0, 0.0, 0.0] }));
            let u = cross(n, t);
            let (x, y, z) = (s.sqrt() * angle.cos(), s.sqrt() * angle.sin(), (1.0 - s).sqrt());
            let d = unit_vector(std::array::from_fn(|k| t[k] * x + u[k] * y + n[k] * z));
            out.push(Ray { o: p, tmin: 0.0, d, tmax: f32::INFINITY });
            if let Some(shadow) = shadow.as_deref_mut() {
                let light = if unit() < 0.5 {
                    [-0.5 + unit(), 1.45, -0.5 + unit()]
                } else {
                    [-1.45, -0.3 + 0.6 * unit(), 1.2 - 0.6 * unit()]
                };
                let to = minus(light, p);
                let length = dot(to, to).sqrt();
                shadow.push(Ray { o: p, tmin: 0.0, d: to.map(|x| x / length), tmax: length * 0.999 });
            }
        }
        out
    };
    let mut shadow = Vec::new();
    let bounce1 = bounce(&primary, Some(&mut shadow));
    let bounce2 = bounce(&bounce1, None);
    for (name, rays) in SETS.into_iter().zip([primary, bounce1, bounce2, shadow]) {
        let path = dir.join(format!("{name}.rays"));
        std::fs::write(&path, bytemuck::cast_slice(&rays))
            .with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}: {} rays", path.display(), rays.len());
    }
    Ok(())
}

fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
fn unit_vector(a: [f32; 3]) -> [f32; 3] {
    let length = dot(a, a).sqrt();
    a.map(|x| x / length)
}
