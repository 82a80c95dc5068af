//! Meshes and volumes without a scene around them: one grey two-sided material, camera and light by [`super::framing`].

use std::path::{Path, PathBuf};

use super::framing::{self, Up};
use super::isosurface::IsoSurfaceSource;
use super::mesh::extension;
use super::{DEFAULT_ALBEDO, ImportOptions, refuse};
use crate::ImportError;
use crate::description::{Affine, Bsdf, Description, Environment, Geometry, Material, MeshFormat, Place, Shape};

/// The mesh format that a file's name says.
pub(super) fn mesh_format(path: &Path) -> Option<MeshFormat> {
    match extension(path).as_str() {
        "ply" => Some(MeshFormat::Ply),
        "obj" => Some(MeshFormat::Obj),
        "stl" => Some(MeshFormat::Stl),
        _ => None,
    }
}

/// The meshes in a folder, by name (not in its subfolders).
pub(super) fn meshes_in(folder: &Path) -> Result<Vec<(PathBuf, MeshFormat)>, ImportError> {
    let io = |source| ImportError::Io { path: folder.into(), source };
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if let Some(format) = mesh_format(&path)
            && path.is_file()
        {
            found.push((path, format));
        }
    }
    found.sort();
    Ok(found)
}

/// Meshes in this order.
pub(super) fn meshes(
    path: &Path,
    files: &[(PathBuf, MeshFormat)],
    options: &ImportOptions,
) -> Result<(Description, Up), ImportError> {
    if options.iso.is_some() {
        return refuse(path, "an iso value was given, but a mesh is a surface already: leave it out");
    }
    let mut out = description(options);
    for (path, format) in files {
        let geometry = Geometry::MeshFile { path: path.clone(), format: *format, flip_v: false, smooth: false };
        out.shapes.push(shape(path, geometry));
    }
    let up = if files.iter().all(|(_, format)| *format == MeshFormat::Stl) { Up::Z } else { Up::Y };
    Ok((out, up))
}

/// A volume's surface.
pub(super) fn volume(path: &Path, options: &ImportOptions) -> Result<(Description, Up), ImportError> {
    let Some(iso) = options.iso else {
        return refuse(
            path,
            "a volume has no surface of its own: pass --iso VALUE (for CT in HU; 300 is bone, -300 is skin)",
        );
    };
    let source = IsoSurfaceSource::new(path, iso)?;
    let mut out = description(options);
    // the box of the samples is known without a pass over them
    out.bounds = Some(source.world_box());
    out.bytes_read += source.file().header_bytes();
    out.shapes.push(shape(path, Geometry::IsoSurface { path: path.into(), iso }));
    Ok((out, Up::Z))
}

fn description(options: &ImportOptions) -> Description {
    let bsdf = Bsdf::Diffuse { reflectance: options.albedo.unwrap_or(DEFAULT_ALBEDO) };
    Description {
        materials: vec![Material::new("surface", bsdf, true)],
        environment: Some(Environment::Constant(framing::SKY)),
        size: Some(options.size.unwrap_or(framing::SIZE)),
        ..Description::default()
    }
}

fn shape(path: &Path, geometry: Geometry) -> Shape {
    Shape {
        name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        place: Place { file: path.into(), line: 0 },
        geometry,
        to_world: Affine::IDENTITY,
        material: 0,
        emission: None,
        flip_normals: false,
        face_normals: false,
    }
}
