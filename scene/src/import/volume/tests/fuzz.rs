//! Seeded mutations of valid files: any result but a panic, a hang or memory beyond the limits. `RAYHERD_FUZZ_SECONDS` makes
//! each loop that long.

use std::time::{Duration, Instant};

use super::dicom::{BIG, EXPLICIT, IMPLICIT, Image};
use super::nifti::Nifti;
use super::*;
use crate::import::isosurface::IsoSurfaceSource;
use crate::record::RecordSource;

/// splitmix64.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) % n as u64) as usize
    }
}

/// One to four changes: a bit, a byte, a number at an extreme, a piece taken out, doubled or exchanged.
fn mutate(random: &mut Random, valid: &[u8]) -> Vec<u8> {
    let mut bytes = valid.to_vec();
    for _ in 0..1 + random.below(4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.below(bytes.len());
        let end = (at + 1 + random.below(8)).min(bytes.len());
        match random.below(7) {
            0 => bytes[at] ^= 1 << random.below(8),
            1 => bytes[at] = random.below(256) as u8,
            2 => bytes[at..end].fill(0xff),
            3 => bytes[at..end].fill(0),
            4 => drop(bytes.drain(at..end)),
            5 => {
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            _ => bytes.truncate(at),
        }
    }
    bytes
}

fn run(seed: u64, valid: &[Vec<u8>], name: &str) {
    let folder = Folder::new();
    folder.write("1", &[0; 12]);
    let end = std::env::var("RAYHERD_FUZZ_SECONDS")
        .ok()
        .map(|s| Instant::now() + Duration::from_secs_f64(s.parse().expect("RAYHERD_FUZZ_SECONDS is a number")));
    let mut random = Random(seed);
    let (mut rounds, mut opened) = (0, 0);
    while end.map_or(rounds < 2000, |end| Instant::now() < end) {
        let content = mutate(&mut random, &valid[rounds % valid.len()]);
        let path = folder.write(name, &content);
        if let Ok(file) = open(&path) {
            opened += 1;
            let dims = file.volume().dims;
            // a whole pass, unless the slices are so many that gzip would have to be read on and on
            let mut pass = file.slices();
            let mut slice = Vec::new();
            for _ in 0..100 {
                match pass.next(&mut slice) {
                    Ok(true) => assert_eq!(slice.len(), dims[0] * dims[1]),
                    _ => break,
                }
            }
        }
        if let Ok(source) = IsoSurfaceSource::new(&path, 9.5) {
            let mut records = Vec::new();
            let _ = source.open().and_then(|mut s| s.next(&mut records, 10_000));
        }
        rounds += 1;
    }
    // mutations that only ever hit the first check would show nothing
    assert!(opened > rounds / 50 && opened < rounds, "{opened} of {rounds} were opened");
}

#[test]
fn nrrd() {
    let raw: Vec<u8> = (0..24i16).flat_map(i16::to_le_bytes).collect();
    let attached = |encoding: &str, data: &[u8]| {
        let text = format!(
            "NRRD0004\ndimension: 3\ntype: short\nsizes: 3 2 4\nspace: RAS\nspace directions: (1,0,0) (0,1,0) (0,0,2)\n\
             endian: little\nencoding: {encoding}\n\n"
        );
        [text.as_bytes(), data].concat()
    };
    let list = "NRRD0004\ndimension: 3\ntype: short\nsizes: 3 2 1\nspacings: 1 2 3\nencoding: raw\nendian: big\nbyte skip: -1\n\
                data file: %d 1 1 1\n";
    run(1, &[attached("raw", &raw), attached("gzip", &gzip(&raw)), list.into()], "f.nrrd");
}

#[test]
fn nifti() {
    let files: Vec<Vec<u8>> = [(false, false), (false, true), (true, false), (true, true)]
        .into_iter()
        .map(|(second, big)| Nifti::new(second, big, 4).shorts())
        .collect();
    run(2, &[files[0].clone(), files[1].clone(), files[2].clone(), files[3].clone(), gzip(&files[0])], "f.nii");
}

#[test]
fn dicom() {
    let image = |syntax| Image::new(syntax, 1.0, [0, 5, 10, 15, 20, 25]).bytes();
    run(3, &[image(IMPLICIT), image(EXPLICIT), image(BIG)], "f.dcm");
}
