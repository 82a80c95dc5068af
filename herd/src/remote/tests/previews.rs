//! Pictures of a film that is not finished.

use super::super::Work;
use super::super::frames::preview_key;
use super::super::message::Done;
use super::*;
use crate::job::{Progress, Status};

/// Notes which previews are asked for and made, and lets a job go on after some attempts only when there was one.
struct Sees<'a> {
    wire: &'a Wire<'a>,
    cluster: &'a Cluster,
    handed: AtomicU32,
    attempts: AtomicU32,
    /// What lay in the first and the last store after each.
    seen: Mutex<Vec<[Vec<u8>; 2]>>,
    waits: bool,
}

impl Link for Sees<'_> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        let answer = self.wire.poll(poll)?;
        if matches!(&answer, Answer::Work { work, .. } if matches!(**work, Work::Preview { .. })) {
            assert!(poll.clerk);
            self.handed.fetch_add(1, Ordering::Relaxed);
        }
        Ok(answer)
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        match &report.result {
            Ok(Done::Previewed) => {
                let of = |store: usize| {
                    let key = preview_key("jobs/1");
                    self.cluster.runtime.block_on(self.cluster.stores[store].get(&key)).map(|b| b.to_vec())
                };
                // one that is asked for by hand lies elsewhere
                if let (Ok(first), Ok(last)) = (of(0), of(2)) {
                    self.seen.lock().unwrap().push([first, last]);
                }
            }
            Ok(Done::Made { .. }) if self.attempts.fetch_add(1, Ordering::Relaxed) >= 12 && self.waits => {
                wait_for(|| !self.seen.lock().unwrap().is_empty());
            }
            _ => {}
        }
        self.wire.report(report)
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.wire.beat(beat)
    }
}

/// Workers end whatever became of the test.
struct Ends<'a>(&'a Fleet);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

/// Looks as often as it may.
struct Watches<'a>(&'a Fleet);

impl Progress for Watches<'_> {
    fn status(&self, _: &Status) {}
    fn wants_preview(&self) -> bool {
        self.0.wants_preview(Duration::ZERO)
    }
}

#[test]
fn a_job_is_seen_while_it_runs_if_somebody_asks_and_nothing_of_that_stays() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.task_seconds = Some(0.003);
    spec.image.exposure = Some(0.5);
    let (want, shown, _) = local_files(&spec);
    for asked in [true, false] {
        let (cluster, kept) = (Cluster { band: 1, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let (fleet, depot) = (Fleet::new(3, "e"), cluster.depot(None));
        let wire = cluster.wire(&fleet);
        let [handed, attempts] = [AtomicU32::new(0), AtomicU32::new(0)];
        let link = Sees { wire: &wire, cluster: &cluster, handed, attempts, seen: Mutex::default(), waits: asked };
        fleet.show(asked);
        std::thread::scope(|scope| {
            let _ends = Ends(&fleet);
            for number in 0..3 {
                let worker = WorkerId { number, session: "s".into() };
                let scratch = cluster.scratch.path().to_owned();
                let station = Station::new(&link, cluster.depot(Some(number)), 1, worker, scratch).unwrap();
                scope.spawn(move || station.run().unwrap());
            }
            let keeper: Arc<dyn Keeper> = kept.clone();
            let result = run(&cluster.job(&spec, &depot, &fleet, "e"), &keeper, &Watches(&fleet));
            for store in &cluster.stores {
                let left = cluster.runtime.block_on(store.list(&preview_key("jobs/1"))).unwrap();
                assert_eq!(left, [], "asked: {asked}");
            }
            if asked && result.is_ok() {
                // of the finished film it is the PNG
                let part = cluster.depot(None).part("jobs/1/0", 2).unwrap();
                let records = cluster.runtime.block_on(journal::read(&part)).unwrap();
                let last = records.values().max_by_key(|r| r.sequence).and_then(|r| r.snapshot.clone()).unwrap();
                let (key, exposure) = ("by-hand.png".to_owned(), 0.5);
                fleet.preview(Work::Preview { parts: last.film, spp: 6.into(), key: key.clone(), exposure });
                let get = || cluster.runtime.block_on(cluster.stores[1].get(&key));
                wait_for(|| get().is_ok());
                assert_eq!(texels(&get().unwrap()), texels(&shown));
            }
            result.unwrap();
        });
        assert!(cluster.picture(1) == want, "asked: {asked}");
        let (handed, seen) = (link.handed.into_inner(), link.seen.into_inner().unwrap());
        assert_eq!((handed > 0, !seen.is_empty()), (asked, asked));
        for [first, last] in seen {
            assert_eq!(texels(&first).len(), texels(&shown).len());
            assert_eq!(texels(&last).len(), texels(&shown).len());
        }
        assert_eq!(kept.reports.lock().unwrap()[0].tasks_redone, 0);
    }
}
