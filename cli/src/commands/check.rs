//! `rayherd check`: what a scene holds and what of it would not be read, before anything is prepared.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::process::ExitCode;

use clap::Args;
use rayherd_api::{RenderJob, RenderJobSpec};
use rayherd_herd::job::spec::import_options;
use rayherd_scene::description::{
    Amount, Beam, Bsdf, Description, Environment, Geometry, Material, MeshFormat, Projection, TextureKind,
};
use rayherd_scene::import::{ImportOptions, Survey, import, sky_map};
use rayherd_scene::prepare::{Cut, PrepareError, PrepareSettings, foresee};

use super::{print, size};
use crate::options::{self, SceneOptions};

/// Say what a scene holds and what of it is not supported; render nothing
///
/// Exits with 2 when something is unsupported (each named with file and line; with --substitute that is allowed), cannot be read, or leaves
/// nothing to see or no light.
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd check scene.xml\n  rayherd check chest --iso -789.5\n  \
    rayherd check scene.xml --substitute")]
pub struct Arguments {
    /// Mitsuba XML, mesh (PLY, OBJ, STL), folder of meshes, or CT volume (DICOM folder, NRRD, NIfTI)
    scene: String,
    #[command(flatten)]
    scene_options: SceneOptions,
}

/// Reads all of the source once and prints.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let mut spec = RenderJobSpec::default();
    spec.scene.source.clone_from(&arguments.scene);
    arguments.scene_options.apply(&mut spec);
    options::check(&RenderJob::new(spec.clone()), None)?;

    // with stand-ins, to go on after the first thing that is not supported
    let options = ImportOptions { substitute: true, ..import_options(&spec) };
    let description = import(Path::new(&arguments.scene), &options)?;
    let survey = Survey::of(&description);
    let (text, mut problems) = (tell(&arguments.scene, &description, &survey), problems(&description, &survey));
    let mut warnings: Vec<String> = survey.walled_in.iter().cloned().collect();
    // where a file ends too early, what is missing tells nothing of the scene
    if survey.shapes.iter().all(|s| s.error.is_none()) {
        match foresee(&description, &survey) {
            Ok(told) => warnings.extend(told),
            Err(error @ PrepareError::Dark { .. }) => problems.push(error.to_string()),
            Err(error) => problems.push(format!("{}: {error}", arguments.scene)),
        }
    }
    for s in &description.substitutions {
        let line = format!("{}: {} is not supported; --substitute puts in its place: {}", s.place, s.what, s.stand_in);
        if spec.scene.substitute { tracing::info!("{line}") } else { problems.push(line) }
    }
    print(&text)?;
    description.notes.iter().for_each(|note| eprintln!("{}: {}", note.place, note.text));
    warnings.iter().for_each(|text| eprintln!("warning: {text}"));
    problems.iter().for_each(|p| eprintln!("{p}"));
    if problems.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    eprintln!("error: {} in {}", count(problems.len() as u64, "problem"), arguments.scene);
    Ok(ExitCode::from(2))
}

/// Shapes and pictures that cannot be read to their end.
fn problems(description: &Description, survey: &Survey) -> Vec<String> {
    let shapes = description.shapes.iter().zip(&survey.shapes);
    let mut out: Vec<String> = shapes
        .filter_map(|(shape, found)| {
            let error = anyhow::Error::msg(found.error.as_ref()?.to_string());
            Some(format!("{}: shape \"{}\": {}", shape.place, shape.name, crate::fault::tell(&error)))
        })
        .collect();
    out.extend(survey.textures.iter().filter_map(|t| Some(t.as_ref().err()?.to_string())));
    if let Err(error) = sky_map(description.environment.as_ref()) {
        out.push(format!("the sky: {error}"));
    }
    out
}

fn tell(scene: &str, description: &Description, survey: &Survey) -> String {
    let mut out = format!("scene        {scene}\n");
    let mut line = |name: &str, text: String| {
        let _ = writeln!(out, "{name:12} {text}");
    };
    let (triangles, spheres) = (survey.sum(|s| s.triangles), survey.sum(|s| s.spheres));
    line("source", format!("{} read", size(description.bytes_read + survey.bytes_read)));
    line("shapes", kinds(description.shapes.iter().map(|s| geometry(&s.geometry))));
    line("primitives", format!("{}, {}", count(triangles, "triangle"), count(spheres, "sphere")));
    let (flat, bad) = (survey.sum(|s| s.flat), survey.sum(|s| s.not_finite));
    let far = match survey.sum(|s| s.out_of_range) {
        0 => String::new(),
        n => format!(", {n} beyond 2^39 units"),
    };
    line("skipped", format!("{flat} of zero area, {bad} with NaN or infinity{far}"));
    let [lo, hi] = survey.bounds;
    if lo[0] <= hi[0] {
        line("box", format!("{lo:.4?} to {hi:.4?}"));
    }
    line("materials", kinds(description.materials.iter().map(material)));
    if !description.textures.is_empty() {
        let kinds = kinds(description.textures.iter().map(|t| texture(&t.kind)));
        line("textures", format!("{kinds}; {} of texels", size(survey.texture_bytes())));
    }
    line("lights", lights(description, survey));
    if let Some(camera) = &description.camera {
        let [w, h] = description.size.unwrap_or([0, 0]);
        let kind = match camera.projection {
            Projection::Perspective { fov_x } => format!("perspective, {fov_x:.3} degrees across"),
            Projection::ThinLens { fov_x, aperture, focus } => {
                format!("thin lens of radius {aperture}, sharp at {focus}, {fov_x:.3} degrees across")
            }
            Projection::Orthographic => "orthographic".to_owned(),
        };
        let part = match camera.crop {
            Some(([w, h], [x, y, ..])) => format!(" from ({x}, {y}) of {w}x{h}"),
            None => String::new(),
        };
        line("camera", format!("{kind}, {w}x{h}{part}"));
    }
    let with_attribute = survey.sum(|s| s.with_attribute);
    if with_attribute > 0 {
        line("colours", format!("{} with a mesh attribute", count(with_attribute, "triangle")));
    }
    let total = survey.prepared_bytes();
    let Cut::BlockSize(block) = PrepareSettings::default().cut else { unreachable!("the default is a size") };
    let [least, most] = survey.split_bytes(block).map(size);
    let one = if least == most { least } else { format!("{least} to {most}") };
    let needed = format!("a node needs memory for one split at least, {one} (with a --block-size of {})", size(block));
    line("prepared", format!("about {}; {needed}", size(total)));
    out
}

fn lights(description: &Description, survey: &Survey) -> String {
    let emits = description.shapes.iter().zip(&survey.shapes).filter(|(s, _)| s.emission.is_some());
    let primitives: u64 = emits.clone().map(|(_, found)| found.triangles + found.spheres).sum();
    let sky = match &description.environment {
        Some(Environment::Constant(rgb)) => format!(", sky of {rgb:?}"),
        Some(Environment::Map { path, .. }) => format!(", sky from {}", path.display()),
        Some(Environment::Sky(sky)) => format!(", clear sky of turbidity {}", sky.turbidity),
        None => String::new(),
    };
    let sun = if description.sun.is_some() { ", sun" } else { "" };
    let beams = match description.beams.len() {
        0 => String::new(),
        _ => format!(", {}", kinds(description.beams.iter().map(beam))),
    };
    format!("{} of {}{beams}{sky}{sun}", count(emits.count() as u64, "shape"), count(primitives, "primitive"))
}

/// "3: 2 obj, 1 sphere".
fn kinds<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let mut by_name: BTreeMap<&str, u64> = BTreeMap::new();
    names.for_each(|name| *by_name.entry(name).or_default() += 1);
    let list: Vec<String> = by_name.iter().map(|(name, n)| format!("{n} {name}")).collect();
    format!("{}: {}", by_name.values().sum::<u64>(), list.join(", "))
}

fn count(n: u64, what: &str) -> String {
    if n == 1 { format!("1 {what}") } else { format!("{n} {what}s") }
}

fn beam(beam: &Beam) -> &'static str {
    match beam {
        Beam::Point { .. } => "point light",
        Beam::Spot { .. } => "spot light",
        Beam::Directional { .. } => "directional light",
    }
}

fn geometry(geometry: &Geometry) -> &'static str {
    match geometry {
        Geometry::MeshFile { format: MeshFormat::Ply, .. } => "ply",
        Geometry::MeshFile { format: MeshFormat::Obj, .. } => "obj",
        Geometry::Part => "part of an obj",
        Geometry::MeshFile { format: MeshFormat::Stl, .. } => "stl",
        Geometry::MeshFile { format: MeshFormat::Serialized(_), .. } => "serialized",
        Geometry::Inline { .. } => "rectangle, cube, disk or cylinder",
        Geometry::Sphere { .. } => "sphere",
        Geometry::IsoSurface { .. } => "surface of a volume",
    }
}

fn texture(kind: &TextureKind) -> &'static str {
    match kind {
        TextureKind::Image { .. } => "image",
        TextureKind::Checkerboard(_) => "checkerboard",
        TextureKind::Attribute { .. } => "mesh attribute",
    }
}

fn material(material: &Material) -> &'static str {
    match &material.detail {
        Some(detail) if detail.blend.is_some() => return "blend",
        Some(detail) if detail.opacity == Amount::Constant(0.0) => return "null",
        _ => {}
    }
    match material.bsdf {
        Bsdf::Diffuse { .. } => "diffuse",
        Bsdf::Conductor { .. } => "conductor",
        Bsdf::RoughConductor { .. } => "rough conductor",
        Bsdf::Dielectric { .. } => "dielectric",
        Bsdf::ThinDielectric { .. } => "thin dielectric",
        Bsdf::RoughDielectric { .. } => "rough dielectric",
        Bsdf::Plastic { .. } => "plastic",
        Bsdf::RoughPlastic { .. } => "rough plastic",
        Bsdf::Phong { .. } => "phong",
        Bsdf::Principled(_) => "principled",
    }
}
