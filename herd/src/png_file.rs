//! 8-bit sRGB pictures.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};

use crate::job::Image;

/// Encodes `picture` times 2^`exposure` as an sRGB PNG; values are cut to [0, 1], and what is no number is magenta.
pub fn encode(picture: &Image, exposure: f64) -> io::Result<Vec<u8>> {
    let gain = libm::exp2(exposure);
    let texels: Vec<u8> = picture.pixels.iter().flat_map(|&p| srgb8(p, gain)).collect();
    encode_rgb8(picture.width, picture.height, &texels)
}

/// A picture that is written row by row, from the top down, as [`encode`] writes a whole one: the same texels, in memory of a few rows.
pub struct Rows<W: Write + 'static> {
    to: png::StreamWriter<'static, W>,
    gain: f64,
}

impl<W: Write + 'static> Rows<W> {
    /// A picture of this size.
    ///
    /// # Errors
    /// When it is not taken.
    pub fn new(out: W, [width, height]: [u32; 2], exposure: f64) -> io::Result<Self> {
        let writer = encoder(out, width, height).write_header().map_err(io::Error::other)?;
        Ok(Rows { to: writer.into_stream_writer().map_err(io::Error::other)?, gain: libm::exp2(exposure) })
    }
    /// The next row.
    ///
    /// # Errors
    /// When it is not taken.
    pub fn add(&mut self, row: &[[f32; 3]]) -> io::Result<()> {
        let texels: Vec<u8> = row.iter().flat_map(|&p| srgb8(p, self.gain)).collect();
        self.to.write_all(&texels)
    }
    /// After the last row. An error of the last bytes is not told: see [`check_end`].
    ///
    /// # Errors
    /// When it is not taken, or a row is missing.
    pub fn finish(self) -> io::Result<()> {
        self.to.finish().map_err(io::Error::other)
    }
}

/// The chunk that a PNG ends with: no data, and its checksum.
const END: [u8; 12] = *b"\0\0\0\0IEND\xaeB`\x82";

/// Whether a file that [`Rows`] has written is whole to its end.
///
/// # Errors
/// When it is not, or cannot be read.
pub fn check_end(mut file: &File) -> io::Result<()> {
    let mut last = END.map(|_| 0);
    file.seek(SeekFrom::End(-(END.len() as i64)))?;
    file.read_exact(&mut last)?;
    if last == END { Ok(()) } else { Err(io::Error::other("the file lacks its end")) }
}

fn encoder<W: Write>(out: W, width: u32, height: u32) -> png::Encoder<'static, W> {
    let mut encoder = png::Encoder::new(out, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::RelativeColorimetric);
    encoder
}

/// Encodes sRGB bytes, rows from the top.
pub fn encode_rgb8(width: u32, height: u32, rgb: &[u8]) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut writer = encoder(&mut bytes, width, height).write_header().map_err(io::Error::other)?;
    writer.write_image_data(rgb).map_err(io::Error::other)?;
    writer.finish().map_err(io::Error::other)?;
    Ok(bytes)
}

fn srgb8(pixel: [f32; 3], gain: f64) -> [u8; 3] {
    if pixel.iter().any(|v| v.is_nan()) {
        return [255, 0, 255];
    }
    pixel.map(|v| (encode_srgb(f64::from(v) * gain) * 255.0 + 0.5) as u8)
}

/// The transfer function of IEC 61966-2-1 for a linear value, cut to [0, 1].
pub fn encode_srgb(linear: f64) -> f64 {
    let v = linear.clamp(0.0, 1.0);
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * libm::pow(v, 1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> Vec<u8> {
        let mut reader = png::Decoder::new(io::Cursor::new(bytes)).read_info().unwrap();
        let mut texels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut texels).unwrap();
        texels
    }

    #[test]
    fn texels_are_srgb_with_exposure_and_in_order() {
        // every 8-bit value decodes to a linear value that encodes to itself
        for byte in 0..=255u8 {
            let v = f64::from(byte) / 255.0;
            let linear = if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
            assert_eq!(srgb8([linear as f32; 3], 1.0), [byte; 3]);
            assert_eq!(srgb8([linear as f32 * 4.0; 3], 0.25), [byte; 3]);
        }
        assert_eq!(srgb8([-1.0, 2.0, f32::INFINITY], 1.0), [0, 255, 255]);
        assert_eq!(srgb8([0.0, f32::NAN, 0.0], 1.0), [255, 0, 255]);

        let picture = Image { width: 2, height: 2, pixels: vec![[1.0, 0.0, 0.0], [0.0; 3], [0.0; 3], [0.0, 0.0, 0.5]] };
        let bytes = encode(&picture, 1.0).unwrap();
        let texels = decoded(&bytes);
        assert_eq!(texels, [255, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255]);
        // row by row
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut rows = Rows::new(file.reopen().unwrap(), [2, 2], 1.0).unwrap();
        picture.pixels.chunks(2).for_each(|row| rows.add(row).unwrap());
        rows.finish().unwrap();
        assert_eq!(decoded(&std::fs::read(file.path()).unwrap()), texels);
        check_end(file.as_file()).unwrap();
        file.as_file().set_len(file.as_file().metadata().unwrap().len() - 1).unwrap();
        assert!(check_end(file.as_file()).is_err(), "cut");
        let short = Rows::new(Vec::new(), [2, 2], 0.0).unwrap();
        assert!(short.finish().is_err(), "rows are missing");
    }
}
