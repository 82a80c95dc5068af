//! Image files: PNG, JPEG, OpenEXR and Radiance HDR, told by their content.
//!
//! Sizes are read from the header and checked before memory is taken; a header that claims more than its file can hold is refused.

mod exr;
mod hdr;
mod jpeg;
mod png;
#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use rayherd_render::texture::{Bitmap, Texel};

use crate::ImportError;
use crate::description::Place;
use crate::import::regular;

/// Largest file that is read.
const MOST_FILE: u64 = 1 << 30;
/// Most texels of an image: 16384 x 8192.
const MOST_TEXELS: u64 = 1 << 27;
/// What to do about a file that is cut off or damaged.
const AGAIN: &str = "get it again, or save it anew";

/// What an image's header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Width and height.
    pub size: [u32; 2],
    /// 1 or 3; alpha is left out, as Mitsuba leaves it out.
    pub channels: u8,
    /// Of a channel, as it will be kept.
    pub texel: Texel,
}

impl Header {
    /// Bytes of a texel.
    pub fn texel_bytes(&self) -> usize {
        usize::from(self.channels) * self.texel.bytes()
    }
    /// Bytes of all texels.
    pub fn bytes(&self) -> u64 {
        u64::from(self.size[0]) * u64::from(self.size[1]) * self.texel_bytes() as u64
    }
}

/// An image in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// What it is.
    pub header: Header,
    /// Texels by rows from the top, without gaps.
    pub bytes: Vec<u8>,
}

impl Image {
    /// Linear colour of a texel; grey three times.
    ///
    /// # Panics
    /// When it lies outside.
    pub fn rgb(&self, x: u32, y: u32) -> [f32; 3] {
        let at = (y as usize * self.header.size[0] as usize + x as usize) * self.header.texel_bytes();
        self.header.texel.read(self.header.channels, &self.bytes, at).to_array()
    }
}

enum Format {
    Png,
    Jpeg,
    Exr,
    Hdr,
}

/// Reads an image's header. Bytes stay as they are when `raw`, else they are sRGB; floats are linear.
///
/// # Errors
/// What is wrong, for a message that names file and place.
pub fn header(path: &Path, raw: bool) -> Result<Header, String> {
    let (format, file, length) = open(path)?;
    let header = match format {
        Format::Png => png::header(file, length, raw),
        Format::Jpeg => jpeg::header(file, length, raw),
        Format::Exr => exr::header(file, length),
        Format::Hdr => hdr::header(file, length),
    }?;
    check(header.size)?;
    Ok(header)
}

/// Whether an image is a PNG with an alpha channel, or with transparent colours in its palette; false also where it cannot be read.
pub fn has_alpha(path: &Path) -> bool {
    match open(path) {
        Ok((Format::Png, file, _)) => png::has_alpha(file),
        _ => false,
    }
}

/// Reads an image.
///
/// # Errors
/// As [`header`]; and the file is cut off or damaged.
pub fn read(path: &Path, raw: bool) -> Result<Image, String> {
    let (format, file, length) = open(path)?;
    // a decoder that panics on a damaged file must not end the process
    let image = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| match format {
        Format::Png => png::read(file, length, raw),
        Format::Jpeg => jpeg::read(file, length, raw),
        Format::Exr => exr::read(file, length),
        Format::Hdr => hdr::read(file, length),
    }))
    .unwrap_or_else(|_| Err(format!("is damaged, its decoder gave up: {AGAIN}")))?;
    if image.bytes.len() as u64 != image.header.bytes() {
        let (found, claimed) = (image.bytes.len(), image.header.bytes());
        return Err(format!("has {found} bytes of texels instead of {claimed}: {AGAIN}"));
    }
    Ok(image)
}

/// An error about an image that a source names at a place.
pub fn error(path: &Path, place: &Place, why: &str) -> ImportError {
    ImportError::Malformed { place: place.clone(), message: format!("image {}: {why}", path.display()) }
}

fn open(path: &Path) -> Result<(Format, BufReader<File>, u64), String> {
    let io = |e: std::io::Error| format!("cannot be read: {e}");
    let (mut file, metadata) = regular::open(path).map_err(io)?;
    let length = metadata.len();
    if length > MOST_FILE {
        return Err(format!("has {length} bytes; at most {MOST_FILE} are read: make it smaller"));
    }
    let mut head = Vec::new();
    (&mut file).take(16).read_to_end(&mut head).map_err(io)?;
    let format = match head.as_slice() {
        [0x89, b'P', b'N', b'G', ..] => Format::Png,
        [0xff, 0xd8, 0xff, ..] => Format::Jpeg,
        [0x76, 0x2f, 0x31, 0x01, ..] => Format::Exr,
        head if head.starts_with(b"#?") => Format::Hdr,
        [] => return Err(format!("is empty: {AGAIN}")),
        _ => return Err("is no PNG, JPEG, OpenEXR or Radiance HDR image: convert it to one of them".into()),
    };
    std::io::Seek::rewind(&mut file).map_err(io)?;
    Ok((format, BufReader::new(file), length))
}

/// Whether a header's size can be; asked before memory is taken.
fn check([w, h]: [u32; 2]) -> Result<(), String> {
    if w == 0 || h == 0 {
        return Err(format!("has {w} x {h} texels: {AGAIN}"));
    }
    if w > Bitmap::MOST || h > Bitmap::MOST || u64::from(w) * u64::from(h) > MOST_TEXELS {
        let (most, texels) = (Bitmap::MOST, MOST_TEXELS);
        return Err(format!(
            "has {w} x {h} texels; at most {most} each way and {texels} in all are read: make it smaller"
        ));
    }
    Ok(())
}

/// Whether a file of `length` bytes can hold so many of texels, if each byte makes at most `most`.
fn plausible(header: &Header, length: u64, most: u64) -> Result<(), String> {
    if header.bytes() > length.saturating_mul(most) {
        let claimed = header.bytes();
        return Err(format!("is damaged, its header claims {claimed} bytes of texels in a file of {length}: {AGAIN}"));
    }
    Ok(())
}
