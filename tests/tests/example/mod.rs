//! A scene of examples/, prepared in memory.

use std::path::Path;
use std::sync::Arc;

use rayherd_api::{ImageSize, RenderJobSpec};
use rayherd_herd::job::{PreparedScene, spec};
use rayherd_render::frame::Frame;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};

/// The scene, and a frame of so many pixels a side and rays a path.
pub fn prepared(example: &str, size: u32, max_depth: i32, settings: &PrepareSettings) -> (PreparedScene, Frame) {
    let mut job = RenderJobSpec::default();
    job.image.size = Some(ImageSize::new(size, size).unwrap());
    job.sampling.max_depth = Some(max_depth);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples").join(example);
    let description = import(&path, &spec::import_options(&job)).unwrap();
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let objects = Arc::new(MemoryObjects::default());
    let spool = SpoolSettings::default();
    let made = prepare(&description, &source, settings, &spool, objects.as_ref(), &NoProgress).unwrap();
    let scene = PreparedScene::open(made.manifest, objects).unwrap();
    let frame = spec::frame(&job, &scene.manifest, None).unwrap();
    (scene, frame)
}
