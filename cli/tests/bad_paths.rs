//! Paths that lead out of the scene's folder, to what is no file, or to where nothing can be written.

mod common;

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use common::bed::{Bed, HDR, LIT, TRIANGLE, assert_error};

/// Files that a scene must not read, and things that are no files.
#[test]
fn what_lies_outside_or_is_no_file() {
    let bed = Bed::new();
    bed.write("secret.obj", TRIANGLE).write("in/a.obj", TRIANGLE).write("secret.raw", [0; 8]);
    let mesh = |name: &str| format!("<shape type='obj'>\n<string name='filename' value='{name}'/></shape>{LIT}");
    let absolute = bed.path().join("secret.obj");
    symlink("../secret.obj", bed.path().join("in/link.obj")).unwrap();
    symlink("/dev/zero", bed.path().join("in/zero.xml")).unwrap();
    fs::create_dir(bed.path().join("in/folder.obj")).unwrap();
    let nhdr =
        |file: &str| format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: {file}\n\n");
    bed.xml("in/up.xml", &mesh("../secret.obj"))
        .xml("in/absolute.xml", &mesh(absolute.to_str().unwrap()))
        .xml("in/link.xml", &mesh("link.obj"))
        .xml("in/gone.xml", &mesh("gone.obj"))
        .xml("in/folder.xml", &mesh("folder.obj"))
        .xml("in/include.xml", "<include filename='../secret.obj'/>")
        .xml("in/device.xml", "<include filename='zero.xml'/>")
        .pipe("in/pipe.xml")
        .xml("in/piped.xml", "\n<include filename='pipe.xml'/>")
        .pipe("in/pipe.obj")
        .xml("in/piped-mesh.xml", &mesh("pipe.obj"))
        .pipe("in/pipe.png")
        .xml(
            "in/piped-texture.xml",
            &format!(
                "<shape type='cube'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'>\n\
                 <string name='filename' value='pipe.png'/></texture></bsdf></shape>{LIT}"
            ),
        )
        .xml(
            "in/piped-sky.xml",
            "<shape type='cube'/><emitter type='envmap'>\n<string name='filename' value='pipe.png'/></emitter>",
        )
        .write("in/up.nhdr", nhdr("../secret.raw"))
        .pipe("in/pipe.raw")
        .write("in/pipe.nhdr", nhdr("pipe.raw"));
    // a mesh's materials and maps
    bed.write("secret.mtl", "hunter2 is the password\n").write("secret.hdr", HDR);
    symlink("../secret.mtl", bed.path().join("in/link.mtl")).unwrap();
    symlink("../secret.hdr", bed.path().join("in/link.hdr")).unwrap();
    let [mtl, hdr] = ["secret.mtl", "secret.hdr"].map(|name| bed.path().join(name));
    let library = |name: &str, file: &str| {
        bed.write(&format!("in/{name}.obj"), format!("# a mesh\nmtllib {file}\n{TRIANGLE}"));
    };
    let map = |name: &str, file: &str| {
        bed.write(&format!("in/{name}.mtl"), format!("newmtl m\nmap_Kd {file}\n"));
        library(name, &format!("{name}.mtl"));
    };
    library("library-up", "../secret.mtl");
    library("library-absolute", mtl.to_str().unwrap());
    library("library-link", "link.mtl");
    library("library-back", "..\\secret.mtl");
    library("library-two", "none.mtl ../secret.mtl");
    map("map-up", "../secret.hdr");
    map("map-absolute", hdr.to_str().unwrap());
    map("map-link", "-clamp on link.hdr");
    // what lies inside may be named through a folder, by a link, and from a library in a folder
    bed.write("in/maps/m.hdr", HDR).write("in/parts/m.mtl", "newmtl m\nmap_Kd ../maps/link.hdr\n");
    symlink("m.hdr", bed.path().join("in/maps/link.hdr")).unwrap();
    library("inside", "parts/m.mtl");
    assert_eq!(bed.line("check in/inside.obj").code, 0);
    for line in ["library-up", "library-absolute", "library-link", "library-back", "library-two"] {
        for more in ["", " --substitute"] {
            let line = format!("check in/{line}.obj{more}");
            let run = bed.line(&line);
            assert_error(&line, &run, 2, &[".obj:2", "outside the scene's folder", "copy it there"]);
            assert!(!run.err.contains("hunter2"), "{}", run.err);
        }
    }
    // links among the meshes of a folder
    bed.write("linked/a.obj", TRIANGLE);
    symlink("a.obj", bed.path().join("linked/b.obj")).unwrap();
    assert_eq!(bed.line("check linked").code, 0);
    symlink("../secret.obj", bed.path().join("linked/c.obj")).unwrap();
    let outside = &["outside the scene's folder", "copy it there"][..];
    bed.mistakes(&[
        ("render in/up.xml", &[&["in/up.xml:3"], outside].concat()),
        ("render in/absolute.xml", &[&["in/absolute.xml:3"], outside].concat()),
        ("render in/link.xml", &[&["in/link.xml:3"], outside].concat()),
        ("render in/gone.xml", &["in/gone.xml:3", "mesh file \"gone.obj\" (there is no such file)"]),
        ("render in/folder.xml", &["folder.obj", "not a regular file"]),
        ("render in/include.xml", &[&["in/include.xml:2"], outside].concat()),
        ("render in/device.xml", &["in/device.xml:2", "outside"]),
        ("render in/piped.xml", &["pipe.xml", "not a regular file"]),
        ("render in/piped-mesh.xml", &["pipe.obj", "not a regular file"]),
        ("render in/piped-texture.xml", &["in/piped-texture.xml:", "pipe.png", "not a regular file"]),
        ("render in/piped-sky.xml", &["pipe.png", "not a regular file"]),
        ("render in/up.nhdr --iso 1", &["up.nhdr:6", "outside"]),
        ("render in/map-up.obj", &[&["in/map-up.mtl:2"], outside].concat()),
        ("render in/map-absolute.obj", &[&["in/map-absolute.mtl:2"], outside].concat()),
        ("render in/map-link.obj", &[&["in/map-link.mtl:2"], outside].concat()),
        ("render linked", &[&["linked/c.obj"], outside].concat()),
        ("render in/pipe.nhdr --iso 1", &["pipe.raw", "not a file"]),
        ("render in/pipe.xml", &["pipe.xml", "not a regular file"]),
        ("check in/pipe.obj", &["pipe.obj", "not a regular file"]),
        ("render /dev/zero", &["/dev/zero", "not a regular file"]),
        ("compare in/pipe.xml in/pipe.xml", &["pipe.xml", "no regular file"]),
        ("compare /dev/zero /dev/zero", &["/dev/zero", "no regular file"]),
        ("render -f /dev/zero", &["/dev/zero", "4194304 bytes", "no job file"]),
        ("render -f in", &["cannot read in"]),
    ]);
    let huge = File::create(bed.path().join("huge.exr")).unwrap();
    if huge.set_len(1 << 42).is_ok() {
        bed.mistakes(&[("compare huge.exr huge.exr", &["huge.exr", "memory"])]);
    } else {
        println!("this file system has no files of 4 TiB: comparing one is not tested");
    }
}

/// What cannot be written or held.
#[test]
fn outputs_and_memory() {
    let bed = Bed::new();
    bed.write("t.obj", TRIANGLE).write("file", "");
    let render = "render t.obj --spp 1 --size 8x8 --sky 1";
    bed.mistakes(&[
        (&format!("{render} -o none/a.exr"), &["cannot write none/a.exr", "-o"]),
        (&format!("{render} -o file/a.exr"), &["cannot write file/a.exr", "-o"]),
        (&format!("{render} -o /proc/a.exr"), &["cannot write /proc/a.exr", "-o"]),
        (&format!("{render} --report none/r.json"), &["cannot write none/r.json"]),
        (&format!("{render} --store file"), &["file"]),
        ("prepare t.obj --store file/s", &["file/s"]),
        (&format!("{render} --memory 100"), &["100 bytes", "largest split takes", "--memory"]),
        (&format!("{render} --memory 0"), &["--memory is 0"]),
    ]);
    // what it takes is said, is enough, and a byte less is not
    let told = bed.line(&format!("{render} --memory 100")).err;
    let needed = told.split("largest split takes ").nth(1).and_then(|t| t.split(';').next()).unwrap();
    let needed: u64 = needed.parse().unwrap_or_else(|_| panic!("{needed:?} in {told}"));
    assert_eq!(bed.line(&format!("{render} --memory {needed}")).code, 0);
    assert_eq!(bed.line(&format!("{render} --memory {}", needed - 1)).code, 2);

    if !Path::new("/dev/full").exists() {
        println!("this system has no /dev/full: full output is not tested");
        return;
    }
    // nothing rendered is lost
    assert_eq!(bed.line(&format!("{render} -o good.exr")).code, 0);
    symlink("/dev/full", bed.path().join("full.exr")).unwrap();
    let run = bed.line(&format!("{render} -o full.exr"));
    assert_error("full", &run, 1, &["cannot write full.exr", "No space left", "it was written to ./full.exr."]);
    let kept = run.err.split("written to ").nth(1).unwrap().split(' ').next().unwrap();
    assert_eq!(fs::read(bed.path().join(kept)).unwrap(), fs::read(bed.path().join("good.exr")).unwrap());
    assert!(fs::metadata("/dev/full").is_ok_and(|m| !m.is_file()));
    let code = Command::new("sh")
        .args(["-c", "exec \"$0\" check t.obj > /dev/full", env!("CARGO_BIN_EXE_rayherd")])
        .current_dir(bed.path())
        .output()
        .unwrap();
    let err = String::from_utf8(code.stderr).unwrap();
    assert_eq!(code.status.code(), Some(1), "{err}");
    assert!(err.contains("standard output") && err.contains("No space left"), "{err}");
}
