//! Running the built binary.
#![allow(dead_code, reason = "each test file uses its own part of this")]

pub mod bed;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rayherd_tests::mutation::peak_memory_of;

/// What a run said.
pub struct Run {
    /// Exit status.
    pub code: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
    /// Of [`rayherd_bounded`]: most memory that it held, KiB, as far as it was seen by a look each millisecond; none where the system does not
    /// tell.
    pub peak: Option<u64>,
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
    Run { code, out: text(&output.stdout), err: text(&output.stderr), peak: None }
}

/// As [`rayherd`], with no more address space than so many MiB and no more time than two minutes: what takes more memory ends by a
/// signal, and what hangs is killed; both fail the test.
#[track_caller]
pub fn rayherd_bounded(folder: &Path, mib: u64, arguments: &[&str]) -> Run {
    let mut command = Command::new("sh");
    // $0 is the binary
    command.args(["-c", &format!("ulimit -v {} && exec \"$0\" \"$@\"", mib << 10), env!("CARGO_BIN_EXE_rayherd")]);
    command.args(arguments).current_dir(folder).env_remove("RUST_LOG").env_remove("RUST_BACKTRACE");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("the shell starts");
    let read = |mut pipe: Box<dyn Read + Send>| {
        std::thread::spawn(move || {
            let mut text = String::new();
            pipe.read_to_string(&mut text).map(|_| text).expect("UTF-8")
        })
    };
    let out = read(Box::new(child.stdout.take().expect("piped")));
    let err = read(Box::new(child.stderr.take().expect("piped")));
    let end = Instant::now() + Duration::from_secs(120);
    let mut peak = None;
    let status = loop {
        // one that has ended has no memory
        peak = peak_memory_of(child.id()).max(peak);
        match child.try_wait().expect("a child can be waited for") {
            Some(status) => break status,
            None if Instant::now() > end => {
                child.kill().and_then(|()| child.wait()).expect("it can be killed");
                panic!("{arguments:?} hangs");
            }
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    };
    let (out, err) = (out.join().expect("no panic"), err.join().expect("no panic"));
    let code = status.code().unwrap_or_else(|| panic!("{arguments:?} ended by a signal: {status}\n{err}"));
    Run { code, out, err, peak }
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
