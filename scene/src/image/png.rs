//! PNG.

use std::fs::File;
use std::io::BufReader;

use png::{BitDepth, ColorType, Decoder, Limits, Reader, Transformations};
use rayherd_render::texture::{Texel, decode_srgb};

use super::{AGAIN, Header, Image, MOST_TEXELS, check, plausible};

type Input = BufReader<File>;

/// Most bytes that deflate makes of one: of two bits a repetition of 258.
const MOST_EXPANSION: u64 = 1032;

fn open(file: Input) -> Result<Reader<Input>, String> {
    let mut decoder = Decoder::new(file);
    // palettes to colours, fewer bits than a byte's to bytes
    decoder.set_transformations(Transformations::EXPAND);
    decoder.set_limits(Limits { bytes: 8 * MOST_TEXELS as usize });
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let said = |e| format!("cannot be read as PNG ({e}): {AGAIN}");
    let info = decoder.read_header_info().map_err(said)?;
    check([info.width, info.height])?;
    decoder.read_info().map_err(said)
}

fn header_of(reader: &Reader<Input>, length: u64, raw: bool) -> Result<Header, String> {
    let (color, depth) = reader.output_color_type();
    let channels = match color {
        ColorType::Grayscale | ColorType::GrayscaleAlpha => 1,
        ColorType::Rgb | ColorType::Rgba => 3,
        ColorType::Indexed => return Err("has a palette that cannot be read".into()),
    };
    let texel = match depth {
        BitDepth::Sixteen => Texel::Float,
        _ if raw => Texel::Linear8,
        _ => Texel::Srgb8,
    };
    let info = reader.info();
    let header = Header { size: [info.width, info.height], channels, texel };
    // a bit of a palette's index becomes three bytes
    let expansion = (8 * header.texel_bytes()).div_ceil(info.bits_per_pixel());
    plausible(&header, length, MOST_EXPANSION * expansion as u64)?;
    Ok(header)
}

pub(super) fn header(file: Input, length: u64, raw: bool) -> Result<Header, String> {
    header_of(&open(file)?, length, raw)
}

pub(super) fn has_alpha(file: Input) -> bool {
    open(file).is_ok_and(|reader| matches!(reader.output_color_type().0, ColorType::GrayscaleAlpha | ColorType::Rgba))
}

pub(super) fn read(file: Input, length: u64, raw: bool) -> Result<Image, String> {
    let mut reader = open(file)?;
    let header = header_of(&reader, length, raw)?;
    let (color, _) = reader.output_color_type();
    let size = reader.output_buffer_size().ok_or("is too large")?;
    let mut samples = vec![0; size];
    reader.next_frame(&mut samples).map_err(|e| format!("cannot be read to its end ({e}): {AGAIN}"))?;
    let (channels, of_file) = (usize::from(header.channels), color.samples());
    let bytes = match header.texel {
        Texel::Float => {
            let number = |b: &[u8]| {
                let v = f64::from(u16::from_be_bytes([b[0], b[1]])) / 65535.0;
                (if raw { v } else { decode_srgb(v) } as f32).to_le_bytes()
            };
            let texels = samples.chunks_exact(2 * of_file);
            texels.flat_map(|t| t[..2 * channels].chunks_exact(2).flat_map(number)).collect()
        }
        _ if channels == of_file => samples,
        _ => samples.chunks_exact(of_file).flat_map(|t| t[..channels].iter().copied()).collect(),
    };
    Ok(Image { header, bytes })
}
