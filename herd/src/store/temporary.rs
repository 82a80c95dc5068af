//! Folders that go with their value, and that the next run removes where a signal left them.

use std::fs::{self, File};
use std::path::Path;

use tempfile::TempDir;

use super::StoreError;

/// How the names of all such folders begin.
const PREFIX: &str = "rayherd-";
/// A file in each, locked as long as its process lives.
const LOCK: &str = ".lock";
/// Attempts to make one, should somebody remove it before it is locked.
const ATTEMPTS: u32 = 8;

/// A folder in the system's place for such (`TMPDIR`) that goes with the value.
pub struct TemporaryFolder {
    folder: TempDir,
    // the system drops the lock with the process, however it ends
    _lock: File,
}

impl TemporaryFolder {
    /// A new one, its name told from others' by `what`. Folders of processes that were killed are removed first.
    ///
    /// # Errors
    /// When the system's place has no room, or may not be written to.
    pub fn new(what: &str) -> Result<Self, StoreError> {
        let place = std::env::temp_dir();
        sweep(&place);
        let cannot = |e: std::io::Error| StoreError::Misconfigured {
            store: place.display().to_string(),
            message: format!("cannot make a temporary folder: {e}; set TMPDIR to a folder with room"),
        };
        for _ in 0..ATTEMPTS {
            let folder =
                tempfile::Builder::new().prefix(&format!("{PREFIX}{what}")).tempdir_in(&place).map_err(cannot)?;
            let path = folder.path().join(LOCK);
            let Ok(lock) = File::create_new(&path) else { continue };
            lock.lock().map_err(cannot)?;
            // somebody who swept may have been faster
            if path.exists() {
                return Ok(TemporaryFolder { folder, _lock: lock });
            }
        }
        Err(cannot(std::io::Error::other("others remove it at once")))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// Removes folders whose process is gone. What cannot be looked at or removed stays: it is somebody else's.
fn sweep(place: &Path) {
    let Ok(entries) = fs::read_dir(place) else { return };
    for entry in entries.flatten().filter(|e| e.file_name().to_string_lossy().starts_with(PREFIX)) {
        let Ok(lock) = File::options().write(true).open(entry.path().join(LOCK)) else { continue };
        if lock.try_lock().is_ok() {
            tracing::info!("{}: left by a process that is gone, removed", entry.path().display());
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_dead_process_left_goes_and_what_lives_stays() {
        let place = tempfile::tempdir().unwrap();
        let folder = |name: &str| {
            let path = place.path().join(name);
            fs::create_dir(&path).unwrap();
            fs::write(path.join("block"), "x").unwrap();
            path
        };
        let (dead, live, unlocked, other) =
            (folder("rayherd-a"), folder("rayherd-b"), folder("rayherd-c"), folder("other"));
        for f in [&dead, &live, &other] {
            fs::write(f.join(LOCK), "").unwrap();
        }
        let lock = File::open(live.join(LOCK)).unwrap();
        lock.lock().unwrap();
        sweep(place.path());
        assert_eq!([&dead, &live, &unlocked, &other].map(|f| f.exists()), [false, true, true, true]);
        drop(lock);
        sweep(place.path());
        assert!(!live.exists());
        // one of this process stays while its value does
        let mine = TemporaryFolder::new("test-").unwrap();
        let path = mine.path().to_path_buf();
        sweep(&std::env::temp_dir());
        assert!(path.is_dir());
        drop(mine);
        assert!(!path.exists());
    }
}
