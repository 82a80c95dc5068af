//! How texels are stored.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use crate::real::{Stored, Vec3, f32, real};

/// Format of one channel of a texel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Texel {
    /// A byte, sRGB (IEC 61966-2-1).
    Srgb8,
    /// A byte, 255 for 1.
    Linear8,
    /// f32, little endian.
    Float,
}

static SRGB: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|i| decode_srgb(i as f64 / 255.0) as f32));

/// From sRGB to linear (IEC 61966-2-1), for values in [0, 1].
pub fn decode_srgb(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
}

impl Texel {
    /// Bytes of a channel.
    #[inline(always)]
    pub fn bytes(self) -> usize {
        match self {
            Texel::Srgb8 | Texel::Linear8 => 1,
            Texel::Float => 4,
        }
    }

    /// The texel of so many channels (1 or 3) that begins at a byte, linear; a grey one's value in all channels.
    #[inline(always)]
    pub fn read(self, channels: u8, bytes: &[u8], at: usize) -> Vec3 {
        let [texel] = self.read_each(channels, bytes, [at]);
        texel
    }

    /// [`Texel::read`] of several places: format and table are looked at once.
    #[inline(always)]
    pub fn read_each<const N: usize>(self, channels: u8, bytes: &[u8], at: [usize; N]) -> [Vec3; N] {
        let grey = channels == 1;
        match self {
            Texel::Srgb8 => {
                let table: &[f32; 256] = &SRGB;
                each(grey, bytes, at, |&[byte]: &[u8; 1]| table[usize::from(byte)])
            }
            Texel::Linear8 => each(grey, bytes, at, |&[byte]: &[u8; 1]| f32::from(byte) / 255.0),
            Texel::Float => each(grey, bytes, at, |number: &[u8; 4]| real(Stored::from_le_bytes(*number))),
        }
    }
}

/// Texels of channels of `B` bytes each. With loops: `map` on arrays is a call.
#[inline(always)]
fn each<const N: usize, const B: usize>(
    grey: bool,
    bytes: &[u8],
    at: [usize; N],
    number: impl Fn(&[u8; B]) -> f32,
) -> [Vec3; N] {
    let mut texels = [Vec3::ZERO; N];
    if grey {
        for (texel, at) in texels.iter_mut().zip(at) {
            *texel = Vec3::splat(number(&bytes[at..][..B].as_chunks().0[0]));
        }
    } else {
        for (texel, at) in texels.iter_mut().zip(at) {
            // one check for all three
            let channels = bytes[at..][..3 * B].as_chunks::<B>().0;
            *texel = Vec3::new(number(&channels[0]), number(&channels[1]), number(&channels[2]));
        }
    }
    texels
}
