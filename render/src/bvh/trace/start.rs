//! [`State::start`] in vector instructions: the same operations, so the same bits, without the way through memory that picking
//! components by the ray's axes takes.
#![allow(unsafe_code)] // intrinsics: inlined into an entry that enables the features

use std::arch::x86_64::*;

use super::super::layout::MAX_COORDINATE;
use super::setup::{DIRECTION_RANGE, NO_DIRECTION, PAD, State};
use crate::ray::{MISS, Ray};

/// The axes in their order for a ray, by which components of the direction are larger: bit 0 for 0 above 1, bit 1 for 0 above 2, bit
/// 2 for 1 above 2.
static AXES: [[i32; 4]; 8] = {
    let mut table = [[0; 4]; 8];
    let mut mask = 0;
    while mask < 8 {
        let z = if mask & 3 == 3 {
            0
        } else if mask & 4 != 0 {
            1
        } else {
            2
        };
        table[mask] = [(z + 1) % 3, (z + 2) % 3, z, 3];
        mask += 1;
    }
    table
};

/// Sets a state to the start of ray number `number` at reference `root` with the stack's top at `top`.
///
/// # Safety
/// AVX and SSE4.1 are enabled.
#[inline(always)]
pub(super) unsafe fn start(state: &mut State, ray: &Ray, largest: f32, root: u32, number: u32, top: u32) {
    // SAFETY: a ray is eight floats, and every four members of a state that are written together are four words in a row.
    unsafe {
        let all = |x: f32| _mm_set1_ps(x);
        let first = std::ptr::from_ref(ray).cast::<f32>();
        let (o, d) = (_mm_loadu_ps(first), _mm_loadu_ps(first.add(4)));
        // the fourth components are tmin and tmax
        let limits = _mm_unpackhi_ps(o, d);
        let (o, d) = (_mm_blend_ps::<8>(o, _mm_setzero_ps()), _mm_blend_ps::<8>(d, _mm_setzero_ps()));
        let (reach, size) = (_mm_andnot_ps(all(-0.0), o), _mm_andnot_ps(all(-0.0), d));
        // of one vector's three components, in all lanes
        let most = |x: __m128| {
            let pairs = _mm_max_ps(x, _mm_shuffle_ps::<0b10_11_00_01>(x, x));
            _mm_max_ps(pairs, _mm_shuffle_ps::<0b01_00_11_10>(pairs, pairs))
        };
        let steepest = most(size);
        let bounded = _mm_and_ps(_mm_cmple_ps(reach, all(MAX_COORDINATE)), _mm_cmple_ps(size, all(DIRECTION_RANGE.1)));
        let ordered = _mm_and_ps(_mm_cmpord_ps(limits, limits), _mm_cmpge_ps(steepest, all(DIRECTION_RANGE.0)));
        // NaN makes every comparison false; of `limits`, tmin and tmax are the upper two
        if _mm_movemask_ps(bounded) != 15 || _mm_movemask_ps(ordered) & 12 != 12 {
            *state = State { top, current: root, ray: number, ..State::NOTHING };
            return;
        }

        let least = _mm_mul_ps(steepest, all(NO_DIRECTION));
        let is_flat = _mm_cmplt_ps(size, least);
        let sign = _mm_and_ps(all(-0.0), d);
        let inverse = _mm_div_ps(all(1.0), _mm_blendv_ps(d, _mm_or_ps(least, sign), is_flat));
        let d = _mm_andnot_ps(is_flat, d);
        let farthest = _mm_max_ps(most(reach), all(largest));
        let pad = _mm_mul_ps(_mm_andnot_ps(all(-0.0), inverse), _mm_mul_ps(farthest, all(PAD)));
        let center = _mm_mul_ps(o, inverse);
        _mm_store_ps(std::ptr::from_mut(&mut state.inverse).cast(), inverse);
        _mm_store_ps(std::ptr::from_mut(&mut state.near).cast(), _mm_add_ps(center, pad));
        _mm_store_ps(std::ptr::from_mut(&mut state.far).cast(), _mm_sub_ps(center, pad));
        let negative = _mm_slli_epi32::<5>(_mm_srli_epi32::<31>(_mm_castps_si128(inverse)));
        let rows = _mm_insert_epi32::<3>(_mm_add_epi32(negative, _mm_setr_epi32(0, 64, 128, 0)), top as i32);
        _mm_store_si128(state.near_row.as_mut_ptr().cast(), rows);

        let larger =
            _mm_cmpgt_ps(_mm_shuffle_ps::<0b11_01_00_00>(size, size), _mm_shuffle_ps::<0b11_10_10_01>(size, size));
        let axes = _mm_loadu_si128(AXES[_mm_movemask_ps(larger) as usize & 7].as_ptr().cast());
        let along = |x: __m128| _mm_permutevar_ps(x, axes);
        let inverse_z = _mm_shuffle_ps::<0b10_10_10_10>(along(inverse), along(inverse));
        let shear = _mm_mul_ps(along(d), inverse_z);
        _mm_store_ps(state.origin.as_mut_ptr(), along(o));
        _mm_store_ps(state.shear.as_mut_ptr(), _mm_insert_ps::<0b0010_1000>(shear, inverse_z));
        // the maximum is its second operand for zeros of any sign
        let tmin = _mm_max_ps(limits, _mm_setzero_ps());
        let axes = _mm_blend_ps::<8>(_mm_castsi128_ps(axes), _mm_shuffle_ps::<0b10_10_10_10>(tmin, tmin));
        _mm_store_ps(state.axes.as_mut_ptr().cast(), axes);
        let rest = _mm_setr_epi32(0, root as i32, number as i32, MISS as i32);
        let rest = _mm_insert_epi32::<0>(rest, _mm_extract_epi32::<3>(_mm_castps_si128(limits)));
        _mm_store_si128(std::ptr::from_mut(&mut state.tmax).cast(), rest);
        _mm_store_si128(state.uv.as_mut_ptr().cast(), _mm_setzero_si128());
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::testing::Random;
    use super::*;

    #[target_feature(enable = "avx2")]
    fn started(ray: &Ray, largest: f32) -> State {
        let mut state = State::NOTHING;
        // SAFETY: AVX is enabled here.
        unsafe { start(&mut state, ray, largest, 5, 6, 7) };
        state
    }

    fn bits(s: &State) -> Vec<u32> {
        let vectors = [s.inverse.to_array(), s.near.to_array(), s.far.to_array(), s.origin, s.shear];
        let floats = vectors.into_iter().flatten().chain([s.tmin, s.tmax]).chain(s.uv).map(f32::to_bits);
        floats.chain(s.near_row).chain(s.axes).chain([s.top, s.current, s.ray, s.prim, s.leaf, s.lane]).collect()
    }

    #[test]
    fn vectors_start_a_ray_like_its_plain_twin() {
        if !is_x86_feature_detected!("avx2") {
            println!("no AVX2 here: not tested");
            return;
        }
        const SPECIAL: [f32; 12] =
            [0.0, -0.0, 1.0, -1.0, 1e-9, -1e-16, 1e-30, 1e9, 2e12, f32::INFINITY, f32::NAN, f32::MIN_POSITIVE];
        let mut random = Random::new(40);
        let mut insane = 0;
        for i in 0..200_000 {
            let often = [2, 12, 1000][i % 3];
            let mut number = || if random.below(often) == 0 { SPECIAL[random.below(12)] } else { random.signed() };
            let [o, d] = [[number(), number(), number()], [number(), number(), number()]];
            let (tmin, tmax) = (number(), number() * 10.0);
            let ray = Ray { o, tmin, d, tmax };
            let largest = [1.0, 1e-3, 1e6][i / 3 % 3];
            let plain = State { top: 7, current: 5, ray: 6, ..State::new(&ray, largest) };
            insane += usize::from(plain.tmax == State::NOTHING.tmax);
            // SAFETY: AVX2 was found.
            let vector = unsafe { started(&ray, largest) };
            assert_eq!(bits(&vector), bits(&plain), "{ray:?}");
        }
        assert!((1000..150_000).contains(&insane), "{insane}");
    }
}
