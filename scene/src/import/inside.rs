//! Files that a scene names lie in its folder, links followed: so that a scene from elsewhere reads nothing else of a machine, and tells
//! nothing of it in an error.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use crate::ImportError;
use crate::description::Place;

/// The folder in which everything lies that a file names: that of the file itself, where links lead.
pub(super) fn folder_of(file: &Path) -> Result<PathBuf, ImportError> {
    let canonical = file.canonicalize().map_err(|source| ImportError::Io { path: file.into(), source })?;
    Ok(canonical.parent().map(Path::to_path_buf).unwrap_or_default())
}

/// Refuses a file that does not lie in the canonical `folder`, and is named so at `place`. One that cannot be found passes.
pub(super) fn check(path: &Path, folder: &Path, name: impl Display, place: &Place) -> Result<(), ImportError> {
    let Ok(canonical) = path.canonicalize() else { return Ok(()) };
    if canonical.starts_with(folder) {
        return Ok(());
    }
    let folder = folder.display();
    let message =
        format!("file \"{name}\" lies outside the scene's folder {folder}; only files inside are read: copy it there");
    Err(ImportError::Malformed { place: place.clone(), message })
}

/// Refuses an entry of a folder that is read whole, if it is a link that leads to a file outside.
pub(super) fn check_entry(path: &Path, folder: &Path) -> Result<(), ImportError> {
    if !path.is_symlink() || !path.is_file() {
        return Ok(());
    }
    let io = |source| ImportError::Io { path: folder.into(), source };
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    check(path, &folder.canonicalize().map_err(io)?, name, &Place::file(path))
}
