//! `rayherd prepare` and `rayherd inspect` from outside.

mod common;

use std::fs;

use common::{assert_mistake, rayherd, repository};

#[test]
fn a_scene_is_prepared_once_and_can_be_inspected() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/cornell-box.xml");
    let scene = scene.to_str().unwrap();
    let prepare = |more: &[&str]| {
        let mut arguments = vec!["prepare", scene, "--store", "prepared"];
        arguments.extend(more);
        rayherd(folder.path(), &arguments)
    };
    let first = prepare(&["--splits", "4"]);
    assert_eq!(first.code, 0, "{}", first.err);
    assert!(first.out.contains("is prepared: 36 primitives"), "{}", first.out);
    let again = prepare(&["--splits", "4"]);
    assert!(again.out.contains("nothing to do"), "{}", again.out);
    // the same last line: the same scene
    assert_eq!(first.out.lines().last(), again.out.lines().last());

    let shown = rayherd(folder.path(), &["inspect", "prepared", "--splits", "--picture", "grid.png"]);
    assert_eq!(shown.code, 0, "{}", shown.err);
    for part in ["36 triangles, 0 spheres of 36 records", "splits       4 with 36 primitives", "owners", "copied\n"] {
        assert!(shown.out.contains(part), "no {part:?} in {}", shown.out);
    }
    assert!(fs::read(folder.path().join("grid.png")).unwrap().starts_with(b"\x89PNG"));

    // without overlap reduction nothing is copied; and now there are two scenes
    let plain = prepare(&["--splits", "4", "--strategy", "scheduling-grid"]);
    assert!(plain.out.contains("(0 copied)"), "{}", plain.out);
    assert_mistake(&rayherd(folder.path(), &["inspect", "prepared"]), &["holds 2 scenes", "--scene"]);
    let hash = plain.out.lines().last().unwrap().split(' ').next().unwrap();
    let shown = rayherd(folder.path(), &["inspect", "prepared", "--scene", &hash[..12]]);
    assert!(shown.out.starts_with(&format!("scene        {hash}")), "{}", shown.out);
}

#[test]
fn bad_input_is_a_mistake_that_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).unwrap();
    write("empty.xml", b"");
    write("cut.xml", b"<scene version='3.0.0'><shape type='rectangle'>");
    write("noise.ply", &(0..4096u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect::<Vec<_>>());
    write("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    write("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n");
    // a gzip head, and nothing that it promises
    write("cut.ply.gz", b"\x1f\x8b\x08\0\0\0\0\0\0\x03");
    let even = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\0\0\0\0\0\0\0\0";
    write("even.nrrd", even.as_bytes());
    fs::create_dir(folder.path().join("folder")).unwrap();
    let prepare = |scene: &str, more: &[&str]| {
        let mut arguments = vec!["prepare", scene, "--store", "s"];
        arguments.extend(more);
        rayherd(folder.path(), &arguments)
    };
    assert_mistake(&prepare("none.xml", &[]), &["none.xml", "No such file"]);
    assert_mistake(&prepare("empty.xml", &[]), &["empty.xml", "empty"]);
    assert_mistake(&prepare("cut.xml", &[]), &["cut.xml"]);
    assert_mistake(&prepare("noise.ply", &[]), &["noise.ply"]);
    assert_mistake(&prepare("nan.obj", &[]), &["nan.obj"]);
    assert_mistake(&prepare("folder", &[]), &["folder"]);
    assert_mistake(&prepare("flat.obj", &[]), &["flat.obj", "lights aside", "of 5 records, 1 have no area"]);
    assert_mistake(&prepare("cut.ply.gz", &[]), &["cut.ply.gz", "cut off", "deflate", "get the file again"]);
    assert_mistake(&prepare("even.nrrd", &["--iso", "5"]), &["even.nrrd", "lights aside", "iso value"]);
    assert_mistake(&prepare("empty.xml", &["--splits", "0"]), &["--splits is 0: give 1 to 1000000"]);
    assert_mistake(&prepare("empty.xml", &["--block-size", "64K"]), &["--block-size", "ambiguous"]);
    assert_mistake(&prepare("empty.xml", &["--overlap-threshold", "2"]), &["--overlap-threshold is 2: give 0 to 1"]);
    assert_mistake(&prepare("empty.xml", &["--splits", "2", "--block-size", "1Mi"]), &["cannot be used with"]);
    assert_mistake(&prepare("empty.xml", &["--light", "1,2,3"]), &["--light", "nine numbers"]);
    assert_mistake(&prepare("empty.xml", &["--size", "0x5"]), &["--size", "WIDTHxHEIGHT"]);
    assert_mistake(&rayherd(folder.path(), &["prepare", "nan.obj", "--store", "empty.xml/x"]), &["empty.xml/x"]);
    assert_mistake(
        &rayherd(folder.path(), &["inspect", "folder"]),
        &["folder holds no prepared scene", "rayherd prepare"],
    );
}
