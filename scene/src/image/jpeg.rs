//! JPEG.

use std::fs::File;
use std::io::{BufReader, Cursor, Read};

use rayherd_render::texture::{Bitmap, Texel};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::{Header, Image, check};

type Decoder = JpegDecoder<Cursor<Vec<u8>>>;

fn open(mut file: BufReader<File>, raw: bool) -> Result<(Decoder, Header), String> {
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).map_err(|e| format!("cannot be read: {e}"))?;
    // no vector code: the same bytes on every machine; strict: a file that is cut off is an error, not grey below
    let options = DecoderOptions::default()
        .set_use_unsafe(false)
        .set_strict_mode(true)
        .set_max_width(Bitmap::MOST as usize)
        .set_max_height(Bitmap::MOST as usize);
    let mut decoder = JpegDecoder::new_with_options(Cursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| format!("cannot be read as JPEG: {e:?}"))?;
    let grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    let out = if grey { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(options.jpeg_set_out_colorspace(out));
    let (width, height) = decoder.dimensions().ok_or("says no size")?;
    let header = Header {
        size: [width as u32, height as u32],
        channels: if grey { 1 } else { 3 },
        texel: if raw { Texel::Linear8 } else { Texel::Srgb8 },
    };
    check(&header)?;
    Ok((decoder, header))
}

pub(super) fn header(file: BufReader<File>, raw: bool) -> Result<Header, String> {
    Ok(open(file, raw)?.1)
}

pub(super) fn read(file: BufReader<File>, raw: bool) -> Result<Image, String> {
    let (mut decoder, header) = open(file, raw)?;
    let bytes = decoder.decode().map_err(|e| format!("cannot be read to its end: {e:?}"))?;
    Ok(Image { header, bytes })
}
