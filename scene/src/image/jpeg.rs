//! JPEG.

use std::fs::File;
use std::io::BufReader;

use jpeg_decoder::{Decoder, Error, PixelFormat};
use rayherd_render::texture::Texel;

use super::{AGAIN, Header, Image, check, plausible};

/// Most texels that a byte makes: a block of 8 x 8 samples takes a bit at least, that of its mean, and where no channel is as fine as the image all together
/// have more than half as many samples as it has texels.
const MOST_EXPANSION: u64 = 2 * 8 * 64;

fn open(file: BufReader<File>, length: u64, raw: bool) -> Result<(Decoder<BufReader<File>>, Header), String> {
    let mut decoder = Decoder::new(file);
    decoder.read_info().map_err(said)?;
    let info = decoder.info().ok_or("says no size")?;
    let channels = match info.pixel_format {
        PixelFormat::L8 => 1,
        PixelFormat::RGB24 => 3,
        PixelFormat::L16 => return Err("has 16 bits a sample: save it as PNG or EXR".into()),
        PixelFormat::CMYK32 => return Err("has four colours, for print: save it as RGB".into()),
    };
    let size = [info.width.into(), info.height.into()];
    let header = Header { size, channels, texel: if raw { Texel::Linear8 } else { Texel::Srgb8 } };
    check(header.size)?;
    plausible(&header, length, MOST_EXPANSION * u64::from(channels))?;
    Ok((decoder, header))
}

pub(super) fn header(file: BufReader<File>, length: u64, raw: bool) -> Result<Header, String> {
    Ok(open(file, length, raw)?.1)
}

pub(super) fn read(file: BufReader<File>, length: u64, raw: bool) -> Result<Image, String> {
    let (mut decoder, header) = open(file, length, raw)?;
    Ok(Image { bytes: decoder.decode().map_err(said)?, header })
}

fn said(error: Error) -> String {
    match error {
        Error::Io(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => format!("is cut off: {AGAIN}"),
        e => format!("cannot be read as JPEG ({e}): {AGAIN}"),
    }
}
