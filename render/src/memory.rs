//! What the processor and the system can be told about memory: neither changes a value.
#![allow(unsafe_code)] // an instruction that reads nothing, and advice to the system

/// Asks for the cache line in which a value begins. Worth it where many values are read that lie in no cache, each a few hundred
/// instructions after it is known where: the processor waits for one after the other otherwise.
#[inline(always)]
pub fn prefetch<T>(place: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint, of an address that may be read; all x86-64 processors know it.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(place).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = place;
}

/// Size of a huge page on x86-64 and, most often, on aarch64.
pub(crate) const HUGE: usize = 2 << 20;
/// From so many bytes on an arena asks for huge pages; they round up what it takes by less than a quarter.
pub(crate) const HUGE_FROM: usize = 8 << 20;
/// From so many bytes on [`widen`] asks for them, for the whole ones inside: one at least, wherever the memory begins.
const WIDE_FROM: usize = 2 * HUGE;

/// An empty vector with room for so many values, in huge pages if it is large and the system has them: for tables that are read here
/// and there, where every read would look up its page too.
pub(crate) fn spacious<T>(count: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(count);
    widen(values.spare_capacity_mut());
    values
}

/// So many zeros, in huge pages if they are many and the system has them; as fresh memory is zero, none is written. Of values that are aligned to more
/// than 16 bytes the standard library would write all, into small pages.
pub(crate) fn zeros<T: bytemuck::Zeroable>(count: usize) -> Vec<T> {
    const { assert!(align_of::<T>() <= 16) };
    let mut values: Vec<T> = bytemuck::zeroed_vec(count);
    let room = std::ptr::slice_from_raw_parts_mut(values.as_mut_ptr().cast(), count);
    // SAFETY: the vector's own values, borrowed mutably; `widen` writes nothing.
    widen::<T>(unsafe { &mut *room });
    values
}

/// Asks for huge pages for memory that nothing was written to, if it is large and the system has them. A hint: what was written before keeps its pages.
pub fn widen<T>(room: &mut [std::mem::MaybeUninit<T>]) {
    let bytes = size_of_val(room);
    #[cfg(target_os = "linux")]
    if bytes >= WIDE_FROM {
        let start = room.as_mut_ptr().cast::<u8>();
        let skipped = start.align_offset(HUGE).min(bytes);
        let whole = (bytes - skipped) & !(HUGE - 1);
        // SAFETY: the range lies in the room; the advice changes none of its bytes, and a system that refuses it keeps small pages.
        unsafe {
            libc::madvise(start.add(skipped).cast(), whole, libc::MADV_HUGEPAGE);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_and_small_vectors_hold_what_is_put_in() {
        for count in [0, 1, 1000, 3 << 20] {
            let mut values = spacious(count);
            assert!(values.capacity() >= count);
            values.extend(0..count as u32);
            assert!(values.iter().enumerate().all(|(i, &v)| v == i as u32));
            let zeros: Vec<u32> = zeros(count);
            assert!(zeros.len() == count && zeros.iter().all(|&v| v == 0));
        }
    }
}
