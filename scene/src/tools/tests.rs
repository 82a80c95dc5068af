use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::*;
use crate::description::{Affine, Description, Geometry, MeshFormat, Place, Shape};
use crate::import::{DescriptionSource, ImportOptions, StreamOptions, import_surface};

/// A tetrahedron with awkward corners, as an OBJ file.
fn tetrahedron(folder: &Path) -> PathBuf {
    let path = folder.join("t.obj");
    std::fs::write(&path, "v 0.1 0 0\nv 1 0.3 0\nv 0 1 0.7\nv 0 0 1e3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n").unwrap();
    path
}

fn read(path: &Path) -> Vec<Triangle> {
    let description = import_surface(path, &ImportOptions::default()).unwrap();
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let mut out = vec![];
    each(&source, &mut |t| {
        out.push(t);
        Ok(())
    })
    .unwrap();
    out
}

fn with<T>(path: &Path, f: impl FnOnce(&dyn RecordSource) -> T) -> T {
    let description = import_surface(path, &ImportOptions::default()).unwrap();
    f(&DescriptionSource::new(&description, StreamOptions::default()))
}

/// The same by its definition: four triangles by midpoints, again and again.
fn divided(t: Triangle, levels: u32) -> Vec<Triangle> {
    if levels == 0 {
        return vec![t];
    }
    let [a, b, c] = t;
    let middle = |p: [f64; 3], q: [f64; 3]| [0, 1, 2].map(|k| p[k] / 2.0 + q[k] / 2.0);
    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]].into_iter().flat_map(|t| divided(t, levels - 1)).collect()
}

/// A triangle whatever its first corner, as bits.
fn key(t: &Triangle) -> [[u64; 3]; 3] {
    let bits = t.map(|p| p.map(f64::to_bits));
    (0..3).map(|k| [bits[k], bits[(k + 1) % 3], bits[(k + 2) % 3]]).min().unwrap()
}

#[test]
fn subdividing_is_exact_and_stays_closed() {
    let dir = tempfile::tempdir().unwrap();
    let path = tetrahedron(dir.path());
    let out = dir.path().join("s.ply");
    for levels in 0..4 {
        let written = with(&path, |source| subdivide(source, levels, &out)).unwrap();
        assert_eq!((written.read, written.triangles), (4, 4 << (2 * levels)));
        assert_eq!(written.bytes, std::fs::metadata(&out).unwrap().len());
        let got = read(&out);
        let mut expected: Vec<_> = read(&path).into_iter().flat_map(|t| divided(t, levels)).collect();
        assert_eq!(got.len(), expected.len());
        let mut keys: Vec<_> = got.iter().map(key).collect();
        keys.sort();
        expected.sort_by_key(key);
        assert_eq!(keys, expected.iter().map(key).collect::<Vec<_>>());
        // each edge is in two triangles, once in each direction
        let mut edges = BTreeMap::new();
        for t in &got {
            for k in 0..3 {
                let [a, b] = [t[k], t[(k + 1) % 3]].map(|p| p.map(f64::to_bits));
                *edges.entry((a.min(b), a.max(b))).or_insert(0) += if a < b { 1 } else { -1 };
            }
        }
        assert!(edges.values().all(|&n| n == 0));
    }
}

#[test]
fn replicating_copies() {
    let dir = tempfile::tempdir().unwrap();
    let path = tetrahedron(dir.path());
    let out = dir.path().join("r.ply");
    let written = with(&path, |source| replicate(source, [2, 1, 3], [10.0, 5.0, -0.5], &out)).unwrap();
    assert_eq!((written.read, written.triangles), (4, 24));
    let (one, all) = (read(&path), read(&out));
    for (i, t) in all.iter().enumerate() {
        let offset = [if i / 4 % 2 == 1 { 10.0 } else { 0.0 }, 0.0, (i / 8) as f64 * -0.5];
        assert_eq!(*t, one[i % 4].map(|p| [0, 1, 2].map(|k| p[k] + offset[k])));
    }
}

#[test]
fn interleaving_only_changes_the_order() {
    let dir = tempfile::tempdir().unwrap();
    let (path, all, out) = (tetrahedron(dir.path()), dir.path().join("all.ply"), dir.path().join("i.ply"));
    with(&path, |source| subdivide(source, 4, &all)).unwrap(); // 1024 triangles: strands longer than one block
    let before = read(&all);
    for strands in [1, 2, 3, 7, 1000, 4096] {
        let written = with(&all, |source| interleave(source, strands, &out)).unwrap();
        assert_eq!(written.triangles, 1024);
        let length = 1024usize.div_ceil(strands as usize);
        let order = (0..length).flat_map(|k| (k..1024).step_by(length).filter(move |i| i % length == k));
        let expected: Vec<_> = order.map(|i| before[i]).collect();
        assert_eq!(read(&out), expected, "{strands} strands");
    }
}

#[test]
fn what_cannot_be_done_leaves_no_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = tetrahedron(dir.path());
    let out = dir.path().join("x.ply");
    let refused = |result: Result<Written, ToolError>, what: &str| {
        let error = result.unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    };
    refused(with(&path, |source| subdivide(source, 9, &out)), "at most 8");
    refused(with(&path, |source| replicate(source, [1, 0, 1], [1.0; 3], &out)), "at least 1");
    refused(with(&path, |source| replicate(source, [1; 3], [f64::NAN; 3], &out)), "finite");
    refused(with(&path, |source| interleave(source, 0, &out)), "1 to 4096");
    refused(with(&path, |source| subdivide(source, 1, Path::new("/"))), "no name");
    refused(with(&path, |source| subdivide(source, 1, &dir.path().join("no/x.ply"))), "cannot write");
    let sphere = Description {
        shapes: vec![Shape {
            name: "s".into(),
            place: Place::default(),
            geometry: Geometry::Sphere { center: [0.0; 3], radius: 1.0 },
            to_world: Affine::IDENTITY,
            material: 0,
            emission: None,
            emission_texture: None,
            flip_normals: false,
            face_normals: false,
        }],
        ..Description::default()
    };
    let source = DescriptionSource::new(&sphere, StreamOptions::default());
    refused(subdivide(&source, 1, &out), "spheres");
    let mut broken = import_surface(&path, &ImportOptions::default()).unwrap();
    let file = dir.path().join("broken.obj");
    std::fs::write(&file, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 9\n").unwrap();
    broken.shapes[0].geometry = Geometry::MeshFile {
        path: file,
        format: MeshFormat::Obj,
        flip_v: false,
        smooth: false,
        attribute: None,
        parts: None,
    };
    let source = DescriptionSource::new(&broken, StreamOptions::default());
    refused(interleave(&source, 2, &out), "index 9");
    let mut left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["broken.obj", "t.obj"]);
}
