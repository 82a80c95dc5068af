//! A finished picture as an OpenEXR file: linear 32-bit float RGB, and layers of AOVs beside it.

use std::io::Cursor;

use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image as ExrImage, ImageAttributes, IntegerBounds, Layer,
    LayerAttributes, SpecificChannels, Text, WritableImage,
};
use rayherd_render::film::Channel;
use serde_json::{Map, Value};

use crate::job::{Image, JobError};

/// The attribute that holds what defines the image, as one JSON object.
///
/// One, because the exr crate writes attributes in the order of a hash map, which differs from run to run.
pub const ATTRIBUTE: &str = "rayherd";

/// Encodes `picture` with `definition` in its header, and the channels `beside` it, each of as many values as it has pixels. The same arguments
/// give the same bytes: compression and order of lines are fixed, and nothing tells of time, host or threads.
///
/// The picture is R, G and B, whatever is beside it, so that whoever knows of no layers finds it; a layer is the part of a channel's name before
/// the dot.
///
/// # Errors
/// When the definition does not fit a header.
pub fn encode(picture: &Image, beside: &[Channel], definition: &Map<String, Value>) -> Result<Vec<u8>, JobError> {
    let width = picture.width as usize;
    let size = (width, picture.height as usize);
    let encoding = Encoding { line_order: exr::meta::attribute::LineOrder::Increasing, ..Encoding::SMALL_LOSSLESS };
    let mut attributes = LayerAttributes::default();
    let text = Value::Object(definition.clone()).to_string();
    let wrong = |message: String| JobError::Internal(format!("cannot encode an EXR: {message}"));
    let text = Text::new_or_none(text).ok_or_else(|| wrong("its definition does not fit the header".into()))?;
    attributes.other.insert(Text::from(ATTRIBUTE), exr::meta::attribute::AttributeValue::Text(text));
    attributes.software_name = Some(Text::from(concat!("rayherd ", env!("CARGO_PKG_VERSION"))));
    let whole = ImageAttributes::new(IntegerBounds::from_dimensions(size));
    let mut bytes = Cursor::new(Vec::new());
    let written = if beside.is_empty() {
        let channels = SpecificChannels::rgb(|at: exr::math::Vec2<usize>| {
            let [r, g, b] = picture.pixels[at.y() * width + at.x()];
            (r, g, b)
        });
        let image = ExrImage { attributes: whole, layer_data: Layer::new(size, attributes, encoding, channels) };
        image.write().to_buffered(&mut bytes)
    } else {
        let light = ["R", "G", "B"].into_iter().enumerate();
        let light = light.map(|(c, name)| (name, picture.pixels.iter().map(|p| p[c]).collect::<Vec<f32>>()));
        let all = light.chain(beside.iter().map(|c| (c.name, c.values.clone())));
        let channels = all.map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values))).collect();
        // a file's channels are in the order of their names
        let layer = Layer::new(size, attributes, encoding, AnyChannels::sort(channels));
        ExrImage { attributes: whole, layer_data: layer }.write().to_buffered(&mut bytes)
    };
    written.map_err(|e| wrong(e.to_string()))?;
    Ok(bytes.into_inner())
}
