//! Workers and operators that die, and what lies in the ledger unreadable.

use super::*;

#[test]
fn workers_and_operators_that_go_change_no_byte() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    let want = expected(&spec);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let depot = cluster.depot(None);
    // the operator is stopped after some commits, and a worker with a task in hand leaves before
    let first = Fleet::new(3, "e1");
    let wire = cluster.wire(&first);
    std::thread::scope(|scope| {
        let stations: Vec<Arc<Station>> = (0..3).map(|n| Arc::new(cluster.station(&wire, n, "s1", Some(n)))).collect();
        for station in &stations {
            let station = station.clone();
            scope.spawn(move || station.run().unwrap());
        }
        let keeper: Arc<dyn Keeper> = kept.clone();
        let (spec, depot, first, cluster, kept) = (&spec, &depot, &first, &cluster, &kept);
        let job = scope.spawn(move || run(&cluster.job(spec, depot, first, "e1"), &keeper, &Silent));
        wait_for(|| wire.attempts.load(Ordering::Relaxed) >= 4);
        stations[1].leave();
        wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= 6));
        first.cancel("stopped by the test");
        let stopped = job.join().unwrap();
        assert!(matches!(stopped, Err(JobError::Owned(_))), "{:?}", stopped.err());
        first.end();
    });
    let committed = kept.newest(0).unwrap().unwrap().0;
    assert!(committed >= 6);
    // a record that was written beyond the pointer does not count
    cluster.beside((&spec, &kept, "e2"), |job| job, |_, _| {}).unwrap();
    assert!(cluster.picture(2) == want);
    assert!(kept.reports.lock().unwrap()[0].tasks_reused > 0);
    // each record lies on as many of the stores as there are to be copies
    let mut copies: BTreeMap<String, u32> = BTreeMap::new();
    let records = |key: &String| key.starts_with("jobs/1/0/records/");
    cluster.lies().into_iter().flatten().filter(records).for_each(|key| *copies.entry(key).or_default() += 1);
    assert!(copies.len() > 1 && copies.values().all(|&n| n == 2), "{copies:?}");
}

#[test]
fn an_unreadable_record_or_snapshot_costs_work_and_not_the_job() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.sampling.spp = Some(6);
    spec.task_seconds = Some(0.003);
    let want = expected(&spec);
    let its_film = "the newest snapshot's film";
    for (broken, band) in
        [("the pointer's record", BAND), ("the newest snapshot", 1), (its_film, BAND), (its_film, 1), ("all film", 1)]
    {
        let (cluster, kept) = (Cluster { band, ..Cluster::new(3) }, Arc::new(Kept::default()));
        begun(&cluster, &spec, &kept, 40);
        let part = cluster.depot(None).part("jobs/1/0", 2).unwrap();
        let (sequence, name) = kept.newest(0).unwrap().unwrap();
        let mut records = cluster.runtime.block_on(journal::read(&part)).unwrap();
        records.retain(|n, r| r.sequence < sequence || *n == name);
        let snapshots = records.iter().filter(|r| r.1.snapshot.is_some());
        let (snapshot, record) = snapshots.max_by_key(|r| r.1.sequence).expect("there are snapshots");
        let film = record.snapshot.as_ref().and_then(|s| s.film.first()).map(|f| f.key.as_str());
        let wrong = match broken {
            "the pointer's record" => name.as_str(),
            "the newest snapshot" => snapshot.as_str(),
            "the newest snapshot's film" => film.expect("a snapshot with film"),
            _ => "film/",
        };
        let mut damaged = 0;
        for store in &cluster.stores {
            for (key, _) in cluster.runtime.block_on(store.list("jobs/1/0/")).unwrap() {
                if key.contains(wrong) {
                    cluster.runtime.block_on(store.damage(&key)).unwrap();
                    damaged += 1;
                }
            }
        }
        assert!(damaged > 0, "{broken}");
        if let Err(e) = cluster.render(&spec, &kept) {
            panic!("{broken}: {e}");
        }
        assert!(cluster.picture(1) == want, "{broken}");
        let reports = kept.reports.lock().unwrap();
        // a part of a band may be named by the snapshot before as well: then there is nothing to go on from
        let shared = broken == its_film && band == 1;
        assert!(shared || (reports[0].tasks_reused > 0) == (broken != "all film"), "{broken}: {:?}", reports[0]);
    }
}

/// Runs a job of one worker whose processes are the test's; what came of it.
fn by_hand(
    cluster: &Cluster,
    spec: &RenderJobSpec,
    known: Option<String>,
    kept: &Arc<Kept>,
    hand: impl FnOnce(&Hand, &Wire, &dyn Fn() -> bool),
) -> Result<(), JobError> {
    let (fleet, depot) = (Fleet::new(1, "h"), cluster.depot(None));
    let wire = cluster.wire(&fleet);
    std::thread::scope(|scope| {
        let keeper: Arc<dyn Keeper> = kept.clone();
        let (fleet, depot) = (&fleet, &depot);
        let job = scope.spawn(move || {
            let job = Job { known, slots: vec![1], prefix: "jobs/2".into(), ..cluster.job(spec, depot, fleet, "h") };
            let result = run(&job, &keeper, &Silent);
            fleet.end();
            result
        });
        let over = || job.is_finished();
        hand(&Hand(fleet, &over), &wire, &over);
        job.join().unwrap()
    })
}

#[test]
fn a_task_that_was_killed_for_lack_of_memory_holds_half_and_then_the_job_fails_with_the_sizes() {
    // one worker, and two copies on as many servers
    let mut spec = spec(Strategy::Auto, 6, 2);
    spec.workers.memory = Some("256Ki".parse().unwrap());
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    cluster.render(&spec, &kept).unwrap();
    let scene = kept.prepared.lock().unwrap()[0].0.hash.to_string();
    for deaths in [2, 3] {
        let kept = Arc::new(Kept::default());
        let done = by_hand(&cluster, &spec, Some(scene.clone()), &kept, |hand, wire, over| {
            let mut memories = Vec::new();
            for session in 0..deaths {
                let (memory, work) = hand.takes(&format!("s{session}"));
                assert!(matches!(work, super::super::Work::Attempt { .. }));
                memories.push(memory.unwrap());
                hand.0.killed_for_memory(0, Some("200Mi"));
            }
            assert_eq!(memories, [256 << 10, 128 << 10, 64 << 10][..deaths]);
            if deaths == 2 {
                let station = cluster.station(wire, 0, "at last", Some(0));
                std::thread::scope(|scope| {
                    scope.spawn(|| station.run().unwrap());
                    wait_for(over);
                });
            }
        });
        if deaths == 2 {
            done.unwrap();
            assert!(cluster.picture(0) == expected(&spec), "the memory changes no byte");
        } else {
            let said = done.unwrap_err().to_string();
            for part in [
                "256Ki, then 128Ki, then 64Ki of the scene",
                "may take 200Mi",
                "the largest split takes",
                "limits.memory",
            ] {
                assert!(said.contains(part), "{part}: {said}");
            }
        }
    }
}

#[test]
fn work_that_kills_its_worker_each_time_fails_the_job() {
    let spec = spec(Strategy::Auto, 4, 1);
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    // whoever prepares needs more memory than there is
    let done = by_hand(&cluster, &spec, None, &kept, |hand, _, _| {
        for session in 0..3 {
            let (_, work) = hand.takes(&format!("s{session}"));
            assert!(matches!(work, super::super::Work::Prepare { .. }));
            hand.0.killed_for_memory(0, Some("1Gi"));
        }
    });
    let said = done.unwrap_err().to_string();
    assert!(said.contains("preparing the scene: 3 workers were killed") && said.contains("may take 1Gi"), "{said}");
    // whatever they die of
    cluster.render(&spec, &kept).unwrap();
    cluster.forget_sources();
    let scene = kept.prepared.lock().unwrap()[0].0.hash.to_string();
    for known in [None, Some(scene)] {
        let what = if known.is_some() { "camera rays of tile" } else { "preparing the scene" };
        let kept = Arc::new(Kept::default());
        let done = by_hand(&cluster, &spec, known, &kept, |hand, _, over| {
            for session in 0..5 {
                hand.takes(&format!("s{session}"));
            }
            // the next process finds that the last one died as well
            hand.0.answer(&poll(0, "last")).unwrap();
            wait_for(over);
        });
        let said = done.unwrap_err().to_string();
        assert!(said.contains(what) && said.contains("5 times the worker that had it in hand died"), "{said}");
    }
}

#[test]
fn a_worker_that_leaves_gives_back_the_scene_that_it_prepares_without_waiting_for_it() {
    // never freed: a thread waits for the store for ever
    let cluster: &Cluster = Box::leak(Box::new(Cluster::new(2)));
    let fleet: &Fleet = Box::leak(Box::new(Fleet::new(3, "e")));
    let handed: &AtomicU32 = Box::leak(Box::default());
    // a store hangs once the scene is to be prepared
    let link = Box::leak(Box::new(Tap(cluster.wire(fleet), |wire: &Wire, poll: &Poll| {
        let answer = wire.poll(poll)?;
        if matches!(&answer, Answer::Work { work, .. } if matches!(**work, super::super::Work::Prepare { .. })) {
            cluster.stores[0].hang(true);
            handed.fetch_add(1, Ordering::Relaxed);
        }
        Ok(answer)
    })));
    let spec: &RenderJobSpec = Box::leak(Box::new(spec(Strategy::Auto, 4, 1)));
    let kept = Arc::new(Kept::default());
    let job = std::thread::spawn({
        let keeper: Arc<dyn Keeper> = kept.clone();
        move || run(&cluster.job(spec, &cluster.depot(None), fleet, "e"), &keeper, &Silent)
    });
    // which nobody watches: whoever asks it waits
    let stores = cluster.stores.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect();
    let depot = Depot::new(stores, None).unwrap();
    let worker = WorkerId { number: 0, session: "first".into() };
    let first = Arc::new(Station::new(link, depot, 1, worker, cluster.scratch.path().join("first")).unwrap());
    std::thread::spawn({
        let first = first.clone();
        move || first.run()
    });
    wait_for(|| cluster.stores[0].hung() > 0);
    assert_eq!((handed.load(Ordering::Relaxed), fleet.tally().running, first.is_idle()), (1, 1, false));
    first.leave();
    wait_for(|| first.is_idle());
    assert_eq!((fleet.tally().running, fleet.tally().queued), (0, 1), "told, not found out by its silence");
    cluster.stores[0].hang(false);
    let wire = cluster.wire(fleet);
    std::thread::scope(|scope| {
        let second = cluster.station(&wire, 1, "second", Some(1));
        scope.spawn(move || second.run().unwrap());
        job.join().unwrap().unwrap();
        fleet.end();
    });
    assert!(cluster.picture(1) == expected(spec));
}
