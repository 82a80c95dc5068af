//! What is written must be nothing that is read, nor each other, through the binary.

mod common;

use std::fs;
use std::os::unix::fs::FileTypeExt;

use common::{assert_mistake, rayherd, repository};

#[test]
fn a_result_never_replaces_what_it_is_made_of() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = fs::read_to_string(repository("examples/cornell-box.xml")).unwrap();
    fs::write(folder.join("box.xml"), &scene).unwrap();
    let size = ["--size", "8x8", "--spp", "2"];
    let render = |scene: &str, more: &[&str]| rayherd(folder, &[&["render", scene][..], &size, more].concat());
    assert_eq!(render("box.xml", &["-o", "a.exr"]).code, 0);
    // the picture of a sky has the name that the result gets by default
    fs::copy(folder.join("a.exr"), folder.join("sky.exr")).unwrap();
    let sky = "<scene version='3.0.0'><shape type='sphere'/><emitter type='envmap'><string name='filename' value='sky.exr'/></emitter></scene>";
    fs::write(folder.join("sky.xml"), sky).unwrap();
    let before = fs::read(folder.join("sky.exr")).unwrap();
    for (run, name) in [
        (render("sky.xml", &[]), "sky.exr"),
        (render("box.xml", &["-o", "b.exr", "--report", "box.xml"]), "box.xml"),
        (render("box.xml", &["-o", "b.exr", "--preview", "./box.xml"]), "box.xml"),
        (render("box.xml", &["-o", "b.exr", "--report", "b.exr"]), "b.exr"),
        (render("box.xml", &["-o", "b.exr", "--report", "b.png"]), "b.png"),
        (rayherd(folder, &["compare", "a.exr", "sky.exr", "--diff", "sky.exr"]), "sky.exr"),
        (rayherd(folder, &["scene", "subdivide", "box.xml", "-o", "box.xml"]), "box.xml"),
    ] {
        assert_mistake(&run, &[name]);
    }
    assert!(fs::read(folder.join("sky.exr")).unwrap() == before && !folder.join("b.exr").exists());
    assert_eq!(fs::read_to_string(folder.join("box.xml")).unwrap(), scene);
    // a preview may be the picture that it becomes
    assert_eq!(render("box.xml", &["-o", "b.exr", "--preview", "b.png"]).code, 0);
}

#[test]
fn a_device_is_no_file_for_a_mesh() {
    let folder = tempfile::tempdir().unwrap();
    let scene = repository("examples/cornell-box.xml");
    let run = rayherd(folder.path(), &["scene", "subdivide", scene.to_str().unwrap(), "-o", "/dev/null"]);
    assert_mistake(&run, &["/dev/null", "no file"]);
    assert!(fs::metadata("/dev/null").unwrap().file_type().is_char_device());
}
