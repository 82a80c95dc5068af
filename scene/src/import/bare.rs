//! Meshes and volumes without a scene around them: their own materials and colours, or one grey two-sided material; camera and light by
//! [`super::framing`].

use std::path::{Path, PathBuf};

use super::framing::{self, Up};
use super::isosurface::IsoSurfaceSource;
use super::mesh::extension;
use super::mtl::Libraries;
use super::passed_over::passed_over;
use super::{DEFAULT_ALBEDO, ImportOptions, inside, refuse};
use crate::ImportError;
use crate::description::{
    Affine, Bsdf, Description, Detail, Environment, Geometry, Material, MeshFormat, Note, Place, Shape, Slot, Texture,
    TextureKind, Textured,
};

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
            inside::check_entry(&path, folder)?;
            found.push((path, format));
        }
    }
    found.sort();
    Ok(found)
}

/// Meshes in this order, with their materials and colours if `looks`.
pub(super) fn meshes(
    path: &Path,
    files: &[(PathBuf, MeshFormat)],
    options: &ImportOptions,
    looks: bool,
) -> Result<(Description, Up), ImportError> {
    if options.iso.is_some() {
        return refuse(path, "an iso value was given, but a mesh is a surface already: leave it out");
    }
    let mut out = description(options);
    let mut unsupported = vec![];
    for (path, format) in files {
        let format = *format;
        let (mut attribute, mut parts, mut made) = (None, None, vec![]);
        // an albedo that was asked for is that of all
        let looks = looks && options.albedo.is_none();
        match format {
            MeshFormat::Obj if looks => {
                let head = super::obj::head(path)?;
                out.bytes_read += head.bytes_read;
                if let Some(text) = head.passed_over() {
                    let place = Place::line(path, head.line);
                    out.notes.push(Note { place, text: text.into() });
                }
                let folder = inside::folder_of(path)?;
                let mut libraries = Libraries { options, out: &mut out, unsupported: vec![], folder };
                let found = libraries.read(path, &head.libraries)?;
                (parts, made) = (Some(found.0), found.1);
                unsupported.append(&mut libraries.unsupported);
            }
            MeshFormat::Ply if looks => {
                let found = super::ply::looks(path)?;
                out.bytes_read += found.bytes_read;
                attribute = found.colors;
                let text = "the texture that the ply names is passed over: write an obj whose material has it, or a scene whose bsdf has it";
                out.notes.extend(found.texture.map(|place| Note { place, text: text.into() }));
            }
            MeshFormat::Stl if looks => {
                let head = passed_over(path, format);
                out.bytes_read += head.bytes_read;
                let place = Place::file(path);
                out.notes.extend(head.looks.iter().map(|&text| Note { place: place.clone(), text: text.into() }));
            }
            _ => {}
        }
        let colored = attribute.is_some();
        // texture coordinates of OBJ have v upwards
        let flip_v = format == MeshFormat::Obj;
        let geometry = Geometry::MeshFile { path: path.clone(), format, flip_v, smooth: false, attribute, parts };
        let material = if colored { color_material(&mut out) } else { 0 };
        out.shapes.push(Shape { material, ..shape(path, geometry) });
        for part in made {
            out.materials.push(part.material);
            out.shapes.push(Shape {
                name: part.name,
                place: part.place,
                material: out.materials.len() as u32 - 1,
                emission: part.emission,
                emission_texture: part.emission_texture,
                ..shape(path, Geometry::Part)
            });
        }
    }
    if !unsupported.is_empty() {
        return Err(ImportError::Unsupported(unsupported));
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

/// Number of the material whose albedo is the mesh's colour.
fn color_material(out: &mut Description) -> u32 {
    const NAME: &str = "colours";
    if let Some(n) = out.materials.iter().position(|m| m.name == NAME) {
        return n as u32;
    }
    let kind = TextureKind::Attribute { name: "color".into(), scale: 1.0 };
    out.textures.push(Texture { place: Place::default(), kind });
    let textured = vec![Textured::new(Slot::Diffuse, out.textures.len() as u32 - 1)];
    let bsdf = Bsdf::Diffuse { reflectance: DEFAULT_ALBEDO };
    let mut material = Material::new(NAME, bsdf, true);
    material.detail = Some(Box::new(Detail { textured, ..Detail::default() }));
    out.materials.push(material);
    out.materials.len() as u32 - 1
}

fn shape(path: &Path, geometry: Geometry) -> Shape {
    Shape {
        name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        place: Place::file(path),
        geometry,
        to_world: Affine::IDENTITY,
        material: 0,
        emission: None,
        emission_texture: None,
        flip_normals: false,
        face_normals: false,
    }
}
