//! What happens to a job while it runs, step by step.

use k8s_openapi::jiff::Timestamp;
use kube::runtime::controller::Action;
use rayherd_herd::remote::{Answer, Beat, WorkerId};
use serde_json::{Value, json};

use super::*;
use crate::jobs::{Problem, Running};

const SLICES: &str = "/apis/discovery.k8s.io/v1/namespaces/store/endpointslices?";
const REQUIRED: &str =
    "/spec/affinity/nodeAffinity/requiredDuringSchedulingIgnoredDuringExecution/nodeSelectorTerms/0/matchExpressions/0";

/// An operator, the API server that it asks, and a job whose scene nobody has prepared yet.
pub struct Bench {
    pub context: Arc<Context>,
    server: Server,
    stores: Vec<S3Server>,
    pub job: Value,
}

impl Bench {
    /// A job that runs: its first worker's pod was made.
    pub async fn begun(job: Value) -> Self {
        let stores = vec![S3Server::start().await, S3Server::start().await];
        stores[0].put_raw("scenes/box/box.xml", b"<scene version='3.0.0'/>");
        let (context, server) = context();
        let mut bench = Bench { context, server, stores, job };
        bench.job["metadata"]["finalizers"] = json!([FINALIZER]);
        let told = step("PATCH", STATUS, 200, bench.job.clone()).with("/status/phase", json!("Pending"));
        bench.begins(no_pods(), vec![made("box-w0", "p-0"), told]).await;
        bench
    }

    /// One step; the job has the status then that it was told.
    pub async fn step(&mut self, steps: Vec<Step>) -> (Result<Action, String>, Vec<Value>) {
        let seen: Seen = serde_json::from_value(self.job.clone()).unwrap();
        let reconciled = reconcile(Arc::new(seen), self.context.clone());
        let (done, said) = tokio::join!(reconciled, serve_on(&mut self.server, steps));
        if let Some(told) = said.iter().rev().find_map(|s| s.get("status")) {
            self.job["status"] = told.clone();
        }
        (done.map_err(|e| e.to_string()), said)
    }

    /// A step in which it begins to run, with these pods; then this must come.
    async fn begins(&mut self, pods: Value, more: Vec<Step>) {
        let mut steps = begins_on(&self.stores, pods);
        steps[2] = step("GET", GET_JOB, 200, self.job.clone());
        steps.extend(more);
        let (done, _) = self.step(steps).await;
        assert_ne!(done.unwrap(), Action::await_change());
    }

    pub fn running(&self) -> Arc<Running> {
        self.context.jobs.get("u-1").expect("it runs")
    }

    /// A change of its spec.
    fn change(&mut self, pointer: &str, value: Value) {
        let (parent, field) = pointer.rsplit_once('/').unwrap();
        self.job.pointer_mut(parent).unwrap()[field] = value;
        self.job["metadata"]["generation"] = json!(self.job["metadata"]["generation"].as_i64().unwrap() + 1);
    }

    /// Until what ran before has stopped.
    async fn stops(&mut self) {
        let old = self.running();
        old.fleet.cancel("the job was changed");
        while !old.is_over() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.context.jobs.stop_all("the test is over");
    }
}

const PODS_BY_NAME: [(&str, &str); 4] = [
    ("box-w0", "/api/v1/namespaces/studio/pods/box-w0?"),
    ("box-w1", "/api/v1/namespaces/studio/pods/box-w1?"),
    ("box-w2", "/api/v1/namespaces/studio/pods/box-w2?"),
    ("box-w0-1", "/api/v1/namespaces/studio/pods/box-w0-1?"),
];

fn path(pod: &str) -> &'static str {
    PODS_BY_NAME.iter().find(|(name, _)| *name == pod).expect("a pod of these").1
}

/// A pod is made.
pub fn made(name: &str, uid: &str) -> Step {
    step("PATCH", path(name), 201, json!({"metadata": {"name": name, "uid": uid}})).with("/metadata/name", json!(name))
}

pub fn deleted(name: &str) -> Step {
    step("DELETE", path(name), 200, json!({"kind": "Pod", "apiVersion": "v1", "metadata": {}}))
}

/// A pod that runs, with these statuses of its containers.
pub fn pod(number: u32, containers: Value) -> Value {
    json!({
        "metadata": {"name": format!("box-w{number}"), "uid": format!("p-{number}"),
            "labels": {"rayherd.io/worker": number.to_string(), "rayherd.io/placed": "true"}},
        "spec": {"containers": [{"name": "worker", "resources": {"limits": {"memory": "200Mi"}}}]},
        "status": {"phase": "Running", "containerStatuses": containers},
    })
}

#[tokio::test]
async fn a_template_is_tried_before_anything_is_made() {
    let mut crooked = job();
    crooked["spec"]["workers"]["template"] = json!({"spec": {"tolerationz": []}});
    let refused = |code: u16, message: &str| json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "R", "code": code, "message": message});
    let tried = |code: u16, message: &str| {
        let mut steps = begins(no_pods());
        steps.truncate(2);
        let path = "/api/v1/namespaces/studio/pods/box-template?";
        let tried = step("PATCH", path, code, refused(code, message)).asks("dryRun=All").asks("fieldValidation=Strict");
        steps.push(tried.with("/spec/tolerationz", json!([])));
        steps
    };
    // what is wrong in it
    for code in [400, 422] {
        let mut steps = tried(code, "Pod \"box-template\" is invalid: spec.tolerationz: unknown field");
        steps.extend([
            step("GET", PODS, 200, no_pods()),
            step("PATCH", STATUS, 200, crooked.clone())
                .with("/status/phase", json!("Failed"))
                .with("/status/conditions/0/type", json!("Accepted"))
                .with("/status/conditions/0/status", json!("False")),
            event("Warning", "BadTemplate"),
        ]);
        let (done, said, context) = scenario(&crooked, steps).await;
        assert_eq!(done, Ok(Action::await_change()));
        let told = said[4].to_string();
        assert!(
            told.contains("spec.workers.template does not make a pod") && told.contains("spec.tolerationz"),
            "{told}"
        );
        assert!(context.jobs.get("u-1").is_none());
    }
    // what passes when others end
    let mut steps = tried(403, "pods \"box-template\" is forbidden: exceeded quota: team");
    steps.extend([
        step("PATCH", STATUS, 200, crooked.clone()).with("/status/phase", json!("Pending")),
        event("Warning", "PodsRefused"),
    ]);
    let (done, said, _) = scenario(&crooked, steps).await;
    assert_ne!(done.unwrap(), Action::await_change(), "it is tried again");
    assert!(said[3].to_string().contains("there is no room for the workers' pods"), "{}", said[3]);
    // what is no answer
    let (done, ..) = scenario(&crooked, tried(500, "etcd")).await;
    assert!(done.unwrap_err().contains("cannot try a worker's pod"));
}

#[tokio::test]
async fn servers_are_found_by_their_slices_and_looked_for_again_when_a_pod_is_made() {
    let profile = json!({"metadata": {"name": "x"}, "data": {"profile.yaml":
        "bucket: herd\nservice: {namespace: store, name: minio, port: 9000, servers: 2}"}});
    let slices = |hosts: &[(&str, &str)]| {
        let endpoints: Vec<Value> = hosts
            .iter()
            .map(|(host, node)| json!({"addresses": ["127.0.0.1"], "hostname": host, "nodeName": node}))
            .collect();
        let slice = json!({"addressType": "IPv4", "metadata": {}, "endpoints": endpoints});
        json!({"kind": "EndpointSliceList", "apiVersion": "discovery.k8s.io/v1", "metadata": {}, "items": [slice]})
    };
    let found =
        |hosts| step("GET", SLICES, 200, slices(hosts)).asks("labelSelector=kubernetes.io%2Fservice-name%3Dminio");
    let mut steps = begins(no_pods());
    steps[0].answer = profile.clone();
    steps.insert(1, found(&[("minio-1", "node2")]));
    steps.extend([
        // the other one was away
        step("GET", PROFILE, 200, profile),
        found(&[("minio-1", "node2"), ("minio-0", "node7")]),
        made("box-w0", "p-0"),
        step("PATCH", STATUS, 200, job()),
    ]);
    let (done, said, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    let env = said[7].pointer("/spec/containers/0/env").and_then(Value::as_array).unwrap();
    let storage = env.iter().find(|v| v["name"] == "RAYHERD_STORAGE").unwrap()["value"].as_str().unwrap();
    let storage: Value = serde_json::from_str(storage).unwrap();
    let nodes: Vec<&Value> = storage["endpoints"].as_array().unwrap().iter().map(|e| &e["node"]).collect();
    assert_eq!(nodes, ["node7", "node2"], "{storage}");
    context.jobs.get("u-1").expect("it runs").fleet.cancel("the test is over");
}

#[tokio::test]
async fn workers_stay_with_a_change_that_leaves_their_pods_alike() {
    let mut bench = Bench::begun(job()).await;
    for (pointer, value, keeps) in
        [("/spec/sampling", json!({"spp": 32}), true), ("/spec/workers/memory", json!("1Mi"), false)]
    {
        let old = bench.running();
        bench.change(pointer, value);
        bench.stops().await;
        let told = step("PATCH", STATUS, 200, bench.job.clone())
            .with("/status/observedGeneration", bench.job["metadata"]["generation"].clone());
        bench.begins(list(vec![pod(0, json!([]))]), vec![told]).await;
        let running = bench.running();
        assert_eq!(running.generation, old.generation + 1);
        assert_eq!(running.lock().pods.get("p-0"), Some(&0), "its token counts");
        // who is not to stay is told to end
        let asks = json!({"worker": {"number": 0, "session": "box-w0-1"}, "home": null, "stage": null, "clerk": false});
        let answer = old.fleet.answer(&serde_json::from_value(asks).unwrap()).unwrap();
        assert_eq!(answer == Answer::Over, !keeps, "{pointer}: {answer:?}");
    }
}

#[tokio::test]
async fn workers_are_kept_warm_when_that_is_asked_for() {
    for warm in [None, Some(600)] {
        let mut asked = job();
        asked["spec"]["workers"]["keepWarmSeconds"] = json!(warm);
        let mut bench = Bench::begun(asked).await;
        let is_told = |bench: &Bench| bench.context.metrics.text().unwrap().contains("job=\"box\"");
        assert!(is_told(&bench));
        bench.running().lock().end = Some((Timestamp::now(), Ok(())));
        let mut steps = vec![
            step("PATCH", STATUS, 200, bench.job.clone())
                .with("/status/phase", json!("Complete"))
                .with("/status/progress", json!("100%")),
            event("Normal", "Rendered"),
        ];
        if warm.is_none() {
            steps.extend([step("GET", PODS, 200, list(vec![pod(0, json!([]))])), deleted("box-w0")]);
        }
        let (done, _) = bench.step(steps).await;
        if warm.is_none() {
            assert_eq!(done, Ok(Action::await_change()));
            assert!(bench.context.jobs.get("u-1").is_none());
            assert!(!is_told(&bench), "the job stays, and its labels do not");
            continue;
        }
        assert_eq!(done, Ok(Action::requeue(Duration::from_secs(600))));
        let (done, _) = bench.step(vec![]).await;
        assert_ne!(done.unwrap(), Action::await_change(), "they wait, in silence");
        assert!(bench.context.jobs.get("u-1").is_some() && is_told(&bench));
        // their time is over
        bench.job["status"]["completionTime"] = json!("2026-01-01T00:00:00Z");
        let (done, _) =
            bench.step(vec![step("GET", PODS, 200, list(vec![pod(0, json!([]))])), deleted("box-w0")]).await;
        assert_eq!(done, Ok(Action::await_change()));
        assert!(!is_told(&bench));
    }
}

#[tokio::test]
async fn a_job_whose_ledger_was_moved_by_another_begins_anew_with_the_same_workers() {
    let mut bench = Bench::begun(job()).await;
    let old = bench.running();
    old.lock().end = Some((Timestamp::now(), Err(Problem { message: "moved".into(), stopped: true })));
    let (done, _) = bench.step(vec![]).await;
    assert_eq!(done, Ok(Action::requeue(Duration::from_secs(10))));
    assert!(bench.context.jobs.get("u-1").is_none());
    // with nothing new to tell
    bench.begins(list(vec![pod(0, json!([]))]), vec![]).await;
    assert!(!Arc::ptr_eq(&old, &bench.running()));
    old.fleet.cancel("the test is over");
}

#[tokio::test]
async fn kills_for_lack_of_memory_are_counted_once_each_and_end_the_job() {
    let mut bench = Bench::begun(job()).await;
    let killed = |id: u32| {
        let end = json!({"terminated": {"exitCode": 137, "reason": "OOMKilled", "containerID": format!("c{id}")}});
        list(vec![pod(
            0,
            json!([{"name": "worker", "state": {"running": {}}, "lastState": end,
            "restartCount": id, "ready": true, "image": "i", "imageID": "i"}]),
        )])
    };
    // what was there when it began is of an earlier run
    bench.change("/spec/sampling", json!({"spp": 32}));
    bench.stops().await;
    let told = step("PATCH", STATUS, 200, bench.job.clone());
    bench.begins(killed(0), vec![told]).await;
    // and what was seen is not seen again
    for id in [0, 1, 1, 1, 2, 2] {
        let (done, _) = bench.step(vec![step("GET", PODS, 200, killed(id))]).await;
        assert_ne!(done.unwrap(), Action::await_change());
        assert!(!bench.running().is_over(), "{id}");
    }
    bench.step(vec![step("GET", PODS, 200, killed(3))]).await.0.unwrap();
    let running = bench.running();
    while !running.is_over() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let steps = vec![
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/phase", json!("Failed")),
        event("Warning", "CannotRender"),
        step("GET", PODS, 200, killed(3)),
        deleted("box-w0"),
    ];
    let (done, said) = bench.step(steps).await;
    assert_eq!(done, Ok(Action::await_change()));
    let told = said[0].to_string();
    assert!(told.contains("3 workers were killed for lack of memory, and a pod may take 200Mi"), "{told}");
}

#[tokio::test]
async fn a_worker_whose_pod_is_gone_is_no_worker_any_more() {
    let mut bench = Bench::begun(job()).await;
    let worker = WorkerId { number: 0, session: "box-w0-1".into() };
    let running = bench.running();
    running.fleet.beat(&Beat { worker, running: vec![] }).unwrap();
    let steps = vec![
        step("GET", PODS, 200, list(vec![pod(0, json!([]))])),
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/workers", json!("1/2")),
    ];
    bench.step(steps).await.0.unwrap();
    assert_eq!(running.fleet.tally().ready, 1);
    let steps = vec![
        step("GET", PODS, 200, no_pods()),
        made("box-w0", "p-9"),
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/workers", json!("0/2")),
    ];
    bench.step(steps).await.0.unwrap();
    assert_eq!(running.lock().pods.keys().collect::<Vec<_>>(), ["p-9"], "nor does its token count");
}

#[tokio::test]
async fn tracing_workers_are_bound_to_the_scenes_nodes_or_drawn_there() {
    for (placement, pointer) in
        [("Required", REQUIRED), ("Preferred", PREFERRED), ("None", "/spec/affinity/nodeAffinity")]
    {
        let mut asked = job();
        asked["spec"]["placement"] = json!(placement);
        let mut bench = Bench::begun(asked).await;
        {
            let (running, scene) = (bench.running(), "0123".to_owned());
            let mut state = running.lock();
            (state.scene, state.held) = (Some(scene), [("node2".to_owned(), 100 << 20)].into());
        }
        // the first one came up before that was known, elsewhere
        let mut early = pod(0, json!([]));
        early["metadata"]["labels"]["rayherd.io/placed"] = json!("false");
        early["spec"]["nodeName"] = json!("node1");
        let mut steps = vec![step("GET", PODS, 200, list(vec![early]))];
        if placement != "None" {
            steps.extend([deleted("box-w0"), made("box-w0-1", "p-8")]);
        }
        steps.extend([
            made("box-w1", "p-1"),
            step("PATCH", STATUS, 200, bench.job.clone()).with("/status/phase", json!("Rendering")),
            event("Normal", "Prepared"),
        ]);
        let at = steps.len() - 3;
        let (done, said) = bench.step(steps).await;
        assert_ne!(done.unwrap(), Action::await_change());
        let affinity = said[at].pointer(pointer).cloned();
        match placement {
            "Required" => assert_eq!(affinity.unwrap()["values"], json!(["node2"])),
            "Preferred" => {
                let terms = affinity.unwrap();
                assert_eq!(terms[0]["preference"]["matchExpressions"][0]["values"], json!(["node2"]));
                assert!(said[at].pointer(REQUIRED).is_none());
            }
            _ => assert_eq!(affinity, None),
        }
    }
}

#[tokio::test]
async fn workers_come_and_go_with_the_waiting_rays() {
    let mut asked = job();
    asked["spec"]["workers"] = json!({"min": 1, "max": 3, "slots": [1]});
    let mut bench = Bench::begun(asked).await;
    let waiting = |bench: &Bench, rays: u64| {
        let running = bench.running();
        let mut state = running.lock();
        state.scene = Some("0123".into());
        state.status.waiting = rays;
    };
    waiting(&bench, 10 << 20);
    let steps = vec![
        step("GET", PODS, 200, list(vec![pod(0, json!([]))])),
        made("box-w1", "p-1"),
        made("box-w2", "p-2"),
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/workers", json!("0/3")),
        event("Normal", "Prepared"),
    ];
    bench.step(steps).await.0.unwrap();
    waiting(&bench, 1);
    let all = || list((0..3).map(|n| pod(n, json!([]))).collect());
    let steps = vec![
        step("GET", PODS, 200, all()),
        deleted("box-w1"),
        deleted("box-w2"),
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/workers", json!("0/1")),
    ];
    bench.step(steps).await.0.unwrap();
}
