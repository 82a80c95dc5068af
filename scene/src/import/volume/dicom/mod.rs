//! A DICOM series: the images of one folder that share a series number, sorted by their place along the normal.

mod element;

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use element::{DataSet, Failure, Tag};

use super::layout::{Layout, Part, Skip, check_dims};
use super::slices::{Bytes, Counted};
use super::{SampleType, Volume, malformed};
use crate::ImportError;
use crate::import::inside;

const SERIES_DESCRIPTION: Tag = (0x0008, 0x103e);
const SERIES: Tag = (0x0020, 0x000e);
const POSITION: Tag = (0x0020, 0x0032);
const ORIENTATION: Tag = (0x0020, 0x0037);
const SAMPLES_PER_PIXEL: Tag = (0x0028, 0x0002);
const PHOTOMETRIC: Tag = (0x0028, 0x0004);
const FRAMES: Tag = (0x0028, 0x0008);
const ROWS: Tag = (0x0028, 0x0010);
const COLUMNS: Tag = (0x0028, 0x0011);
const PIXEL_SPACING: Tag = (0x0028, 0x0030);
const BITS_ALLOCATED: Tag = (0x0028, 0x0100);
const BITS_STORED: Tag = (0x0028, 0x0101);
const HIGH_BIT: Tag = (0x0028, 0x0102);
const PIXEL_REPRESENTATION: Tag = (0x0028, 0x0103);
const INTERCEPT: Tag = (0x0028, 0x1052);
const SLOPE: Tag = (0x0028, 0x1053);
const MODALITY_LUT: Tag = (0x0028, 0x3000);
const WANTED: &[Tag] = &[
    SERIES_DESCRIPTION,
    SERIES,
    POSITION,
    ORIENTATION,
    SAMPLES_PER_PIXEL,
    PHOTOMETRIC,
    FRAMES,
    ROWS,
    COLUMNS,
    PIXEL_SPACING,
    BITS_ALLOCATED,
    BITS_STORED,
    HIGH_BIT,
    PIXEL_REPRESENTATION,
    INTERCEPT,
    SLOPE,
    MODALITY_LUT,
];

/// How far a slice may be from where even spacing puts it, as part of the spacing. Scanners write positions rounded, to 0.01 mm
/// or so, and tables move within some hundredths; a missing slice is off by 1.
const UNEVEN: f64 = 0.05;
/// How far direction cosines of one series may differ: they are written with 6 digits or more.
const DIRECTIONS_DIFFER: f64 = 1e-4;
/// Series named in an error.
const NAMED: usize = 10;

/// A file with an image.
struct Found {
    path: PathBuf,
    series: String,
    set: DataSet,
}

/// An image that can be a slice.
#[derive(Clone, Debug)]
struct Image {
    path: PathBuf,
    set: Meaning,
}

/// What must be the same in all images of a series, and what may differ.
#[derive(Clone, Debug)]
struct Meaning {
    rows: u16,
    columns: u16,
    sample: SampleType,
    big_endian: bool,
    bits: (u32, u32),
    spacing: [f64; 2],
    orientation: [f64; 6],
    position: [f64; 3],
    slope: f64,
    intercept: f64,
    offset: u64,
}

/// Whether a file is a DICOM file.
pub(super) fn is_dicom(first: &[u8]) -> bool {
    first.get(128..132) == Some(b"DICM")
}

/// Opens the series in a folder, which must be the only one there.
pub(super) fn open_folder(folder: &Path, bytes: &Bytes) -> Result<(Volume, Layout), ImportError> {
    let scan = scan(folder, None, bytes)?;
    let mut series: BTreeMap<&str, Vec<&Found>> = BTreeMap::new();
    for image in &scan.images {
        series.entry(&image.series).or_default().push(image);
    }
    if series.len() > 1 {
        let mut message = format!(
            "the folder holds {} DICOM series: give one file of the series you want instead of the folder\n",
            series.len()
        );
        for (uid, images) in series.iter().take(NAMED) {
            let name = images[0].path.file_name().unwrap_or_default().to_string_lossy();
            let what = string(&images[0].set, SERIES_DESCRIPTION).unwrap_or_default();
            message += &format!("  {name}: {} image(s), {what} {uid}\n", images.len());
        }
        if series.len() > NAMED {
            message += &format!("  and {} more\n", series.len() - NAMED);
        }
        return Err(malformed(folder, 0, message.trim_end()));
    }
    if scan.images.is_empty() {
        return Err(malformed(
            folder,
            0,
            format!(
                "no DICOM image in this folder ({} other file(s), {} folder(s) not looked into): give the folder that \
                 holds the series",
                scan.others, scan.folders
            ),
        ));
    }
    assemble(folder, scan)
}

/// Opens the series that one file belongs to: those of its folder with the same series number.
pub(super) fn open_file(path: &Path, bytes: &Bytes) -> Result<(Volume, Layout), ImportError> {
    let Some(image) = read(path, bytes)? else {
        return Err(malformed(path, 0, "this DICOM file holds no image"));
    };
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut scan = scan(folder, path.file_name(), bytes)?;
    scan.images.retain(|i| i.series == image.series);
    assemble(folder, scan)
}

struct Scan {
    images: Vec<Found>,
    others: usize,
    folders: usize,
}

/// Reads the headers of a folder's files. Of links only that of this name, which the user gave, may lead out of it.
fn scan(folder: &Path, named: Option<&OsStr>, bytes: &Bytes) -> Result<Scan, ImportError> {
    let io = |source| ImportError::Io { path: folder.to_owned(), source };
    let mut names = Vec::new();
    let mut folders = 0;
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.is_dir() {
            folders += 1;
        } else {
            names.push(path);
        }
    }
    names.sort();
    let mut images = Vec::new();
    let mut others = Vec::new();
    for path in names {
        if path.file_name() != named {
            inside::check_entry(&path, folder)?;
        }
        match read(&path, bytes)? {
            Some(image) => images.push(image),
            None => others.push(path),
        }
    }
    // a slice at either end of a series leaves no gap when it is cut or lost: its name says that it should be there
    let named: BTreeSet<String> = images.iter().map(|i: &Found| pattern(&i.path)).collect();
    if let Some(path) = others.iter().find(|p| named.contains(&pattern(p)) && !begins_as_dicom(p, bytes)) {
        let message = "this is no DICOM file, though it is named as the series' images are: get it again, or move it out of the folder";
        return Err(malformed(path, 0, message));
    }
    Ok(Scan { images, others: others.len(), folders })
}

/// A file's name without its numbers.
fn pattern(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.chars().filter(|c| !c.is_ascii_digit()).collect()
}

/// Whether a file is DICOM at all: a directory or a report holds no image, and is left out.
fn begins_as_dicom(path: &Path, bytes: &Bytes) -> bool {
    let mut first = [0; 132];
    let file =
        std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file).and_then(|_| Counted::open(path, bytes).ok());
    file.is_some_and(|mut file| file.read_exact(&mut first).is_ok()) && is_dicom(&first)
}

/// Reads one file's header; none if it is no DICOM file, or none of an image (a directory, a report).
fn read(path: &Path, bytes: &Bytes) -> Result<Option<Found>, ImportError> {
    let io = |source| ImportError::Io { path: path.to_owned(), source };
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        return Ok(None); // opening a pipe would wait for ever
    }
    let file = Counted::open(path, bytes).map_err(io)?;
    // headers of a slice have some 2 KB, and what is read beyond them is read again in each pass
    match element::read(BufReader::with_capacity(2048, file), WANTED) {
        Ok(Some(set)) if set.pixels.is_some() => {
            Ok(Some(Found { path: path.to_owned(), series: string(&set, SERIES).unwrap_or_default(), set }))
        }
        Ok(_) => Ok(None),
        Err(Failure::Io(e)) => Err(io(e)),
        Err(Failure::Content(message)) => Err(malformed(path, 0, message)),
    }
}

fn value(set: &DataSet, tag: Tag) -> Option<&[u8]> {
    set.values.iter().find(|(t, _)| *t == tag).map(|(_, v)| v.as_slice())
}

fn string(set: &DataSet, tag: Tag) -> Option<String> {
    value(set, tag).map(element::text)
}

fn name(tag: Tag) -> String {
    format!("({:04x},{:04x})", tag.0, tag.1)
}

fn short(set: &DataSet, tag: Tag) -> Result<u16, String> {
    let v = value(set, tag).and_then(|v| <[u8; 2]>::try_from(v).ok());
    let v = v.ok_or_else(|| format!("element {} is missing or not one short", name(tag)))?;
    Ok(if set.big_endian { u16::from_be_bytes(v) } else { u16::from_le_bytes(v) })
}

/// Decimal strings; none if the element is absent or empty.
fn decimals<const N: usize>(set: &DataSet, tag: Tag) -> Result<Option<[f64; N]>, String> {
    let Some(text) = string(set, tag).filter(|t| !t.is_empty()) else { return Ok(None) };
    let numbers: Option<Vec<f64>> =
        text.split('\\').map(|n| n.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect();
    match numbers.and_then(|n| n.try_into().ok()) {
        Some(n) => Ok(Some(n)),
        None => Err(format!("element {} is `{text}`, not {N} number(s)", name(tag))),
    }
}

fn needed<const N: usize>(set: &DataSet, tag: Tag, what: &str) -> Result<[f64; N], String> {
    decimals(set, tag)?.ok_or_else(|| format!("the image has no {what} {}", name(tag)))
}

fn meaning(set: &DataSet) -> Result<Meaning, String> {
    let fail = |message: String| Err(message);
    if let Some(problem) = &set.problem {
        return fail(problem.clone());
    }
    if short(set, SAMPLES_PER_PIXEL)? != 1 || string(set, PHOTOMETRIC).is_some_and(|p| p == "PALETTE COLOR") {
        return fail("a colour image: only images of one value per pixel make a volume".into());
    }
    if decimals::<1>(set, FRAMES)?.is_some_and(|[n]| n != 1.0) {
        return fail("an image of many frames is not supported: split it into one file per frame".into());
    }
    if value(set, MODALITY_LUT).is_some() {
        return fail("values by a table (0028,3000) are not supported: only rescale slope and intercept".into());
    }
    let allocated = short(set, BITS_ALLOCATED)?;
    let signed = match short(set, PIXEL_REPRESENTATION)? {
        0 => false,
        1 => true,
        other => return fail(format!("pixel representation {other} is neither 0 nor 1")),
    };
    let sample = match (allocated, signed) {
        (8, false) => SampleType::U8,
        (8, true) => SampleType::I8,
        (16, false) => SampleType::U16,
        (16, true) => SampleType::I16,
        (32, false) => SampleType::U32,
        (32, true) => SampleType::I32,
        _ => return fail(format!("{allocated} bits per pixel are not supported: 8, 16 and 32 are")),
    };
    let (stored, high) = (short(set, BITS_STORED)?, short(set, HIGH_BIT)?);
    if stored == 0 || high >= allocated || stored > high + 1 {
        return fail(format!("{stored} bits up to bit {high} do not lie within {allocated} bits"));
    }
    let (rows, columns) = (short(set, ROWS)?, short(set, COLUMNS)?);
    let (offset, length) = set.pixels.expect("asked before");
    let need = u64::from(rows) * u64::from(columns) * sample.bytes() as u64;
    if u64::from(length) < need {
        return fail(format!("the pixel data has {length} bytes where {columns} x {rows} pixels need {need}"));
    }
    let [slope] = decimals(set, SLOPE)?.unwrap_or([1.0]);
    let [intercept] = decimals(set, INTERCEPT)?.unwrap_or([0.0]);
    if slope == 0.0 {
        return fail("the rescale slope is 0".into());
    }
    Ok(Meaning {
        rows,
        columns,
        sample,
        big_endian: set.big_endian,
        bits: (high.into(), stored.into()),
        spacing: needed(set, PIXEL_SPACING, "pixel spacing")?,
        orientation: needed(set, ORIENTATION, "orientation")?,
        position: needed(set, POSITION, "position")?,
        slope,
        intercept,
        offset,
    })
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// A volume from the images of one series.
fn assemble(folder: &Path, scan: Scan) -> Result<(Volume, Layout), ImportError> {
    let mut images = Vec::with_capacity(scan.images.len());
    for Found { path, set, .. } in scan.images {
        let set = meaning(&set).map_err(|message| malformed(&path, 0, message))?;
        images.push(Image { path, set });
    }
    let Some(first) = images.first().cloned() else {
        return Err(malformed(folder, 0, "the series has no image: its files were taken away"));
    };
    let f = &first.set;
    for image in &images {
        let s = &image.set;
        let differs = |what: &str| {
            Err(malformed(
                &image.path,
                0,
                format!(
                    "{what} differs from {} in the same series: move images of another kind away",
                    first.path.display()
                ),
            ))
        };
        if (s.rows, s.columns) != (f.rows, f.columns) {
            return differs(&format!("the size {} x {} (from {} x {})", s.columns, s.rows, f.columns, f.rows));
        }
        if (s.sample, s.big_endian, s.bits) != (f.sample, f.big_endian, f.bits) {
            return differs("the kind of pixel");
        }
        if s.spacing != f.spacing {
            return differs("the pixel spacing");
        }
        if s.orientation.iter().zip(f.orientation).any(|(a, b)| (a - b).abs() > DIRECTIONS_DIFFER) {
            return differs("the orientation");
        }
    }
    let [o0, o1, o2, o3, o4, o5] = f.orientation;
    let (across, down) = ([o0, o1, o2], [o3, o4, o5]);
    let normal = [
        across[1] * down[2] - across[2] * down[1],
        across[2] * down[0] - across[0] * down[2],
        across[0] * down[1] - across[1] * down[0],
    ];
    images.sort_by(|a, b| dot(a.set.position, normal).total_cmp(&dot(b.set.position, normal)));
    let n = images.len();
    let dims = check_dims(folder, 0, [f.columns.into(), f.rows.into(), n as u64])?;
    let base = images[0].set.position;
    let last = images[n - 1].set.position;
    // one image has no distance to a next one: any will do
    let step = if n == 1 { normal } else { [0, 1, 2].map(|k| (last[k] - base[k]) / (n - 1) as f64) };
    check_spacing(&images, normal, base, step)?;
    // pixel spacing is (between rows, between columns)
    let columns = [across.map(|v| v * f.spacing[1]), down.map(|v| v * f.spacing[0]), step];
    let to_world = super::affine(&images[0].path, |r, c| columns[c][r], |r| base[r])?;
    let (slope, intercept) = (images[0].set.slope, images[0].set.intercept);
    let parts = images.into_iter().map(|i| Part {
        path: i.path,
        slices: 1,
        skip: Skip::Lines(0, i.set.offset),
        gzip: false,
        slope: i.set.slope,
        intercept: i.set.intercept,
    });
    let layout = Layout {
        slice_samples: dims[0] * dims[1],
        sample: f.sample,
        big_endian: f.big_endian,
        bits: Some(f.bits),
        parts: parts.collect(),
    };
    layout.check(folder)?;
    let volume = Volume { dims, to_world, slope, intercept, sample: f.sample, skipped_files: scan.others };
    Ok((volume, layout))
}

/// Sorted images must lie evenly on a line.
fn check_spacing(images: &[Image], normal: [f64; 3], base: [f64; 3], step: [f64; 3]) -> Result<(), ImportError> {
    let gaps: Vec<f64> =
        images.windows(2).map(|w| dot(w[1].set.position, normal) - dot(w[0].set.position, normal)).collect();
    if gaps.is_empty() {
        return Ok(());
    }
    let mut sorted = gaps.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted[sorted.len() / 2];
    for (gap, pair) in gaps.iter().zip(images.windows(2)) {
        if (gap - usual).abs() > UNEVEN * usual || *gap <= 0.0 {
            let why = if *gap < 0.5 * usual || *gap <= 0.0 {
                "two images of one place, or of several passes in one series"
            } else {
                "an image is missing, or the spacing is uneven"
            };
            return Err(malformed(
                &pair[1].path,
                0,
                format!(
                    "it lies {gap:.4} mm after {}, where {usual:.4} mm are usual in this series: {why}",
                    pair[0].path.display()
                ),
            ));
        }
    }
    for (i, image) in images.iter().enumerate() {
        let off = [0, 1, 2].map(|k| image.set.position[k] - (base[k] + step[k] * i as f64));
        // beyond half a spacing
        if dot(off, off).sqrt() > 0.5 * usual {
            return Err(malformed(
                &image.path,
                0,
                format!("it lies {:.3} mm beside the line of its series", dot(off, off).sqrt()),
            ));
        }
    }
    Ok(())
}
