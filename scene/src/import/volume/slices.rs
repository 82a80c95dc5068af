//! A pass over a volume's slices, one in memory at a time.

use std::cell::Cell;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use std::rc::Rc;

use flate2::bufread::MultiGzDecoder;

use super::layout::{Layout, Part, SampleType, Skip};
use super::malformed;
use crate::ImportError;
use crate::import::regular;

/// Slices in z order, each once.
pub struct Slices<'a> {
    layout: &'a Layout,
    part: usize,
    /// Slices of the part that are read.
    done: usize,
    reader: Option<Box<dyn Read>>,
    raw: Vec<u8>,
    bytes: Bytes,
}

impl<'a> Slices<'a> {
    pub(super) fn new(layout: &'a Layout) -> Self {
        Slices { layout, part: 0, done: 0, reader: None, raw: Vec::new(), bytes: Rc::default() }
    }

    /// Bytes read from files so far in this pass (compressed ones where the file is compressed).
    pub fn bytes_read(&self) -> u64 {
        self.bytes.get()
    }

    /// Replaces `out` by the rescaled samples of the next slice, x fastest; false at the end (`out` is then empty).
    pub fn next(&mut self, out: &mut Vec<f64>) -> Result<bool, ImportError> {
        out.clear();
        let Some(part) = self.layout.parts.get(self.part) else { return Ok(false) };
        if self.reader.is_none() {
            let opened = open_part(part, self.layout, &self.bytes);
            self.reader = Some(opened.map_err(|e| self.explain(part, e))?);
        }
        self.raw.resize(self.layout.slice_bytes(), 0);
        let reader = self.reader.as_mut().expect("opened above");
        // never more is decompressed than the header's sizes need, but for one byte, which makes gzip check its sum
        let last = part.gzip && self.done + 1 == part.slices;
        let read =
            reader.read_exact(&mut self.raw).and_then(|()| if last { reader.read(&mut [0]).map(drop) } else { Ok(()) });
        if let Err(e) = read {
            return Err(self.explain(part, e));
        }
        decode(&self.raw, self.layout, part, out);
        self.done += 1;
        if self.done == part.slices {
            self.reader = None;
            self.done = 0;
            self.part += 1;
        }
        Ok(true)
    }

    fn explain(&self, part: &Part, e: io::Error) -> ImportError {
        let before: usize = self.layout.parts[..self.part].iter().map(|p| p.slices).sum();
        let slice = before + self.done;
        match e.kind() {
            io::ErrorKind::UnexpectedEof => {
                malformed(&part.path, 0, format!("ends before slice {slice} (from 0) does"))
            }
            io::ErrorKind::InvalidData | io::ErrorKind::InvalidInput => {
                malformed(&part.path, 0, format!("bad data in slice {slice} (from 0): {e}"))
            }
            _ => ImportError::Io { path: part.path.clone(), source: e },
        }
    }
}

/// Bytes read from some files together.
pub(super) type Bytes = Rc<Cell<u64>>;

/// Counts what is read from a file.
pub(super) struct Counted {
    file: File,
    bytes: Bytes,
}

impl Counted {
    /// Opens a regular file.
    pub fn open(path: &Path, bytes: &Bytes) -> io::Result<Self> {
        Ok(Counted { file: regular::open(path)?.0, bytes: bytes.clone() })
    }
}

impl Seek for Counted {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

impl Read for Counted {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.file.read(buffer)?;
        self.bytes.set(self.bytes.get() + n as u64);
        Ok(n)
    }
}

/// A reader at the part's first sample.
fn open_part(part: &Part, layout: &Layout, bytes: &Bytes) -> io::Result<Box<dyn Read>> {
    let mut file = Counted::open(&part.path, bytes)?;
    let need = layout.slice_bytes() as u64 * part.slices as u64;
    let (lines, skip) = match part.skip {
        Skip::Lines(lines, skip) => (lines, skip),
        Skip::FromEnd => {
            let start = file.seek(SeekFrom::End(0))?.checked_sub(need).ok_or(io::ErrorKind::UnexpectedEof)?;
            (0, start)
        }
    };
    if lines == 0 && !part.gzip {
        // no buffer: slices are large, and nothing beyond them is read
        file.seek(SeekFrom::Start(skip))?;
        return Ok(Box::new(file));
    }
    file.rewind()?;
    let mut reader = BufReader::new(file);
    for _ in 0..lines {
        reader.skip_until(b'\n')?;
    }
    let mut reader: Box<dyn Read> = if part.gzip { Box::new(MultiGzDecoder::new(reader)) } else { Box::new(reader) };
    let skipped = io::copy(&mut reader.by_ref().take(skip), &mut io::sink())?;
    if skipped < skip {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Ok(reader)
}

/// Stored samples to values.
fn decode(raw: &[u8], layout: &Layout, part: &Part, out: &mut Vec<f64>) {
    /// One loop per type, so that each is a plain vector loop. No value needs more than f64 but 64 bit integers, which are
    /// rounded.
    macro_rules! each {
        ($type:ty, $map:expr) => {{
            let map = $map;
            let (samples, _) = raw.as_chunks::<{ size_of::<$type>() }>();
            let (slope, intercept) = (part.slope, part.intercept);
            if layout.big_endian {
                out.extend(samples.iter().map(|&b| map(<$type>::from_be_bytes(b)) as f64 * slope + intercept));
            } else {
                out.extend(samples.iter().map(|&b| map(<$type>::from_le_bytes(b)) as f64 * slope + intercept));
            }
        }};
    }
    // bits in use: shifted to the top and back, which extends the sign
    let unused = layout.bits.map(|(high, count)| {
        let width = 8 * layout.sample.bytes() as u32;
        (width - 1 - high, width - count)
    });
    macro_rules! integer {
        ($type:ty) => {
            match unused {
                Some((up, down)) if down > 0 => each!($type, |v: $type| (v << up) >> down),
                _ => each!($type, |v: $type| v),
            }
        };
    }
    match layout.sample {
        SampleType::U8 => integer!(u8),
        SampleType::I8 => integer!(i8),
        SampleType::U16 => integer!(u16),
        SampleType::I16 => integer!(i16),
        SampleType::U32 => integer!(u32),
        SampleType::I32 => integer!(i32),
        SampleType::U64 => integer!(u64),
        SampleType::I64 => integer!(i64),
        SampleType::F32 => each!(f32, |v: f32| v),
        SampleType::F64 => each!(f64, |v: f64| v),
    }
}
