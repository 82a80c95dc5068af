//! What rounds, tasks and the planner add where a scene fits one node: CPU of `auto` over that of a plain loop in memory.
//!
//! `overhead SCENE.xml [SPP] [PAIRS] [NAME=VALUE ...]` prepares the scene into memory and renders it at 256 x 256 and depth 8, in
//! turn with one thread by a job of strategy `auto`, with the same by the loop below, and with two threads by a job. The films must
//! be equal. Figures: medians of the ratios, each with the interval of its order statistics that holds the median with 95 %.

use std::num::NonZeroU32;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, ensure};
use rayherd_api::{ImageSize, RenderJobSpec, Strategy};
use rayherd_benches::{interval, median, process_cpu};
use rayherd_herd::job::{self, JobSettings, NodeSpec, PreparedScene, Sampling, Silent};
use rayherd_herd::local::render_local;
use rayherd_herd::resident::Resident;
use rayherd_render::bvh::{Kernel, Tracer};
use rayherd_render::film::{FilmPart, TILE};
use rayherd_render::frame::Frame;
use rayherd_render::path::{Context, Outcome, PathRay, camera_rays, shade_traced};
use rayherd_render::ray::{Hit, Ray};
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};

/// Rays traced together, as in a task.
const BATCH: usize = 2048;

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let path = args.next().context("usage: overhead SCENE.xml [SPP] [PAIRS] [NAME=VALUE ...]")?;
    let spp: u32 = args.next().map_or(Ok(64), |n| n.parse())?;
    let pairs: usize = args.next().map_or(Ok(10), |n| n.parse())?;
    let mut options = ImportOptions { size: Some([256, 256]), ..ImportOptions::default() };
    for define in args {
        let (name, value) = define.split_once('=').context("definitions are NAME=VALUE")?;
        options.defines.push((name.to_owned(), value.to_owned()));
    }
    let description = import(Path::new(&path), &options)?;
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let objects = Arc::new(MemoryObjects::default());
    let (settings, spool) = (PrepareSettings::default(), SpoolSettings::default());
    let prepared = prepare(&description, &source, &settings, &spool, objects.as_ref(), &NoProgress)?;
    let scene = PreparedScene::open(prepared.manifest, objects)?;
    ensure!(scene.manifest.tiles.is_empty(), "the plain loop has no textures: name another scene");
    let mut spec = RenderJobSpec::default();
    spec.image.size = Some(ImageSize::new(256, 256)?);
    spec.sampling.max_depth = Some(8);
    let frame = job::spec::frame(&spec, &scene.manifest, None)?;

    let (mut over, mut speed, mut tax) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..pairs {
        let one = timed(|| by_job(&scene, &frame, spp, 1))?;
        let plain = timed(|| by_loop(&scene, &frame, spp))?;
        let two = timed(|| by_job(&scene, &frame, spp, 2))?;
        ensure!(one.film == plain.film && two.film == plain.film, "another film");
        println!(
            "pair {pair}: plain loop {:.3} CPU-s, auto {:.3}, ratio {:.4}; two threads {:.3} CPU-s, {:.3} s against {:.3}: {:.3} times",
            plain.cpu,
            one.cpu,
            one.cpu / plain.cpu,
            two.cpu,
            two.wall,
            one.wall,
            one.wall / two.wall
        );
        over.push(one.cpu / plain.cpu);
        speed.push(one.wall / two.wall);
        tax.push(two.cpu / one.cpu);
    }
    for (name, ratios) in
        [("auto over plain loop, CPU", over), ("one thread over two, wall", speed), ("two threads over one, CPU", tax)]
    {
        let (lo, hi) = interval(&ratios);
        println!("{name}: median {:.4}, 95 % interval {lo:.4} to {hi:.4}", median(ratios));
    }
    Ok(())
}

struct Timed {
    film: FilmPart,
    cpu: f64,
    wall: f64,
}

fn timed(work: impl FnOnce() -> anyhow::Result<FilmPart>) -> anyhow::Result<Timed> {
    let (start, before) = (Instant::now(), process_cpu());
    let film = work()?;
    Ok(Timed { film, cpu: process_cpu() - before, wall: start.elapsed().as_secs_f64() })
}

fn by_job(scene: &PreparedScene, frame: &Frame, spp: u32, threads: u32) -> anyhow::Result<FilmPart> {
    let settings = JobSettings {
        strategy: Strategy::Auto,
        nodes: vec![NodeSpec { slots: threads }],
        threads: NonZeroU32::new(threads),
        ..JobSettings::default()
    };
    let sampling = Sampling { spp, target_error: None, time_limit: None };
    Ok(render_local(scene, frame, &sampling, &settings, &Silent)?.film)
}

/// Tile by tile, depth first: the same calls as a task makes, and nothing around them.
fn by_loop(scene: &PreparedScene, frame: &Frame, spp: u32) -> anyhow::Result<FilmPart> {
    let splits: Vec<u32> = (0..scene.splits()).collect();
    let resident = Resident::load(scene, &splits, scene)?;
    let surfaces = resident.surfaces(scene, scene)?;
    let context = Context::new(&scene.world, &scene.lights, frame);
    let mut tracer = Tracer::new(Kernel::Auto)?;
    let mut film = FilmPart::new(frame.size);
    let mut outcome = Outcome::default();
    let (mut pending, mut rays): (Vec<PathRay>, Vec<Ray>) = Default::default();
    let (mut hits, mut occluded) = (Vec::new(), Vec::new());
    let mut samples = samples(frame.size, spp);
    let mut some = Vec::new();
    loop {
        occluded.resize(outcome.shadow.len(), false);
        tracer.any(resident.forest(), &outcome.shadow_rays, &mut occluded);
        let seen = outcome.shadow.iter().zip(&occluded).filter(|(_, occluded)| !**occluded);
        film.add_all(seen.map(|(s, _)| (s.key.pixel, s.key.sample, s.contribution)));
        outcome.shadow.clear();
        outcome.shadow_rays.clear();
        let from = pending.len().saturating_sub(BATCH);
        some.clear();
        some.extend(samples.by_ref().take(from + BATCH - pending.len()));
        camera_rays(frame, &some, &mut pending, &mut rays);
        if pending.is_empty() {
            return Ok(film);
        }
        hits.resize(pending.len() - from, Hit::miss(0.0));
        tracer.closest(resident.forest(), &rays[from..], &mut hits);
        shade_traced(&context, &surfaces, &pending[from..], &rays[from..], &hits, &mut outcome);
        pending.truncate(from);
        rays.truncate(from);
        film.add_all(outcome.light.drain(..).map(|l| (l.pixel, l.sample, l.value)));
        pending.append(&mut outcome.next);
        rays.append(&mut outcome.next_rays);
    }
}

/// Pixel and sample, the samples of a pixel together, film tile by film tile.
fn samples([width, height]: [u32; 2], spp: u32) -> impl Iterator<Item = [u32; 2]> {
    let tiles =
        (0..height).step_by(TILE as usize).flat_map(move |y| (0..width).step_by(TILE as usize).map(move |x| (x, y)));
    let pixels = tiles.flat_map(move |(x, y)| {
        let rows = y..(y + TILE).min(height);
        rows.flat_map(move |y| (x..(x + TILE).min(width)).map(move |x| y * width + x))
    });
    pixels.flat_map(move |pixel| (0..spp).map(move |sample| [pixel, sample]))
}
