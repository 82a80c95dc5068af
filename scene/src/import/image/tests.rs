use std::io::Cursor;

use ::exr::prelude::{SpecificChannels, WritableImage};
use ::png::{BitDepth, ColorType, Encoder};
use rayherd_tests::mutation;

use super::*;

fn read(bytes: &[u8]) -> Image {
    match decode(bytes, &ImageLimits::default()) {
        Ok(image) => image,
        Err(problem) => panic!("{problem:?}"),
    }
}

fn error(bytes: &[u8]) -> String {
    format!("{:?}", decode(bytes, &ImageLimits { pixels: 1 << 20 }).unwrap_err())
}

fn png(size: [u32; 2], color: ColorType, depth: BitDepth, raw: &[u8]) -> Vec<u8> {
    let mut out = vec![];
    let mut encoder = Encoder::new(&mut out, size[0], size[1]);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == ColorType::Indexed {
        encoder.set_palette(vec![0, 0, 0, 255, 128, 0]);
        encoder.set_trns(vec![255, 51]);
    }
    encoder.write_header().unwrap().write_image_data(raw).unwrap();
    out
}

/// R = 3x + y, G = -x, B = y / 4.
fn exr() -> Vec<u8> {
    let pixel = |p: ::exr::math::Vec2<usize>| (3.0 * p.0 as f32 + p.1 as f32, -(p.0 as f32), p.1 as f32 / 4.0);
    let mut out = vec![];
    let channels = SpecificChannels::rgb(pixel);
    let image = ::exr::prelude::Image::from_channels((7, 5), channels);
    image.write().non_parallel().to_buffered(Cursor::new(&mut out)).unwrap();
    out
}

fn hdr(header: &str, rows: &[u8]) -> Vec<u8> {
    [header.as_bytes(), rows].concat()
}

const HEADER: &str = "#?RADIANCE\n# by hand\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n";

/// 9 x 2 with both kinds of encoding: the first row in new runs, the second in old ones.
fn runs() -> Vec<u8> {
    let mut rows = vec![2, 2, 0, 9];
    rows.extend([128 + 9, 128]); // red: nine times 128
    rows.extend([9, 0, 1, 2, 3, 4, 5, 6, 7, 8]); // green: as they are
    rows.extend([4, 10, 20, 30, 40, 128 + 5, 7]); // blue
    rows.extend([128 + 8, 129, 1, 136]); // exponents
    rows.extend([64, 128, 255, 130, 1, 1, 1, 7, 9, 9, 9, 0]);
    hdr(&format!("{HEADER}-Y 2 +X 9\n"), &rows)
}

#[test]
fn png_of_every_kind() {
    let grey = read(&png([2, 2], ColorType::Grayscale, BitDepth::Eight, &[0, 51, 102, 255]));
    assert_eq!((grey.width, grey.height, grey.channels, grey.srgb), (2, 2, 1, true));
    assert_eq!(grey.values, [0.0, 0.2, 0.4, 1.0]);
    let rgba = read(&png([1, 1], ColorType::Rgba, BitDepth::Eight, &[255, 0, 51, 102]));
    assert_eq!((rgba.channels, &rgba.values[..]), (4, &[1.0, 0.0, 0.2, 0.4][..]));
    let deep = read(&png([1, 1], ColorType::Rgb, BitDepth::Sixteen, &[255, 255, 0, 1, 128, 0]));
    assert_eq!(deep.values, [1.0, 1.0 / 65535.0, 32768.0 / 65535.0]);
    let bits = read(&png([3, 1], ColorType::Grayscale, BitDepth::One, &[0b1010_0000]));
    assert_eq!(bits.values, [1.0, 0.0, 1.0]);
    let palette = read(&png([2, 1], ColorType::Indexed, BitDepth::Eight, &[1, 0]));
    assert_eq!(palette.channels, 4);
    assert_eq!(palette.values, [1.0, 128.0 / 255.0, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn srgb_is_decoded_and_alpha_is_not() {
    let mut image = read(&png([1, 1], ColorType::Rgba, BitDepth::Eight, &[0, 10, 188, 188]));
    image.decode_srgb();
    let expected = [0.0, 10.0 / 255.0 / 12.92, 0.502_886_5, 188.0 / 255.0];
    assert!(image.values.iter().zip(&expected).all(|(v, e)| (v - e).abs() < 1e-6), "{:?}", image.values);
    let once = image.clone();
    image.decode_srgb();
    assert_eq!(image, once, "a second time changes nothing");
    let mut deep = read(&png([1, 1], ColorType::Grayscale, BitDepth::Sixteen, &[128, 0]));
    deep.decode_srgb();
    assert!((f64::from(deep.values[0]) - srgb_to_linear(32768.0 / 65535.0)).abs() < 1e-7);
}

/// A ramp of known values at quality 98: within 6 of 255, as libjpeg has it too.
#[test]
fn jpeg() {
    let image = read(include_bytes!("testdata/ramp.jpg"));
    assert_eq!((image.width, image.height, image.channels, image.srgb), (24, 16, 3, true));
    for y in 0..16 {
        for x in 0..24 {
            let expected = [20 + x * 8, 40 + y * 10, 200 - x * 4].map(|v| v as f32 / 255.0);
            let found = image.rgb(x, y);
            assert!((0..3).all(|c| (found[c] - expected[c]).abs() < 6.5 / 255.0), "{x} {y} {found:?} {expected:?}");
        }
    }
    let grey = read(include_bytes!("testdata/grey.jpg"));
    assert_eq!((grey.width, grey.height, grey.channels), (24, 16, 1));
    assert!((grey.rgb(23, 3)[1] - 204.0 / 255.0).abs() < 2.5 / 255.0);
    let whole = include_bytes!("testdata/ramp.jpg");
    assert!(error(&whole[..whole.len() / 2 + 200]).contains("JPEG"));
}

#[test]
fn openexr() {
    let image = read(&exr());
    assert_eq!((image.width, image.height, image.channels, image.srgb), (7, 5, 3, false));
    assert_eq!(image.rgb(6, 4), [22.0, -6.0, 1.0]);
    let bytes = exr();
    assert!(error(&bytes[..bytes.len() - 9]).contains("OpenEXR"));
}

#[test]
fn radiance_hdr() {
    let image = read(&runs());
    assert_eq!((image.width, image.height, image.channels, image.srgb), (9, 2, 3, false));
    // 2^(129 - 136) = 1/128
    assert_eq!(image.rgb(2, 0), [1.0, 2.0 / 128.0, 30.0 / 128.0]);
    assert_eq!(image.rgb(8, 0), [128.0, 8.0, 7.0]);
    for x in 0..8 {
        assert_eq!(image.rgb(x, 1), [1.0, 2.0, 255.0 / 64.0]);
    }
    assert_eq!(image.rgb(8, 1), [0.0; 3], "exponent 0 is black");
    let bytes = runs();
    assert!(error(&bytes[..bytes.len() - 1]).contains("ends before its last row"));
    assert!(error(&hdr("#?RGBE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n", &[0; 4])).contains("xyze"));
    assert!(error(&hdr("#?RGBE\n\n+Y 1 +X 1\n", &[0; 4])).contains("rows do not run"));
}

#[test]
fn sizes_are_checked_first() {
    assert!(error(&hdr("#?RGBE\n\n-Y 100000 +X 100000\n", &[0; 64])).contains("Size(100000, 100000)"));
    assert!(error(&hdr("#?RGBE\n\n-Y 1000 +X 1000\n", &[0; 64])).contains("ends before"));
    assert!(error(&hdr("#?RGBE\n\n-Y 0 +X 4\n", &[0; 64])).contains("no pixels"));
    let mut large = png([1, 1], ColorType::Grayscale, BitDepth::Eight, &[0]);
    large[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
    // the header's check sum
    let crc = crc(&large[12..29]);
    large[29..33].copy_from_slice(&crc.to_be_bytes());
    assert!(error(&large).contains("Size(65536, 65536)"), "{}", error(&large));
    assert!(error(b"GIF89a").contains("convert it"));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.hdr");
    std::fs::write(&path, runs()).unwrap();
    assert!(read_image(&path, &ImageLimits::default()).is_ok());
    let e = read_image(&path, &ImageLimits { pixels: 17 }).unwrap_err().to_string();
    assert!(e.contains("a.hdr") && e.contains("9 x 2"), "{e}");
    assert!(matches!(read_image(folder.path(), &ImageLimits::default()), Err(ImportError::Malformed { .. })));
}

/// CRC-32 as PNG has it.
fn crc(bytes: &[u8]) -> u32 {
    let step = |c: u32| (0..8).fold(c, |c, _| if c & 1 == 1 { 0xedb8_8320 ^ c >> 1 } else { c >> 1 });
    !bytes.iter().fold(!0, |c, &b| step((c ^ u32::from(b)) & 255) ^ c >> 8)
}

#[test]
fn damaged_pictures_end_in_an_error_or_a_whole_picture() {
    let seeds = [
        png([5, 4], ColorType::Rgb, BitDepth::Eight, &[77; 60]),
        include_bytes!("testdata/ramp.jpg").to_vec(),
        include_bytes!("testdata/grey.jpg").to_vec(),
        exr(),
        runs(),
    ];
    // only a decoder's own panic is let pass, and only within `exr`
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = std::panic::catch_unwind(|| {
        for seed in &seeds {
            mutation::rounds("pictures", 2000, |random| {
                if let Ok(image) = decode(&mutation::bytes(seed, random), &ImageLimits { pixels: 1 << 16 }) {
                    assert!((1..=4).contains(&image.channels));
                    let n = u64::from(image.width) * u64::from(image.height) * u64::from(image.channels);
                    assert_eq!(image.values.len() as u64, n);
                }
            });
        }
    });
    std::panic::set_hook(hook);
    if let Err(what) = result {
        std::panic::resume_unwind(what);
    }
}
