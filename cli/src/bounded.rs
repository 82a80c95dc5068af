//! Reading small files whole: never more than they may have.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::fault::Mistake;

/// The content of a file of at most `most` bytes; `remedy` is told about a larger one. A pipe is read as well: whoever names one
/// fills it.
pub fn read(path: &Path, most: u64, remedy: &str) -> Result<Vec<u8>, Mistake> {
    let failed = |e| Mistake(format!("cannot read {}: {e}", path.display()));
    let too_long = || Mistake(format!("{} has more than {most} bytes: {remedy}", path.display()));
    let file = File::open(path).map_err(failed)?;
    // before memory is taken for any of it
    if file.metadata().is_ok_and(|m| m.is_file() && m.len() > most) {
        return Err(too_long());
    }
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 > most { Err(too_long()) } else { Ok(bytes) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_too_long_is_not_read_to_its_end() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, b"12345678").unwrap();
        assert_eq!(read(&path, 8, "").unwrap(), b"12345678");
        let error = read(&path, 7, "make it shorter").unwrap_err().to_string();
        assert!(error.contains("more than 7 bytes: make it shorter"), "{error}");
        // without an end
        assert!(read(Path::new("/dev/zero"), 1 << 16, "x").is_err());
        assert!(read(folder.path(), 8, "").unwrap_err().to_string().contains("cannot read"));
    }
}
