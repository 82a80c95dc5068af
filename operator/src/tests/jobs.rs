//! Jobs that do not run: bad ones, others', suspended, late, finished, deleted.

use k8s_openapi::jiff::{SignedDuration, Timestamp};
use kube::runtime::controller::Action;
use rayherd_herd::store::{BlockStore, S3Store};
use serde_json::{Value, json};

use super::life::Bench;
use super::*;

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
async fn what_a_deleted_job_wrote_goes_from_its_storage_but_its_pictures() {
    const OTHERS: [&str; 3] = ["jobs/u-10/0/film/a", "objects/ab", "output/studio/box/box.exr"];
    const ITS: [&str; 2] = ["jobs/u-1/0/film/a", "jobs/u-1/preview.png"];
    let mut deleted = job();
    deleted["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    deleted["metadata"]["finalizers"] = json!([FINALIZER]);
    // with keys that the servers do not know nothing can be done there, ever: the job must not stay for that
    for (key, left) in [("dGVzdC1rZXk=", OTHERS.to_vec()), ("b3RoZXI=", [&ITS[..], &OTHERS].concat())] {
        let servers = [S3Server::start().await, S3Server::start().await];
        for server in &servers {
            ITS.iter().chain(&OTHERS).for_each(|key| server.put_raw(key, b"x"));
        }
        let mut found = begins_on(&servers, no_pods());
        found[1].answer["data"]["AWS_ACCESS_KEY_ID"] = json!(key);
        let mut steps = vec![step("GET", PODS, 200, no_pods())];
        steps.extend(found.into_iter().take(2));
        steps.push(step("PATCH", JOB, 200, deleted.clone()).with("/metadata/finalizers", json!([])));
        let (done, ..) = scenario(&deleted, steps).await;
        assert_eq!(done, Ok(Action::await_change()));
        for server in &servers {
            let listed = S3Store::new(server.settings("")).unwrap().list("").await.unwrap();
            let mut keys: Vec<String> = listed.into_iter().map(|(key, _)| key).collect();
            keys.sort();
            let mut left = left.clone();
            left.sort_unstable();
            assert_eq!(keys, left);
        }
    }
}

#[tokio::test]
async fn a_deleted_job_that_lost_its_finalizer_leaves_no_labels() {
    let mut bench = Bench::begun(job()).await;
    let labels = |bench: &Bench| bench.context.metrics.text().unwrap().matches("job=\"box\"").count();
    assert!(labels(&bench) > 0);
    bench.job["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    bench.job["metadata"]["finalizers"] = json!([]);
    let running = bench.running();
    assert_eq!(bench.step(vec![]).await.0, Ok(Action::await_change()));
    assert_eq!(labels(&bench), 0);
    running.fleet.cancel("the test is over");
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
