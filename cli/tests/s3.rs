//! The store in S3 from outside: prepare, render, resume and gc against a server in this process.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{Run, assert_mistake, repository};
use rayherd_herd::store::s3_server::{BUCKET, S3Faults, S3Server};
use serde_json::Value;
use tokio::runtime::Runtime;

/// A server on its own threads.
struct Server {
    server: S3Server,
    // after the server, which it runs
    _runtime: Runtime,
}

impl Server {
    fn start() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let server = runtime.block_on(S3Server::start());
        Server { server, _runtime: runtime }
    }

    fn command(&self, folder: &Path, arguments: &[&str]) -> Command {
        let settings = self.server.settings("");
        let mut command = Command::new(env!("CARGO_BIN_EXE_rayherd"));
        command.args(arguments).args(["--s3-endpoint", settings.endpoint.as_deref().unwrap()]);
        command.current_dir(folder).env_remove("RUST_LOG").env_remove("RUST_BACKTRACE");
        command.env("AWS_ACCESS_KEY_ID", settings.credentials.access_key);
        command.env("AWS_SECRET_ACCESS_KEY", settings.credentials.secret_key);
        command
    }

    fn run(&self, folder: &Path, arguments: &[&str]) -> Run {
        finish(self.command(folder, arguments).output().unwrap())
    }

    fn spawn(&self, folder: &Path, arguments: &[&str]) -> Child {
        self.command(folder, arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    }
}

fn finish(output: std::process::Output) -> Run {
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Run { code: output.status.code().unwrap(), out: text(output.stdout), err: text(output.stderr), peak: None }
}

fn scene() -> String {
    repository("examples/cornell-box.xml").to_str().unwrap().to_owned()
}

fn render<'a>(scene: &'a str, spp: &'a str, output: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let start = ["render", scene, "--size", "32x32", "--splits", "3", "--spp", spp, "-o", output];
    [&start[..], more].concat()
}

fn report(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join("r.json")).unwrap()).unwrap()
}

/// Prepares, renders over a network that `worse` makes bad, adds samples, collects, and goes on.
fn serves_as_a_folder_does(store: &str, run: &dyn Fn(&Path, &[&str]) -> Run, worse: &dyn Fn(bool)) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = scene();
    assert_eq!(common::rayherd(folder, &render(&scene, "9", "long.exr", &[])).code, 0);

    let prepare = ["prepare", &scene, "--size", "32x32", "--splits", "3", "--store", store];
    let first = run(folder, &prepare);
    assert_eq!(first.code, 0, "{}", first.err);
    assert!(first.out.contains("is prepared: 36 primitives"), "{}", first.out);
    let again = run(folder, &prepare);
    assert!(again.out.contains("nothing to do"), "{}{}", again.out, again.err);
    let shown = run(folder, &["inspect", store]);
    assert!(shown.code == 0 && shown.out.contains("36 triangles"), "{}{}", shown.out, shown.err);

    worse(true);
    let part = run(folder, &render(&scene, "4", "a.exr", &["--store", store, "--report", "r.json"]));
    assert_eq!(part.code, 0, "{}", part.err);
    assert_eq!(report(folder)["prepare"]["reused"], true);
    worse(false);
    assert_mistake(
        &run(folder, &render(&scene, "9", "a.exr", &["--store", store])),
        &["holds a job already", "resume"],
    );
    let more = run(folder, &render(&scene, "9", "a.exr", &["--store", store, "--resume", "--report", "r.json"]));
    assert_eq!(more.code, 0, "{}", more.err);
    assert!(report(folder)["tasks_reused"].as_u64() > Some(0));
    assert!(fs::read(folder.join("a.exr")).unwrap() == fs::read(folder.join("long.exr")).unwrap());

    let gc = run(folder, &["gc", store]);
    assert!(gc.code == 0 && gc.out.starts_with(store), "{}{}", gc.out, gc.err);
    let gc = run(folder, &["gc", store]);
    assert!(gc.out.contains(": 0 objects deleted, 0 B; "), "{}{}", gc.out, gc.err);
    let last = run(folder, &render(&scene, "9", "b.exr", &["--store", store, "--resume"]));
    assert_eq!(last.code, 0, "{}", last.err);
    assert!(fs::read(folder.join("b.exr")).unwrap() == fs::read(folder.join("long.exr")).unwrap());
}

#[test]
fn a_bucket_serves_as_a_folder_does() {
    let server = Server::start();
    let store = format!("s3://{BUCKET}/scenes/one");
    let worse = |bad: bool| {
        let some =
            S3Faults { seed: 5, unavailable: 40, starting: 20, lost_reply: 20, cut_body: 20, latency: Duration::ZERO };
        server.server.set_faults(if bad { some } else { S3Faults::default() });
    };
    serves_as_a_folder_does(&store, &|folder, arguments| server.run(folder, arguments), &worse);
    assert!(server.server.requests().1 > 0, "no fault was met");
    // an object that belongs to no scene goes
    let folder = tempfile::tempdir().unwrap();
    server.server.put_raw(&format!("scenes/one/objects/00/{}", "0".repeat(64)), b"stray");
    let gc = server.run(folder.path(), &["gc", &store]);
    assert!(gc.code == 0 && !gc.out.contains(": 0 objects deleted"), "{}{}", gc.out, gc.err);
}

/// A memory of one split of three: each is read again and again, over the network or from the cache; the file is the same.
#[test]
fn what_memory_drops_is_fetched_once_with_a_cache() {
    let server = Server::start();
    let (store, scene) = (format!("s3://{BUCKET}/cached"), scene());
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let small = ["--nodes", "1", "--slots", "1", "--memory", "2000", "--strategy", "demand-driven"];
    let asked = |seed: &str, output: &str, more: &[&str]| {
        let before = server.server.requests().0;
        let more = [&small, &["--store", &store, "--seed", seed][..], more].concat();
        let run = server.run(folder, &render(&scene, "4", output, &more));
        assert_eq!(run.code, 0, "{}", run.err);
        server.server.requests().0 - before
    };
    // prepares
    asked("1", "a.exr", &[]);
    let without = asked("2", "b.exr", &[]);
    let with = asked("3", "c.exr", &["--s3-cache", "1MiB"]);
    println!("{without} requests without, {with} with a cache");
    assert!(with + 30 < without, "{with} of {without}");
    let plain = common::rayherd(folder, &render(&scene, "4", "d.exr", &["--seed", "3"]));
    assert_eq!(plain.code, 0, "{}", plain.err);
    assert!(fs::read(folder.join("c.exr")).unwrap() == fs::read(folder.join("d.exr")).unwrap());
    let folder_store = ["--store", "s", "--s3-cache", "1MiB"];
    let refused = common::rayherd(folder, &render(&scene, "4", "e.exr", &folder_store));
    assert_mistake(&refused, &["--s3-cache", "s3://bucket/prefix"]);
}

/// `tests/minio/run` starts one and names it: `RAYHERD_S3_ENDPOINT`, `RAYHERD_S3_BUCKET` and the keys.
#[test]
#[ignore = "needs an S3 server: tests/minio/run"]
fn a_real_bucket_serves_as_a_folder_does() {
    let variable = |name: &str| std::env::var(name).unwrap_or_else(|_| panic!("{name} is not set"));
    let endpoint = variable("RAYHERD_S3_ENDPOINT");
    let store = format!("s3://{}/cli", variable("RAYHERD_S3_BUCKET"));
    let run = |folder: &Path, arguments: &[&str]| {
        common::rayherd(folder, &[arguments, &["--s3-endpoint", &endpoint]].concat())
    };
    serves_as_a_folder_does(&store, &run, &|_| {});
    let folder = tempfile::tempdir().unwrap();
    let denied = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(["inspect", &store, "--s3-endpoint", &endpoint])
        .env("AWS_SECRET_ACCESS_KEY", "wrong-secret")
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert_mistake(&finish(denied), &[&store]);
}

#[test]
fn a_server_that_goes_away_costs_only_time() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = scene();
    assert_eq!(common::rayherd(folder, &render(&scene, "200", "whole.exr", &[])).code, 0);
    let store = format!("s3://{BUCKET}/gone");
    let prepare = ["prepare", &scene, "--size", "32x32", "--splits", "3", "--store", &store];
    assert_eq!(server.run(folder, &prepare).code, 0);
    let before = server.server.requests().0;
    let slow = ["--store", &store, "--task-seconds", "0.02", "--threads", "1"];
    let child = server.spawn(folder, &render(&scene, "200", "x.exr", &slow));
    // opening, the scene and the owner's object take some twenty; the rest are commits
    let begun = Instant::now();
    while server.server.requests().0 < before + 80 && begun.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(2));
    }
    server.server.set_faults(S3Faults { unavailable: 1000, ..S3Faults::default() });
    let stopped = finish(child.wait_with_output().unwrap());
    assert_eq!(stopped.code, 1, "{}", stopped.err);
    for part in ["error: ", &format!("s3://{BUCKET}/gone"), "tried 7 times"] {
        assert!(stopped.err.contains(part), "no {part:?} in {}", stopped.err);
    }
    assert!(!stopped.err.contains("panicked") && !stopped.err.contains("defect"), "{}", stopped.err);

    server.server.set_faults(S3Faults::default());
    let more = ["--store", &store, "--resume", "--report", "r.json"];
    let resumed = server.run(folder, &render(&scene, "200", "x.exr", &more));
    assert_eq!(resumed.code, 0, "{}", resumed.err);
    assert!(report(folder)["tasks_reused"].as_u64() > Some(0));
    assert!(fs::read(folder.join("x.exr")).unwrap() == fs::read(folder.join("whole.exr")).unwrap());
}

#[test]
fn what_the_user_can_put_right_is_told() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let scene = scene();
    let store = format!("s3://{BUCKET}/p");
    let arguments = ["prepare", &scene, "--store", &store];
    let denied = server.command(folder, &arguments).env("AWS_SECRET_ACCESS_KEY", "wrong").output().unwrap();
    assert_mistake(&finish(denied), &[&store, "SignatureDoesNotMatch", "AWS_SECRET_ACCESS_KEY"]);
    let keyless = server.command(folder, &arguments).env_remove("AWS_ACCESS_KEY_ID").output().unwrap();
    assert_mistake(&finish(keyless), &["AWS_ACCESS_KEY_ID"]);
    assert_mistake(&server.run(folder, &["prepare", &scene, "--store", "s3://no-such-bucket/p"]), &["no-such-bucket"]);
    assert_mistake(&server.run(folder, &["inspect", &store]), &["holds no prepared scene"]);
    // nobody listens: the port of a listener that is gone
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let gone = Command::new(env!("CARGO_BIN_EXE_rayherd"))
        .args(arguments)
        .args(["--s3-endpoint", &format!("http://127.0.0.1:{port}")])
        .current_dir(folder)
        .env("AWS_ACCESS_KEY_ID", "test-key")
        .env("AWS_SECRET_ACCESS_KEY", "test-secret")
        .output()
        .unwrap();
    let gone = finish(gone);
    assert_eq!(gone.code, 1, "{}", gone.err);
    assert!(gone.err.starts_with("error: ") && gone.err.contains(&format!("127.0.0.1:{port}")), "{}", gone.err);
}
