//! Pictures of extreme scenes: scaled, moved far away, with tiny and huge lights, deep paths, thin films.

mod common;

use std::fs;
use std::path::Path;

use common::rayherd;
use serde_json::Value;

/// A room with a lamp, a glossy ball and a sky, `size` times as large, around `center`.
fn room(folder: &Path, name: &str, size: f64, center: [f64; 3]) {
    let at = |p: [f64; 3]| {
        let [x, y, z] = [0, 1, 2].map(|c| center[c] + size * p[c]);
        format!("{x:e},{y:e},{z:e}")
    };
    let number = |x: f64| format!("{:e}", x * size);
    // the rows of scale and place, axes exchanged without rounding
    let matrix = |rows: [[f64; 3]; 3], p: [f64; 3]| {
        let row = |r: usize| {
            let [a, b, c] = rows[r].map(|x| x * size);
            format!("{a:e} {b:e} {c:e} {:e}", center[r] + size * p[r])
        };
        format!("<transform name='to_world'><matrix value='{} {} {} 0 0 0 1'/></transform>", row(0), row(1), row(2))
    };
    let text = format!(
        "<scene version='3.0.0'>
        <sensor type='perspective'><float name='fov' value='45'/><transform name='to_world'>
            <lookat origin='{}' target='{}' up='0,1,0'/></transform></sensor>
        <shape type='rectangle'>{}<bsdf type='diffuse'><rgb name='reflectance' value='0.6,0.5,0.4'/></bsdf></shape>
        <shape type='cube'>{}<bsdf type='twosided'><bsdf type='diffuse'><rgb name='reflectance' value='0.2,0.5,0.7'/></bsdf></bsdf></shape>
        <shape type='rectangle'>{}<emitter type='area'><rgb name='radiance' value='9,8,7'/></emitter></shape>
        <shape type='sphere'><point name='center' value='{}'/><float name='radius' value='{}'/>
            <bsdf type='roughconductor'><float name='alpha' value='0.25'/></bsdf></shape>
        <shape type='sphere'><point name='center' value='{}'/><float name='radius' value='{}'/>
            <emitter type='area'><rgb name='radiance' value='20'/></emitter></shape>
        <emitter type='constant'><rgb name='radiance' value='0.1,0.2,0.3'/></emitter></scene>",
        at([0.0, 3.0, 6.0]),
        at([0.0, 0.5, 0.0]),
        // floor: the rectangle's normal (z) goes up
        matrix([[4.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, -4.0, 0.0]], [0.0; 3]),
        matrix([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]], [-1.5, 0.5, 0.0]),
        // lamp: looking down
        matrix([[0.5, 0.0, 0.0], [0.0, 0.0, -0.5], [0.0, 0.5, 0.0]], [0.0, 3.0, 0.0]),
        at([1.0, 1.0, 0.5]),
        number(1.0),
        at([0.0, 0.25, 2.0]),
        number(0.25),
    );
    fs::write(folder.join(name), text).unwrap();
}

fn render(folder: &Path, scene: &str, output: &str, more: &[&str]) -> Value {
    let arguments = [&["render", scene, "-o", output, "--report", "r.json"], more].concat();
    let run = rayherd(folder, &arguments);
    assert_eq!(run.code, 0, "{}", run.err);
    serde_json::from_slice(&fs::read(folder.join("r.json")).unwrap()).unwrap()
}

fn compared(folder: &Path, a: &str, b: &str) -> Value {
    serde_json::from_str(&rayherd(folder, &["compare", a, b]).out).unwrap()
}

/// Scaling by a power of two rounds nothing but what is absolute, and nothing may be: the pixels are the same to the bit from 1e-6 to 1e6.
#[test]
fn size_is_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let more = ["--size", "24x24", "--spp", "16"];
    room(folder, "room.xml", 1.0, [0.0; 3]);
    render(folder, "room.xml", "room.exr", &more);
    for power in [-20, -10, 10, 20] {
        room(folder, "scaled.xml", 2f64.powi(power), [0.0; 3]);
        let report = render(folder, "scaled.xml", "scaled.exr", &more);
        assert_eq!(report["non_finite"], 0);
        let equal = compared(folder, "room.exr", "scaled.exr");
        assert_eq!(equal["identical"], true, "scaled by 2^{power}: {equal}");
    }
}

/// A source in f64 may lie a million sizes from its origin: it is recentred before anything is rounded.
#[test]
fn place_is_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let more = ["--size", "24x24", "--spp", "16"];
    room(folder, "room.xml", 1.0, [0.0; 3]);
    render(folder, "room.xml", "room.exr", &more);
    for center in [[1024.0, 0.0, 0.0], [1_048_576.0, -1_048_576.0, 524_288.0]] {
        room(folder, "moved.xml", 1.0, center);
        render(folder, "moved.xml", "moved.exr", &more);
        let equal = compared(folder, "room.exr", "moved.exr");
        assert_eq!(equal["identical"], true, "moved to {center:?}: {equal}");
    }
}

/// A sphere that emits L at distance d lights a surface by pi L (r / d)^2 cos, exactly, for every radius that stays above its horizon.
#[test]
fn lights_of_every_size_give_what_they_should() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let more = ["--size", "4x4", "--spp", "64", "--max-depth", "2"];
    let scene = |radius: f64| {
        let radiance = 10.0 / (radius * radius);
        let text = format!(
            "<scene version='3.0.0'><sensor type='perspective'><float name='fov' value='1'/><transform name='to_world'>
            <lookat origin='3,3,0' target='0,0,0' up='0,1,0'/></transform></sensor>
            <shape type='rectangle'><transform name='to_world'><matrix value='1 0 0 0 0 0 1 0 0 -1 0 0 0 0 0 1'/></transform>
            <bsdf type='diffuse'><rgb name='reflectance' value='0.5'/></bsdf></shape>
            <shape type='sphere'><point name='center' value='0,2,0'/><float name='radius' value='{radius:e}'/>
            <emitter type='area'><rgb name='radiance' value='{radiance:e}'/></emitter></shape></scene>"
        );
        fs::write(folder.join("lamp.xml"), text).unwrap();
        render(folder, "lamp.xml", "lamp.exr", &more)
    };
    scene(0.5);
    fs::rename(folder.join("lamp.exr"), folder.join("half.exr")).unwrap();
    for radius in [1e-6, 1e-5, 1e-3, 0.1, 1.2] {
        let report = scene(radius);
        assert_eq!(report["non_finite"], 0, "radius {radius}");
        let compared = compared(folder, "lamp.exr", "half.exr");
        for ratio in compared["mean_ratio"].as_object().expect("a ratio per channel").values() {
            let ratio = ratio.as_f64().unwrap();
            // both pictures' noise is below a thousandth: MIS gives nearly all to the light
            assert!((ratio - 1.0).abs() < 0.004, "radius {radius}: {ratio}");
        }
    }
}

/// A thousand bounces between walls that emit 1 and reflect a: (1 - a^1000) / (1 - a) at every pixel.
#[test]
fn deep_paths_end_where_they_should() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = |name: &str, a: f64, e: f64| {
        let text = format!(
            "<scene version='3.0.0'><sensor type='perspective'><float name='fov' value='60'/><transform name='to_world'>
            <lookat origin='0.2,0.1,0' target='0,0,1' up='0,1,0'/></transform></sensor>
            <shape type='cube'><boolean name='flip_normals' value='true'/>
            <bsdf type='diffuse'><rgb name='reflectance' value='{a:e}'/></bsdf>
            <emitter type='area'><rgb name='radiance' value='{e:e}'/></emitter></shape></scene>"
        );
        fs::write(folder.join(name), text).unwrap();
    };
    let a = 1.0 - 1.0 / 256.0;
    let light: f64 = (0..1000).map(|n| f64::powi(a, n)).sum();
    scene("deep.xml", a, 1.0 / light);
    scene("one.xml", 0.0, 1.0);
    let more = ["--size", "8x8", "--spp", "16"];
    let report =
        render(folder, "deep.xml", "deep.exr", &[&more[..], &["--max-depth", "1000", "--rr-depth", "1000"]].concat());
    render(folder, "one.xml", "one.exr", &more);
    let compared = compared(folder, "deep.exr", "one.exr");
    let error = 4.0 * (report["rel_mse"].as_f64().unwrap() / 64.0).sqrt();
    println!("{compared}, four standard errors {error}");
    for ratio in compared["mean_ratio"].as_object().expect("a ratio per channel").values() {
        let ratio = ratio.as_f64().unwrap();
        assert!((ratio - 1.0).abs() < error.max(1e-5), "{ratio}, four standard errors are {error}");
    }
}

/// Films of one pixel, and of one row of 32,768.
#[test]
fn films_may_be_thin() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    room(folder, "room.xml", 1.0, [0.0; 3]);
    for (size, pixels) in [("1x1", 1), ("32768x1", 32768), ("1x32768", 32768)] {
        let report =
            render(folder, "room.xml", "thin.exr", &["--size", size, "--spp", "2", "--nodes", "3", "--splits", "3"]);
        assert_eq!(report["samples"], 2 * pixels, "{size}");
        assert_eq!(report["non_finite"], 0);
    }
}
