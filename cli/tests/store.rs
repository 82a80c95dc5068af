//! `rayherd render --store`, `--resume` and `rayherd gc` from outside.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{Run, assert_mistake, rayherd, repository};
use serde_json::Value;

fn arguments<'a>(scene: &'a str, spp: &'a str, output: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let start = ["render", scene, "--size", "32x32", "--splits", "3", "--spp", spp, "-o", output];
    [&start[..], more].concat()
}

fn scene() -> String {
    repository("examples/cornell-box.xml").to_str().unwrap().to_owned()
}

fn render(folder: &Path, spp: &str, output: &str, more: &[&str]) -> Run {
    rayherd(folder, &arguments(&scene(), spp, output, more))
}

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    fs::read(folder.join(name)).unwrap()
}

/// Files below a folder.
fn count(folder: &Path) -> usize {
    let Ok(entries) = fs::read_dir(folder) else { return 0 };
    entries.map(|e| e.unwrap().path()).map(|p| if p.is_dir() { count(&p) } else { 1 }).sum()
}

#[test]
fn more_samples_continue_and_equal_the_longer_run() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(render(folder, "9", "long.exr", &[]).code, 0);
    assert_eq!(render(folder, "4", "a.exr", &["--store", "s"]).code, 0);
    assert_mistake(&render(folder, "9", "a.exr", &["--store", "s"]), &["holds a job already", "resume"]);
    let more = render(folder, "9", "a.exr", &["--store", "s", "--resume", "--report", "r.json"]);
    assert_eq!(more.code, 0, "{}", more.err);
    assert!(bytes(folder, "a.exr") == bytes(folder, "long.exr"));
    let report: Value = serde_json::from_slice(&bytes(folder, "r.json")).unwrap();
    assert!(report["tasks_reused"].as_u64() > Some(0), "{report}");
    assert_eq!(report["prepare"]["reused"], true);
    assert_mistake(&render(folder, "4", "a.exr", &["--store", "s", "--resume"]), &["9 samples per pixel", "at least"]);

    // what is collected is not missed
    let before = count(&folder.join("s"));
    let gc = rayherd(folder, &["gc", "s"]);
    assert!(gc.code == 0 && gc.out.starts_with("s: "), "{}{}", gc.out, gc.err);
    assert!(count(&folder.join("s")) <= before);
    let again = render(folder, "9", "b.exr", &["--store", "s", "--resume"]);
    assert_eq!(again.code, 0, "{}", again.err);
    assert!(bytes(folder, "b.exr") == bytes(folder, "long.exr"));
    // an object that belongs to no scene goes
    fs::create_dir_all(folder.join("s/objects/00")).unwrap();
    let stray = folder.join("s/objects/00").join("0".repeat(64));
    fs::write(&stray, "stray").unwrap();
    assert_eq!(rayherd(folder, &["gc", "s"]).code, 0);
    assert!(!stray.exists());
    let last = rayherd(folder, &["gc", "s"]);
    assert!(last.out.contains(": 0 objects deleted, 0 B; "), "{}", last.out);

    assert_mistake(&render(folder, "4", "a.exr", &["--resume"]), &["--store"]);
    assert_mistake(&rayherd(folder, &["gc", "none"]), &["there is no store none"]);
    assert_mistake(&render(folder, "4", "a.exr", &["--store", "a.png/s"]), &["a.png"]);
    assert_mistake(&render(folder, "4", "a.exr", &["--store", "s3://x"]), &["s3://x"]);
}

/// Waits until the store holds some commits of the child, which must still run then.
fn wait_for_commits(folder: &Path, child: &mut Child) {
    let commits = || {
        let jobs = fs::read_dir(folder.join("s/jobs")).ok().into_iter().flatten().flatten();
        jobs.map(|job| count(&job.path().join("records"))).sum::<usize>()
    };
    let begun = Instant::now();
    while commits() < 3 && begun.elapsed() < Duration::from_secs(60) && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(child.try_wait().unwrap().is_none(), "it was done before it could be stopped");
}

#[test]
fn a_signal_ends_a_run_between_commits_and_leaves_no_temporary_folder() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let temporary = folder.join("tmp");
    fs::create_dir(&temporary).unwrap();
    let options = ["--store", "s", "--resume", "--task-seconds", "0.02", "--threads", "1", "--nodes", "2"];
    let scene = scene();
    for (signal, code) in [("-INT", 130), ("-TERM", 143)] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_rayherd"))
            .args(arguments(&scene, "400", "x.exr", &options))
            .current_dir(folder)
            .env("TMPDIR", &temporary)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        wait_for_commits(folder, &mut child);
        let folders = || fs::read_dir(&temporary).unwrap().count();
        let begun = Instant::now();
        while folders() == 0 && begun.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(folders() > 0, "nodes have folders");
        assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), Some(code));
        assert_eq!(folders(), 0);
    }
    let resumed = render(folder, "400", "x.exr", &["--store", "s", "--resume", "--report", "r.json"]);
    assert_eq!(resumed.code, 0, "{}", resumed.err);
    let report: Value = serde_json::from_slice(&bytes(folder, "r.json")).unwrap();
    assert!(report["tasks_reused"].as_u64() >= Some(3), "{report}");
    assert_eq!(render(folder, "400", "whole.exr", &[]).code, 0);
    assert!(bytes(folder, "x.exr") == bytes(folder, "whole.exr"));
}

#[test]
fn a_killed_run_goes_on_and_a_live_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(render(folder, "200", "whole.exr", &[]).code, 0);
    let slow = ["--store", "s", "--task-seconds", "0.02", "--threads", "1"];
    let scene = scene();
    let mut child = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(arguments(&scene, "200", "x.exr", &slow))
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    wait_for_commits(folder, &mut child);
    let refused = render(folder, "200", "x.exr", &["--store", "s", "--resume"]);
    assert_eq!(refused.code, 2, "{}", refused.err);
    assert!(child.try_wait().unwrap().is_none(), "it was done before the second could be refused");
    child.kill().unwrap();
    child.wait().unwrap();

    let resumed = render(folder, "200", "x.exr", &["--store", "s", "--resume", "--report", "r.json"]);
    assert_eq!(resumed.code, 0, "{}", resumed.err);
    assert!(bytes(folder, "x.exr") == bytes(folder, "whole.exr"));
    let report: Value = serde_json::from_slice(&bytes(folder, "r.json")).unwrap();
    assert!(report["tasks_reused"].as_u64() > Some(0), "{report}");
    // previews of the killed run left no half-written file behind the picture's name
    assert!(bytes(folder, "x.png").starts_with(b"\x89PNG"));
}
