//! Arrays that are appended to and read at random, in a budget of memory; what exceeds it lies in a mapped temporary file.

#![allow(unsafe_code)] // mapping a file is unsafe: see the SAFETY note at its only place

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::Pod;
use memmap2::{Mmap, MmapMut, MmapOptions};

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

    /// Takes memory; false if it is not there.
    fn take(&mut self, bytes: u64) -> bool {
        let fits = bytes <= self.left;
        self.left -= if fits { bytes } else { 0 };
        fits
    }

    /// The file, for so many bytes more.
    fn file(&mut self, bytes: u64) -> io::Result<&mut File> {
        let Some(left) = self.spill_left.checked_sub(bytes) else {
            return Err(io::Error::other("the vertex arrays exceed the memory budget and the limit of the spill file"));
        };
        self.spill_left = left;
        if self.file.is_none() {
            self.file = Some(temporary_file(&self.folder)?);
        }
        let Some(file) = &mut self.file else { unreachable!("made above") };
        Ok(file)
    }

    /// Writes a chunk to the file and maps it.
    fn spill(&mut self, bytes: &[u8]) -> io::Result<Mmap> {
        let at = self.length;
        let file = self.file(bytes.len() as u64)?;
        file.write_all(bytes)?;
        // SAFETY: the file has no name any more, so that no other process can reach it; this process only appends to it, and
        // never truncates it, so the mapped range stays as it is. Its bytes were written (not sparse), so that a full disk is
        // an error of write and no fault of a read.
        let map = unsafe { MmapOptions::new().offset(at).len(bytes.len()).map(&*file)? };
        self.length += bytes.len() as u64;
        Ok(map)
    }

    /// Writes so many zeros to the file and maps them, to be changed.
    fn spill_zeros(&mut self, bytes: u64) -> io::Result<MmapMut> {
        static ZEROS: [u8; 1 << 16] = [0; 1 << 16];
        // whole pages, so that what comes after begins at a page again
        let (at, whole) = (self.length, bytes.next_multiple_of(ZEROS.len() as u64));
        let file = self.file(whole)?;
        for _ in 0..whole / ZEROS.len() as u64 {
            file.write_all(&ZEROS)?;
        }
        // SAFETY: as in `spill`; and no other map covers this range, so that the one who gets this one alone reads and changes it.
        let map = unsafe { MmapOptions::new().offset(at).len(bytes as usize).map_mut(&*file)? };
        self.length += whole;
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

/// An array of fixed length that is changed at random.
pub(super) enum Table<T> {
    Memory(Vec<T>),
    Mapped(MmapMut),
}

impl<T: Pod> Table<T> {
    /// All zeros.
    pub fn zeroed(len: usize, budget: &mut Budget) -> io::Result<Self> {
        let bytes = (len * size_of::<T>()) as u64;
        Ok(match budget.take(bytes) {
            true => Table::Memory(vec![T::zeroed(); len]),
            false => Table::Mapped(budget.spill_zeros(bytes)?),
        })
    }

    /// All elements.
    pub fn values(&self) -> &[T] {
        match self {
            Table::Memory(values) => values,
            Table::Mapped(map) => bytemuck::cast_slice(map),
        }
    }

    /// All elements, to be changed.
    pub fn values_mut(&mut self) -> &mut [T] {
        match self {
            Table::Memory(values) => values,
            Table::Mapped(map) => bytemuck::cast_slice_mut(map),
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
    fn a_table_that_spills_holds_what_is_put_into_it() {
        for memory in [u64::MAX, 0] {
            let mut budget = Budget::new(memory, u64::MAX, std::env::temp_dir());
            let mut column = Column::new();
            let n = 3 * CHUNK + 11;
            let mut table = Table::<[f64; 3]>::zeroed(n, &mut budget).unwrap();
            for i in (0..n).rev().step_by(7) {
                table.values_mut()[i][1] += i as f64;
            }
            // what comes after it in the file does not touch it
            (0..2 * CHUNK).for_each(|i| column.push(i as u32, &mut budget).unwrap());
            assert_eq!(budget.spilled() > 0, memory == 0);
            for (i, v) in table.values().iter().enumerate() {
                let want = if (n - 1 - i).is_multiple_of(7) { i as f64 } else { 0.0 };
                assert_eq!(*v, [0.0, want, 0.0]);
            }
            assert_eq!(column.get(CHUNK + 3), Some(CHUNK as u32 + 3));
        }
        assert!(Table::<u64>::zeroed(10, &mut Budget::new(0, 100, std::env::temp_dir())).is_err());
        assert_eq!(Table::<u64>::zeroed(0, &mut Budget::new(0, 0, std::env::temp_dir())).unwrap().values(), [0; 0]);
    }

    #[test]
    fn the_file_has_a_limit() {
        let mut budget = Budget::new(0, CHUNK as u64 * 8, std::env::temp_dir());
        let mut column = Column::new();
        let pushed = (0..3 * CHUNK as u64).take_while(|&i| column.push(i, &mut budget).is_ok()).count();
        assert_eq!(pushed, 2 * CHUNK - 1);
    }
}
