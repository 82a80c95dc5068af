use super::super::conformance::conformance;
use super::super::{FaultPlan, Faulty, MemoryStore};
use super::*;

struct Cluster {
    nodes: Vec<Arc<Faulty>>,
    store: Arc<Replicated>,
    counters: Counters,
}

/// Bodies say which key they are of, so that a damaged one is known.
fn body_of(key: &str) -> Bytes {
    format!("{key} {key} {key}").into()
}

fn cluster(nodes: usize, copies: usize, plan: FaultPlan) -> Cluster {
    let node = |seed| Arc::new(Faulty::new(Arc::new(MemoryStore::new()), FaultPlan { seed, ..plan }));
    let nodes: Vec<Arc<Faulty>> = (0..nodes as u64).map(node).collect();
    let verify: Verify =
        Arc::new(|key, body| if body == body_of(key) { Ok(()) } else { Err("not its body".to_owned()) });
    let stores = nodes.iter().map(|n| n.clone() as Arc<dyn BlockStore>).collect();
    let store = Arc::new(Replicated::new(stores, copies, Some(verify)).unwrap());
    Cluster { nodes, store, counters: Counters::new() }
}

impl Cluster {
    fn view(&self, node: usize) -> NodeView {
        self.store.view(Some(node), Some((self.counters.clone(), Stage::Trace)))
    }

    async fn good_copies(&self, key: &str) -> Vec<usize> {
        let got = join_all(self.nodes.iter().map(|n| n.get(key))).await;
        let good = |(i, got): (usize, Result<Bytes, _>)| got.is_ok_and(|b| b == body_of(key)).then_some(i);
        got.into_iter().enumerate().filter_map(good).collect()
    }

    fn bytes(&self, op: Op, place: Place) -> u64 {
        self.counters.sums().sum(|_, o, _, p| o == op && p == place)
    }
}

#[tokio::test]
async fn conforms() {
    for (nodes, copies) in [(1, 1), (3, 1), (3, 2), (3, 3)] {
        let stores = (0..nodes).map(|_| Arc::new(MemoryStore::new()) as Arc<dyn BlockStore>).collect();
        let store = Arc::new(Replicated::new(stores, copies, None).unwrap());
        conformance(&store.view(Some(0), None)).await;
        conformance(&store.view(None, None)).await;
        assert_eq!(store.counts(), ReplicationCounts::default());
    }
}

#[tokio::test]
async fn conforms_with_a_node_gone() {
    let stores: Vec<Arc<Faulty>> =
        (0..3).map(|_| Arc::new(Faulty::new(Arc::new(MemoryStore::new()), FaultPlan::default()))).collect();
    stores[1].lose();
    let nodes = stores.iter().map(|n| n.clone() as Arc<dyn BlockStore>).collect();
    let store = Arc::new(Replicated::new(nodes, 2, None).unwrap());
    // what is not found now may be on the lost node, so only the parts that need no such answer hold
    let view = store.view(Some(0), None);
    view.put("a/b", Bytes::from_static(b"x")).await.unwrap();
    assert_eq!(view.get("a/b").await.unwrap(), "x");
    assert_eq!(view.list("a").await.unwrap(), [("a/b".to_owned(), 1)]);
    assert!(matches!(view.get("a/c").await, Err(StoreError::Unavailable { .. })));
    view.delete(&["a/b".to_owned()]).await.unwrap();
    assert_eq!(store.counts().undeleted, 1);
}

#[tokio::test]
async fn acknowledges_only_when_enough_nodes_did() {
    let c = cluster(3, 2, FaultPlan::default());
    c.nodes[0].lose();
    c.view(0).put("k", body_of("k")).await.unwrap();
    assert_eq!(c.good_copies("k").await, [1, 2]);
    assert_eq!(c.store.counts().elsewhere, 1);
    c.nodes[1].lose();
    let error = c.view(0).put("l", body_of("l")).await.unwrap_err();
    assert!(matches!(&error, StoreError::Unavailable { .. }), "{error}");
    assert!(error.to_string().contains("1 of 2 copies"), "{error}");
    assert!(c.view(2).list("").await.is_err(), "R nodes are silent: what they hold is not known");
}

#[tokio::test]
async fn writes_at_home_reads_at_home_and_counts_the_rest_as_remote() {
    let c = cluster(4, 2, FaultPlan::default());
    let size = body_of("k").len() as u64;
    c.view(3).put("k", body_of("k")).await.unwrap();
    let holders = c.store.holders("k").await.unwrap();
    assert!(holders.len() == 2 && holders[0] == 3, "{holders:?}");
    assert_eq!((c.bytes(Op::Write, Place::Local), c.bytes(Op::Write, Place::Remote)), (size, size));
    c.view(3).get("k").await.unwrap();
    c.view(holders[1]).get("k").await.unwrap();
    assert_eq!((c.bytes(Op::Read, Place::Local), c.bytes(Op::Read, Place::Remote)), (2 * size, 0));
    let other = (0..4).find(|n| !holders.contains(n)).unwrap();
    c.view(other).get("k").await.unwrap();
    assert_eq!(c.bytes(Op::Read, Place::Remote), size);
    c.view(0).put_on(&[2, 1], "l", body_of("l")).await.unwrap();
    assert_eq!(c.store.holders("l").await.unwrap(), [2, 1]);
}

#[tokio::test]
async fn a_bad_copy_is_read_elsewhere_and_written_again() {
    let c = cluster(3, 2, FaultPlan::default());
    for key in ["corrupt", "gone"] {
        c.view(0).put(key, body_of(key)).await.unwrap();
    }
    c.nodes[0].damage("corrupt").await.unwrap();
    c.nodes[0].delete(&["gone".to_owned()]).await.unwrap();
    for key in ["corrupt", "gone"] {
        assert_eq!(c.view(0).get(key).await.unwrap(), body_of(key));
        let copies = c.good_copies(key).await;
        assert!(copies.len() == 2 && copies[0] == 0, "{copies:?}");
    }
    let counts = ReplicationCounts { corrupt: 1, missing: 1, rewritten: 2, ..Default::default() };
    assert_eq!(c.store.counts(), counts);
    // all copies bad: said so, not handed out
    c.nodes.iter().for_each(|n| assert!(!n.is_lost()));
    for node in c.good_copies("corrupt").await {
        c.nodes[node].damage("corrupt").await.unwrap();
    }
    assert!(matches!(c.view(0).get("corrupt").await, Err(StoreError::Corrupt { .. })));
}

#[tokio::test]
async fn a_lost_disk_is_filled_again() {
    let c = cluster(4, 2, FaultPlan::default());
    let keys: Vec<String> = (0..40).map(|i| format!("geometry/{i}")).collect();
    for key in &keys {
        c.store.view(None, None).put(key, body_of(key)).await.unwrap();
    }
    let held = join_all(keys.iter().map(|k| c.store.holders(k))).await;
    let lost: u64 = held.iter().filter(|h| h.as_ref().unwrap().contains(&1)).count() as u64;
    assert!((10..=30).contains(&lost), "rendezvous spreads: {lost} of 40 on one of four nodes with two copies");
    c.nodes[1].lose();
    for key in &keys {
        assert_eq!(c.view(1).get(key).await.unwrap(), body_of(key), "while the node is gone");
    }
    c.nodes[1].restore(Some(Arc::new(MemoryStore::new())));
    c.store.forget_node(1);
    let mut written = 0;
    for key in &keys {
        written += c.store.restore(key).await.unwrap();
        assert_eq!(c.good_copies(key).await.len(), 2, "{key}");
    }
    assert_eq!(written, lost);
}

/// Any schedule of refusals, lost replies and damage that leaves one good copy gives the right bytes.
#[tokio::test]
async fn random_faults_never_show() {
    for seed in 0..40 {
        let plan = FaultPlan {
            seed: seed * 1000,
            unavailable: 100,
            lost_reply: 100,
            corrupt: 100,
            most_per_key: 2,
            ..FaultPlan::default()
        };
        let c = cluster(5, 3, plan);
        for i in 0..10 {
            let key = format!("k{i}");
            while c.view(i % 5).put(&key, body_of(&key)).await.is_err() {}
            if i % 3 == 0 {
                let holder = c.store.holders(&key).await.unwrap()[0];
                // the node may refuse that as well
                let _ = c.nodes[holder].damage(&key).await;
            }
        }
        for i in 0..10 {
            let key = format!("k{i}");
            // each node refuses or garbles a key at most twice
            let got = join_all(
                (0..5).map(|n| c.store.view(Some(n), None)).map(|v| async move { v.get(&format!("k{i}")).await }),
            );
            for body in got.await.into_iter().flatten() {
                assert_eq!(body, body_of(&key), "seed {seed}");
            }
            let mut tries = 0;
            while c.view(0).get(&key).await.is_err() {
                tries += 1;
                assert!(tries < 20, "seed {seed}, {key}");
            }
        }
    }
}
