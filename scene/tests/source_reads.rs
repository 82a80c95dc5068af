//! What preparing reads of a source: each file at most twice, as counted where it is read, and as the kernel counted it.

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::sync::Mutex;

use flate2::Compression;
use flate2::write::GzEncoder;
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{ByteKind, ByteOp, PrepareProgress, PrepareSettings, SpoolSettings, Stage, prepare};

/// What tells the format of a file, and what materials or colours a mesh has: read before it is known who reads the rest. Of a volume it is
/// looked at twice, of a mesh 4 KiB are read, and what is packed is read by 32 KiB.
const HEAD: u64 = 256 + 132 + (32 << 10);
/// Vertices along a side of the grid that every mesh here is.
const N: usize = 80;

fn height(i: usize, j: usize) -> f64 {
    ((i * 7 + j * 3) % 5) as f64 / 8.0
}

fn vertices() -> impl Iterator<Item = [f64; 3]> {
    (0..N * N).map(|k| [(k / N) as f64, (k % N) as f64, height(k / N, k % N)])
}

fn triangles() -> impl Iterator<Item = [usize; 3]> {
    (0..N - 1)
        .flat_map(|i| (0..N - 1).map(move |j| i * N + j))
        .flat_map(|a| [[a, a + N, a + 1], [a + 1, a + N, a + N + 1]])
}

fn ply(binary: bool) -> Vec<u8> {
    let (nv, nf) = (vertices().count(), triangles().count());
    let format = if binary { "binary_little_endian" } else { "ascii" };
    let mut out = format!(
        "ply\nformat {format} 1.0\nelement vertex {nv}\nproperty float x\nproperty float y\nproperty float z\nelement face {nf}\n\
         property list uchar int vertex_indices\nend_header\n"
    )
    .into_bytes();
    for p in vertices() {
        match binary {
            true => out.extend(p.iter().flat_map(|x| (*x as f32).to_le_bytes())),
            false => writeln!(out, "{} {} {}", p[0], p[1], p[2]).unwrap(),
        }
    }
    for t in triangles() {
        match binary {
            true => {
                out.push(3);
                out.extend(t.iter().flat_map(|i| (*i as i32).to_le_bytes()));
            }
            false => writeln!(out, "3 {} {} {}", t[0], t[1], t[2]).unwrap(),
        }
    }
    out
}

fn obj() -> Vec<u8> {
    let mut out = String::new();
    vertices().for_each(|p| writeln!(out, "v {} {} {}", p[0], p[1], p[2]).unwrap());
    triangles().for_each(|t| writeln!(out, "f {} {} {}", t[0] + 1, t[1] + 1, t[2] + 1).unwrap());
    out.into_bytes()
}

fn stl(binary: bool) -> Vec<u8> {
    let all: Vec<[f64; 3]> = vertices().collect();
    let mut out = if binary { vec![0; 80] } else { b"solid grid\n".to_vec() };
    if binary {
        out.extend((triangles().count() as u32).to_le_bytes());
    }
    for t in triangles() {
        match binary {
            true => {
                out.extend([0; 12]);
                out.extend(t.iter().flat_map(|&i| all[i]).flat_map(|x| (x as f32).to_le_bytes()));
                out.extend([0; 2]);
            }
            false => {
                out.extend(b"facet normal 0 0 1\nouter loop\n");
                t.iter().for_each(|&i| writeln!(out, "vertex {} {} {}", all[i][0], all[i][1], all[i][2]).unwrap());
                out.extend(b"endloop\nendfacet\n");
            }
        }
    }
    out
}

fn gz(bytes: &[u8]) -> Vec<u8> {
    let mut out = GzEncoder::new(Vec::new(), Compression::default());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

/// Samples of a ball with some noise, so that gzip does not make nothing of it: x fastest, 16 bits.
fn samples(side: usize) -> Vec<u8> {
    let c = side as f64 / 2.0;
    let value = |x: usize, y: usize, z: usize| {
        let d = [x, y, z].map(|v| v as f64 - c).iter().map(|v| v * v).sum::<f64>().sqrt();
        (1000.0 - 40.0 * d + ((x * 7919 + y * 104_729 + z * 1_299_709) % 31) as f64) as i16
    };
    let all = (0..side).flat_map(|z| (0..side).flat_map(move |y| (0..side).map(move |x| [x, y, z])));
    all.flat_map(|[x, y, z]| value(x, y, z).to_le_bytes()).collect()
}

/// An image of a series, explicit little endian.
fn dicom(z: usize, side: usize, pixels: &[u8]) -> Vec<u8> {
    let mut out = vec![0; 128];
    out.extend(b"DICM");
    let mut element = |tag: [u16; 2], vr: &[u8; 2], value: &[u8]| {
        let mut value = value.to_vec();
        if !value.len().is_multiple_of(2) {
            value.push(b' ');
        }
        tag.iter().for_each(|t| out.extend(t.to_le_bytes()));
        out.extend(vr);
        if vr == b"OW" {
            out.extend([0, 0]);
            out.extend((value.len() as u32).to_le_bytes());
        } else {
            out.extend((value.len() as u16).to_le_bytes());
        }
        out.extend(value);
    };
    let short = |v: usize| (v as u16).to_le_bytes();
    element([2, 0x10], b"UI", b"1.2.840.10008.1.2.1\0");
    element([0x20, 0x0e], b"UI", b"1.2.3\0");
    element([0x20, 0x32], b"DS", format!("0\\0\\{z}").as_bytes());
    element([0x20, 0x37], b"DS", b"1\\0\\0\\0\\1\\0");
    element([0x28, 2], b"US", &short(1));
    element([0x28, 0x10], b"US", &short(side));
    element([0x28, 0x11], b"US", &short(side));
    element([0x28, 0x30], b"DS", b"1\\1");
    element([0x28, 0x100], b"US", &short(16));
    element([0x28, 0x101], b"US", &short(16));
    element([0x28, 0x102], b"US", &short(15));
    element([0x28, 0x103], b"US", &short(1));
    element([0x7fe0, 0x10], b"OW", pixels);
    out
}

fn nifti(side: usize, samples: &[u8]) -> Vec<u8> {
    let mut out = vec![0u8; 352];
    out[..4].copy_from_slice(&348i32.to_le_bytes());
    for (k, d) in [3, side, side, side].into_iter().enumerate() {
        out[40 + 2 * k..42 + 2 * k].copy_from_slice(&(d as i16).to_le_bytes());
    }
    out[70..72].copy_from_slice(&4i16.to_le_bytes());
    for k in 0..4 {
        out[76 + 4 * k..80 + 4 * k].copy_from_slice(&1f32.to_le_bytes());
    }
    out[108..112].copy_from_slice(&352f32.to_le_bytes());
    out[344..348].copy_from_slice(b"n+1\0");
    out.extend(samples);
    out
}

/// Bytes that this thread has read by system calls, and those that asking took.
fn read_by_thread() -> Option<(u64, u64)> {
    let text = fs::read_to_string("/proc/thread-self/io").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("rchar: "))?;
    Some((line.parse().ok()?, text.len() as u64))
}

/// What the thread had read when the last record was read: later stages ask the system for their CPU time, by reading files.
#[derive(Default)]
struct AfterReading(Mutex<Option<u64>>);

impl PrepareProgress for AfterReading {
    fn begin(&self, stage: Stage, _: Option<u64>) {
        if stage == Stage::Counting {
            *self.0.lock().unwrap() = read_by_thread().map(|(read, _)| read);
        }
    }
    fn advance(&self, _: u64) {}
}

fn size_of(path: &Path) -> u64 {
    if path.is_dir() {
        return fs::read_dir(path).unwrap().map(|e| size_of(&e.unwrap().path())).sum();
    }
    fs::metadata(path).unwrap().len()
}

/// Prepares `source`, whose files are all of `folder`, and compares what was read.
#[track_caller]
fn check(folder: &Path, source: &str, iso: Option<f64>, reads: u32, primitives: Option<u64>) {
    let before = read_by_thread();
    let options = ImportOptions { iso, ..ImportOptions::default() };
    let description = import(&folder.join(source), &options).unwrap();
    let records = DescriptionSource::new(&description, StreamOptions::default());
    let (settings, spool) = (PrepareSettings::default(), SpoolSettings::default());
    let after = AfterReading::default();
    let prepared = prepare(&description, &records, &settings, &spool, &MemoryObjects::new(), &after).unwrap();
    let counts = &prepared.manifest.counts;
    let row = prepared.report.bytes.iter().find(|r| (r.op, r.kind) == (ByteOp::Read, ByteKind::Source)).unwrap();
    assert_eq!(row.bytes, counts.source_bytes);
    if let (Some((first, asked)), Some(last)) = (before, *after.0.lock().unwrap()) {
        assert_eq!(row.bytes, last - first - asked, "{source}: what was counted is not what was read");
    } else {
        println!("{source}: this system does not tell what a thread reads, the count is not compared with it");
    }
    let size = size_of(folder);
    // a scene's meshes too have heads
    let all = if folder.join(source).is_dir() { folder.join(source) } else { folder.to_owned() };
    let files = fs::read_dir(all).unwrap().count();
    assert!(row.bytes <= 2 * size + files as u64 * HEAD, "{source}: {} bytes read of {size}", row.bytes);
    assert!(row.bytes >= u64::from(reads) * (size - size / 8), "{source}: {} bytes read of {size}", row.bytes);
    assert_eq!(counts.source_reads, reads, "{source}");
    if let Some(primitives) = primitives {
        assert_eq!(counts.triangles, primitives, "{source}");
    }
}

/// A file's name and content.
type Named<'a> = (&'a str, &'a [u8]);

fn folder(files: &[Named]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        fs::write(folder.path().join(name), bytes).unwrap();
    }
    folder
}

// one test: what another thread of this process reads is not counted, but a test that shares a thread would be
#[test]
fn each_file_is_read_at_most_twice_and_counted() {
    // starting threads reads what the system says of processors
    rayon::current_num_threads();
    let lights = 4;
    let all = triangles().count() as u64;
    let meshes = [
        ("a.ply", ply(false)),
        ("b.ply", ply(true)),
        ("a.obj", obj()),
        ("a.stl", stl(false)),
        ("b.stl", stl(true)),
        ("c.ply.gz", gz(&ply(true))),
        ("c.obj.gz", gz(&obj())),
    ];
    for (name, bytes) in &meshes {
        check(folder(&[(name, bytes)]).path(), name, None, 2, Some(all + lights));
    }
    let files: Vec<(&str, &[u8])> = meshes.iter().map(|(name, bytes)| (*name, &bytes[..])).collect();
    check(folder(&files).path(), ".", None, 2, Some(7 * all + lights));

    // no mesh here has normals: smooth ones are computed
    let shapes: String = meshes.iter().enumerate().fold(String::new(), |mut text, (i, (name, _))| {
        let kind = name.trim_end_matches(".gz").rsplit('.').next().unwrap();
        write!(text, "<shape type='{kind}'><string name='filename' value='{name}'/>").unwrap();
        writeln!(text, "<transform name='to_world'><translate x='{}'/></transform></shape>", 100 * i).unwrap();
        text
    });
    let part = format!("<scene version='3.0.0'>{shapes}</scene>");
    // a small source whose records are kept is read once; what it is framed by is not kept
    for (sensor, what, reads) in [("", "framed by reading", 2), ("<sensor type='perspective'/>", "not framed", 1)] {
        let scene =
            format!("<scene version='3.0.0'><include filename='part.xml'/><emitter type='constant'/>{sensor}</scene>");
        let mut files = files.clone();
        files.extend([("scene.xml", scene.as_bytes()), ("part.xml", part.as_bytes())]);
        println!("{what}");
        check(folder(&files).path(), "scene.xml", None, reads, Some(7 * all));
    }

    let side = 48;
    let volume = samples(side);
    let head = |more: &str| {
        format!("NRRD0004\ntype: short\ndimension: 3\nsizes: {side} {side} {side}\nendian: little\n{more}\n")
            .into_bytes()
    };
    let raw = [head("encoding: raw\n"), volume.clone()].concat();
    let packed = [head("encoding: gzip\n"), gz(&volume)].concat();
    let apart = head("encoding: raw\ndata file: v.raw\n");
    let nii = nifti(side, &volume);
    let volumes: [(&str, &[Named]); 5] = [
        ("a.nrrd", &[("a.nrrd", &raw)]),
        ("b.nrrd", &[("b.nrrd", &packed)]),
        ("c.nhdr", &[("c.nhdr", &apart), ("v.raw", &volume)]),
        ("d.nii", &[("d.nii", &nii)]),
        ("d.nii.gz", &[("d.nii.gz", &gz(&nii))]),
    ];
    for (name, files) in volumes {
        check(folder(files).path(), name, Some(500.0), 1, None);
    }
    let series = tempfile::tempdir().unwrap();
    for (z, pixels) in volume.chunks(2 * side * side).enumerate() {
        fs::write(series.path().join(format!("{z:03}.dcm")), dicom(z, side, pixels)).unwrap();
    }
    check(series.path(), ".", Some(500.0), 1, None);
    check(series.path(), "007.dcm", Some(500.0), 1, None);
}
