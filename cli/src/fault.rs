//! Whose fault an error is, and how it is told.

use std::cell::Cell;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};

use rayherd_herd::job::JobError;
use rayherd_herd::store::{StoreError, object_is_users};
use rayherd_scene::ImportError;
use rayherd_scene::manifest::ManifestError;
use rayherd_scene::prepare::PrepareError;
use rayherd_scene::tools::ToolError;

/// Something that the user can put right. The message says what and where, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Mistake(pub String);

/// Whether a signal ended it.
pub fn is_interrupted(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| matches!(cause.downcast_ref(), Some(JobError::Cancelled)))
}

/// 2 when the user can put it right, 1 when it is ours or the machine's.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    if error.chain().any(is_users) { 2 } else { 1 }
}

fn is_users(cause: &(dyn std::error::Error + 'static)) -> bool {
    cause.is::<Mistake>()
        || cause.downcast_ref().is_some_and(import_is_users)
        || cause.downcast_ref().is_some_and(object_is_users)
        || cause.downcast_ref().is_some_and(|e| match e {
            // transparent errors do not show in the chain themselves
            PrepareError::Import(e) => import_is_users(e),
            PrepareError::Store(e) => object_is_users(e),
            PrepareError::Settings(_)
            | PrepareError::Empty { .. }
            | PrepareError::Dark { .. }
            | PrepareError::Build { .. }
            | PrepareError::TooManySplits(_) => true,
            PrepareError::Inconsistent(_) | PrepareError::Spool { .. } => false,
        })
        || cause.downcast_ref().is_some_and(JobError::is_users)
        || cause.downcast_ref().is_some_and(StoreError::is_users)
        || cause.downcast_ref().is_some_and(|e| match e {
            ToolError::Import(e) => import_is_users(e),
            ToolError::Write { source, .. } => is_wrong_path(source),
            ToolError::Refused(_) => true,
        })
        || cause.downcast_ref().is_some_and(|e| match e {
            ManifestError::Malformed(_) | ManifestError::Format { .. } => true,
            ManifestError::Store(e) => object_is_users(e),
        })
}

fn import_is_users(error: &ImportError) -> bool {
    match error {
        ImportError::Io { source, .. } => is_wrong_path(source),
        ImportError::Malformed { .. } | ImportError::Unsupported(_) | ImportError::Limit { .. } => true,
    }
}

fn is_wrong_path(error: &io::Error) -> bool {
    use io::ErrorKind::*;
    matches!(error.kind(), NotFound | PermissionDenied | NotADirectory | IsADirectory | InvalidInput | InvalidFilename)
}

/// An error and its causes in one line; a cause that the text before it tells already is left out.
pub fn tell(error: &anyhow::Error) -> String {
    let mut told = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if told.is_empty() {
            told = cause;
        } else if !told.contains(&cause) {
            told = format!("{told}: {cause}");
        }
    }
    told
}

thread_local! {
    static OTHERS: Cell<bool> = const { Cell::new(false) };
}

/// Runs a library's code that panics on some bad input; the panic's message, untold, when it does. `run` must start no thread: a panic
/// there is not caught.
pub fn of_others<T>(run: impl FnOnce() -> T) -> Result<T, String> {
    OTHERS.set(true);
    // nothing that `run` changes is seen after a panic but by its owner's drop
    let result = catch_unwind(AssertUnwindSafe(run));
    OTHERS.set(false);
    result.map_err(|what| {
        let text = what.downcast_ref::<String>().map(String::as_str).or(what.downcast_ref::<&str>().copied());
        text.unwrap_or("no message").to_owned()
    })
}

/// Prints a panic as one short message that says how to report it. The process must then exit with 1.
pub fn install_panic_hook() {
    let backtrace = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if OTHERS.get() {
            return;
        }
        if std::env::var_os("RUST_BACKTRACE").is_some() {
            backtrace(info);
        }
        let what = info.payload_as_str().unwrap_or("no message");
        let place = info.location().map(|l| format!(" at {}:{}", l.file(), l.line())).unwrap_or_default();
        eprintln!(
            "error: rayherd has a defect: {what}{place}\n\
             please report it with the command, the scene and the output of the same command with RUST_BACKTRACE=1"
        );
    }));
}

#[cfg(test)]
mod tests {
    use anyhow::Context;

    use super::*;

    #[test]
    fn a_panic_of_others_is_an_error() {
        assert_eq!(of_others(|| 1), Ok(1));
        assert_eq!(of_others(|| -> i32 { panic!("no {}", 2) }), Err("no 2".to_owned()));
        assert!(!OTHERS.get());
    }

    #[test]
    fn causes_are_told_once_and_faults_are_told_apart() {
        let missing = || io::Error::from(io::ErrorKind::NotFound);
        let error = ImportError::Io { path: "a.xml".into(), source: missing() };
        let error = anyhow::Error::new(error).context("cannot prepare a.xml");
        assert_eq!(tell(&error), "cannot prepare a.xml: cannot read a.xml: entity not found");
        assert_eq!(exit_code(&error), 2);
        let transparent = PrepareError::Import(ImportError::Io { path: "a.ply".into(), source: missing() });
        assert_eq!(exit_code(&transparent.into()), 2);
        assert_eq!(exit_code(&Mistake("no".into()).into()), 2);
        assert_eq!(exit_code(&anyhow::Error::new(missing())), 1);
        let error = Err::<(), _>(io::Error::other("disk on fire")).context("cannot write").unwrap_err();
        assert_eq!((tell(&error).as_str(), exit_code(&error)), ("cannot write: disk on fire", 1));
    }
}
