//! Running the built binary.
#![allow(dead_code, reason = "each test file uses its own part of this")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// What a run said.
pub struct Run {
    /// Exit status.
    pub code: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

/// Runs `rayherd` in a folder.
pub fn rayherd(folder: &Path, arguments: &[&str]) -> Run {
    let output: Output = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(arguments)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .env_remove("RUST_BACKTRACE")
        .output()
        .expect("the binary starts");
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).expect("UTF-8");
    let code = output.status.code().expect("it exits, not by a signal");
    Run { code, out: text(&output.stdout), err: text(&output.stderr) }
}

/// Asserts that a run ended with a user's mistake, told in one message that holds `parts`.
#[track_caller]
pub fn assert_mistake(run: &Run, parts: &[&str]) {
    assert_eq!(run.code, 2, "{}", run.err);
    assert!(run.err.starts_with("error: "), "{}", run.err);
    assert!(!run.err.contains("panicked") && !run.err.contains("defect"), "{}", run.err);
    for part in parts {
        assert!(run.err.contains(part), "no {part:?} in: {}", run.err);
    }
}

/// A file of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}
