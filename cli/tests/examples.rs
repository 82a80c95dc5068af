//! The scenes of `examples/`.

mod common;

use std::fs;

use common::{rayherd, repository};

/// They are read without a word, but for that of an unbounded depth.
#[test]
fn every_example_is_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let mut names = vec![];
    for entry in fs::read_dir(repository("examples")).unwrap().map(Result::unwrap) {
        let path = entry.path();
        if path.extension().is_some_and(|e| e == "xml") {
            let run = rayherd(folder.path(), &["check", path.to_str().unwrap()]);
            assert_eq!(run.code, 0, "{}: {}", path.display(), run.err);
            assert!(run.err.lines().all(|line| line.contains("max_depth -1")), "{}: {}", path.display(), run.err);
            names.push(entry.file_name().into_string().unwrap());
        }
    }
    names.sort();
    assert_eq!(names, ["ajar-door.xml", "cornell-box.xml", "furnace.xml", "still-life.xml", "veach-mis.xml"]);
}

/// In the furnace every pixel is 1, up to its noise: 256 samples spread by 0.005 (measured), and a pixel may be off by eight times that, their mean
/// by four of its own standard errors.
#[test]
fn the_furnace_is_one_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/furnace.xml");
    let run = rayherd(
        folder.path(),
        &["render", scene.to_str().unwrap(), "--size", "16x16", "--spp", "256", "-o", "f.exr", "--files", "exr"],
    );
    assert_eq!(run.code, 0, "{}", run.err);
    let image = exr::prelude::read_first_rgba_layer_from_file(
        folder.path().join("f.exr"),
        |_, _| vec![],
        |values: &mut Vec<[f32; 3]>, _, (r, g, b, _): (f32, f32, f32, f32)| values.push([r, g, b]),
    );
    let pixels = image.unwrap().layer_data.channel_data.pixels;
    let n = pixels.len() as f64;
    assert_eq!(n, 256.0);
    for channel in 0..3 {
        let values: Vec<f64> = pixels.iter().map(|p| f64::from(p[channel])).collect();
        let mean = values.iter().sum::<f64>() / n;
        let spread = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        let worst = values.iter().map(|v| (v - 1.0).abs()).fold(0.0, f64::max);
        println!("channel {channel}: {mean} with a spread of {spread}, at worst {worst} off");
        assert!(spread < 0.007 && worst < 8.0 * 0.005, "{spread} {worst}");
        assert!((mean - 1.0).abs() < 4.0 * spread / n.sqrt(), "{mean}");
    }
}
