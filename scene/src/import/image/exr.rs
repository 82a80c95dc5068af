//! OpenEXR: the first layer's R, G, B and A, or Y, or a single channel of any name; the first size level.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

use ::exr::math::Vec2;
use ::exr::prelude::{FlatSamples, MetaData, ReadChannels, ReadLayers};

use super::{Image, ImageLimits, Problem, check_size};

/// No compression of OpenEXR does better than deflate, which makes at most 1032 bytes of one; more than that is a lie about the size.
const MOST_EXPANSION: u128 = 1100;

pub(super) fn decode(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    // the decoder panics on some damaged files (compression B44, in 1.74); it starts no thread here, and nothing of it is used after
    catch_unwind(AssertUnwindSafe(|| read(bytes, limits)))
        .unwrap_or_else(|_| Err(Problem::new("a damaged OpenEXR: its decoder gave up")))
}

fn read(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    let broken = |e: ::exr::error::Error| Problem::new(format!("a damaged OpenEXR: {e}"));
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(broken)?;
    let header = meta.headers.first().ok_or_else(|| Problem::new("an OpenEXR without a layer"))?;
    let (width, height) = check_size(header.layer_size.width() as u64, header.layer_size.height() as u64, limits)?;
    let mut claimed = 0u128;
    for header in &meta.headers {
        let pixels = header.layer_size.width() as u128 * header.layer_size.height() as u128;
        for channel in &header.channels.list {
            if channel.sampling != Vec2(1, 1) {
                return Err(Problem::new(format!("an OpenEXR whose channel {} is subsampled", channel.name)));
            }
            claimed += pixels * channel.sample_type.bytes_per_sample() as u128;
        }
    }
    // the reader takes memory for all of it
    if claimed > bytes.len() as u128 * MOST_EXPANSION {
        return Err(Problem::new(format!("a damaged OpenEXR: it claims {claimed} bytes in a file of {}", bytes.len())));
    }
    if claimed > u128::from(limits.pixels) * 16 {
        return Err(Problem::new("an OpenEXR with too many channels or layers: keep R, G, B and A"));
    }
    let image = ::exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(broken)?;
    let layer = image.layer_data.into_iter().next().ok_or_else(|| Problem::new("an OpenEXR without a layer"))?;
    let mut channels: Vec<(String, Vec<f32>)> = vec![];
    for channel in layer.channel_data.list {
        let samples = match channel.sample_data {
            FlatSamples::F32(v) => v,
            FlatSamples::F16(v) => v.into_iter().map(f32::from).collect(),
            FlatSamples::U32(v) => v.into_iter().map(|v| v as f32).collect(),
        };
        channels.push((channel.name.to_string(), samples));
    }
    let mut take = |name: &str| {
        let i = channels.iter().position(|(n, _)| n.eq_ignore_ascii_case(name))?;
        Some(channels.swap_remove(i).1)
    };
    let alpha = take("A");
    let mut planes = match (take("R"), take("G"), take("B")) {
        (Some(r), Some(g), Some(b)) => vec![r, g, b],
        (r, g, b) => match (take("Y"), r.or(g).or(b)) {
            (Some(only), _) | (None, Some(only)) => vec![only],
            (None, None) if channels.len() == 1 => vec![channels.swap_remove(0).1],
            (None, None) => return Err(Problem::new("an OpenEXR without channels R, G and B, or Y")),
        },
    };
    planes.extend(alpha);
    let pixels = width as usize * height as usize;
    if planes.iter().any(|p| p.len() != pixels) {
        return Err(Problem::new("a damaged OpenEXR: a channel has another size than the picture"));
    }
    let values = (0..pixels).flat_map(|i| planes.iter().map(move |p| p[i])).collect();
    Ok(Image { width, height, channels: planes.len() as u32, srgb: false, values })
}
