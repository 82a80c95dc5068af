//! Which source a scene was prepared from, found out without reading it.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::time::UNIX_EPOCH;

use crate::ImportError;
use crate::description::{Description, Environment, Geometry, Place, TextureKind};
use crate::objects::ObjectHash;

/// Fingerprint of a source: the hash of its description, but for what [`crate::manifest::Defaults`] holds of it, and, for every file it names (for a folder: every file in
/// it), of path, size and time of last change in nanoseconds.
///
/// Sizes and times, not contents, as `make` does: hashing contents would be a third read of a scene that may be
/// larger than this machine, only to learn that there is nothing to do. The price: a file that was touched or copied
/// is prepared again (into the same objects), and one that was changed within the clock's step, keeping its size, is
/// not noticed. What the picture is made of has its own hash: [`crate::manifest::Manifest::content`].
pub fn fingerprint(description: &Description) -> Result<ObjectHash, ImportError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"rayherd source\0");
    // what the source says about camera, film and paths makes no difference to what is prepared, and follows options such as a size
    let scene = Description {
        camera: None,
        size: None,
        filter: None,
        spp: None,
        max_depth: None,
        rr_depth: None,
        ..description.clone()
    };
    hasher.update(&serde_json::to_vec(&scene).map_err(|e| ImportError::Limit {
        place: Place::default(),
        message: format!("the description cannot be written down: {e}"),
    })?);
    for file in source_files(description) {
        add(&mut hasher, file, true)?;
    }
    Ok(ObjectHash(*hasher.finalize().as_bytes()))
}

/// Files and folders that a description names: meshes, volumes, pictures.
pub fn source_files(description: &Description) -> BTreeSet<&Path> {
    let shapes = description.shapes.iter().filter_map(|shape| match &shape.geometry {
        Geometry::MeshFile { path, .. } | Geometry::IsoSurface { path, .. } => Some(path.as_path()),
        Geometry::Inline { .. } | Geometry::Sphere { .. } | Geometry::Part => None,
    });
    let textures = description.textures.iter().filter_map(|texture| match &texture.kind {
        TextureKind::Image { path, .. } => Some(path.as_path()),
        TextureKind::Checkerboard(_) | TextureKind::Attribute { .. } => None,
    });
    let sky = match &description.environment {
        Some(Environment::Map { path, .. }) => Some(path.as_path()),
        _ => None,
    };
    shapes.chain(textures).chain(sky).collect()
}

/// Adds a file, or the files of a folder.
fn add(hasher: &mut blake3::Hasher, path: &Path, enter: bool) -> Result<(), ImportError> {
    let io = |source| ImportError::Io { path: path.to_owned(), source };
    let meta = fs::metadata(path).map_err(io)?;
    // lengths first, so that no two lists of files look the same
    let name = path.as_os_str().as_encoded_bytes();
    hasher.update(&(name.len() as u64).to_le_bytes()).update(name);
    if meta.is_dir() {
        if !enter {
            return Ok(());
        }
        let mut inside = Vec::new();
        for entry in fs::read_dir(path).map_err(io)? {
            inside.push(entry.map_err(io)?.path());
        }
        inside.sort();
        hasher.update(&(inside.len() as u64).to_le_bytes());
        return inside.iter().try_for_each(|p| add(hasher, p, false));
    }
    let changed = meta.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    hasher.update(&meta.len().to_le_bytes());
    hasher.update(&changed.map_or(0, |t| t.as_nanos()).to_le_bytes());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::{Affine, MeshFormat, Place, Shape};

    #[test]
    fn it_changes_with_the_description_and_with_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        fs::write(&path, b"one").unwrap();
        let mut description = Description {
            shapes: vec![Shape {
                name: "a".to_owned(),
                place: Place::default(),
                geometry: Geometry::MeshFile {
                    path: path.clone(),
                    format: MeshFormat::Ply,
                    flip_v: false,
                    smooth: false,
                    attribute: None,
                    parts: None,
                },
                to_world: Affine::IDENTITY,
                material: 0,
                emission: None,
                emission_texture: None,
                flip_normals: false,
                face_normals: false,
            }],
            ..Default::default()
        };
        let first = fingerprint(&description).unwrap();
        assert_eq!(fingerprint(&description).unwrap(), first);
        fs::write(&path, b"three").unwrap();
        let second = fingerprint(&description).unwrap();
        assert_ne!(second, first);
        description.size = Some([4, 4]);
        description.spp = Some(4);
        assert_eq!(fingerprint(&description).unwrap(), second, "the picture is not the scene");
        description.shapes[0].flip_normals = true;
        assert_ne!(fingerprint(&description).unwrap(), second);
        // a folder stands for its files
        description.shapes[0].geometry = Geometry::IsoSurface { path: folder.path().to_owned(), iso: 1.0 };
        let third = fingerprint(&description).unwrap();
        fs::write(folder.path().join("b"), b"").unwrap();
        assert_ne!(fingerprint(&description).unwrap(), third);
        description.shapes[0].geometry = Geometry::IsoSurface { path: folder.path().join("none"), iso: 1.0 };
        assert!(matches!(fingerprint(&description), Err(ImportError::Io { .. })));
    }
}
