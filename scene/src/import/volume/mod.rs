//! Volumes: what a file says of them, and their slices one at a time.
//!
//! World space is LPS in millimetres, DICOM's: x to the patient's left, y to the back, z to the head. NIfTI's RAS and NRRD's
//! named spaces are converted. An NRRD without space and directions has its first slice on top.

mod dicom;
mod layout;
mod nifti;
mod nrrd;
mod slices;
#[cfg(test)]
mod tests;

use std::io::Read;
use std::path::Path;

use crate::ImportError;
use crate::description::Affine;
use layout::Layout;
pub use layout::SampleType;
pub use slices::Slices;
use slices::{Bytes, Counted};

/// Most samples in one slice: 4096 x 4096. Two slices of f64 are in memory while a surface is made, 256 MiB of these.
pub const MAX_SLICE_SAMPLES: u64 = 1 << 24;

/// What a volume is.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    /// Samples along x (fastest in the file), y and z (slices); each at least 1.
    pub dims: [usize; 3],
    /// From sample numbers (the centre of the first sample is the origin) to LPS millimetres. It may shear (gantry tilt) and
    /// mirror.
    pub to_world: Affine,
    /// Value = stored * slope + intercept; of the first slice where slices differ (DICOM).
    pub slope: f64,
    /// See `slope`.
    pub intercept: f64,
    /// How samples are stored.
    pub sample: SampleType,
    /// Files of the folder that are no part of the volume (not DICOM).
    pub skipped_files: usize,
}

impl Volume {
    /// The world's box around all samples: least and greatest corner.
    pub fn world_box(&self) -> [[f64; 3]; 2] {
        let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for corner in 0..8 {
            let p = self.to_world.point([0, 1, 2].map(|k| ((corner >> k & 1) * (self.dims[k] - 1)) as f64));
            for k in 0..3 {
                bounds[0][k] = bounds[0][k].min(p[k]);
                bounds[1][k] = bounds[1][k].max(p[k]);
            }
        }
        bounds
    }
}

/// A volume whose headers are read and checked, to be passed over any number of times.
#[derive(Clone, Debug)]
pub struct VolumeFile {
    volume: Volume,
    layout: Layout,
    header_bytes: u64,
}

impl VolumeFile {
    /// What it is.
    pub fn volume(&self) -> &Volume {
        &self.volume
    }
    /// Bytes that were read to open it, those that told the format among them.
    pub fn header_bytes(&self) -> u64 {
        self.header_bytes
    }
    /// Starts a pass over the slices, z = 0 first.
    pub fn slices(&self) -> Slices<'_> {
        Slices::new(&self.layout)
    }
}

/// Whether `path` is a volume that [`open`] knows: an NRRD or NIfTI file, a DICOM file, or a folder with one in it. Told from
/// the content.
pub fn is_volume(path: &Path) -> Result<bool, ImportError> {
    if path.is_dir() {
        let io = |source| ImportError::Io { path: path.to_owned(), source };
        for entry in std::fs::read_dir(path).map_err(io)? {
            let file = entry.map_err(io)?.path();
            super::inside::check_entry(&file, path)?;
            if file.is_file() && matches!(format(&file, &Bytes::default())?, Some(Format::Dicom)) {
                return Ok(true);
            }
        }
        return Ok(false);
    }
    Ok(format(path, &Bytes::default())?.is_some())
}

/// Opens a volume: an NRRD, NHDR or NIfTI file (also gzipped), a folder with a DICOM series, or one DICOM file, which
/// stands for all of its series in its folder. The format is told from the content. Headers are read and checked; sizes are
/// compared with those of the files.
///
/// # Errors
/// What cannot be read, is malformed or not supported, with the file that is to blame.
pub fn open(path: &Path) -> Result<VolumeFile, ImportError> {
    let bytes = Bytes::default();
    let (volume, layout) = if path.is_dir() {
        dicom::open_folder(path, &bytes)?
    } else {
        match format(path, &bytes)? {
            Some(Format::Nrrd) => nrrd::open(path, &bytes)?,
            Some(Format::Nifti(header)) => nifti::open(path, &header)?,
            Some(Format::Dicom) => dicom::open_file(path, &bytes)?,
            None => return Err(malformed(path, 0, "not a volume: neither NRRD nor NIfTI nor DICOM by its content")),
        }
    };
    Ok(VolumeFile { volume, layout, header_bytes: bytes.get() })
}

enum Format {
    Nrrd,
    Nifti(nifti::Header),
    Dicom,
}

fn format(path: &Path, bytes: &Bytes) -> Result<Option<Format>, ImportError> {
    let io = |source| ImportError::Io { path: path.to_owned(), source };
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        return Ok(None); // opening a pipe would wait for ever
    }
    let mut first = Vec::new();
    Counted::open(path, bytes).map_err(io)?.take(132).read_to_end(&mut first).map_err(io)?;
    if first.starts_with(b"NRRD000") {
        return Ok(Some(Format::Nrrd));
    }
    if dicom::is_dicom(&first) {
        return Ok(Some(Format::Dicom));
    }
    Ok(nifti::recognise(path, bytes).map_err(io)?.map(Format::Nifti))
}

/// An error of the content.
fn malformed(path: &Path, line: u32, message: impl Into<String>) -> ImportError {
    ImportError::Malformed { place: crate::description::Place::line(path, line), message: message.into() }
}

/// A map from sample numbers to the world by its linear part (row, column) and its translation; refused unless finite and
/// of full rank.
fn affine(
    path: &Path,
    linear: impl Fn(usize, usize) -> f64,
    translation: impl Fn(usize) -> f64,
) -> Result<Affine, ImportError> {
    let map =
        Affine(std::array::from_fn(|r| std::array::from_fn(|c| if c < 3 { linear(r, c) } else { translation(r) })));
    let determinant = map.determinant();
    if !map.0.as_flattened().iter().all(|v| v.is_finite()) || !determinant.is_finite() || determinant == 0.0 {
        return Err(malformed(
            path,
            0,
            "the placement of the samples is flat or not finite: directions must span space",
        ));
    }
    Ok(map)
}
