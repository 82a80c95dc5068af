//! Preparing takes memory by splits and grid, not by the scene: a child process prepares volumes of known size and tells its peak.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::Command;

use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::objects::DirectoryObjects;
use rayherd_scene::prepare::{Cut, NoProgress, PrepareSettings, SpoolSettings, prepare};
use rayherd_tests::mutation::peak_memory;
use rayherd_tests::shared;

/// Tells the child what to prepare.
const JOB: &str = "RAYHERD_MEMORY_JOB";
/// Tells it of a scan to prepare instead.
const SCAN: &str = "RAYHERD_MEMORY_SCAN";
/// Value of the scan's surface.
const CHEST: f64 = -789.5;
/// Samples along x and y.
const SIDE: usize = 96;
const BLOCK: u64 = 2 << 20;
const THREADS: u64 = 2;
const MIB: u64 = 1 << 20;

/// What a process takes before anything is prepared, code and threads: some 10 MiB.
const BASE: u64 = 24 * MIB;
/// Bytes of memory per byte of a block and thread: records (as much as the block), what of them is copied for overlap reduction, the
/// builder's arrays (twice the block), the block itself, and room that a growing array or the allocator keeps.
const PER_BLOCK: u64 = 10;

/// A raw volume of a gyroid, 12 samples to a period, and so of surface everywhere: 0.6 triangles per sample.
fn gyroid(path: &Path, depth: usize) {
    let mut out = BufWriter::new(File::create(path).unwrap());
    let head = "NRRD0004\ntype: short\ndimension: 3\nencoding: raw\nendian: little\n";
    write!(out, "{head}sizes: {SIDE} {SIDE} {depth}\n\n").unwrap();
    let wave: Vec<(f64, f64)> = (0..12).map(|i| (i as f64 * std::f64::consts::TAU / 12.0).sin_cos()).collect();
    for z in 0..depth {
        for y in 0..SIDE {
            for x in 0..SIDE {
                let [(sx, cx), (sy, cy), (sz, cz)] = [x, y, z].map(|i| wave[i % 12]);
                // not 0 at samples, and a little different everywhere, so that no triangle is like another
                let value = 1000.0 * (sx * cy + sy * cz + sz * cx) + ((x * 31 + y * 17 + z * 7) % 23) as f64 + 0.5;
                out.write_all(&(value as i16).to_le_bytes()).unwrap();
            }
        }
    }
    out.flush().unwrap();
}

/// The child: the folder in `JOB` holds the volume, and what is prepared goes there.
#[test]
fn child() {
    let Ok(folder) = std::env::var(JOB) else { return };
    let folder = Path::new(&folder);
    let threads = rayon::ThreadPoolBuilder::new().num_threads(THREADS as usize).build().unwrap();
    let spool = SpoolSettings { folder: Some(folder.into()), ..SpoolSettings::default() };
    let (volume, iso, cut, spool) = match std::env::var_os(SCAN) {
        Some(scan) => (scan.into(), CHEST, Cut::Splits(32), spool),
        None => (folder.join("v.nrrd"), 0.25, Cut::BlockSize(BLOCK), SpoolSettings { memory: 4 * MIB, ..spool }),
    };
    let options = ImportOptions { iso: Some(iso), ..ImportOptions::default() };
    let description = import(&volume, &options).unwrap();
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let settings = PrepareSettings { cut, ..PrepareSettings::default() };
    let store = DirectoryObjects::open(folder.join("store")).unwrap();
    let prepared = threads.install(|| prepare(&description, &source, &settings, &spool, &store, &NoProgress)).unwrap();
    let manifest = &prepared.manifest;
    let Some(kib) = peak_memory() else { return println!("no VmHWM") };
    println!(
        "told {} {} {} {}",
        kib << 10,
        manifest.counts.triangles,
        manifest.splits.len(),
        manifest.grid.cells.len()
    );
}

/// Peak, triangles, splits and cells of preparing a gyroid of so many slices; none where the system does not tell.
fn measure(depth: usize) -> Option<[u64; 4]> {
    let folder = tempfile::tempdir().unwrap();
    gyroid(&folder.path().join("v.nrrd"), depth);
    told(folder.path(), None, &format!("{depth} slices"))
}

/// What a child tells that prepares the volume of a folder, or a scan there.
fn told(folder: &Path, scan: Option<&Path>, what: &str) -> Option<[u64; 4]> {
    let mut child = Command::new(std::env::current_exe().unwrap());
    child.args(["child", "--exact", "--nocapture"]).env(JOB, folder).env_remove(SCAN);
    let child = child.envs(scan.map(|scan| (SCAN, scan))).output().unwrap();
    let text = String::from_utf8_lossy(&child.stdout);
    assert!(child.status.success(), "{text}\n{}", String::from_utf8_lossy(&child.stderr));
    let told = text.lines().find_map(|l| l.split("told ").nth(1));
    let Some(told) = told else {
        println!("this system does not tell a process its peak: not tested");
        return None;
    };
    let numbers: Vec<u64> = told.split(' ').map(|n| n.parse().unwrap()).collect();
    println!("{what}: peak {:.1} MiB, {told}", numbers[0] as f64 / MIB as f64);
    Some(numbers.try_into().unwrap())
}

#[test]
fn memory_is_by_splits_and_grid() {
    let Some(small) = measure(64) else { return };
    let Some(large) = measure(512) else { return };
    // records are 52 bytes each, and lie in the temporary file
    assert!(large[1] > 7 * small[1] && 52 * large[1] > 120 * MIB, "{large:?}");
    assert!(large[2] > 50, "{large:?}");
    for [peak, _, splits, cells] in [small, large] {
        // per cell: what is counted of it for each candidate, its box for each split at work, owners and manifest
        let bound = BASE + THREADS * PER_BLOCK * BLOCK + 2048 * cells + 4096 * splits;
        assert!(peak < bound, "{peak} bytes at the peak, expected {bound}");
    }
    let more = large[0].saturating_sub(small[0]);
    assert!(more < 16 * MIB, "eight times the scene takes {more} bytes more");
}

/// A scan of 144 MB, 8.1 million triangles, 32 splits.
#[test]
fn the_chest_scan_takes_less_than_300_mib() {
    let folder = tempfile::tempdir().unwrap();
    let Some(scan) = shared::unpack("ct-lidc-0314", folder.path()) else { return };
    let Some([peak, triangles, splits, _]) = told(folder.path(), Some(&scan.join("dicom")), "the chest scan") else {
        return;
    };
    assert!(triangles > 8_000_000 && splits >= 32, "{triangles} triangles, {splits} splits");
    assert!(peak < 300 * MIB, "{:.1} MiB at the peak", peak as f64 / MIB as f64);
}
