//! `rayherd scene` from outside.

mod common;

use std::fs;

use common::{assert_mistake, rayherd};

const TETRAHEDRON: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";

#[test]
fn scenes_grow_and_lose_their_order() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("t.obj"), TETRAHEDRON).unwrap();
    let tool = |arguments: &[&str]| {
        let run = rayherd(folder.path(), &[&["scene"], arguments].concat());
        assert_eq!(run.code, 0, "{}", run.err);
        run.out
    };
    let said = tool(&["subdivide", "t.obj", "-o", "s.ply", "--levels", "2"]);
    assert!(said.starts_with("s.ply: 64 triangles of 4"), "{said}");
    let said = tool(&["replicate", "s.ply", "-o", "r.ply", "--copies", "2,1,1", "--step", "-2,0,0"]);
    assert!(said.starts_with("r.ply: 128 triangles of 64"), "{said}");
    let said = tool(&["interleave", "r.ply", "-o", "i.ply", "--strands", "4"]);
    assert!(said.starts_with("i.ply: 128 triangles of 128"), "{said}");
    assert_ne!(fs::read(folder.path().join("i.ply")).unwrap(), fs::read(folder.path().join("r.ply")).unwrap());

    let refused = |arguments: &[&str], parts: &[&str]| {
        assert_mistake(&rayherd(folder.path(), &[&["scene"], arguments].concat()), parts);
    };
    refused(&["subdivide", "none.obj", "-o", "x.ply"], &["none.obj"]);
    refused(&["subdivide", "t.obj", "-o", "x.ply", "--levels", "9"], &["at most 8"]);
    refused(&["subdivide", "t.obj", "-o", "none/x.ply"], &["none/x.ply"]);
    refused(&["replicate", "t.obj", "-o", "x.ply", "--copies", "2,2", "--step", "1,1,1"], &["--copies", "three"]);
    refused(&["interleave", "t.obj", "-o", "x.ply", "--strands", "0"], &["1 to 4096"]);
    refused(&["many-lights", "0", "-o", "x.xml"], &["1..=100000"]);
    let said = tool(&["many-lights", "120", "-o", "room.xml"]);
    assert!(said.starts_with("room.xml: 120 lamps"), "{said}");
    let room = rayherd(folder.path(), &["render", "room.xml", "--size", "8x8", "--spp", "2"]);
    assert!(room.code == 0 && room.out.contains("room.exr"), "{}{}", room.out, room.err);
    refused(&["house", "--size", "0", "h"], &["1..=256"]);
    let said = tool(&["house", "--size", "1", "h"]);
    assert!(said.starts_with("h: ") && said.contains("triangles"), "{said}");
    // by its XML, and as a folder of meshes with materials of their own
    for scene in ["h/house.xml", "h"] {
        let house = rayherd(folder.path(), &["render", scene, "--size", "8x8", "--spp", "2"]);
        assert_eq!(house.code, 0, "{}{}", house.out, house.err);
        assert_eq!(rayherd(folder.path(), &["check", scene]).code, 0);
    }
    // found before anything is written: this would be 1.2 TB
    let many = ["replicate", "t.obj", "-o", "x.ply", "--copies", "1000000,1000,1", "--step", "1,1,1"];
    refused(&many, &["12000000000 vertices", "fewer levels or copies"]);
    assert!(!folder.path().join("x.ply").exists());
}
