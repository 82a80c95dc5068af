//! From the spec of a checked job to what importing, preparing and tracing are told: the same for a local run and for a
//! cluster, so that both make the same bytes.

use rayherd_api::{self as api, CameraSpec, LightSpec, RenderJobSpec, StorageSpec, Strategy};
use rayherd_render::aov::{Aov, Aovs};
use rayherd_render::camera::{Camera, View};
use rayherd_render::film::Samples;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;
use rayherd_scene::import::{CameraView, ImportOptions, Light};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::prepare::{Cut, PrepareSettings};
use serde_json::{Map, Value, json};

use super::JobError;

/// What Mitsuba renders when nothing is said.
const DEFAULT_SIZE: [u32; 2] = [768, 576];
/// Enough for every scene that ends paths by Russian roulette.
const DEFAULT_MAX_DEPTH: u32 = 65;
/// The least CPU to an error in most scenes (docs/benchmarks/tried.md); Mitsuba, whose chances are others, begins at 5.
const DEFAULT_RR_DEPTH: u32 = 3;
/// Enough to see what is what.
const DEFAULT_SPP: u32 = 64;

/// What importing is told.
pub fn import_options(spec: &RenderJobSpec) -> ImportOptions {
    let scene = &spec.scene;
    let light = |l: &LightSpec| Light { origin: l.origin, target: l.target, size: l.size, radiance: rgb(&l.radiance) };
    ImportOptions {
        substitute: scene.substitute,
        defines: scene.define.iter().map(|(name, value)| (name.clone(), value.clone())).collect(),
        size: spec.image.size.map(|s| [s.width(), s.height()]),
        iso: scene.iso,
        albedo: scene.albedo.as_deref().map(rgb),
        // a camera that was asked for belongs to a frame, not to the scene: it must not prepare it anew
        camera: None,
        lights: scene.lights.iter().map(light).collect(),
        sky: scene.sky.as_deref().map(rgb),
    }
}

/// One number for all channels, or three.
fn rgb(numbers: &[f64]) -> [f32; 3] {
    std::array::from_fn(|c| numbers[if numbers.len() == 3 { c } else { 0 }] as f32)
}

/// What preparing is told.
pub fn prepare_settings(spec: &RenderJobSpec) -> PrepareSettings {
    let defaults = PrepareSettings::default();
    let cut = match (spec.block_size, spec.splits) {
        (Some(size), _) => Cut::BlockSize(size.bytes()),
        (None, Some(n)) => Cut::Splits(u32::try_from(n).unwrap_or(u32::MAX)),
        (None, None) => defaults.cut,
    };
    let overlap_threshold = spec.overlap_threshold.unwrap_or(defaults.overlap_threshold);
    // the paper's other two systems have none
    let overlap_reduction = matches!(spec.strategy, Strategy::SchedulingGridOverlapReduced | Strategy::Auto);
    PrepareSettings { cut, overlap_reduction, overlap_threshold, ..defaults }
}

/// Names what the prepared scene of a job depends on, but for the source's content: two jobs of one name and an unchanged source
/// have one prepared scene.
pub fn scene_settings(spec: &RenderJobSpec) -> String {
    // the API server fills in what others leave out
    let storage = StorageSpec {
        profile: spec.storage.profile.clone().filter(|p| p != "default"),
        secret: spec.storage.secret.clone().filter(|s| s != "rayherd-storage"),
    };
    let settings = json!({
        "scene": spec.scene,
        "size": spec.image.size,
        "cut": prepare_settings(spec),
        "storage": storage,
        "replicas": spec.replicas.filter(|&r| r != 1),
    });
    blake3::hash(settings.to_string().as_bytes()).to_hex()[..32].to_owned()
}

/// Samples per pixel: the job's, the scene's, or the default.
pub fn samples(spec: &RenderJobSpec, manifest: &Manifest) -> u32 {
    spec.sampling.spp.map(|n| n as u32).or(manifest.defaults.spp).unwrap_or(DEFAULT_SPP)
}

/// The frame that a camera sees; the scene's own without one.
///
/// # Errors
/// When the scene has no camera either, or one is out of range.
pub fn frame(spec: &RenderJobSpec, manifest: &Manifest, camera: Option<&CameraSpec>) -> Result<Frame, JobError> {
    let (image, sampling, defaults) = (&spec.image, &spec.sampling, &manifest.defaults);
    let camera = match camera {
        Some(c) => {
            let view = CameraView { origin: c.origin, target: c.target, up: c.up, fov: c.fov };
            view.camera().map_err(|e| JobError::Settings(e.to_string()))?
        }
        None => {
            let none = || JobError::Settings("the scene has no camera: give one (--camera, spec.image.cameras)".into());
            defaults.camera.clone().ok_or_else(none)?
        }
    };
    let size = image.size.map(|s| [s.width(), s.height()]).or(defaults.size).unwrap_or(DEFAULT_SIZE);
    let view = View { to_world: camera.to_world.0, projection: camera.projection, crop: camera.crop };
    let camera = Camera::of(&view, size, manifest.offset).map_err(|e| JobError::Settings(format!("camera: {e}")))?;
    let given = |v: Option<i32>| v.map(|n| n as u32);
    let frame = Frame {
        camera,
        size,
        filter: defaults.filter.unwrap_or(Filter::Box),
        seed: sampling.seed.map_or(0, |n| n as u64),
        max_depth: given(sampling.max_depth).or(defaults.max_depth).unwrap_or(DEFAULT_MAX_DEPTH),
        rr_depth: given(sampling.rr_depth).or(defaults.rr_depth).unwrap_or(DEFAULT_RR_DEPTH),
        split: given(sampling.split).unwrap_or(1),
        hide_emitters: defaults.hide_emitters,
        aovs: match &image.aovs {
            Some(aovs) => aovs.iter().map(aov).collect(),
            None => defaults.aovs.unwrap_or(Aovs::NONE),
        },
    };
    frame.check()?;
    Ok(frame)
}

fn aov(aov: &api::Aov) -> Aov {
    match aov {
        api::Aov::Albedo => Aov::Albedo,
        api::Aov::Normal => Aov::Normal,
        api::Aov::Depth => Aov::Depth,
        api::Aov::Position => Aov::Position,
        api::Aov::Uv => Aov::Uv,
        api::Aov::ObjectId => Aov::ObjectId,
        api::Aov::MaterialId => Aov::MaterialId,
        api::Aov::Variance => Aov::Variance,
        api::Aov::Cost => Aov::Cost,
    }
}

/// What defines an image, for the header of its file: the scene's content, the frame, the number of samples (fewest, most and a hash over all
/// tiles, where these have different numbers).
///
/// # Errors
/// When the frame cannot be written down, which is a mistake of Rayherd.
pub fn definition(manifest: &Manifest, frame: &Frame, samples: &Samples) -> Result<Map<String, Value>, JobError> {
    let spp = match samples {
        Samples::Even(n) => json!(n),
        Samples::Each(tiles) => {
            let bytes: Vec<u8> = tiles.iter().flat_map(|n| n.to_le_bytes()).collect();
            let hash = blake3::hash(&bytes).to_hex();
            json!({ "least": samples.least(), "most": samples.most(), "tiles": hash.as_str() })
        }
    };
    let frame = serde_json::to_value(frame).map_err(|e| JobError::Internal(e.to_string()))?;
    match json!({ "scene": manifest.content, "frame": frame, "spp": spp }) {
        Value::Object(map) => Ok(map),
        _ => Err(JobError::Internal("the definition of an image is no object".into())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_that_the_api_server_writes_out_are_no_other_settings() {
        let mut spec = RenderJobSpec::default();
        let name = scene_settings(&spec);
        spec.storage = StorageSpec { profile: Some("default".into()), secret: Some("rayherd-storage".into()) };
        (spec.replicas, spec.overlap_threshold) = (Some(1), Some(0.2));
        assert_eq!(scene_settings(&spec), name);
        spec.replicas = Some(2);
        assert_ne!(scene_settings(&spec), name);
    }
}
