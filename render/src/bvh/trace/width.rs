//! Vectors with a ray in each lane: eight of them with AVX2, sixteen with AVX-512.
#![allow(unsafe_code)] // intrinsics: every function here is inlined into an entry that enables the features

use std::arch::x86_64::*;

use crate::ray::Ray;

/// Operations of an instruction set on a packet of rays. As with [`super::vector::InstructionSet`], functions take part in the caller's
/// code; and code that uses them has no closures, which would not.
///
/// Comparisons with NaN are false; of two zeros and of a NaN, `min` and `max` give the second operand.
///
/// # Safety
/// All are to be called where the instruction set is enabled; pointers lead to as many values as there are lanes.
pub(super) trait Width {
    /// Number of lanes.
    const LANES: usize;
    /// An f32 in each lane.
    type F: Copy;
    /// An f64 in each lane.
    type D: Copy;
    /// Yes or no in each lane.
    type Mask: Copy;

    unsafe fn all(x: f32) -> Self::F;
    unsafe fn load(from: *const f32) -> Self::F;
    unsafe fn store(to: *mut f32, x: Self::F);
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn sub(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn min(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn max(a: Self::F, b: Self::F) -> Self::F;
    /// a b + c, fused.
    unsafe fn fmadd(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// a b - c, fused.
    unsafe fn fmsub(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c - a b, fused.
    unsafe fn fnmadd(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    unsafe fn abs(x: Self::F) -> Self::F;
    /// The first one's bits where the mask holds, the second one's elsewhere.
    unsafe fn select(mask: Self::Mask, a: Self::F, b: Self::F) -> Self::F;
    /// Whether the sign bit is set.
    unsafe fn is_negative(x: Self::F) -> Self::Mask;
    unsafe fn lt(a: Self::F, b: Self::F) -> Self::Mask;
    unsafe fn le(a: Self::F, b: Self::F) -> Self::Mask;
    unsafe fn eq(a: Self::F, b: Self::F) -> Self::Mask;
    unsafe fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    unsafe fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// The mask as bits, that of the first lane lowest.
    unsafe fn bits(mask: Self::Mask) -> u32;
    /// The mask of such bits.
    unsafe fn of_bits(bits: u32) -> Self::Mask;
    /// The least value where the mask holds, infinite if it holds nowhere.
    unsafe fn least(mask: Self::Mask, x: Self::F) -> f32;

    unsafe fn all_wide(x: f64) -> Self::D;
    unsafe fn widen(x: Self::F) -> Self::D;
    /// Rounded to the nearest.
    unsafe fn narrow(x: Self::D) -> Self::F;
    unsafe fn add_wide(a: Self::D, b: Self::D) -> Self::D;
    unsafe fn sub_wide(a: Self::D, b: Self::D) -> Self::D;
    unsafe fn mul_wide(a: Self::D, b: Self::D) -> Self::D;
    unsafe fn div_wide(a: Self::D, b: Self::D) -> Self::D;
    unsafe fn sqrt_wide(x: Self::D) -> Self::D;
    unsafe fn le_wide(a: Self::D, b: Self::D) -> Self::Mask;

    /// The eight members of the rays with these numbers.
    unsafe fn columns(rays: *const Ray, numbers: *const u32) -> [Self::F; 8];
}

/// Functions of one instruction each.
macro_rules! instructions {
    ($($name:ident($($x:ident),+: $t:ty) -> $r:ty = $f:expr;)*) => {$(
        #[inline(always)]
        unsafe fn $name($($x: $t),+) -> $r {
            // SAFETY: the caller has the instruction set.
            unsafe { $f($($x),+) }
        }
    )*};
}
/// The same for f64, in two registers.
macro_rules! both {
    ($($name:ident($($x:ident),+: $t:ty) = $f:ident;)*) => {$(
        #[inline(always)]
        unsafe fn $name($($x: [$t; 2]),+) -> [$t; 2] {
            // SAFETY: the caller has the instruction set.
            unsafe { [$f($($x[0]),+), $f($($x[1]),+)] }
        }
    )*};
}

/// Eight lanes: AVX2 and FMA.
pub(super) struct Eight;

impl Width for Eight {
    const LANES: usize = 8;
    type F = __m256;
    type D = [__m256d; 2];
    type Mask = __m256;

    instructions! {
        all(x: f32) -> __m256 = _mm256_set1_ps;
        load(from: *const f32) -> __m256 = _mm256_loadu_ps;
        add(a, b: __m256) -> __m256 = _mm256_add_ps;
        sub(a, b: __m256) -> __m256 = _mm256_sub_ps;
        mul(a, b: __m256) -> __m256 = _mm256_mul_ps;
        div(a, b: __m256) -> __m256 = _mm256_div_ps;
        min(a, b: __m256) -> __m256 = _mm256_min_ps;
        max(a, b: __m256) -> __m256 = _mm256_max_ps;
        fmadd(a, b, c: __m256) -> __m256 = _mm256_fmadd_ps;
        fmsub(a, b, c: __m256) -> __m256 = _mm256_fmsub_ps;
        fnmadd(a, b, c: __m256) -> __m256 = _mm256_fnmadd_ps;
        lt(a, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_LT_OQ>;
        le(a, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_LE_OQ>;
        eq(a, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_EQ_OQ>;
        and(a, b: __m256) -> __m256 = _mm256_and_ps;
        or(a, b: __m256) -> __m256 = _mm256_or_ps;
    }
    both! {
        add_wide(a, b: __m256d) = _mm256_add_pd;
        sub_wide(a, b: __m256d) = _mm256_sub_pd;
        mul_wide(a, b: __m256d) = _mm256_mul_pd;
        div_wide(a, b: __m256d) = _mm256_div_pd;
        sqrt_wide(x: __m256d) = _mm256_sqrt_pd;
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, x: __m256) {
        // SAFETY: the caller's.
        unsafe { _mm256_storeu_ps(to, x) }
    }
    #[inline(always)]
    unsafe fn abs(x: __m256) -> __m256 {
        // SAFETY: the caller's.
        unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), x) }
    }
    #[inline(always)]
    unsafe fn select(mask: __m256, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the caller's.
        unsafe { _mm256_blendv_ps(b, a, mask) }
    }
    #[inline(always)]
    unsafe fn is_negative(x: __m256) -> __m256 {
        // a mask's lanes are read by their sign bits, and by `and` and `or` bit by bit
        x
    }
    #[inline(always)]
    unsafe fn bits(mask: __m256) -> u32 {
        // SAFETY: the caller's.
        unsafe { _mm256_movemask_ps(mask) as u32 }
    }
    #[inline(always)]
    unsafe fn of_bits(bits: u32) -> __m256 {
        // SAFETY: the caller's.
        unsafe {
            let each = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let set = _mm256_and_si256(_mm256_set1_epi32(bits as i32), each);
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, each))
        }
    }
    #[inline(always)]
    unsafe fn least(mask: __m256, x: __m256) -> f32 {
        // SAFETY: the caller's.
        unsafe {
            let x = _mm256_blendv_ps(_mm256_set1_ps(f32::INFINITY), x, mask);
            let four = _mm_min_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
            let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_min_ss(two, _mm_shuffle_ps::<1>(two, two)))
        }
    }
    #[inline(always)]
    unsafe fn all_wide(x: f64) -> [__m256d; 2] {
        // SAFETY: the caller's.
        unsafe { [_mm256_set1_pd(x); 2] }
    }
    #[inline(always)]
    unsafe fn widen(x: __m256) -> [__m256d; 2] {
        // SAFETY: the caller's.
        unsafe { [_mm256_cvtps_pd(_mm256_castps256_ps128(x)), _mm256_cvtps_pd(_mm256_extractf128_ps::<1>(x))] }
    }
    #[inline(always)]
    unsafe fn narrow(x: [__m256d; 2]) -> __m256 {
        // SAFETY: the caller's.
        unsafe { _mm256_set_m128(_mm256_cvtpd_ps(x[1]), _mm256_cvtpd_ps(x[0])) }
    }
    #[inline(always)]
    unsafe fn le_wide(a: [__m256d; 2], b: [__m256d; 2]) -> __m256 {
        // SAFETY: the caller's.
        unsafe {
            let low = _mm256_castpd_ps(_mm256_cmp_pd::<_CMP_LE_OQ>(a[0], b[0]));
            let high = _mm256_castpd_ps(_mm256_cmp_pd::<_CMP_LE_OQ>(a[1], b[1]));
            // the even words of each quarter, and the quarters in their order
            let mixed = _mm256_castps_pd(_mm256_shuffle_ps::<0b10_00_10_00>(low, high));
            _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(mixed))
        }
    }
    #[inline(always)]
    unsafe fn columns(rays: *const Ray, numbers: *const u32) -> [__m256; 8] {
        // SAFETY: the caller's; a ray is eight floats.
        unsafe {
            let mut r = [_mm256_setzero_ps(); 8];
            let mut i = 0;
            while i < 8 {
                r[i] = _mm256_loadu_ps(rays.add(*numbers.add(i) as usize).cast());
                i += 1;
            }
            transposed(r)
        }
    }
}

/// Sixteen lanes: AVX-512 F and DQ.
pub(super) struct Sixteen;

impl Width for Sixteen {
    const LANES: usize = 16;
    type F = __m512;
    type D = [__m512d; 2];
    type Mask = __mmask16;

    instructions! {
        all(x: f32) -> __m512 = _mm512_set1_ps;
        load(from: *const f32) -> __m512 = _mm512_loadu_ps;
        add(a, b: __m512) -> __m512 = _mm512_add_ps;
        sub(a, b: __m512) -> __m512 = _mm512_sub_ps;
        mul(a, b: __m512) -> __m512 = _mm512_mul_ps;
        div(a, b: __m512) -> __m512 = _mm512_div_ps;
        min(a, b: __m512) -> __m512 = _mm512_min_ps;
        max(a, b: __m512) -> __m512 = _mm512_max_ps;
        fmadd(a, b, c: __m512) -> __m512 = _mm512_fmadd_ps;
        fmsub(a, b, c: __m512) -> __m512 = _mm512_fmsub_ps;
        fnmadd(a, b, c: __m512) -> __m512 = _mm512_fnmadd_ps;
        abs(x: __m512) -> __m512 = _mm512_abs_ps;
        lt(a, b: __m512) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_LT_OQ>;
        le(a, b: __m512) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_LE_OQ>;
        eq(a, b: __m512) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>;
    }
    both! {
        add_wide(a, b: __m512d) = _mm512_add_pd;
        sub_wide(a, b: __m512d) = _mm512_sub_pd;
        mul_wide(a, b: __m512d) = _mm512_mul_pd;
        div_wide(a, b: __m512d) = _mm512_div_pd;
        sqrt_wide(x: __m512d) = _mm512_sqrt_pd;
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, x: __m512) {
        // SAFETY: the caller's.
        unsafe { _mm512_storeu_ps(to, x) }
    }
    #[inline(always)]
    unsafe fn select(mask: __mmask16, a: __m512, b: __m512) -> __m512 {
        // SAFETY: the caller's.
        unsafe { _mm512_mask_blend_ps(mask, b, a) }
    }
    #[inline(always)]
    unsafe fn is_negative(x: __m512) -> __mmask16 {
        // SAFETY: the caller's.
        unsafe { _mm512_movepi32_mask(_mm512_castps_si512(x)) }
    }
    #[inline(always)]
    unsafe fn and(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    unsafe fn or(a: __mmask16, b: __mmask16) -> __mmask16 {
        a | b
    }
    #[inline(always)]
    unsafe fn bits(mask: __mmask16) -> u32 {
        u32::from(mask)
    }
    #[inline(always)]
    unsafe fn of_bits(bits: u32) -> __mmask16 {
        bits as __mmask16
    }
    #[inline(always)]
    unsafe fn least(mask: __mmask16, x: __m512) -> f32 {
        // SAFETY: the caller's.
        unsafe { _mm512_reduce_min_ps(_mm512_mask_blend_ps(mask, _mm512_set1_ps(f32::INFINITY), x)) }
    }
    #[inline(always)]
    unsafe fn all_wide(x: f64) -> [__m512d; 2] {
        // SAFETY: the caller's.
        unsafe { [_mm512_set1_pd(x); 2] }
    }
    #[inline(always)]
    unsafe fn widen(x: __m512) -> [__m512d; 2] {
        // SAFETY: the caller's.
        unsafe { [_mm512_cvtps_pd(_mm512_castps512_ps256(x)), _mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(x))] }
    }
    #[inline(always)]
    unsafe fn narrow(x: [__m512d; 2]) -> __m512 {
        // SAFETY: the caller's.
        unsafe { _mm512_insertf32x8::<1>(_mm512_castps256_ps512(_mm512_cvtpd_ps(x[0])), _mm512_cvtpd_ps(x[1])) }
    }
    #[inline(always)]
    unsafe fn le_wide(a: [__m512d; 2], b: [__m512d; 2]) -> __mmask16 {
        // SAFETY: the caller's.
        unsafe {
            let low = _mm512_cmp_pd_mask::<_CMP_LE_OQ>(a[0], b[0]);
            u16::from(low) | u16::from(_mm512_cmp_pd_mask::<_CMP_LE_OQ>(a[1], b[1])) << 8
        }
    }
    #[inline(always)]
    unsafe fn columns(rays: *const Ray, numbers: *const u32) -> [__m512; 8] {
        // SAFETY: the caller's.
        unsafe {
            let (low, high) = (Eight::columns(rays, numbers), Eight::columns(rays, numbers.add(8)));
            let mut both = [_mm512_setzero_ps(); 8];
            let mut i = 0;
            while i < 8 {
                both[i] = _mm512_insertf32x8::<1>(_mm512_castps256_ps512(low[i]), high[i]);
                i += 1;
            }
            both
        }
    }
}

/// Columns of eight rows.
///
/// # Safety
/// AVX is enabled.
#[inline(always)]
unsafe fn transposed(r: [__m256; 8]) -> [__m256; 8] {
    // SAFETY: the caller's.
    unsafe {
        let (a0, a1) = (_mm256_unpacklo_ps(r[0], r[1]), _mm256_unpackhi_ps(r[0], r[1]));
        let (a2, a3) = (_mm256_unpacklo_ps(r[2], r[3]), _mm256_unpackhi_ps(r[2], r[3]));
        let (a4, a5) = (_mm256_unpacklo_ps(r[4], r[5]), _mm256_unpackhi_ps(r[4], r[5]));
        let (a6, a7) = (_mm256_unpacklo_ps(r[6], r[7]), _mm256_unpackhi_ps(r[6], r[7]));
        let (b0, b1) = (_mm256_shuffle_ps::<0x44>(a0, a2), _mm256_shuffle_ps::<0xEE>(a0, a2));
        let (b2, b3) = (_mm256_shuffle_ps::<0x44>(a1, a3), _mm256_shuffle_ps::<0xEE>(a1, a3));
        let (b4, b5) = (_mm256_shuffle_ps::<0x44>(a4, a6), _mm256_shuffle_ps::<0xEE>(a4, a6));
        let (b6, b7) = (_mm256_shuffle_ps::<0x44>(a5, a7), _mm256_shuffle_ps::<0xEE>(a5, a7));
        [
            _mm256_permute2f128_ps::<0x20>(b0, b4),
            _mm256_permute2f128_ps::<0x20>(b1, b5),
            _mm256_permute2f128_ps::<0x20>(b2, b6),
            _mm256_permute2f128_ps::<0x20>(b3, b7),
            _mm256_permute2f128_ps::<0x31>(b0, b4),
            _mm256_permute2f128_ps::<0x31>(b1, b5),
            _mm256_permute2f128_ps::<0x31>(b2, b6),
            _mm256_permute2f128_ps::<0x31>(b3, b7),
        ]
    }
}
