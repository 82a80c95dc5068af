use crate::ImportError;
use crate::description::{Geometry, MeshAttribute, MeshFormat, Slot, TextureKind, Textured};
use crate::import::tests::{folder, mesh_shape, records, records_with, triangles, write};
use crate::import::{ImportOptions, StreamOptions, import};
use crate::record::{Record, TriangleRecord};

/// A quad and a triangle, with extra elements and properties, in an odd order.
const HEADER: &str = "comment by hand\nobj_info nothing\nelement camera 1\nproperty double where\nproperty list uchar short views\n\
                      element vertex 5\nproperty uchar red\nproperty float nz\nproperty float x\nproperty float y\nproperty float z\n\
                      property float nx\nproperty float ny\nproperty float s\nproperty float t\n\
                      element face 3\nproperty short flags\nproperty list uchar uint vertex_index\nproperty float quality\n\
                      element edge 1\nproperty int a\nproperty int b\nend_header\n";

#[derive(Clone, Copy)]
enum Cell {
    U8(u8),
    I16(i16),
    I32(i32),
    U32(u32),
    F32(f32),
    F64(f64),
}
use Cell::*;

fn cells() -> Vec<Cell> {
    let mut out = vec![F64(0.1), U8(2), I16(-1), I16(300)];
    for i in 0..5 {
        let f = i as f32;
        out.extend([
            U8(i),
            F32(1.0),
            F32(f * 0.1),
            F32(-f * 1e-3),
            F32(1.0 / 3.0),
            F32(0.0),
            F32(0.0),
            F32(f),
            F32(0.7),
        ]);
    }
    out.extend([I16(7), U8(4), U32(0), U32(1), U32(2), U32(3), F32(0.5)]);
    out.extend([I16(7), U8(2), U32(0), U32(1), F32(0.5)]); // an edge: no triangle
    out.extend([I16(-7), U8(3), U32(4), U32(3), U32(0), F32(0.5)]);
    out.extend([I32(0), I32(1)]);
    out
}

fn ascii() -> Vec<u8> {
    let mut out = format!("ply\nformat ascii 1.0\n{HEADER}");
    for cell in cells() {
        let word = match cell {
            U8(v) => v.to_string(),
            I16(v) => v.to_string(),
            I32(v) => v.to_string(),
            U32(v) => v.to_string(),
            F32(v) => v.to_string(),
            F64(v) => v.to_string(),
        };
        out += &word;
        out += if out.len() % 3 == 0 { "\n" } else { " " };
    }
    out.into_bytes()
}

fn binary(little: bool) -> Vec<u8> {
    let name = if little { "binary_little_endian" } else { "binary_big_endian" };
    let mut out = format!("ply\r\nformat {name} 1.0\r\n{}", HEADER.replace('\n', "\r\n")).into_bytes();
    for cell in cells() {
        let mut bytes = match cell {
            U8(v) => v.to_le_bytes().to_vec(),
            I16(v) => v.to_le_bytes().to_vec(),
            I32(v) => v.to_le_bytes().to_vec(),
            U32(v) => v.to_le_bytes().to_vec(),
            F32(v) => v.to_le_bytes().to_vec(),
            F64(v) => v.to_le_bytes().to_vec(),
        };
        if !little {
            bytes.reverse();
        }
        out.extend(bytes);
    }
    out
}

#[test]
fn the_three_formats_are_the_same_mesh() {
    let dir = folder();
    let read = |name: &str, bytes: Vec<u8>| triangles(&write(&dir, name, bytes), MeshFormat::Ply).unwrap();
    let a = read("a.ply", ascii());
    assert_eq!(a.len(), 3);
    assert_eq!(a[0].p[1], [f64::from(0.1f32), f64::from(-1e-3f32), f64::from(1.0f32 / 3.0)]);
    assert_eq!(a[0].n, Some([[0.0, 0.0, 1.0]; 3]));
    assert_eq!(a[1].uv, Some([[0.0, 0.7], [2.0, 0.7], [3.0, 0.7]]), "the fan's second triangle has corners 0, 2, 3");
    assert_eq!(a[2].uv, Some([[4.0, 0.7], [3.0, 0.7], [0.0, 0.7]]));
    assert_eq!(a, read("l.ply", binary(true)));
    assert_eq!(a, read("b.ply", binary(false)));
}

#[test]
fn steps_and_spilling_change_nothing() {
    let dir = folder();
    let n = 300;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nelement face {}\n\
         property list int int vertex_indices\nend_header\n",
        n * n,
        (n - 1) * (n - 1)
    );
    for i in 0..n * n {
        text += &format!("{} {} 0.25\n", i % n, i / n);
    }
    for i in (0..n * (n - 1)).filter(|i| i % n < n - 1) {
        text += &format!("4 {} {} {} {}\n", i, i + 1, i + n + 1, i + n);
    }
    let description = mesh_shape(&write(&dir, "grid.ply", text), MeshFormat::Ply, false);
    let all = records(&description).unwrap();
    assert_eq!(all.len(), 2 * (n - 1) * (n - 1));
    let small = StreamOptions { vertex_budget: 0, ..StreamOptions::default() };
    assert_eq!(records_with(&description, small, 7).unwrap(), all);
    let too_small = StreamOptions { vertex_budget: 0, spill_limit: 1000, ..StreamOptions::default() };
    assert!(records_with(&description, too_small, 7).unwrap_err().to_string().contains("spill"));
}

#[test]
fn smooth_normals_are_computed_where_there_are_none() {
    // a roof: two right triangles at 90 degrees along the x axis
    let dir = folder();
    let text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n\
                property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n0 0 -1\n3 0 1 2\n3 1 0 3\n";
    let path = write(&dir, "roof.ply", text);
    let normals = |smooth| -> Vec<TriangleRecord> {
        let all = records(&mesh_shape(&path, MeshFormat::Ply, smooth)).unwrap();
        all.into_iter().map(|r| if let Record::Triangle(t) = r { t } else { unreachable!() }).collect()
    };
    assert!(normals(false).iter().all(|t| t.n.is_none()));
    let all = normals(true);
    let h = std::f32::consts::FRAC_1_SQRT_2;
    let close = |a: [f32; 3], b: [f32; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-6);
    let n = all[0].n.unwrap();
    // front of the first is +z, of the second -y; equal angles at both shared vertices
    assert!(close(n[0], [0.0, -h, h]) && close(n[1], [0.0, -h, h]) && close(n[2], [0.0, 0.0, 1.0]), "{n:?}");
    assert!(close(all[1].n.unwrap()[2], [0.0, -1.0, 0.0]));
}

#[test]
fn errors_name_the_place() {
    let dir = folder();
    let small = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                 element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2\n";
    let cases: &[(&str, &str, &str)] = &[
        (
            "3 0 1 2",
            "3 0 1 3",
            "a.ply:13:7: face 0: vertex index 3, but the file has 3 vertices, numbered from 0: export the file again",
        ),
        ("3 0 1 2", "3 0  -1 2", "a.ply:13:6: face 0: vertex index -1"),
        ("3 0 1 2", "3 0 1", "a.ply:14:1: the file ends in the middle of its data: it is truncated, get it again"),
        ("3 0 1 2", "250 0 1 2", "a.ply:13:1: face 0: 250 corners, which is more than the rest of the file holds"),
        ("3 0 1 2", "-3 0 1 2", "a.ply:13:1: face 0: -3 corners: export the file again"),
        ("3 0 1 2", "3 0 x 2", "a.ply:13:5: \"x\" where a whole number"),
        ("1 0 0\n", "1 zero 0\n", "a.ply:11:3: \"zero\" where a number"),
        ("vertex 3", "vertex 4000000000", "truncated"),
        ("face 1", "face 18446744073709551615", "truncated"),
        ("face 1", "face -1", "a.ply:7:14: \"-1\" is no number of elements: export"),
        ("format ascii 1.0\n", "", "a.ply:8:1: the header has no line format: write"),
        ("ascii", "ebcdic", "a.ply:2:8: unknown format \"ebcdic\": it should be ascii, binary"),
        ("property float x\n", "", "a.ply:3:9: element vertex lacks one of the properties"),
        ("list uchar int", "list float int", "a.ply:8:1: no property that PLY knows"),
        ("list uchar int", "list uchar float", "a.ply:7:9: vertex_indices are floating point numbers: use int"),
        ("vertex_indices", "corners", "a.ply:7:9: element face has no list property"),
        ("element face 1\nproperty list uchar int vertex_indices\n", "", "a.ply:1:1: no element face"),
        ("element vertex 3\n", "", "a.ply:3:1: a property before the first element: put it below"),
        ("end_header\n", "", "a.ply:9:1: no header line that PLY knows: 0 0 0; a header ends with end_header"),
        ("end_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2\n", "", "a.ply:8:1: the file ends in its header"),
        ("ply\n", "plywood\n", "a.ply:1:1: this is no PLY file"),
    ];
    for (from, to, what) in cases {
        let text = small.replacen(from, to, 1);
        assert_ne!(text, small);
        let error = triangles(&write(&dir, "a.ply", text), MeshFormat::Ply).unwrap_err().to_string();
        assert!(error.contains(what), "{to}: {error}");
    }
    let whole = binary(true);
    for cut in [10, 100, whole.len() - 20, whole.len() - 60] {
        let path = write(&dir, "cut.ply", &whole[..cut]);
        let error = triangles(&path, MeshFormat::Ply).unwrap_err();
        assert!(matches!(error, ImportError::Malformed { .. } | ImportError::Limit { .. }), "{error}");
    }
    let huge = format!("ply\n{}", "comment and so on\n".repeat(100_000));
    assert!(
        triangles(&write(&dir, "h.ply", huge), MeshFormat::Ply).unwrap_err().to_string().contains("header is longer")
    );
    let long = format!("ply\n{}", "x".repeat(1 << 20));
    assert!(triangles(&write(&dir, "h.ply", long), MeshFormat::Ply).unwrap_err().to_string().contains("line longer"));
}

/// A triangle and a quad with colours of vertices and of faces.
fn colored(vertex: &str, values: [&str; 4], face: &str, faces: [&str; 2]) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n{vertex}element face 2\n\
         {face}end_header\n"
    );
    for (place, value) in ["0 0 0", "1 0 0", "1 1 0", "0 1 0"].iter().zip(values) {
        text += &format!("{place} {value}\n");
    }
    text + &faces.join("\n") + "\n"
}

fn attributes(text: &str, name: &str, of_faces: bool, srgb: bool) -> Result<Vec<[[f32; 3]; 3]>, ImportError> {
    let dir = folder();
    let mut description = mesh_shape(&write(&dir, "a.ply", text), MeshFormat::Ply, true);
    if let Geometry::MeshFile { attribute, .. } = &mut description.shapes[0].geometry {
        *attribute = Some(MeshAttribute { of_faces, name: name.into(), srgb });
    }
    let value = |r: &Record| if let Record::Triangle(t) = r { t.attribute.unwrap() } else { unreachable!() };
    Ok(records(&description)?.iter().map(value).collect())
}

#[test]
fn colours_of_vertices_and_faces() {
    let list = "property list uchar int vertex_indices\n";
    let bytes = "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n";
    let four = ["255 0 51 9", "0 0 0 9", "255 255 255 9", "1 2 3 9"];
    let text = colored(bytes, four, list, ["3 0 1 2", "4 0 1 2 3"]);
    let found = attributes(&text, "color", false, true).unwrap();
    assert_eq!(found.len(), 3);
    let srgb = |v: f64| rayherd_render::texture::decode_srgb(v / 255.0) as f32;
    assert_eq!(found[0], [[1.0, 0.0, srgb(51.0)], [0.0; 3], [1.0; 3]]);
    assert_eq!(found[2], [found[0][0], [1.0; 3], [srgb(1.0), srgb(2.0), srgb(3.0)]]);
    // as Mitsuba has them: whole numbers stay what they are
    assert_eq!(attributes(&text, "color", false, false).unwrap()[0][0], [255.0, 0.0, 51.0]);
    // of faces, before and behind the list; the second face is fanned
    for before in [true, false] {
        let colors = "property float r\nproperty float g\nproperty float b\n";
        let (face, faces) = match before {
            true => (format!("{colors}{list}"), ["0.1 0.2 0.3 3 0 1 2", "0.5 nan 1e9 4 0 1 2 3"]),
            false => (format!("{list}{colors}"), ["3 0 1 2 0.1 0.2 0.3", "4 0 1 2 3 0.5 nan 1e9"]),
        };
        let found = attributes(&colored("", [""; 4], &face, faces), "color", true, false).unwrap();
        assert_eq!((found.len(), found[0]), (3, [[0.1, 0.2, 0.3]; 3]));
        assert!(found[1..].iter().flatten().all(|c| c[0] == 0.5 && c[1].is_nan() && c[2] == 1e9), "{found:?}");
    }
    // names with a stem; one number stands for three
    let three = "property float heat_x\nproperty float heat_y\nproperty float heat_z\nproperty float tone_r\n";
    let text = colored(three, ["1 2 3 4"; 4], list, ["3 0 1 2", "3 0 2 3"]);
    assert_eq!(attributes(&text, "heat", false, false).unwrap(), [[[1.0, 2.0, 3.0]; 3]; 2]);
    assert_eq!(attributes(&text, "color_tone", false, false).unwrap()[1], [[4.0; 3]; 3]);
    let error = attributes(&text, "color", false, false).unwrap_err().to_string();
    assert!(error.contains("a.ply:3:9: ") && error.contains("r g b or red green blue"), "{error}");
    let error = attributes(&text, "heat", true, false).unwrap_err().to_string();
    assert!(error.contains("a.ply:11:9: element face has no properties heat_x heat_y heat_z"), "{error}");
    let cut = &text[..text.len() - 12];
    assert!(attributes(cut, "heat", false, false).unwrap_err().to_string().contains("truncated"));
}

#[test]
fn a_bare_mesh_has_its_colours() {
    let dir = folder();
    let list = "property list uchar int vertex_indices\n";
    let colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let path = write(&dir, "a.ply", colored(colors, ["9 9 9"; 4], list, ["3 0 1 2", "3 0 2 3"]));
    let out = import(&path, &ImportOptions::default()).unwrap();
    let material = &out.materials[out.shapes[0].material as usize];
    assert_eq!(material.detail.as_ref().unwrap().textured, [Textured::new(Slot::Diffuse, 0)]);
    assert!(matches!(out.textures[0].kind, TextureKind::Attribute { .. }) && out.textures.len() == 1);
    assert!(matches!(records(&out).unwrap()[0], Record::Triangle(TriangleRecord { attribute: Some(_), .. })));
    let options = ImportOptions { albedo: Some([0.5; 3]), ..ImportOptions::default() };
    assert!(import(&path, &options).unwrap().textures.is_empty());
    // of faces where vertices have none
    let faces = format!("{list}{colors}");
    let path = write(&dir, "b.ply", colored("", [""; 4], &faces, ["3 0 1 2 1 2 3", "3 0 2 3 4 5 6"]));
    let out = import(&path, &ImportOptions::default()).unwrap();
    let Geometry::MeshFile { attribute: Some(a), .. } = &out.shapes[0].geometry else { panic!() };
    assert!(a.of_faces && a.srgb);
}
