//! Workers of another version than their operator, as an upgrade leaves them while a job runs.

use rayherd_herd::job::PICTURE;
use rayherd_herd::remote::{Answer, Poll, Stage};
use serde_json::{Value, json};

use super::life::{Bench, deleted, made, pod};
use super::*;

/// A frame that is rendered.
fn stage() -> Stage {
    let camera = json!({"origin": [0, 0, 0], "corner": [-1, -1, 1], "right": [1, 0, 0], "down": [0, 1, 0]});
    let frame = json!({"camera": camera, "size": [2, 2], "filter": "Box", "seed": 0, "max_depth": 2, "rr_depth": 2, "split": 1});
    let scene = json!({"hash": "0".repeat(64), "bytes": 1});
    let stage = json!({"id": "s", "scene": scene, "frame": frame, "prefix": "jobs/u-1/0", "strategy": "Auto", "memory": null,
        "replicas": 1, "near": true, "buckets": 1});
    serde_json::from_value(stage).unwrap()
}

/// What a worker of a pod says that makes this picture.
fn poll(number: u32, pod: &str, picture: u32) -> Poll {
    let worker = json!({"number": number, "session": format!("{pod}-1")});
    let poll = json!({"worker": worker, "home": null, "stage": null, "clerk": false, "picture": picture});
    serde_json::from_value(poll).unwrap()
}

/// A pod of this image.
fn of(image: &str, number: u32) -> Value {
    let mut pod = pod(number, json!([]));
    pod["spec"]["containers"][0]["image"] = json!(image);
    pod
}

#[tokio::test]
async fn workers_that_make_another_picture_make_room_for_some_of_the_operators_image() {
    let mut bench = Bench::begun(job()).await;
    let running = bench.running();
    running.lock().scene = Some("0123".into());
    running.fleet.open(stage(), vec![], 0);
    let asks = |number, pod: &str, picture| running.fleet.answer(&poll(number, pod, picture)).unwrap();
    // both came up before the upgrade; of one the version makes the same picture, so it stays
    assert_eq!(asks(0, "box-w0", PICTURE - 1), Answer::Wait);
    assert!(matches!(asks(1, "box-w1", PICTURE), Answer::Open { .. }));
    let steps = vec![
        step("GET", PODS, 200, list(vec![of("worker:0", 0), of("worker:0", 1)])),
        deleted("box-w0"),
        step("PATCH", STATUS, 200, bench.job.clone()).with("/status/workers", json!("2/2")),
        event("Normal", "Prepared"),
    ];
    bench.step(steps).await.0.unwrap();
    // while it ends, which may take long, another takes its place
    let mut ending = of("worker:0", 0);
    ending["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
    let steps = vec![
        step("GET", PODS, 200, list(vec![ending, of("worker:0", 1)])),
        made("box-w0-1", "p-8").with("/spec/containers/0/image", json!("worker:1")),
    ];
    bench.step(steps).await.0.unwrap();
    assert_eq!(running.lock().pods.get("p-8"), Some(&0), "its token counts");
    assert!(matches!(asks(0, "box-w0-1", PICTURE), Answer::Open { .. }));
    let mut next = of("worker:1", 0);
    (next["metadata"]["name"], next["metadata"]["uid"]) = (json!("box-w0-1"), json!("p-8"));
    // one that would be made of the same image again is left alone, and gets nothing to do
    assert_eq!(asks(1, "box-w1", PICTURE + 1), Answer::Wait);
    let pods = list(vec![next, of("worker:1", 1)]);
    bench.step(vec![step("GET", PODS, 200, pods)]).await.0.unwrap();
    assert_eq!(running.fleet.unfit(), [1]);
}
