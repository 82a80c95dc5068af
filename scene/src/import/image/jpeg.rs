//! JPEG, baseline and progressive.

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::{Image, ImageLimits, Problem, check_size};

pub(super) fn decode(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    let broken = |e: zune_jpeg::errors::DecodeErrors| Problem::new(format!("a damaged JPEG: {e}"));
    // strict: a file that is cut off is an error, not grey
    let options = DecoderOptions::new_safe().set_strict_mode(true).set_max_width(65535).set_max_height(65535);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(broken)?;
    let Some((width, height)) = decoder.dimensions() else { return Err(Problem::new("a JPEG without a size")) };
    let (width, height) = check_size(width as u64, height as u64, limits)?;
    let grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    decoder.set_options(options.jpeg_set_out_colorspace(if grey { ColorSpace::Luma } else { ColorSpace::RGB }));
    let raw = decoder.decode().map_err(broken)?;
    let channels = if grey { 1 } else { 3 };
    if raw.len() as u64 != u64::from(width) * u64::from(height) * u64::from(channels) {
        return Err(Problem::new("a JPEG of a colour space that is not read: convert it to RGB"));
    }
    Ok(Image { width, height, channels, srgb: true, values: raw.iter().map(|&b| f32::from(b) / 255.0).collect() })
}
