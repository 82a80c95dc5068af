//! `rayherd replay` from outside.

mod common;

use common::{assert_mistake, rayherd, repository};

/// The three numbers after `in all`.
fn total(out: &str) -> Vec<f32> {
    let line = out.lines().last().unwrap().strip_prefix("in all [").unwrap().trim_end_matches(']');
    line.split(", ").map(|n| n.parse().unwrap()).collect()
}

#[test]
fn samples_of_a_pixel_add_up_to_what_was_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/cornell-box.xml");
    let scene = scene.to_str().unwrap();
    let image = ["--size", "8x8", "--split", "2", "--seed", "5"];
    let render = [&["render", scene, "-o", "a.exr", "--spp", "2"], &image[..]].concat();
    assert_eq!(rayherd(folder.path(), &render).code, 0);
    let pixels = exr::prelude::read_first_rgba_layer_from_file(
        folder.path().join("a.exr"),
        |size, _| (size.width(), vec![[0f32; 3]; size.area()]),
        |(width, pixels), at, (r, g, b, _): (f32, f32, f32, f32)| pixels[at.y() * *width + at.x()] = [r, g, b],
    );
    let (width, pixels) = pixels.unwrap().layer_data.channel_data.pixels;
    for (x, y) in [(4, 5), (2, 2), (6, 7)] {
        let mut sum = [0f32; 3];
        for sample in ["0", "1"] {
            let pixel = format!("{x},{y}");
            let run = rayherd(
                folder.path(),
                &[&["replay", scene, "--pixel", &pixel, "--sample", sample], &image[..]].concat(),
            );
            assert_eq!(run.code, 0, "{}", run.err);
            assert!(run.out.contains("vertex 0 branch 0: from ") && run.out.contains("the path "), "{}", run.out);
            total(&run.out).iter().zip(&mut sum).for_each(|(v, s)| *s += v / 2.0);
        }
        let rendered = pixels[y * width + x];
        // two roundings more than the film makes
        assert!((0..3).all(|c| (sum[c] - rendered[c]).abs() <= 4.0 * f32::EPSILON * sum[c]), "{sum:?} {rendered:?}");
    }
    let outside = rayherd(folder.path(), &["replay", scene, "--size", "8x8", "--pixel", "8,0", "--sample", "0"]);
    assert_mistake(&outside, &["--pixel 8,0", "8x8"]);
    assert_mistake(&rayherd(folder.path(), &["replay", scene, "--pixel", "8", "--sample", "0"]), &["X,Y"]);
}
