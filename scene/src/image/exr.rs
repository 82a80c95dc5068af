//! OpenEXR: the first layer's R, G and B, or its Y, as floats.

use std::fs::File;
use std::io::BufReader;

use exr::meta::attribute::IntegerBounds;
use exr::prelude::{Compression, FlatSamples, MetaData, ReadChannels, ReadLayers};
use rayherd_render::texture::Texel;

use super::{AGAIN, Header, Image, check, plausible};

/// No compression of OpenEXR does better than deflate, which makes at most 1032 bytes of one; twice, as halves become floats, and some.
const MOST_EXPANSION: u64 = 2200;

fn header_of(meta: &MetaData, length: u64) -> Result<(Header, Vec<String>), String> {
    let first = meta.headers.first().ok_or("has no layer")?;
    if matches!(first.compression, Compression::B44 | Compression::B44A) {
        // its decoder panics on some damaged files
        return Err("is compressed by B44, which is not read: save it with ZIP".into());
    }
    if matches!(first.compression, Compression::DWAA(_) | Compression::DWAB(_)) {
        // its decoder takes powers and cosines from the system's library, which differ by system
        return Err("is compressed by DWA, which is not read: save it with ZIP".into());
    }
    let has = |name: &str| first.channels.list.iter().any(|c| c.name.to_string() == name);
    let names: Vec<String> = if ["R", "G", "B"].into_iter().all(has) {
        ["R", "G", "B"].map(str::to_owned).to_vec()
    } else if has("Y") {
        vec!["Y".to_owned()]
    } else {
        return Err("has neither channels R, G and B nor Y in its first layer".into());
    };
    if first.channels.list.iter().any(|c| c.sampling != exr::math::Vec2(1, 1)) {
        return Err("has subsampled channels, which are not read".into());
    }
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let IntegerBounds { size, .. } = first.shared_attributes.display_window;
    if size != first.layer_size {
        return Err("has a data window that is not its display window: crop it".into());
    }
    let header = Header { size: [side(size.x()), side(size.y())], channels: names.len() as u8, texel: Texel::Float };
    check(header.size)?;
    for other in &meta.headers {
        // every layer is read
        let pixels = other.layer_size.width() as u64 * other.layer_size.height() as u64;
        if pixels != u64::from(header.size[0]) * u64::from(header.size[1]) || meta.headers.len() > 64 {
            return Err("has layers of several sizes, or more than 64 of them".into());
        }
    }
    plausible(&header, length, MOST_EXPANSION)?;
    Ok((header, names))
}

pub(super) fn header(file: BufReader<File>, length: u64) -> Result<Header, String> {
    let meta =
        MetaData::read_from_buffered(file, false).map_err(|e| format!("cannot be read as EXR ({e}): {AGAIN}"))?;
    Ok(header_of(&meta, length)?.0)
}

pub(super) fn read(mut file: BufReader<File>, length: u64) -> Result<Image, String> {
    let meta =
        MetaData::read_from_buffered(&mut file, false).map_err(|e| format!("cannot be read as EXR ({e}): {AGAIN}"))?;
    let (header, names) = header_of(&meta, length)?;
    std::io::Seek::rewind(&mut file).map_err(|e| format!("cannot be read: {e}"))?;
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        // a panic on one of its threads would end the process
        .non_parallel()
        .from_buffered(file)
        .map_err(|e| format!("cannot be read to its end ({e}): {AGAIN}"))?;
    let channels = &image.layer_data.channel_data.list;
    let find = |name: &String| channels.iter().find(|c| c.name.to_string() == *name).map(|c| &c.sample_data);
    let samples: Option<Vec<&FlatSamples>> = names.iter().map(find).collect();
    let samples = samples.ok_or("lacks channels that its header names")?;
    let texels = u64::from(header.size[0]) * u64::from(header.size[1]);
    if samples.iter().any(|s| s.len() as u64 != texels) {
        return Err("has channels of several sizes".into());
    }
    let mut bytes = Vec::with_capacity(header.bytes() as usize);
    for i in 0..texels as usize {
        for channel in &samples {
            bytes.extend(channel.value_by_flat_index(i).to_f32().to_le_bytes());
        }
    }
    Ok(Image { header, bytes })
}
