//! Flags that several commands share, and how they become a [`RenderJobSpec`].
//!
//! A flag is named after the last part of the field that it sets (`spec.sampling.maxDepth`, `--max-depth`), so that a
//! problem of a field is told in the user's own words by [`check`].

use std::path::Path;
use std::str::FromStr;

use clap::Args;
use rayherd_api::{ByteSize, LightSpec, RenderJob, RenderJobSpec};
use rayherd_scene::import::{Light, parse_albedo, parse_define, parse_radiance};

use crate::fault::Mistake;

/// How a scene is read.
#[derive(Args, Default)]
#[command(next_help_heading = "Scene")]
pub struct SceneOptions {
    /// Value of the surface to extract from a volume, in its own units (Hounsfield for CT)
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true)]
    pub iso: Option<f64>,
    /// A rectangular light, nine numbers or eleven: ORIGIN,TARGET,WIDTH,HEIGHT,RADIANCE, the last one number or three;
    /// of a mesh or volume instead of the two that frame it, of an XML scene beside its own; repeatable
    #[arg(long, value_name = "LIGHT", allow_hyphen_values = true)]
    pub light: Vec<Light>,
    /// Radiance of a constant sky, one number or R,G,B, instead of the scene's; 0 is none
    #[arg(long, value_name = "RADIANCE", value_parser = parse_radiance, allow_hyphen_values = true)]
    pub sky: Option<[f32; 3]>,
    /// Reflectance of a mesh or volume, one number or R,G,B [default: 0.7]
    #[arg(long, value_name = "ALBEDO", value_parser = parse_albedo, allow_hyphen_values = true)]
    pub albedo: Option<[f32; 3]>,
    /// Replace what is not supported by named stand-ins, told in log and report, instead of refusing the scene
    #[arg(long)]
    pub substitute: bool,
    /// Value of a parameter ($NAME) of a Mitsuba scene; repeatable
    #[arg(short = 'D', value_name = "NAME=VALUE", value_parser = parse_define)]
    pub define: Vec<(String, String)>,
}

/// How a scene is cut.
#[derive(Args, Default)]
#[command(next_help_heading = "Preparing")]
pub struct CutOptions {
    /// Bytes of one split, such as 64Mi [default: 128Mi]
    #[arg(long, value_name = "SIZE")]
    pub block_size: Option<ByteSize>,
    /// Number of splits, instead of their size
    #[arg(long, value_name = "N", conflicts_with = "block_size", allow_hyphen_values = true)]
    pub splits: Option<i64>,
    /// Refine the grid while more than this share of primitives is in contested cells [default: 0.2]
    #[arg(long, value_name = "SHARE", allow_hyphen_values = true)]
    pub overlap_threshold: Option<f64>,
}

impl SceneOptions {
    /// Sets what was given.
    pub fn apply(&self, spec: &mut RenderJobSpec) {
        let scene = &mut spec.scene;
        set(&mut scene.iso, self.iso);
        if !self.light.is_empty() {
            scene.lights = self.light.iter().map(light_spec).collect();
        }
        set(&mut scene.sky, self.sky.map(|rgb| rgb.map(f64::from).to_vec()));
        set(&mut scene.albedo, self.albedo.map(|rgb| rgb.map(f64::from).to_vec()));
        scene.substitute |= self.substitute;
        scene.define.extend(self.define.iter().cloned());
    }
}

impl CutOptions {
    /// Sets what was given. A flag wins over the other way to say it in a file.
    pub fn apply(&self, spec: &mut RenderJobSpec) {
        if self.block_size.is_some() || self.splits.is_some() {
            (spec.block_size, spec.splits) = (self.block_size, self.splits);
        }
        set(&mut spec.overlap_threshold, self.overlap_threshold);
    }
}

/// Takes the value of a flag that was given.
pub fn set<T: Clone>(field: &mut Option<T>, flag: Option<T>) {
    if flag.is_some() {
        *field = flag;
    }
}

/// Every problem of a job as one error, told by field when it came from a file and by flag otherwise.
pub fn check(job: &RenderJob, file: Option<&Path>) -> Result<(), Mistake> {
    told(&rayherd_api::validate(job), file)
}

/// A file of a cluster may ask for more copies than there are workers, since servers hold them: here each node has one.
pub fn fit_replicas(job: &mut RenderJob) {
    let nodes = rayherd_api::local_nodes(job);
    if let Some(replicas) = job.spec.replicas.filter(|&r| r > 1 && r as usize > nodes) {
        tracing::warn!(
            "spec.replicas is {replicas}: here there is one copy on each of {nodes} node(s), and the picture is the same"
        );
        job.spec.replicas = Some(nodes as i32);
    }
}

/// The same of a job that runs in this process.
pub fn check_local(job: &RenderJob, file: Option<&Path>) -> Result<(), Mistake> {
    let mut problems = rayherd_api::validate(job);
    problems.extend(rayherd_api::validate_local(job));
    told(&problems, file)
}

fn told(problems: &[rayherd_api::Problem], file: Option<&Path>) -> Result<(), Mistake> {
    if problems.is_empty() {
        return Ok(());
    }
    let tell = |p: &rayherd_api::Problem| match file {
        Some(file) => format!("{}: {p}", file.display()),
        None => format!("{} {}", flag(&p.field), p.message),
    };
    let told: Vec<String> = problems.iter().map(tell).collect();
    Err(Mistake(told.join("\n  ")))
}

/// `spec.image.cameras[0].fov` -> `--camera`, `spec.sampling.maxDepth` -> `--max-depth`.
fn flag(field: &str) -> String {
    if field.contains("cameras[") {
        return "--camera".into();
    }
    if field == "spec.scene.source" {
        return "SCENE".into();
    }
    let name = field.rsplit('.').next().unwrap_or(field).split('[').next().unwrap_or(field);
    let kebab = name.chars().flat_map(|c| {
        let dash = c.is_ascii_uppercase().then_some('-');
        dash.into_iter().chain(std::iter::once(c.to_ascii_lowercase()))
    });
    std::iter::once('-').chain(std::iter::once('-')).chain(kebab).collect()
}

/// Numbers between commas.
pub fn numbers<T: FromStr>(text: &str) -> Result<Vec<T>, String> {
    text.split(',').map(|n| n.trim().parse().map_err(|_| format!("{n:?} is no number"))).collect()
}

fn light_spec(l: &Light) -> LightSpec {
    let radiance = l.radiance.map(f64::from).to_vec();
    LightSpec { origin: l.origin, target: l.target, size: l.size, radiance }
}

#[cfg(test)]
mod tests {
    use rayherd_herd::job::spec::import_options;

    use super::*;

    #[test]
    fn a_field_is_told_as_the_flag_that_sets_it() {
        for (field, name) in [
            ("spec.sampling.maxDepth", "--max-depth"),
            ("spec.blockSize", "--block-size"),
            ("spec.workers.slots[2]", "--slots"),
            ("spec.image.cameras[1].up", "--camera"),
            ("spec.scene.source", "SCENE"),
        ] {
            assert_eq!(flag(field), name);
        }
    }

    #[test]
    fn flags_become_what_importing_is_told() {
        let options = SceneOptions {
            iso: Some(-789.5),
            light: vec!["0,5,0,0,0,0,2,4,1,2,3".parse().unwrap()],
            sky: Some([0.5; 3]),
            define: vec![("spp".into(), "4".into())],
            ..SceneOptions::default()
        };
        let mut spec = RenderJobSpec::default();
        options.apply(&mut spec);
        let told = import_options(&spec);
        assert_eq!(told.lights, options.light);
        assert_eq!((told.iso, told.sky, told.albedo), (options.iso, options.sky, None));
        assert_eq!(told.defines, options.define);
    }
}
