//! A finished picture as an OpenEXR file: linear 32-bit float RGB.

use std::io::{Cursor, Seek, Write};

use exr::block::UncompressedBlock;
use exr::block::writer::ChunksWriter;
use exr::prelude::{
    Encoding, Image as ExrImage, ImageAttributes, IntegerBounds, Layer, LayerAttributes, SpecificChannels, Text,
    WritableImage,
};
use serde_json::{Map, Value};

use crate::job::{Image, JobError};

/// The attribute that holds what defines the image, as one JSON object.
///
/// One, because the exr crate writes attributes in the order of a hash map, which differs from run to run.
pub const ATTRIBUTE: &str = "rayherd";

/// Encodes `picture` with `definition` in its header: [`write()`] into memory.
///
/// # Errors
/// When the definition does not fit a header.
pub fn encode(picture: &Image, definition: &Map<String, Value>) -> Result<Vec<u8>, JobError> {
    let mut bytes = Cursor::new(Vec::new());
    let width = picture.width as usize;
    let next = |y: u32, row: &mut [[f32; 3]]| {
        row.copy_from_slice(&picture.pixels[y as usize * width..][..width]);
        Ok(())
    };
    write([picture.width, picture.height], definition, next, &mut bytes)?;
    Ok(bytes.into_inner())
}

/// Writes a picture of `size` pixels with `definition` in its header; `next` is asked for each row once, from the top down. The same
/// arguments give the same bytes: compression and order of lines are fixed, and nothing tells of time, host or threads. Memory is that of
/// a few rows.
///
/// # Errors
/// When the definition does not fit a header, a row cannot be had, or what is written is not taken.
pub fn write(
    size: [u32; 2],
    definition: &Map<String, Value>,
    mut next: impl FnMut(u32, &mut [[f32; 3]]) -> Result<(), JobError>,
    out: impl Write + Seek,
) -> Result<(), JobError> {
    let image = empty(size, definition, |_| (0.0, 0.0, 0.0))?;
    let headers = image.write().infer_meta_data();
    let mut row = vec![[0.0f32; 3]; size[0] as usize];
    let mut failed = None;
    let written = exr::block::write(out, headers, true, |meta, writer| {
        let blocks = meta.enumerate_ordered_header_block_indices().map_while(|(number, index)| {
            let mut data = Vec::with_capacity(index.pixel_size.area() * size_of::<[f32; 3]>());
            for y in 0..index.pixel_size.height() {
                if let Err(e) = next((index.pixel_position.y() + y) as u32, &mut row) {
                    // the file stays without its end, and is refused for that
                    failed = Some(e);
                    return None;
                }
                // channels are sorted by their names: B, G, R
                for channel in [2, 1, 0] {
                    data.extend(row.iter().flat_map(|pixel| pixel[channel].to_ne_bytes()));
                }
            }
            Some((number, UncompressedBlock { index, data }))
        });
        writer.on_progress(|_| ()).compress_all_blocks_parallel(&meta, blocks)
    });
    match (failed, written) {
        (Some(e), _) => Err(e),
        (None, written) => written.map_err(|e| wrong(&e.to_string())),
    }
}

fn wrong(message: &str) -> JobError {
    JobError::Internal(format!("cannot write an EXR: {message}"))
}

type Pixel = (f32, f32, f32);

/// A picture whose pixels are asked for when it is written.
fn empty<F: Sync + Fn(exr::math::Vec2<usize>) -> Pixel>(
    [width, height]: [u32; 2],
    definition: &Map<String, Value>,
    pixels: F,
) -> Result<ExrImage<Layer<SpecificChannels<F, Channels>>>, JobError> {
    let size = (width as usize, height as usize);
    let encoding = Encoding { line_order: exr::meta::attribute::LineOrder::Increasing, ..Encoding::SMALL_LOSSLESS };
    let mut attributes = LayerAttributes::default();
    let text = Value::Object(definition.clone()).to_string();
    let text = Text::new_or_none(text).ok_or_else(|| wrong("its definition does not fit the header"))?;
    attributes.other.insert(Text::from(ATTRIBUTE), exr::meta::attribute::AttributeValue::Text(text));
    attributes.software_name = Some(Text::from(concat!("rayherd ", env!("CARGO_PKG_VERSION"))));
    Ok(ExrImage {
        attributes: ImageAttributes::new(IntegerBounds::from_dimensions(size)),
        layer_data: Layer::new(size, attributes, encoding, SpecificChannels::rgb(pixels)),
    })
}

type Description = exr::meta::attribute::ChannelDescription;
type Channels = (Description, Description, Description);

#[cfg(test)]
mod tests {
    use super::*;

    fn definition() -> Map<String, Value> {
        Map::from_iter([("spp".to_owned(), Value::from(3)), ("scene".to_owned(), Value::from("abc"))])
    }

    /// Against the plain way of the exr crate, on sizes that blocks do not divide.
    #[test]
    fn row_by_row_is_the_file_of_the_whole() {
        for [width, height] in [[1, 1], [70, 45], [33, 16], [5, 200]] {
            let pixels: Vec<[f32; 3]> = (0..width * height)
                .map(|i| [i as f32, 1.0 / (1.0 + i as f32), if i % 7 == 0 { f32::INFINITY } else { -0.25 * i as f32 }])
                .collect();
            let at = |p: exr::math::Vec2<usize>| pixels[p.y() * width as usize + p.x()].into();
            let mut plain = Cursor::new(Vec::new());
            let image = empty([width, height], &definition(), at).unwrap();
            image.write().non_parallel().to_buffered(&mut plain).unwrap();
            let picture = Image { width, height, pixels: pixels.clone() };
            assert!(encode(&picture, &definition()).unwrap() == plain.into_inner(), "{width}x{height}");
        }
    }

    #[test]
    fn a_row_that_cannot_be_had_is_the_error() {
        let next = |y: u32, _: &mut [[f32; 3]]| if y < 20 { Ok(()) } else { Err(JobError::Stopped) };
        let done = write([4, 50], &definition(), next, Cursor::new(Vec::new()));
        assert!(matches!(done, Err(JobError::Stopped)), "{done:?}");
    }
}
