//! `rayherd render --store`, `--resume` and `rayherd gc` from outside.

mod common;

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{Run, assert_mistake, rayherd, repository};
use rayherd_herd::wire::envelope::{Kind, open};
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
    // and what a writer that was killed left
    let half = folder.join("s/objects/00/.writing-a");
    fs::write(&half, "half").unwrap();
    assert_eq!(rayherd(folder, &["gc", "s"]).code, 0);
    assert!(!stray.exists() && !half.exists());
    let last = rayherd(folder, &["gc", "s"]);
    assert!(last.out.contains(": 0 objects deleted, 0 B; "), "{}", last.out);

    assert_mistake(&render(folder, "4", "a.exr", &["--resume"]), &["--store"]);
    assert_mistake(&rayherd(folder, &["gc", "none"]), &["there is no store none"]);
    assert_mistake(&render(folder, "4", "a.exr", &["--store", "a.png/s"]), &["a.png"]);
    assert_mistake(&render(folder, "4", "a.exr", &["--store", "s3://x"]), &["s3://x"]);
}

#[test]
fn what_was_begun_otherwise_is_not_begun_anew_without_a_word() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = fs::read_to_string(scene()).unwrap();
    fs::write(folder.join("box.xml"), &scene).unwrap();
    let run = |spp: &str, more: &[&str]| rayherd(folder, &arguments("box.xml", spp, "a.exr", more));
    let kept = ["--store", "s", "--resume"];
    // there is nothing yet: it begins
    let begun = run("2", &kept);
    assert!(begun.code == 0 && begun.err.contains("no job of this scene to go on with: it is begun"), "{}", begun.err);
    // another cut of the same scene goes on with it
    let strategy = run("3", &[&kept[..], &["--strategy", "scheduling-grid", "--report", "r.json"]].concat());
    assert_eq!(strategy.code, 0, "{}", strategy.err);
    let report: Value = serde_json::from_slice(&bytes(folder, "r.json")).unwrap();
    assert!(report["tasks_reused"].as_u64() > Some(0), "{report}");

    let seed = run("3", &[&kept[..], &["--seed", "5"]].concat());
    assert_mistake(&seed, &["no job of this picture", "box.xml", "seed (0, not 5)", "--store"]);
    let changed = scene.replacen("0.885809", "0.5", 1);
    assert_ne!(changed, scene);
    fs::write(folder.join("box.xml"), changed).unwrap();
    assert_mistake(&run("3", &kept), &["content", "--resume", "--store"]);
    // that is how
    assert_eq!(run("3", &["--store", "s"]).code, 0);
    assert_eq!(run("4", &kept).code, 0);
}

/// Files below a folder, by path.
fn files(folder: &Path) -> Vec<std::path::PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    entries.flat_map(|p| if p.is_dir() { files(&p) } else { vec![p] }).collect()
}

#[test]
fn a_corrupt_object_of_the_scene_is_named_or_made_again_and_never_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    assert_eq!(render(folder, "1", "a.exr", &["--store", "s"]).code, 0);
    let (mut named, mut rebuilt) = (0, 0);
    for (number, path) in files(&folder.join("s/objects")).into_iter().enumerate() {
        let whole = fs::read(&path).unwrap();
        let cut = number % 3 == 2;
        let mut broken = whole.clone();
        if cut {
            broken.truncate(whole.len() / 2);
        } else {
            broken[whole.len() / 2] ^= 4;
        }
        fs::write(&path, &broken).unwrap();
        // another seed each time: nothing of the picture is there yet
        let seed = (1 + number).to_string();
        assert_eq!(render(folder, "1", "fresh.exr", &["--seed", &seed]).code, 0);
        let _ = fs::remove_file(folder.join("kept.exr"));
        let mut made = render(folder, "1", "kept.exr", &["--store", "s", "--seed", &seed]);
        if made.code != 0 {
            let hash = path.file_name().unwrap().to_str().unwrap();
            assert_mistake(&made, &[hash, "corrupt", "delete it"]);
            assert!(!folder.join("kept.exr").exists());
            named += 1;
            // what the message says helps
            fs::remove_file(&path).unwrap();
            made = render(folder, "1", "kept.exr", &["--store", "s", "--seed", &seed]);
        } else {
            rebuilt += 1;
        }
        assert_eq!(made.code, 0, "{}: {}", path.display(), made.err);
        assert!(bytes(folder, "kept.exr") == bytes(folder, "fresh.exr"), "{}", path.display());
        assert!(fs::read(&path).unwrap() == whole, "{}", path.display());
    }
    assert!(named > 0 && rebuilt > 0, "{named} named, {rebuilt} made again");
}

#[test]
fn another_size_of_a_prepared_scene_is_not_prepared_again() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = scene();
    let run = |size: &str, output: &str, more: &[&str]| {
        let run = ["render", &scene, "--size", size, "--spp", "2", "-o", output];
        let run = rayherd(folder, &[&run[..], more].concat());
        assert_eq!(run.code, 0, "{}", run.err);
    };
    for size in ["24x16", "16x24"] {
        run(size, "kept.exr", &["--store", "s", "--report", "r.json"]);
        run(size, "fresh.exr", &[]);
        assert!(bytes(folder, "kept.exr") == bytes(folder, "fresh.exr"), "{size}");
        let report: Value = serde_json::from_slice(&bytes(folder, "r.json")).unwrap();
        assert_eq!(report["prepare"]["reused"], size != "24x16", "{report}");
    }
}

fn report(folder: &Path) -> Value {
    serde_json::from_slice(&bytes(folder, "r.json")).unwrap()
}

/// Tasks that are committed in the store, which one writer after the other wrote to: a record is a commit, or the whole state and how many
/// commits led to it.
fn committed(folder: &Path) -> u64 {
    let mut records = files(&folder.join("s/jobs"));
    records.retain(|path| path.parent().is_some_and(|folder| folder.ends_with("records")));
    records.sort();
    records.iter().fold(0, |commits, path| {
        let json = open(Kind::RoundRecord, &fs::read(path).unwrap(), 1 << 30).unwrap();
        let record: Value = serde_json::from_slice(&json).unwrap();
        record["snapshot"]["commits"].as_u64().unwrap_or(commits + 1)
    })
}

/// Whether a report says that so many tasks were taken over, and that none of what they made was lost.
fn assert_reused(report: &Value, committed: u64) {
    let found = ["tasks_reused", "tasks_redone"].map(|key| report[key].as_u64());
    assert_eq!(found, [Some(committed), Some(0)], "{report}");
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
    let held = committed(folder);
    assert!(held >= 3, "{held}");
    let resumed = render(folder, "400", "x.exr", &["--store", "s", "--resume", "--report", "r.json"]);
    assert_eq!(resumed.code, 0, "{}", resumed.err);
    assert_reused(&report(folder), held);
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
    assert_mistake(&refused, &["s/", &format!("process {} writes to it", child.id()), "wait for it", "--takeover"]);
    assert!(child.try_wait().unwrap().is_none(), "it was done before the second could be refused");
    child.kill().unwrap();
    child.wait().unwrap();
    let held = committed(folder);
    assert!(held >= 3, "{held}");

    let resumed = render(folder, "200", "x.exr", &["--store", "s", "--resume", "--report", "r.json"]);
    assert_eq!(resumed.code, 0, "{}", resumed.err);
    assert!(bytes(folder, "x.exr") == bytes(folder, "whole.exr"));
    assert_reused(&report(folder), held);
    // previews of the killed run left no half-written file behind the picture's name
    assert!(bytes(folder, "x.png").starts_with(b"\x89PNG"));
}

#[test]
fn a_live_writer_that_is_taken_over_ends() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // more samples than anybody waits for
    let slow = ["--store", "s", "--task-seconds", "0.02", "--threads", "1"];
    let (scene, spp) = (scene(), "1000000");
    let mut child = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(arguments(&scene, spp, "old.exr", &slow))
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    wait_for_commits(folder, &mut child);
    // `--takeover` alone would begin anew, which is refused before anybody is harmed
    let anew = render(folder, spp, "new.exr", &["--store", "s", "--takeover"]);
    assert_mistake(&anew, &["holds a job already", "resume"]);
    assert!(child.try_wait().unwrap().is_none());
    let taken = ["--store", "s", "--resume", "--takeover", "--time-limit", "0.1", "--report", "r.json"];
    let taken = render(folder, spp, "new.exr", &taken);
    assert_eq!(taken.code, 0, "{}", taken.err);
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() && begun.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    // a child that has ended is not killed
    let _ = child.kill();
    let code = child.wait().unwrap().code();
    let mut told = String::new();
    child.stderr.take().unwrap().read_to_string(&mut told).unwrap();
    assert_eq!(code, Some(2), "{told}");
    assert!(told.contains("error: ") && told.contains("was taken over by"), "{told}");
    assert!(!folder.join("old.exr").exists());
    // what the new writer made stands on what the old one had committed, and is what one run makes
    let report = report(folder);
    assert!(report["tasks_reused"].as_u64() >= Some(3), "{report}");
    let spp = report["spp"].to_string();
    assert_eq!(render(folder, &spp, "whole.exr", &[]).code, 0);
    assert!(bytes(folder, "new.exr") == bytes(folder, "whole.exr"), "{spp} samples");
}

/// A run that stops by itself is gone on with as one that was told its samples.
#[test]
fn what_stopped_by_error_or_time_is_continued() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for (store, limit) in [("e", ["--target-error", "0.2"]), ("t", ["--time-limit", "0.05"])] {
        let kept = ["--store", store, "--resume", "--report", "r.json", "--task-seconds", "0.02"];
        let run = |spp: &str, more: &[&str]| {
            let run = render(folder, spp, "a.exr", &[&kept[..], more].concat());
            assert_eq!(run.code, 0, "{limit:?}: {}", run.err);
            report(folder)
        };
        let straight = |spp: &str| {
            assert_eq!(render(folder, spp, "straight.exr", &[]).code, 0);
            bytes(folder, "straight.exr")
        };
        let stopped = run("100000", &limit);
        let spp = stopped["spp"].as_u64().unwrap();
        assert!(spp < 100_000, "{limit:?}: it did not stop");
        assert_eq!(stopped["target_reached"].as_bool(), (store == "e").then_some(true), "{stopped}");
        assert!(bytes(folder, "a.exr") == straight(&spp.to_string()), "{limit:?} at {spp}");
        // it stopped again at once: there is no reason to go on
        if store == "e" {
            assert_eq!(run("100000", &limit)["spp"], spp);
        }
        // an end that is no step's
        let more = (spp + spp / 2 + 1).to_string();
        let made = run(&more, &[]);
        assert_eq!(made["tasks_reused"], stopped["tasks"], "{limit:?}");
        assert!(bytes(folder, "a.exr") == straight(&more), "{limit:?} from {spp} to {more}");
        // and onwards from there, to where the limit stops it
        let further = run("100000", &limit)["spp"].as_u64().unwrap();
        assert!(further > spp && bytes(folder, "a.exr") == straight(&further.to_string()), "{limit:?} to {further}");
    }
}
