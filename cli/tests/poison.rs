//! NaN and infinity put in wherever a number comes in: refused with file and place, or left out and counted, or counted with the key that replays them.
//! Never a panic, never a pixel that is no number.

mod common;

use std::fs;
use std::path::Path;

use common::{Run, assert_mistake, rayherd};
use serde_json::Value;

const LAMP: &str = "<emitter type='constant'/>";

/// A scene of a quad before the camera, of this material, and whatever else.
fn scene(folder: &Path, material: &str, more: &str) {
    let text = format!(
        "<scene version='3.0.0'>
        <sensor type='perspective'><float name='fov' value='40'/><transform name='to_world'>
        <lookat origin='0,0,3' target='0,0,0' up='0,1,0'/></transform></sensor>
        <shape type='rectangle'>{material}</shape>
        {more}</scene>"
    );
    fs::write(folder.join("poison.xml"), text).unwrap();
}

fn render(folder: &Path) -> Run {
    rayherd(folder, &["render", "poison.xml", "--spp", "4", "--size", "8x8", "--report", "r.json", "-o", "p.exr"])
}

/// A run that went well, all of whose pixels are numbers; its report.
#[track_caller]
fn clean(folder: &Path, what: &str) -> Value {
    let run = render(folder);
    assert_eq!(run.code, 0, "{what}: {}", run.err);
    assert!(pixels(folder).iter().all(|v| v.is_finite() && *v >= 0.0), "{what}: {:?}", pixels(folder));
    serde_json::from_slice(&fs::read(folder.join("r.json")).unwrap()).unwrap()
}

fn pixels(folder: &Path) -> Vec<f32> {
    let image = exr::prelude::read_first_rgba_layer_from_file(
        folder.join("p.exr"),
        |_, _| Vec::new(),
        |values: &mut Vec<f32>, _, (r, g, b, _): (f32, f32, f32, f32)| values.extend([r, g, b]),
    );
    image.unwrap().layer_data.channel_data.pixels
}

/// A picture of 4 x 4 whose first texel is this.
fn picture(path: &Path, first: f32) {
    let texel = |x: usize, y: usize| if x + y == 0 { (first, first, first) } else { (0.5, 0.5, 0.5) };
    exr::prelude::write_rgb_file(path, 4, 4, texel).unwrap();
}

/// Numbers in text that are none, or do not fit a float.
#[test]
fn parameters_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let diffuse = |value: &str| format!("<bsdf type='diffuse'><rgb name='reflectance' value='{value}'/></bsdf>");
    let rough = |value: &str| format!("<bsdf type='roughconductor'><float name='alpha' value='{value}'/></bsdf>");
    let glass = |value: &str| format!("<bsdf type='dielectric'><float name='int_ior' value='{value}'/></bsdf>");
    let metal = |value: &str| {
        format!("<bsdf type='conductor'><rgb name='eta' value='{value}'/><rgb name='k' value='1'/></bsdf>")
    };
    let area = |value: &str| {
        format!("<shape type='rectangle'><emitter type='area'><rgb name='radiance' value='{value}'/></emitter></shape>")
    };
    let sky = |value: &str| format!("<emitter type='constant'><rgb name='radiance' value='{value}'/></emitter>");
    let point =
        |value: &str| format!("<emitter type='point'><point name='position' x='{value}' y='1' z='1'/></emitter>");
    let turned = |value: &str| {
        format!("<shape type='cube'><transform name='to_world'><rotate y='1' angle='{value}'/></transform></shape>")
    };
    let scaled = |value: &str| {
        format!("<shape type='cube'><transform name='to_world'><scale value='{value}'/></transform></shape>")
    };
    let ball = |value: &str| format!("<shape type='sphere'><float name='radius' value='{value}'/></shape>");
    let mut refused = 0;
    for value in ["nan", "NaN", "inf", "-inf", "1e999"] {
        for material in [diffuse(value), rough(value), glass(value), metal(value)] {
            scene(folder, &material, LAMP);
            assert_mistake(&render(folder), &["poison.xml:"]);
            refused += 1;
        }
        for more in [area(value), sky(value), point(value), turned(value), scaled(value), ball(value)] {
            scene(folder, "", &format!("{more}{LAMP}"));
            assert_mistake(&render(folder), &["poison.xml:"]);
            refused += 1;
        }
    }
    // finite as they stand, infinite as floats: refused, or else the picture is one of numbers
    for value in ["1e39", "1e300", "-1e39", "1e-60"] {
        for (material, more) in [
            (diffuse(value), String::new()),
            (rough(value), String::new()),
            (glass(value), String::new()),
            (metal(value), String::new()),
            (String::new(), area(value)),
            (String::new(), sky(value)),
            (String::new(), point(value)),
            (String::new(), scaled(value)),
            (String::new(), ball(value)),
        ] {
            scene(folder, &material, &format!("{more}{LAMP}"));
            let run = render(folder);
            match run.code {
                0 => assert_eq!(clean(folder, &format!("{material}{more}"))["non_finite"], 0, "{material}{more}"),
                // a conductor's eta is found out when the prepared scene is read, which knows no file
                _ => {
                    assert_mistake(&run, &[]);
                    refused += 1;
                }
            }
        }
    }
    println!("{refused} refused");
    // the ray itself: cameras that are nowhere, that look nowhere
    for camera in ["nan,0,3", "inf,0,3", "0,0,1e300"] {
        scene(folder, "", LAMP);
        let text = fs::read_to_string(folder.join("poison.xml")).unwrap().replace("0,0,3", camera);
        fs::write(folder.join("poison.xml"), text).unwrap();
        let run = render(folder);
        if run.code == 0 {
            assert_eq!(clean(folder, camera)["non_finite"], 0, "{camera}");
        } else {
            assert_mistake(&run, &[]);
        }
    }
    for camera in ["nan,0,3,0,0,0,0,1,0,40", "0,0,3,0,0,inf,0,1,0,40", "0,0,3,0,0,0,0,1,0,nan"] {
        scene(folder, "", LAMP);
        assert_mistake(&rayherd(folder, &["render", "poison.xml", "--camera", camera]), &["--camera"]);
    }
}

/// Numbers in binary files: vertices, normals, texture coordinates of a mesh, texels of a texture and of a sky, values of a volume.
#[test]
fn data_are_left_out_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mesh = |poison: f32, at: usize| {
        let mut out = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
            property float nx\nproperty float ny\nproperty float nz\nproperty float u\nproperty float v\nelement face 2\n\
            property list uchar int vertex_indices\nend_header\n"
            .to_vec();
        for (i, [x, y]) in [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].into_iter().enumerate() {
            let mut vertex = [x, y, 0.0, 0.0, 0.0, 1.0, 0.5 * x + 0.5, 0.5 * y + 0.5];
            if i == 3 {
                vertex[at] = poison;
            }
            out.extend(vertex.iter().flat_map(|v: &f32| v.to_le_bytes()));
        }
        for face in [[0, 1, 2], [0, 2, 3]] {
            out.push(3);
            out.extend(face.iter().flat_map(|i: &i32| i.to_le_bytes()));
        }
        fs::write(folder.join("mesh.ply"), out).unwrap();
    };
    let textured = "<bsdf type='diffuse'><texture type='bitmap' name='reflectance'><string name='filename' value='t.exr'/></texture></bsdf>";
    picture(&folder.join("t.exr"), 0.5);
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 1e-45] {
        for at in 0..8 {
            mesh(poison, at);
            let shape = format!("<shape type='ply'><string name='filename' value='mesh.ply'/>{textured}</shape>");
            scene(folder, "", &format!("{shape}{LAMP}"));
            let report = clean(folder, &format!("{poison} at {at}"));
            assert_eq!(report["non_finite"], 0, "{poison} at {at}");
            let skipped =
                report["skipped"]["non_finite"].as_u64().unwrap() + report["skipped"]["out_of_range"].as_u64().unwrap();
            assert_eq!(skipped, u64::from(at < 3 && poison.abs() != 1e-45), "{poison} at {at}: {report}");
        }
        // a texel: refused, or a reflectance within [0, 1]
        picture(&folder.join("t.exr"), poison);
        scene(folder, textured, LAMP);
        let run = render(folder);
        if run.code == 0 {
            assert_eq!(clean(folder, &format!("texel {poison}"))["non_finite"], 0, "texel {poison}");
        } else {
            assert_mistake(&run, &["t.exr"]);
        }
        picture(&folder.join("t.exr"), 0.5);
        // of a sky: refused, or light that the film takes or counts
        picture(&folder.join("sky.exr"), poison);
        scene(folder, "", "<emitter type='envmap'><string name='filename' value='sky.exr'/></emitter>");
        let run = render(folder);
        if poison.is_finite() {
            let counted = clean(folder, &format!("sky {poison}"))["non_finite"].as_u64().unwrap();
            assert!((counted > 0) == (poison == f32::MAX), "sky {poison}: {counted}");
        } else if poison == f32::NEG_INFINITY && run.code == 0 {
            // below 0 is 0
            assert_eq!(clean(folder, "sky")["non_finite"], 0);
        } else {
            assert_mistake(&run, &["sky.exr"]);
        }
        // a value of a volume
        let mut volume =
            b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: raw\nendian: little\n\n".to_vec();
        for i in 0..64 {
            let value = if i == 21 { poison } else { (i % 4) as f32 };
            volume.extend(value.to_le_bytes());
        }
        fs::write(folder.join("v.nrrd"), volume).unwrap();
        let run = rayherd(
            folder,
            &["render", "v.nrrd", "--iso", "1.5", "--spp", "4", "--size", "8x8", "--report", "r.json", "-o", "p.exr"],
        );
        if run.code == 0 {
            assert!(pixels(folder).iter().all(|v| v.is_finite() && *v >= 0.0), "volume {poison}");
        } else {
            assert_mistake(&run, &["v.nrrd"]);
        }
    }
}

/// Light that the film does not take: each contribution is counted, the first are named by pixel and sample, and these replay to it.
#[test]
fn light_beyond_bounds_is_counted_keyed_and_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for (what, lamp) in [
        ("sky", "<emitter type='constant'><rgb name='radiance' value='3e38'/></emitter>"),
        (
            "lamp",
            "<shape type='rectangle'><transform name='to_world'><rotate y='1' angle='180'/><translate z='9'/></transform><emitter type='area'><rgb name='radiance' value='3e38'/></emitter></shape>",
        ),
        (
            "point",
            "<emitter type='point'><point name='position' x='0' y='0' z='1'/><rgb name='intensity' value='3e38'/></emitter>",
        ),
    ] {
        scene(folder, "", lamp);
        let report = clean(folder, what);
        let counted = report["non_finite"].as_u64().unwrap();
        let keys = report["non_finite_at"].as_array().unwrap();
        assert!(counted > 0 && !keys.is_empty(), "{what}: {report}");
        for key in keys {
            let number = |v: &Value| v.as_u64().unwrap().to_string();
            let pixel = format!("{},{}", number(&key["pixel"][0]), number(&key["pixel"][1]));
            let sample = number(&key["sample"]);
            let run =
                rayherd(folder, &["replay", "poison.xml", "--size", "8x8", "--pixel", &pixel, "--sample", &sample]);
            assert_eq!(run.code, 0, "{}", run.err);
            assert!(run.out.contains("which the film REJECTS"), "{what} {pixel} {sample}: {}", run.out);
        }
        println!("{what}: {counted} counted, {} replayed", keys.len());
    }
}
