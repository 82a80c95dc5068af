//! The store in S3 from outside: prepare, render, resume and gc against a server in this process.

mod common;

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::{Run, assert_mistake, repository};
use rayherd_herd::store::s3_server::{BUCKET, S3Faults, S3Server};
use rayherd_tests::mutation::peak_memory_of;
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
        command.env("AWS_ACCESS_KEY_ID", S3Server::key().access_key);
        command.env("AWS_SECRET_ACCESS_KEY", S3Server::key().secret_key);
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

/// A cluster that does not answer, as kubectl knows it.
fn no_cluster(folder: &Path) -> String {
    let path = folder.join("kubeconfig");
    let text = "{apiVersion: v1, kind: Config, current-context: c, clusters: [{name: c, cluster: {server: 'http://127.0.0.1:1'}}], \
                users: [{name: u, user: {}}], contexts: [{name: c, context: {cluster: c, user: u}}]}";
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().to_owned()
}

/// Runs the program in a folder, with these arguments and variables.
type Runs<'a> = &'a dyn Fn(&Path, &[&str], &[(&str, &str)]) -> Run;

/// Uploads a scene as `submit` does, and renders a job of it from there by its profile: the same bytes as from the local file.
fn a_scene_goes_there_and_comes_back(store: &str, profile: &str, run: Runs) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let kubeconfig = no_cluster(folder);
    let scene = folder.join("box");
    fs::create_dir(&scene).unwrap();
    fs::copy(repository("examples/cornell-box.xml"), scene.join("box.xml")).unwrap();
    // beside it, and above what goes in one put
    fs::write(scene.join("large.bin"), vec![7; 70 << 20]).unwrap();
    let submit = ["submit", "box/box.xml", "--store", store];
    let told = |run: &Run| run.err.lines().find_map(|l| l.strip_prefix("the scene is ")).map(str::to_owned);
    let sent = run(folder, &submit, &[("KUBECONFIG", &kubeconfig)]);
    // the cluster is asked last
    assert!(sent.code == 1 && sent.err.contains("2 of 2 files uploaded"), "{}", sent.err);
    let key = told(&sent).unwrap();
    let again = run(folder, &submit, &[("KUBECONFIG", &kubeconfig)]);
    assert!(again.err.contains("0 of 2 files uploaded") && told(&again).as_ref() == Some(&key), "{}", again.err);

    fs::write(folder.join("profile.yaml"), profile).unwrap();
    let job = format!(
        "{{apiVersion: rayherd.io/v1alpha1, kind: RenderJob, metadata: {{name: b}}, spec: {{scene: {{source: {key}}}, \
         image: {{size: 16x16}}, sampling: {{spp: 4}}, splits: 3, replicas: 1}}}}"
    );
    fs::write(folder.join("job.yaml"), job).unwrap();
    let there = run(folder, &["render", "-f", "job.yaml", "--storage-profile", "profile.yaml", "-o", "there.exr"], &[]);
    assert_eq!(there.code, 0, "{}", there.err);
    let here = common::rayherd(folder, &["render", "-f", "job.yaml", "--scene", "box/box.xml", "-o", "here.exr"]);
    assert_eq!(here.code, 0, "{}", here.err);
    assert!(fs::read(folder.join("there.exr")).unwrap() == fs::read(folder.join("here.exr")).unwrap());
    // its own source is no file here
    assert_mistake(&common::rayherd(folder, &["render", "-f", "job.yaml", "-o", "x.exr"]), &["box.xml"]);
}

#[test]
fn a_scene_is_submitted_and_rendered_by_its_profile() {
    let server = Server::start();
    let run = |folder: &Path, arguments: &[&str], variables: &[(&str, &str)]| {
        finish(server.command(folder, arguments).envs(variables.iter().copied()).output().unwrap())
    };
    // inside the cluster: the flag says where
    let service = "{bucket: test-bucket, prefix: herd, service: {namespace: s, name: minio, servers: 3}}";
    a_scene_goes_there_and_comes_back(&format!("s3://{BUCKET}/herd"), service, &run);
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("p.yaml"), service).unwrap();
    let job =
        "{apiVersion: rayherd.io/v1alpha1, kind: RenderJob, metadata: {name: b}, spec: {scene: {source: no/such.xml}}}";
    fs::write(folder.join("job.yaml"), job).unwrap();
    let of_profile = ["render", "-f", "job.yaml", "--storage-profile", "p.yaml", "-o", "x.exr"];
    assert_mistake(&run(folder, &of_profile, &[]), &["no/such.xml", "upload the scene first"]);
    assert_mistake(&common::rayherd(folder, &of_profile), &["p.yaml", "--s3-endpoint"]);
    assert_eq!(common::rayherd(folder, &["render", "x.ply", "--storage-profile", "p.yaml"]).code, 2);
}

/// Parts that were sent before the server went away are not sent again, and no file is held in memory.
#[test]
fn an_upload_goes_on_within_a_file() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let kubeconfig = no_cluster(folder);
    fs::create_dir(folder.join("scene")).unwrap();
    // twenty parts of 8 MiB, no two alike
    let bytes: u64 = 160 << 20;
    let body: Vec<u8> = (0..bytes / 8).flat_map(u64::to_le_bytes).collect();
    fs::write(folder.join("scene/large.bin"), &body).unwrap();
    drop(body);
    let store = format!("s3://{BUCKET}/on");
    let command = || {
        let mut command = server.command(folder, &["submit", "scene", "--store", &store]);
        command.env("KUBECONFIG", &kubeconfig).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    };
    server.server.set_faults(S3Faults { latency: Duration::from_millis(5), ..S3Faults::default() });
    let mut child = command().spawn().unwrap();
    let (begun, mut peak) = (Instant::now(), None);
    while server.server.uploads().0 < 8 && begun.elapsed() < Duration::from_secs(120) {
        peak = peak_memory_of(child.id()).max(peak);
        assert!(child.try_wait().unwrap().is_none(), "too soon at its end");
        std::thread::sleep(Duration::from_millis(1));
    }
    server.server.set_faults(S3Faults { unavailable: 1000, ..S3Faults::default() });
    let stopped = finish(child.wait_with_output().unwrap());
    assert_eq!(stopped.code, 1, "{}", stopped.err);
    assert!(stopped.err.contains("the same command goes on"), "{}", stopped.err);
    if let Some(kib) = peak {
        assert!(kib << 10 < bytes / 2 + (40 << 20), "{kib} KiB for a file of {bytes} bytes");
    }
    let (before, unfinished) = server.server.uploads();
    assert_eq!(unfinished.len(), 1, "{unfinished:?}");
    server.server.set_faults(S3Faults::default());
    let more = finish(command().output().unwrap());
    assert!(more.err.contains("1 of 1 files uploaded, 160"), "{}", more.err);
    let (after, unfinished) = server.server.uploads();
    // four may have been on their way
    assert!(unfinished.is_empty() && after - before <= 20 - before + 4, "{before} parts, then {} more", after - before);
    println!("{before} parts, then {} more; at most {peak:?} KiB", after - before);
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

/// What lies on one of a cluster's servers may be named on another: one alone is refused, all together are collected.
#[test]
fn a_cluster_is_collected_as_a_whole() {
    let servers = [Server::start(), Server::start()];
    let url = |n: usize| servers[n].server.settings("").endpoint.unwrap();
    let (store, folder) = (format!("s3://{BUCKET}/herd"), tempfile::tempdir().unwrap());
    let folder = folder.path();
    let prepare = ["prepare", &scene(), "--size", "8x8", "--splits", "2", "--store", &store];
    assert_eq!(servers[0].run(folder, &prepare).code, 0);
    for Server { server, .. } in &servers {
        // as the operator marks a scene that is used, on all servers; this one is gone
        server.put_raw(&format!("herd/uses/{}", "1".repeat(64)), b"{\"time\":1,\"stores\":2}");
        server.put_raw(&format!("herd/objects/00/{}", "0".repeat(64)), b"stray");
    }
    for server in &servers {
        let alone = server.run(folder, &["gc", &store]);
        assert_mistake(&alone, &["one of 2", "nothing is deleted", "--server"]);
    }
    let all = servers[0].run(folder, &["gc", &store, "--server", &url(1)]);
    assert!(all.code == 0 && all.out.contains(": 2 objects deleted, 10 B; "), "{}{}", all.out, all.err);
    let again = servers[1].run(folder, &["gc", &store, "--server", &url(0)]);
    assert!(again.code == 0 && again.out.contains(": 0 objects deleted"), "{}{}", again.out, again.err);
    let whole = servers[0].run(folder, &["inspect", &store]);
    assert_eq!(whole.code, 0, "{}", whole.err);
    assert_mistake(&common::rayherd(folder, &["gc", &store, "--server", &url(1)]), &["--s3-endpoint"]);
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
    let with = |folder: &Path, arguments: &[&str], variables: &[(&str, &str)]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rayherd"));
        command.args(arguments).args(["--s3-endpoint", &endpoint]).envs(variables.iter().copied());
        finish(command.current_dir(folder).output().unwrap())
    };
    let profile =
        format!("{{bucket: {}, prefix: sent, endpoints: [{{url: '{endpoint}'}}]}}", variable("RAYHERD_S3_BUCKET"));
    a_scene_goes_there_and_comes_back(&format!("s3://{}/sent", variable("RAYHERD_S3_BUCKET")), &profile, &with);
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

/// A server of HTTP that answers every request alike; its address, and what it was asked.
fn answering(status: &'static str, body: String) -> (String, Arc<Mutex<Vec<String>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let asked = Arc::new(Mutex::new(Vec::new()));
    let of_thread = asked.clone();
    std::thread::spawn(move || {
        for socket in listener.incoming() {
            let (mut socket, mut request, mut part) = (socket.unwrap(), String::new(), [0; 4096]);
            let whole = |request: &str| {
                let (head, body) = request.split_once("\r\n\r\n")?;
                let length = head.to_lowercase().split("content-length: ").nth(1)?.lines().next()?.parse().ok();
                Some(body.len() >= length.unwrap_or(0))
            };
            while !whole(&request).unwrap_or(request.starts_with("GET") && request.ends_with("\r\n\r\n")) {
                match socket.read(&mut part).unwrap() {
                    0 => break,
                    n => request.push_str(&String::from_utf8_lossy(&part[..n])),
                }
            }
            of_thread.lock().unwrap().push(request);
            let head = format!("HTTP/1.1 {status}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n", body.len());
            socket.write_all(format!("{head}{body}").as_bytes()).unwrap();
        }
    });
    (address, asked)
}

/// A role's keys from STS for a token, or from a container's address: no key in the environment.
#[test]
fn a_clouds_identity_is_used_where_there_is_no_key() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (scene, token) = (scene(), folder.join("token"));
    fs::write(&token, "who-i-am").unwrap();
    let key = S3Server::key();
    let (id, secret) = (&key.access_key, &key.secret_key);
    let sts = format!(
        "<AssumeRoleWithWebIdentityResponse xmlns=\"https://sts.amazonaws.com/doc/2011-06-15/\"><AssumeRoleWithWebIdentityResult>\
         <Credentials><AccessKeyId>{id}</AccessKeyId><SecretAccessKey>{secret}</SecretAccessKey><SessionToken>passing</SessionToken>\
         <Expiration>2100-01-01T00:00:00Z</Expiration></Credentials>\
         <AssumedRoleUser><AssumedRoleId>a:b</AssumedRoleId><Arn>arn:aws:sts::1:assumed-role/herd/s</Arn></AssumedRoleUser>\
         </AssumeRoleWithWebIdentityResult></AssumeRoleWithWebIdentityResponse>"
    );
    let (sts, asked_sts) = answering("200 OK", sts);
    let container = format!(
        r#"{{"AccessKeyId":"{id}","SecretAccessKey":"{secret}","Token":"passing","Expiration":"2100-01-01T00:00:00Z"}}"#
    );
    let (container, asked_container) = answering("200 OK", container);
    let denied =
        "<ErrorResponse><Error><Code>AccessDenied</Code><Message>not this role</Message></Error></ErrorResponse>";
    let (denying, _) = answering("403 Forbidden", denied.into());
    let token = token.to_str().unwrap();
    let run = |store: &str, variables: &[(&str, &str)]| {
        let store = format!("s3://{BUCKET}/{store}");
        let mut command = server.command(folder, &["prepare", &scene, "--store", &store]);
        command.env_remove("AWS_ACCESS_KEY_ID").env_remove("AWS_SECRET_ACCESS_KEY");
        finish(command.envs(variables.iter().copied()).output().unwrap())
    };
    let web = |sts| {
        [
            ("AWS_WEB_IDENTITY_TOKEN_FILE", token),
            ("AWS_ROLE_ARN", "arn:aws:iam::1:role/herd"),
            ("AWS_ENDPOINT_URL_STS", sts),
        ]
    };
    let done = run("web", &web(&sts));
    assert_eq!(done.code, 0, "{}", done.err);
    let asked = asked_sts.lock().unwrap().join("\n");
    for part in ["Action=AssumeRoleWithWebIdentity", "WebIdentityToken=who-i-am", "role%2Fherd"] {
        assert!(asked.contains(part), "no {part} in {asked}");
    }
    let uri = format!("{container}/keys");
    let done = run(
        "container",
        &[("AWS_CONTAINER_CREDENTIALS_FULL_URI", &uri), ("AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE", token)],
    );
    assert_eq!(done.code, 0, "{}", done.err);
    let asked = asked_container.lock().unwrap().join("\n");
    assert!(asked.starts_with("GET /keys") && asked.to_lowercase().contains("authorization: who-i-am"), "{asked}");
    let refused = run("denied", &web(&denying));
    assert!(refused.code == 1 && refused.err.contains("not this role"), "{}: {}", refused.code, refused.err);
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
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
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
