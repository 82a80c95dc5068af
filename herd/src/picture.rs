//! A finished picture as an OpenEXR file: linear 32-bit float RGB, and layers of AOVs beside it.

use std::io::{Cursor, Seek, Write};

use exr::block::UncompressedBlock;
use exr::block::writer::ChunksWriter;
use exr::image::write::channels::WritableChannels;
use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image as ExrImage, ImageAttributes, IntegerBounds, Layer,
    LayerAttributes, Text, WritableImage,
};
use rayherd_render::film::Channel;
use serde_json::{Map, Value};

use crate::job::{Image, JobError};

/// The attribute that holds what defines the image, as one JSON object.
///
/// One, because the exr crate writes attributes in the order of a hash map, which differs from run to run.
pub const ATTRIBUTE: &str = "rayherd";

/// A row of a picture, or several side by side.
pub struct Row {
    /// Red, green and blue by pixel.
    pub light: Vec<[f32; 3]>,
    /// By channel beside these, by pixel.
    pub beside: Vec<Vec<f32>>,
}

impl Row {
    /// So many black pixels.
    pub fn new(pixels: usize, beside: usize) -> Row {
        Row { light: vec![[0.0; 3]; pixels], beside: vec![vec![0.0; pixels]; beside] }
    }

    /// Becomes a part of another with the same channels, from a pixel on.
    pub fn copy_from(&mut self, other: &Row, first: usize) {
        let range = first..first + self.light.len();
        self.light.copy_from_slice(&other.light[range.clone()]);
        self.beside.iter_mut().zip(&other.beside).for_each(|(to, from)| to.copy_from_slice(&from[range.clone()]));
    }
}

/// Encodes `picture` with `definition` in its header, and the channels `beside` it, each of as many values as it has pixels: [`write()`] into
/// memory.
///
/// # Errors
/// When the definition does not fit a header.
pub fn encode(picture: &Image, beside: &[Channel], definition: &Map<String, Value>) -> Result<Vec<u8>, JobError> {
    let mut bytes = Cursor::new(Vec::new());
    let names: Vec<&str> = beside.iter().map(|c| c.name).collect();
    let width = picture.width as usize;
    let next = |y: u32, row: &mut Row| {
        let from = y as usize * width;
        row.light.copy_from_slice(&picture.pixels[from..from + width]);
        row.beside.iter_mut().zip(beside).for_each(|(row, c)| row.copy_from_slice(&c.values[from..from + width]));
        Ok(())
    };
    write([picture.width, picture.height], &names, definition, next, &mut bytes)?;
    Ok(bytes.into_inner())
}

/// Writes a picture of `size` pixels with `definition` in its header, and channels of these names `beside` it; `next` is asked for each row
/// once, from the top down. The same arguments give the same bytes: compression and order of lines are fixed, and nothing tells of time, host
/// or threads. Memory is that of a few rows.
///
/// The picture is R, G and B, whatever is beside it, so that whoever knows of no layers finds it; a layer is the part of a channel's name
/// before the dot.
///
/// # Errors
/// When the definition does not fit a header, a row cannot be had, or what is written is not taken.
pub fn write(
    size: [u32; 2],
    beside: &[&str],
    definition: &Map<String, Value>,
    mut next: impl FnMut(u32, &mut Row) -> Result<(), JobError>,
    out: impl Write + Seek,
) -> Result<(), JobError> {
    // a file's channels are in the order of their names
    let mut channels: Vec<(&str, usize)> = LIGHT.iter().chain(beside).copied().zip(0..).collect();
    channels.sort_unstable();
    let empty = channels.iter().map(|&(name, _)| AnyChannel::new(name, FlatSamples::F32(Vec::new()))).collect();
    let headers = image(size, definition, AnyChannels::sort(empty))?.write().infer_meta_data();
    let mut row = Row::new(size[0] as usize, beside.len());
    let mut failed = None;
    let written = exr::block::write(out, headers, true, |meta, writer| {
        let blocks = meta.enumerate_ordered_header_block_indices().map_while(|(number, index)| {
            let mut data = Vec::with_capacity(index.pixel_size.area() * size_of::<f32>() * channels.len());
            for y in 0..index.pixel_size.height() {
                if let Err(e) = next((index.pixel_position.y() + y) as u32, &mut row) {
                    // the file stays without its end, and is refused for that
                    failed = Some(e);
                    return None;
                }
                for &(_, channel) in &channels {
                    match channel.checked_sub(LIGHT.len()) {
                        None => data.extend(row.light.iter().flat_map(|pixel| pixel[channel].to_ne_bytes())),
                        Some(channel) => data.extend(row.beside[channel].iter().flat_map(|value| value.to_ne_bytes())),
                    }
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

/// Channels of the picture itself.
const LIGHT: [&str; 3] = ["R", "G", "B"];

fn wrong(message: &str) -> JobError {
    JobError::Internal(format!("cannot write an EXR: {message}"))
}

/// A picture with its header.
fn image<'s, C: WritableChannels<'s> + 's>(
    [width, height]: [u32; 2],
    definition: &Map<String, Value>,
    channels: C,
) -> Result<ExrImage<Layer<C>>, JobError> {
    let size = (width as usize, height as usize);
    let encoding = Encoding { line_order: exr::meta::attribute::LineOrder::Increasing, ..Encoding::SMALL_LOSSLESS };
    let mut attributes = LayerAttributes::default();
    let text = Value::Object(definition.clone()).to_string();
    let text = Text::new_or_none(text).ok_or_else(|| wrong("its definition does not fit the header"))?;
    attributes.other.insert(Text::from(ATTRIBUTE), exr::meta::attribute::AttributeValue::Text(text));
    attributes.software_name = Some(Text::from(concat!("rayherd ", env!("CARGO_PKG_VERSION"))));
    Ok(ExrImage {
        attributes: ImageAttributes::new(IntegerBounds::from_dimensions(size)),
        layer_data: Layer::new(size, attributes, encoding, channels),
    })
}

#[cfg(test)]
mod tests {
    use exr::prelude::SpecificChannels;

    use super::*;

    fn definition() -> Map<String, Value> {
        Map::from_iter([("spp".to_owned(), Value::from(3)), ("scene".to_owned(), Value::from("abc"))])
    }

    fn picture([width, height]: [u32; 2]) -> Image {
        let blue = |i: u32| if i.is_multiple_of(7) { f32::INFINITY } else { -0.25 * i as f32 };
        let pixels = (0..width * height).map(|i| [i as f32, 1.0 / (1.0 + i as f32), blue(i)]).collect();
        Image { width, height, pixels }
    }

    /// Against the plain way of the exr crate, on sizes that blocks do not divide.
    #[test]
    fn row_by_row_is_the_file_of_the_whole() {
        for size @ [width, height] in [[1, 1], [70, 45], [33, 16], [5, 200]] {
            let picture = picture(size);
            let light = |p: exr::math::Vec2<usize>| -> (f32, f32, f32) {
                picture.pixels[p.y() * width as usize + p.x()].into()
            };
            let mut expected = Cursor::new(Vec::new());
            let whole = image(size, &definition(), SpecificChannels::rgb(light)).unwrap();
            whole.write().non_parallel().to_buffered(&mut expected).unwrap();
            assert!(encode(&picture, &[], &definition()).unwrap() == expected.into_inner(), "{width}x{height}");
            // names that sort before, between and after those of the picture
            let names = ["variance.R", "H.Y", "albedo.R", "A.Y", "depth.Z"];
            let values = |c: usize| (0..width * height).map(|i| i as f32 * 0.5 - c as f32).collect::<Vec<_>>();
            let beside: Vec<Channel> =
                names.iter().enumerate().map(|(c, &name)| Channel { name, values: values(c) }).collect();
            let light = LIGHT.iter().enumerate();
            let light = light.map(|(c, &name)| (name, picture.pixels.iter().map(|p| p[c]).collect::<Vec<_>>()));
            let all = light.chain(beside.iter().map(|c| (c.name, c.values.clone())));
            let all = all.map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values))).collect();
            let mut expected = Cursor::new(Vec::new());
            let whole = image(size, &definition(), AnyChannels::sort(all)).unwrap();
            whole.write().non_parallel().to_buffered(&mut expected).unwrap();
            assert!(encode(&picture, &beside, &definition()).unwrap() == expected.into_inner(), "{width}x{height}");
        }
    }

    #[test]
    fn a_row_that_cannot_be_had_is_the_error() {
        let next = |y: u32, _: &mut Row| if y < 20 { Ok(()) } else { Err(JobError::Stopped) };
        let done = write([4, 50], &["depth.Z"], &definition(), next, Cursor::new(Vec::new()));
        assert!(matches!(done, Err(JobError::Stopped)), "{done:?}");
    }
}
