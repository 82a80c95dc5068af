//! Reconciling against a mock API server: each request is asserted, and silence too.

use std::sync::Arc;
use std::time::Duration;

use futures::channel::mpsc;
use hyper::{Request, Response};
use kube::Client;
use kube::client::Body;
use kube::runtime::controller::Action;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::store::s3_server::{BUCKET, S3Server};
use serde_json::{Value, json};
use tower::Layer;
use tower_test::mock::{self, Handle as Mock};

use crate::config::Config;
use crate::metrics::Metrics;
use crate::reconcile::{Context, FINALIZER, Seen, reconcile};

mod jobs;
mod ledger;
mod life;
mod pods;
mod versions;

/// One request that must come, and its answer.
pub struct Step {
    method: &'static str,
    path: &'static str,
    /// What must be in the query.
    query: Vec<&'static str>,
    /// What must be in the body, by JSON pointer.
    body: Vec<(&'static str, Value)>,
    status: u16,
    answer: Value,
}

pub fn step(method: &'static str, path: &'static str, status: u16, answer: Value) -> Step {
    Step { method, path, query: vec![], body: vec![], status, answer }
}

impl Step {
    fn with(mut self, pointer: &'static str, value: Value) -> Self {
        self.body.push((pointer, value));
        self
    }
    fn asks(mut self, query: &'static str) -> Self {
        self.query.push(query);
        self
    }
}

pub type Server = Mock<Request<Body>, Response<Body>>;

/// Answers these requests in their order, and sees that no other comes. What each said is handed back.
pub async fn serve(mut server: Server, steps: Vec<Step>) -> Vec<Value> {
    serve_on(&mut server, steps).await
}

/// The same, after which the server can be asked for more.
pub async fn serve_on(server: &mut Server, steps: Vec<Step>) -> Vec<Value> {
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
        let query = parts.uri.query().unwrap_or_default();
        step.query.iter().for_each(|q| assert!(query.split('&').any(|p| p == *q), "{asked}: {q}"));
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
    (Arc::new(Context::new(Client::new(service, "default"), config, metrics, mpsc::unbounded().0)), server)
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

pub fn conflict() -> Value {
    json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "reason": "Conflict", "code": 409, "message": "old"})
}

fn no_pods() -> Value {
    list(vec![])
}

fn list(pods: Vec<Value>) -> Value {
    json!({"kind": "PodList", "apiVersion": "v1", "metadata": {}, "items": pods})
}

/// An event is published.
fn event(kind: &'static str, reason: &'static str) -> Step {
    let path = "/apis/events.k8s.io/v1/namespaces/studio/events?";
    step("POST", path, 201, json!({"metadata": {}, "eventTime": null}))
        .with("/type", json!(kind))
        .with("/reason", json!(reason))
        .with("/regarding/uid", json!("u-1"))
}

/// Where a pod says which nodes it is drawn to.
const PREFERRED: &str = "/spec/affinity/nodeAffinity/preferredDuringSchedulingIgnoredDuringExecution";
const GET_JOB: &str = "/apis/rayherd.io/v1alpha1/namespaces/studio/renderjobs/box";
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

/// The same of a job whose servers are these, each on a node of its own: node1 and so on.
fn begins_on(servers: &[S3Server], pods: Value) -> Vec<Step> {
    let endpoint =
        |(i, s): (usize, &S3Server)| format!("{{url: '{}', node: node{}}}", s.settings("").endpoint.unwrap(), i + 1);
    let endpoints: Vec<String> = servers.iter().enumerate().map(endpoint).collect();
    let mut steps = begins(pods);
    steps[0].answer["data"] =
        json!({"profile.yaml": format!("bucket: {BUCKET}\nendpoints: [{}]", endpoints.join(", "))});
    // test-key, test-secret
    steps[1].answer["data"] = json!({"AWS_ACCESS_KEY_ID": "dGVzdC1rZXk=", "AWS_SECRET_ACCESS_KEY": "dGVzdC1zZWNyZXQ="});
    steps
}
