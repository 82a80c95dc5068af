//! OpenEXR in: any flat scanline or tiled picture. Out: [`rayherd_herd::picture`].

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use exr::prelude::{FlatImage, FlatSamples, MetaData, ReadChannels, ReadLayers};

use crate::bounded;
use crate::fault::{self, Mistake};
use crate::frames::memory_of_machine;

/// The channels of an EXR file by name (`LAYER.NAME` when there are layers), as f32, rows from the top.
pub struct Channels {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// By name, ascending.
    pub values: BTreeMap<String, Vec<f32>>,
}

/// No compression of OpenEXR does better than deflate, which makes at most 1032 bytes of one; more than that is a lie
/// about the size, found before memory is taken.
const MOST_EXPANSION: u64 = 1100;

/// Part of the machine's memory that one picture may take, as a file and as floats: two are compared, each once as it is stored and
/// once as it is read.
const SHARE: u64 = 4;

/// Reads every channel of a file's first size level. Layers must have one size.
///
/// # Errors
/// What is no EXR file, is damaged, or needs more memory than there is, told before it is taken.
pub fn read(path: &Path) -> anyhow::Result<Channels> {
    let mistake = |why: String| Mistake(format!("{}: {why}", path.display()));
    // it is read twice, and a pipe can only be read once
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(mistake("is no regular file: name an EXR picture".into()).into());
    }
    let most = memory_of_machine().unwrap_or(u64::MAX - 1) / SHARE;
    let bytes =
        bounded::read(path, most, "this machine has not the memory to compare such pictures, take another one")?;
    // the decoder panics on some damaged files (compression B44, in 1.74)
    let image =
        fault::of_others(|| decode(&bytes, most)).unwrap_or_else(|what| Err(format!("cannot be read as EXR: {what}")));
    image.and_then(collect).map_err(|e| mistake(e).into())
}

fn decode(bytes: &[u8], most: u64) -> Result<FlatImage, String> {
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(|e| format!("is no EXR file: {e}"))?;
    let mut claimed = 0u128;
    for header in &meta.headers {
        // what the reader takes memory for: every channel over the whole window
        let pixels = header.layer_size.width() as u128 * header.layer_size.height() as u128;
        for channel in &header.channels.list {
            if channel.sampling != exr::math::Vec2(1, 1) {
                return Err(format!("has a subsampled channel {}", channel.name));
            }
            claimed += pixels * channel.sample_type.bytes_per_sample() as u128;
        }
    }
    if claimed > bytes.len() as u128 * u128::from(MOST_EXPANSION) {
        return Err(format!("is damaged: its header claims {claimed} bytes of pixels in a file of {}", bytes.len()));
    }
    if claimed > u128::from(most) {
        return Err(format!(
            "holds {claimed} bytes of pixels, this machine can take {most}: compare them on a larger one"
        ));
    }
    exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        // a panic on one of its threads would end the process
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(|e| format!("cannot be read as EXR: {e}"))
}

fn collect(image: FlatImage) -> Result<Channels, String> {
    let size = image.layer_data.first().ok_or("has no layer")?.size;
    let mut values = BTreeMap::new();
    for layer in image.layer_data {
        if layer.size != size {
            return Err(format!("has layers of different sizes ({size:?} and {:?})", layer.size));
        }
        for channel in layer.channel_data.list {
            if channel.sampling != exr::math::Vec2(1, 1) {
                return Err(format!("has a subsampled channel {}", channel.name));
            }
            let samples = match channel.sample_data {
                FlatSamples::F32(v) => v,
                FlatSamples::F16(v) => v.into_iter().map(f32::from).collect(),
                FlatSamples::U32(v) => v.into_iter().map(|v| v as f32).collect(),
            };
            let name = match &layer.attributes.layer_name {
                Some(layer) => format!("{layer}.{}", channel.name),
                None => channel.name.to_string(),
            };
            if values.insert(name.clone(), samples).is_some() {
                return Err(format!("has channel {name} twice"));
            }
        }
    }
    Ok(Channels { width: size.x(), height: size.y(), values })
}

#[cfg(test)]
mod tests {
    use exr::prelude::Text;
    use rayherd_herd::job::Image as Picture;
    use rayherd_herd::picture::{ATTRIBUTE, encode};
    use rayherd_tests::mutation;
    use serde_json::{Map, Value};
    use std::fs;

    use super::*;

    fn picture() -> Picture {
        let pixels = (0..70 * 40).map(|i| [i as f32, -0.5 * i as f32, 1.0 / (1.0 + i as f32)]).collect();
        Picture { width: 70, height: 40, pixels }
    }

    fn definition() -> Map<String, Value> {
        let Value::Object(map) = serde_json::json!({"spp": 16, "seed": 3, "scene": "abc"}) else { unreachable!() };
        map
    }

    #[test]
    fn the_same_picture_is_the_same_bytes_and_comes_back() {
        let bytes = encode(&picture(), &[], &definition()).unwrap();
        for _ in 0..4 {
            assert_eq!(encode(&picture(), &[], &definition()).unwrap(), bytes);
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        fs::write(&path, &bytes).unwrap();
        let channels = read(&path).unwrap();
        assert_eq!((channels.width, channels.height), (70, 40));
        assert_eq!(channels.values.keys().collect::<Vec<_>>(), ["B", "G", "R"]);
        for (i, name) in ["R", "G", "B"].iter().enumerate() {
            assert!(channels.values[*name].iter().zip(&picture().pixels).all(|(v, p)| *v == p[i]));
        }
        let meta = MetaData::read_from_file(&path, true).unwrap();
        let attribute = &meta.headers[0].own_attributes.other[&Text::from(ATTRIBUTE)];
        let text = attribute.to_text().unwrap().to_string();
        assert_eq!(text, r#"{"scene":"abc","seed":3,"spp":16}"#);
    }

    #[test]
    fn damaged_files_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let good = encode(&picture(), &[], &definition()).unwrap();
        for bad in [&good[..0], &good[..40], &good[..good.len() / 2], &b"no picture at all"[..]] {
            fs::write(&path, bad).unwrap();
            let error = read(&path).err().unwrap().to_string();
            assert!(error.contains("a.exr"), "{error}");
        }
        // a window of 2^30 x 40 pixels in a file of a few kilobytes
        let mut huge = good.clone();
        let at = huge.windows(10).position(|w| w == b"dataWindow").unwrap() + 10 + 1 + 6 + 4;
        assert_eq!(huge[at + 8..at + 12], 69i32.to_le_bytes());
        huge[at + 8..at + 12].copy_from_slice(&((1i32 << 30) - 1).to_le_bytes());
        fs::write(&path, huge).unwrap();
        let error = read(&path).err().unwrap().to_string();
        assert!(error.contains("a.exr"), "{error}");
    }

    #[test]
    fn memory_is_asked_before_it_is_taken() {
        let bytes = encode(&picture(), &[], &definition()).unwrap();
        let pixels = 70 * 40 * 3 * 4;
        assert!(decode(&bytes, pixels).is_ok());
        let error = decode(&bytes, pixels - 1).err().unwrap();
        assert!(error.contains("33600 bytes of pixels"), "{error}");
    }

    /// Ours, and others' kinds of compression, tiles and sample types.
    fn kinds() -> Vec<Vec<u8>> {
        use exr::prelude::{
            AnyChannel, AnyChannels, Blocks, Compression, Encoding, Image, Layer, LayerAttributes, LineOrder, Vec2,
            WritableImage, f16,
        };
        let mut made = vec![encode(&picture(), &[], &definition()).unwrap()];
        let encodings = [
            (Compression::Uncompressed, Blocks::ScanLines),
            (Compression::RLE, Blocks::Tiles(Vec2(16, 16))),
            (Compression::ZIP1, Blocks::ScanLines),
            (Compression::PIZ, Blocks::ScanLines),
            (Compression::PXR24, Blocks::ScanLines),
            (Compression::B44, Blocks::ScanLines),
        ];
        for (compression, blocks) in encodings {
            let f = FlatSamples::F32((0..20 * 24).map(|i| i as f32).collect());
            let h = FlatSamples::F16((0..20 * 24).map(|i| f16::from_f32(i as f32)).collect());
            let u = FlatSamples::U32((0..20 * 24).collect());
            let list = [AnyChannel::new("Y", f), AnyChannel::new("H", h), AnyChannel::new("id", u)];
            let channels = AnyChannels::sort(list.into_iter().collect());
            let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
            let layer = Layer::new((20, 24), LayerAttributes::named("a"), encoding, channels);
            let mut bytes = Cursor::new(Vec::new());
            Image::from_layer(layer).write().to_buffered(&mut bytes).unwrap();
            made.push(bytes.into_inner());
        }
        made
    }

    #[test]
    fn mutants_are_read_or_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let valid = kinds();
        for bytes in &valid {
            fs::write(&path, bytes).unwrap();
            read(&path).unwrap();
        }
        let before = mutation::peak_memory();
        let mut good = 0;
        let rounds = mutation::rounds("EXR", 1500, |random| {
            let valid = &valid[random.below(valid.len())];
            // half of the changes in the header, which is a small part of a file
            let head = valid.len().min(if random.below(2) == 0 { 500 } else { usize::MAX });
            let bad = [mutation::bytes(&valid[..head], random), valid[head..].to_vec()].concat();
            fs::write(&path, bad).unwrap();
            match read(&path) {
                Ok(channels) => {
                    good += 1;
                    assert!(channels.values.values().all(|v| v.len() == channels.width * channels.height));
                }
                Err(e) => assert!(e.is::<Mistake>() && e.to_string().contains("a.exr"), "{e}"),
            }
        });
        assert!(rounds.is_none_or(|n| good > n / 100 && good < n), "{good} of {rounds:?} were read");
        if let (Some(before), Some(after)) = (before, mutation::peak_memory()) {
            let more = after.saturating_sub(before);
            assert!(more < 256 << 10, "reading small files took {} MiB more", more >> 10);
        }
    }
}
