//! PNG, of every colour type and depth.

use std::io::Cursor;

use ::png::{BitDepth, ColorType, Decoder, Limits, Transformations};

use super::{Image, ImageLimits, Problem, check_size};

pub(super) fn decode(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    let broken = |e: ::png::DecodingError| Problem::new(format!("a damaged PNG: {e}"));
    // what the decoder keeps beside the picture: a few rows, a palette, texts (which are passed over)
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), Limits { bytes: 1 << 26 });
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    decoder.set_transformations(Transformations::EXPAND);
    let header = decoder.read_header_info().map_err(broken)?;
    let (width, height) = check_size(header.width.into(), header.height.into(), limits)?;
    let mut reader = decoder.read_info().map_err(broken)?;
    let (color, depth) = reader.output_color_type();
    let channels: u32 = match color {
        ColorType::Grayscale => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err(Problem::new("a PNG whose palette cannot be read")),
    };
    let size = reader.output_buffer_size().ok_or_else(|| Problem::Size(width.into(), height.into()))?;
    let mut raw = vec![0; size];
    reader.next_frame(&mut raw).map_err(broken)?;
    let values = match depth {
        BitDepth::Sixteen => {
            let word = |b: &[u8]| f32::from(u16::from_be_bytes([b[0], b[1]])) / 65535.0;
            raw.chunks_exact(2).map(word).collect()
        }
        _ => raw.iter().map(|&b| f32::from(b) / 255.0).collect(),
    };
    // of both depths, as Mitsuba does
    Ok(Image { width, height, channels, srgb: true, values })
}
