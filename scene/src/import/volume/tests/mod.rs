//! Round trips by small writers, errors of headers, and mutation loops over the parsers.

mod dicom;
mod fuzz;
mod nifti;
mod nrrd;

use std::io::Write;
use std::path::{Path, PathBuf};

use super::*;

/// A folder that is removed at the end.
pub(super) struct Folder(tempfile::TempDir);

impl Folder {
    pub(super) fn new() -> Self {
        Folder(tempfile::tempdir().unwrap())
    }
    pub(super) fn path(&self) -> &Path {
        self.0.path()
    }
    pub(super) fn write(&self, name: &str, content: &[u8]) -> PathBuf {
        let path = self.path().join(name);
        // some file systems flush a file that is truncated and written again
        let _ = std::fs::remove_file(&path);
        std::fs::write(&path, content).unwrap();
        path
    }
}

pub(super) fn gzip(content: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(content).unwrap();
    encoder.finish().unwrap()
}

/// All slices of a file.
pub(super) fn slices(file: &VolumeFile) -> Result<Vec<Vec<f64>>, ImportError> {
    let mut pass = file.slices();
    let mut all = Vec::new();
    let mut slice = Vec::new();
    while pass.next(&mut slice)? {
        assert_eq!(slice.len(), file.volume().dims[0] * file.volume().dims[1]);
        all.push(slice.clone());
    }
    assert_eq!(all.len(), file.volume().dims[2]);
    assert!(!pass.next(&mut slice)?);
    Ok(all)
}

/// The error of opening, or else of reading.
pub(super) fn error(path: &Path) -> String {
    match open(path).and_then(|f| slices(&f)) {
        Ok(_) => panic!("no error"),
        Err(e) => e.to_string(),
    }
}

/// The samples 0, 1, 2, .. of slices of 6.
pub(super) fn counting(slices: usize) -> Vec<Vec<f64>> {
    (0..slices).map(|z| (0..6).map(|i| (z * 6 + i) as f64).collect()).collect()
}

#[test]
fn what_is_no_volume() {
    let folder = Folder::new();
    assert!(error(&folder.path().join("absent")).starts_with("cannot read"));
    for (name, content) in [("empty", &b""[..]), ("short", b"NRRD"), ("text", b"hello"), ("gz", &gzip(b"hello"))] {
        let path = folder.write(name, content);
        assert!(!is_volume(&path).unwrap());
        assert!(error(&path).contains("not a volume"));
    }
    assert!(!is_volume(folder.path()).unwrap());
    let message = error(folder.path());
    assert!(message.contains("no DICOM image in this folder (4 other file(s), 0 folder(s)"), "{message}");
}

#[test]
fn boxes_of_turned_volumes() {
    let volume = Volume {
        dims: [3, 4, 5],
        to_world: Affine([[0.0, -2.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.5, -7.0]]),
        slope: 1.0,
        intercept: 0.0,
        sample: SampleType::U8,
        skipped_files: 0,
    };
    assert_eq!(volume.world_box(), [[-5.0, 0.0, -7.0], [1.0, 2.0, -5.0]]);
}
