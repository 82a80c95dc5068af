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
        let number = |k: usize| match self {
            Texel::Srgb8 => SRGB[usize::from(bytes[at + k])],
            Texel::Linear8 => f32::from(bytes[at + k]) / 255.0,
            Texel::Float => {
                let at = at + 4 * k;
                real(Stored::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]))
            }
        };
        if channels == 1 { Vec3::splat(number(0)) } else { Vec3::new(number(0), number(1), number(2)) }
    }
}
