//! Where a volume's samples lie: what every format comes down to.

use std::path::{Path, PathBuf};

use super::{MAX_SLICE_SAMPLES, malformed};
use crate::ImportError;
use crate::description::Place;

/// How a sample is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum SampleType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl SampleType {
    /// Bytes of one sample.
    pub fn bytes(self) -> usize {
        match self {
            SampleType::U8 | SampleType::I8 => 1,
            SampleType::U16 | SampleType::I16 => 2,
            SampleType::U32 | SampleType::I32 | SampleType::F32 => 4,
            SampleType::U64 | SampleType::I64 | SampleType::F64 => 8,
        }
    }
}

/// The samples of a volume as runs of whole slices in files.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// Samples of one slice.
    pub slice_samples: usize,
    pub sample: SampleType,
    pub big_endian: bool,
    /// Bits that are in use: (number of the highest, count). The rest is not part of the value (DICOM).
    pub bits: Option<(u32, u32)>,
    /// In z order.
    pub parts: Vec<Part>,
}

/// Consecutive slices in one file.
#[derive(Clone, Debug)]
pub(super) struct Part {
    pub path: PathBuf,
    pub slices: usize,
    pub skip: Skip,
    pub gzip: bool,
    pub slope: f64,
    pub intercept: f64,
}

/// Where the samples of a part begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Skip {
    /// After this many lines of the file, and then this many bytes (of what is decompressed).
    Lines(u64, u64),
    /// So that they end with the file.
    FromEnd,
}

impl Layout {
    pub fn slice_bytes(&self) -> usize {
        self.slice_samples * self.sample.bytes()
    }

    /// Refuses what the files cannot hold before memory is taken. `header` is the file that made the claim.
    pub fn check(&self, header: &Path) -> Result<(), ImportError> {
        for part in &self.parts {
            let io = |source| ImportError::Io { path: part.path.clone(), source };
            let metadata = std::fs::metadata(&part.path).map_err(io)?;
            if !metadata.is_file() {
                return Err(malformed(header, 0, format!("{} is not a file", part.path.display())));
            }
            let need = self.slice_bytes() as u64 * part.slices as u64;
            let (skipped, have) = match part.skip {
                // lines are counted when they are read: at least one byte each
                Skip::Lines(lines, bytes) => (lines.saturating_add(bytes), metadata.len()),
                Skip::FromEnd => (0, metadata.len()),
            };
            // deflate makes at most 1032 bytes of one
            let most = if part.gzip { have.saturating_mul(1032) } else { have };
            if skipped.saturating_add(need) > most {
                return Err(malformed(
                    header,
                    0,
                    format!(
                        "{} holds {have} bytes where the header asks for {need} bytes{}{}: truncated, or the sizes are \
                         wrong",
                        part.path.display(),
                        if skipped > 0 { format!(" after {skipped}") } else { String::new() },
                        if part.gzip { " decompressed, more than gzip can hold" } else { "" },
                    ),
                ));
            }
        }
        Ok(())
    }
}

/// Checks sizes from a header: at least 1, and bounded slices.
pub(super) fn check_dims(path: &Path, line: u32, dims: [u64; 3]) -> Result<[usize; 3], ImportError> {
    if dims.contains(&0) {
        return Err(malformed(path, line, format!("a size is 0 in {} x {} x {}", dims[0], dims[1], dims[2])));
    }
    match dims[0].checked_mul(dims[1]) {
        Some(n) if n <= MAX_SLICE_SAMPLES && dims[2] <= u64::from(u32::MAX) => Ok(dims.map(|d| d as usize)),
        _ => Err(ImportError::Limit {
            place: Place::line(path, line),
            message: format!(
                "the header says {} x {} x {} samples; a slice may have {MAX_SLICE_SAMPLES}: crop or resample it first",
                dims[0], dims[1], dims[2]
            ),
        }),
    }
}
