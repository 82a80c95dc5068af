//! `rayherd compare` from outside.

mod common;

use std::fs;
use std::path::Path;

use common::{assert_mistake, rayherd};
use serde_json::Value;

fn write(path: &Path, size: (usize, usize), value: impl Fn(usize, usize) -> (f32, f32, f32) + Sync) {
    exr::prelude::write_rgb_file(path, size.0, size.1, value).unwrap();
}

fn gradient(x: usize, y: usize) -> (f32, f32, f32) {
    (x as f32 / 8.0, y as f32 / 4.0, 0.5)
}

#[test]
fn pixels_files_and_differences() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write(&at("a.exr"), (8, 4), gradient);
    fs::copy(at("a.exr"), at("copy.exr")).unwrap();
    write(&at("b.exr"), (8, 4), |x, y| {
        let (r, g, b) = gradient(x, y);
        (r, g, if (x, y) == (7, 3) { 1.0 } else { b })
    });
    let json = |run: &common::Run| serde_json::from_str::<Value>(&run.out).unwrap();

    let same = rayherd(folder.path(), &["compare", "a.exr", "copy.exr"]);
    assert_eq!(same.code, 0, "{}", same.err);
    let report = json(&same);
    assert_eq!(report["identical"], true);
    assert_eq!(report["file_identical"], true);
    assert_eq!(report["rmse"], 0.0);

    let other = rayherd(folder.path(), &["compare", "a.exr", "b.exr", "--diff", "d.png"]);
    assert_eq!(other.code, 1, "{}", other.err);
    let report = json(&other);
    assert_eq!(report["identical"], false);
    assert_eq!(report["max_abs_diff"], 0.5);
    assert_eq!(report["rmse"], (0.25f64 / 96.0).sqrt());
    assert_eq!(report["relmse"], 0.25 / 1.01 / 96.0);
    assert_eq!(report["mean_ratio"]["R"], 1.0);
    assert_eq!(report["mean_ratio"]["B"], 16.0 / 16.5);
    assert_eq!(report["channels"]["G"]["max_abs_diff"], 0.0);

    // the difference is one pixel, in blue
    let mut reader =
        png::Decoder::new(std::io::BufReader::new(fs::File::open(at("d.png")).unwrap())).read_info().unwrap();
    let mut texels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut texels).unwrap();
    assert_eq!(texels.len(), 8 * 4 * 3);
    assert!(texels[..texels.len() - 1].iter().all(|&t| t == 0));
    assert!(texels[texels.len() - 1] > 100);

    for (tolerance, code) in [
        (["--max-abs-diff", "0.5"], 0),
        (["--max-abs-diff", "0.49"], 1),
        (["--max-relmse", "0.01"], 0),
        (["--max-mean-error", "0.01"], 1),
    ] {
        let run = rayherd(folder.path(), &["compare", "a.exr", "b.exr", tolerance[0], tolerance[1]]);
        assert_eq!(run.code, code, "{tolerance:?}");
    }
}

#[test]
fn what_cannot_be_compared() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write(&at("a.exr"), (8, 4), gradient);
    write(&at("wide.exr"), (9, 4), gradient);
    exr::prelude::write_rgba_file(at("alpha.exr"), 8, 4, |_, _| (0f32, 0f32, 0f32, 1f32)).unwrap();
    fs::write(at("empty.exr"), "").unwrap();
    fs::write(at("text.exr"), "this is no picture").unwrap();
    let compare = |b: &str| rayherd(folder.path(), &["compare", "a.exr", b]);
    assert_mistake(&compare("none.exr"), &["cannot read none.exr"]);
    assert_mistake(&compare("empty.exr"), &["empty.exr: is no EXR file"]);
    assert_mistake(&compare("text.exr"), &["text.exr: is no EXR file"]);
    assert_mistake(&compare("wide.exr"), &["a.exr is 8x4 but wide.exr is 9x4"]);
    assert_mistake(&compare("alpha.exr"), &["channels B, G, R", "A, B, G, R"]);
    assert_mistake(&rayherd(folder.path(), &["compare", "a.exr", "a.exr", "--max-rmse", "-1"]), &["--max-rmse"]);
    assert_mistake(&rayherd(folder.path(), &["compare", "a.exr", "a.exr", "--diff", "no/d.png"]), &["no/d.png"]);
}

/// Layers count for what is identical, and not for the figures of the picture.
#[test]
fn layers_beside_the_picture() {
    use exr::prelude::{AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, WritableImage};
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, layers: &[(&str, f32)]| {
        let all = [("R", 0.5), ("G", 0.25), ("B", 0.75)].iter().chain(layers);
        let list = all.map(|&(name, x)| AnyChannel::new(name, FlatSamples::F32(vec![x; 32])));
        let channels = AnyChannels::sort(list.collect());
        let layer = Layer::new((8, 4), LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
        Image::from_layer(layer).write().to_file(folder.path().join(name)).unwrap();
    };
    write("a.exr", &[("depth.Z", 3.0), ("uv.U", 0.5)]);
    write("b.exr", &[("depth.Z", 4.0), ("uv.U", 0.5)]);
    write("c.exr", &[("depth.Z", 3.0)]);
    write("d.exr", &[]);
    let compare = |other: &str| {
        let run = rayherd(folder.path(), &["compare", "a.exr", other]);
        (run.code, serde_json::from_str::<Value>(&run.out).unwrap_or_else(|e| panic!("{e}: {}", run.err)))
    };
    assert_eq!(compare("a.exr").0, 0);
    let (code, other) = compare("b.exr");
    assert_eq!((code, &other["identical"], &other["rmse"]), (1, &Value::from(false), &Value::from(0.0)));
    assert_eq!(other["channels"]["depth.Z"]["max_abs_diff"], 1.0);
    assert!(other["mean_ratio"].get("depth.Z").is_none() && other.get("only_in_a").is_none());
    let (code, other) = compare("c.exr");
    assert_eq!((code, &other["only_in_a"]), (1, &Value::from(vec!["uv.U"])));
    let (code, other) = compare("d.exr");
    assert_eq!((code, &other["only_in_a"]), (1, &Value::from(vec!["depth.Z", "uv.U"])));
    let accepted = rayherd(folder.path(), &["compare", "d.exr", "b.exr", "--max-abs-diff", "0"]);
    assert_eq!(accepted.code, 0, "{}", accepted.err);
}
