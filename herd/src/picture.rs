//! A finished picture as an OpenEXR file: linear 32-bit float RGB.

use std::io::Cursor;

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

/// Encodes `picture` with `definition` in its header. The same arguments give the same bytes: compression and order of
/// lines are fixed, and nothing tells of time, host or threads.
///
/// # Errors
/// When the definition does not fit a header.
pub fn encode(picture: &Image, definition: &Map<String, Value>) -> Result<Vec<u8>, JobError> {
    let width = picture.width as usize;
    let channels = SpecificChannels::rgb(|at: exr::math::Vec2<usize>| {
        let [r, g, b] = picture.pixels[at.y() * width + at.x()];
        (r, g, b)
    });
    let size = (width, picture.height as usize);
    let encoding = Encoding { line_order: exr::meta::attribute::LineOrder::Increasing, ..Encoding::SMALL_LOSSLESS };
    let mut attributes = LayerAttributes::default();
    let text = Value::Object(definition.clone()).to_string();
    let wrong = |message: String| JobError::Internal(format!("cannot encode an EXR: {message}"));
    let text = Text::new_or_none(text).ok_or_else(|| wrong("its definition does not fit the header".into()))?;
    attributes.other.insert(Text::from(ATTRIBUTE), exr::meta::attribute::AttributeValue::Text(text));
    attributes.software_name = Some(Text::from(concat!("rayherd ", env!("CARGO_PKG_VERSION"))));
    let image = ExrImage {
        attributes: ImageAttributes::new(IntegerBounds::from_dimensions(size)),
        layer_data: Layer::new(size, attributes, encoding, channels),
    };
    let mut bytes = Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).map_err(|e| wrong(e.to_string()))?;
    Ok(bytes.into_inner())
}
