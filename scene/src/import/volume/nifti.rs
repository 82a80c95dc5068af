//! NIfTI-1 and NIfTI-2: `.nii`, `.nii.gz` and pairs of `.hdr` and `.img`, both byte orders. One volume of three dimensions.
//! Formats: <https://nifti.nimh.nih.gov/nifti-1> and `/nifti-2`.

use std::io::{self, BufReader, Read};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;

use super::layout::{Layout, Part, Skip, check_dims};
use super::slices::{Bytes, Counted};
use super::{SampleType, Volume, malformed};
use crate::ImportError;
use crate::description::Affine;

const SIZE_1: usize = 348;
const SIZE_2: usize = 540;

/// The header of a file, decompressed, if it is a NIfTI file.
pub(super) struct Header {
    bytes: Vec<u8>,
    big_endian: bool,
    gzip: bool,
}

/// Looks whether a file is a NIfTI file.
pub(super) fn recognise(path: &Path, read: &Bytes) -> io::Result<Option<Header>> {
    let mut reader = BufReader::new(Counted::open(path, read)?);
    let gzip = io::BufRead::fill_buf(&mut reader)?.starts_with(&[0x1f, 0x8b]);
    let mut bytes = Vec::new();
    if gzip {
        let mut decoder = MultiGzDecoder::new(reader);
        match decoder.by_ref().take(SIZE_2 as u64).read_to_end(&mut bytes) {
            Ok(_) => {}
            // truncated or bad gzip: it is for the caller to say that nothing is known here
            Err(e)
                if matches!(
                    e.kind(),
                    io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof
                ) => {}
            Err(e) => return Err(e),
        }
    } else {
        reader.take(SIZE_2 as u64).read_to_end(&mut bytes)?;
    }
    let Some(size) = bytes.get(..4) else { return Ok(None) };
    let size = [size[0], size[1], size[2], size[3]];
    let is = |size: u32| match size as usize {
        SIZE_1 => bytes.len() >= SIZE_1 && matches!(&bytes[344..348], b"n+1\0" | b"ni1\0"),
        SIZE_2 => bytes.len() >= SIZE_2 && matches!(&bytes[4..8], b"n+2\0" | b"ni2\0"),
        _ => false,
    };
    let big_endian = match (is(u32::from_le_bytes(size)), is(u32::from_be_bytes(size))) {
        (true, _) => false,
        (_, true) => true,
        _ => return Ok(None),
    };
    Ok(Some(Header { bytes, big_endian, gzip }))
}

impl Header {
    fn at<const N: usize>(&self, at: usize) -> [u8; N] {
        let mut b = [0; N];
        b.copy_from_slice(&self.bytes[at..at + N]);
        if self.big_endian {
            b.reverse();
        }
        b
    }
    fn i16(&self, at: usize) -> i64 {
        i16::from_le_bytes(self.at(at)).into()
    }
    fn i32(&self, at: usize) -> i64 {
        i32::from_le_bytes(self.at(at)).into()
    }
    fn i64(&self, at: usize) -> i64 {
        i64::from_le_bytes(self.at(at))
    }
    fn f32(&self, at: usize) -> f64 {
        f32::from_le_bytes(self.at(at)).into()
    }
    fn f64(&self, at: usize) -> f64 {
        f64::from_le_bytes(self.at(at))
    }

    fn fields(&self) -> Fields {
        if self.bytes[..4] == [0x5c, 1, 0, 0] || self.bytes[..4] == [0, 0, 1, 0x5c] {
            Fields {
                pair: self.bytes[345] == b'i',
                dim: std::array::from_fn(|k| self.i16(40 + 2 * k)),
                datatype: self.i16(70),
                pixdim: std::array::from_fn(|k| self.f32(76 + 4 * k)),
                offset: self.f32(108),
                slope: self.f32(112),
                intercept: self.f32(116),
                units: i64::from(self.bytes[123]),
                qform: self.i16(252),
                sform: self.i16(254),
                quaternion: std::array::from_fn(|k| self.f32(256 + 4 * k)),
                shift: std::array::from_fn(|k| self.f32(268 + 4 * k)),
                rows: std::array::from_fn(|r| std::array::from_fn(|c| self.f32(280 + 16 * r + 4 * c))),
            }
        } else {
            Fields {
                pair: self.bytes[5] == b'i',
                dim: std::array::from_fn(|k| self.i64(16 + 8 * k)),
                datatype: self.i16(12),
                pixdim: std::array::from_fn(|k| self.f64(104 + 8 * k)),
                offset: self.i64(168) as f64,
                slope: self.f64(176),
                intercept: self.f64(184),
                units: self.i32(500),
                qform: self.i32(344),
                sform: self.i32(348),
                quaternion: std::array::from_fn(|k| self.f64(352 + 8 * k)),
                shift: std::array::from_fn(|k| self.f64(376 + 8 * k)),
                rows: std::array::from_fn(|r| std::array::from_fn(|c| self.f64(400 + 32 * r + 8 * c))),
            }
        }
    }
}

/// Both versions' fields, by the names of the standard where they differ from ours: qoffset is `shift`, srow `rows`.
struct Fields {
    pair: bool,
    dim: [i64; 8],
    datatype: i64,
    pixdim: [f64; 8],
    offset: f64,
    slope: f64,
    intercept: f64,
    units: i64,
    qform: i64,
    sform: i64,
    quaternion: [f64; 3],
    shift: [f64; 3],
    rows: [[f64; 4]; 3],
}

pub(super) fn open(path: &Path, header: &Header) -> Result<(Volume, Layout), ImportError> {
    let f = header.fields();
    let fail = |message: String| Err(malformed(path, 0, message));
    let used = match f.dim[0] {
        n @ 1..=7 => n as usize,
        n => return fail(format!("{n} dimensions: NIfTI has 1 to 7")),
    };
    if used < 3 || f.dim[4..=used.max(3)].iter().any(|&d| d != 1) {
        let dims = &f.dim[1..=used];
        return fail(format!("dimensions {dims:?} are not one volume: cut one out first (`fslroi`, `nibabel`)"));
    }
    let sizes = [1, 2, 3].map(|k| u64::try_from(f.dim[k]).unwrap_or(0));
    let dims = check_dims(path, 0, sizes)?;
    let sample = match f.datatype {
        2 => SampleType::U8,
        4 => SampleType::I16,
        8 => SampleType::I32,
        16 => SampleType::F32,
        64 => SampleType::F64,
        256 => SampleType::I8,
        512 => SampleType::U16,
        768 => SampleType::U32,
        1024 => SampleType::I64,
        1280 => SampleType::U64,
        other => return fail(format!("data type {other} is not supported: integers of 8 to 64 bits, f32 and f64 are")),
    };
    if !(f.offset >= 0.0 && f.offset <= 2f64.powi(52) && f.offset.fract() == 0.0) {
        return fail(format!("the samples' place {} in the file is not a number of bytes", f.offset));
    }
    let (slope, intercept) = match (f.slope, f.intercept) {
        // by the standard a slope of 0 says that there is no scaling
        (0.0, _) => (1.0, 0.0),
        (s, i) if s.is_finite() && i.is_finite() => (s, i),
        (s, i) => return fail(format!("slope {s} and intercept {i} of the samples are not finite")),
    };
    let data = if f.pair {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match name.strip_suffix(".hdr").or(name.strip_suffix(".hdr.gz")) {
            Some(stem) => path.with_file_name(format!("{stem}.img{}", if header.gzip { ".gz" } else { "" })),
            None => return fail("the samples are in another file, but this one's name does not end with .hdr".into()),
        }
    } else {
        path.to_owned()
    };
    let part = Part {
        path: data,
        slices: dims[2],
        skip: Skip::Lines(0, f.offset as u64),
        gzip: header.gzip,
        slope,
        intercept,
    };
    let layout = Layout {
        slice_samples: dims[0] * dims[1],
        sample,
        big_endian: header.big_endian,
        bits: None,
        parts: vec![part],
    };
    layout.check(path)?;
    let volume = Volume { dims, to_world: placement(path, &f)?, slope, intercept, sample, skipped_files: 0 };
    Ok((volume, layout))
}

/// By the standard: sform if there is one, else qform, else the spacing alone. RAS becomes LPS.
fn placement(path: &Path, f: &Fields) -> Result<Affine, ImportError> {
    let millimetres = match f.units & 7 {
        1 => 1000.0,
        3 => 0.001,
        _ => 1.0,
    };
    let spacing = [f.pixdim[1], f.pixdim[2], f.pixdim[3]];
    let rows = if f.sform > 0 {
        f.rows
    } else if f.qform > 0 {
        let [b, c, d] = f.quaternion;
        // of unit length with the part that is not stored; three numbers of f32 are off by some 1e-7
        let rest = 1.0 - (b * b + c * c + d * d);
        if rest.is_nan() || rest < -1e-5 {
            return Err(malformed(path, 0, format!("the orientation's quaternion ({b}, {c}, {d}) is longer than 1")));
        }
        let a = rest.max(0.0).sqrt();
        let turn = [
            [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
            [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
            [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ];
        // pixdim[0] below 0 turns the slices' direction over
        let scale = [spacing[0], spacing[1], if f.pixdim[0] < 0.0 { -spacing[2] } else { spacing[2] }];
        std::array::from_fn(|r| [turn[r][0] * scale[0], turn[r][1] * scale[1], turn[r][2] * scale[2], f.shift[r]])
    } else {
        std::array::from_fn(|r| std::array::from_fn(|c| if r == c { spacing[r] } else { 0.0 }))
    };
    let sign = [-millimetres, -millimetres, millimetres];
    super::affine(path, |r, c| sign[r] * rows[r][c], |r| sign[r] * rows[r][3])
}
