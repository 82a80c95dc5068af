//! Scenes that one worker cuts and all of them build.

use std::sync::atomic::AtomicBool;

use rayherd_scene::objects::ObjectStore;

use super::super::message::{Done, Failure, ToBuild};
use super::super::{Work, download};
use super::*;
use crate::report::{Kind, Op, Place};

/// The scene as one process prepares it, from the same paths.
fn whole(cluster: &Cluster, spec: &RenderJobSpec) -> (Manifest, MemoryObjects) {
    let folder = cluster.scratch.path().join("source");
    let store = cluster.depot(None).replicated(1).unwrap();
    let source = download(&store, cluster.runtime.handle(), SOURCE, &folder).unwrap();
    let description = import(&source, &from_spec::import_options(spec)).unwrap();
    let records = DescriptionSource::new(&description, StreamOptions::default());
    let (objects, settings) = (MemoryObjects::default(), from_spec::prepare_settings(spec));
    let made = prepare(&description, &records, &settings, &SpoolSettings::default(), &objects, &NoProgress).unwrap();
    std::fs::remove_dir_all(folder).unwrap();
    (made.manifest, objects)
}

/// Checks that the stores hold that scene, so many copies of each block on the stores where it belongs, and nothing else of it.
fn check(cluster: &Cluster, spec: &RenderJobSpec, kept: &Kept, copies: usize) {
    let (wanted, objects) = whole(cluster, spec);
    let reference = kept.prepared.lock().unwrap()[0].0;
    let all = Arc::new(cluster.depot(None).replicated(1).unwrap());
    let all = Arc::new(SceneObjects::new(all, cluster.runtime.handle().clone()).unwrap());
    let mut manifest = Manifest::load(all.as_ref(), &reference).unwrap();
    let lookup = Manifest::lookup_name(&manifest.source, &manifest.settings);
    assert_eq!(all.name(&lookup).unwrap(), Some(reference));
    let keys = |store: &Arc<Faulty>, prefix: &str| -> BTreeSet<String> {
        let listed = cluster.runtime.block_on(store.list(prefix)).unwrap();
        listed.into_iter().map(|(key, _)| key).collect()
    };
    let named = |m: &Manifest| -> BTreeSet<String> { m.objects().map(|o| object_key(&o.hash)).collect() };
    let mut there = BTreeSet::new();
    for store in &cluster.stores {
        assert_eq!(keys(store, "jobs/1/prepare/"), BTreeSet::new(), "what lay in between is gone");
        there.extend(keys(store, "objects/"));
    }
    assert!(there.remove(&object_key(&reference.hash)));
    assert_eq!(there, named(&manifest), "no object but those of the scene");
    let scene = PreparedScene::open(manifest.clone(), all.clone()).unwrap();
    let places = super::super::homes::Homes::of(&scene, cluster.stores.len() as u32, copies as u32);
    for split in scene.owning_order() {
        let entry = &manifest.splits[split as usize];
        let on = &places.splits()[split as usize];
        assert_eq!(on.len(), copies);
        // what several splits name lies where the first of them belongs
        let once = |o: &&ObjectRef| manifest.objects().filter(|other| other == o).count() == 1;
        for object in [&entry.geometry, &entry.attributes].into_iter().filter(once) {
            let body = objects.get(object).unwrap();
            for &store in on {
                let key = object_key(&object.hash);
                let there = cluster.runtime.block_on(cluster.stores[store as usize].get(&key)).unwrap();
                assert!(there == body, "split {split} on store {store}");
            }
        }
    }
    manifest.homes = None;
    assert!(manifest.encode() == wanted.encode(), "byte for byte");
}

/// Notes what is handed out, and holds back who is to build as long as it is closed.
struct Gate<'a> {
    wire: &'a Wire<'a>,
    handed: Mutex<Vec<Work>>,
    closed: AtomicBool,
}

impl Link for Gate<'_> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        let answer = self.wire.poll(poll)?;
        if let Answer::Work { work, .. } = &answer {
            self.handed.lock().unwrap().push((**work).clone());
            while matches!(**work, Work::Build { .. }) && self.closed.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        Ok(answer)
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.wire.report(report)
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.wire.beat(beat)
    }
}

impl Gate<'_> {
    fn count(&self, what: impl Fn(&Work) -> bool) -> usize {
        self.handed.lock().unwrap().iter().filter(|w| what(w)).count()
    }
    fn station<'l>(&'l self, cluster: &Cluster, number: u32, session: &str) -> Station<'l> {
        let worker = WorkerId { number, session: session.into() };
        Station::new(self, cluster.depot(Some(number)), 1, worker, cluster.scratch.path().to_owned()).unwrap()
    }
}

fn is_cut(work: &Work) -> bool {
    matches!(work, Work::Prepare { .. })
}
fn is_build(work: &Work) -> bool {
    matches!(work, Work::Build { .. })
}

#[test]
fn what_all_workers_build_is_what_one_prepares() {
    for (strategy, splits, stores, copies) in [
        (Strategy::SchedulingGridOverlapReduced, 6, 3, 2),
        (Strategy::SchedulingGrid, 5, 2, 1),
        (Strategy::Auto, 9, 6, 2),
    ] {
        let spec = spec(strategy, splits, copies);
        let (cluster, kept) = (Cluster { apart: 2, ..Cluster::new(stores) }, Arc::new(Kept::default()));
        cluster.render(&spec, &kept).unwrap();
        check(&cluster, &spec, &kept, copies as usize);
        assert!(cluster.picture(0) == expected(&spec));
        // and it is found
        let again = Arc::new(Kept::default());
        cluster.render(&spec, &again).unwrap();
        assert_eq!(*again.prepared.lock().unwrap(), [(kept.prepared.lock().unwrap()[0].0, true)]);
    }
}

/// Workers die with the source, with blocks, and all at once, in hand; and the packed primitives of a split are lost.
#[test]
fn workers_that_die_cost_what_they_had_in_hand() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 8, 2);
    for lose in [false, true] {
        let (cluster, kept) = (Cluster { apart: 2, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let (fleet, depot) = (Fleet::new(3, "e"), cluster.depot(None));
        let wire = cluster.wire(&fleet);
        let gate = Gate { wire: &wire, handed: Mutex::default(), closed: true.into() };
        std::thread::scope(|scope| {
            let keeper: Arc<dyn Keeper> = kept.clone();
            let (spec, depot, fleet, cluster, gate) = (&spec, &depot, &fleet, &cluster, &gate);
            let job = scope.spawn(move || {
                let result = run(&cluster.job(spec, depot, fleet, "e"), &keeper, &Silent);
                fleet.end();
                result
            });
            let over = || job.is_finished();
            let dies = |session: &str| {
                let work = Hand(fleet, &over).takes(session).1;
                gone(fleet, 0, session);
                work
            };
            assert!(is_cut(&dies("cuts")));
            let first = Arc::new(gate.station(cluster, 1, "first"));
            let running = first.clone();
            scope.spawn(move || running.run());
            wait_for(|| gate.count(is_build) == 1);
            let Work::Build { splits, prefix, .. } = dies("builds") else { panic!("blocks are built") };
            if lose {
                let key = format!("{prefix}/{}", splits[0].packed.hash);
                cluster
                    .stores
                    .iter()
                    .for_each(|s| cluster.runtime.block_on(s.delete(std::slice::from_ref(&key))).unwrap());
            }
            // nobody is left; one that was only said to be gone might ask for work once more
            first.leave();
            gone(fleet, 1, "first");
            gate.closed.store(false, Ordering::Relaxed);
            for number in 0..3 {
                let station = gate.station(cluster, number, "last");
                scope.spawn(move || station.run().unwrap());
            }
            job.join().unwrap().unwrap();
        });
        assert_eq!(gate.count(is_cut), if lose { 2 } else { 1 }, "a death costs no other's work");
        check(&cluster, &spec, &kept, 2);
        assert!(cluster.picture(1) == expected(&spec));
        let tally = fleet.tally();
        let moved = |op, kind| tally.bytes.sum(|_, o, k, _| o == op && k == kind);
        assert!(moved(Op::Read, Kind::Source) > 0 && moved(Op::Write, Kind::Geometry) > 0 && tally.cpu > 0.0);
        assert!(moved(Op::Write, Kind::Spool) > 0 && moved(Op::Read, Kind::Spool) > 0);
        // two copies of each block, of which the worker beside one wrote it
        let near = tally.bytes.sum(|_, o, k, p| o == Op::Write && k == Kind::Geometry && p == Place::Local);
        assert!(near > 0);
    }
}

/// An operator goes while blocks are built: the next one has them built of the same draft, if it is of the same source and all there.
#[test]
fn an_operator_that_comes_after_the_cut_has_nothing_cut_again() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 8, 2);
    for (what, cuts) in [("nothing", 1), ("a split", 2), ("the draft", 2), ("the source", 2)] {
        let (cluster, kept) = (Cluster { apart: 2, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let mut cut = 0;
        for epoch in ["e1", "e2"] {
            let (fleet, depot) = (Fleet::new(3, epoch), cluster.depot(None));
            let wire = cluster.wire(&fleet);
            let gate = Gate { wire: &wire, handed: Mutex::default(), closed: (epoch == "e1").into() };
            std::thread::scope(|scope| {
                for number in 0..3 {
                    let station = gate.station(&cluster, number, epoch);
                    scope.spawn(move || station.run());
                }
                let keeper: Arc<dyn Keeper> = kept.clone();
                let (spec, depot, fleet, cluster) = (&spec, &depot, &fleet, &cluster);
                let job = scope.spawn(move || {
                    let result = run(&cluster.job(spec, depot, fleet, epoch), &keeper, &Silent);
                    fleet.end();
                    result
                });
                if epoch == "e1" {
                    wait_for(|| gate.count(is_build) > 0);
                    fleet.cancel("stopped by the test");
                    // before the gate opens, or on a busy machine all might be built until the job looks whether it is to go on
                    let ended = job.join().unwrap();
                    gate.closed.store(false, Ordering::Relaxed);
                    assert!(matches!(ended, Err(JobError::Owned(_))));
                } else {
                    job.join().unwrap().unwrap();
                }
            });
            cut += gate.count(is_cut);
            if epoch == "e2" {
                break;
            }
            let lies = cluster.runtime.block_on(cluster.stores[0].list("jobs/1/prepare/")).unwrap();
            assert!(lies.iter().any(|(key, _)| key == "jobs/1/prepare/cut"), "{lies:?}");
            let packed = gate.handed.lock().unwrap().iter().find_map(|w| match w {
                Work::Build { splits, .. } => Some(splits[0].packed),
                _ => None,
            });
            let gone = match what {
                "a split" => format!("jobs/1/prepare/{}", packed.unwrap().hash),
                "the draft" => {
                    let cut = cluster.runtime.block_on(cluster.stores[0].get("jobs/1/prepare/cut")).unwrap();
                    let cut: serde_json::Value = serde_json::from_slice(&cut).unwrap();
                    let draft: ObjectRef = serde_json::from_value(cut["draft"].clone()).unwrap();
                    format!("jobs/1/prepare/{}", draft.hash)
                }
                "the source" => {
                    let mut other = wall();
                    *other.last_mut().unwrap() ^= 1;
                    cluster.runtime.block_on(cluster.stores[0].put(TEXTURE, other.into())).unwrap();
                    continue;
                }
                _ => continue,
            };
            for store in &cluster.stores {
                cluster.runtime.block_on(store.delete(std::slice::from_ref(&gone))).unwrap();
            }
        }
        assert_eq!(cut, cuts, "{what}");
        // of another source the first tiles lie there still
        if what != "the source" {
            check(&cluster, &spec, &kept, 2);
            assert!(cluster.picture(0) == expected(&spec), "{what}");
        }
    }
}

#[test]
fn a_scene_for_one_worker_and_a_small_one_are_prepared_by_one() {
    let spec = spec(Strategy::Auto, 6, 1);
    for (apart, slots) in [(u64::MAX, vec![1; 3]), (2, vec![2])] {
        let (cluster, kept) = (Cluster { apart, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let (fleet, depot) = (Fleet::new(slots.len() as u32, "e"), cluster.depot(None));
        let wire = cluster.wire(&fleet);
        let gate = Gate { wire: &wire, handed: Mutex::default(), closed: false.into() };
        std::thread::scope(|scope| {
            for number in 0..slots.len() as u32 {
                let station = gate.station(&cluster, number, "s");
                scope.spawn(move || station.run().unwrap());
            }
            let keeper: Arc<dyn Keeper> = kept.clone();
            run(&Job { slots, ..cluster.job(&spec, &depot, &fleet, "e") }, &keeper, &Silent).unwrap();
            fleet.end();
        });
        assert_eq!((gate.count(is_cut), gate.count(is_build)), (1, 0));
        check(&cluster, &spec, &kept, 1);
    }
}

/// One of an earlier version builds none, and prepares all of a scene that it is given.
#[test]
fn a_worker_that_knows_no_blocks_is_given_none_and_others_build_those_of_their_store_first() {
    let fleet = Fleet::new(3, "e");
    let given = |number: u32, home: u32, builds: bool, clerk: bool| {
        let poll = Poll { home: Some(home), clerk, builds, ..poll(number, "a") };
        let mut text = serde_json::to_value(poll).unwrap();
        if !builds {
            text.as_object_mut().unwrap().remove("builds");
        }
        match fleet.answer(&serde_json::from_value(text).unwrap()).unwrap() {
            Answer::Work { work, id } => Some((*work, id)),
            _ => None,
        }
    };
    let build = |store: u32| {
        let packed = ObjectRef::of(&[store as u8]);
        let split = ToBuild { number: store, primitives: 1, packed, on: vec![store] };
        Work::Build { prefix: "p".into(), splits: vec![split], replicas: 1 }
    };
    std::thread::scope(|scope| {
        let call = scope.spawn(|| fleet.call_all((0..3).map(build).collect()));
        let got = std::cell::OnceCell::new();
        wait_for(|| given(1, 1, true, false).is_some_and(|work| got.set(work).is_ok()));
        let (near, id) = got.into_inner().unwrap();
        assert_eq!(near, build(1), "not the first one");
        assert!(given(0, 0, false, false).is_none() && given(2, 2, true, true).is_none(), "nor a clerk");
        assert_eq!(given(2, 9, true, false).unwrap().0, build(0), "who is near none takes the first");
        // one that fails for good ends all
        let worker = WorkerId { number: 1, session: "a".into() };
        let result: Result<Done, Failure> = Err(Failure::ForGood { message: "no tree".into() });
        let (bytes, reads, holds, cpu) = (vec![], Default::default(), None, 0.0);
        let report = Report { worker, id, result, cpu, bytes, reads, holds, cache_failures: 0, resident: 0 };
        // the calls are waited for in their order
        fleet.report(report).unwrap();
        let worker = WorkerId { number: 2, session: "a".into() };
        gone(&fleet, 2, "a");
        let again = given(2, 0, true, false).unwrap();
        assert_eq!(again.0, build(0), "what it had in hand is done by another");
        let blocks = vec![ObjectRef::of(b"block")];
        let report = Report {
            worker,
            id: again.1,
            result: Ok(Done::Built { blocks }),
            cpu: 0.0,
            bytes: vec![],
            reads: Default::default(),
            holds: None,
            cache_failures: 0,
            resident: 0,
        };
        fleet.report(report).unwrap();
        assert!(call.join().unwrap().unwrap_err().to_string().contains("no tree"));
        assert!(given(0, 2, true, false).is_none(), "the rest is given up");
    });
    // an earlier version knows nothing of the way that is asked for
    let text = serde_json::json!({"work": "prepare", "spec": RenderJobSpec::default(), "replicas": 1});
    assert!(matches!(serde_json::from_value(text).unwrap(), Work::Prepare { apart: None, .. }));
}

/// Names that stand for sources, on all stores.
fn sources(cluster: &Cluster) -> BTreeSet<String> {
    let list = |s: &Arc<Faulty>| cluster.runtime.block_on(s.list("names/source-")).unwrap();
    cluster.stores.iter().flat_map(list).map(|(key, _)| key).collect()
}

/// The work that workers of another job get before its first attempt, if it needs any; and how the job ended.
fn job_of(cluster: &Cluster, spec: &RenderJobSpec, number: u32) -> (Vec<Work>, Result<(), JobError>, Arc<Kept>) {
    let kept = Arc::new(Kept::default());
    let (fleet, depot) = (Fleet::new(3, "e"), cluster.depot(None));
    let wire = cluster.wire(&fleet);
    let gate = Gate { wire: &wire, handed: Mutex::default(), closed: false.into() };
    let done = std::thread::scope(|scope| {
        for number in 0..3 {
            let station = gate.station(cluster, number, "s");
            scope.spawn(move || station.run());
        }
        let keeper: Arc<dyn Keeper> = kept.clone();
        let job = Job { prefix: format!("jobs/{number}"), ..cluster.job(spec, &depot, &fleet, "e") };
        let done = run(&job, &keeper, &Silent);
        fleet.end();
        done
    });
    let handed = gate.handed.into_inner().unwrap();
    (handed.into_iter().filter(|w| is_cut(w) || is_build(w)).collect(), done, kept)
}

#[test]
fn a_source_is_known_by_its_listing_until_it_changes_or_something_of_the_scene_is_gone() {
    let spec = spec(Strategy::Auto, 4, 2);
    let cluster = Cluster { apart: 2, ..Cluster::new(3) };
    let put = |store: usize, key: &str, body: &[u8]| {
        cluster.runtime.block_on(cluster.stores[store].put(key, body.to_vec().into())).unwrap();
    };
    let (work, done, first) = job_of(&cluster, &spec, 1);
    done.unwrap();
    assert!(!work.is_empty());
    let reference = first.prepared.lock().unwrap()[0].0;
    assert_eq!(sources(&cluster).len(), 1);
    // the second asks nobody, wherever a copy of the source lies besides
    put(2, TEXTURE, &wall());
    let (work, done, second) = job_of(&cluster, &spec, 2);
    done.unwrap();
    assert!(work.is_empty(), "{work:?}");
    assert_eq!(*second.prepared.lock().unwrap(), [(reference, true)]);
    assert_eq!(sources(&cluster).len(), 1);
    // what decides what is prepared is part of the name; what does not is none
    for (change, asks) in [
        (RenderJobSpec { splits: Some(5), ..spec.clone() }, true),
        (RenderJobSpec { splits: Some(5), replicas: Some(1), ..spec.clone() }, false),
    ] {
        let (work, done, _) = job_of(&cluster, &change, 3);
        done.unwrap();
        assert_eq!(!work.is_empty(), asks, "{work:?}");
    }
    // one texel of one copy: which of the two is meant is nobody's guess, and a worker is asked
    let mut other = wall();
    *other.last_mut().unwrap() ^= 1;
    put(0, TEXTURE, &other);
    let before = sources(&cluster);
    assert!(!job_of(&cluster, &spec, 4).0.is_empty());
    assert_eq!(sources(&cluster), before);
    // in all of them: another source, of the same sizes
    put(2, TEXTURE, &other);
    let (work, done, changed) = job_of(&cluster, &spec, 5);
    done.unwrap();
    assert!(!work.is_empty());
    let changed = changed.prepared.lock().unwrap()[0].0;
    assert_ne!(changed, reference);
    // the first one again
    put(0, TEXTURE, &wall());
    put(2, TEXTURE, &wall());
    let (work, done, _) = job_of(&cluster, &spec, 6);
    done.unwrap();
    assert!(work.is_empty());
    // a block, the manifest, and the whole scene are gone: the name is a promise that nobody relies on
    let all = Arc::new(cluster.depot(None).replicated(1).unwrap());
    let objects = SceneObjects::new(all, cluster.runtime.handle().clone()).unwrap();
    let mut now = reference;
    for what in ["a block", "the manifest", "everything"] {
        let manifest = Manifest::load(&objects, &now).unwrap();
        let gone: Vec<String> = match what {
            "a block" => vec![object_key(&manifest.splits[0].geometry.hash)],
            "the manifest" => vec![object_key(&now.hash)],
            _ => manifest.objects().map(|o| object_key(&o.hash)).collect(),
        };
        cluster.stores.iter().for_each(|s| cluster.runtime.block_on(s.delete(&gone)).unwrap());
        let (work, done, again) = job_of(&cluster, &spec, 7);
        done.unwrap();
        assert!(work.iter().any(is_cut) && work.iter().any(is_build), "{what}, {gone:?}: {work:?}");
        // whoever cuts it chooses its homes, which are part of the manifest: it may have another name now
        let prepared = again.prepared.lock().unwrap()[0];
        assert!(!prepared.1);
        now = prepared.0;
    }
    assert!(cluster.picture(0) == expected(&spec));
}

/// The worker beside the source, whoever came first.
#[test]
fn a_source_is_cut_beside_it_if_a_worker_is_there() {
    let fleet = Fleet::new(2, "e");
    let given = |number: u32, home: u32| {
        let poll = Poll { home: Some(home), ..poll(number, "a") };
        matches!(fleet.answer(&poll).unwrap(), Answer::Work { .. })
    };
    let cut =
        |beside: Vec<u32>| Work::Prepare { spec: Box::new(RenderJobSpec::default()), replicas: 1, apart: None, beside };
    // both are there, and wait
    assert!(!given(0, 0) && !given(1, 1));
    std::thread::scope(|scope| {
        let call = scope.spawn(|| fleet.call_all(vec![cut(vec![1]), cut(vec![7])]));
        // beside none of these is anybody
        wait_for(|| given(0, 0));
        assert!(!given(0, 0), "the other one is beside it");
        gone(&fleet, 1, "a");
        assert!(given(0, 0), "nobody is any more");
        fleet.cancel("enough");
        assert!(call.join().unwrap().is_err());
    });
}
