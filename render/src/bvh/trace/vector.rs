//! What differs between the instruction sets of the vector kernel, and sorting networks.
#![allow(unsafe_code)] // intrinsics: every function here is inlined into an entry that enables the features

use std::arch::x86_64::*;

/// Operations of an instruction set on eight lanes. Functions take part in the caller's code, without features of their
/// own: otherwise vectors would be passed through memory.
///
/// # Safety
/// All are to be called where the instruction set is enabled.
pub(super) trait InstructionSet {
    /// Mask of the lanes for which the comparison holds.
    unsafe fn compare<const OP: i32>(a: __m256, b: __m256) -> u32;
    /// Lanes of the mask moved to the front, the others filled. (Never compressed to memory: very slow on Zen 4.)
    unsafe fn compress(mask: u32, x: __m256i, fill: i32) -> __m256i;
}

pub(super) struct Avx512;

impl InstructionSet for Avx512 {
    #[inline(always)]
    unsafe fn compare<const OP: i32>(a: __m256, b: __m256) -> u32 {
        // SAFETY: the caller has AVX-512 VL.
        unsafe { u32::from(_mm256_cmp_ps_mask::<OP>(a, b)) }
    }
    #[inline(always)]
    unsafe fn compress(mask: u32, x: __m256i, fill: i32) -> __m256i {
        // SAFETY: the caller has AVX-512 VL.
        unsafe { _mm256_mask_compress_epi32(_mm256_set1_epi32(fill), mask as u8, x) }
    }
}

pub(super) struct Avx2;

impl InstructionSet for Avx2 {
    #[inline(always)]
    unsafe fn compare<const OP: i32>(a: __m256, b: __m256) -> u32 {
        // SAFETY: the caller has AVX.
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<OP>(a, b)) as u32 }
    }
    #[inline(always)]
    unsafe fn compress(mask: u32, x: __m256i, fill: i32) -> __m256i {
        // SAFETY: the caller has AVX2; a row of the table has the 8 bytes that are read.
        unsafe {
            // lanes past the count have bit 7 set, which sign extension turns into a blend mask
            let lanes = _mm256_cvtepi8_epi32(_mm_loadl_epi64(COMPRESS[mask as usize & 255].as_ptr().cast()));
            let front = _mm256_castsi256_ps(_mm256_permutevar8x32_epi32(x, lanes));
            let fill = _mm256_castsi256_ps(_mm256_set1_epi32(fill));
            _mm256_castps_si256(_mm256_blendv_ps(front, fill, _mm256_castsi256_ps(lanes)))
        }
    }
}

/// For each mask the lanes to move to the front; 128 past them.
static COMPRESS: [[u8; 8]; 256] = {
    let mut table = [[128u8; 8]; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut lane, mut n) = (0, 0);
        while lane < 8 {
            if mask >> lane & 1 != 0 {
                table[mask][n] = lane;
                n += 1;
            }
            lane += 1;
        }
        mask += 1;
    }
    table
};

/// One layer of a sorting network: lanes in the mask take the smaller of themselves and their partner, others the larger.
macro_rules! layer {
    ($v:expr, $partners:expr, $max:ident, $min:ident, $blend:ident, $mask:literal) => {{
        let partners = $partners;
        $blend::<$mask>($max($v, partners), $min($v, partners))
    }};
}

/// Sorts four keys, largest first (Batcher's odd-even merge).
///
/// # Safety
/// Needs AVX2.
#[inline(always)]
pub(super) unsafe fn sort4(v: __m128i) -> __m128i {
    // SAFETY: the caller has AVX2.
    unsafe {
        let v = layer!(v, _mm_shuffle_epi32::<0xB1>(v), _mm_max_epi32, _mm_min_epi32, _mm_blend_epi32, 0b1010);
        let v = layer!(v, _mm_shuffle_epi32::<0x4E>(v), _mm_max_epi32, _mm_min_epi32, _mm_blend_epi32, 0b1100);
        layer!(v, _mm_shuffle_epi32::<0xD8>(v), _mm_max_epi32, _mm_min_epi32, _mm_blend_epi32, 0b0100)
    }
}

/// Sorts eight keys, largest first (Batcher's odd-even merge).
///
/// # Safety
/// Needs AVX2.
#[inline(always)]
pub(super) unsafe fn sort8(v: __m256i) -> __m256i {
    macro_rules! layer8 {
        ($v:expr, $partners:expr, $mask:literal) => {
            layer!($v, $partners, _mm256_max_epi32, _mm256_min_epi32, _mm256_blend_epi32, $mask)
        };
    }
    // SAFETY: the caller has AVX2.
    unsafe {
        let v = layer8!(v, _mm256_shuffle_epi32::<0xB1>(v), 0b1010_1010);
        let v = layer8!(v, _mm256_shuffle_epi32::<0x4E>(v), 0b1100_1100);
        let v = layer8!(v, _mm256_shuffle_epi32::<0xD8>(v), 0b0100_0100);
        let v = layer8!(v, _mm256_permute4x64_epi64::<0x4E>(v), 0b1111_0000);
        let v = layer8!(v, _mm256_permute4x64_epi64::<0xD8>(v), 0b0011_0000);
        let across = _mm256_setr_epi32(0, 2, 1, 4, 3, 6, 5, 7);
        layer8!(v, _mm256_permutevar8x32_epi32(v, across), 0b0101_0100)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[target_feature(enable = "avx2")]
    fn sorted(keys: [i32; 8]) -> ([i32; 8], [i32; 4]) {
        let (mut eight, mut four) = ([0; 8], [0; 4]);
        // SAFETY: AVX2 is enabled here; the arrays have the size of the vectors.
        unsafe {
            let v = _mm256_loadu_si256(keys.as_ptr().cast());
            _mm256_storeu_si256(eight.as_mut_ptr().cast(), sort8(v));
            _mm_storeu_si128(four.as_mut_ptr().cast(), sort4(_mm256_castsi256_si128(v)));
        }
        (eight, four)
    }

    #[target_feature(enable = "avx2")]
    fn compressed(mask: u32, x: [i32; 8]) -> [i32; 8] {
        let mut out = [0; 8];
        // SAFETY: as above.
        unsafe {
            let v = Avx2::compress(mask, _mm256_loadu_si256(x.as_ptr().cast()), -1);
            _mm256_storeu_si256(out.as_mut_ptr().cast(), v);
        }
        out
    }

    #[test]
    fn networks_sort_every_pattern_of_zeros_and_ones() {
        if !is_x86_feature_detected!("avx2") {
            println!("no AVX2 here: not tested");
            return;
        }
        // the 0-1 principle: a network that sorts these sorts everything
        for mask in 0..256u32 {
            let keys: [i32; 8] = std::array::from_fn(|i| (mask >> i & 1) as i32);
            // SAFETY: AVX2 was found.
            let (eight, four) = unsafe { sorted(keys) };
            assert!(eight.is_sorted_by(|a, b| a >= b), "{keys:?} {eight:?}");
            assert!(four.is_sorted_by(|a, b| a >= b), "{keys:?} {four:?}");
            assert_eq!(eight.iter().sum::<i32>(), mask.count_ones() as i32);
            // SAFETY: as above.
            let out = unsafe { compressed(mask, [0, 1, 2, 3, 4, 5, 6, 7]) };
            let expected: Vec<i32> = (0..8).filter(|i| mask >> i & 1 != 0).collect();
            assert_eq!(out[..expected.len()], expected);
            assert!(out[expected.len()..].iter().all(|&x| x == -1));
        }
    }
}
