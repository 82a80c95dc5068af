//! Ctrl-C and SIGTERM: a render ends between two commits; everything else ends at once. Temporary folders go either way.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU8, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

/// Exit code of the signal that came; 0 for none.
static CODE: AtomicU8 = AtomicU8::new(0);
/// Renders that look at [`requested`].
static HEEDING: AtomicUsize = AtomicUsize::new(0);
static FOLDERS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Looks out for signals from now on. Where they cannot be caught, they end the process as ever.
pub fn install() {
    let caught = Signals::new([SIGINT, SIGTERM]).and_then(|mut signals| {
        let watch = std::thread::Builder::new().name("signals".into());
        // as shells have it: 128 and the signal's number
        watch.spawn(move || signals.forever().for_each(|signal| came(128 + signal as u8)))
    });
    if let Err(e) = caught {
        tracing::warn!("Ctrl-C cannot be caught and leaves temporary folders behind: {e}");
    }
}

fn came(code: u8) {
    if HEEDING.load(Ordering::SeqCst) > 0 && CODE.swap(code, Ordering::SeqCst) == 0 {
        eprintln!("stopping; once more to stop at once");
        return;
    }
    for folder in FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
        // the system clears what is left when it clears its temporary files
        let _ = std::fs::remove_dir_all(folder);
    }
    std::process::exit(code.into());
}

/// A render that looks at [`requested`], until it is dropped.
pub struct Heeding(());

impl Heeding {
    /// From now on.
    pub fn begin() -> Self {
        HEEDING.fetch_add(1, Ordering::SeqCst);
        Heeding(())
    }
}

impl Drop for Heeding {
    fn drop(&mut self) {
        HEEDING.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Whether a signal asks for the end.
pub fn requested() -> bool {
    code().is_some()
}

/// Exit code for the signal that came, if one did.
pub fn code() -> Option<u8> {
    Some(CODE.load(Ordering::SeqCst)).filter(|&c| c != 0)
}

/// Has a folder removed when a signal ends the process at once.
pub fn remove_at_end(folder: &Path) {
    FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).push(folder.to_path_buf());
}
