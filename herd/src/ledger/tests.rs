use proptest::prelude::*;

use super::*;

fn group(key: &str, split: u32, rays: u32) -> GroupRef {
    GroupRef { key: key.to_owned(), to: Destination::Split(split), rays, bytes: 40 * u64::from(rays), holders: vec![0] }
}

fn unit(tile: u32, first: u32, end: u32) -> CameraUnit {
    CameraUnit { tile, first, end }
}

fn camera(units: &[CameraUnit]) -> Inputs {
    Inputs { groups: vec![], camera: units.to_vec() }
}

fn commit(ledger: &mut Ledger, id: TaskId, made: Outputs) -> (String, Record) {
    let record = ledger.record(id, made).unwrap();
    let name = format!("r{}-{}", record.sequence, id.0);
    ledger.commit(id, &record, name.clone()).unwrap();
    (name, record)
}

#[test]
fn a_task_counts_once_whatever_its_attempts_do() {
    let mut ledger = Ledger::new("image", 2);
    let (id, _) = ledger.start(&camera(&[unit(0, 0, 4)])).unwrap();
    assert_eq!(ledger.start(&camera(&[unit(1, 0, 4), unit(0, 3, 5)])), Err(Refused::NotFree(unit(0, 3, 5))));
    assert!(ledger.start(&camera(&[unit(1, 0, 4)])).is_ok(), "the refused start gave its tile back");
    let second = ledger.again(id).unwrap();
    let made = Outputs { groups: vec![group("a", 3, 10)], ..Outputs::default() };
    let record = ledger.record(id, made.clone()).unwrap();
    ledger.commit(id, &record, "x".into()).unwrap();
    assert_eq!(ledger.commit(id, &record, "x".into()), Err(Refused::NotRunning(id)));
    assert!(!ledger.lost(id, second));
    assert_eq!((ledger.attempts_lost(), ledger.commits(), ledger.waiting().count()), (1, 1, 1));
    assert_eq!(ledger.done().complete(), 0);
}

#[test]
fn inputs_of_a_lost_task_wait_again() {
    let mut ledger = Ledger::new("image", 1);
    let (id, _) = ledger.start(&camera(&[unit(0, 0, 1)])).unwrap();
    commit(&mut ledger, id, Outputs { groups: vec![group("a", 0, 5), group("b", 1, 6)], ..Outputs::default() });
    let both = Inputs { groups: vec!["a".into(), "b".into()], camera: vec![unit(0, 1, 4)] };
    let (id, groups) = ledger.start(&both).unwrap();
    assert_eq!(groups.len(), 2);
    let second = ledger.again(id).unwrap();
    assert!(!ledger.lost(id, 0));
    assert!(!ledger.lost(id, 0), "lost once only");
    assert!(ledger.lost(id, second));
    assert_eq!((ledger.waiting().count(), ledger.attempts_lost()), (2, 2));
    assert!(ledger.start(&both).is_ok());
    let twice = Inputs { groups: vec!["a".into(), "a".into()], camera: vec![] };
    assert!(matches!(ledger.start(&twice), Err(Refused::NotWaiting(_))));
}

#[test]
fn the_newest_complete_chain_wins_and_forks_are_named() {
    let record = |sequence, parent: &str| Record {
        image: "image".into(),
        sequence,
        parent: parent.into(),
        took: Inputs::default(),
        made: Outputs::default(),
        snapshot: None,
    };
    let mut all = BTreeMap::from([
        ("a".to_owned(), record(0, "image")),
        ("b".to_owned(), record(1, "a")),
        ("c".to_owned(), record(1, "a")),
        ("d".to_owned(), record(2, "c")),
        ("z".to_owned(), record(4, "lost")),
    ]);
    let chain = newest("image", all.clone()).unwrap();
    assert_eq!(chain.records.iter().map(|r| r.0.as_str()).collect::<Vec<_>>(), ["a", "c", "d"]);
    assert_eq!(chain.forks, [Fork { parent: "a".into(), children: vec!["c".into(), "b".into()] }]);
    assert!(matches!(newest("other", all.clone()), Err(ChainError::OtherImage { .. })));
    all.remove("a");
    assert!(matches!(newest("image", all), Err(ChainError::Incomplete { records: 4, .. })));
    assert_eq!(newest("image", BTreeMap::new()).unwrap(), Chain::default());
}

/// One thing that may happen to a ledger.
#[derive(Clone, Debug)]
enum Event {
    StartCamera(u32),
    StartGroups(usize),
    Again(usize),
    Lost(usize, u32),
    Commit(usize, usize),
    Stale(usize),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        (0u32..4).prop_map(Event::StartCamera),
        (1usize..4).prop_map(Event::StartGroups),
        any::<usize>().prop_map(Event::Again),
        (any::<usize>(), 0u32..3).prop_map(|(t, a)| Event::Lost(t, a)),
        (any::<usize>(), 0usize..4).prop_map(|(t, n)| Event::Commit(t, n)),
        any::<usize>().prop_map(Event::Stale),
    ]
}

proptest! {
    /// Whatever happens in whatever order: each group and each sample is consumed at most once, and replaying the
    /// records (from the start or from any snapshot) gives the state without its running tasks.
    #[test]
    fn any_order_of_events_counts_once(events in prop::collection::vec(event(), 1..80)) {
        let mut ledger = Ledger::new("image", 4);
        let mut next_sample = [0u32; 4];
        let mut started: Vec<TaskId> = Vec::new();
        let mut finished: BTreeSet<TaskId> = BTreeSet::new();
        let mut records: Vec<(String, Record)> = Vec::new();
        let mut keys = 0;
        for event in events {
            let pick = |i: usize| started.get(i % started.len().max(1)).copied();
            match event {
                Event::StartCamera(tile) => {
                    let first = next_sample[tile as usize];
                    if let Ok((id, _)) = ledger.start(&camera(&[unit(tile, first, first + 2)])) {
                        next_sample[tile as usize] += 2;
                        started.push(id);
                    }
                }
                Event::StartGroups(n) => {
                    let groups: Vec<String> = ledger.waiting().take(n).map(|g| g.key.clone()).collect();
                    if !groups.is_empty() {
                        started.push(ledger.start(&Inputs { groups, camera: vec![] }).unwrap().0);
                    }
                }
                Event::Again(i) => if let Some(id) = pick(i) {
                    prop_assert_eq!(ledger.again(id).is_ok(), !finished.contains(&id));
                },
                Event::Lost(i, attempt) => if let Some(id) = pick(i)
                    && ledger.lost(id, attempt) {
                    prop_assert!(finished.insert(id));
                },
                Event::Commit(i, n) => if let Some(id) = pick(i) {
                    let groups = (0..n).map(|k| group(&format!("g{}", keys + k), k as u32, 7)).collect();
                    keys += n;
                    match ledger.record(id, Outputs { groups, ..Outputs::default() }) {
                        Ok(record) => {
                            let name = format!("r{}", record.sequence);
                            ledger.commit(id, &record, name.clone()).unwrap();
                            records.push((name, record));
                            prop_assert!(finished.insert(id));
                            if ledger.sequence % 4 == 3 {
                                let record = ledger.record_of(ledger.snapshot(Vec::new()));
                                let name = format!("r{}", record.sequence);
                                ledger.follow_snapshot(&record, name.clone()).unwrap();
                                records.push((name, record));
                            }
                        }
                        Err(e) => prop_assert_eq!((e, finished.contains(&id)), (Refused::NotRunning(id), true)),
                    }
                },
                Event::Stale(i) => if let Some((name, record)) = records.get(i % records.len().max(1))
                    && let Some(id) = started.iter().find(|t| !finished.contains(t)) {
                    // a record that is not the next one never commits a task
                    if record.sequence < ledger.sequence {
                        prop_assert!(ledger.clone().commit(*id, record, name.clone()).is_err());
                    }
                },
            }
        }
        let consumed: Vec<&String> = records.iter().flat_map(|r| &r.1.took.groups).collect();
        prop_assert_eq!(consumed.iter().collect::<BTreeSet<_>>().len(), consumed.len());
        let mut samples = Done::none(4);
        for unit in records.iter().flat_map(|r| &r.1.took.camera) {
            prop_assert!(samples.add(*unit));
        }
        let live: Vec<TaskId> = ledger.running.keys().copied().collect();
        for id in live {
            for attempt in 0..ledger.running[&id].attempts {
                if ledger.lost(id, attempt) { break; }
            }
        }
        prop_assert_eq!(&samples, ledger.done());
        prop_assert_eq!(ledger.taken(), ledger.done());
        for skip in [0, records.len() / 2] {
            let from = records.iter().skip(skip).position(|r| r.1.snapshot.is_some()).map_or(0, |p| p + skip);
            let mut again = Ledger::new("image", 4);
            let scope = Scope { tiles: 4, pixels: None, splits: Some(("cut".into(), 8)) };
            for (number, (name, record)) in records[from..].iter().enumerate() {
                if let (Some(snapshot), true) = (&record.snapshot, number > 0) {
                    prop_assert!(again.is_as(snapshot), "a snapshot is of the state before it");
                }
                // what was written by the rules is believed
                scope.replay(&mut again, record, name.clone()).unwrap();
            }
            prop_assert_eq!(&again.waiting, &ledger.waiting);
            prop_assert_eq!((&again.done, &again.taken, &again.head), (&ledger.done, &ledger.taken, &ledger.head));
            prop_assert_eq!((again.sequence, again.commits), (ledger.sequence, ledger.commits));
        }
    }
}

#[test]
fn going_back_gives_up_what_came_after() {
    let mut ledger = Ledger::new("image", 1);
    let (id, _) = ledger.start(&camera(&[unit(0, 0, 1)])).unwrap();
    let before = ledger.snapshot(Vec::new());
    assert!(ledger.is_settled());
    commit(&mut ledger, id, Outputs { groups: vec![group("a", 0, 5)], ..Outputs::default() });
    assert!(!ledger.is_settled() && ledger.relocate("a", vec![3]) && !ledger.relocate("b", vec![]));
    let (running, groups) = ledger.start(&Inputs { groups: vec!["a".into()], camera: vec![] }).unwrap();
    assert_eq!(groups[0].holders, [3]);
    let record = ledger.record_of(before);
    ledger.go_back(&record, "back".into()).unwrap();
    assert!(ledger.is_quiet() && !ledger.lost(running, 0));
    assert_eq!((ledger.commits(), ledger.attempts_lost(), ledger.done().complete()), (0, 1, 0));
    assert!(ledger.start(&camera(&[unit(0, 0, 1)])).is_ok(), "its camera rays are free again");
}

/// A chain of four records: camera rays, their groups, a snapshot, and what consumes one of the groups.
fn chain() -> (Scope, Vec<(String, Record)>) {
    let scope = Scope { tiles: 2, pixels: Some(vec![100, 50]), splits: Some(("cut".into(), 8)) };
    let mut ledger = Ledger::new("image", 2);
    let mut records = Vec::new();
    let rays = |camera: u64| RayCounts { camera, closest: 2 * camera + 7, shadow: 3, merged: 0 };
    let film = |key: &str| FilmRef { key: key.into(), band: None, bytes: 10, holders: vec![0, 1] };
    let group = |key: &str, to| GroupRef { key: key.into(), ..group("", to, 7) };
    let (id, _) = ledger.start(&camera(&[unit(0, 0, 2), unit(1, 0, 1)])).unwrap();
    let groups = vec![group("rays/cut-a", 3), group("rays/cut-b", 7)];
    let made = Outputs { groups, film: vec![film("film/a")], rays: rays(250), non_finite: 1 };
    records.push(commit(&mut ledger, id, made));
    let record = ledger.record_of(ledger.snapshot(vec![film("film/s")]));
    ledger.follow_snapshot(&record, "s".into()).unwrap();
    records.push(("s".into(), record));
    let (id, _) = ledger.start(&Inputs { groups: vec!["rays/cut-a".into()], camera: vec![unit(0, 2, 3)] }).unwrap();
    let made = Outputs { groups: vec![group("rays/cut-c", 0)], film: vec![], rays: rays(100), non_finite: 0 };
    records.push(commit(&mut ledger, id, made));
    (scope, records)
}

fn follow(scope: &Scope, records: &[(String, Record)]) -> Result<Ledger, Refused> {
    let mut ledger = Ledger::new("image", scope.tiles);
    records.iter().try_for_each(|(name, record)| scope.replay(&mut ledger, record, name.clone()))?;
    Ok(ledger)
}

#[test]
fn a_record_that_cannot_be_is_named_and_refused() {
    let (scope, records) = chain();
    assert_eq!(follow(&scope, &records).unwrap().commits(), 2);
    assert_eq!(follow(&scope, &records[1..]).unwrap().commits(), 2);
    type Wrong = (usize, &'static str, fn(&mut Record));
    fn snapshot(r: &mut Record) -> &mut Snapshot {
        r.snapshot.as_mut().expect("the second one is a snapshot")
    }
    let wrong: [Wrong; 24] = [
        (0, "tile 2", |r| r.took.camera[1].tile = 2),
        (0, "samples 2..2", |r| r.took.camera[0].first = 2),
        (0, "samples 0..", |r| r.took.camera[0].end = u32::MAX),
        (0, "a second time", |r| {
            r.took.camera.push(unit(0, 1, 2));
            r.made.rays.camera += 100;
        }),
        (0, "250 were made", |r| r.made.rays.camera = 249),
        (0, "camera rays", |r| r.made.rays.closest = 10),
        (0, "names rays/cut-a twice", |r| r.made.groups[1].key = "rays/cut-a".into()),
        (0, "waits for split 8 of 8", |r| r.made.groups[1].to = Destination::Split(8)),
        (0, "0 rays", |r| r.made.groups[0].rays = 0),
        (0, "0 bytes", |r| r.made.groups[0].bytes = 0),
        (0, "lies on nodes [2, 2]", |r| r.made.groups[0].holders = vec![2, 2]),
        (0, "film/a has no bytes", |r| r.made.film[0].bytes = 0),
        (0, "another image", |r| r.image = "other".into()),
        (1, "film tiles", |r| snapshot(r).done = Done::none(3)),
        (1, "9 commits", |r| snapshot(r).commits = 9),
        (1, "250 were made", |r| snapshot(r).rays.camera += 1),
        (1, "twice", |r| {
            let again = snapshot(r).waiting[0].clone();
            snapshot(r).waiting.push(again);
        }),
        (1, "no sample was made", |r| {
            snapshot(r).done = Done::none(2);
            snapshot(r).rays = RayCounts::default();
        }),
        (1, "consumes or makes something", |r| r.took.groups.push("rays/cut-a".into())),
        (2, "rays/cut-x, which does not wait", |r| r.took.groups[0] = "rays/cut-x".into()),
        (2, "twice", |r| r.took.groups.push("rays/cut-a".into())),
        (2, "there already", |r| r.made.groups[0].key = "rays/cut-b".into()),
        (2, "more rays than", |r| r.made.rays.shadow = u64::MAX),
        (2, "consumes nothing", |r| r.took = Inputs::default()),
    ];
    for (at, says, change) in wrong {
        let mut records = records.clone();
        change(&mut records[at].1);
        let error = follow(&scope, &records).expect_err(says).to_string();
        assert!(error.contains(says) && error.contains(&record_key(at as u64, &records[at].0)), "{says}: {error}");
    }
    // of another cut, the split's number says nothing here
    let mut other = records;
    other[0].1.made.groups[1] = GroupRef { key: "rays/old-b".into(), ..group("", 99, 7) };
    assert!(follow(&scope, &other[..1]).is_ok_and(|l| l.waiting().any(|g| !is_of_cut(g, "cut"))));
}

/// Records of earlier versions name one part of the film or none, and those of small films are still written so.
#[test]
fn film_is_named_as_it_was_before_there_were_bands() {
    let (_, records) = chain();
    let text = serde_json::to_value(&records[0].1).unwrap();
    let old = serde_json::json!({"key": "film/a", "bytes": 10, "holders": [0, 1]});
    assert_eq!((&text["made"]["film"], &text["snapshot"]), (&old, &serde_json::Value::Null));
    assert_eq!(serde_json::to_value(&records[2].1).unwrap()["made"]["film"], serde_json::Value::Null);
    for (_, mut record) in records {
        let one = record.made.film.clone();
        record.made.film.extend(one.into_iter().map(|f| FilmRef { band: Some(7), ..f }));
        let back: Record = serde_json::from_str(&serde_json::to_string(&record).unwrap()).unwrap();
        assert_eq!(back, record);
    }
}

proptest! {
    /// What is sound is what adding its ranges one by one gives.
    #[test]
    fn done_is_sound_when_adding_makes_it(ranges in prop::collection::vec((0u32..30, 0u32..30), 0..5), end in 20u32..40) {
        let read: Done = serde_json::from_value(serde_json::json!([ranges])).unwrap();
        let mut made = Done::none(1);
        let all = ranges.iter().all(|&(a, b)| b <= end && made.add(unit(0, a, b)));
        prop_assert_eq!(read.is_sound(end), all && made == read);
        if read.is_sound(end) {
            prop_assert_eq!(read.samples(0), ranges.iter().map(|r| r.1 - r.0).sum::<u32>());
        }
    }

    /// From whichever place a chain can be begun, the same state is reached.
    #[test]
    fn a_chain_reaches_as_far_back_as_it_can(lost in prop::collection::btree_set(0u64..12, 0..4), snapshots in prop::collection::btree_set(0u64..12, 0..5)) {
        let state = Ledger::new("image", 1).snapshot(Vec::new());
        let record = |n: u64| Record {
            image: "image".into(),
            sequence: n,
            parent: if n == 0 { "image".into() } else { (n - 1).to_string() },
            took: Inputs::default(),
            made: Outputs::default(),
            snapshot: snapshots.contains(&n).then(|| state.clone()),
        };
        let all: BTreeMap<String, Record> =
            (0..12).filter(|n| !lost.contains(n)).map(|n| (n.to_string(), record(n))).collect();
        // the plain twin: each tip from the highest down, each beginning from the lowest up
        let whole = |from: u64, to: u64| (from..=to).all(|n| !lost.contains(&n));
        let begins = |n: u64| n == 0 || snapshots.contains(&n);
        let mut spans = (0..12).rev().flat_map(|to| (0..=to).map(move |from| (from, to)));
        let naive = spans.find(|&(from, to)| begins(from) && whole(from, to));
        match newest("image", all) {
            Ok(chain) => {
                let places: Vec<u64> = chain.records.iter().map(|r| r.1.sequence).collect();
                let (from, to) = naive.unwrap();
                prop_assert_eq!(places, (from..=to).collect::<Vec<_>>());
                let starts: Vec<u64> = chain.starts().into_iter().map(|i| from + i as u64).collect();
                prop_assert_eq!(starts, (from..=to).rev().filter(|&n| begins(n)).collect::<Vec<_>>());
            }
            Err(e) => prop_assert!(naive.is_none() && matches!(e, ChainError::Incomplete { .. }), "{}", e),
        }
    }
}
