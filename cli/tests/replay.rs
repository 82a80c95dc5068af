//! `rayherd replay` from outside.

mod common;

use std::path::Path;

use common::{assert_mistake, rayherd, repository};

/// The three numbers after `in all`.
fn total(out: &str) -> Vec<f32> {
    let line = out.lines().last().unwrap().strip_prefix("in all [").unwrap().trim_end_matches(']');
    line.split(", ").map(|n| n.parse().unwrap()).collect()
}

/// Width and pixels of a picture.
fn pixels(path: &Path) -> (usize, Vec<[f32; 3]>) {
    let read = exr::prelude::read_first_rgba_layer_from_file(
        path,
        |size, _| (size.width(), vec![[0f32; 3]; size.area()]),
        |(width, pixels), at, (r, g, b, _): (f32, f32, f32, f32)| pixels[at.y() * *width + at.x()] = [r, g, b],
    );
    read.unwrap().layer_data.channel_data.pixels
}

/// What a picture was made without skipping, by lights and by roulette, is replayed so.
#[test]
fn what_was_not_skipped_is_not_skipped_again() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // lamps on both sides of a floor that shine outwards: from one side those on the other are left out
    let lamp = |i: i32| {
        let (side, z) = (if i % 2 == 0 { 1 } else { -1 }, 0.2 * f64::from(i - 12));
        format!(
            "<shape type='rectangle'><transform name='to_world'><scale value='0.05'/><rotate y='1' angle='{}'/>\
             <translate x='{side}' y='0.5' z='{z}'/></transform><emitter type='area'><rgb name='radiance' value='{}'/></emitter></shape>",
            90 * side,
            50 + i
        )
    };
    let text = format!(
        "<scene version='3.0.0'><sensor type='perspective'><float name='fov' value='60'/><transform name='to_world'>\
         <lookat origin='0,4,3' target='0,0,0' up='0,1,0'/></transform></sensor><shape type='rectangle'>\
         <transform name='to_world'><scale value='3'/><rotate x='1' angle='-90'/></transform></shape>{}</scene>",
        (0..24).map(lamp).collect::<String>()
    );
    std::fs::write(folder.join("m.xml"), text).unwrap();
    let image = ["--size", "4x4", "--max-depth", "4"];
    let cornell = repository("examples/cornell-box.xml");
    for (scene, off, on) in [
        ("m.xml", &["--no-skip", "lights"][..], &[][..]),
        (cornell.to_str().unwrap(), &["--no-skip", "roulette", "--rr-depth", "1"], &["--rr-depth", "1"]),
    ] {
        let render = [&["render", scene, "-o", "a.exr", "--spp", "1"], &image[..], off].concat();
        assert_eq!(rayherd(folder, &render).code, 0);
        let (width, pixels) = pixels(&folder.join("a.exr"));
        let mut others = 0;
        for (i, rendered) in pixels.iter().enumerate() {
            let pixel = format!("{},{}", i % width, i / width);
            let replay = [&["replay", scene, "--pixel", &pixel, "--sample", "0"], &image[..]].concat();
            let replayed = |more: &[&str]| {
                let run = rayherd(folder, &[&replay[..], more].concat());
                assert_eq!(run.code, 0, "{}", run.err);
                total(&run.out)
            };
            assert_eq!(replayed(off), rendered, "{off:?} {pixel}");
            others += u32::from(replayed(on) != rendered);
        }
        assert!(others > 0, "{off:?} changes nothing here");
    }
}

#[test]
fn samples_of_a_pixel_add_up_to_what_was_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/cornell-box.xml");
    let scene = scene.to_str().unwrap();
    let image = ["--size", "8x8", "--split", "2", "--seed", "5"];
    let render = [&["render", scene, "-o", "a.exr", "--spp", "2"], &image[..]].concat();
    assert_eq!(rayherd(folder.path(), &render).code, 0);
    let (width, pixels) = pixels(&folder.path().join("a.exr"));
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
