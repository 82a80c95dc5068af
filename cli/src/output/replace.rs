//! Replacing a file whole: readers see the old one or the new one, and a failure leaves the old one.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};

use crate::fault::Mistake;

/// Whether `path`, which `flag` names, can be replaced, found out before any work is done: a file is made beside it and removed again.
pub fn probe(path: &Path, flag: &str) -> anyhow::Result<()> {
    if path.is_dir() {
        return Err(Mistake(format!("cannot write {}: it is a folder; name a file", path.display())).into());
    }
    if is_device(path) {
        return Ok(());
    }
    let temporary = beside(path);
    let made = create(&temporary).and_then(|_| fs::remove_file(&temporary));
    made.map_err(|e| Mistake(format!("cannot write {}: {e}; choose another place with {flag}", path.display())).into())
}

/// [`probe`] for a file that is written piece by piece and then named: nothing else can be.
pub fn probe_file(path: &Path, flag: &str) -> anyhow::Result<()> {
    if is_device(path) {
        return Err(Mistake(format!("cannot write {}: it is no file; name one with {flag}", path.display())).into());
    }
    probe(path, flag)
}

/// Whether something is there that takes bytes but is no file: a device, a pipe, a socket. It must not be replaced by one.
fn is_device(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir())
}

/// Replaces `path` by `bytes`, on the disk when it returns; a device or a pipe is written to.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if is_device(path) {
        return OpenOptions::new().write(true).open(path)?.write_all(bytes);
    }
    let temporary = beside(path);
    let written = create(&temporary)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&temporary, path));
    if written.is_err() {
        // the first error is the one that matters; the file may not even exist
        let _ = fs::remove_file(&temporary);
    }
    written
}

/// Replaces `path` by `bytes`, or else writes them to the first place that takes them: the working folder, then the
/// system's folder for temporary files. An error always says where the bytes are, if anywhere.
pub fn replace_or_keep(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    replace_or_keep_in(path, bytes, &[PathBuf::from("."), std::env::temp_dir()])
}

fn replace_or_keep_in(path: &Path, bytes: &[u8], fallbacks: &[PathBuf]) -> anyhow::Result<()> {
    let Err(error) = replace(path, bytes) else { return Ok(()) };
    let name = path.file_name().context("an output without a name")?;
    let kept = fallbacks.iter().find_map(|folder| {
        let mut kept = folder.join(name).into_os_string();
        kept.push(format!(".{}", std::process::id()));
        replace(Path::new(&kept), bytes).is_ok().then(|| PathBuf::from(kept))
    });
    Err(match kept {
        Some(kept) => anyhow!("cannot write {}: {error}; it was written to {} instead", path.display(), kept.display()),
        None => anyhow!(
            "cannot write {}: {error}; there was no room for it in {} either: free some and render again",
            path.display(),
            fallbacks.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(" or ")
        ),
    })
}

/// The file that becomes `path`: in the same folder, so that renaming is atomic, and hidden while it is half done.
fn beside(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{}.tmp", std::process::id()))
}

fn create(path: &Path) -> io::Result<File> {
    // one left by a process of the same number that was killed may be there
    match fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    OpenOptions::new().write(true).create_new(true).open(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_stays_a_device() {
        let device = Path::new("/dev/full");
        if !is_device(device) {
            eprintln!("this system has no /dev/full: not tested");
            return;
        }
        probe(device, "-o").unwrap();
        assert_eq!(replace(device, b"x").unwrap_err().kind(), io::ErrorKind::StorageFull);
        assert!(is_device(device));
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(device, &link).unwrap();
        assert!(replace(&link, b"x").is_err());
        assert_eq!(names(folder.path()), ["link"]);
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_replaced_whole_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        probe(&path, "-o").unwrap();
        assert_eq!(names(folder.path()), [""; 0]);
        replace(&path, b"one").unwrap();
        replace(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(names(folder.path()), ["a.exr"]);
    }

    #[test]
    fn what_cannot_be_written_is_found_before_and_kept_after() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("none/a.exr");
        assert!(probe(&missing, "--report").unwrap_err().to_string().contains("another place with --report"));
        assert!(probe(folder.path(), "-o").unwrap_err().to_string().contains("it is a folder"));

        let fallback = folder.path().to_path_buf();
        let error = replace_or_keep_in(&missing, b"film", &[missing.clone(), fallback]).unwrap_err().to_string();
        let kept = names(folder.path()).into_iter().find(|n| n.starts_with("a.exr.")).unwrap();
        assert!(error.contains(&kept), "{error}");
        assert_eq!(fs::read(folder.path().join(kept)).unwrap(), b"film");

        let error = replace_or_keep_in(&missing, b"film", std::slice::from_ref(&missing)).unwrap_err().to_string();
        assert!(error.contains("no room"), "{error}");
        // a failed rename leaves no temporary file
        fs::create_dir(folder.path().join("taken")).unwrap();
        assert!(replace(&folder.path().join("taken"), b"film").is_err());
        assert!(names(folder.path()).iter().all(|n| !n.ends_with(".tmp")));
    }
}
