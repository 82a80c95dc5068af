//! Reconciling against a mock API server: each request is asserted, and silence too.

use std::sync::Arc;
use std::time::Duration;

use hyper::{Request, Response};
use k8s_openapi::jiff::{SignedDuration, Timestamp};
use kube::Client;
use kube::client::Body;
use kube::runtime::controller::Action;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::job::JobError;
use rayherd_herd::remote::Depot;
use rayherd_herd::store::s3_server::{BUCKET, S3Server};
use rayherd_herd::store::{BlockStore, MemoryStore};
use serde_json::{Value, json};
use tokio::runtime::Handle;
use tower::Layer;
use tower_test::mock::{self, Handle as Mock};

use crate::config::Config;
use crate::ledger::{Beside, Ledger};
use crate::metrics::Metrics;
use crate::reconcile::{Context, FINALIZER, Seen, reconcile};

/// One request that must come, and its answer.
pub struct Step {
    method: &'static str,
    path: &'static str,
    /// What must be in the body, by JSON pointer.
    body: Vec<(&'static str, Value)>,
    status: u16,
    answer: Value,
}

pub fn step(method: &'static str, path: &'static str, status: u16, answer: Value) -> Step {
    Step { method, path, body: vec![], status, answer }
}

impl Step {
    fn with(mut self, pointer: &'static str, value: Value) -> Self {
        self.body.push((pointer, value));
        self
    }
}

pub type Server = Mock<Request<Body>, Response<Body>>;

/// Answers these requests in their order, and sees that no other comes. What each said is handed back.
pub async fn serve(mut server: Server, steps: Vec<Step>) -> Vec<Value> {
    let mut said = Vec::new();
    for (number, step) in steps.into_iter().enumerate() {
        let next = tokio::time::timeout(Duration::from_secs(20), server.next_request()).await;
        let (request, send) = next
            .ok()
            .flatten()
            .unwrap_or_else(|| panic!("request {number} ({} {}) did not come", step.method, step.path));
        let (parts, body) = request.into_parts();
        let asked = format!("{} {}", parts.method, parts.uri);
        assert!(
            parts.method == step.method && parts.uri.to_string().starts_with(step.path),
            "request {number} is {asked}, not {} {}",
            step.method,
            step.path
        );
        let bytes = body.collect_bytes().await.unwrap();
        let body: Value = serde_json::from_slice(&bytes).unwrap_or(Value::Null);
        for (pointer, want) in &step.body {
            assert_eq!(body.pointer(pointer), Some(want), "{asked}: {pointer} in {body}");
        }
        said.push(body);
        let answer = serde_json::to_vec(&step.answer).unwrap();
        send.send_response(Response::builder().status(step.status).body(Body::from(answer)).unwrap());
    }
    let more = tokio::time::timeout(Duration::from_millis(300), server.next_request()).await;
    if let Ok(Some((request, _))) = more {
        panic!("one request too many: {} {}", request.method(), request.uri());
    }
    said
}

pub fn context() -> (Arc<Context>, Server) {
    let (service, server) = mock::pair::<Request<Body>, Response<Body>>();
    let config = Config {
        namespace: "rayherd".into(),
        pod: "operator-1".into(),
        lease: "lease".into(),
        authority: "authority".into(),
        url: "https://operator:8443".into(),
        image: "worker:1".into(),
        listen: "127.0.0.1:0".parse().unwrap(),
        metrics: "127.0.0.1:0".parse().unwrap(),
        watch: None,
        scene_days: 30,
    };
    let metrics = Metrics::new().unwrap();
    let service = metrics.requests().layer(service);
    (Arc::new(Context::new(Client::new(service, "default"), config, metrics)), server)
}

pub fn job() -> Value {
    json!({
        "apiVersion": "rayherd.io/v1alpha1",
        "kind": "RenderJob",
        "metadata": {"name": "box", "namespace": "studio", "uid": "u-1", "generation": 3, "resourceVersion": "7"},
        "spec": {"scene": {"source": "scenes/box/box.xml"}, "workers": {"nodes": 2, "slots": [1]}},
    })
}

fn object(value: &Value) -> Arc<RenderJobObject> {
    Arc::new(serde_json::from_value(value.clone()).unwrap())
}

pub fn not_found() -> Value {
    json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "NotFound", "code": 404, "message": "none"})
}

fn conflict() -> Value {
    json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "Conflict", "code": 409, "message": "old"})
}

fn no_pods() -> Value {
    json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": []})
}

/// An event is published.
fn event(kind: &'static str, reason: &'static str) -> Step {
    let path = "/apis/events.k8s.io/v1/namespaces/studio/events?";
    step("POST", path, 201, json!({"metadata": {}, "eventTime": null}))
        .with("/type", json!(kind))
        .with("/reason", json!(reason))
        .with("/regarding/uid", json!("u-1"))
}

const STATUS: &str = "/apis/rayherd.io/v1alpha1/namespaces/studio/renderjobs/box/status?";
const JOB: &str = "/apis/rayherd.io/v1alpha1/namespaces/studio/renderjobs/box?";
pub const PROFILE: &str = "/api/v1/namespaces/rayherd/configmaps/rayherd-storage-default";
const SECRET: &str = "/api/v1/namespaces/studio/secrets/rayherd-storage";
const PODS: &str = "/api/v1/namespaces/studio/pods?&labelSelector=rayherd.io%2Fjob%3Du-1";

async fn scenario(job: &Value, steps: Vec<Step>) -> (Result<Action, String>, Vec<Value>, Arc<Context>) {
    let (context, server) = context();
    let serving = tokio::spawn(serve(server, steps));
    let seen: Seen = serde_json::from_value(job.clone()).unwrap();
    let done = reconcile(Arc::new(seen), context.clone()).await.map_err(|e| e.to_string());
    (done, serving.await.unwrap(), context)
}

#[tokio::test]
async fn a_bad_job_fails_with_what_to_do_and_nothing_is_made() {
    let mut bad = job();
    bad["spec"]["sampling"] = json!({"spp": 0});
    let tell = step("PATCH", STATUS, 200, bad.clone())
        .with("/status/phase", json!("Failed"))
        .with("/status/observedGeneration", json!(3))
        .with("/status/conditions/0/status", json!("False"));
    let (done, said, _) = scenario(&bad, vec![tell, event("Warning", "Invalid")]).await;
    assert_eq!(done, Ok(Action::await_change()));
    assert!(said[0].to_string().contains("spec.sampling.spp: is 0"), "{}", said[0]);
    // told once: the same again is silence but for a look at what pods are left
    let mut told = bad.clone();
    told["status"] = said[0]["status"].clone();
    let (done, ..) = scenario(&told, vec![step("GET", PODS, 200, no_pods())]).await;
    assert_eq!(done, Ok(Action::await_change()));
}

#[tokio::test]
async fn a_job_without_its_storage_waits_and_says_for_what() {
    let tell = step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending"));
    let steps = vec![step("GET", PROFILE, 404, not_found()), tell, event("Warning", "StorageMissing")];
    let (done, said, _) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    assert!(said[1].to_string().contains("rayherd-storage-default is not there"), "{}", said[1]);
    let mut told = job();
    told["status"] = said[1]["status"].clone();
    let (done, ..) = scenario(&told, vec![step("GET", PROFILE, 404, not_found())]).await;
    assert_ne!(done.unwrap(), Action::await_change(), "told once, and looked at again");
}

#[tokio::test]
async fn a_job_that_somebody_else_manages_is_left_alone() {
    let mut theirs = job();
    theirs["spec"]["managedBy"] = json!("kueue.x-k8s.io/multikueue");
    // whatever there is to say of it
    theirs["spec"]["sampling"] = json!({"spp": 0});
    let (done, _, context) = scenario(&theirs, vec![]).await;
    assert_eq!(done, Ok(Action::await_change()));
    assert!(context.jobs.get("u-1").is_none());
    theirs["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    theirs["metadata"]["finalizers"] = json!([FINALIZER]);
    let (done, ..) = scenario(&theirs, vec![]).await;
    assert_eq!(done, Ok(Action::await_change()), "also when another operator of its kind has it");
    let mut ours = theirs.clone();
    ours["spec"]["managedBy"] = json!(rayherd_api::MANAGED_BY);
    ours["metadata"]["finalizers"] = json!([]);
    ours["metadata"]["deletionTimestamp"] = Value::Null;
    let tell = step("PATCH", STATUS, 200, ours.clone()).with("/status/phase", json!("Failed"));
    let (done, _, context) = scenario(&ours, vec![tell, event("Warning", "Invalid")]).await;
    assert_eq!(done, Ok(Action::await_change()));
    // what was asked of the API server is counted
    let text = context.metrics.text().unwrap();
    assert!(text.contains("rayherd_api_requests_total{verb=\"patch\"} 1"), "{text}");
    assert!(text.contains("rayherd_api_requests_total{verb=\"post\"} 1"), "{text}");
}

#[tokio::test]
async fn an_api_server_that_fails_is_an_error_to_try_again() {
    let failure = json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "InternalError", "code": 500, "message": "etcd"});
    let (done, ..) = scenario(&job(), vec![step("GET", PROFILE, 500, failure)]).await;
    assert!(done.unwrap_err().contains("cannot read ConfigMap"));
}

#[tokio::test]
async fn a_good_job_gets_its_finalizer_then_one_worker_that_prepares() {
    let mut with_finalizer = job();
    with_finalizer["metadata"]["finalizers"] = json!([FINALIZER]);
    let pod = json!({"metadata": {"name": "box-w0", "uid": "p-0", "labels": {"rayherd.io/worker": "0"}}});
    let mut steps = begins(no_pods());
    steps[2] = step("PATCH", JOB, 200, with_finalizer.clone())
        .with("/metadata/finalizers", json!([FINALIZER]))
        .with("/metadata/resourceVersion", json!("7"));
    steps.extend([
        step("PATCH", "/api/v1/namespaces/studio/pods/box-w0?", 201, pod.clone())
            .with("/metadata/ownerReferences/0/uid", json!("u-1"))
            .with("/spec/automountServiceAccountToken", json!(false)),
        step("PATCH", STATUS, 200, with_finalizer.clone())
            .with("/status/phase", json!("Pending"))
            .with("/status/workers", json!("0/2")),
    ]);
    let (done, said, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    assert!(said[5]["status"].get("ledger").is_none(), "the pointers belong to another manager");
    let running = context.jobs.get("u-1").expect("it runs");
    assert_eq!(running.lock().pods.get("p-0"), Some(&0), "its token counts");
    running.fleet.cancel("the test is over");
}

/// Requests of a job that begins, up to the list of its pods.
fn begins(pods: Value) -> Vec<Step> {
    let profile = json!({
        "metadata": {"name": "rayherd-storage-default"},
        "data": {"profile.yaml": "bucket: herd\nendpoints: [{url: 'http://127.0.0.1:1', node: node1}]"},
    });
    let secret = json!({"metadata": {"name": "rayherd-storage"}, "data": {"AWS_ACCESS_KEY_ID": "YQ==", "AWS_SECRET_ACCESS_KEY": "Yg=="}});
    let mut with_finalizer = job();
    with_finalizer["metadata"]["finalizers"] = json!([FINALIZER]);
    vec![
        step("GET", PROFILE, 200, profile),
        step("GET", SECRET, 200, secret),
        step("PATCH", JOB, 200, with_finalizer),
        step("GET", PODS, 200, pods),
    ]
}

#[tokio::test]
async fn the_first_worker_comes_up_beside_the_source() {
    let servers = [S3Server::start().await, S3Server::start().await];
    servers[1].put_raw("scenes/box/box.xml", b"<scene version='3.0.0'/>");
    let url = |n: usize| servers[n].settings("").endpoint.unwrap();
    let profile = format!(
        "bucket: {BUCKET}\nendpoints: [{{url: '{}', node: node1}}, {{url: '{}', node: node2}}]",
        url(0),
        url(1)
    );
    let profile = json!({"metadata": {"name": "rayherd-storage-default"}, "data": {"profile.yaml": profile}});
    let pod = json!({"metadata": {"name": "box-w0", "uid": "p-0", "labels": {"rayherd.io/worker": "0"}}});
    let mut steps = begins(no_pods());
    steps[0] = step("GET", PROFILE, 200, profile);
    // test-key, test-secret
    steps[1].answer["data"] = json!({"AWS_ACCESS_KEY_ID": "dGVzdC1rZXk=", "AWS_SECRET_ACCESS_KEY": "dGVzdC1zZWNyZXQ="});
    let nodes = "/spec/affinity/nodeAffinity/preferredDuringSchedulingIgnoredDuringExecution";
    steps.extend([
        step("PATCH", "/api/v1/namespaces/studio/pods/box-w0?", 201, pod)
            .with("/metadata/labels/rayherd.io~1placed", json!("false")),
        step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending")),
    ]);
    let (done, said, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    let terms = said[4].pointer(nodes).and_then(Value::as_array).expect("node affinity").clone();
    assert_eq!(terms.len(), 1, "{terms:?}");
    assert_eq!(terms[0].pointer("/preference/matchExpressions/0/values"), Some(&json!(["node2"])));
    context.jobs.get("u-1").expect("it runs").fleet.cancel("the test is over");
}

#[tokio::test]
async fn a_job_is_shown_as_long_as_its_annotation_asks_for_it() {
    for asked in [true, false] {
        let mut watched = job();
        if asked {
            watched["metadata"]["annotations"] = json!({"rayherd.io/preview": "true"});
        }
        let mut steps = begins(no_pods());
        let pod = json!({"metadata": {"name": "box-w0", "uid": "p-0"}});
        steps.extend([
            step("PATCH", "/api/v1/namespaces/studio/pods/box-w0?", 201, pod),
            step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending")),
        ]);
        let (_, _, context) = scenario(&watched, steps).await;
        let running = context.jobs.get("u-1").expect("it runs");
        assert_eq!(running.fleet.wants_preview(Duration::from_secs(30)), asked);
        running.fleet.cancel("the test is over");
    }
}

#[tokio::test]
async fn pods_that_are_refused_are_told_of_and_made_later() {
    let quota = json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "Forbidden", "code": 403,
        "message": "pods \"box-w0\" is forbidden: exceeded quota: team"});
    let mut steps = begins(no_pods());
    steps.extend([
        step("PATCH", "/api/v1/namespaces/studio/pods/box-w0?", 403, quota),
        step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending")),
        event("Warning", "PodsRefused"),
    ]);
    let (done, said, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    assert!(said[5].to_string().contains("does not take the pod of worker 0: pods"), "{}", said[5]);
    assert_eq!(context.metrics.errors.get(), 1);
    let running = context.jobs.get("u-1").expect("it runs");
    assert!(!running.lock().rests.may(0, Timestamp::now()), "not at once");
    running.fleet.cancel("the test is over");
}

#[tokio::test]
async fn a_pod_that_failed_goes_and_the_next_comes_after_a_rest() {
    let pod = json!({"kind": "Pod", "apiVersion": "v1", "metadata": {"name": "box-w0"}});
    let failed = json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": [
        {"metadata": {"name": "box-w0", "labels": {"rayherd.io/worker": "0"}}, "status": {"phase": "Failed", "reason": "Evicted"}},
    ]});
    let mut steps = begins(failed);
    steps.extend([
        step("DELETE", "/api/v1/namespaces/studio/pods/box-w0?", 200, pod),
        step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending")),
    ]);
    let (done, _, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    context.jobs.get("u-1").expect("it runs").fleet.cancel("the test is over");
}

#[tokio::test]
async fn failures_of_a_job_make_it_wait_longer_each_time() {
    let (context, _server) = context();
    let seen: Arc<Seen> = Arc::new(serde_json::from_value(job()).unwrap());
    let error = crate::reconcile::Error::Clean("no".into());
    let rests: Vec<String> =
        (0..6).map(|_| format!("{:?}", crate::reconcile::failed(seen.clone(), &error, context.clone()))).collect();
    let distinct: std::collections::BTreeSet<&String> = rests.iter().collect();
    assert_eq!(distinct.len(), 6, "{rests:?}");
}

#[tokio::test]
async fn a_finished_job_loses_its_workers_and_then_there_is_silence() {
    let mut finished = job();
    finished["status"] = json!({"phase": "Complete", "observedGeneration": 3});
    let pods = json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": [
        {"metadata": {"name": "box-w0", "labels": {"rayherd.io/worker": "0"}}},
        {"metadata": {"name": "box-w1", "deletionTimestamp": "2026-01-01T00:00:00Z"}},
    ]});
    let pod = json!({"kind": "Pod", "apiVersion": "v1", "metadata": {"name": "box-w0"}});
    let steps = vec![step("GET", PODS, 200, pods), step("DELETE", "/api/v1/namespaces/studio/pods/box-w0?", 200, pod)];
    let (done, ..) = scenario(&finished, steps).await;
    assert_eq!(done, Ok(Action::await_change()));
    let (done, ..) = scenario(&finished, vec![step("GET", PODS, 200, no_pods())]).await;
    assert_eq!(done, Ok(Action::await_change()), "nothing is written");
}

#[tokio::test]
async fn a_deleted_job_goes_even_when_its_storage_went_first() {
    let mut deleted = job();
    deleted["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    let (done, ..) = scenario(&deleted, vec![]).await;
    assert_eq!(done, Ok(Action::await_change()), "it is not ours any more");
    deleted["metadata"]["finalizers"] = json!(["other/one", FINALIZER]);
    let steps = vec![
        step("GET", PODS, 200, no_pods()),
        step("GET", PROFILE, 404, not_found()),
        step("PATCH", JOB, 200, deleted.clone()).with("/metadata/finalizers", json!(["other/one"])),
    ];
    let (done, ..) = scenario(&deleted, steps).await;
    assert_eq!(done, Ok(Action::await_change()));
}

#[tokio::test]
async fn what_a_deleted_job_wrote_is_looked_for_when_none_of_its_workers_writes_any_more() {
    let mut deleted = job();
    deleted["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    deleted["metadata"]["finalizers"] = json!([FINALIZER]);
    let pods = |metadata: Value, phase: &str| {
        let pod = json!({"metadata": metadata, "status": {"phase": phase}});
        json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": [pod]})
    };
    let name = "box-w0";
    let pod = json!({"kind": "Pod", "apiVersion": "v1", "metadata": {"name": name}});
    let delete = || step("DELETE", "/api/v1/namespaces/studio/pods/box-w0?", 200, pod.clone());
    let soon = (Timestamp::now() + SignedDuration::from_secs(20)).to_string();
    let (past, living) = (json!({"name": name, "deletionTimestamp": "2026-01-01T00:00:00Z"}), json!({"name": name}));
    let ending = json!({"name": name, "deletionTimestamp": soon});
    for (pods, more) in [(pods(living.clone(), "Running"), vec![delete()]), (pods(ending.clone(), "Running"), vec![])] {
        let steps = [step("GET", PODS, 200, pods)].into_iter().chain(more).collect();
        let (done, ..) = scenario(&deleted, steps).await;
        assert_ne!(done.unwrap(), Action::await_change(), "it is looked at again");
    }
    let ended = [
        (pods(living, "Failed"), vec![delete()]),
        (pods(ending, "Succeeded"), vec![]),
        (pods(past, "Running"), vec![]),
    ];
    for (pods, more) in ended {
        let last = [
            step("GET", PROFILE, 404, not_found()),
            step("PATCH", JOB, 200, deleted.clone()).with("/metadata/finalizers", json!([])),
        ];
        let steps = [step("GET", PODS, 200, pods)].into_iter().chain(more).chain(last).collect();
        let (done, ..) = scenario(&deleted, steps).await;
        assert_eq!(done, Ok(Action::await_change()));
    }
}

#[tokio::test]
async fn a_suspended_job_has_no_workers_and_is_told_once() {
    let mut suspended = job();
    suspended["spec"]["suspend"] = json!(true);
    suspended["status"] = json!({"phase": "Rendering", "startTime": "2026-01-01T00:00:00Z", "progress": "40%"});
    let pods =
        json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": [{"metadata": {"name": "box-w0"}}]});
    let pod = json!({"kind": "Pod", "apiVersion": "v1", "metadata": {"name": "box-w0"}});
    let steps = vec![
        step("GET", PODS, 200, pods),
        step("DELETE", "/api/v1/namespaces/studio/pods/box-w0?", 200, pod),
        step("PATCH", STATUS, 200, suspended.clone())
            .with("/status/phase", json!("Suspended"))
            .with("/status/progress", json!("40%")),
        event("Normal", "Suspended"),
    ];
    let (done, said, _) = scenario(&suspended, steps).await;
    assert_eq!(done, Ok(Action::await_change()));
    assert!(said[2]["status"].get("startTime").is_none(), "its time begins anew when it goes on");
    suspended["status"] = said[2]["status"].clone();
    let (done, ..) = scenario(&suspended, vec![step("GET", PODS, 200, no_pods())]).await;
    assert_eq!(done, Ok(Action::await_change()));
}

#[tokio::test]
async fn a_job_that_took_too_long_fails_and_one_whose_time_is_over_is_deleted() {
    let mut late = job();
    late["spec"]["activeDeadlineSeconds"] = json!(60);
    late["spec"]["ttlSecondsAfterFinished"] = json!(3600);
    late["status"] = json!({"phase": "Rendering", "startTime": "2026-01-01T00:00:00Z", "observedGeneration": 3});
    let steps = vec![
        step("GET", PODS, 200, no_pods()),
        step("PATCH", STATUS, 200, late.clone()).with("/status/phase", json!("Failed")),
        event("Warning", "DeadlineExceeded"),
    ];
    let (done, said, _) = scenario(&late, steps).await;
    assert_eq!(done, Ok(Action::await_change()), "its end is seen by the watch, and then its time begins");
    late["status"] = said[1]["status"].clone();
    let (done, ..) = scenario(&late, vec![step("GET", PODS, 200, no_pods())]).await;
    assert_ne!(done.unwrap(), Action::await_change(), "it is looked at again in an hour");
    late["status"]["completionTime"] = json!("2026-01-01T00:01:00Z");
    let gone = step("DELETE", JOB, 200, late.clone())
        .with("/preconditions/uid", json!("u-1"))
        .with("/preconditions/resourceVersion", json!("7"));
    let (done, ..) = scenario(&late, vec![step("GET", PODS, 200, no_pods()), gone]).await;
    assert_eq!(done, Ok(Action::await_change()));
}

#[tokio::test]
async fn a_job_that_cannot_be_read_fails_alone() {
    let mut bad = job();
    bad["metadata"]["creationTimestamp"] = json!("2026-01-01T00:00:00Z");
    bad["spec"]["workers"] = json!({"memory": "99999999999E"});
    let steps = || {
        let tell = step("PATCH", STATUS, 200, bad.clone())
            .with("/status/phase", json!("Failed"))
            .with("/status/completionTime", json!("2026-01-01T00:00:00Z"));
        vec![step("GET", PODS, 200, no_pods()), tell, event("Warning", "Unreadable")]
    };
    let (done, said, _) = scenario(&bad, steps()).await;
    assert_eq!(done, Ok(Action::await_change()));
    assert!(said[1].to_string().contains("is no size"), "{}", said[1]);
    let (_, again, _) = scenario(&bad, steps()).await;
    assert_eq!(said[1], again[1], "the same again, which changes nothing");
    // its storage is cleaned all the same
    bad["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    bad["metadata"]["finalizers"] = json!([FINALIZER]);
    bad["spec"]["storage"] = json!({"profile": "other"});
    let steps = vec![
        step("GET", GET_JOB, 200, bad.clone()),
        step("GET", PODS, 200, no_pods()),
        step("GET", "/api/v1/namespaces/rayherd/configmaps/rayherd-storage-other", 404, not_found()),
        step("PATCH", JOB, 200, bad.clone()).with("/metadata/finalizers", json!([])),
    ];
    let (done, ..) = scenario(&bad, steps).await;
    assert_eq!(done, Ok(Action::await_change()));
}

/// Runs a move of the pointer against a script.
async fn moved(steps: Vec<Step>) -> (Result<(), JobError>, Option<(u64, String)>) {
    let (service, server) = mock::pair::<Request<Body>, Response<Body>>();
    let client = Client::new(service, "default");
    let mut known = job();
    known["status"] = json!({"ledger": [{"frame": 0, "sequence": 4, "record": "four"}]});
    let ledger = Arc::new(Ledger::new(client, &object(&known), Handle::current(), beside(&stores())));
    let serving = tokio::spawn(serve(server, steps));
    let of_thread = ledger.clone();
    let result = tokio::task::spawn_blocking(move || of_thread.move_to(0, 5, "five")).await.unwrap();
    serving.await.unwrap();
    (result, tokio::task::spawn_blocking(move || ledger.newest(0)).await.unwrap().unwrap())
}

fn stores() -> Vec<Arc<MemoryStore>> {
    (0..2).map(|_| Arc::new(MemoryStore::default())).collect()
}

fn beside(stores: &[Arc<MemoryStore>]) -> Beside {
    let stores = stores.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect();
    Beside { depot: Depot::new(stores, None).unwrap(), replicas: 2, prefix: "jobs/u-1".into() }
}

#[tokio::test]
async fn pointers_of_many_frames_take_no_more_room_than_those_of_a_few() {
    let (service, server) = mock::pair::<Request<Body>, Response<Body>>();
    let frames = 100;
    let steps = (0..frames).map(|_| step("PATCH", STATUS, 200, at(0, "x", "8"))).collect();
    let serving = tokio::spawn(serve(server, steps));
    let stores = stores();
    let client = Client::new(service, "default");
    let ledger = Ledger::new(client.clone(), &object(&job()), Handle::current(), beside(&stores));
    let moves = move || {
        for frame in 0..frames {
            ledger.move_to(frame, 10 + u64::from(frame), &format!("record-{frame}")).unwrap();
            let newest = ledger.newest(frame / 2).unwrap();
            assert_eq!(newest, Some((10 + u64::from(frame / 2), format!("record-{}", frame / 2))));
        }
        assert_eq!(ledger.newest(frames).unwrap(), None);
    };
    tokio::task::spawn_blocking(moves).await.unwrap();
    let said = serving.await.unwrap();
    let most = said.iter().map(|s| s["status"]["ledger"].as_array().unwrap().len()).max();
    assert_eq!(most, Some(33), "32, and the object with the others");
    // another operator goes on from the status
    let mut known = job();
    known["status"] = said[99]["status"].clone();
    let anew = |job: &Value| Ledger::new(client.clone(), &object(job), Handle::current(), beside(&stores));
    let (full, empty) = (anew(&known), anew(&known));
    let look = move || {
        for frame in 0..frames {
            assert_eq!(full.newest(frame).unwrap(), Some((10 + u64::from(frame), format!("record-{frame}"))));
        }
    };
    tokio::task::spawn_blocking(look).await.unwrap();
    // no copy left: what the status itself says is known still
    for store in &stores {
        let keys: Vec<String> = store.list("jobs/u-1/pointers/").await.unwrap().into_iter().map(|(k, _)| k).collect();
        assert!(!keys.is_empty());
        store.delete(&keys).await.unwrap();
    }
    let look = move || (empty.newest(0).unwrap(), empty.newest(frames - 1).unwrap());
    let found = tokio::task::spawn_blocking(look).await.unwrap();
    assert_eq!(found, (None, Some((109, "record-99".to_owned()))));
}

fn at(sequence: i64, record: &str, version: &str) -> Value {
    let mut job = job();
    job["metadata"]["resourceVersion"] = json!(version);
    job["status"] = json!({"ledger": [{"frame": 0, "sequence": sequence, "record": record}]});
    job
}

const GET_JOB: &str = "/apis/rayherd.io/v1alpha1/namespaces/studio/renderjobs/box";

#[tokio::test]
async fn the_ledger_moves_only_from_where_this_operator_left_it() {
    let write = |version: &'static str, status, answer| {
        step("PATCH", STATUS, status, answer)
            .with("/metadata/resourceVersion", json!(version))
            .with("/status/ledger/0/record", json!("five"))
    };
    let five = Some((5, "five".to_owned()));
    let (done, newest) = moved(vec![write("7", 200, at(5, "five", "8"))]).await;
    assert!(done.is_ok() && newest == five);
    // somebody wrote another part of the status
    let again = vec![
        write("7", 409, conflict()),
        step("GET", GET_JOB, 200, at(4, "four", "9")),
        write("9", 200, at(5, "five", "10")),
    ];
    let (done, newest) = moved(again).await;
    assert!(done.is_ok() && newest == five);
    // the write was done, its answer lost
    let (done, newest) = moved(vec![write("7", 409, conflict()), step("GET", GET_JOB, 200, at(5, "five", "9"))]).await;
    assert!(done.is_ok() && newest == five);
    // another operator went on
    let (done, newest) = moved(vec![write("7", 409, conflict()), step("GET", GET_JOB, 200, at(5, "other", "9"))]).await;
    assert!(matches!(done, Err(JobError::Owned(_))), "{done:?}");
    assert_eq!(newest, Some((4, "four".to_owned())));
    let (done, _) = moved(vec![write("7", 404, not_found())]).await;
    assert!(matches!(done, Err(JobError::Owned(_))), "{done:?}");
}
