use crate::description::MeshFormat;
use crate::import::tests::{folder, triangles, write};

const ASCII: &str = "solid a name\nfacet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 0.1 0\n endloop\nendfacet\n\
                     endsolid a name\nsolid\nFACET\nfacet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 1 1 0\n  \
                     vertex 0 1 0\n endloop\nendfacet\nendsolid\n";

fn binary(count: u32, triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
    let mut out = [b"solid, it says".to_vec(), vec![0; 66]].concat();
    out.extend(count.to_le_bytes());
    for t in triangles {
        out.extend([0u8; 12]);
        out.extend(t.iter().flatten().flat_map(|x| x.to_le_bytes()));
        out.extend([0u8; 2]);
    }
    out
}

#[test]
fn text_and_binary_are_the_same_mesh() {
    let dir = folder();
    let text = ASCII.replace("FACET\n", "");
    let a = triangles(&write(&dir, "a.stl", text), MeshFormat::Stl).unwrap();
    let [o, x, d, y, t] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.1, 0.0]];
    let b = triangles(&write(&dir, "b.stl", binary(3, &[[o, x, t], [o, x, d], [o, d, y]])), MeshFormat::Stl).unwrap();
    assert_eq!(a, b);
    assert_eq!(a.len(), 3);
    // text in the head and an exact length: binary all the same
    let mut spaces = binary(1, &[[o, x, d]]);
    spaces[..80].copy_from_slice(&[b' '; 80]);
    spaces[..5].copy_from_slice(b"solid");
    assert_eq!(triangles(&write(&dir, "c.stl", spaces), MeshFormat::Stl).unwrap().len(), 1);
}

#[test]
fn errors_name_the_place() {
    let dir = folder();
    let one = [[[0.0; 3]; 3]];
    let cases: Vec<(Vec<u8>, &str)> = vec![
        (binary(2, &one), "head says 2 triangles, the 134 bytes of the file hold 1"),
        (binary(0, &one), "head says 0"),
        (binary(u32::MAX, &one), "head says 4294967295"),
        (binary(1, &one)[..100].to_vec(), "hold 0"),
        (vec![0; 10], "too short"),
        (vec![], "too short"),
        (ASCII.into(), "a.stl:11:1: \"FACET\" is no word of STL: export"),
        (b"solid x\n".to_vec(), "a.stl:1:1: no facet"),
        (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0".to_vec(), "a.stl:5:11: the file ends in"),
        (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n\n".to_vec(), "a.stl:6:1: the file ends in"),
        (
            b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n endloop".to_vec(),
            "a.stl:6:2: a loop of 2 vertices, which has no area: export the file again",
        ),
        (b"solid x\nfacet normal 0 0 up\n".to_vec(), "a.stl:2:18: \"up\" where a number"),
    ];
    for (bytes, what) in cases {
        let error = triangles(&write(&dir, "a.stl", bytes), MeshFormat::Stl).unwrap_err().to_string();
        assert!(error.contains(what), "{what}: {error}");
    }
}
