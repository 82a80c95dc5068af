//! A range of memory of its own pages, huge ones where the system has them.
#![allow(unsafe_code)] // anonymous memory is had from the operating system by pointers

use std::ptr::NonNull;

use crate::memory::{HUGE, HUGE_FROM};

/// Zeroed memory that is reserved at once and costs pages only where it was written.
pub(super) struct Arena {
    /// What was mapped.
    mapping: NonNull<u8>,
    mapped: usize,
    /// First multiple of [`HUGE`] in it.
    base: NonNull<u8>,
    len: usize,
}

// SAFETY: the arena owns its mapping as a Vec owns its buffer; sharing gives out shared slices only.
unsafe impl Send for Arena {}
// SAFETY: as above.
unsafe impl Sync for Arena {}

impl Arena {
    /// Reserves `len` bytes of addresses, at least 1.
    pub fn reserve(len: usize) -> Result<Arena, std::io::Error> {
        let too_large = || std::io::Error::new(std::io::ErrorKind::InvalidInput, "more bytes than there are addresses");
        let mapped = len.max(1).checked_add(2 * HUGE).ok_or_else(too_large)? & !(HUGE - 1);
        // SAFETY: a fresh private anonymous mapping touches nothing that exists.
        let address = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                mapped,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_NORESERVE,
                -1,
                0,
            )
        };
        if address == libc::MAP_FAILED {
            return Err(std::io::Error::last_os_error());
        }
        let mapping = NonNull::new(address.cast::<u8>()).ok_or_else(std::io::Error::last_os_error)?;
        let skip = mapping.addr().get().next_multiple_of(HUGE) - mapping.addr().get();
        // a small arena would take a huge page for each of its parts, and many of them are held at a time
        #[cfg(target_os = "linux")]
        if len >= HUGE_FROM {
            // SAFETY: the range is our own mapping. A system without huge pages refuses, and small ones serve, more slowly.
            unsafe {
                libc::madvise(address, mapped, libc::MADV_HUGEPAGE);
            }
        }
        // SAFETY: skip < HUGE <= mapped - len.
        let base = unsafe { mapping.add(skip) };
        Ok(Arena { mapping, mapped, base, len })
    }

    /// All of it.
    #[inline(always)]
    pub fn bytes(&self) -> &[u8] {
        // SAFETY: base..base + len lies in the mapping, is initialised (zeros) and lives as long as self.
        unsafe { std::slice::from_raw_parts(self.base.as_ptr(), self.len) }
    }
    /// All of it, to write.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as for `bytes`, and self is borrowed mutably.
        unsafe { std::slice::from_raw_parts_mut(self.base.as_ptr(), self.len) }
    }

    /// Gives the whole small pages within the range back to the system; they read as zeros afterwards.
    pub fn discard(&mut self, at: usize, len: usize) {
        const PAGE: usize = 4096;
        assert!(at <= self.len && len <= self.len - at);
        let (first, end) = (at.next_multiple_of(PAGE), (at + len) & !(PAGE - 1));
        if first < end {
            // SAFETY: the pages lie in our mapping, and nobody else borrows them. On Linux private anonymous pages read
            // as zeros after this; a system with larger pages refuses unaligned ranges and keeps them as they are.
            unsafe {
                libc::madvise(self.base.as_ptr().add(first).cast(), end - first, libc::MADV_DONTNEED);
            }
        }
    }
}

impl Drop for Arena {
    fn drop(&mut self) {
        // SAFETY: mapped by `reserve`, unmapped once.
        unsafe {
            libc::munmap(self.mapping.as_ptr().cast(), self.mapped);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn starts_as_zeros_and_keeps_what_is_written() {
        let mut arena = Arena::reserve(10 << 20).unwrap();
        assert_eq!(arena.bytes().len(), 10 << 20);
        assert!(arena.bytes().iter().all(|&b| b == 0));
        arena.bytes_mut()[10 << 19] = 7;
        assert_eq!(arena.bytes()[10 << 19], 7);
        assert_eq!(arena.bytes().as_ptr() as usize % HUGE, 0);
    }

    #[test]
    fn too_much_is_an_error() {
        assert!(Arena::reserve(usize::MAX).is_err());
        assert!(Arena::reserve(1 << 62).is_err());
    }

    #[test]
    fn discards_whole_pages_only() {
        let mut arena = Arena::reserve(1 << 16).unwrap();
        arena.bytes_mut().fill(1);
        arena.discard(100, 5000);
        assert_eq!(arena.bytes()[..4096], [1; 4096]);
        assert_eq!(arena.bytes()[4096..8192], [1; 4096]);
        arena.discard(4096, 4096);
        assert_eq!(arena.bytes()[..4096], [1; 4096]);
        assert_eq!(arena.bytes()[8192..12288], [1; 4096]);
    }
}
