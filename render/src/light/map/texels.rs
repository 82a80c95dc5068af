//! A sky's radiances in memory.

use crate::memory::{prefetch, spacious};
use crate::real::{Stored, Vec3, f32, real, stored};

/// By row from the top.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Texels {
    /// As they came.
    Plain(Vec<[f32; 3]>),
    /// Each is a number of half precision, as those of most pictures of skies are: the same values in 8 bytes, a quarter of which is not used, so
    /// that none lies on two lines of memory.
    Half(Vec<[u16; 4]>),
}

impl Texels {
    /// Of finite values, none negative.
    pub(super) fn new(values: Vec<[f32; 3]>) -> Texels {
        let halves = |v: &[f32; 3]| v.iter().all(|v| half(stored(*v)).is_some_and(|h| real(whole(h)) == *v));
        if !values.iter().all(halves) {
            return Texels::Plain(values);
        }
        let mut packed = spacious(values.len());
        packed.extend(values.iter().map(|v| {
            let [r, g, b] = v.map(|v| half(stored(v)).unwrap_or(0));
            [r, g, b, 0]
        }));
        Texels::Half(packed)
    }

    #[inline(always)]
    pub(super) fn get(&self, i: usize) -> Vec3 {
        match self {
            Texels::Plain(values) => Vec3::from(values[i]),
            Texels::Half(values) => {
                let [r, g, b, _] = values[i];
                Vec3::new(real(whole(r)), real(whole(g)), real(whole(b)))
            }
        }
    }

    /// All of them.
    pub(super) fn iter(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        (0..self.len()).map(|i| self.get(i).to_array())
    }

    fn len(&self) -> usize {
        match self {
            Texels::Plain(values) => values.len(),
            Texels::Half(values) => values.len(),
        }
    }

    #[inline(always)]
    pub(super) fn foresee(&self, i: usize) {
        match self {
            Texels::Plain(values) => prefetch(&values[i]),
            Texels::Half(values) => prefetch(&values[i]),
        }
    }
}

/// 2^112: between the exponents' zeros of a half and of a float.
const SHIFT: Stored = f32_power(112);

const fn f32_power(n: u32) -> Stored {
    Stored::from_bits((127 + n) << 23)
}

/// The value of a half, which is not negative, an infinity or NaN; exact for those of less than full precision too.
#[inline(always)]
fn whole(h: u16) -> Stored {
    Stored::from_bits(u32::from(h) << 13) * SHIFT
}

/// A half of this value, perhaps; `None` where it is too large.
fn half(v: Stored) -> Option<u16> {
    let bits = (v / SHIFT).to_bits() >> 13;
    // below the exponent of infinity
    (bits < 0x7c00).then_some(bits as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every half comes back, and what is none stays as it is.
    #[test]
    fn halves_are_kept_as_they_are() {
        let all: Vec<[f32; 3]> = (0..0x7c00u16).map(|h| [real(whole(h)); 3]).collect();
        assert_eq!(all[1][0], real((-24f32).exp2() as Stored));
        assert_eq!(all[0x3c00][0], 1.0);
        assert_eq!(all[0x7bff][0], 65504.0);
        let texels = Texels::new(all.clone());
        assert!(matches!(texels, Texels::Half(_)));
        assert!(texels.iter().eq(all.iter().copied()));
        for odd in [65520.0, 65536.0, 1.0e30, 0.1, 1.000_488_4, 1.0e-8, 5.0e-45] {
            let mut values = all.clone();
            values[7][1] = odd;
            let texels = Texels::new(values.clone());
            assert!(matches!(texels, Texels::Plain(_)), "{odd}");
            assert!(texels.iter().eq(values));
        }
    }
}
