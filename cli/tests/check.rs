//! `rayherd check` from outside.

mod common;

use std::fs;

use common::{rayherd, repository};

#[test]
fn a_good_scene_is_described_and_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/veach-mis.xml");
    let run = rayherd(folder.path(), &["check", scene.to_str().unwrap()]);
    assert_eq!(run.code, 0, "{}", run.err);
    for part in
        ["52 triangles, 5 spheres", "4 rough conductor", "5 shapes of 5 primitives", "0 of zero area", "perspective"]
    {
        assert!(run.out.contains(part), "no {part:?} in {}", run.out);
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// A bare mesh has its own materials; what of them is not read is named.
#[test]
fn materials_of_a_mesh_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let text = "# two\nmtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";
    fs::write(folder.path().join("a.obj"), text).unwrap();
    let check = |arguments: &[&str]| rayherd(folder.path(), &[&["check"], arguments].concat());
    let run = check(&["a.obj"]);
    assert!(
        run.code == 2 && run.err.contains("a.obj:2:8: material library \"a.mtl\" (there is no such file)"),
        "{}",
        run.err
    );
    assert_eq!(check(&["a.obj", "--substitute"]).code, 0);
    assert_eq!(check(&["a.obj", "--albedo", "0.5"]).code, 0);

    let library = "newmtl red\nKd 1 0 0\nKa 1 1 1\nnewmtl odd\nKd 0 1 0\nKa 1 1 1\ndisp none.png\n";
    fs::write(folder.path().join("a.mtl"), library).unwrap();
    let run = check(&["a.obj"]);
    assert_eq!(run.code, 2, "{}", run.err);
    assert!(run.err.contains("a.mtl:7:1: disp in a material library is not supported"), "{}", run.err);
    assert_eq!(run.err.matches("ka is passed over").count(), 1, "once for each library: {}", run.err);
    assert!(run.out.contains("1 obj, 2 part of an obj"), "{}", run.out);
    let run = check(&["a.obj", "--substitute"]);
    assert!(run.code == 0 && run.err.contains("a.mtl:3:1: ka is passed over"), "{}", run.err);

    // a scene around it has materials of its own
    let scene = "<scene version='3.0.0'><shape type='obj'><string name='filename' value='a.obj'/></shape>\
        <emitter type='constant'/><sensor type='perspective' id='one'/>\n<sensor type='perspective' id='two'/></scene>";
    fs::write(folder.path().join("s.xml"), scene).unwrap();
    let run = check(&["s.xml"]);
    assert!(run.code == 0 && !run.err.contains("a.mtl"), "{}", run.err);
    assert!(run.err.contains("s.xml:2:1: sensor \"two\" is left out"), "{}", run.err);
}

/// Bytes that are told.
fn bytes(text: &str) -> f64 {
    let (number, unit) = text.split_once(' ').unwrap_or_else(|| panic!("{text:?}"));
    let power = ["B", "KiB", "MiB", "GiB"].iter().position(|u| *u == unit).unwrap_or_else(|| panic!("{text:?}"));
    number.parse::<f64>().unwrap() * 1024f64.powi(power as i32)
}

/// What a node is said to need is what a render asks for whose memory does not suffice, and what the prepared scene is said to take is about what the store
/// then holds of it. This mesh takes more than most: its triangles lie in rows of the same height.
#[test]
fn memory_that_is_needed_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let run = |line: &str| rayherd(folder.path(), &line.split(' ').collect::<Vec<_>>());
    let tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    fs::write(folder.path().join("t.obj"), tetrahedron).unwrap();
    assert_eq!(run("scene subdivide t.obj -o s.ply --levels 7").code, 0);
    let told = run("check s.ply").out;
    let line = told.lines().find(|l| l.starts_with("prepared")).unwrap_or_else(|| panic!("{told}"));
    let (all, one) = line.split_once("; a node needs memory for one split at least, ").unwrap();
    let all = bytes(all.split_once("about ").unwrap().1);
    let (one, block) = one.split_once(" (with a --block-size of ").unwrap();
    assert_eq!(block, "128.0 MiB)");
    let (least, most) = one.split_once(" to ").unwrap();
    let [least, most] = [least, most].map(bytes);

    let refused = run("render s.ply --size 8x8 --spp 1 --memory 100").err;
    let needed = refused.split("the largest split takes ").nth(1).and_then(|t| t.split(';').next());
    let needed: f64 = needed.unwrap_or_else(|| panic!("{refused}")).parse().unwrap();
    assert!(least <= needed && needed <= most && most < 2.0 * least, "{line}: {needed}");

    assert_eq!(run("prepare s.ply --store p").code, 0);
    let mut found = 0;
    let mut folders = vec![folder.path().join("p")];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap().map(Result::unwrap) {
            if entry.file_type().unwrap().is_dir() {
                folders.push(entry.path());
            } else {
                found += entry.metadata().unwrap().len();
            }
        }
    }
    assert!(all < 1.1 * found as f64 && all > 0.6 * found as f64, "{line}: {found}");
    // 65,536 triangles and two lamps
    assert!(all > 65_540.0 * 50.0, "{line}");
}

/// Everything wrong is told at once: what is not supported, and each file that is broken.
#[test]
fn all_problems_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let text = "<scene version='3.0.0'>\n\n\
        <shape type='ply'><string name='filename' value='cut.ply'/></shape>\n\
        <shape type='rectangle'><bsdf type='ward'/></shape>\n\
        <shape type='obj'><string name='filename' value='good.obj'/></shape>\n\
        <emitter type='constant'/><sensor type='perspective'/>\n\
        <shape type='serialized'><string name='filename' value='gone.serialized'/></shape></scene>";
    fs::write(folder.path().join("s.xml"), text).unwrap();
    fs::write(folder.path().join("cut.ply"), "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n").unwrap();
    fs::write(folder.path().join("good.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 nan\nf 1 2 3\nf 1 1 2\nf 1 2 4\n")
        .unwrap();
    let run = rayherd(folder.path(), &["check", "s.xml"]);
    assert_eq!(run.code, 2, "{}", run.err);
    for part in [
        "s.xml:7:26: mesh file \"gone.serialized\" (there is no such file)",
        "cut.ply:4:1: the file ends in its header: no line end_header, get it again",
        "s.xml:4:25: bsdf \"ward\" is not supported",
        "error: 3 problems in s.xml",
    ] {
        assert!(run.err.contains(part), "no {part:?} in {}", run.err);
    }
    for part in ["5 triangles", "1 of zero area, 1 with NaN", "1 rectangle, cube", "sky of"] {
        assert!(run.out.contains(part), "no {part:?} in {}", run.out);
    }
    // a stand-in that was asked for is no problem
    let run = rayherd(folder.path(), &["check", "s.xml", "--substitute"]);
    assert!(run.code == 2 && run.err.contains("error: 1 problem in s.xml"), "{}", run.err);
    // of a file that is not there the XML's place is told
    fs::write(folder.path().join("t.xml"), text.replace("cut.ply", "gone.ply")).unwrap();
    let run = rayherd(folder.path(), &["check", "t.xml"]);
    assert!(run.code == 2 && run.err.contains("t.xml:3") && run.err.contains("gone.ply"), "{}", run.err);
}

/// Textures that are missing, no images, or cut off: all at once, by file and line; nothing is rendered without them.
#[test]
fn bad_textures_are_named_together() {
    let folder = tempfile::tempdir().unwrap();
    let shape = |name: &str| {
        format!(
            "<shape type='rectangle'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'>\
             <string name='filename' value='{name}'/></texture></bsdf></shape>\n"
        )
    };
    let text = format!(
        "<scene version='3.0.0'>\n{}{}{}{}<emitter type='constant'/></scene>",
        shape("gone.png"),
        shape("text.jpg"),
        shape("cut.hdr"),
        shape("good.hdr")
    );
    fs::write(folder.path().join("s.xml"), text).unwrap();
    fs::write(folder.path().join("text.jpg"), "a text").unwrap();
    let head = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 1\n";
    fs::write(folder.path().join("cut.hdr"), format!("{head}abcd")).unwrap();
    fs::write(folder.path().join("good.hdr"), format!("{head}abcdefgh")).unwrap();
    let run = rayherd(folder.path(), &["check", "s.xml"]);
    assert_eq!(run.code, 2, "{}", run.err);
    for part in [
        "s.xml:2:88: texture file \"gone.png\"",
        "s.xml:3:88: texture file \"text.jpg\"",
        "s.xml:4:46: image ",
        "cut.hdr: row 1: the file is cut off: get it again, or save it anew",
        "3 problems",
    ] {
        assert!(run.err.contains(part), "no {part:?} in {}", run.err);
    }
    assert!(run.out.contains("textures     2: 2 image; 24 B of texels"), "{}", run.out);
    let run = rayherd(folder.path(), &["render", "s.xml"]);
    assert!(run.code == 2 && run.err.contains("gone.png") && run.err.contains("text.jpg"), "{}", run.err);
    let run = rayherd(folder.path(), &["render", "s.xml", "--substitute"]);
    assert!(run.code == 2 && run.err.contains("s.xml:4:46: image "), "{}", run.err);
    assert!(run.err.contains("cut.hdr: row 1: the file is cut off: get it again, or save it anew"), "{}", run.err);
}
