//! Reading scenes: a file or folder of any supported format to a [`Description`], and its records.

mod bare;
mod bounds;
mod framing;
mod inside;
pub mod isosurface;
mod mesh;
mod metals;
mod mitsuba;
mod mtl;
mod number;
mod obj;
mod options;
mod passed_over;
mod placement;
mod ply;
mod refraction;
pub(crate) mod regular;
mod serialized;
mod shapes;
mod sight;
mod sky;
mod skylight;
mod source;
mod spill;
mod stl;
mod stream;
mod survey;
pub(crate) mod vector;
pub mod volume;

use std::io::Read;
use std::path::Path;

pub use bounds::bounds;
pub use options::{
    CameraView, DEFAULT_ALBEDO, ImportOptions, Light, OptionError, parse_albedo, parse_define, parse_radiance,
};
pub use placement::Placement;
pub use sight::Sight;
pub use sky::sky_map;
pub(crate) use sky::to_map;
pub(crate) use skylight::PICTURE_TO_SKY;
pub(crate) use spill::temporary_file;
pub use stream::{DescriptionSource, StreamOptions};
pub use survey::{ShapeSurvey, Survey};

use crate::ImportError;
use crate::description::{Bsdf, Description, Environment, Material, MeshFormat, Place};
use framing::Up;

/// What a path holds.
enum Kind {
    Mitsuba,
    Mesh(MeshFormat),
    Volume,
    /// Meshes, or a DICOM series.
    Folder,
}

/// Reads a scene: a Mitsuba XML file, a mesh (PLY, OBJ, STL, also `.gz`), a folder of meshes, or with `options.iso` a volume.
///
/// # Errors
/// The file cannot be read, is malformed, has elements that are not supported (all are listed), or gives no light.
pub fn import(path: &Path, options: &ImportOptions) -> Result<Description, ImportError> {
    let (mut out, up, bare) = read(path, options, true)?;
    place_camera(path, &mut out, up, bare, options)?;
    if let Some(sky) = options.sky {
        out.environment = Some(Environment::Constant(sky));
        out.sun = None;
    }
    out.environment = out.environment.filter(|sky| match sky {
        Environment::Constant(rgb) => rgb.iter().any(|v| *v > 0.0),
        Environment::Map { .. } | Environment::Sky(_) => true,
    });
    let far = out.environment.is_some() || out.sun.is_some();
    if !far && out.beams.is_empty() && out.shapes.iter().all(|s| s.emission.is_none()) {
        return refuse(
            path,
            "nothing in this scene emits light, its image is black: add an emitter, or pass --light or --sky",
        );
    }
    Ok(out)
}

/// Reads the shapes of a scene as they are: no camera or light is added, and none is asked for; nor are a mesh's materials and colours.
///
/// # Errors
/// As [`import`], but for light.
pub fn import_surface(path: &Path, options: &ImportOptions) -> Result<Description, ImportError> {
    Ok(read(path, options, false)?.0)
}

/// What the source says, which way is up, and whether it is a surface without a scene. `looks`: with what a mesh says of its materials and
/// colours.
fn read(path: &Path, options: &ImportOptions, looks: bool) -> Result<(Description, Up, bool), ImportError> {
    let (kind, head) = kind(path)?;
    let bare = !matches!(kind, Kind::Mitsuba);
    if bare && !options.defines.is_empty() {
        return refuse(path, "a value of a name was given, but only an XML scene has names: leave -D out");
    }
    let (mut out, up) = match kind {
        Kind::Mitsuba => {
            for (given, name) in [(options.iso.is_some(), "an iso value"), (options.albedo.is_some(), "an albedo")] {
                if given {
                    return refuse(
                        path,
                        format!("{name} was given, but an XML scene has its own surfaces: leave it out"),
                    );
                }
            }
            (mitsuba::import(path, options)?, Up::Y)
        }
        Kind::Mesh(format) => bare::meshes(path, &[(path.to_path_buf(), format)], options, looks)?,
        Kind::Volume => bare::volume(path, options)?,
        Kind::Folder => match bare::meshes_in(path)? {
            meshes if meshes.is_empty() && options.iso.is_none() => {
                return refuse(
                    path,
                    "no .ply, .obj or .stl in this folder; if it holds a DICOM series, pass --iso VALUE, if a scene, name its file",
                );
            }
            meshes if meshes.is_empty() => bare::volume(path, options)?,
            meshes => bare::meshes(path, &meshes, options, looks)?,
        },
    };
    if out.shapes.is_empty() {
        let left_out: Vec<String> =
            out.substitutions.iter().map(|s| format!("; left out: {}: {}", s.place, s.what)).collect();
        return refuse(path, format!("the scene has no shapes: there is nothing to render{}", left_out.concat()));
    }
    out.bytes_read += head;
    Ok((out, up, bare))
}

/// The camera that was asked for, or one that frames the scene if it has none; and the lights.
fn place_camera(
    path: &Path,
    out: &mut Description,
    up: Up,
    bare: bool,
    options: &ImportOptions,
) -> Result<(), ImportError> {
    if let Some(view) = &options.camera {
        out.camera = Some(view.camera().or_else(|e| refuse(path, e.to_string()))?);
    }
    let mut lights = options.lights.clone();
    // a mesh whose materials shine has its own
    let wants_lights = bare && lights.is_empty() && out.shapes.iter().all(|s| s.emission.is_none());
    if out.camera.is_none() || wants_lights {
        let bounds = match out.bounds {
            Some(bounds) => bounds,
            None => bounds::measure(out)?,
        };
        let size = *out.size.get_or_insert(options.size.unwrap_or(framing::SIZE));
        let Some(frame) = framing::frame(bounds, up, size) else {
            return refuse(
                path,
                "no primitive with finite vertices and an extent: there is nothing to look at; check its transforms and its scale",
            );
        };
        if out.camera.is_none() {
            tracing::info!("the source has no camera; one is placed to frame it");
            out.camera = Some(frame.camera);
        }
        if wants_lights {
            lights.extend(frame.lights);
        }
        out.bounds = Some(bounds);
    }
    if lights.is_empty() {
        return Ok(());
    }
    let material = out.materials.len() as u32;
    let black = Bsdf::Diffuse { reflectance: [0.0; 3] };
    out.materials.push(Material::new("light", black, false));
    for (i, light) in lights.iter().enumerate() {
        let Some(shape) = light.shape(format!("light-{}", i + 1), material) else {
            return refuse(path, format!("light {} has no direction: its origin and target are one point", i + 1));
        };
        if let Some(bounds) = &mut out.bounds {
            bounds::add_corners(bounds, &shape);
        }
        out.shapes.push(shape);
    }
    Ok(())
}

/// Tells what a path holds, by its content where that says it, else by its name; and the bytes read for it.
fn kind(path: &Path) -> Result<(Kind, u64), ImportError> {
    let io = |source| ImportError::Io { path: path.into(), source };
    let metadata = std::fs::metadata(path).map_err(io)?;
    if metadata.is_dir() {
        return Ok((Kind::Folder, 0));
    }
    let mut head = vec![];
    regular::open(path).and_then(|(file, _)| file.take(256).read_to_end(&mut head)).map_err(io)?;
    if head.is_empty() {
        return refuse(path, "the file is empty");
    }
    Ok((kind_of(path, &head)?, head.len() as u64))
}

/// What a file holds that begins with `head`.
fn kind_of(path: &Path, head: &[u8]) -> Result<Kind, ImportError> {
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    if text.starts_with(b"<") {
        return Ok(Kind::Mitsuba);
    }
    if head.starts_with(b"ply") && head.get(3).is_some_and(u8::is_ascii_whitespace) {
        return Ok(Kind::Mesh(MeshFormat::Ply));
    }
    if head.starts_with(b"NRRD") {
        return Ok(Kind::Volume);
    }
    if let Some(format) = bare::mesh_format(path) {
        return Ok(Kind::Mesh(format));
    }
    match mesh::extension(path).as_str() {
        "xml" => Ok(Kind::Mitsuba),
        "nrrd" | "nhdr" | "nii" | "hdr" | "dcm" | "ima" => Ok(Kind::Volume),
        _ if text.starts_with(b"solid") => Ok(Kind::Mesh(MeshFormat::Stl)),
        _ => refuse(
            path,
            "this is no scene that can be read: Mitsuba .xml, .ply, .obj, .stl, a folder of meshes, or a volume (.nrrd, .nhdr, \
             .nii, .nii.gz, a DICOM folder)",
        ),
    }
}

/// An error about the source as a whole.
fn refuse<T>(path: &Path, message: impl Into<String>) -> Result<T, ImportError> {
    Err(ImportError::Malformed { place: Place::file(path), message: message.into() })
}

#[cfg(test)]
mod tests;
