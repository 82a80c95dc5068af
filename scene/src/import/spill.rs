//! Arrays that are appended to and read at random, in a budget of memory; what exceeds it lies in a mapped temporary file.

#![allow(unsafe_code)] // mapping a file is unsafe: see the SAFETY note at its only place

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::Pod;
use memmap2::{Mmap, MmapOptions};

/// Elements of a chunk: a power of two, and large enough that a chunk of any element size is whole pages (4 bytes x 2^16 = 64 pages).
const CHUNK: usize = 1 << 16;

/// Memory that the arrays of one mesh may take together, and the file for what exceeds it.
pub(super) struct Budget {
    left: u64,
    folder: PathBuf,
    spill_left: u64,
    file: Option<File>,
    length: u64,
}

impl Budget {
    /// `memory` bytes, then up to `spill` bytes of a file in `folder`.
    pub fn new(memory: u64, spill: u64, folder: PathBuf) -> Self {
        Budget { left: memory, folder, spill_left: spill, file: None, length: 0 }
    }

    /// Bytes in the file.
    pub fn spilled(&self) -> u64 {
        self.length
    }

    /// Takes memory that is not in an array; false if it is not there.
    pub fn take(&mut self, bytes: u64) -> bool {
        let fits = bytes <= self.left;
        self.left -= if fits { bytes } else { 0 };
        fits
    }

    /// Writes a chunk to the file and maps it.
    fn spill(&mut self, bytes: &[u8]) -> io::Result<Mmap> {
        let Some(left) = self.spill_left.checked_sub(bytes.len() as u64) else {
            return Err(io::Error::other("the vertex arrays exceed the memory budget and the limit of the spill file"));
        };
        self.spill_left = left;
        if self.file.is_none() {
            self.file = Some(temporary_file(&self.folder)?);
        }
        let Some(file) = &mut self.file else { unreachable!("made above") };
        file.write_all(bytes)?;
        // SAFETY: the file has no name any more, so that no other process can reach it; this process only appends to it, and
        // never truncates it, so the mapped range stays as it is. Its bytes were written (not sparse), so that a full disk is
        // an error of write and no fault of a read.
        let map = unsafe { MmapOptions::new().offset(self.length).len(bytes.len()).map(&*file)? };
        self.length += bytes.len() as u64;
        Ok(map)
    }
}

/// A file without a name.
pub(crate) fn temporary_file(folder: &std::path::Path) -> io::Result<File> {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    loop {
        let name = format!(".rayherd-{}-{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed));
        let path = folder.join(name);
        match OpenOptions::new().read(true).write(true).create_new(true).open(&path) {
            Ok(file) => {
                std::fs::remove_file(&path)?;
                return Ok(file);
            }
            // left by a process of the same number that was killed between the two calls
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(e),
        }
    }
}

/// An array.
pub(super) struct Column<T> {
    chunks: Vec<Chunk<T>>,
    tail: Vec<T>,
}

enum Chunk<T> {
    Memory(Box<[T]>),
    Mapped(Mmap),
}

impl<T: Pod> Column<T> {
    /// An empty array.
    pub fn new() -> Self {
        Column { chunks: vec![], tail: vec![] }
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.chunks.len() * CHUNK + self.tail.len()
    }

    /// Appends one.
    #[inline]
    pub fn push(&mut self, value: T, budget: &mut Budget) -> io::Result<()> {
        self.tail.push(value);
        if self.tail.len() == CHUNK { self.close_chunk(budget) } else { Ok(()) }
    }

    fn close_chunk(&mut self, budget: &mut Budget) -> io::Result<()> {
        let chunk = if budget.take((CHUNK * size_of::<T>()) as u64) {
            Chunk::Memory(std::mem::replace(&mut self.tail, Vec::with_capacity(CHUNK)).into_boxed_slice())
        } else {
            let map = budget.spill(bytemuck::cast_slice(&self.tail))?;
            self.tail.clear();
            Chunk::Mapped(map)
        };
        self.chunks.push(chunk);
        Ok(())
    }

    /// The element of a number.
    #[inline]
    pub fn get(&self, i: usize) -> Option<T> {
        match self.chunks.get(i / CHUNK) {
            Some(Chunk::Memory(values)) => values.get(i % CHUNK).copied(),
            Some(Chunk::Mapped(map)) => bytemuck::cast_slice(map).get(i % CHUNK).copied(),
            None if i / CHUNK == self.chunks.len() => self.tail.get(i % CHUNK).copied(),
            None => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_spills_reads_like_what_does_not() {
        let n = 3 * CHUNK + 5;
        for (memory, spilled) in [(u64::MAX, 0), ((CHUNK * 12) as u64, 2 * CHUNK * 12), (0, 3 * CHUNK * 12)] {
            let mut budget = Budget::new(memory, u64::MAX, std::env::temp_dir());
            let mut column = Column::new();
            for i in 0..n {
                column.push([i as f32, 0.5, -(i as f32)], &mut budget).unwrap();
            }
            assert_eq!(budget.spilled(), spilled as u64);
            assert_eq!(column.len(), n);
            for i in (0..n).step_by(997).chain(n - 5..n) {
                assert_eq!(column.get(i), Some([i as f32, 0.5, -(i as f32)]));
            }
            assert_eq!(column.get(n), None);
            assert_eq!(column.get(usize::MAX), None);
        }
    }

    #[test]
    fn the_file_has_a_limit() {
        let mut budget = Budget::new(0, CHUNK as u64 * 8, std::env::temp_dir());
        let mut column = Column::new();
        let pushed = (0..3 * CHUNK as u64).take_while(|&i| column.push(i, &mut budget).is_ok()).count();
        assert_eq!(pushed, 2 * CHUNK - 1);
    }
}
