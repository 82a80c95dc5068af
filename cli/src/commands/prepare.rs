//! `rayherd prepare`: a scene made ready once, for many renders.

use std::process::ExitCode;

use clap::Args;
use rayherd_api::{ImageSize, RenderJob, RenderJobSpec, Strategy};
use rayherd_render::skip::Skips;

use super::{print, size};
use crate::options::{self, CutOptions, SceneOptions};
use crate::source;
use crate::store::{S3Options, Store};

/// Cut a scene into splits, build their trees and the scheduling grid, and store them
///
/// Objects are named by their content: preparing the same scene again finds it and does nothing.
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd prepare scene.xml --store prepared\n  \
    rayherd prepare chest --iso -789.5 --splits 32 --store prepared\n  rayherd inspect prepared")]
pub struct Arguments {
    /// Mitsuba XML, mesh (PLY, OBJ, STL), folder of meshes, or CT volume (DICOM folder, NRRD, NIfTI)
    scene: String,
    /// Where to store it: a folder, or s3://bucket/prefix
    #[arg(long, value_name = "STORE")]
    store: String,
    #[command(flatten)]
    s3: S3Options,
    #[command(flatten)]
    scene_options: SceneOptions,
    #[command(flatten)]
    cut: CutOptions,
    /// Whose grid: auto and scheduling-grid-overlap-reduced copy contested cells, the others do not
    #[arg(long, value_name = "NAME", default_value_t = Strategy::Auto, help_heading = "Preparing")]
    strategy: Strategy,
    /// Width and height of the image to come, as given to `render` [default: the scene's]
    #[arg(long, value_name = "WxH", help_heading = "Preparing")]
    size: Option<ImageSize>,
}

/// Prepares and says what was done.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let mut spec = RenderJobSpec { strategy: arguments.strategy, ..RenderJobSpec::default() };
    spec.scene.source.clone_from(&arguments.scene);
    spec.image.size = arguments.size;
    arguments.scene_options.apply(&mut spec);
    arguments.cut.apply(&mut spec);
    options::check(&RenderJob::new(spec.clone()), None)?;

    let store = Store::open(&arguments.store, &arguments.s3)?;
    let prepared = source::open(&spec, store.objects.as_ref(), &[], Skips::ALL)?.prepared;
    let m = &prepared.manifest;
    let copied = m.splits.iter().filter(|s| s.copied).count();
    let done = if prepared.reused { "was prepared already: nothing to do" } else { "is prepared" };
    print(&format!(
        "{} {done}: {} primitives in {} splits ({copied} copied), {}; grid {}^3\n{} in {}\n",
        arguments.scene,
        m.counts.triangles + m.counts.spheres,
        m.splits.len(),
        size(m.scene_bytes()),
        m.grid.subdiv,
        prepared.reference.hash,
        arguments.store
    ))?;
    Ok(ExitCode::SUCCESS)
}
