//! Workers with a cache of their own, and all data on an S3 server that is on no node.

use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::ObjectStore;

use super::*;
use crate::driver::Launch;
use crate::ledger::TaskId;
use crate::local::attempt::Attempt;
use crate::local::nodes::placement;
use crate::local::slots::StopFlag;
use crate::plan::Set;
use crate::remote::Work;
use crate::remote::message::{Done, Holds, Stage};
use crate::report::{Kind, Op, Place};
use crate::store::s3_server::S3Server;
use crate::store::{Copies, S3Store, SceneObjects};
use crate::wave::CameraUnit;

/// A server, and a cluster whose only store it is.
fn external() -> (S3Server, Cluster) {
    let cluster = Cluster::new(1);
    let server = cluster.runtime.block_on(S3Server::start());
    let cluster = Cluster { stores: client(&server), ..cluster };
    cluster.runtime.block_on(cluster.stores[0].put(SOURCE, CORNELL.clone().into())).unwrap();
    cluster.runtime.block_on(cluster.stores[0].put(TEXTURE, wall().into())).unwrap();
    (server, cluster)
}

fn client(server: &S3Server) -> Vec<Arc<Faulty>> {
    let store = Arc::new(S3Store::new(server.settings("")).unwrap());
    vec![Arc::new(Faulty::new(store, FaultPlan::default()))]
}

/// A worker with a client of its own, as in a pod: connections live on the threads of the worker that made them.
fn worker<'l>(server: &S3Server, cluster: &Cluster, link: &'l Wire<'l>, number: u32) -> Station<'l> {
    let id = WorkerId { number, session: "s".into() };
    Station::new(link, depot(&client(server), None), 1, id, cluster.scratch.path().to_owned()).unwrap()
}

/// Scene bytes that a report counts at a place.
fn read(report: &report::Report, place: Place) -> u64 {
    let scene = |k: Kind| matches!(k, Kind::Geometry | Kind::Attributes | Kind::Texture);
    let rows = report.bytes.iter().filter(|r| r.op == Op::Read && r.place == place && scene(r.kind));
    rows.map(|r| r.bytes).sum()
}

/// Two pictures of one scene by two workers with a memory of one split; what each picture's report says, and the fleet's failures.
fn two_pictures(
    (server, cluster): (&S3Server, &Cluster),
    spec: &RenderJobSpec,
    cache: &dyn Fn() -> Option<Copies>,
) -> (Vec<report::Report>, u64) {
    let (fleet, depot, kept) = (Fleet::new(2, "e"), cluster.depot(None), Arc::new(Kept::default()));
    let wire = cluster.wire(&fleet);
    std::thread::scope(|scope| {
        for number in 0..2 {
            let mut station = worker(server, cluster, &wire, number);
            if let Some(copies) = cache() {
                station = station.caching(copies);
            }
            scope.spawn(move || station.run().unwrap());
        }
        let keeper: Arc<dyn Keeper> = kept.clone();
        let pictures = vec!["out/a.exr".into(), "out/b.exr".into()];
        let job = Job { pictures, slots: vec![1; 2], ..cluster.job(spec, &depot, &fleet, "e") };
        let result = run(&job, &keeper, &Silent);
        fleet.end();
        result.unwrap();
    });
    (kept.reports.lock().unwrap().clone(), fleet.tally().cache_failures)
}

#[test]
fn a_cache_of_any_size_or_none_changes_no_byte_and_a_large_one_reads_all_once() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 1);
    spec.workers.memory = Some("2000".parse().unwrap());
    spec.image.size = Some("16x12".parse().unwrap());
    spec.sampling.spp = Some(4);
    spec.task_seconds = Some(0.05);
    let want = expected(&spec);
    let folder = tempfile::tempdir().unwrap();
    let not_a_folder = folder.path().join("file");
    std::fs::write(&not_a_folder, "in the way").unwrap();
    let number = AtomicU32::new(0);
    let fresh = || folder.path().join(number.fetch_add(1, Ordering::Relaxed).to_string());
    let mut reads = BTreeMap::new();
    for case in ["none", "tiny", "small", "large", "full", "unwritable"] {
        let (server, cluster) = external();
        let cache = || match case {
            "none" => None,
            "tiny" => Some(Copies::in_folder(&fresh(), 1)),
            "small" => Some(Copies::in_folder(&fresh(), 4 * 4096)),
            "large" => Some(Copies::in_folder(&fresh(), 1 << 30)),
            "full" => Some(Copies::new(Arc::new(MemoryStore::with_limit(3000)), 1 << 30)),
            _ => Some(Copies::in_folder(&not_a_folder, 1 << 30)),
        };
        let (reports, failures) = two_pictures((&server, &cluster), &spec, &cache);
        for name in ["out/a.exr", "out/b.exr"] {
            assert!(cluster.runtime.block_on(cluster.stores[0].get(name)).unwrap() == want, "{case}: {name}");
        }
        let [near, far] = [Place::Local, Place::Remote].map(|p| reports.iter().map(|r| read(r, p)).sum::<u64>());
        let objects = server.reads("objects/");
        println!("{case}: {near} bytes near, {far} far, {failures} failures, {} reads", objects.values().sum::<u64>());
        assert!(far > 0 && (near > 0) == matches!(case, "small" | "large" | "full"), "{case}: {near} near, {far} far");
        assert_eq!(failures > 0, matches!(case, "full" | "unwritable"), "{case}: {failures}");
        assert!(case != "unwritable" || failures == 2, "once for each worker: {failures}");
        if case == "large" {
            // by each worker once, and once more by the operator: manifest and world
            assert!(objects.values().all(|&n| n <= 3), "{objects:?}");
        }
        reads.insert(case, far);
    }
    assert!(2 * reads["large"] < reads["none"], "{reads:?}");
}

/// Ends a fleet, so that its workers go, also where a test fails.
struct Ending<'a>(&'a Fleet);

impl Drop for Ending<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

/// A fleet whose workers have a stage open, driven by hand.
struct Driven<'a> {
    fleet: &'a Fleet,
    next: u64,
}

impl Driven<'_> {
    /// Each of these workers traces a few camera rays with these splits in memory.
    fn round(&mut self, work: &[(u32, u32)]) {
        for &(node, split) in work {
            let camera = vec![CameraUnit { first: 0, end: 1, tile: split % 4 }];
            let name = format!("t{}", self.next);
            let attempt = Attempt { name, node, set: Set::Resident(vec![split]), groups: vec![], camera };
            self.fleet.launch(Launch { task: TaskId(self.next), number: 1, attempt, stop: StopFlag::default() });
            self.next += 1;
        }
        let mut left = work.len();
        let since = Instant::now();
        while left > 0 {
            assert!(since.elapsed() < Duration::from_secs(60), "{left} tasks did not end");
            if let Some(Event::Finished(finished)) = self.fleet.next(Duration::from_millis(50)).unwrap() {
                assert!(finished.result.is_ok(), "{:?}", finished.result.err());
                left -= 1;
            }
        }
    }
}

#[test]
fn what_a_worker_has_cached_makes_it_a_holder_and_is_read_from_s3_no_more() {
    let (server, cluster) = external();
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 1);
    let folder = tempfile::tempdir().unwrap();
    let (fleet, depot) = (Fleet::new(2, "e"), cluster.depot(None));
    let wire = cluster.wire(&fleet);
    std::thread::scope(|scope| {
        let _ending = Ending(&fleet);
        for number in 0..2u32 {
            let copies = Copies::in_folder(&folder.path().join(number.to_string()), 1 << 30);
            let station = worker(&server, &cluster, &wire, number).caching(copies);
            scope.spawn(move || station.run().unwrap());
        }
        let prepare = Work::Prepare { spec: Box::new(spec.clone()), replicas: 1, apart: None, beside: vec![] };
        let Done::Prepared { scene: reference, .. } = fleet.call(prepare).unwrap() else { panic!("not prepared") };
        let store = Arc::new(depot.replicated(1).unwrap());
        let objects: Arc<dyn ObjectStore> =
            Arc::new(SceneObjects::new(store, cluster.runtime.handle().clone()).unwrap());
        let scene = PreparedScene::open(Manifest::load(objects.as_ref(), &reference).unwrap(), objects).unwrap();
        assert!(scene.splits() >= 4);
        let stage = |id: &str, near: bool| Stage {
            id: id.into(),
            scene: reference,
            frame: from_spec::frame(&spec, &scene.manifest, None).unwrap(),
            prefix: format!("jobs/1/{id}"),
            strategy: spec.strategy,
            // of any two splits one must go
            memory: (0..scene.splits()).map(|s| scene.split_bytes(s)).max(),
            replicas: 1,
            near,
            buckets: 2,
            band: BAND,
            exposure: None,
            exr: true,
            profile: false,
        };
        let holders = || -> Vec<Vec<u32>> { fleet.holders().unwrap().into_iter().take(4).collect() };
        // a worker tells what it holds when it asks for more, which is after its result
        let will_hold = |want: [&[u32]; 4]| wait_for(|| holders() == want);
        let begin = |id: &str, near: bool| {
            fleet.open(stage(id, near), placement(&scene, 1, 1), 0);
            wait_for(|| (0..2).all(|n| fleet.is_up(n)));
        };
        begin("first", true);
        assert_eq!(holders(), [[0; 0]; 4], "the server is on no node");
        let (mut driven, own) = (Driven { fleet: &fleet, next: 0 }, [(0, 0), (0, 1), (1, 2), (1, 3)]);
        driven.round(&own);
        will_hold([&[0], &[0], &[1], &[1]]);
        let once = server.reads("objects/");
        let fetched = |bytes: &report::Bytes, at: Place| {
            bytes.sum(|_, o, k, p| o == Op::Read && p == at && matches!(k, Kind::Geometry | Kind::Attributes))
        };
        let first = fleet.tally().bytes;
        assert!(fetched(&first, Place::Remote) > 0 && fetched(&first, Place::Local) == 0);
        driven.round(&own);
        let second = fleet.tally().bytes;
        assert_eq!(server.reads("objects/"), once, "the second round asks S3 for nothing");
        assert_eq!(fetched(&second, Place::Remote), fetched(&first, Place::Remote));
        assert_eq!(fetched(&second, Place::Local), fetched(&first, Place::Remote), "memory had dropped all of it");
        // another one that reads a split holds it too
        driven.round(&[(1, 0)]);
        will_hold([&[0, 1], &[0], &[1], &[1]]);
        assert!(server.reads("objects/") != once);
        // the next frame of the scene: what they hold is known when they have opened it, and neither the scene nor a split is read again
        let before = server.reads("objects/");
        begin("second", true);
        will_hold([&[0, 1], &[0], &[1], &[1]]);
        driven.round(&own);
        assert_eq!(server.reads("objects/"), before);
        // where nobody is to look
        begin("third", false);
        assert_eq!(holders(), [[0; 0]; 4]);
        begin("fourth", true);
        will_hold([&[0, 1], &[0], &[1], &[1]]);
        // a worker that is gone holds nothing, until it asks for work again, which it does at once
        wait_for(|| {
            gone(&fleet, 1, "s");
            holders()[..3] == [vec![0], vec![0], vec![]]
        });
    });
}

#[test]
fn of_what_a_cache_holds_the_latest_word_counts() {
    let fleet = Fleet::new(1, "e");
    let scene = crate::testing::prepared(&crate::testing::cornell(), 4, true);
    let reference = ObjectRef::of(b"any");
    let open = |id: &str| {
        let frame = crate::testing::frame(&scene, [32, 32], 1);
        let stage = Stage {
            id: id.into(),
            scene: reference,
            frame,
            prefix: "p".into(),
            strategy: Strategy::Auto,
            memory: None,
            replicas: 1,
            near: true,
            buckets: 1,
            band: BAND,
            exposure: None,
            exr: true,
            profile: false,
        };
        fleet.open(stage, vec![vec![0]; 4], 0);
    };
    let holds = |version: u64, runs: &[[u32; 2]]| Some(Holds { version, splits: runs.to_vec() });
    let say = |stage: &str, holds: Option<Holds>| {
        fleet.answer(&over(&Poll { stage: Some(stage.into()), holds, ..poll(0, "a") })).unwrap()
    };
    let held = || fleet.holders().unwrap().iter().map(|on| !on.is_empty()).collect::<Vec<_>>();
    open("one");
    say("one", holds(5, &[[1, 2]]));
    assert_eq!(held(), [false, true, true, false]);
    // polls overtake each other
    say("one", holds(3, &[[0, 3]]));
    assert_eq!(held(), [false, true, true, false]);
    say("one", None);
    assert_eq!(held(), [false, true, true, false]);
    say("one", holds(6, &[[3, 900]]));
    assert_eq!(held(), [false, false, false, true]);
    // of another stage nothing counts that was said of the one before
    open("two");
    assert_eq!(held(), [false; 4]);
    assert!(matches!(say("one", holds(7, &[[0, 0]])), Answer::Open { .. }));
    assert_eq!(held(), [false; 4]);
    say("two", holds(7, &[[0, 0]]));
    assert_eq!(held(), [true, false, false, false]);
}
