//! Millions of triangles per CPU-second of preparing (import included, tree building apart), by kind of source.
//!
//! `prepare [--times N] [PATH[@ISO] ...]` writes one surface of about a million triangles in every format that is read,
//! prepares each with one thread into memory, and then the sources that are named; a volume takes its iso value after
//! `@`. Figures are medians of thread CPU time.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use rayherd_benches::{median, thread_cpu};
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};

/// Quads along each side of the generated surface.
const SIDE: u32 = 708;

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1).peekable();
    let mut times = 5;
    if args.next_if_eq("--times").is_some() {
        times = args.next().context("--times needs a number")?.parse()?;
    }
    let named: Vec<String> = args.collect();
    let folder = tempfile::tempdir()?;
    let mut sources = generate(folder.path())?;
    for name in &named {
        sources.push(match name.rsplit_once('@') {
            Some((path, iso)) => (name.clone(), PathBuf::from(path), Some(iso.parse()?)),
            None => (name.clone(), PathBuf::from(name), None),
        });
    }
    // one thread: its CPU time is the whole, and the tree builder's time on it is CPU time too
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    println!("{:<24} {:>10} {:>9} {:>9} {:>22}", "source", "triangles", "CPU s", "of trees", "M triangles / CPU-s");
    for (name, path, iso) in sources {
        let mut runs = Vec::new();
        for _ in 0..times {
            runs.push(pool.install(|| measure(&path, iso))?);
        }
        let of = |figure: &dyn Fn(&Run) -> f64| median(runs.iter().map(figure).collect());
        println!(
            "{name:<24} {:>10} {:>9.3} {:>9.3} {:>22.2}",
            runs[0].triangles,
            of(&|r| r.cpu),
            of(&|r| r.tree),
            of(&|r| r.triangles as f64 / (r.cpu - r.tree) * 1e-6),
        );
    }
    Ok(())
}

struct Run {
    triangles: u64,
    cpu: f64,
    tree: f64,
}

fn measure(path: &Path, iso: Option<f64>) -> anyhow::Result<Run> {
    let store = MemoryObjects::default();
    let start = thread_cpu();
    let description = import(path, &ImportOptions { iso, ..ImportOptions::default() })?;
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let (settings, spool) = (PrepareSettings::default(), SpoolSettings::default());
    let prepared = prepare(&description, &source, &settings, &spool, &store, &NoProgress)?;
    let cpu = thread_cpu() - start;
    Ok(Run { triangles: prepared.manifest.counts.triangles, cpu, tree: prepared.report.tree_s })
}

/// Writes a wavy sheet in each format: (kind, path, iso value).
fn generate(folder: &Path) -> anyhow::Result<Vec<(String, PathBuf, Option<f64>)>> {
    let n = SIDE + 1;
    let vertex = |i: u32| -> [f32; 3] {
        let [x, y] = [i % n, i / n].map(|k| f64::from(k) / f64::from(SIDE));
        [x as f32, y as f32, (0.05 * libm::sin(25.0 * x) * libm::cos(19.0 * y)) as f32]
    };
    let faces = || {
        (0..SIDE * SIDE).flat_map(move |q| {
            let a = q / SIDE * n + q % SIDE;
            [[a, a + 1, a + n + 1], [a, a + n + 1, a + n]]
        })
    };
    let mut out = Vec::new();
    let mut file = |kind: &str, name: &str, iso: Option<f64>| -> anyhow::Result<BufWriter<File>> {
        let path = folder.join(name);
        out.push((kind.to_owned(), path.clone(), iso));
        Ok(BufWriter::new(File::create(path)?))
    };
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n",
            n * n,
            2 * SIDE * SIDE
        )
    };

    let mut ascii = file("PLY, ascii", "ascii.ply", None)?;
    ascii.write_all(header("ascii").as_bytes())?;
    for [x, y, z] in (0..n * n).map(vertex) {
        writeln!(ascii, "{x} {y} {z}")?;
    }
    for [a, b, c] in faces() {
        writeln!(ascii, "3 {a} {b} {c}")?;
    }
    ascii.flush()?;

    let mut packed = file("PLY, ascii, gzip", "packed.ply.gz", None)?;
    let mut encoder = flate2::write::GzEncoder::new(&mut packed, flate2::Compression::new(6));
    std::io::copy(&mut File::open(folder.join("ascii.ply"))?, &mut encoder)?;
    encoder.finish()?;
    packed.flush()?;

    for (kind, name, little) in [("PLY, little endian", "little.ply", true), ("PLY, big endian", "big.ply", false)] {
        let mut binary = file(kind, name, None)?;
        binary.write_all(header(if little { "binary_little_endian" } else { "binary_big_endian" }).as_bytes())?;
        let put = |x: u32| if little { x.to_le_bytes() } else { x.to_be_bytes() };
        for x in (0..n * n).flat_map(vertex) {
            binary.write_all(&put(x.to_bits()))?;
        }
        for face in faces() {
            binary.write_all(&[3])?;
            for i in face {
                binary.write_all(&put(i))?;
            }
        }
        binary.flush()?;
    }

    let mut obj = file("OBJ", "sheet.obj", None)?;
    for [x, y, z] in (0..n * n).map(vertex) {
        writeln!(obj, "v {x} {y} {z}")?;
    }
    for [a, b, c] in faces() {
        writeln!(obj, "f {} {} {}", a + 1, b + 1, c + 1)?;
    }
    obj.flush()?;

    let mut stl = file("STL, binary", "binary.stl", None)?;
    stl.write_all(&[b' '; 80])?;
    stl.write_all(&(2 * SIDE * SIDE).to_le_bytes())?;
    for face in faces() {
        stl.write_all(&[0; 12])?;
        for x in face.into_iter().flat_map(vertex) {
            stl.write_all(&x.to_le_bytes())?;
        }
        stl.write_all(&[0; 2])?;
    }
    stl.flush()?;

    let mut stl = file("STL, ascii", "ascii.stl", None)?;
    writeln!(stl, "solid sheet")?;
    for face in faces() {
        writeln!(stl, "facet normal 0 0 1\nouter loop")?;
        for [x, y, z] in face.map(vertex) {
            writeln!(stl, "vertex {x} {y} {z}")?;
        }
        writeln!(stl, "endloop\nendfacet")?;
    }
    writeln!(stl, "endsolid sheet")?;
    stl.flush()?;

    // a gyroid: its surface has the density of a scan's
    let side = 160u32;
    let mut values = Vec::new();
    for k in 0..side.pow(3) {
        let [x, y, z] = [k % side, k / side % side, k / side / side].map(|k| f64::from(k) * 0.35);
        let f = libm::sin(x) * libm::cos(y) + libm::sin(y) * libm::cos(z) + libm::sin(z) * libm::cos(x);
        values.extend_from_slice(&((f * 1000.0) as i16).to_le_bytes());
    }
    let header = format!("NRRD0004\ntype: short\ndimension: 3\nsizes: {side} {side} {side}\nendian: little\n");
    let mut nrrd = file("NRRD, raw", "raw.nrrd", Some(100.5))?;
    write!(nrrd, "{header}encoding: raw\n\n")?;
    nrrd.write_all(&values)?;
    nrrd.flush()?;
    let mut nrrd = file("NRRD, gzip", "gzip.nrrd", Some(100.5))?;
    write!(nrrd, "{header}encoding: gzip\n\n")?;
    let mut encoder = flate2::write::GzEncoder::new(&mut nrrd, flate2::Compression::new(6));
    encoder.write_all(&values)?;
    encoder.finish()?;
    nrrd.flush()?;
    ensure!(out.len() == 9, "a format was forgotten");
    Ok(out)
}
