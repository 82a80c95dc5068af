//! Seeded mutations of valid files: any result but a panic, a hang or memory beyond the limits.

use rayherd_tests::mutation;

use super::dicom::{BIG, EXPLICIT, IMPLICIT, Image};
use super::nifti::Nifti;
use super::*;
use crate::import::isosurface::IsoSurfaceSource;
use crate::record::RecordSource;

fn run(valid: &[Vec<u8>], name: &str) {
    let folder = Folder::new();
    folder.write("1", &[0; 12]);
    let mut opened = 0;
    let rounds = mutation::rounds(name, 2000, |random| {
        let content = mutation::bytes(&valid[random.below(valid.len())], random);
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
    });
    // mutations that only ever hit the first check would show nothing
    assert!(rounds.is_none_or(|n| opened > n / 50 && opened < n), "{opened} of {rounds:?} were opened");
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
    run(&[attached("raw", &raw), attached("gzip", &gzip(&raw)), list.into()], "f.nrrd");
}

#[test]
fn nifti() {
    let files: Vec<Vec<u8>> = [(false, false), (false, true), (true, false), (true, true)]
        .into_iter()
        .map(|(second, big)| Nifti::new(second, big, 4).shorts())
        .collect();
    run(&[files[0].clone(), files[1].clone(), files[2].clone(), files[3].clone(), gzip(&files[0])], "f.nii");
}

#[test]
fn dicom() {
    let image = |syntax| Image::new(syntax, 1.0, [0, 5, 10, 15, 20, 25]).bytes();
    run(&[image(IMPLICIT), image(EXPLICIT), image(BIG)], "f.dcm");
}
