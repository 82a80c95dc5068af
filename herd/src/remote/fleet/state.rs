//! What is known of a job's workers and of what they do.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rayherd_render::film::Samples;

use super::super::deaths::{Deaths, Held, MOST_DEATHS};
use super::super::message::{Beat, Done, Failure, Holds, Poll, Stage, Work, WorkerId};
use super::preview::Preview;
use super::{MOST_FAILURES, Outcome, PATIENCE, SILENCE, Tally, Unknown};
use crate::driver::Finished;
use crate::job::JobError;
use crate::ledger::TaskId;
use crate::local::attempt::Made;
use crate::local::slots::StopFlag;
use crate::report::Bytes;

#[derive(Default)]
pub struct State {
    pub epoch: String,
    pub next: u64,
    pub stage: Option<Stage>,
    /// The stage before memory was taken away from it: its name, and what a worker was to hold of the scene.
    pub whole: (String, Option<u64>),
    /// The least that a worker must hold of the scene: its largest split.
    pub least: u64,
    /// Tasks are to hold less from now on, and whoever plans them does not know yet.
    pub less: bool,
    pub deaths: Deaths,
    /// Why the job cannot be done.
    pub hopeless: Option<String>,
    /// Stores that hold each split.
    pub placement: Vec<Vec<u32>>,
    pub workers: Vec<Option<Worker>>,
    /// For any worker.
    pub common: VecDeque<(u64, Work)>,
    pub doing: BTreeMap<String, Doing>,
    pub finished: VecDeque<Finished>,
    /// Workers that went away since this was told last.
    pub emptied: BTreeSet<u32>,
    pub answers: BTreeMap<u64, Result<Done, Failure>>,
    /// Since the last success.
    pub failures: u32,
    pub failing: Option<Instant>,
    /// What is added up; what is there now is counted by [`super::Fleet::tally`].
    pub tally: Tally,
    /// Splits and texture tiles that somebody has read in this stage.
    pub read: [BTreeSet<u32>; 2],
    pub preview: Preview,
    pub over: bool,
    /// Another fleet has the workers now.
    pub retired: bool,
    pub cancelled: Option<String>,
}

pub struct Worker {
    pub session: String,
    pub home: Option<u32>,
    pub seen: Instant,
    pub ready: VecDeque<(TaskId, u32, Work, StopFlag)>,
    /// It has the current stage open.
    pub open: bool,
    /// It can take a band out of a film part.
    pub bands: bool,
    /// It was told of that it cannot do what the stage asks for.
    pub unfit: bool,
    /// What its cache holds of the current stage's scene.
    pub holds: Holds,
}

impl Worker {
    /// What was told later counts, in whatever order it came.
    pub fn told(&mut self, holds: Option<&Holds>) {
        if let Some(holds) = holds.filter(|h| h.version > self.holds.version) {
            self.holds = holds.clone();
        }
    }
}

pub struct Doing {
    pub worker: u32,
    /// When it was handed out.
    pub since: Instant,
    pub what: What,
    pub held: Held,
}

pub enum What {
    Attempt {
        task: TaskId,
        number: u32,
        stop: StopFlag,
    },
    Call {
        call: u64,
        work: Work,
    },
    /// A picture of the film so far: nobody waits for it, and it is not tried again.
    Preview {
        stop: StopFlag,
    },
}

/// Whether a home is one of these stores.
pub fn is_beside(stores: &[u32], home: Option<u32>) -> bool {
    home.is_some_and(|home| stores.contains(&home))
}

/// Memory that was halved so often, but holds the largest split.
pub fn halved(memory: Option<u64>, level: u32, least: u64) -> Option<u64> {
    memory.map(|m| (m >> level).max(least.min(m)))
}

impl State {
    /// What a worker is to hold of the scene at most, bytes.
    pub fn memory(&self) -> Option<u64> {
        halved(self.whole.1, self.deaths.level(), self.least)
    }

    /// Workers open the stage anew with the memory that is left to them; what none of them has begun goes back.
    pub fn reopen(&mut self) {
        let (memory, level) = (self.memory(), self.deaths.level());
        let id = format!("{}+{level}", self.whole.0);
        if let Some(stage) = &mut self.stage {
            (stage.id, stage.memory) = (id, memory);
        }
        let workers = self.workers.iter_mut().flatten();
        let ready: Vec<_> = workers
            .flat_map(|w| {
                w.open = false;
                std::mem::take(&mut w.ready)
            })
            .collect();
        ready.into_iter().for_each(|(task, number, ..)| self.give_back(task, number));
        self.emptied.clear();
    }

    /// Whether a worker is there beside one of these stores.
    pub fn has_beside(&self, stores: &[u32]) -> bool {
        self.workers.iter().flatten().any(|w| is_beside(stores, w.home))
    }

    /// Which of the common work a worker is given: the first that it can do. Blocks are built in whatever order: those that are to lie on the store
    /// beside it come first.
    pub fn common_for(&self, poll: &Poll) -> Option<usize> {
        let can = |work: &Work| match work {
            Work::Merge { band, spp, tiles, .. } => {
                (poll.bands || band.is_none()) && (poll.tiles || !(*tiles || matches!(spp, Samples::Each(_))))
            }
            // slots alone, so that as many trees are in memory as there are slots
            Work::Build { .. } => poll.builds && !poll.clerk,
            Work::Prepare { beside, .. } => is_beside(beside, poll.home) || !self.has_beside(beside),
            _ => true,
        };
        let is_near = |work: &Work| match work {
            Work::Build { splits, .. } => {
                poll.home.is_some() && splits.first().is_some_and(|s| s.on.first().copied() == poll.home)
            }
            _ => false,
        };
        let mut all = (0..).zip(&self.common).filter(|(_, (_, work))| can(work));
        let (first, (_, work)) = all.next()?;
        if !matches!(work, Work::Build { .. }) || is_near(work) {
            return Some(first);
        }
        Some(all.find(|(_, (_, work))| is_near(work)).map_or(first, |(at, _)| at))
    }

    /// Notes that a worker is there; whether it was not before.
    pub fn meet(&mut self, worker: &WorkerId, home: Option<u32>) -> Result<bool, Unknown> {
        let number = worker.number as usize;
        let known = self.workers.get(number).ok_or(Unknown)?.as_ref();
        let newcomer = known.is_none_or(|w| w.session != worker.session);
        if newcomer {
            self.leave(worker.number);
            if let Some(what) = self.deaths.began(worker.number, &worker.session) {
                self.hopeless = Some(format!(
                    "{what}: {MOST_DEATHS} times the worker that had it in hand died: the pods' last logs (kubectl logs --previous) and \
                     kubectl describe say of what"
                ));
            }
            let (session, seen) = (worker.session.clone(), Instant::now());
            let (ready, holds) = (VecDeque::new(), Holds::default());
            let worker = Worker { session, home, seen, ready, open: false, bands: true, unfit: false, holds };
            self.workers[number] = Some(worker);
        }
        if let Some(w) = &mut self.workers[number] {
            w.seen = Instant::now();
            w.home = home.or(w.home);
        }
        Ok(newcomer)
    }

    /// Whether this one has its number, and is not thought gone.
    pub fn knows(&self, worker: &WorkerId) -> bool {
        self.workers.get(worker.number as usize).and_then(Option::as_ref).is_some_and(|w| w.session == worker.session)
    }

    /// Notes a sign of life; whether it is of the worker that has this number. Only who asks for work takes over the number of another: one that
    /// was thought dead, and was replaced, has nothing to report, and must not cost its successor what it does.
    pub fn hear(&mut self, worker: &WorkerId) -> Result<bool, Unknown> {
        let known = self.workers.get(worker.number as usize).ok_or(Unknown)?.as_ref();
        if known.is_some_and(|w| w.session != worker.session) {
            return Ok(false);
        }
        self.meet(worker, None).map(|_| true)
    }

    /// A worker is gone: what it did is lost, what it had not begun goes back, what any worker can do is done by another. Whether it was there.
    pub fn leave(&mut self, number: u32) -> bool {
        let Some(worker) = self.workers.get_mut(number as usize).and_then(Option::take) else { return false };
        if let Some(tally) = self.tally.by_worker.get_mut(&number) {
            tally.resident = 0;
        }
        self.emptied.insert(number);
        let held = self.doing.values().filter(|d| d.worker == number).map(|d| d.held.clone()).collect();
        self.deaths.left(number, &worker.session, held);
        for (task, attempt, _, _) in worker.ready {
            self.give_back(task, attempt);
        }
        let ids: Vec<String> =
            self.doing.iter().filter(|(_, d)| d.worker == number).map(|(id, _)| id.clone()).collect();
        ids.iter().for_each(|id| self.drop_work(id));
        true
    }

    /// Takes back what a worker was given so long ago and does not know of; whether there was any.
    pub fn take_back(&mut self, beat: &Beat, unheard: Duration) -> bool {
        let of_worker = self.doing.iter().filter(|(_, d)| d.worker == beat.worker.number);
        let lost = of_worker.filter(|(id, d)| d.since.elapsed() >= unheard && !beat.running.contains(id));
        let lost: Vec<String> = lost.map(|(id, _)| id.clone()).collect();
        for id in &lost {
            tracing::warn!(
                "worker {} never heard of {id}, which it was given: it is given out again",
                beat.worker.number
            );
            self.drop_work(id);
        }
        !lost.is_empty()
    }

    /// What a worker was to do is done by another.
    pub fn drop_work(&mut self, id: &str) {
        match self.doing.remove(id).map(|d| d.what) {
            Some(What::Attempt { task, number, .. }) => self.lose(task, number),
            Some(What::Call { call, work }) => self.common.push_front((call, work)),
            Some(What::Preview { .. }) | None => {}
        }
    }

    /// An attempt that was begun is gone with the work in it.
    fn lose(&mut self, task: TaskId, number: u32) {
        *self.tally.outcomes.entry(Outcome::Gone).or_default() += 1;
        self.give_back(task, number);
    }

    /// What an attempt was to do is planned anew: one that nobody has begun is no work lost, and is not counted as that.
    pub fn give_back(&mut self, task: TaskId, number: u32) {
        let (result, bytes) = (Err(JobError::Stopped), Bytes::default());
        self.finished.push_back(Finished { task, number, result, cpu: 0.0, bytes });
    }

    /// A worker cannot do what the stage asks for, and would not say so: it gets nothing to do.
    pub fn set_unfit(&mut self, number: u32) {
        let worker = self.workers[number as usize].as_mut();
        if worker.is_some_and(|w| !std::mem::replace(&mut w.unfit, true)) {
            tracing::warn!(
                "worker {number} is of a version that makes another picture of the scene, or knows no layers beside it, which the job asks for: it \
                 gets nothing to do until its pod is made again of the current version"
            );
        }
    }

    /// Lets silent workers go; whether there were any.
    pub fn sweep(&mut self) -> bool {
        let silent = |w: &Option<Worker>| w.as_ref().is_some_and(|w| w.seen.elapsed() >= SILENCE);
        let gone: BTreeSet<u32> =
            (0..self.workers.len() as u32).filter(|&n| silent(&self.workers[n as usize])).collect();
        for &number in &gone {
            tracing::warn!("worker {number} is silent: what it did is done again");
            self.leave(number);
        }
        !gone.is_empty()
    }

    pub fn is_staffed(&self) -> bool {
        self.workers.iter().any(Option::is_some)
    }

    /// Counts a failure that may pass by itself; whether that is still to be hoped for.
    pub fn may_pass(&mut self) -> bool {
        self.failures += 1;
        let since = *self.failing.get_or_insert_with(Instant::now);
        self.failures <= MOST_FAILURES || since.elapsed() < PATIENCE
    }
    pub fn succeeded(&mut self) {
        (self.failures, self.failing) = (0, None);
    }

    pub fn check(&self) -> Result<(), JobError> {
        if let Some(why) = &self.hopeless {
            return Err(JobError::Settings(why.clone()));
        }
        self.cancelled.as_ref().map_or(Ok(()), |why| Err(JobError::Owned(why.clone())))
    }

    /// What an attempt's result means to the loop over rounds.
    pub fn judge(&mut self, result: Result<Done, Failure>) -> Result<Made, JobError> {
        match result {
            Ok(Done::Made { outputs, hops, skipped, profile }) => {
                self.succeeded();
                Ok(Made { outputs, film: None, hops, skipped, profile: profile.map(|p| *p) })
            }
            Ok(_) => Err(JobError::Internal("a worker reports something else than it was to do".into())),
            Err(Failure::Stopped) => Err(JobError::Stopped),
            Err(Failure::Lost { name, why }) => Err(JobError::Lost { name, why }),
            Err(Failure::ForNow { message }) if self.may_pass() => {
                tracing::warn!("{message}; trying again");
                Err(JobError::Stopped)
            }
            Err(Failure::ForNow { message } | Failure::ForGood { message }) => Err(JobError::Settings(message)),
        }
    }
}
