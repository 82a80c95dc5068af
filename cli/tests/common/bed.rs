//! A folder of bad inputs, and how a run that meets one must end.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;
use std::process::Command;

use flate2::Compression;
use flate2::write::GzEncoder;

use super::{Run, rayherd_bounded};

/// Address space of a run. Most of it is threads' stacks and reserves; the inputs below ask for far more.
const MIB: u64 = 4096;
/// Memory of a run that is refused, at most: what is read of a bad input stays within the limits of its reader, the largest of which is that
/// of XML: some 300 MiB with the program itself, which takes a few more where it is not optimised.
const MOST_MEMORY: u64 = 320 << 20;
/// The longest error: what a terminal shows.
const MOST_TEXT: usize = 2000;

/// A mesh.
pub const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
/// Light for whatever there is.
pub const LIT: &str = "<emitter type='constant'/>";
/// A picture of one texel.
pub const HDR: &[u8] = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\x80\x40\x20\x81";

/// A JPEG of 37 x 29 texels.
pub const JPEG: &[u8] = include_bytes!("../../../scene/src/image/fixtures/waves.jpg");

/// A folder with the inputs of one table.
pub struct Bed(tempfile::TempDir);

impl Bed {
    /// An empty one.
    pub fn new() -> Self {
        Bed(tempfile::tempdir().unwrap())
    }
    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
    /// Puts a file there, in folders of its own where it names them.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> &Self {
        let path = self.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
        self
    }
    /// A scene with this inside.
    pub fn xml(&self, name: &str, inner: &str) -> &Self {
        self.write(name, format!("<scene version='3.0.0'>\n{inner}\n</scene>"))
    }
    /// Compressed: a head, and so many `0` after it.
    pub fn gz(&self, name: &str, head: &[u8], zeros: u64) -> &Self {
        let mut out = GzEncoder::new(File::create(self.path().join(name)).unwrap(), Compression::fast());
        out.write_all(head).unwrap();
        std::io::copy(&mut std::io::Read::take(std::io::repeat(b'0'), zeros), &mut out).unwrap();
        out.finish().unwrap();
        self
    }
    /// A pipe that nobody writes to.
    pub fn pipe(&self, name: &str) -> &Self {
        assert!(Command::new("mkfifo").arg(self.path().join(name)).status().unwrap().success());
        self
    }
    /// Runs the binary there, within bounds.
    pub fn run(&self, arguments: &[&str]) -> Run {
        rayherd_bounded(self.path(), MIB, arguments)
    }
    /// Runs a command line.
    pub fn line(&self, line: &str) -> Run {
        self.run(&line.split(' ').collect::<Vec<_>>())
    }

    /// Runs each row's command line, which must end with a mistake that names its parts, and within [`MOST_MEMORY`]; the most that one took,
    /// bytes.
    #[track_caller]
    pub fn mistakes(&self, rows: &[(&str, &[&str])]) -> Option<u64> {
        let mut most = None;
        for (line, parts) in rows {
            let run = self.line(line);
            assert_error(line, &run, 2, parts);
            let peak = run.peak.map(|kib| kib << 10);
            assert!(peak < Some(MOST_MEMORY), "{line}: {} MiB", peak.unwrap_or(0) >> 20);
            most = most.max(peak);
        }
        most
    }
}

/// A run that ended with this code and one short error, which has these parts.
#[track_caller]
pub fn assert_error(line: &str, run: &Run, code: i32, parts: &[&str]) {
    let told = &run.err;
    assert_eq!(run.code, code, "{line}: {told}");
    let errors = told.lines().filter(|l| l.starts_with("error: ")).count();
    assert!(errors == 1, "{line}: {errors} errors in: {told}");
    assert!(told.len() < MOST_TEXT, "{line}: {} bytes of errors: {told}", told.len());
    assert!(!told.contains("panicked") && !told.contains("defect"), "{line}: {told}");
    for part in parts {
        assert!(told.contains(part), "{line}: no {part:?} in: {told}");
    }
}

/// Bytes without a sense, the same each time.
pub fn noise(n: u32) -> Vec<u8> {
    (0..n).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}
