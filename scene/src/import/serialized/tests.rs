use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use rayherd_tests::mutation;

use super::*;
use crate::description::MeshFormat;
use crate::import::tests::{folder, mesh_shape, records, write};
use crate::record::Record;

/// One mesh: a square of two triangles at z, with what the flags say, and colours that are passed over.
fn mesh(version: u16, flags: u32, z: f64, indices: &[u32]) -> Vec<u8> {
    let mut body = flags.to_le_bytes().to_vec();
    if version == 4 {
        body.extend(b"square\0");
    }
    body.extend(4u64.to_le_bytes());
    body.extend((indices.len() as u64 / 3).to_le_bytes());
    let mut number = |x: f64| {
        if flags & DOUBLE != 0 { body.extend(x.to_le_bytes()) } else { body.extend((x as f32).to_le_bytes()) }
    };
    let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
    corners.iter().for_each(|[x, y]| [*x, *y, z].into_iter().for_each(&mut number));
    if flags & HAS_NORMALS != 0 {
        corners.iter().for_each(|_| [0.0, 0.6, 0.8].into_iter().for_each(&mut number));
    }
    if flags & HAS_UV != 0 {
        corners.iter().for_each(|c| c.iter().copied().for_each(&mut number));
    }
    if flags & HAS_COLORS != 0 {
        corners.iter().for_each(|_| [9.0; 3].into_iter().for_each(&mut number));
    }
    indices.iter().for_each(|i| body.extend(i.to_le_bytes()));
    let mut out = [MAGIC.to_le_bytes(), version.to_le_bytes()].concat();
    let mut encoder = ZlibEncoder::new(&mut out, Compression::default());
    encoder.write_all(&body).unwrap();
    encoder.finish().unwrap();
    out
}

const SQUARE: [u32; 6] = [0, 1, 2, 1, 3, 2];

/// Several meshes and the list of their places.
fn file(version: u16, meshes: &[Vec<u8>]) -> Vec<u8> {
    let mut out = meshes.concat();
    let mut at = 0u64;
    for mesh in meshes {
        match version {
            4 => out.extend(at.to_le_bytes()),
            _ => out.extend((at as u32).to_le_bytes()),
        }
        at += mesh.len() as u64;
    }
    out.extend((meshes.len() as u32).to_le_bytes());
    out
}

fn read(bytes: &[u8], index: u32) -> Result<Vec<Record>, ImportError> {
    let dir = folder();
    let path = write(&dir, "a.serialized", bytes);
    records(&mesh_shape(&path, MeshFormat::Serialized(index), true))
}

#[test]
fn every_kind_of_mesh() {
    for version in [3, 4] {
        for (flags, normals, uv) in [
            (SINGLE, false, false),
            (SINGLE | HAS_NORMALS, true, false),
            (DOUBLE | HAS_UV | HAS_COLORS, false, true),
            (DOUBLE | HAS_NORMALS | HAS_UV | HAS_COLORS, true, true),
            (SINGLE | HAS_NORMALS | FACE_NORMALS, false, false),
        ] {
            let bytes = file(version, &[mesh(version, flags, 0.25, &SQUARE), mesh(version, flags, 0.5, &SQUARE[..3])]);
            for (index, count, z) in [(0, 2, 0.25), (1, 1, 0.5)] {
                let records = read(&bytes, index).unwrap();
                assert_eq!(records.len(), count);
                let Record::Triangle(t) = &records[0] else { panic!("no triangle") };
                assert_eq!(t.p, [[0.0, 0.0, z], [1.0, 0.0, z], [0.0, 1.0, z]]);
                assert_eq!(t.uv, uv.then_some([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]));
                // without normals, and not told to have none, they are computed
                let expected = if normals { Some([0.0, 0.6, 0.8]) } else { Some([0.0, 0.0, 1.0]) };
                let expected = expected.filter(|_| flags & FACE_NORMALS == 0);
                let found = t.n.map(|n| n[0]);
                let close = |a: [f32; 3], b: [f32; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-6);
                assert!(found.is_some() == expected.is_some(), "{flags:#x}");
                assert!(found.zip(expected).is_none_or(|(a, b)| close(a, b)), "{found:?} {expected:?}");
            }
        }
    }
}

#[test]
fn broken_files_are_refused_with_a_reason() {
    let good = mesh(4, SINGLE, 0.0, &SQUARE);
    let error = |bytes: &[u8], index| read(bytes, index).unwrap_err().to_string();
    assert!(error(b"solid", 0).contains("does not begin with 0x041c"));
    let mut version = good.clone();
    version[2] = 7;
    assert!(error(&version, 0).contains("version 7"));
    assert!(error(&mesh(4, 0, 0.0, &SQUARE), 0).contains("neither single nor double"));
    assert!(error(&mesh(4, SINGLE, 0.0, &[0, 1, 4]), 0).contains("triangle 0: vertex 4 of 4"));
    assert!(error(&file(4, std::slice::from_ref(&good)), 1).contains("shape_index 1, but the file has 1 meshes"));
    assert!(error(&good[..good.len() / 2], 0).contains("a.serialized"));
    let mut list = file(4, &[good.clone(), good.clone()]);
    let at = list.len() - 12;
    list[at..at + 8].fill(0xff);
    assert!(error(&list, 1).contains("beyond the end"));
    // counts that no memory is taken for
    let mut body = SINGLE.to_le_bytes().to_vec();
    body.extend(b"\0");
    body.extend((1u64 << 40).to_le_bytes());
    body.extend(1u64.to_le_bytes());
    let mut out = [MAGIC.to_le_bytes(), 4u16.to_le_bytes()].concat();
    let mut encoder = ZlibEncoder::new(&mut out, Compression::default());
    encoder.write_all(&body).unwrap();
    encoder.finish().unwrap();
    assert!(error(&out, 0).contains("more than the file can hold"));
}

#[test]
fn damaged_files_end_in_records_or_an_error() {
    let bytes = file(4, &[mesh(4, SINGLE | HAS_NORMALS, 0.0, &SQUARE), mesh(4, DOUBLE, 0.0, &SQUARE)]);
    mutation::rounds("serialized", 500, |random| {
        let damaged = mutation::bytes(&bytes, random);
        for index in [0, 1] {
            if let Ok(records) = read(&damaged, index) {
                assert!(records.len() < 10_000);
            }
        }
    });
}
