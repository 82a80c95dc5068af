//! The one door to the files of a source: regular files only. Opening a pipe waits for a writer that may never come, and a
//! device has no end.

use std::fs::{File, Metadata};
use std::io;
use std::path::Path;

/// Opens a regular file for reading.
///
/// # Errors
/// Those of the operating system, and one of kind `InvalidInput` for everything that is no regular file.
pub(crate) fn open(path: &Path) -> io::Result<(File, Metadata)> {
    let metadata = std::fs::metadata(path)?;
    if !metadata.is_file() {
        return Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            "not a regular file: copy what it holds into a file, and name that",
        ));
    }
    Ok((File::open(path)?, metadata))
}
