//! Records that wait between passes: in memory while they are few, in a temporary file beyond.

use std::fs::File;
use std::io::{self, Write};
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use super::records::Records;
use super::settings::SpoolSettings;

/// Chunks of records, by number.
#[derive(Debug)]
pub(crate) struct Spool {
    chunks: Vec<Chunk>,
    memory: u64,
    most_memory: u64,
    folder: PathBuf,
    file: Option<File>,
    written: u64,
    read: AtomicU64,
}

#[derive(Debug)]
struct Chunk {
    /// Primitives before it.
    first: u64,
    len: usize,
    place: Stored,
}

#[derive(Debug)]
enum Stored {
    Memory(Records),
    File { offset: u64, bytes: u64 },
}

impl Spool {
    pub(crate) fn new(settings: &SpoolSettings) -> Self {
        Spool {
            chunks: Vec::new(),
            memory: 0,
            most_memory: settings.memory,
            folder: settings.folder.clone().unwrap_or_else(std::env::temp_dir),
            file: None,
            written: 0,
            read: AtomicU64::new(0),
        }
    }

    /// Where the file is, for messages.
    pub(crate) fn folder(&self) -> &PathBuf {
        &self.folder
    }

    /// Adds a chunk and returns its number.
    pub(crate) fn push(&mut self, records: Records) -> io::Result<usize> {
        let first = self.chunks.last().map_or(0, |c| c.first + c.len as u64);
        let (len, bytes) = (records.len(), records.bytes());
        let place = if self.memory + bytes <= self.most_memory {
            self.memory += bytes;
            Stored::Memory(records)
        } else {
            let mut body = Vec::with_capacity(bytes as usize);
            records.write(&mut body);
            let file = match &mut self.file {
                Some(file) => file,
                // it has no name, and vanishes with this process
                none => none.insert(tempfile::tempfile_in(&self.folder)?),
            };
            file.write_all(&body)?;
            let offset = self.written;
            self.written += bytes;
            Stored::File { offset, bytes }
        };
        self.chunks.push(Chunk { first, len, place });
        Ok(self.chunks.len() - 1)
    }

    /// Appends a chunk to `out`.
    pub(crate) fn load(&self, chunk: usize, out: &mut Records) -> io::Result<()> {
        self.load_part(chunk, 0, usize::MAX, out)
    }

    /// The primitives of a range, counted over the chunks that were pushed first.
    pub(crate) fn range(&self, range: &Range<u64>) -> io::Result<Records> {
        let mut out = Records::default();
        let mut at = range.start;
        let mut number = self.chunks.partition_point(|c| c.first + c.len as u64 <= at);
        while at < range.end {
            let chunk = &self.chunks[number];
            let skip = (at - chunk.first) as usize;
            let take = (chunk.len - skip).min((range.end - at) as usize);
            self.load_part(number, skip, take, &mut out)?;
            at += take as u64;
            number += 1;
        }
        Ok(out)
    }

    fn load_part(&self, number: usize, skip: usize, take: usize, out: &mut Records) -> io::Result<()> {
        match &self.chunks[number].place {
            Stored::Memory(records) => out.append_range(records, skip, take),
            Stored::File { offset, bytes } => {
                let broken = || io::Error::new(io::ErrorKind::InvalidData, "the temporary file was changed");
                let mut body = vec![0; *bytes as usize];
                self.file.as_ref().ok_or_else(broken)?.read_exact_at(&mut body, *offset)?;
                self.read.fetch_add(*bytes, Ordering::Relaxed);
                out.append_range(&Records::read(&body).ok_or_else(broken)?, skip, take);
            }
        }
        Ok(())
    }

    /// Bytes written to the file and read from it.
    pub(crate) fn traffic(&self) -> (u64, u64) {
        (self.written, self.read.load(Ordering::Relaxed))
    }
}
