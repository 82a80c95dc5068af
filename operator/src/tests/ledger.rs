//! The ledger's pointers in the status.

use rayherd_herd::job::JobError;
use rayherd_herd::remote::Depot;
use rayherd_herd::store::{BlockStore, MemoryStore};
use serde_json::{Value, json};
use tokio::runtime::Handle;

use super::*;
use crate::ledger::{Beside, Ledger};

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
