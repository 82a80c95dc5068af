//! Small scenes, one for each material, emitter, sensor, shape and most of what they have beside their kind, against Mitsuba 3's pictures of them.
//!
//! `oracles/` holds both; `tests/accuracy/run oracles` makes them. What is rendered here is the same on every machine, so a test that passed once fails by a
//! change of ours only. Its samples are few: it finds a wrong model, not a wrong digit, which is for `tests/accuracy/run` to find.

mod common;

use std::path::{Path, PathBuf};

use common::{rayherd, repository};

/// Edge of a picture, and of a tile of it, in pixels.
const SIZE: usize = 24;
const TILE: usize = 4;
/// Independent renders, whose spread is the noise, and samples of each.
const RENDERS: usize = 8;
const SPP: &str = "32";
/// Standard errors that a mean may be off; with that few renders one in 2000 is beyond 6. Beside them what Mitsuba's own noise and roundings may do.
const OF_PICTURE: (f64, f64) = (6.0, 0.002);
/// The same of a tile, of which a picture has 36 in three channels, and so many may be off.
const OF_TILE: (f64, f64) = (8.0, 0.01);
const TILES_OFF: usize = 2;

type Picture = Vec<[f32; 3]>;

fn read(path: &Path) -> Picture {
    let pixels = |size: exr::math::Vec2<usize>, _: &_| (size.0, vec![[0.0; 3]; size.0 * size.1]);
    let set = |(width, out): &mut (usize, Picture), at: exr::math::Vec2<usize>, (r, g, b, _): (f32, f32, f32, f32)| {
        out[at.1 * *width + at.0] = [r, g, b];
    };
    let image = exr::prelude::read_first_rgba_layer_from_file(path, pixels, set).unwrap();
    let (width, out) = image.layer_data.channel_data.pixels;
    assert_eq!((width, out.len()), (SIZE, SIZE * SIZE), "{}", path.display());
    out
}

/// Mean of a channel over some pixels.
fn mean(picture: &Picture, channel: usize, pixels: &[usize]) -> f64 {
    pixels.iter().map(|&i| f64::from(picture[i][channel])).sum::<f64>() / pixels.len() as f64
}

/// How far the renders' mean is from the oracle's, over what it may be.
fn off(ours: &[Picture], oracle: &Picture, channel: usize, pixels: &[usize], (errors, slack): (f64, f64)) -> f64 {
    let means: Vec<f64> = ours.iter().map(|p| mean(p, channel, pixels)).collect();
    let n = means.len() as f64;
    let middle = means.iter().sum::<f64>() / n;
    let variance = means.iter().map(|m| (m - middle).powi(2)).sum::<f64>() / (n - 1.0);
    let expected = mean(oracle, channel, pixels);
    (middle - expected).abs() / (errors * (variance / n).sqrt() + slack * expected.abs() + 1e-6)
}

fn compare(folder: &Path, xml: &Path) -> Result<(), String> {
    let name = xml.file_stem().unwrap().to_str().unwrap();
    let oracle = read(&xml.with_extension("exr"));
    let ours: Vec<Picture> = (0..RENDERS)
        .map(|seed| {
            let (seed, out) = (seed.to_string(), format!("{name}-{seed}.exr"));
            let size = format!("{SIZE}x{SIZE}");
            let xml = xml.to_str().unwrap();
            let run = rayherd(
                folder,
                &["render", xml, "--size", &size, "--spp", SPP, "--seed", &seed, "--max-depth", "8", "-o", &out],
            );
            assert_eq!(run.code, 0, "{name}: {}", run.err);
            read(&folder.join(out))
        })
        .collect();
    let all: Vec<usize> = (0..SIZE * SIZE).collect();
    let tiles = (0..(SIZE / TILE).pow(2)).map(|t| {
        let (x, y) = (t % (SIZE / TILE) * TILE, t / (SIZE / TILE) * TILE);
        (0..TILE * TILE).map(|i| (y + i / TILE) * SIZE + x + i % TILE).collect::<Vec<_>>()
    });
    let tiles: Vec<Vec<usize>> = tiles.collect();
    let mut wrong = Vec::new();
    for channel in 0..3 {
        let of_all = off(&ours, &oracle, channel, &all, OF_PICTURE);
        let tiles_off = tiles.iter().filter(|t| off(&ours, &oracle, channel, t, OF_TILE) > 1.0).count();
        if of_all > 1.0 || tiles_off > TILES_OFF {
            let mean_of_ours = ours.iter().map(|p| mean(p, channel, &all)).sum::<f64>() / RENDERS as f64;
            let of_theirs = mean(&oracle, channel, &all);
            wrong.push(format!(
                "{name}, channel {channel}: mean {mean_of_ours:.5}, Mitsuba's {of_theirs:.5}, {:.1} standard errors; {tiles_off} tiles off",
                of_all * OF_PICTURE.0
            ));
        }
    }
    if wrong.is_empty() { Ok(()) } else { Err(format!("{}\n{}", wrong.join("\n"), leave(name, &ours, &oracle))) }
}

/// Writes where a picture differs: red where ours is brighter, blue where darker, a tenth of the local mean at full strength; a pixel is 8 x 8.
fn leave(name: &str, ours: &[Picture], oracle: &Picture) -> String {
    const ZOOM: usize = 8;
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("oracle-{name}-difference.png"));
    let mut bytes = Vec::with_capacity((SIZE * ZOOM).pow(2) * 3);
    for at in 0..(SIZE * ZOOM).pow(2) {
        let i = at / (SIZE * ZOOM) / ZOOM * SIZE + at % (SIZE * ZOOM) / ZOOM;
        let light = |p: &Picture| p[i].iter().map(|&v| f64::from(v)).sum::<f64>();
        let (o, t) = (ours.iter().map(light).sum::<f64>() / RENDERS as f64, light(oracle));
        let d = (o - t) / (t + 0.01) * 10.0;
        bytes.extend([d, 0.0, -d].map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8));
    }
    let mut encoder =
        png::Encoder::new(std::fs::File::create(&path).unwrap(), (SIZE * ZOOM) as u32, (SIZE * ZOOM) as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
    format!("look at {}", path.display())
}

#[test]
fn small_scenes_are_mitsubas() {
    let folder = tempfile::tempdir().unwrap();
    let mut scenes: Vec<PathBuf> = std::fs::read_dir(repository("cli/tests/oracles"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "xml"))
        .collect();
    scenes.sort();
    assert!(scenes.len() >= 60, "{} scenes", scenes.len());
    // most of such a short render is its beginning and its end, on one thread
    let all = |from: usize| scenes.iter().skip(from).step_by(2).filter_map(|xml| compare(folder.path(), xml).err());
    let wrong: Vec<String> = std::thread::scope(|scope| {
        let halves = [0, 1].map(|from| scope.spawn(move || all(from).collect::<Vec<_>>()));
        halves.into_iter().flat_map(|half| half.join().unwrap()).collect()
    });
    assert!(wrong.is_empty(), "{} of {} differ:\n{}", wrong.len(), scenes.len(), wrong.join("\n"));
}
