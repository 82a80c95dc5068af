//! Real scenes made by others, in `shared/data` beside the clone: no part of the repository.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Unpacks a set into a folder; where it lies then. None if it is not there, which is said.
pub fn unpack(name: &str, folder: &Path) -> Option<PathBuf> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let archive = data.join(name).join(format!("{name}.tar.xz"));
    if !archive.exists() {
        println!("{} is absent: not tested", archive.display());
        return None;
    }
    let status = Command::new("tar").arg("xf").arg(&archive).arg("-C").arg(folder).status().unwrap();
    assert!(status.success(), "tar cannot unpack {}", archive.display());
    Some(folder.join(name))
}
