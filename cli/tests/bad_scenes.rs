//! Whole files that make no scene, no picture or no job: one short error that says where and what to do, or a warning.

mod common;

use std::fs;

use common::bed::{Bed, LIT, TRIANGLE, noise};
use common::repository;
use serde_json::Value;

#[test]
fn cycles_and_references_to_nothing() {
    let bed = Bed::new();
    bed.xml("self.xml", "<include filename='self.xml'/>")
        .xml("one.xml", "\n<include filename='two.xml'/>")
        .xml("two.xml", "<include filename='one.xml'/>")
        .xml(
            "ref.xml",
            &format!(
                "<bsdf type='twosided' id='m'><ref id='m'/></bsdf>\n<shape type='cube'><ref id='m'/></shape>{LIT}"
            ),
        )
        .xml(
            "pair.xml",
            &format!(
                "<bsdf type='twosided' id='a'><ref id='b'/></bsdf><bsdf type='twosided' id='b'>\n<ref id='a'/></bsdf>\
                 <shape type='cube'><ref id='a'/></shape>{LIT}"
            ),
        )
        .xml(
            "group.xml",
            &format!(
                "<shape type='shapegroup' id='g'><shape type='cube'/>\n<shape type='instance'><ref id='g'/></shape></shape>\
                 <shape type='instance'><ref id='g'/></shape>{LIT}"
            ),
        )
        .xml("nothing.xml", &format!("<shape type='cube'>\n<ref id='no'/></shape>{LIT}"))
        .xml("twice.xml", &format!("<bsdf type='diffuse' id='m'/>\n<bsdf type='diffuse' id='m'/>{LIT}"))
        .write("beyond.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 4\n")
        .write("zero.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n")
        .write("back.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n")
        .write("huge.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n");
    let ply = |index: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 {index}\n"
        )
    };
    bed.write("beyond.ply", ply("3")).write("minus.ply", ply("-1"));
    bed.mistakes(&[
        ("render self.xml", &["self.xml:2:1: ", "cycle: self.xml -> self.xml", "take one of these <include>s out"]),
        (
            "render one.xml",
            &["two.xml:2:1: ", "cycle: one.xml -> two.xml -> one.xml", "take one of these <include>s out"],
        ),
        ("render ref.xml", &["ref.xml:2:30: ", "cycle through \"m\": take this one out"]),
        ("render pair.xml", &["pair.xml:3:1: ", "cycle through \"a\": take this one out"]),
        ("render group.xml", &["group.xml:3:24: ", "cycle through \"g\": take this one out"]),
        ("render nothing.xml", &["nothing.xml:3:1: ", "ref to \"no\"", "nothing in the scene has this id"]),
        ("render twice.xml", &["twice.xml:3:1: ", "id \"m\" is taken", "its own"]),
        ("render beyond.obj", &["beyond.obj:5:7: index 4 of v, but 3", "a face names what stands before it"]),
        ("render zero.obj", &["zero.obj:4:3: index 0"]),
        ("render back.obj", &["back.obj:4:9: index -4"]),
        ("render huge.obj", &["huge.obj:4:7: "]),
        ("render beyond.ply", &["beyond.ply:13:7: ", "vertex index 3, but the file has 3", "export the file again"]),
        ("render minus.ply", &["minus.ply:13:7: ", "vertex index -1"]),
    ]);
}

#[test]
fn nothing_to_see_or_to_see_by() {
    let bed = Bed::new();
    let film = |n: u32| {
        format!(
            "<sensor type='perspective'><film type='hdrfilm'>\n <integer name='width' value='{n}'/><integer name='height' value='{n}'/>\
             </film></sensor><shape type='cube'/>{LIT}"
        )
    };
    let lamp = |kind: &str, file: &str, more: &str| {
        format!(
            "<shape type='cube'/>\n  <shape type='{kind}' id='lamp'><string name='filename' value='{file}'/><emitter type='area'/></shape>{more}"
        )
    };
    let rough = |alpha: &str| {
        format!(
            "<shape type='cube'><bsdf type='roughconductor'><float name='alpha' value='{alpha}'/></bsdf></shape>{LIT}"
        )
    };
    bed.write("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("inf.obj", "v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n")
        .write("far.obj", "v 0 0 0\nv 1e30 0 0\nv 0 1e30 0\nf 1 2 3\n")
        .write("points.obj", "v 0 0 0\nv 1 0 0\n")
        .xml("dark.xml", "<shape type='cube'/>")
        .xml("empty.xml", LIT)
        .xml("black.xml", "<shape type='cube'/><emitter type='constant'><rgb name='radiance' value='0'/></emitter>")
        .xml(
            "flat.xml",
            &format!("<shape type='cube'>\n<transform name='to_world'><scale value='0'/></transform></shape>{LIT}"),
        )
        .xml(
            "flat-seen.xml",
            &format!("<sensor type='perspective'/>\n <shape type='cube'><transform name='to_world'><scale value='0'/></transform></shape>{LIT}"),
        )
        .xml(
            "nan.xml",
            &format!("<shape type='cube'>\n<transform name='to_world'><scale value='nan'/></transform></shape>{LIT}"),
        )
        .xml("film-0.xml", &film(0))
        .xml("film-large.xml", &film(100_000))
        .write("t.obj", TRIANGLE)
        .xml("rough.xml", &rough("-1"))
        .xml("rough-nan.xml", &rough("NaN").replace("NaN", "nan"))
        .xml("ior.xml", &format!("<shape type='cube'><bsdf type='dielectric'>\n <float name='int_ior' value='0'/></bsdf></shape>{LIT}"))
        .xml("albedo.xml", &format!("<shape type='cube'><bsdf type='diffuse'>\n <rgb name='reflectance' value='2'/></bsdf></shape>{LIT}"))
        .xml("factor.xml", &format!("<shape type='cube'><bsdf type='plastic'>\n\n  <rgb name='specular_reflectance' value='1, 1, -1'/></bsdf></shape>{LIT}"))
        .xml("line-light.xml", {
            "<shape type='cube'/><shape type='rectangle' id='lamp'>\n<transform name='to_world'><scale x='0'/></transform>\
             <emitter type='area'/></shape>"
        })
        .xml("flat-sensor.xml", &format!("<shape type='cube'/><sensor type='perspective'>\n <transform name='to_world'><scale z='0'/></transform></sensor>{LIT}"))
        // a lamp of vertices that are none, and one of no triangles
        .write("nan-lamp.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("no-lamp.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 0\n\
            property list uchar int vertex_indices\nend_header\n")
        .xml("nan-lamp.xml", &lamp("obj", "nan-lamp.obj", ""))
        .xml("no-lamp.xml", &lamp("ply", "no-lamp.ply", ""))
        .xml("nan-lamp-lit.xml", &lamp("obj", "nan-lamp.obj", LIT))
        .xml("no-lamp-lit.xml", &lamp("ply", "no-lamp.ply", "<shape type='sphere'><emitter type='area'/></shape>"))
        .xml("flat-lamp-lit.xml", &format!("{}{LIT}", "<shape type='cube'/>\n<shape type='rectangle' id='lamp'><transform name='to_world'>\
            <scale x='0'/></transform><emitter type='area'/></shape>"))
        .xml("point.xml", &format!("<shape type='sphere'>\n<float name='radius' value='0'/></shape>{LIT}"))
        .write("even.nrrd", "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\0\0\0\0\0\0\0\0");
    bed.mistakes(&[
        ("render nan.obj", &["nan.obj", "finite"]),
        ("render inf.obj", &["inf.obj", "finite"]),
        ("render flat.obj", &["flat.obj", "have no area"]),
        ("render far.obj", &["far.obj", "scale is sane"]),
        ("render points.obj", &["points.obj"]),
        ("render dark.xml", &["dark.xml", "emits light", "--light or --sky"]),
        ("render black.xml", &["black.xml", "emits light"]),
        ("render empty.xml", &["empty.xml", "no shapes"]),
        ("render flat.xml", &["flat.xml: no primitive with finite vertices and an extent", "check its transforms"]),
        (
            "render flat-seen.xml",
            &["flat-seen.xml:3:2: to_world flattens", "flat-seen.xml: the scene has no primitive", "12 have no area"],
        ),
        (
            "check flat-seen.xml",
            &["flat-seen.xml:3:2: to_world flattens", "flat-seen.xml: the scene has no primitive", "12 have no area"],
        ),
        ("check flat.obj", &["flat.obj: the scene has no primitive", "2 have no area", "1 problem in flat.obj"]),
        ("check far.obj", &["far.obj: the scene has no primitive", "5 lie beyond", "scale is sane"]),
        ("render nan.xml", &["nan.xml:3:28: \"nan\" is not finite"]),
        ("render flat-sensor.xml", &["flat-sensor.xml:3:2: ", "to_world is singular", "leave out the scale of 0"]),
        ("render point.xml", &["point.xml:2:1: ", "radius 0"]),
        ("render line-light.xml", &["line-light.xml:2:21: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check line-light.xml", &["line-light.xml:2:21: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render nan-lamp.xml", &["nan-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check nan-lamp.xml", &["nan-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render no-lamp.xml", &["no-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check no-lamp.xml", &["no-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render even.nrrd --iso 5", &["even.nrrd", "both sides of the iso value"]),
        ("render even.nrrd --iso nan", &["iso"]),
        ("render film-0.xml", &["film-0.xml:3:2: ", "width 0 should lie between 1 and 65535"]),
        ("render film-large.xml", &["film-large.xml:3:2: ", "width 100000 should lie between 1 and 65535"]),
        ("render t.obj --size 0x0", &["0x0", "--size"]),
        ("render t.obj --size 100000x100000", &["100000x100000", "--size"]),
        ("render ior.xml", &["ior.xml:3:2: ", "int_ior over ext_ior is 0; it should lie between 0.1 and 10"]),
        ("check ior.xml", &["ior.xml:3:2: "]),
        ("render albedo.xml", &["albedo.xml:3:2: ", "reflectance [2.0, 2.0, 2.0] should lie in [0, 1]"]),
        ("check albedo.xml", &["albedo.xml:3:2: "]),
        ("render factor.xml", &["factor.xml:4:3: ", "specular_reflectance [1.0, 1.0, -1.0] should lie in [0, 1]"]),
        ("render rough.xml", &["rough.xml:2:48: roughness [-1.0, -1.0] should lie in (0, 1]"]),
        ("render rough-nan.xml", &["rough-nan.xml:2:48: ", "\"nan\" is not finite"]),
    ]);

    // beside other light it is dark, and that is told
    for (name, place) in [("nan-lamp-lit", "3:3"), ("no-lamp-lit", "3:3"), ("flat-lamp-lit", "3:1")] {
        let told =
            format!("{name}.xml:{place}: shape \"lamp\" emits, but has no area that can be hit: it gives no light");
        for line in [format!("render {name}.xml --spp 1 --size 8x8"), format!("check {name}.xml")] {
            let run = bed.line(&line);
            assert!(run.code == 0 && run.err.contains(&told), "{line}: {}", run.err);
        }
    }

    // without a camera a scene is framed; what is unusable is skipped, counted and reported
    bed.write("some.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 2 5\n");
    bed.xml("plain.xml", &format!("<shape type='obj'><string name='filename' value='some.obj'/></shape>{LIT}"));
    let run = bed.line("check plain.xml");
    assert!(
        run.code == 0 && run.out.contains("camera       perspective"),
        "a camera is placed: {}{}",
        run.out,
        run.err
    );
    let run = bed.line("render plain.xml --spp 1 --size 8x8 --report r.json");
    assert_eq!(run.code, 0, "{}", run.err);
    // it sees the triangle, and what is around it
    let pixels = exr::prelude::read_first_rgba_layer_from_file(
        bed.path().join("plain.exr"),
        |_, _| vec![],
        |values: &mut Vec<f32>, _, (r, ..): (f32, f32, f32, f32)| values.push(r),
    );
    let pixels = pixels.unwrap().layer_data.channel_data.pixels;
    let sky = pixels.iter().filter(|v| **v == 1.0).count();
    assert!(pixels.len() == 64 && (8..=62).contains(&sky), "{sky} of {} pixels see the sky", pixels.len());
    let report: Value = serde_json::from_slice(&fs::read(bed.path().join("r.json")).unwrap()).unwrap();
    let counts = &report["prepare"]["counts"];
    let found = ["records", "triangles", "degenerate", "non_finite"].map(|key| counts[key].as_u64());
    assert_eq!(found, [3, 1, 1, 1].map(Some), "{counts}");
    assert_eq!(
        (report["skipped"]["degenerate"].as_u64(), report["skipped"]["non_finite"].as_u64()),
        (Some(1), Some(1))
    );
}

/// A camera inside of a wall is a black picture and no error: it is told, with the shape and what to do. So is any other black picture, and a shape that
/// its transform flattens. A picture is what its content says, whatever it is called.
#[test]
fn what_is_odd_is_told() {
    let bed = Bed::new();
    let sensor = "<sensor type='perspective'><transform name='to_world'><lookat origin='0, 0, 0' target='0, 0, 1' up='0, 1, 0'/>\
                  </transform></sensor>";
    let cube = |bsdf: &str| format!("{sensor}\n<shape type='cube' id='wall'>{bsdf}</shape>{LIT}");
    let away = "<shape type='rectangle'><transform name='to_world'><translate z='5'/></transform></shape>";
    bed.xml("wall.xml", &cube(""))
        .xml("room.xml", &cube("<bsdf type='twosided'><bsdf type='diffuse'/></bsdf>"))
        .xml("black.xml", &format!("{}{away}", cube("<bsdf type='diffuse'><rgb name='reflectance' value='0'/></bsdf><boolean name='flip_normals' value='true'/>")))
        .xml("flat.xml", &format!("<shape type='cube'/>\n<shape type='sphere'/><shape type='cube'>\n<transform name='to_world'><scale value='0'/></transform></shape>{LIT}"))
        .xml("sheet.xml", &format!("<shape type='rectangle'><transform name='to_world'><scale x='2' y='2' z='0'/></transform></shape>{LIT}"));
    let render = |name: &str| bed.line(&format!("render {name} --spp 1 --size 8x8"));
    let (run, checked) = (render("wall.xml"), bed.line("check wall.xml"));
    for run in [&run, &checked] {
        assert_eq!(run.code, 0, "{}", run.err);
        for part in ["wall.xml:3", "\"wall\"", "one-sided", "--camera", "twosided"] {
            assert!(run.err.contains(part), "no {part:?} in {}", run.err);
        }
    }
    assert!(run.err.contains("wall.exr is black") && checked.err.contains("warning: "), "{}{}", run.err, checked.err);
    let run = render("wall.xml --camera 0,0,5,0,0,0,0,1,0,40");
    assert!(run.code == 0 && run.err.is_empty(), "from outside: {}", run.err);
    let (run, checked) = (render("room.xml"), bed.line("check room.xml"));
    assert!(!run.err.contains("one-sided") && checked.err.is_empty(), "{}{}", run.err, checked.err);
    let (run, checked) = (render("black.xml"), bed.line("check black.xml"));
    assert!(run.code == 0 && run.err.contains("black.exr is black: no light reached the camera"), "{}", run.err);
    assert!(!run.err.contains("one-sided") && checked.err.is_empty(), "{}{}", run.err, checked.err);
    let (run, checked) = (render("flat.xml"), bed.line("check flat.xml"));
    for run in [&run, &checked] {
        assert!(
            run.code == 0 && run.err.contains("flat.xml:3:23: to_world flattens this shape \"cube\""),
            "{}",
            run.err
        );
    }
    let run = render("sheet.xml");
    assert!(run.code == 0 && run.err.is_empty(), "{}", run.err);

    let mut png = vec![];
    let mut encoder = png::Encoder::new(&mut png, 1, 1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&[255, 0, 0]).unwrap();
    let textured = "<shape type='cube'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'><string name='filename' value='red.jpg'/>\
                    </texture></bsdf></shape>";
    bed.write("red.jpg", png).xml("lying.xml", &format!("{textured}{LIT}"));
    let run = render("lying.xml");
    assert!(run.code == 0 && run.err.is_empty(), "a PNG named .jpg: {}", run.err);
}

/// A job file's mistakes are told by line or field.
#[test]
fn job_files() {
    let bed = Bed::new();
    let cornell = repository("examples/cornell-box.xml");
    let job = format!(
        "apiVersion: rayherd.io/v1alpha1\nkind: RenderJob\nspec:\n  scene: {{source: {}}}\n",
        cornell.display()
    );
    bed.write("good.yaml", format!("{job}  image: {{size: 8x8, output: good.exr}}\n  sampling: {{spp: 1}}\n"));
    assert_eq!(bed.line("render -f good.yaml").code, 0);
    bed.write("noise.yaml", noise(3000))
        .write("empty.yaml", "")
        .write("cut.yaml", "apiVersion: rayherd.io/v1alpha1\nkind: RenderJob\nspec:\n  scene: {source")
        .write("kind.yaml", job.replace("RenderJob", "Pod"))
        .write("twice.yaml", format!("{job}  strategy: Auto\n  strategy: Auto\n"))
        .write("gone.yaml", job.replace("cornell-box", "gone"))
        .write("list.yaml", "- 1\n- 2\n")
        .write("long.yaml", format!("{job}# {}\n", "x".repeat(5 << 20)));
    bed.mistakes(&[
        ("render -f noise.yaml", &["noise.yaml"]),
        ("render -f empty.yaml", &["empty.yaml"]),
        ("render -f cut.yaml", &["cut.yaml", "line 4"]),
        ("render -f kind.yaml", &["kind.yaml", "kind"]),
        ("render -f twice.yaml", &["twice.yaml", "strategy"]),
        ("render -f gone.yaml", &["gone.xml", "No such file"]),
        ("render -f list.yaml", &["list.yaml"]),
        ("render -f long.yaml", &["long.yaml", "no job file"]),
    ]);
}
