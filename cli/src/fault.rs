//! Whose fault an error is, and how it is told.

use std::io;

use rayherd_scene::ImportError;

/// Something that the user can put right. The message says what and where, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Mistake(pub String);

/// 2 when the user can put it right, 1 when it is ours or the machine's.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    let theirs = error.chain().any(|cause| {
        cause.is::<Mistake>()
            || cause.downcast_ref::<ImportError>().is_some_and(|e| match e {
                ImportError::Io { source, .. } => is_wrong_path(source),
                ImportError::Malformed { .. } | ImportError::Unsupported(_) | ImportError::Limit { .. } => true,
            })
    });
    if theirs { 2 } else { 1 }
}

fn is_wrong_path(error: &io::Error) -> bool {
    use io::ErrorKind::*;
    matches!(error.kind(), NotFound | PermissionDenied | NotADirectory | IsADirectory | InvalidInput | InvalidFilename)
}

/// Prints a panic as one short message that says how to report it. The process must then exit with 1.
pub fn install_panic_hook() {
    let backtrace = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
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
