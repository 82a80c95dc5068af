//! Work that is handed out and reported, by hand.

use std::collections::BTreeMap;

use super::*;
use crate::ledger::TaskId;
use crate::local::attempt::Attempt;
use crate::local::slots::StopFlag;
use crate::plan::Set;
use crate::remote::message::WorkerId;
use crate::remote::tests::{gone, poll};

fn report(worker: &WorkerId, id: &str, result: Result<Done, Failure>) -> Report {
    Report {
        worker: worker.clone(),
        id: id.to_owned(),
        result,
        cpu: 0.0,
        bytes: Vec::new(),
        reads: Default::default(),
        holds: None,
        cache_failures: 0,
        resident: 0,
    }
}

fn given(answer: Answer) -> Option<(String, Work)> {
    match answer {
        Answer::Work { id, work } => Some((id, *work)),
        _ => None,
    }
}

/// Both are planned anew, but only what was begun is counted as lost.
#[test]
fn attempts_that_a_dead_worker_had_begun_are_lost_and_those_that_it_had_not_are_none() {
    let fleet = Fleet::new(1, "e");
    let launch = |task| {
        let attempt = Attempt { name: "a".into(), node: 0, set: Set::Reduce, groups: Vec::new(), camera: Vec::new() };
        fleet.launch(Launch { task: TaskId(task), number: 0, attempt, stop: StopFlag::default() });
    };
    // planned for a worker that went before it was told
    launch(0);
    let poll = poll(0, "s");
    assert_eq!(fleet.answer(&poll), Ok(Answer::Wait));
    (1..6).for_each(launch);
    let begun: Vec<String> = (0..3).filter_map(|_| Some(given(fleet.answer(&poll).unwrap())?.0)).collect();
    assert_eq!(begun.len(), 3);
    // one is given back in time
    assert_eq!(fleet.report(report(&poll.worker, &begun[1], Err(Failure::Stopped))), Ok(true));
    gone(&fleet, 0, "s");
    let mut back = Vec::new();
    while let Some(event) = fleet.next(Duration::ZERO).unwrap() {
        if let Event::Finished(finished) = event {
            assert!(matches!(finished.result, Err(JobError::Stopped)));
            back.push(finished.task.0);
        }
    }
    back.sort_unstable();
    assert_eq!(back, [0, 1, 2, 3, 4, 5], "all are planned anew");
    assert_eq!(fleet.tally().outcomes, BTreeMap::from([(Outcome::Gone, 2), (Outcome::Stopped, 1)]));
}

/// Whatever comes of it: nobody waits, nothing is tried again, and only a clerk of a version that knows how is asked.
#[test]
fn a_preview_is_made_by_a_clerk_at_most_once_and_keeps_nobody() {
    let fleet = Fleet::new(1, "e");
    let slot = poll(0, "s");
    let clerk = Poll { clerk: true, ..slot.clone() };
    let old = Poll { previews: false, ..clerk.clone() };
    let work = Work::Preview { parts: Vec::new(), spp: 1.into(), key: "k".into(), exposure: 0.0 };
    let answer = |poll: &Poll| given(fleet.answer(poll).unwrap());
    assert!(!fleet.wants_preview(Duration::ZERO), "nobody asks");
    fleet.show(true);
    for end in ["fails", "is killed for lack of memory", "goes"] {
        assert!(fleet.wants_preview(Duration::ZERO));
        fleet.preview(work.clone());
        assert!(!fleet.wants_preview(Duration::ZERO), "one waits");
        assert_eq!((answer(&slot), answer(&old)), (None, None));
        let (id, taken) = answer(&clerk).unwrap();
        assert_eq!(taken, work);
        assert!(!fleet.wants_preview(Duration::ZERO), "one is made");
        match end {
            "fails" => {
                let failed = Err(Failure::ForNow { message: "no".into() });
                assert_eq!(fleet.report(report(&slot.worker, &id, failed)), Ok(true));
            }
            "goes" => gone(&fleet, slot.worker.number, &slot.worker.session),
            _ => fleet.killed_for_memory(0, None),
        }
        assert_eq!(answer(&clerk), None, "{end}: it is not tried again");
        assert!(fleet.wants_preview(Duration::ZERO) && !fleet.wants_preview(Duration::from_secs(3600)), "{end}");
    }
    fleet.check().unwrap();
    assert_eq!(fleet.tally().outcomes, BTreeMap::new());
    // at the end of the job whoever makes one is told to stop
    fleet.preview(work);
    let (id, _) = answer(&clerk).unwrap();
    let beat = Beat { worker: slot.worker.clone(), running: vec![id.clone()] };
    assert_eq!(fleet.beat(&beat), Ok(Vec::new()));
    assert!(fleet.end_previews(Duration::ZERO));
    assert_eq!(fleet.beat(&beat), Ok(vec![id]));
}

/// As a link does that is cut for less than a worker is silent for.
#[test]
fn work_whose_answer_was_lost_on_its_way_is_given_out_again() {
    let fleet = Fleet::new(1, "e");
    let poll = Poll { clerk: true, ..poll(0, "s") };
    let worker = &poll.worker;
    let given = || loop {
        if let Answer::Work { id, .. } = fleet.answer(&poll).unwrap() {
            return id;
        }
        std::thread::yield_now();
    };
    std::thread::scope(|scope| {
        let call = scope.spawn(|| fleet.call(Work::Restore { gone: 0 }));
        let first = given();
        let beat = |running: &[String]| Beat { worker: worker.clone(), running: running.to_vec() };
        assert!(!fleet.lock().take_back(&beat(std::slice::from_ref(&first)), Duration::ZERO), "it is being done");
        assert!(!fleet.lock().take_back(&beat(&[]), UNHEARD), "the answer may be on its way");
        assert!(fleet.lock().take_back(&beat(&[]), Duration::ZERO));
        let second = given();
        let done = Done::Restored { copies: 1, few: 0 };
        let report = |id: &str| report(worker, id, Ok(done.clone()));
        assert!(!fleet.report(report(&first)).unwrap(), "it is another's now");
        assert!(fleet.report(report(&second)).unwrap());
        assert_eq!(call.join().unwrap().unwrap(), done);
    });
}

fn merged(rel_mse: Option<f64>) -> Done {
    Done::Merged { film: None, rel_mse, error: None, tiles: vec![], non_finite: vec![], picture: vec![] }
}

#[test]
fn a_worker_that_comes_back_under_another_session_loses_only_its_tasks() {
    let fleet = Fleet::new(1, "e");
    let poll = |session: &str| poll(0, session);
    assert_eq!(fleet.answer(&poll("a")), Ok(Answer::Wait));
    assert!(fleet.answer(&crate::remote::tests::poll(1, "a")).is_err());
    std::thread::scope(|scope| {
        let work = Work::Merge { name: None, parts: vec![], spp: 1.into(), picture: None, band: None, tiles: false };
        let call = scope.spawn(|| fleet.call(work));
        let handed = |session: &str| {
            let since = Instant::now();
            loop {
                match fleet.answer(&poll(session)).unwrap() {
                    Answer::Work { id, .. } => return id,
                    _ => assert!(since.elapsed() < Duration::from_secs(60)),
                }
                std::thread::sleep(Duration::from_millis(1));
            }
        };
        let first = handed("a");
        let second = handed("b");
        assert_ne!(first, second);
        let report = |session: &str, id: &str, rel_mse| Report {
            worker: WorkerId { number: 0, session: session.into() },
            id: id.into(),
            result: Ok(merged(rel_mse)),
            cpu: 0.5,
            bytes: vec![],
            reads: Default::default(),
            holds: None,
            cache_failures: 0,
            resident: 5,
        };
        assert_eq!(fleet.report(report("b", &first, Some(1.0))), Ok(false), "its id is known no more");
        assert_eq!(fleet.report(report("b", "other-0", Some(2.0))), Ok(false));
        let beat = Beat { worker: poll("b").worker, running: vec![first.clone(), second.clone()] };
        assert_eq!(fleet.beat(&beat), Ok(vec![first]));
        assert_eq!((fleet.tally().running, fleet.tally().queued), (1, 0));
        // the one before still goes on, and costs its successor nothing
        assert_eq!(fleet.report(report("a", &second, Some(5.0))), Ok(false), "another session's");
        let beat = Beat { worker: poll("a").worker, running: vec![second.clone()] };
        assert_eq!(fleet.beat(&beat), Ok(vec![second.clone()]), "it need not go on");
        assert_eq!((fleet.tally().running, fleet.tally().queued), (1, 0));
        assert_eq!(fleet.report(report("b", &second, Some(3.0))), Ok(true));
        assert_eq!(fleet.report(report("b", &second, Some(4.0))), Ok(false), "a replay");
        let tally = fleet.tally();
        assert_eq!(tally.by_worker.get(&0), Some(&WorkerTally { cpu: 0.5, resident: 5 }), "counted once");
        assert_eq!((tally.cpu, tally.running, tally.queued), (0.5, 0, 0));
        let done = call.join().unwrap().unwrap();
        assert!(matches!(done, Done::Merged { rel_mse: Some(x), .. } if x == 3.0));
    });
    assert_eq!(fleet.tally().outcomes, Default::default(), "there was no attempt");
    // the loop over rounds learns that the one that came back holds nothing
    let told = fleet.next(Duration::ZERO).unwrap();
    assert!(matches!(told, Some(Event::MemoryLost(0))) && fleet.next(Duration::ZERO).unwrap().is_none());
}

#[test]
fn workers_that_wait_are_sent_to_the_next_fleet_at_once() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let fleet = Fleet::new(1, "e");
    let poll = poll(0, "a");
    // far longer than a test may take
    let waits = runtime.block_on(async {
        let waiting = fleet.poll(&poll, Duration::from_secs(3600));
        let retire = async {
            tokio::time::sleep(Duration::from_millis(20)).await;
            fleet.retire();
        };
        futures::future::join(waiting, retire).await.0
    });
    assert_eq!(waits, Ok(Answer::Wait));
}

/// A pod that is gone has a connection left, on which it asked for work: it gets none, and takes nothing from the pod that comes after it.
#[test]
fn who_waited_while_it_was_replaced_has_nothing_and_costs_nothing() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    for replaced in [true, false] {
        let fleet = Fleet::new(1, "e");
        let (old, new) = (poll(0, "old"), poll(0, "new"));
        let launch = |task| {
            let attempt =
                Attempt { name: "a".into(), node: 0, set: Set::Reduce, groups: Vec::new(), camera: Vec::new() };
            fleet.launch(Launch { task: TaskId(task), number: 0, attempt, stop: StopFlag::default() });
        };
        let meanwhile = async {
            tokio::task::yield_now().await;
            if replaced {
                assert_eq!(fleet.answer(&new), Ok(Answer::Wait));
            } else {
                gone(&fleet, 0, "old");
            }
            launch(1);
        };
        // far longer than a test may take
        let waiting = fleet.poll(&old, Duration::from_secs(3600));
        let (answer, ()) = runtime.block_on(futures::future::join(waiting, meanwhile));
        assert_eq!(answer, Ok(Answer::Wait));
        assert_eq!(fleet.tally().outcomes, BTreeMap::new(), "no attempt was begun");
        assert_eq!(given(fleet.answer(&new).unwrap()).is_some(), replaced);
    }
}

/// Another attempt has done the task, and what this one read was deleted: no work is lost.
#[test]
fn an_attempt_that_was_beaten_and_finds_its_input_gone_is_none_that_is_lost() {
    for (beaten, outcome) in [(false, Outcome::Lost), (true, Outcome::Stopped)] {
        let fleet = Fleet::new(1, "e");
        let poll = poll(0, "s");
        assert_eq!(fleet.answer(&poll), Ok(Answer::Wait));
        let attempt = Attempt { name: "a".into(), node: 0, set: Set::Reduce, groups: Vec::new(), camera: Vec::new() };
        let stop = StopFlag::default();
        fleet.launch(Launch { task: TaskId(0), number: 0, attempt, stop: stop.clone() });
        let (id, _) = given(fleet.answer(&poll).unwrap()).unwrap();
        if beaten {
            stop.set();
        }
        let lost = Err(Failure::Lost { name: "g".into(), why: "gone".into() });
        assert_eq!(fleet.report(report(&poll.worker, &id, lost)), Ok(true));
        assert_eq!(fleet.tally().outcomes, BTreeMap::from([(outcome, 1)]));
    }
}
