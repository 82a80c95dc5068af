//! `rayherd render`: from a scene to an EXR and a PNG.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use rayherd_api::{ImageSpec, PictureFile, RenderJob, RenderJobSpec};
use rayherd_herd::job::spec;
use rayherd_herd::job::{Commits, JobSettings, PreparedScene, Sampling};
use rayherd_herd::local::{JobOutcome, render_local};
use rayherd_herd::picture;
use rayherd_herd::profile::{Part, Profile};
use rayherd_herd::report::{Kind, Op, Report};
use rayherd_render::frame::Frame;
use rayherd_render::skip::Skip;
use rayherd_scene::import::{Sight, import};
use rayherd_scene::prepare::{ByteKind, ByteOp, ByteRow, Prepared};
use serde_json::json;

use super::print;
use crate::frames::{self, Shot};
use crate::image_options::ImageOptions;
use crate::interrupt::{self, Heeding};
use crate::job_file::{parse_job, read_job};
use crate::kept::{self, About};
use crate::options::{self, CutOptions, SceneOptions, set};
use crate::output::{distinct, png_file, replace};
use crate::progress::{Display, si};
use crate::run_options::RunOptions;
use crate::skip_options::SkipOptions;
use crate::source::{self, Opened};
use crate::storage;
use crate::store::{S3Options, Store, Temporary};

/// Objects of the prepared scene that stay in memory; what is more goes to a temporary folder.
pub const OBJECTS_IN_MEMORY: u64 = 256 << 20;

/// Render a scene to an EXR (linear) and a PNG (sRGB)
///
/// While it runs, the PNG is a preview. A scene file's own camera, size, samples and depth hold unless a flag or a job
/// file says otherwise; a mesh or volume is framed by a camera and lit by two area lights and a sky.
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd render examples/cornell-box.xml\n  \
    rayherd render bunny.ply -o bunny.exr --spp 256 --albedo 0.8,0.6,0.4\n  \
    rayherd render chest-ct --iso -789.5 --size 512x512 --target-error 0.01\n  \
    rayherd render scene.xml --nodes 4 --slots 2,2,4,4 --memory 64Mi --splits 32 --report r.json\n  \
    rayherd render -f job.yaml\n  \
    rayherd render scene.xml --profile\n  \
    rayherd render -f job.yaml --storage-profile storage.yaml --s3-endpoint http://localhost:9000\n  \
    rayherd render scene.xml --spp 4096 --store results --resume")]
pub struct Arguments {
    /// Mitsuba XML, mesh (PLY, OBJ, STL), folder of meshes, or CT volume (DICOM folder, NRRD, NIfTI)
    #[arg(required_unless_present_any = ["file", "local"])]
    scene: Option<String>,
    /// The scene, named by a flag: with -f a local one in the place of the job's
    #[arg(long = "scene", value_name = "PATH", conflicts_with = "scene")]
    local: Option<String>,
    /// Take the job from a RenderJob in YAML; flags win over it
    #[arg(short, long, value_name = "YAML")]
    file: Option<PathBuf>,
    /// With -f, fetch the job's scene from the storage of this profile: the chart's ConfigMap, or the profile.yaml in it; --s3-endpoint
    /// names a server where the profile's are inside the cluster
    #[arg(long, value_name = "YAML", requires = "file", conflicts_with_all = ["scene", "local"])]
    storage_profile: Option<PathBuf>,
    /// The EXR; the PNG goes beside it (see --files) [default: ./SCENE.exr]
    #[arg(short, long, value_name = "EXR")]
    output: Option<String>,
    /// Exposure of the PNG in stops [default: 0]
    #[arg(long, value_name = "STOPS", allow_hyphen_values = true)]
    exposure: Option<f64>,
    /// Write previews to this PNG instead of the final one's place
    #[arg(long, value_name = "PNG")]
    preview: Option<PathBuf>,
    /// Write what was done and counted as JSON (an array when there are several cameras)
    #[arg(long, value_name = "JSON")]
    report: Option<PathBuf>,
    /// Measure what each stage of the work costs: a table at the end, and `profile` in the report
    #[arg(long)]
    profile: bool,
    #[command(flatten)]
    image: ImageOptions,
    #[command(flatten)]
    sampling: SamplingOptions,
    #[command(flatten)]
    scene_options: SceneOptions,
    #[command(flatten)]
    cut: CutOptions,
    #[command(flatten)]
    run: RunOptions,
    #[command(flatten)]
    keep: KeepOptions,
    #[command(flatten)]
    skip: SkipOptions,
}

/// Where the job is kept.
#[derive(Args)]
#[command(next_help_heading = "Keeping")]
struct KeepOptions {
    /// Keep the prepared scene and every committed task here, a folder or s3://bucket/prefix, to go on after a crash
    #[arg(long, value_name = "STORE")]
    store: Option<String>,
    /// Go on where the store's job stopped: after a crash, or with more samples
    #[arg(long, requires = "store")]
    resume: bool,
    /// Take the store from whoever writes to it
    #[arg(long, requires = "store")]
    takeover: bool,
    #[command(flatten)]
    s3: S3Options,
}

/// How many samples.
#[derive(Args)]
#[command(next_help_heading = "Sampling")]
struct SamplingOptions {
    /// Samples per pixel; with a target error (then on average) or time limit, the most [default: the scene's, or 64]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    spp: Option<i32>,
    /// Stop when the estimated relative squared error (relMSE) is at most this, such as 0.01; parts of the picture that need fewer samples get fewer
    #[arg(long, value_name = "E", allow_hyphen_values = true)]
    target_error: Option<f64>,
    /// Start no further step of samples after so many seconds
    #[arg(long, value_name = "SECONDS", allow_hyphen_values = true)]
    time_limit: Option<f64>,
}

/// Renders every frame of the job.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let mut job = job(arguments)?;
    let settings = JobSettings { profile: arguments.profile, ..arguments.run.settings(&job.spec)? };
    use_threads(settings.threads)?;
    let files = frames::files(&job);
    frames::check_files(&files)?;
    let mut outputs: Vec<PathBuf> = files.iter().flat_map(|exr| frames::written(exr, &job.spec.image)).collect();
    outputs.iter().try_for_each(|path| replace::probe(path, "-o"))?;
    for (path, flag) in [(&arguments.preview, "--preview"), (&arguments.report, "--report")] {
        if let Some(path) = path {
            replace::probe(path, flag)?;
            // a preview becomes the picture, if it is to
            if !(flag == "--preview" && outputs.contains(path) && path.extension().is_some_and(|e| e == "png")) {
                outputs.push(path.clone());
            }
        }
    }
    distinct::check_outputs(&outputs)?;
    distinct::check_inputs(&outputs, arguments.file.as_deref())?;

    let keep = &arguments.keep;
    let origin = job.spec.scene.source.clone();
    // goes with its folder at the end
    let _fetched = match &arguments.storage_profile {
        Some(profile) => {
            let fetched = storage::fetch(profile, keep.s3.s3_endpoint.as_deref(), &job.spec.scene.source)?;
            job.spec.scene.source = fetched.source.to_string_lossy().into_owned();
            Some(fetched)
        }
        None => None,
    };
    let store = keep.store.as_ref().map(|address| Store::open(address, &keep.s3)).transpose()?;
    let temporary = if store.is_none() { Some(Temporary::new(OBJECTS_IN_MEMORY)?) } else { None };
    let objects = store.as_ref().map(|s| s.objects.clone()).or_else(|| temporary.as_ref().map(|t| t.objects.clone()));
    let objects = objects.context("no place for the prepared scene")?;
    let skips = arguments.skip.skips();
    let Opened { prepared, vertices_spilled, cells_passed } =
        source::open(&job.spec, objects.as_ref(), &outputs, skips)?;
    let shots = frames::shots(&job, &prepared.manifest)?;
    let scene = PreparedScene::open(prepared.manifest.clone(), objects)?.skipping(skips);
    let sampling = Sampling {
        spp: spec::samples(&job.spec, &prepared.manifest),
        target_error: job.spec.sampling.target_error,
        time_limit: job.spec.sampling.time_limit,
    };
    let exposure = job.spec.image.exposure.unwrap_or(0.0);
    let named = |shot: &Shot| -> anyhow::Result<(String, About)> {
        Ok((scene.image_name(&shot.frame)?, About::new(&origin, &scene, &shot.frame)?))
    };
    let names = shots.iter().map(named).collect::<Result<Vec<_>, _>>()?;
    if let (true, Some(store), Some(place)) = (keep.resume, &store, &keep.store) {
        kept::check_resumed(store, place, &names)?;
    }
    let mut reports = Vec::new();
    for (shot, (image, about)) in shots.iter().zip(&names) {
        let png = || job.spec.image.writes(PictureFile::Png).then(|| shot.png());
        let preview = arguments.preview.clone().or_else(png).map(|path| (path, exposure));
        if let Some(store) = &store {
            kept::note(store, image, about)?;
        }
        let store = store.as_ref().map(|store| store.job(image)).transpose()?;
        let commits = store.map(|store| Commits { store, resume: keep.resume, takeover: keep.takeover });
        let settings = JobSettings { commits, ..settings.clone() };
        let mut outcome = render(&scene, shot, &sampling, &settings, preview)?;
        outcome.report.prepare = prepare_report(&prepared);
        outcome.report.spilled_bytes += vertices_spilled + temporary.as_ref().map_or(0, Temporary::spilled);
        for (skip, count) in [(Skip::Prepared, prepared.kept()), (Skip::Volume, cells_passed)] {
            outcome.report.skips.insert(skip.name().to_owned(), count);
        }
        outcome.report.add_prepare_bytes(prepared.report.bytes.iter().map(prepare_row));
        let saved = save(&scene, shot, &outcome, &job.spec.image);
        match &keep.store {
            Some(place) => {
                saved.with_context(|| format!("all samples are kept in {place}, run again with --resume"))?
            }
            None => saved?,
        }
        tell(&shot.written(&job.spec.image), &shot.frame, &outcome.report, &sampling)?;
        if outcome.image.pixels.iter().all(|pixel| *pixel == [0.0; 3]) {
            tracing::warn!("{} is black: {}", shot.exr.display(), why_black(&job.spec, shot, prepared.manifest.offset));
        }
        if let Some(profile) = &outcome.report.profile {
            print(&costs(profile, outcome.report.nodes_detail.iter().map(|n| n.busy).sum()))?;
        }
        reports.push(outcome.report);
    }
    if let Some(path) = &arguments.report {
        let json = match &reports[..] {
            [one] => serde_json::to_vec_pretty(one)?,
            many => serde_json::to_vec_pretty(many)?,
        };
        replace::replace_or_keep(path, &[&json[..], b"\n"].concat())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Why a picture may be black. The scene is read once more: its blocks do not say what the shapes are called.
fn why_black(spec: &RenderJobSpec, shot: &Shot, offset: [f64; 3]) -> String {
    let sight = Sight::new(&shot.frame.camera, shot.frame.size, offset);
    let found = import(Path::new(&spec.scene.source), &spec::import_options(spec))
        .and_then(|description| Ok(sight.look(&description)?.walled_in(&description)));
    match found {
        Ok(Some(text)) => text,
        Ok(None) => "no light reached the camera: does it look at what is lit, and from outside?".to_owned(),
        // it was read before; what is wrong now is no fault of the picture
        Err(e) => format!("no light reached the camera ({e})"),
    }
}

/// The job of file and flags, checked.
fn job(arguments: &Arguments) -> anyhow::Result<RenderJob> {
    let mut job = match &arguments.file {
        Some(file) => {
            // with a profile the source is a key in the storage
            let job = if arguments.storage_profile.is_some() { parse_job(file)? } else { read_job(file)? };
            options::check(&job, Some(file))?;
            job
        }
        None => RenderJob::new(RenderJobSpec::default()),
    };
    let spec = &mut job.spec;
    if let Some(scene) = arguments.scene.as_ref().or(arguments.local.as_ref()) {
        spec.scene.source.clone_from(scene);
        spec.scene.prepared = None;
    }
    arguments.scene_options.apply(spec);
    arguments.cut.apply(spec);
    arguments.image.apply(spec);
    arguments.run.apply(spec);
    arguments.skip.apply(spec);
    set(&mut spec.sampling.spp, arguments.sampling.spp);
    set(&mut spec.sampling.target_error, arguments.sampling.target_error);
    set(&mut spec.sampling.time_limit, arguments.sampling.time_limit);
    set(&mut spec.image.output, arguments.output.clone());
    set(&mut spec.image.exposure, arguments.exposure);
    if arguments.run.replicas.is_none() {
        options::fit_replicas(&mut job);
    }
    options::check_local(&job, None)?;
    Ok(job)
}

/// Preparing and encoding keep to the threads that were asked for, too.
fn use_threads(threads: Option<NonZeroU32>) -> anyhow::Result<()> {
    let Some(threads) = threads else { return Ok(()) };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.get() as usize);
    pool.build_global().context("cannot start threads")
}

fn render(
    scene: &PreparedScene,
    shot: &Shot,
    sampling: &Sampling,
    settings: &JobSettings,
    preview: Option<(PathBuf, f64)>,
) -> anyhow::Result<JobOutcome> {
    let [width, height] = shot.frame.size;
    let display = Display::new(u64::from(width) * u64::from(height), sampling.target_error, preview);
    let heeding = Heeding::begin();
    let outcome = render_local(scene, &shot.frame, sampling, settings, &display);
    drop(heeding);
    display.finish();
    let kept = settings.commits.is_some();
    outcome.map_err(|error| {
        let exr = shot.exr.display();
        let what = match (interrupt::requested(), kept) {
            (true, true) => format!("{exr} is not finished: its committed samples are kept, go on with --resume"),
            (true, false) => format!("{exr} is not finished; with --store it could be resumed"),
            // a full store, a server that is gone
            (false, true) if !error.is_users() => {
                format!("cannot render {exr} (what is committed is kept: when that is mended, go on with --resume)")
            }
            (false, _) => format!("cannot render {exr}"),
        };
        anyhow::Error::new(error).context(what)
    })
}

fn save(scene: &PreparedScene, shot: &Shot, outcome: &JobOutcome, image: &ImageSpec) -> anyhow::Result<()> {
    if image.writes(PictureFile::Png) {
        replace::replace_or_keep(&shot.png(), &png_file::encode(&outcome.image, image.exposure.unwrap_or(0.0))?)?;
    }
    if !image.writes(PictureFile::Exr) {
        return Ok(());
    }
    let mut definition = spec::definition(&scene.manifest, &shot.frame, &outcome.samples)?;
    if !scene.skips().makes(Skip::Lights) {
        // the frame says nothing of it
        definition.insert("no_skip".to_owned(), json!([Skip::Lights.name()]));
    }
    let channels = outcome.film.channels(&outcome.samples, scene.manifest.offset);
    replace::replace_or_keep(&shot.exr, &picture::encode(&outcome.image, &channels, &definition)?)
}

fn prepare_report(prepared: &Prepared) -> serde_json::Value {
    let m = &prepared.manifest;
    json!({
        "reused": prepared.reused,
        "scene": prepared.reference.hash,
        "subdiv": m.grid.subdiv,
        "splits": m.splits.iter().filter(|s| !s.copied).count(),
        "copied_splits": m.splits.iter().filter(|s| s.copied).count(),
        "choice": m.choice,
        "contested_share": m.choice.candidates.iter().find(|c| c.subdiv == m.grid.subdiv).map(|c| c.contested_share()),
        "counts": m.counts,
        "took": prepared.report,
        "substitutions": m.defaults.substitutions,
    })
}

fn prepare_row(row: &ByteRow) -> (Op, Kind, u64) {
    let op = match row.op {
        ByteOp::Read => Op::Read,
        ByteOp::Write => Op::Write,
    };
    let kind = match row.kind {
        ByteKind::Source => Kind::Source,
        ByteKind::Spool => Kind::Spool,
        ByteKind::Manifest => Kind::Manifest,
        ByteKind::Geometry => Kind::Geometry,
        ByteKind::Attributes => Kind::Attributes,
        ByteKind::Texture => Kind::Texture,
    };
    (op, kind, row.bytes)
}

/// Where the pictures are, how noisy, what it took.
fn tell(files: &[PathBuf], frame: &Frame, report: &Report, sampling: &Sampling) -> anyhow::Result<()> {
    let [width, height] = frame.size;
    let files: Vec<String> = files.iter().map(|path| path.display().to_string()).collect();
    let error = report.rel_mse.map_or_else(|| "relMSE unknown".into(), |e| format!("relMSE {e:.2e}"));
    let target = match (report.target_reached, sampling.target_error) {
        (Some(true), Some(target)) => format!(" (target {target} reached)"),
        (Some(false), Some(target)) => format!(" (target {target} not reached: give more --spp or time)"),
        _ => String::new(),
    };
    let rays = report.rays.closest + report.rays.shadow;
    let (least, most) = (report.spp, report.most_spp);
    let mean = report.samples as f64 / (f64::from(width) * f64::from(height));
    let spp = if least == most { format!("{most} spp") } else { format!("{mean:.0} spp ({least} to {most})") };
    print(&format!(
        "{}: {width}x{height}, {spp}, {error}{target}, {} rays, {:.2} CPU-seconds\n",
        files.join(" and "),
        si(rays as f64),
        report.cpu_s
    ))
}

/// What each stage cost, of the CPU-seconds of all tasks; without stages that did nothing.
fn costs(profile: &Profile, busy: f64) -> String {
    let share = |cpu: f64| if busy > 0.0 { 100.0 * cpu / busy } else { 0.0 };
    let mut table = format!("{:<9}{:>9}{:>8}{:>10}{:>9}\n", "stage", "CPU-s", "share", "items", "ns each");
    for part in Part::ALL {
        let cost = profile.of(part);
        if cost.items > 0 {
            let (cpu, items) = (cost.cpu_s, cost.items as f64);
            let [each, share] = [1e9 * cpu / items, share(cpu)];
            table += &format!("{:<9}{cpu:>9.3}{share:>7.1}%{:>10}{each:>9.0}\n", part.name(), si(items));
        }
    }
    let rest = (busy - profile.cpu_s()).max(0.0);
    table + &format!("{:<9}{rest:>9.3}{:>7.1}%\n", "rest", share(rest))
}
