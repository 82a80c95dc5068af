//! What f32 costs: the same paths with the same random numbers in f32 and in f64, by the same source (see docs/numerics.md).
//!
//! `precision SCENE.xml [--size 128x128] [--spp 64] [--depth 8] [--seed 0] [NAME=VALUE ...]` prepares the scene, which is stored in f32, and
//! traces each sample's path twice, one path at a time, with the plain kernel. A path has *parted* where it met something else
//! in f64 or a shadow ray had another answer: from there on both are paths of their own, as likely, and their difference is noise. What is
//! left in the other paths is rounding alone. Printed by scene: means and their ratio with its standard error (of the differences, path by path), relMSE
//! between the two pictures beside that of either's noise, how many paths parted, and how far the others differ.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, bail};
use rayherd_api::{ImageSize, RenderJobSpec};
use rayherd_herd::job::{self, PreparedScene};
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};
use rayon::prelude::*;

/// The film keeps nothing below. In f64 the tails of lobes go on where those in f32 are 0: shadow rays for less than this are none.
const LEAST: f64 = 1.0 / (1u128 << 64) as f64;

/// What a ray came upon.
#[derive(Clone, Copy, PartialEq)]
enum Met {
    /// A primitive, or nothing.
    Surface(Option<u64>),
    /// A light, unless something was in the way.
    Light(bool),
}

/// What became of a sample's path.
#[derive(Default)]
struct Traced {
    light: [f64; 3],
    /// Rays to the nearest hit.
    rays: u32,
    /// What was met, in order, and which shadow rays arrived.
    way: Vec<Met>,
}

impl Traced {
    fn add(&mut self, light: [f64; 3]) {
        (0..3).for_each(|c| self.light[c] += light[c]);
    }
}

/// What follows for one build of render: a scene in its numbers, and how it traces a path.
macro_rules! build {
    ($name:ident, $render:ident, $real:ty) => {
        #[allow(clippy::useless_conversion)] // what widens in one build does nothing in the other
        mod $name {
            use std::cell::{Ref, RefCell};

            use super::*;
            use $render::attributes::AttributeBlock;
            use $render::bvh::{BlockHandle, Forest, Kernel, Tracer};
            use $render::frame::Frame;
            use $render::light::{Lights, SkyMap};
            use $render::path::{Context, Outcome, PathRay, Surface, Surfaces, camera_ray, shade};
            use $render::ray::{Hit, PrimId};
            use $render::texture::Textures;
            use $render::world::World;

            pub struct Scene {
                world: World,
                lights: Lights,
                frame: Frame,
                forest: Forest,
                attributes: HashMap<BlockHandle, AttributeBlock>,
                tiles: Arc<Vec<Vec<u8>>>,
            }

            impl Scene {
                pub fn open(scene: &PreparedScene, frame: &serde_json::Value) -> anyhow::Result<Scene> {
                    let objects = scene.objects.as_ref();
                    // by way of values, in which a float is an f64: what was f32 is the same number
                    let world: World = serde_json::from_value(serde_json::to_value(&scene.world)?)?;
                    let frame: Frame = serde_json::from_value(frame.clone())?;
                    let map = scene.manifest.sky_map.as_ref();
                    let map = map.map(|object| anyhow::Ok(SkyMap::decode(&objects.get(object)?)?)).transpose()?;
                    let lights = Lights::with_sky_map(&world, map.map(Arc::new));
                    let splits = &scene.manifest.splits;
                    // and of each split's top tree, 64 KiB at most
                    let bytes = splits.iter().map(|s| s.geometry.bytes + (64 << 10)).sum();
                    let mut forest = Forest::new(bytes)?;
                    let mut attributes = HashMap::new();
                    for split in splits {
                        let block = forest.insert(&objects.get(&split.geometry)?)?;
                        let primitives = (split.triangles + split.spheres) as u32;
                        attributes.insert(block, AttributeBlock::decode(&objects.get(&split.attributes)?, primitives)?);
                    }
                    forest.finish()?;
                    let tiles = scene.manifest.tiles.iter().map(|tile| objects.get(tile)).collect::<Result<_, _>>()?;
                    Ok(Scene { world, lights, frame, forest, attributes, tiles: Arc::new(tiles) })
                }
            }

            struct Tiles(RefCell<Arc<Vec<Vec<u8>>>>);

            impl Textures for Tiles {
                fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>> {
                    Ref::filter_map(self.0.borrow(), |tiles| tiles.get(number as usize).map(Vec::as_slice)).ok()
                }
            }

            impl Surfaces for Scene {
                fn surface(&self, _: usize, hit: &Hit) -> Surface {
                    let (block, local) = self.forest.slot(hit.prim);
                    let (block, local) = (&self.attributes[&block], local as usize);
                    let normals = block.normals.get(local).filter(|n| n.as_flattened().iter().any(|&x| x != 0.0));
                    let wide = |x: f32| <$real>::from(x);
                    Surface {
                        geometry: self.forest.primitive(hit),
                        normals: normals.map(|n| n.map(|v| v.map(wide))),
                        uv: block.uvs.get(local).map(|t| t.map(|v| v.map(wide))),
                        attribute: block.attributes.get(local).map(|a| a.map(|v| v.map(wide))),
                    }
                }
                fn shape(&self, _: usize, hit: &Hit) -> u32 {
                    let (block, local) = self.forest.slot(hit.prim);
                    self.attributes[&block].shapes[local as usize]
                }
                fn prim(&self, _: usize, hit: &Hit) -> PrimId {
                    self.forest.prim_id(hit.prim)
                }
            }

            /// Traces paths on one thread.
            pub struct Walker<'a> {
                scene: &'a Scene,
                tiles: Tiles,
                tracer: Tracer,
                out: Outcome,
                stack: Vec<PathRay>,
            }

            impl<'a> Walker<'a> {
                pub fn new(scene: &'a Scene) -> anyhow::Result<Walker<'a>> {
                    let (tracer, tiles) = (Tracer::new(Kernel::Scalar)?, Tiles(RefCell::new(scene.tiles.clone())));
                    Ok(Walker { scene, tiles, tracer, out: Outcome::default(), stack: Vec::new() })
                }

                /// All that comes of one sample.
                pub fn trace(&mut self, pixel: u32, sample: u32) -> Traced {
                    let Walker { scene, tiles, tracer, out, stack } = self;
                    let context = Context::new(&scene.world, &scene.lights, &scene.frame).with(tiles);
                    let mut traced = Traced::default();
                    stack.push(camera_ray(&scene.frame, pixel, sample));
                    while let Some(ray) = stack.pop() {
                        let mut hits = [Hit::miss(0.0)];
                        tracer.closest(&scene.forest, &[ray.ray()], &mut hits);
                        let is_hit = hits[0].is_hit();
                        traced.rays += 1;
                        traced.way.push(Met::Surface(is_hit.then(|| scene.forest.prim_id(hits[0].prim))));
                        shade(&context, *scene, &[ray], &hits, out);
                        for light in &out.light {
                            traced.add(light.value.map(f64::from));
                        }
                        for shadow in &out.shadow {
                            if shadow.contribution.map(f64::from).iter().all(|&x| x < LEAST) {
                                continue;
                            }
                            let mut occluded = [false];
                            tracer.any(&scene.forest, &[shadow.ray()], &mut occluded);
                            traced.way.push(Met::Light(!occluded[0]));
                            if !occluded[0] {
                                traced.add(shadow.contribution.map(f64::from));
                            }
                        }
                        stack.extend_from_slice(&out.next);
                        out.clear();
                    }
                    traced
                }
            }
        }
    };
}

build!(single, rayherd_render, f32);
build!(double, rayherd_double, f64);

struct Arguments {
    scene: String,
    size: [u32; 2],
    spp: u32,
    depth: i32,
    seed: i64,
    defines: Vec<(String, String)>,
}

fn arguments() -> anyhow::Result<Arguments> {
    let mut args = std::env::args().skip(1);
    let mut read = Arguments { scene: String::new(), size: [128; 2], spp: 64, depth: 8, seed: 0, defines: Vec::new() };
    while let Some(arg) = args.next() {
        let mut value = || args.next().with_context(|| format!("{arg} needs a value"));
        match arg.as_str() {
            "--size" => {
                let value = value()?;
                let (w, h) = value.split_once('x').context("a size is WIDTHxHEIGHT")?;
                read.size = [w.parse()?, h.parse()?];
            }
            "--spp" => read.spp = value()?.parse()?,
            "--depth" => read.depth = value()?.parse()?,
            "--seed" => read.seed = value()?.parse()?,
            _ => match arg.split_once('=') {
                Some((name, value)) => read.defines.push((name.to_owned(), value.to_owned())),
                None if read.scene.is_empty() => read.scene = arg,
                None => bail!("one scene at a time: {} or {arg}", read.scene),
            },
        }
    }
    if read.scene.is_empty() || read.spp < 2 {
        bail!(
            "usage: precision SCENE [--size 128x128] [--spp 64] [--depth 8] [--seed 0] [NAME=VALUE ...]; 2 spp at least"
        );
    }
    Ok(read)
}

/// Sums over some pixels' paths.
#[derive(Clone, Copy, Default)]
struct Sums {
    paths: u64,
    /// Of f32 and of f64: by channel.
    light: [[f64; 3]; 2],
    /// Of the differences of luminance, f32 less f64, and their squares: of all paths, and of those that did not part.
    difference: [[f64; 2]; 2],
    luminance: f64,
    /// With another number of rays.
    longer: u64,
    /// On another way: since a ray met another surface, a shadow ray had another answer, or only one of both had one.
    parted: [u64; 3],
    /// Not finite in f32, in f64: left out.
    broken: [u64; 2],
    /// Of |difference| / luminance of paths that did not part: largest.
    worst: f64,
    /// Sums over pixels of relative squared errors: between the pictures, and of either's noise.
    between: f64,
    noise: [f64; 2],
}

impl Sums {
    fn join(mut self, o: Sums) -> Sums {
        self.paths += o.paths;
        for k in 0..2 {
            (0..3).for_each(|c| self.light[k][c] += o.light[k][c]);
            (0..2).for_each(|j| self.difference[k][j] += o.difference[k][j]);
            self.broken[k] += o.broken[k];
            self.noise[k] += o.noise[k];
        }
        self.luminance += o.luminance;
        self.longer += o.longer;
        (0..3).for_each(|k| self.parted[k] += o.parted[k]);
        self.worst = self.worst.max(o.worst);
        self.between += o.between;
        self
    }
}

fn luminance([r, g, b]: [f64; 3]) -> f64 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// All paths of a row of pixels.
fn row(scenes: (&single::Scene, &double::Scene), size: [u32; 2], y: u32, spp: u32) -> anyhow::Result<Sums> {
    let (mut single, mut double) = (single::Walker::new(scenes.0)?, double::Walker::new(scenes.1)?);
    let mut sums = Sums::default();
    for pixel in y * size[0]..(y + 1) * size[0] {
        // by precision, by half of the samples
        let mut halves = [[[0.0; 3]; 2]; 2];
        for sample in 0..spp {
            let traced = [single.trace(pixel, sample), double.trace(pixel, sample)];
            let broken = [0, 1].map(|k| !traced[k].light.iter().all(|x| x.is_finite()));
            (0..2).for_each(|k| sums.broken[k] += u64::from(broken[k]));
            if broken != [false; 2] {
                continue;
            }
            let [a, b] = [0, 1].map(|k| luminance(traced[k].light));
            let mut ways = traced[0].way.iter().zip(&traced[1].way);
            let parting = ways.find(|(a, b)| a != b);
            // one may end where the other goes on
            let parted = parting.is_some() || traced[0].way.len() != traced[1].way.len();
            sums.paths += 1;
            sums.luminance += b;
            sums.longer += u64::from(traced[0].rays != traced[1].rays);
            if parted {
                sums.parted[match parting {
                    Some((Met::Surface(_), Met::Surface(_))) => 0,
                    Some((Met::Light(_), Met::Light(_))) => 1,
                    _ => 2,
                }] += 1;
            }
            sums.difference[0][0] += a - b;
            sums.difference[0][1] += (a - b) * (a - b);
            if !parted {
                sums.difference[1][0] += a - b;
                sums.difference[1][1] += (a - b) * (a - b);
                if b > 0.0 {
                    sums.worst = sums.worst.max((a - b).abs() / b);
                }
            }
            for (k, t) in traced.iter().enumerate() {
                for c in 0..3 {
                    sums.light[k][c] += t.light[c];
                    halves[k][(sample & 1) as usize][c] += t.light[c];
                }
            }
        }
        // as rayherd_render::film estimates it; of an odd number the even half has one more
        let n = f64::from(spp);
        let (n_a, n_b) = (n - f64::from(spp / 2), f64::from(spp / 2));
        for c in 0..3 {
            let mean = |k: usize| (halves[k][0][c] + halves[k][1][c]) / n;
            for k in 0..2 {
                let apart = halves[k][0][c] / n_a - halves[k][1][c] / n_b;
                sums.noise[k] += apart * apart * (n_a * n_b / (n * n)) / (mean(k) * mean(k) + 0.01);
            }
            let apart = mean(0) - mean(1);
            sums.between += apart * apart / (mean(1) * mean(1) + 0.01);
        }
    }
    Ok(sums)
}

fn main() -> anyhow::Result<()> {
    let arguments = arguments()?;
    report(&arguments.scene, compare(&arguments)?, arguments.size);
    Ok(())
}

/// Traces every path of the picture in both.
fn compare(arguments: &Arguments) -> anyhow::Result<Sums> {
    let &Arguments { ref scene, size, spp, depth, seed, ref defines } = arguments;
    let options = ImportOptions { size: Some(size), defines: defines.clone(), ..ImportOptions::default() };
    let description = import(Path::new(scene), &options)?;
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let objects = Arc::new(MemoryObjects::default());
    let (settings, spool) = (PrepareSettings::default(), SpoolSettings::default());
    let prepared = prepare(&description, &source, &settings, &spool, objects.as_ref(), &NoProgress)?;
    let scene = PreparedScene::open(prepared.manifest, objects)?;
    let mut spec = RenderJobSpec::default();
    spec.image.size = Some(ImageSize::new(size[0], size[1])?);
    (spec.sampling.max_depth, spec.sampling.seed) = (Some(depth), Some(seed));
    let frame = serde_json::to_value(job::spec::frame(&spec, &scene.manifest, None)?)?;
    let (single, double) = (single::Scene::open(&scene, &frame)?, double::Scene::open(&scene, &frame)?);
    let rows = (0..size[1]).into_par_iter().map(|y| row((&single, &double), size, y, spp));
    let rows = rows.collect::<anyhow::Result<Vec<Sums>>>()?;
    Ok(rows.into_iter().fold(Sums::default(), Sums::join))
}

fn report(path: &str, s: Sums, size: [u32; 2]) {
    let n = s.paths as f64;
    let parted: u64 = s.parted.iter().sum();
    let channels = 3.0 * f64::from(size[0]) * f64::from(size[1]);
    // of a mean of differences, relative to the picture's mean
    let relative = |[sum, squares]: [f64; 2]| {
        let mean = sum / n;
        let error = ((squares / n - mean * mean).max(0.0) / n).sqrt();
        (sum / s.luminance, error * n / s.luminance)
    };
    println!("{path}: {} paths", s.paths);
    println!("  means of f32: {:.7?}; of f64: {:.7?}", s.light[0].map(|x| x / n), s.light[1].map(|x| x / n));
    let ratios: [f64; 3] = std::array::from_fn(|c| s.light[0][c] / s.light[1][c] - 1.0);
    let ratios = ratios.map(|ratio| format!("{ratio:+.2e}")).join(", ");
    println!("  f32 over f64, less 1: {ratios} by channel");
    let (all, error) = relative(s.difference[0]);
    println!("  of luminance: {all:+.2e}, standard error {error:.1e}: {:+.2} of them", all / error);
    let (together, error) = relative(s.difference[1]);
    println!(
        "  of paths that did not part: {together:+.2e}, standard error {error:.1e}; the largest of one path {:.1e}",
        s.worst
    );
    println!(
        "  relMSE between the pictures {:.2e}, of the noise of f32 {:.2e}, of f64 {:.2e}",
        s.between / channels,
        s.noise[0] / channels,
        s.noise[1] / channels
    );
    println!(
        "  parted: {} ({:.1e}; {} by another surface, {} by a shadow ray's answer, {} by one that only one of both had), with another number of rays: {}; not finite: {} in f32, {} in f64",
        parted,
        parted as f64 / n,
        s.parted[0],
        s.parted[1],
        s.parted[2],
        s.longer,
        s.broken[0],
        s.broken[1]
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    /// f64 is another arithmetic on the same paths: nearly all meet the same, and then bring the same light.
    #[test]
    fn both_trace_the_same_paths() {
        for name in ["cornell-box", "still-life", "ajar-door"] {
            let scene = format!("{}/../examples/{name}.xml", env!("CARGO_MANIFEST_DIR"));
            let of = Arguments { scene, size: [24, 24], spp: 4, depth: 8, seed: 1, defines: Vec::new() };
            let sums = compare(&of).unwrap();
            report(name, sums, of.size);
            assert_eq!((sums.paths, sums.broken), (24 * 24 * 4, [0; 2]));
            assert!(sums.luminance > 0.0 && sums.difference[1][1] > 0.0, "{name}: f64 is f32");
            let parted: u64 = sums.parted.iter().sum();
            assert!(parted < sums.paths / 100, "{name}: {parted} paths parted");
            let rounding = sums.difference[1][0] / sums.luminance;
            // through glass a rounding grows: a hundredth of a path's light, of a few paths
            assert!(rounding.abs() < 1e-3, "{name}: f32 brings {rounding:e} more");
        }
    }
}
