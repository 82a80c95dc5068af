//! A film is filled, added up and made a picture of in memory of a band, not of the film: a child process does so and tells its peak.

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::Path;
use std::process::Command;

use rayherd_herd::job::{Image, JobError};
use rayherd_herd::ledger::FilmRef;
use rayherd_herd::picture;
use rayherd_herd::remote::bands::{Adder, BAND, count};
use rayherd_render::film::BoundedFilm;
use rayherd_tests::mutation::peak_memory;
use serde_json::{Map, Value};

/// Tells the child where to work.
const JOB: &str = "RAYHERD_FILM_MEMORY_JOB";
const SIZE: [u32; 2] = [2500, 2000];
/// Each adds a sample to a part of the rows; neighbours share some.
const TASKS: u32 = 6;
/// Tiles that a task holds as sums.
const MOST: usize = 256;
const MIB: u64 = 1 << 20;

/// What a process takes before anything is rendered, code and threads: some 10 MiB.
const BASE: u64 = 24 * MIB;
/// Bytes of a pixel's sums.
const SUMS: u64 = 96;
/// Bytes of a pixel that is packed, at most: bitmap, headers and values here.
const PACKED: u64 = 32;

fn rows(task: u32) -> std::ops::Range<u32> {
    let of = SIZE[1] / TASKS;
    (task * of).saturating_sub(70)..if task + 1 == TASKS { SIZE[1] } else { (task + 1) * of }
}

fn value(pixel: u32) -> [f32; 3] {
    [0.25 * (pixel % 251) as f32, 0.5 * (pixel % 17) as f32, 1.0 + (pixel % 5) as f32]
}

fn definition() -> Map<String, Value> {
    Map::from_iter([("spp".to_owned(), Value::from(2))])
}

/// The child.
#[test]
fn child() {
    let Ok(folder) = std::env::var(JOB) else { return };
    let folder = Path::new(&folder);
    let mut parts = Vec::new();
    for task in 0..TASKS {
        let mut film = BoundedFilm::new(SIZE, MOST);
        for y in rows(task) {
            film.add_all((y * SIZE[0]..(y + 1) * SIZE[0]).map(|pixel| (pixel, task & 1, value(pixel))));
        }
        film.into_bands(BAND, |band, bytes| {
            let key = format!("{task}-{band}");
            fs::write(folder.join(&key), &bytes).unwrap();
            parts.push(FilmRef { key, band: Some(band), bytes: bytes.len() as u64, holders: vec![0] });
            Ok::<(), JobError>(())
        })
        .unwrap();
    }
    assert_eq!(count(SIZE, BAND), 10);
    let read = |part: &FilmRef| Ok(fs::read(folder.join(&part.key)).unwrap());
    let adder = Adder { size: SIZE, band: BAND, read: &read };
    let out = BufWriter::new(File::create(folder.join("picture.exr")).unwrap());
    let totals = adder.picture(&parts, 2, &definition(), out).unwrap();
    assert!(totals.error.is_some_and(|e| e.mean(SIZE) > 0.0));
    println!("peak {}", peak_memory().map_or(0, |kib| kib << 10));
}

#[test]
fn a_picture_takes_memory_by_bands() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = Command::new(std::env::current_exe().unwrap());
    let child = child.args(["--exact", "child", "--nocapture"]).env(JOB, folder.path()).output().unwrap();
    let said = String::from_utf8_lossy(&child.stdout);
    assert!(child.status.success(), "{said}{}", String::from_utf8_lossy(&child.stderr));
    let told = said.lines().find_map(|l| l.split_once("peak ")?.1.trim().parse::<u64>().ok()).unwrap();
    // the sums of a task and of a band, what a task has packed, and a band packed three times: read, written, in a buffer that grows
    let task = u64::from(rows(1).end - rows(1).start) * u64::from(SIZE[0]) * PACKED;
    let band = u64::from(BAND) * 1024;
    let most = BASE + (MOST as u64 * 1024 + band) * SUMS + task + 3 * band * PACKED;
    let whole = u64::from(SIZE[0]) * u64::from(SIZE[1]) * SUMS;
    println!("peak {} MiB, {} allowed, the whole film {}", told / MIB, most / MIB, whole / MIB);
    assert!(most < whole / 2);
    assert!(told == 0 || told < most, "{} MiB where {} are allowed", told / MIB, most / MIB);
    // and it is the picture of the whole film
    let samples = |y: u32| (0..TASKS).filter(|t| rows(*t).contains(&y)).count() as f32;
    let pixel = |i: u32| value(i).map(|v| v * samples(i / SIZE[0]) / 2.0);
    let pixels = (0..SIZE[0] * SIZE[1]).map(pixel).collect();
    let plain = picture::encode(&Image { width: SIZE[0], height: SIZE[1], pixels }, &definition()).unwrap();
    assert!(fs::read(folder.path().join("picture.exr")).unwrap() == plain);
}
