use crate::description::MeshFormat;
use crate::import::tests::{folder, mesh_shape, records, triangles, write};
use crate::import::{ImportOptions, import};
use crate::record::Record;

#[test]
fn corners_of_all_forms() {
    let dir = folder();
    let text = "# a comment\nmtllib x.mtl\no thing\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0 0.5 0.5 0.5\r\nv 0 1 0\nvt 0.25\nvt 0.5 0.75 0\n\
                vn 0 0 2\nusemtl red\nf 1 2 3 4\nf -4 -3 -2\ns 1\nf 1/1 2/2 3/1\nf 1//1 2//-1 3//1\nf 1/2/1 \\\n 2/2/1 3/2/1 # end\n\
                l 1 2\nf 1 2\np 1\n";
    let t = triangles(&write(&dir, "a.obj", text), MeshFormat::Obj).unwrap();
    assert_eq!(t.len(), 2 + 1 + 1 + 1 + 1);
    assert_eq!(t[0].p, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]);
    assert_eq!(t[1].p, [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]);
    assert_eq!(t[2].p, t[0].p);
    assert_eq!(t[3].uv, Some([[0.25, 0.0], [0.5, 0.75], [0.25, 0.0]]));
    assert_eq!(t[4].n, Some([[0.0, 0.0, 1.0]; 3]), "unit length");
    assert_eq!((t[5].n, t[5].uv), (Some([[0.0, 0.0, 1.0]; 3]), Some([[0.5, 0.75]; 3])));
}

#[test]
fn smoothing_changes_only_normals() {
    let dir = folder();
    let path = write(&dir, "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 1 1 0\nf 2 -1 3\n");
    let flat = records(&mesh_shape(&path, MeshFormat::Obj, false)).unwrap();
    let smooth = records(&mesh_shape(&path, MeshFormat::Obj, true)).unwrap();
    for (a, b) in flat.iter().zip(&smooth) {
        let (Record::Triangle(a), Record::Triangle(b)) = (a, b) else { panic!() };
        assert_eq!((a.p, a.n, b.n), (b.p, None, Some([[0.0, 0.0, 1.0]; 3])));
    }
    assert_eq!(flat.len(), smooth.len());
    // a file with normals keeps them
    let path = write(&dir, "b.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 1 0 0\nf 1 2 3\nf 1//1 2//1 3//1\n");
    let all = records(&mesh_shape(&path, MeshFormat::Obj, true)).unwrap();
    let normals: Vec<_> = all.iter().map(|r| if let Record::Triangle(t) = r { t.n } else { None }).collect();
    assert_eq!(normals, [None, Some([[1.0, 0.0, 0.0]; 3])]);
}

#[test]
fn errors_name_the_place() {
    let dir = folder();
    let head = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    for (line, what) in [
        ("f 1 2 4", "a.obj:4:7: index 4 of v, but 3 of them stand above: a face names what stands before it"),
        ("f 1 2 0", "index 0"),
        ("f 1 2 -4", "index -4"),
        ("f 1 2 9223372036854775807", "index 9223372036854775807"),
        ("f 1 2 -9223372036854775808", "index -9223372036854775808"),
        ("f 1 2 3/1", "index 1 of vt, but 0"),
        ("f 1 2 3//1", "index 1 of vn, but 0"),
        ("f 1 2 3/1/1/1", "index 1 of vt"),
        ("f a b c", "a.obj:4:3: \"a\" where a corner"),
        ("f /1 2 3", "index 1 of vt"),
        ("\tf / 2 3", "a.obj:4:4: \"/\" is no corner of the form"),
        ("v 1 2", "a.obj:4:5: v needs 3 number(s) and has 2: the line is cut off, export the file again"),
        ("  vn", "a.obj:4:3: vn needs 3 number(s) and has 0"),
        ("vt", "a.obj:4:1: vt needs 1 number(s)"),
        ("v 1  2 x", "a.obj:4:8: \"x\" where a number of v"),
        // of a line that goes on in others the place is in the one that has it
        ("v 1 \\\n2 x", "a.obj:5:3: \"x\" where a number of v"),
        ("v x \\\n2 \\\n3", "a.obj:4:3: \"x\" where a number of v"),
        ("v 1 2\\\n\\\n  x", "a.obj:6:3: \"x\" where a number of v"),
        ("v 1 \\\n2", "a.obj:5:1: v needs 3"),
        ("f 1 2\\\n 9 \\\n", "a.obj:5:2: index 9 of v"),
    ] {
        let error =
            triangles(&write(&dir, "a.obj", format!("{head}{line}\n")), MeshFormat::Obj).unwrap_err().to_string();
        assert!(error.contains(what), "{line}: {error}");
    }
    for text in ["", "garbage in here\n"] {
        let error = triangles(&write(&dir, "a.obj", text), MeshFormat::Obj).unwrap_err().to_string();
        assert!(error.contains("a.obj:1:1: ") && error.contains("no OBJ file"), "{error}");
    }
    let error = triangles(&write(&dir, "a.obj", format!("v {}", "1".repeat(1 << 19))), MeshFormat::Obj).unwrap_err();
    assert!(error.to_string().contains("a.obj:1:1: a line longer"));
    let error = triangles(&write(&dir, "a.obj", "v \\\n".repeat(1 << 19)), MeshFormat::Obj).unwrap_err();
    assert!(error.to_string().contains("continuations"));
    // a backslash at the end goes on in nothing
    let error = triangles(&write(&dir, "a.obj", format!("{head}f 1 2 x \\")), MeshFormat::Obj).unwrap_err();
    assert!(error.to_string().contains("a.obj:4:7: \"x\""), "{error}");
}

/// What a file says of its materials is told where it says it.
#[test]
fn errors_of_materials_name_the_place() {
    let dir = folder();
    write(&dir, "m.mtl", "newmtl red\nKd 1 0 0\n");
    let faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    for (text, what) in [
        (format!("mtllib m.mtl\n{faces}\n usemtl  blue\nf 1 2 3\n"), "a.obj:6:10: usemtl \"blue\", which no mtllib"),
        (format!("mtllib m.mtl\n{faces}usemtl \\\n blue\nf 1 2 3\n"), "a.obj:6:2: usemtl \"blue\""),
        (format!("mtllib m.mtl\n{faces}usemtl\nf 1 2 3\n"), "a.obj:5:1: usemtl \"\""),
        (format!("mtllib m.mtl\n{faces}mtllib n.mtl\nf 1 2 3\n"), "a.obj:5:8: mtllib \"n.mtl\" stands after"),
        (format!("#\n mtllib  gone.mtl\n{faces}f 1 2 3\n"), "a.obj:2:10: material library \"gone.mtl\""),
        (format!("mtllib \\\ngone.mtl\n{faces}f 1 2 3\n"), "a.obj:2:1: material library \"gone.mtl\""),
    ] {
        let read = import(&write(&dir, "a.obj", &text), &ImportOptions::default()).and_then(|out| records(&out));
        let error = read.unwrap_err().to_string();
        assert!(error.contains(what), "{text}: {error}");
    }
}

#[test]
fn numbers_that_are_not_finite_pass() {
    let dir = folder();
    let t = triangles(&write(&dir, "a.obj", "v nan 0 0\nv inf 0 0\nv 1e999 1 0\nf 1 2 3\n"), MeshFormat::Obj).unwrap();
    assert!(t[0].p[0][0].is_nan() && t[0].p[1][0] == f64::INFINITY && t[0].p[2][0] == f64::INFINITY);
}
