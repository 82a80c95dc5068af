//! Pictures in: PNG, JPEG, OpenEXR and Radiance HDR as rows of f32, for textures and environment maps.
//!
//! The kind is found from the content. Sizes are checked against [`ImageLimits`] before memory is taken. Every decoder runs in this thread, and
//! without the vector code that some machines lack, so that a picture has the same values everywhere.

mod exr;
mod hdr;
mod jpeg;
mod png;
#[cfg(test)]
mod tests;

use std::path::Path;

use crate::ImportError;
use crate::description::Place;

/// A picture in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Pixels in a row, at least 1.
    pub width: u32,
    /// Rows, at least 1.
    pub height: u32,
    /// 1 (grey), 2 (grey, alpha), 3 (red, green, blue) or 4 (red, green, blue, alpha).
    pub channels: u32,
    /// The values are sRGB-encoded, as those of PNG and JPEG are by convention: see [`Image::decode_srgb`].
    pub srgb: bool,
    /// `height` rows from the top, of `width` pixels from the left, of `channels` values. Integers are divided by the largest one. Values of
    /// floating point files are what the file holds, NaN and infinity included.
    pub values: Vec<f32>,
}

/// What a picture may be at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageLimits {
    /// Pixels.
    pub pixels: u64,
}

impl Default for ImageLimits {
    /// 16384 x 8192: in f32 with four channels 2 GiB.
    fn default() -> Self {
        ImageLimits { pixels: 1 << 27 }
    }
}

impl Image {
    /// Turns colour (not alpha) that is sRGB-encoded into linear light, by IEC 61966-2-1; nothing where it is linear already.
    pub fn decode_srgb(&mut self) {
        if !std::mem::take(&mut self.srgb) {
            return;
        }
        let channels = self.channels as usize;
        let colours = if channels.is_multiple_of(2) { channels - 1 } else { channels };
        let linear = |v: f32| srgb_to_linear(v.into()) as f32;
        // of 8 bits: 256 values
        let table: Vec<[f32; 2]> = (0..=255u8).map(|i| f32::from(i) / 255.0).map(|v| [v, linear(v)]).collect();
        for pixel in self.values.chunks_exact_mut(channels) {
            for v in &mut pixel[..colours] {
                let [exactly, decoded] = table[(*v * 255.0).round() as usize & 255];
                *v = if exactly == *v { decoded } else { linear(*v) };
            }
        }
    }

    /// The first three channels of a pixel, or its grey three times.
    ///
    /// # Panics
    /// When the pixel lies outside.
    pub fn rgb(&self, x: u32, y: u32) -> [f32; 3] {
        let at = (y as usize * self.width as usize + x as usize) * self.channels as usize;
        let v = &self.values[at..at + self.channels as usize];
        if self.channels < 3 { [v[0]; 3] } else { [v[0], v[1], v[2]] }
    }
}

/// Linear light of an sRGB-encoded value in [0, 1] (IEC 61966-2-1).
pub(super) fn srgb_to_linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
}

/// Reads a picture.
///
/// # Errors
/// The file cannot be read, is larger than `limits`, is of another format, or is damaged or cut off.
pub fn read_image(path: &Path, limits: &ImageLimits) -> Result<Image, ImportError> {
    let io = |source| ImportError::Io { path: path.into(), source };
    let metadata = std::fs::metadata(path).map_err(io)?;
    if !metadata.is_file() {
        return wrong(path, "is no file: name a picture");
    }
    // no format has more than 16 bytes a pixel, and headers are small
    if metadata.len() > limits.pixels.saturating_mul(16).saturating_add(1 << 24) {
        let message = format!("a picture of {} bytes is larger than what is read; use a smaller one", metadata.len());
        return Err(ImportError::Limit { path: path.into(), message });
    }
    let bytes = std::fs::read(path).map_err(io)?;
    decode(&bytes, limits).map_err(|problem| match problem {
        Problem::Size(width, height) => ImportError::Limit {
            path: path.into(),
            message: format!(
                "a picture of {width} x {height} pixels is larger than the {} pixels that are read; use a smaller one",
                limits.pixels
            ),
        },
        Problem::Damaged(why) => malformed(path, why),
    })
}

/// Why bytes are no picture that is read.
#[derive(Debug)]
enum Problem {
    /// Too large: width and height.
    Size(u64, u64),
    /// Anything else.
    Damaged(String),
}

impl Problem {
    fn new(what: impl Into<String>) -> Problem {
        Problem::Damaged(what.into())
    }
}

fn decode(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => png::decode(bytes, limits),
        [0xff, 0xd8, 0xff, ..] => jpeg::decode(bytes, limits),
        [0x76, 0x2f, 0x31, 0x01, ..] => exr::decode(bytes, limits),
        [b'#', b'?', ..] => hdr::decode(bytes, limits),
        [] => Err(Problem::new("the file is empty")),
        _ => Err(Problem::new("this is no picture that is read: convert it to PNG, JPEG, OpenEXR or Radiance HDR")),
    }
}

/// Checks a size before memory is taken for it.
fn check_size(width: u64, height: u64, limits: &ImageLimits) -> Result<(u32, u32), Problem> {
    match (u32::try_from(width), u32::try_from(height)) {
        (Ok(0), _) | (_, Ok(0)) => Err(Problem::new("the picture has no pixels")),
        (Ok(w), Ok(h)) if u64::from(w) * u64::from(h) <= limits.pixels => Ok((w, h)),
        _ => Err(Problem::Size(width, height)),
    }
}

fn malformed(path: &Path, message: impl Into<String>) -> ImportError {
    ImportError::Malformed { place: Place { file: path.into(), line: 0 }, message: message.into() }
}

fn wrong<T>(path: &Path, message: &str) -> Result<T, ImportError> {
    Err(malformed(path, message))
}
