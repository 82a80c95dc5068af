//! Directions as they travel: 64 bits that every machine turns into the same three floats.

use bytemuck::{Pod, Zeroable};

/// A unit vector in 64 bits: the two components of smaller magnitude in 30 bits each (fixed point, steps of 2^-29), the
/// axis of the largest in 2 bits and its sign in 1; the largest is had from the others by a square root.
///
/// Octahedral coordinates of as many bits would round to other floats when what was decoded is encoded again; here
/// `decode(encode(decode(x))) == decode(x)` for every `x` that `encode` can make: the stored components are floats in
/// `decode`'s output too, and the third lies within half an ulp of the sphere. The renormalisation in `encode` changes a
/// component `a` by at most `a c 2^-25 < ulp(a) / 2` (c: the largest), so it rounds back; when rounding makes another axis
/// the largest, both are within one ulp of each other, and the root gives back what was there.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Pod, Zeroable)]
pub struct UnitDir([u32; 2]);

const STEPS: f64 = 536_870_912.0; // 2^29
const FIELD: u32 = (1 << 30) - 1;

impl UnitDir {
    /// Nearest code of a vector whose length is 1 to within 1e-4 (a Newton step makes it 1 to 2e-8 or better). The decoded
    /// direction differs by less than 1e-7 rad, which is the rounding of its own floats.
    #[inline]
    pub fn encode(v: [f32; 3]) -> UnitDir {
        // written out: `map` on arrays is a call, which stops loops from becoming vector code
        let w = [f64::from(v[0]), f64::from(v[1]), f64::from(v[2])];
        let scale = 1.5 - 0.5 * (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        let m = [v[0].abs(), v[1].abs(), v[2].abs()];
        let first = (m[0] >= m[1]) & (m[0] >= m[2]);
        let second = !first & (m[1] >= m[2]);
        let (a, b, c) = (
            if first { w[1] } else { w[0] },
            if first | second { w[2] } else { w[1] },
            if first {
                v[0]
            } else if second {
                v[1]
            } else {
                v[2]
            },
        );
        let axis = if first { 0 } else { 2 - u32::from(second) };
        UnitDir([
            (fixed((a * scale) as f32) & FIELD) | axis << 30,
            (fixed((b * scale) as f32) & FIELD) | c.to_bits() >> 31 << 30,
        ])
    }

    /// The direction, of unit length to within a rounding of its largest component.
    #[inline]
    pub fn decode(self) -> [f32; 3] {
        let [x, y] = self.0;
        let a = ((x << 2) as i32 >> 2) as f32 * (1.0 / STEPS as f32);
        let b = ((y << 2) as i32 >> 2) as f32 * (1.0 / STEPS as f32);
        let (da, db) = (f64::from(a), f64::from(b));
        let c = (1.0 - da * da - db * db).max(0.0).sqrt() as f32;
        let c = f32::from_bits(c.to_bits() | (y << 1 & 0x8000_0000));
        let (first, second) = (x >> 30 == 0, x >> 30 == 1);
        [
            if first { c } else { a },
            if second {
                c
            } else if first {
                a
            } else {
                b
            },
            if first | second { b } else { c },
        ]
    }

    /// The two words, for wire formats.
    pub const fn to_words(self) -> [u32; 2] {
        self.0
    }

    /// From the two words; `None` when [`UnitDir::encode`] makes no such code (the axis does not exist, the named axis
    /// is not the largest, or a spare bit is set).
    pub fn from_words(words: [u32; 2]) -> Option<UnitDir> {
        let d = UnitDir(words);
        let [x, y] = words;
        let axis = (x >> 30) as usize;
        if axis > 2 || y >> 31 != 0 {
            return None;
        }
        let v = d.decode().map(f32::abs);
        let (a, b) = OTHERS[axis];
        // one ulp of rounding at a tie
        (v[axis] * (1.0 + 2.0 * f32::EPSILON) >= v[a].max(v[b])).then_some(d)
    }
}

const OTHERS: [(usize, usize); 3] = [(1, 2), (0, 2), (0, 1)];

/// To steps of 2^-29, the nearest, of ties the even one; from 2^-5 on every float is a multiple of the step.
#[inline(always)]
fn fixed(x: f32) -> u32 {
    // 1.5 x 2^52: its last place is 1, so the sum's low bits are the rounded integer
    (f64::from(x) * STEPS + 6_755_399_441_055_744.0).to_bits() as u32
}
