//! `rayherd prepare`: a scene made ready once, for many renders.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Args;
use rayherd_api::{ImageSize, RenderJob, RenderJobSpec, Strategy};
use rayherd_scene::objects::{DirectoryObjects, ObjectStore};

use super::{print, size};
use crate::options::{self, CutOptions, SceneOptions};
use crate::source;

/// Cut a scene into splits, build their trees and the scheduling grid, and store them
///
/// Objects are named by their content: preparing the same scene again finds it and does nothing.
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd prepare scene.xml --store prepared\n  \
    rayherd prepare chest --iso -789.5 --splits 32 --store prepared\n  rayherd inspect prepared")]
pub struct Arguments {
    /// Mitsuba XML, mesh (PLY, OBJ, STL), folder of meshes, or CT volume (DICOM folder, NRRD, NIfTI)
    scene: String,
    /// Folder to store it in
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
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

    let objects: Arc<dyn ObjectStore> = Arc::new(DirectoryObjects::open(&arguments.store)?);
    let (_, prepared) = source::open(&spec, &objects)?;
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
        arguments.store.display()
    ))?;
    Ok(ExitCode::SUCCESS)
}
