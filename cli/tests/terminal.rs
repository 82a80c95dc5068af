//! What a person sees: the progress bar on a terminal of 80 columns, and the preview beside it.

mod common;

use std::ffi::OsStr;
use std::fs::File;
use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::repository;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};

const COLUMNS: u16 = 80;

/// A pseudo-terminal: our end, and the program's.
fn terminal() -> (File, File) {
    let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&ours).unwrap();
    unlockpt(&ours).unwrap();
    let size = Winsize { ws_row: 24, ws_col: COLUMNS, ws_xpixel: 0, ws_ypixel: 0 };
    tcsetwinsize(&ours, size).unwrap();
    let name = ptsname(&ours, Vec::new()).unwrap();
    let theirs = File::options().read(true).write(true).open(OsStr::from_bytes(name.as_bytes())).unwrap();
    (File::from(ours), theirs)
}

/// The lines that were drawn, control sequences left out.
fn lines(bytes: &[u8]) -> Vec<String> {
    let text = String::from_utf8_lossy(bytes);
    let mut out = vec![String::new()];
    let mut characters = text.chars();
    while let Some(c) = characters.next() {
        match c {
            // ESC [ parameters, up to a letter
            '\x1b' => drop(characters.by_ref().find(|c| c.is_ascii_alphabetic())),
            '\r' | '\n' => out.push(String::new()),
            c => out.last_mut().unwrap().push(c),
        }
    }
    out
}

#[test]
fn the_bar_tells_what_matters_and_fits_while_the_preview_is_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/cornell-box.xml");
    let (mut ours, theirs) = terminal();
    let mut child = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(["render", scene.to_str().unwrap(), "--size", "64x64", "--spp", "1000000", "--task-seconds", "0.2"])
        .args(["--threads", "1", "-o", "x.exr"])
        .current_dir(folder.path())
        .env("TERM", "xterm")
        .env_remove("NO_COLOR")
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(theirs)
        .spawn()
        .unwrap();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let sink = seen.clone();
    let reader = std::thread::spawn(move || {
        let mut part = [0; 4096];
        // reading fails when the last user of the other end is gone
        while let Ok(n @ 1..) = ours.read(&mut part) {
            sink.lock().unwrap().extend_from_slice(&part[..n]);
        }
    });

    let picture = folder.path().join("x.png");
    let wanted = ["rays/s", " of 1000000 spp", "relMSE ", " left"];
    let whole = |line: &String| wanted.iter().all(|w| line.contains(w));
    let mut previews: Vec<u64> = Vec::new();
    let begun = Instant::now();
    let done = |previews: &[u64]| previews.len() >= 2 && lines(&seen.lock().unwrap()).iter().any(whole);
    while !done(&previews) && begun.elapsed() < Duration::from_secs(180) {
        assert_eq!(child.try_wait().unwrap(), None, "it ended by itself: {:?}", lines(&seen.lock().unwrap()));
        if let Some(mark) = complete(&picture)
            && previews.last() != Some(&mark)
        {
            previews.push(mark);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let finished = done(&previews);
    child.kill().unwrap();
    child.wait().unwrap();
    reader.join().unwrap();
    let lines = lines(&seen.lock().unwrap());
    assert!(finished, "{} previews; lines {lines:?}", previews.len());
    let widest = lines.iter().map(|l| l.chars().count()).max().unwrap_or(0);
    assert!(widest <= usize::from(COLUMNS), "{widest} columns: {lines:?}");
}

/// What tells one file from the next, if it is there: then it is a whole picture, at any moment.
fn complete(picture: &Path) -> Option<u64> {
    let mut file = File::open(picture).ok()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).unwrap();
    assert!(bytes.starts_with(b"\x89PNG") && bytes.ends_with(b"IEND\xaeB`\x82"), "half a picture");
    // the same number may be given to a later file; then its time tells
    let m = file.metadata().unwrap();
    Some(m.ino() ^ m.mtime_nsec() as u64)
}
