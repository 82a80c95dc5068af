//! Work that is handed out and reported, by hand.

use super::*;

/// As a link does that is cut for less than a worker is silent for.
#[test]
fn work_whose_answer_was_lost_on_its_way_is_given_out_again() {
    let fleet = Fleet::new(1, "e");
    let worker = WorkerId { number: 0, session: "s".into() };
    let poll = Poll {
        worker: worker.clone(),
        home: None,
        stage: None,
        clerk: true,
        bands: true,
        aovs: true,
        builds: false,
        holds: None,
    };
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
        let report = |id: &str| Report {
            worker: worker.clone(),
            id: id.to_owned(),
            result: Ok(done.clone()),
            cpu: 0.0,
            bytes: Vec::new(),
            reads: Default::default(),
            holds: None,
            cache_failures: 0,
            resident: 0,
        };
        assert!(!fleet.report(report(&first)).unwrap(), "it is another's now");
        assert!(fleet.report(report(&second)).unwrap());
        assert_eq!(call.join().unwrap().unwrap(), done);
    });
}
