//! The pods of a job that runs, made and made anew.

use k8s_openapi::jiff::{SignedDuration, Timestamp};
use kube::runtime::controller::Action;
use serde_json::{Value, json};

use super::life::{Bench, made};
use super::*;

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

#[tokio::test]
async fn the_first_worker_comes_up_beside_the_source() {
    let servers = [S3Server::start().await, S3Server::start().await];
    servers[1].put_raw("scenes/box/box.xml", b"<scene version='3.0.0'/>");
    let pod = json!({"metadata": {"name": "box-w0", "uid": "p-0", "labels": {"rayherd.io/worker": "0"}}});
    let mut steps = begins_on(&servers, no_pods());
    steps.extend([
        step("PATCH", "/api/v1/namespaces/studio/pods/box-w0?", 201, pod)
            .with("/metadata/labels/rayherd.io~1placed", json!("false")),
        step("PATCH", STATUS, 200, job()).with("/status/phase", json!("Pending")),
    ]);
    let (done, said, context) = scenario(&job(), steps).await;
    assert_ne!(done.unwrap(), Action::await_change());
    let terms = said[4].pointer(PREFERRED).and_then(Value::as_array).expect("node affinity").clone();
    assert_eq!(terms.len(), 1, "{terms:?}");
    assert_eq!(terms[0].pointer("/preference/matchExpressions/0/values"), Some(&json!(["node2"])));
    context.jobs.get("u-1").expect("it runs").fleet.cancel("the test is over");
}

#[tokio::test]
async fn waiting_for_where_the_scene_lies_is_no_latency_of_the_operator() {
    const SOUGHT_FOR: Duration = Duration::from_secs(1);
    let mut bench = Bench::begun(job()).await;
    let running = bench.running();
    {
        let mut state = running.lock();
        // as if it began in an hour: it waits until somebody says where
        (state.started, state.source) = (Some(Timestamp::now() + SignedDuration::from_hours(1)), None);
    }
    let seconds = bench.context.metrics.reconcile_seconds.clone();
    let (count, sum) = (seconds.get_sample_count(), seconds.get_sample_sum());
    let found = async {
        tokio::time::sleep(SOUGHT_FOR).await;
        assert_eq!(seconds.get_sample_count(), count, "it does not wait");
        running.lock().source = Some(Default::default());
    };
    let steps = vec![step("GET", PODS, 200, no_pods()), made("box-w0", "p-9")];
    let began = std::time::Instant::now();
    let ((done, _), ()) = tokio::join!(bench.step(steps), found);
    let took = began.elapsed();
    assert_ne!(done.unwrap(), Action::await_change());
    assert_eq!(seconds.get_sample_count(), count + 1);
    // however slow the machine: what was waited for, all of that time but for the requests before it, is not in it
    assert!(seconds.get_sample_sum() - sum <= (took - SOUGHT_FOR / 2).as_secs_f64());
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
