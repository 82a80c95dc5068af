use std::fs;
use std::path::PathBuf;

use ::exr::prelude::{AnyChannel, AnyChannels, Encoding, FlatSamples, Image as ExrImage, Layer, LayerAttributes};
use ::exr::prelude::{WritableImage, f16};
use rayherd_tests::mutation;

use super::*;

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Folder(tempfile::tempdir().unwrap())
    }
    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    }
}

fn png(color: ::png::ColorType, depth: ::png::BitDepth, [w, h]: [u32; 2], data: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut out, w, h);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == ::png::ColorType::Indexed {
        encoder.set_palette(vec![10, 20, 30, 40, 50, 60]);
    }
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    out
}

/// A sound PNG but for its image, of which there is the end alone.
fn hollow_png(color: ::png::ColorType, [w, h]: [u32; 2]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut out, w, h);
    encoder.set_color(color);
    encoder.write_header().unwrap().write_chunk(::png::chunk::IDAT, b"\x78\x9c\x03\0\0\0\0\x01").unwrap();
    out
}

/// [`JPEG`] with another size in its header.
fn jpeg_of(width: u16, height: u16) -> Vec<u8> {
    let mut out = JPEG.to_vec();
    let frame = out.windows(2).position(|w| matches!(w, [0xff, 0xc0 | 0xc2])).unwrap();
    out[frame + 5..frame + 7].copy_from_slice(&height.to_be_bytes());
    out[frame + 7..frame + 9].copy_from_slice(&width.to_be_bytes());
    out
}

fn exr_file(names: &[&str], size: (usize, usize)) -> Vec<u8> {
    let n = size.0 * size.1;
    let channel = |(k, name): (usize, &&str)| {
        let value = move |i: usize| (i * 3 + k) as f32 / 7.0;
        let samples = match k {
            0 => FlatSamples::F16((0..n).map(|i| f16::from_f32(value(i))).collect()),
            _ => FlatSamples::F32((0..n).map(value).collect()),
        };
        AnyChannel::new(*name, samples)
    };
    let channels = AnyChannels::sort(names.iter().enumerate().map(channel).collect());
    let layer = Layer::new(size, LayerAttributes::named("a"), Encoding::SMALL_LOSSLESS, channels);
    let mut bytes = std::io::Cursor::new(Vec::new());
    ExrImage::from_layer(layer).write().non_parallel().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

fn hdr_file(width: usize, rows: &[Vec<u8>]) -> Vec<u8> {
    let mut out =
        format!("#?RADIANCE\n# comment\nFORMAT=32-bit_rle_rgbe\n\n-Y {} +X {width}\n", rows.len()).into_bytes();
    rows.iter().for_each(|r| out.extend(r));
    out
}

/// 37 x 29 texels, and the same decoded by libjpeg-turbo (both written by Mitsuba 3.9.1's `Bitmap`).
const JPEG: &[u8] = include_bytes!("fixtures/waves.jpg");
const JPEG_DECODED: &[u8] = include_bytes!("fixtures/waves.png");

fn floats(image: &Image) -> Vec<f32> {
    image.bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

#[test]
fn png_of_every_kind() {
    use ::png::{BitDepth, ColorType};
    let folder = Folder::new();
    let open = |bytes: &[u8], raw| {
        let path = folder.write("a.png", bytes);
        let image = read(&path, raw).unwrap();
        assert_eq!(header(&path, raw).unwrap(), image.header);
        image
    };
    let rgb = open(&png(ColorType::Rgb, BitDepth::Eight, [2, 1], &[1, 2, 3, 4, 5, 6]), false);
    assert_eq!(rgb.header, Header { size: [2, 1], channels: 3, texel: Texel::Srgb8 });
    assert_eq!(rgb.bytes, [1, 2, 3, 4, 5, 6]);
    // alpha is left out
    let rgba = open(&png(ColorType::Rgba, BitDepth::Eight, [2, 1], &[1, 2, 3, 99, 4, 5, 6, 99]), true);
    assert_eq!((rgba.header.texel, rgba.bytes), (Texel::Linear8, vec![1, 2, 3, 4, 5, 6]));
    let grey = open(&png(ColorType::GrayscaleAlpha, BitDepth::Eight, [1, 2], &[7, 0, 8, 0]), false);
    assert_eq!((grey.header.channels, grey.bytes), (1, vec![7, 8]));
    let bits = open(&png(ColorType::Grayscale, BitDepth::One, [3, 1], &[0b1010_0000]), false);
    assert_eq!(bits.bytes, [255, 0, 255]);
    let palette = open(&png(ColorType::Indexed, BitDepth::Eight, [2, 1], &[1, 0]), false);
    assert_eq!(palette.bytes, [40, 50, 60, 10, 20, 30]);
    let deep = png(ColorType::Grayscale, BitDepth::Sixteen, [2, 1], &[0xff, 0xff, 0x80, 0x00]);
    assert_eq!(floats(&open(&deep, true)), [1.0, (32768.0f64 / 65535.0) as f32]);
    let srgb = floats(&open(&deep, false));
    assert!((f64::from(srgb[1]) - ((32768.0 / 65535.0 + 0.055) / 1.055f64).powf(2.4)).abs() < 1e-7, "{srgb:?}");
}

#[test]
fn exr_of_colours_and_of_one_channel() {
    let folder = Folder::new();
    for names in [&["R", "G", "B", "A"][..], &["Y"]] {
        let path = folder.write("a.exr", &exr_file(names, (3, 2)));
        let image = read(&path, false).unwrap();
        assert_eq!(image.header.size, [3, 2]);
        let channels = if names.len() == 1 { 1 } else { 3 };
        let expected = (0..6 * channels).map(|i| {
            let value = ((i / channels) * 3 + i % channels) as f32 / 7.0;
            if i % channels == 0 { f16::from_f32(value).to_f32() } else { value }
        });
        assert_eq!(floats(&image), expected.collect::<Vec<_>>());
        assert_eq!(header(&path, true).unwrap(), image.header);
    }
    let path = folder.write("a.exr", &exr_file(&["depth"], (3, 2)));
    assert!(header(&path, false).unwrap_err().contains("neither"));
}

#[test]
fn hdr_plain_and_coded() {
    let folder = Folder::new();
    // 128 2^(136 - 136) = 128 / 256 of 2^(e - 128)
    let plain = hdr_file(2, &[vec![128, 64, 0, 129, 1, 2, 3, 0]]);
    assert_eq!(floats(&read(&folder.write("a.hdr", &plain), false).unwrap()), [1.0, 0.5, 0.0, 0.0, 0.0, 0.0]);
    let mut row = vec![2, 2, 0, 10];
    row.extend([128 + 10, 128]); // red: ten of 128
    row.extend([4, 1, 2, 3, 4, 128 + 6, 5]); // green: four as they are, six of 5
    row.extend([128 + 10, 0, 128 + 10, 128]);
    let coded = hdr_file(10, &[row.clone(), row.clone()]);
    let image = read(&folder.write("a.hdr", &coded), false).unwrap();
    assert_eq!(image.header.size, [10, 2]);
    let values = floats(&image);
    assert_eq!(&values[..6], [0.5, 1.0 / 256.0, 0.0, 0.5, 2.0 / 256.0, 0.0]);
    assert_eq!(values[3 * 9 + 1], 5.0 / 256.0);
    assert_eq!(values[30..], values[..30]);
    // a run beyond the row's end
    row[4] = 128 + 11;
    let error = read(&folder.write("a.hdr", &hdr_file(10, &[row])), false).unwrap_err();
    assert!(error.contains("row 0"), "{error}");
}

/// Decoders may round differently, and bring half-sized colour back to size differently; no more, and not to one side: a quarter of a
/// level is half a percent of a dark channel.
#[test]
fn jpeg_is_what_libjpeg_says() {
    let folder = Folder::new();
    let path = folder.write("a.jpg", JPEG);
    let image = read(&path, false).unwrap();
    let expected = read(&folder.write("a.png", JPEG_DECODED), false).unwrap();
    assert_eq!(image.header, Header { size: [37, 29], channels: 3, texel: Texel::Srgb8 });
    assert_eq!(header(&path, false).unwrap(), image.header);
    assert_eq!(expected.header, image.header);
    let texels = (image.bytes.len() / 3) as f64;
    for channel in 0..3 {
        let of = |image: &Image| image.bytes.iter().skip(channel).step_by(3).map(|b| i32::from(*b)).collect::<Vec<_>>();
        let differences: Vec<_> = of(&image).iter().zip(of(&expected)).map(|(a, b)| a - b).collect();
        let most = differences.iter().map(|d| d.abs()).max().unwrap();
        let [mean, spread] =
            [|d: i32| d, i32::abs].map(|f| f64::from(differences.iter().map(|d| f(*d)).sum::<i32>()) / texels);
        println!("channel {channel}: at most {most}, {spread} on average, {mean} with its sign");
        assert!(most <= 6 && spread < 0.5 && mean.abs() < 0.1, "channel {channel}: {most} {spread} {mean}");
    }
}

fn samples() -> [(&'static str, Vec<u8>); 4] {
    let rgb: Vec<u8> = (0..64 * 48 * 3).map(|i| (i * 7 % 251) as u8).collect();
    let row: Vec<u8> = [vec![2, 2, 0, 64]].into_iter().chain((0..4).map(|c| vec![128 + 64, c])).flatten().collect();
    [
        ("a.png", png(::png::ColorType::Rgb, ::png::BitDepth::Eight, [64, 48], &rgb)),
        ("a.exr", exr_file(&["R", "G", "B"], (32, 24))),
        ("a.hdr", hdr_file(64, &vec![row; 16])),
        ("a.jpg", JPEG.to_vec()),
    ]
}

/// A file that is cut off anywhere before its last pixel is an error that says so, never grey texels.
#[test]
fn files_that_are_cut_off() {
    let folder = Folder::new();
    for (name, bytes) in samples() {
        let path = folder.write(name, &bytes);
        assert!(read(&path, false).is_ok(), "{name}");
        for n in [0, 1, 3, 20, bytes.len() / 4, bytes.len() / 2, bytes.len() * 3 / 4] {
            let path = folder.write(name, &bytes[..n]);
            let Err(error) = read(&path, false) else { panic!("{name} of {n} bytes of {}", bytes.len()) };
            // what begins as no image is told so
            assert!(n < 20 || error.contains("get it again, or save it anew"), "{name} of {n} bytes: {error}");
        }
    }
    assert!(read(&folder.write("a.png", b"GIF89a no image of ours"), false).unwrap_err().contains("no PNG"));
    assert!(read(&folder.0.path().join("none"), false).is_err());
}

/// Headers that claim more than there can be: refused before memory is taken.
#[test]
fn sizes_that_lie() {
    let folder = Folder::new();
    let before = mutation::peak_memory();
    for (name, bytes, what) in [
        ("a.png", hollow_png(::png::ColorType::Rgb, [0x7fff_ffff, 1]), "at most 65536 each way"),
        ("a.png", hollow_png(::png::ColorType::Rgb, [60_000, 60_000]), "134217728 in all are read: make it smaller"),
        ("a.png", hollow_png(::png::ColorType::Rgb, [16_384, 8192]), "claims 402653184 bytes of texels"),
        ("a.png", hollow_png(::png::ColorType::Grayscale, [16_384, 8192]), "claims 134217728 bytes of texels"),
        ("a.jpg", jpeg_of(60_000, 60_000), "134217728 in all are read: make it smaller"),
        ("a.jpg", jpeg_of(16_384, 8192), "claims 402653184 bytes of texels"),
    ] {
        let path = folder.write(name, &bytes);
        for error in [header(&path, false).unwrap_err(), read(&path, false).unwrap_err()] {
            assert!(error.contains(what), "{name}: {error}");
            assert!(error.contains("make it smaller") || error.contains("get it again, or save it anew"), "{error}");
        }
    }
    let big = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n";
    assert!(header(&folder.write("a.hdr", big), false).unwrap_err().contains("at most"));
    let big = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 10000 +X 10000\n";
    assert!(read(&folder.write("a.hdr", big), false).unwrap_err().contains("claims"));
    let mut big = samples()[1].1.clone();
    let at = big.windows(10).position(|w| w == b"dataWindow").unwrap() + 10 + 1 + 6 + 4;
    big[at + 8..at + 12].copy_from_slice(&((1i32 << 30) - 1).to_le_bytes());
    assert!(read(&folder.write("a.exr", &big), false).is_err());
    let flat = png(::png::ColorType::Indexed, ::png::BitDepth::One, [1024, 64], &[0; 128 * 64]);
    let texels = read(&folder.write("a.png", &flat), false).unwrap().bytes.len();
    assert!(texels > 500 * flat.len(), "what deflate makes much of is no lie: {texels} of {}", flat.len());
    if let (Some(before), Some(after)) = (before, mutation::peak_memory()) {
        assert!(after.saturating_sub(before) < 128 << 10, "{} KiB more", after - before);
    }
}

#[test]
fn mutants_are_read_or_refused() {
    let folder = Folder::new();
    let valid = samples();
    let mut good = 0;
    let rounds = mutation::rounds("images", 2000, |random| {
        let (name, bytes) = &valid[random.below(valid.len())];
        let head = bytes.len().min(if random.below(2) == 0 { 300 } else { usize::MAX });
        let bad = [mutation::bytes(&bytes[..head], random), bytes[head..].to_vec()].concat();
        let path = folder.write(name, &bad);
        if let Ok(image) = read(&path, false) {
            assert_eq!(image.bytes.len() as u64, image.header.bytes());
            good += 1;
        }
        let _ = header(&path, true);
    });
    assert!(rounds.is_none_or(|n| good > n / 100 && good < n), "{good} of {rounds:?}");
}
