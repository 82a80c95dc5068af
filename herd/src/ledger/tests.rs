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
                                let record = ledger.record_of(ledger.snapshot(None));
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
            for (name, record) in &records[from..] {
                again.replay(record, name.clone()).unwrap();
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
    let before = ledger.snapshot(None);
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
