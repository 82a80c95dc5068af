//! `rayherd render --no-skip` from outside.

mod common;

use std::fs;
use std::path::Path;

use common::{assert_mistake, rayherd, repository};
use rayherd_render::skip::Skip;
use serde_json::Value;

/// Renders; the picture's bytes and the report.
fn render(folder: &Path, scene: &str, more: &[&str]) -> (Vec<u8>, Value) {
    let start = ["render", scene, "--size", "24x16", "--spp", "4", "-o", "x.exr", "--report", "r.json"];
    let run = rayherd(folder, &[&start[..], more].concat());
    assert_eq!(run.code, 0, "{more:?}: {}", run.err);
    let report = fs::read(folder.join("r.json")).unwrap();
    (fs::read(folder.join("x.exr")).unwrap(), serde_json::from_slice(&report).unwrap())
}

/// A ball of some 20 samples across in 32^3.
fn volume(folder: &Path) {
    let header = "NRRD0004\ndimension: 3\nsizes: 32 32 32\ntype: uchar\nencoding: raw\n\n";
    let value = |i: u32| {
        let [x, y, z] = [i % 32, i / 32 % 32, i / 1024].map(|k| f64::from(k) - 15.5);
        (200.0 - 10.0 * (x * x + y * y + z * z).sqrt()).max(0.0) as u8
    };
    fs::write(folder.join("ball.nrrd"), [header.as_bytes(), &(0..32768).map(value).collect::<Vec<u8>>()].concat())
        .unwrap();
}

#[test]
fn cells_of_a_volume_without_surface_are_passed_by() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    volume(folder);
    let (usual, report) = render(folder, "ball.nrrd", &["--iso", "100"]);
    let (other, all) = render(folder, "ball.nrrd", &["--iso", "100", "--no-skip", "volume"]);
    assert!(usual == other);
    // 31^3 cells, of which the surface of a ball of radius 10 crosses some 2,000
    let passed = report["skips"]["volume"].as_u64().unwrap();
    assert!(passed > 27_000 && passed < 31 * 31 * 31, "{passed}");
    assert_eq!(all["skips"]["volume"], 0);
}

#[test]
fn what_is_prepared_is_prepared_again_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = repository("examples/cornell-box.xml");
    let scene = scene.to_str().unwrap();
    let (first, report) = render(folder, scene, &["--store", "s"]);
    assert_eq!((&report["skips"]["prepared"], &report["prepare"]["reused"]), (&Value::from(0), &Value::from(false)));
    let (second, report) = render(folder, scene, &["--store", "s", "--resume"]);
    // world, geometry, attributes
    assert_eq!((&report["skips"]["prepared"], &report["prepare"]["reused"]), (&Value::from(3), &Value::from(true)));
    let (third, report) = render(folder, scene, &["--store", "s", "--resume", "--no-skip", "prepared"]);
    assert_eq!((&report["skips"]["prepared"], &report["prepare"]["reused"]), (&Value::from(0), &Value::from(false)));
    assert!(first == second && second == third);
}

#[test]
fn everything_is_done_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = repository("examples/cornell-box.xml");
    let scene = scene.to_str().unwrap();
    let many =
        ["--splits", "5", "--nodes", "2", "--strategy", "scheduling-grid-overlap-reduced", "--task-seconds", "0.05"];
    // without roulette, which is part of what is rendered
    render(folder, scene, &[&many[..], &["--rr-depth", "65535"]].concat());
    fs::rename(folder.join("x.exr"), folder.join("usual.exr")).unwrap();
    let (_, report) = render(folder, scene, &[&many[..], &["--no-skip", "all"]].concat());
    for skip in Skip::ALL {
        assert_eq!(report["skips"][skip.name()], 0, "{}", skip.name());
    }
    // its header says that no light was left out; the picture is the same, as its two are chosen without a tree
    let compared = rayherd(folder, &["compare", "usual.exr", "x.exr"]);
    let compared: Value = serde_json::from_str(&compared.out).unwrap();
    assert_eq!(compared["identical"], true, "{compared}");
}

#[test]
fn a_name_that_is_none_lists_those_that_are() {
    let folder = tempfile::tempdir().unwrap();
    let run = rayherd(folder.path(), &["render", "x.xml", "--no-skip", "shadow"]);
    let names: Vec<&str> = Skip::ALL.iter().map(|s| s.name()).collect();
    assert_mistake(&run, &[&["shadow", "--no-skip"], &names[..]].concat());
}

/// The table of the documentation has a row for each.
#[test]
fn every_skip_is_documented() {
    let text = fs::read_to_string(repository("docs/skips.md")).unwrap();
    let rows = text.lines().filter_map(|l| l.strip_prefix("| `")?.split('`').next());
    let mut rows: Vec<&str> = rows.collect();
    let mut names = Skip::ALL.map(Skip::name).to_vec();
    rows.sort_unstable();
    names.sort_unstable();
    assert_eq!(rows, names);
}
