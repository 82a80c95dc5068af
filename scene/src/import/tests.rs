//! Dispatch, framing and options of whole imports; helpers for the tests of the formats.

use std::path::{Path, PathBuf};

use super::*;
use crate::description::{Affine, Geometry, Projection, Shape};
use crate::record::{Record, RecordSource, TriangleRecord};

/// A folder that vanishes.
pub(super) fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

/// Writes a file into a folder.
pub(super) fn write(folder: &tempfile::TempDir, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, content).unwrap();
    path
}

/// A mesh file as a shape.
pub(super) fn mesh_shape(path: &Path, format: MeshFormat, smooth: bool) -> Description {
    let shape = Shape {
        name: "mesh".into(),
        place: Place::default(),
        geometry: Geometry::MeshFile { path: path.into(), format, flip_v: false, smooth, attribute: None, parts: None },
        to_world: Affine::IDENTITY,
        material: 0,
        emission: None,
        emission_texture: None,
        flip_normals: false,
        face_normals: false,
    };
    Description { shapes: vec![shape], ..Description::default() }
}

/// All records of a description, in steps of `step`.
pub(super) fn records_with(
    description: &Description,
    options: StreamOptions,
    step: usize,
) -> Result<Vec<Record>, ImportError> {
    let source = DescriptionSource::new(description, options);
    let mut stream = source.open()?;
    let mut out = vec![];
    loop {
        let before = out.len();
        let n = stream.next(&mut out, step)?;
        assert_eq!(out.len() - before, n);
        assert!(n <= step);
        if n == 0 {
            return Ok(out);
        }
    }
}

/// All records of a description.
pub(super) fn records(description: &Description) -> Result<Vec<Record>, ImportError> {
    records_with(description, StreamOptions::default(), 1000)
}

/// The triangles of a mesh file.
pub(super) fn triangles(path: &Path, format: MeshFormat) -> Result<Vec<TriangleRecord>, ImportError> {
    let triangle = |r| match r {
        Record::Triangle(t) => t,
        Record::Sphere(_) => panic!("a sphere in a mesh"),
    };
    Ok(records(&mesh_shape(path, format, false))?.into_iter().map(triangle).collect())
}

const TRIANGLE_PLY: &str = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                            element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2\n";

#[test]
fn a_bare_mesh_is_framed_and_lit() {
    let dir = folder();
    let path = write(&dir, "a.ply", TRIANGLE_PLY);
    let out = import(&path, &ImportOptions::default()).unwrap();
    assert_eq!(out.shapes.len(), 3, "the mesh, then two lights");
    assert!(matches!(out.shapes[0].geometry, Geometry::MeshFile { .. }));
    assert!(out.shapes[1].emission.is_some() && out.shapes[2].emission.is_some());
    assert!(out.environment.is_some() && out.camera.is_some());
    let [lo, hi] = out.bounds.unwrap();
    for shape in &out.shapes[1..] {
        let center = shape.to_world.point([0.0; 3]);
        assert!((0..3).all(|k| lo[k] <= center[k] && center[k] <= hi[k]), "bounds hold the lights");
    }
    assert_eq!(records(&out).unwrap().len(), 5);

    let options = ImportOptions {
        lights: vec!["0,0,5,0,0,0,1,1,3".parse().unwrap()],
        sky: Some([0.0; 3]),
        camera: Some("0,0,4,0,0,0,0,1,0,40".parse().unwrap()),
        albedo: Some([0.1, 0.2, 0.3]),
        size: Some([20, 10]),
        ..ImportOptions::default()
    };
    let out = import(&path, &options).unwrap();
    assert_eq!(out.shapes.len(), 2);
    assert_eq!(out.environment, None);
    assert_eq!(out.size, Some([20, 10]));
    assert_eq!(out.camera.unwrap().projection, Projection::Perspective { fov_x: 40.0 });
    assert_eq!(out.materials[0].bsdf, Bsdf::Diffuse { reflectance: [0.1, 0.2, 0.3] });
}

#[test]
fn a_folder_of_meshes_is_read_by_name() {
    let dir = folder();
    write(&dir, "b.ply", TRIANGLE_PLY);
    write(&dir, "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 4 3\n");
    write(&dir, "notes.txt", "no mesh");
    let out = import(dir.path(), &ImportOptions::default()).unwrap();
    let names: Vec<&str> = out.shapes.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["a.obj", "b.ply", "light-1", "light-2"]);
    assert_eq!(records(&out).unwrap().len(), 2 + 1 + 4);
}

#[test]
fn gzip_is_unpacked() {
    use std::io::Write;
    let dir = folder();
    let mut packer = flate2::write::GzEncoder::new(vec![], flate2::Compression::default());
    packer.write_all(TRIANGLE_PLY.as_bytes()).unwrap();
    let packed = packer.finish().unwrap();
    let path = write(&dir, "a.ply.gz", &packed);
    let out = import(&path, &ImportOptions::default()).unwrap();
    // the pass for the bounds, and before it the head that tells the format and the header that tells of colours
    assert_eq!((out.bytes_read, out.passes), (2 * packed.len() as u64 + packed.len().min(256) as u64, 1));
    assert_eq!(records(&out).unwrap().len(), 5);
    let path = write(&dir, "b.ply.gz", &packed[..packed.len() - 12]);
    assert!(matches!(import(&path, &ImportOptions::default()), Err(ImportError::Malformed { .. })));
}

#[test]
fn what_cannot_be_read_says_so() {
    let dir = folder();
    let flat = TRIANGLE_PLY.replace("1 0 0", "nan 0 0");
    let cases = [
        ("empty.xml", "", "empty"),
        ("random.bin", "\u{1}\u{2}garbage", "no scene that can be read"),
        ("nan.ply", flat.as_str(), "no primitive with finite vertices"),
        ("scene.xml", "<scene version=\"3.0.0\"/>", "no shapes"),
        ("dark.xml", "<scene version=\"3.0.0\"><shape type=\"cube\"/></scene>", "emits light"),
        ("other.xml", "<html></html>", "no Mitsuba scene"),
        ("broken.xml", "<scene><shape type=\"cube\"></scene>", "not well-formed"),
    ];
    for (name, content, what) in cases {
        let path = write(&dir, name, content);
        let error = import(&path, &ImportOptions::default()).unwrap_err().to_string();
        assert!(error.contains(what) && error.contains(name), "{name}: {error}");
    }
    assert!(matches!(import(&dir.path().join("absent"), &ImportOptions::default()), Err(ImportError::Io { .. })));
    let mesh = write(&dir, "a.ply", TRIANGLE_PLY);
    let options = ImportOptions { iso: Some(1.0), ..ImportOptions::default() };
    assert!(import(&mesh, &options).unwrap_err().to_string().contains("iso"));
    let options =
        ImportOptions { sky: Some([0.0; 3]), lights: vec!["0,0,5,0,0,0,1,1,0".parse().unwrap()], ..Default::default() };
    assert!(import(&mesh, &options).unwrap_err().to_string().contains("emits light"));
}

/// What a survey says of memory is what preparing makes, whether one block holds all or several do.
#[test]
fn a_survey_knows_what_preparing_makes() {
    use crate::objects::MemoryObjects;
    use crate::prepare::{Cut, NoProgress, PrepareSettings, SpoolSettings, prepare};
    let dir = folder();
    let n = 120;
    let mut text = String::new();
    for i in 0..n * n {
        text += &format!("v {} {} {}\nvt 0.{i} 0.5\n", i % n, i / n, (i * 7919 % 101) as f64 / 101.0);
    }
    for i in (1..n * (n - 1)).filter(|i| i % n != 0) {
        let [a, b, c, d] = [i, i + 1, i + n + 1, i + n];
        text += &format!("f {a}/{a} {b}/{b} {c}/{c} {d}/{d}\n");
    }
    let path = write(&dir, "grid.obj", text);
    for (smooth, block) in [(false, 128 << 20), (true, 128 << 20), (true, 200_000), (false, 500_000)] {
        let mut description = import(&path, &ImportOptions::default()).unwrap();
        if let Geometry::MeshFile { smooth: slot, .. } = &mut description.shapes[0].geometry {
            *slot = smooth;
        }
        let survey = Survey::of(&description);
        let source = DescriptionSource::new(&description, StreamOptions::default());
        let settings =
            PrepareSettings { cut: Cut::BlockSize(block), overlap_reduction: false, ..PrepareSettings::default() };
        let store = MemoryObjects::new();
        let made = prepare(&description, &source, &settings, &SpoolSettings::default(), &store, &NoProgress).unwrap();
        let splits: Vec<u64> = made.manifest.splits.iter().map(|s| s.geometry.bytes + s.attributes.bytes).collect();
        let near = |told: u64, found: u64| (told as f64 / found as f64 - 1.0).abs() < 0.15;
        let (all, largest) = (splits.iter().sum::<u64>(), *splits.iter().max().unwrap());
        assert!((splits.len() > 1) == (block < 1 << 20), "{splits:?}");
        assert!(near(survey.prepared_bytes(), all), "{smooth} {block}: {} {all}", survey.prepared_bytes());
        // this mesh is a good one
        let [least, most] = survey.split_bytes(block);
        assert!(
            near(if splits.len() > 1 { most } else { least }, largest),
            "{smooth} {block}: {least} to {most}, {largest}"
        );
        assert!(least <= most && most < 2 * least);
    }
}
