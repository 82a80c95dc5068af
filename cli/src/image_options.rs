//! Flags that say which image is wanted.

use clap::Args;
use rayherd_api::{AovList, CameraSpec, ImageSize, PictureFile, RenderJobSpec};
use rayherd_scene::import::CameraView;

use crate::options::set;

/// Which image.
#[derive(Args, Default)]
#[command(next_help_heading = "Image")]
pub struct ImageOptions {
    /// Width and height in pixels [default: the scene's, or 768x576]
    #[arg(long, value_name = "WxH")]
    pub size: Option<ImageSize>,
    /// Where to look from, ten numbers: ORIGIN,TARGET,UP,FOV (three each; FOV in degrees along the width); repeatable
    #[arg(long, value_name = "CAMERA", allow_hyphen_values = true)]
    pub camera: Vec<CameraView>,
    /// Layers of the EXR beside the picture, names between commas, or all, or none: albedo, normal, depth, position, uv, objectId,
    /// materialId, variance, cost [default: those that the scene asks for]
    #[arg(long, value_name = "NAMES")]
    pub aov: Option<AovList>,
    /// Which files are written, names between commas [default: exr,png]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub files: Vec<PictureFile>,
    /// Seed of every random number [default: 0]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub seed: Option<i64>,
    /// Most rays in a path, shadow rays not counted: 1 sees emitters only [default: the scene's, or 65]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub max_depth: Option<i32>,
    /// Vertex from which Russian roulette ends paths [default: the scene's, or 3]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub rr_depth: Option<i32>,
    /// Paths that go on from the first hit of each sample [default: 1]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub split: Option<i32>,
}

impl ImageOptions {
    /// Sets what was given.
    pub fn apply(&self, spec: &mut RenderJobSpec) {
        set(&mut spec.image.size, self.size);
        if !self.camera.is_empty() {
            spec.image.cameras = self.camera.iter().map(camera_spec).collect();
        }
        set(&mut spec.image.aovs, self.aov.as_ref().map(|list| list.0.clone()));
        set(&mut spec.image.files, (!self.files.is_empty()).then(|| self.files.clone()));
        set(&mut spec.sampling.seed, self.seed);
        set(&mut spec.sampling.max_depth, self.max_depth);
        set(&mut spec.sampling.rr_depth, self.rr_depth);
        set(&mut spec.sampling.split, self.split);
    }
}

fn camera_spec(c: &CameraView) -> CameraSpec {
    CameraSpec { name: None, origin: c.origin, target: c.target, up: c.up, fov: c.fov }
}
