//! `rayherd replay`: every vertex of one path, for bug reports.

use std::fmt::Write;
use std::process::ExitCode;

use clap::Args;
use rayherd_api::{RenderJob, RenderJobSpec};
use rayherd_herd::job::{JobError, PreparedScene};
use rayherd_herd::resident::Resident;
use rayherd_herd::textures::{DEFAULT_BUDGET, StoredTiles, TaskTextures, TileCache, all_tile_bytes};
use rayherd_render::bvh::{Kernel, Tracer};
use rayherd_render::film::FilmPart;
use rayherd_render::path::{Outcome, PathRay, ShadowRay, Surfaces, camera_ray, shade};
use rayherd_render::ray::Hit;

use super::print;
use super::render::OBJECTS_IN_MEMORY;
use crate::fault::Mistake;
use crate::frames;
use crate::image_options::ImageOptions;
use crate::options::{self, SceneOptions, numbers};
use crate::skip_options::SkipOptions;
use crate::source;
use crate::store::Temporary;

/// Trace one sample of one pixel again and print every vertex of its path
///
/// The scene's flags, those of the image (size, seed, depths, split, camera) and --no-skip must be those of the render. Which samples had a
/// contribution that was not finite, the first 16 of them by pixel, is in its log and its report (non_finite_at).
#[derive(Args)]
#[command(after_help = "Example:\n  rayherd replay examples/cornell-box.xml --pixel 120,80 --sample 7")]
pub struct Arguments {
    /// Mitsuba XML, mesh, folder of meshes, or CT volume
    scene: String,
    /// Column and row, from the upper left corner, from 0
    #[arg(long, value_name = "X,Y", value_parser = pixel)]
    pixel: [u32; 2],
    /// Index of the sample, from 0
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(0..1 << 24))]
    sample: u32,
    #[command(flatten)]
    image: ImageOptions,
    #[command(flatten)]
    scene_options: SceneOptions,
    #[command(flatten)]
    skip: SkipOptions,
}

/// Prints the path.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let mut spec = RenderJobSpec::default();
    spec.scene.source.clone_from(&arguments.scene);
    arguments.scene_options.apply(&mut spec);
    arguments.image.apply(&mut spec);
    arguments.skip.apply(&mut spec);
    let skips = arguments.skip.skips();
    let job = RenderJob::new(spec);
    options::check(&job, None)?;
    let temporary = Temporary::new(OBJECTS_IN_MEMORY)?;
    let objects = temporary.objects.clone();
    let prepared = source::open(&job.spec, objects.as_ref(), &[], skips)?.prepared;
    let frame = frames::frame(&job, &prepared.manifest, job.spec.image.cameras.first())?;
    let ([x, y], [width, height]) = (arguments.pixel, frame.size);
    if x >= width || y >= height {
        return Err(Mistake(format!("--pixel {x},{y} lies outside the image of {width}x{height}")).into());
    }
    let scene = PreparedScene::open(prepared.manifest, objects)?.skipping(skips);
    let all: Vec<u32> = (0..scene.splits()).collect();
    let resident = Resident::load(&scene, &all, &scene)?;
    let surfaces = resident.surfaces(&scene, &scene)?;
    let mut replay = Replay {
        scene: &scene,
        resident: &resident,
        tracer: Tracer::new(Kernel::Scalar).map_err(JobError::from)?,
        film: FilmPart::new(frame.size),
        text: format!("pixel {x},{y} sample {} of {}, seed {}\n", arguments.sample, arguments.scene, frame.seed),
    };
    let (cache, tiles) = (TileCache::new(DEFAULT_BUDGET, all_tile_bytes(&scene)), StoredTiles(&scene));
    let textures = TaskTextures::new(&scene, &cache, &tiles, 1);
    let context = scene.context(&frame).with(&textures);
    let mut out = Outcome::default();
    let mut waiting = vec![camera_ray(&frame, y * width + x, arguments.sample)];
    while let Some(ray) = waiting.pop() {
        let mut hits = [Hit::miss(f32::INFINITY)];
        replay.tracer.closest(resident.forest(), &[ray.ray()], &mut hits);
        let before = out.counters;
        shade(&context, &surfaces, &[ray], &hits, &mut out);
        textures.check()?;
        replay.vertex(&ray, &hits[0], &surfaces);
        replay.light(&out);
        out.shadow.iter().for_each(|shadow| replay.shadow(shadow));
        let c = &out.counters;
        for (ended, why) in [
            (c.missed > before.missed, "left the scene"),
            (c.depth > before.depth, "reached the largest depth"),
            (c.roulette > before.roulette, "was ended by Russian roulette"),
            (c.absorbed > before.absorbed, "was absorbed"),
        ] {
            if ended {
                replay.line(format_args!("  the path {why}"));
            }
        }
        waiting.extend(out.next.iter().rev());
        out.clear();
    }
    replay.end();
    print(&replay.text)?;
    Ok(ExitCode::SUCCESS)
}

fn pixel(text: &str) -> Result<[u32; 2], String> {
    <[u32; 2]>::try_from(numbers(text)?).map_err(|n| format!("has {} numbers: give two, X,Y", n.len()))
}

struct Replay<'a> {
    scene: &'a PreparedScene,
    resident: &'a Resident,
    tracer: Tracer,
    film: FilmPart,
    text: String,
}

impl Replay<'_> {
    fn line(&mut self, line: std::fmt::Arguments) {
        // writing to a string cannot fail
        let _ = writeln!(self.text, "{line}");
    }

    /// The point of a recentred one in the source's coordinates.
    fn source_point(&self, p: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|a| f64::from(p[a]) + self.scene.manifest.offset[a])
    }

    fn vertex(&mut self, ray: &PathRay, hit: &Hit, surfaces: &impl Surfaces) {
        let d = ray.dir.decode();
        let from = self.source_point(ray.o);
        self.line(format_args!("vertex {} branch {}: from {from:?} along {d:?}", ray.key.vertex, ray.key.branch));
        self.line(format_args!("  throughput {:?}, pdf {}", ray.throughput, ray.pdf));
        if !hit.is_hit() {
            return;
        }
        let shape = &self.scene.world.shapes[surfaces.shape(0, hit) as usize];
        let material = &self.scene.world.materials[shape.material as usize];
        let at = self.source_point(std::array::from_fn(|a| ray.o[a] + hit.t * d[a]));
        let (name, made_of) = (shape.name.clone(), material.name.clone());
        self.line(format_args!("  hits primitive {} of shape {name:?}, material {made_of:?}", surfaces.prim(0, hit)));
        self.line(format_args!("  at {at:?}, t {}, u {}, v {}", hit.t, hit.u, hit.v));
    }

    fn light(&mut self, out: &Outcome) {
        for light in &out.light {
            self.add("emission", light.pixel, light.sample, light.value);
        }
    }

    fn shadow(&mut self, shadow: &ShadowRay) {
        let (d, tmax) = (shadow.dir.decode(), shadow.tmax);
        self.line(format_args!("  shadow ray along {d:?} to t {tmax}"));
        let mut occluded = [false];
        self.tracer.any(self.resident.forest(), &[shadow.ray()], &mut occluded);
        if occluded[0] {
            self.line(format_args!("  is blocked, or else would add {:?}", shadow.contribution));
            return;
        }
        let light = shadow.light();
        self.add("light", light.pixel, light.sample, light.value);
    }

    fn add(&mut self, what: &str, pixel: u32, sample: u32, value: [f32; 3]) {
        let before = self.film.rejected().count;
        self.film.add(pixel, sample, value);
        let rejected = if self.film.rejected().count > before { ", which the film REJECTS" } else { "" };
        self.line(format_args!("  {what} adds {value:?}{rejected}"));
    }

    /// What the sample adds to its pixel.
    fn end(&mut self) {
        let sum = self.film.resolve(1).into_iter().fold([0.0f32; 3], |sum, p| std::array::from_fn(|c| sum[c] + p[c]));
        self.line(format_args!("in all {sum:?}"));
    }
}
