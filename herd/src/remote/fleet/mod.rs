//! The workers of a job, as its operator sees them: who is there, who does what, what is to be done next.
//!
//! A worker that is not heard of for [`SILENCE`], or that starts again, has lost what it was doing. What it reports later
//! is refused: its id is known no more.

mod preview;
mod state;
mod tally;
#[cfg(test)]
mod tests;

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rayherd_api::ByteSize;
use tokio::sync::Notify;

use super::deaths::{Held, MOST_KILLED, Verdict, keys};
use super::message::{Answer, Beat, Done, Failure, Holds, Poll, Report, Stage, Work};
use crate::driver::{Event, Executor, Finished, Launch};
use crate::job::{JobError, PICTURE};
use crate::report::Bytes;

use state::{Doing, State, What, halved};

pub use tally::{Outcome, Tally, WorkerTally};

/// A worker that is silent for so long is gone. It beats each second.
pub const SILENCE: Duration = Duration::from_secs(10);
/// So many failures one after the other, that may pass by themselves, are too many, if they have gone on for [`PATIENCE`]: a server that
/// starts anew, or stores that are silent together for a moment, cost no job.
const MOST_FAILURES: u32 = 30;
const PATIENCE: Duration = Duration::from_secs(60);
/// A worker that has been given work for so long and does not name it among what it does has never got the answer, which was lost on its
/// way: longer than a worker waits for an answer.
const UNHEARD: Duration = Duration::from_secs(25);

/// The workers of one job.
pub struct Fleet {
    state: Mutex<State>,
    /// Something for whoever runs the job.
    told: Condvar,
    /// Something for workers that wait for work.
    wanted: Notify,
}

impl Fleet {
    /// A fleet of so many workers, none of them there yet. `epoch` names this run of the operator: ids begin with it, so that
    /// reports of work that another run gave out are not mistaken.
    pub fn new(workers: u32, epoch: &str) -> Self {
        let workers = (0..workers).map(|_| None).collect();
        let state = State { epoch: epoch.to_owned(), workers, ..State::default() };
        Fleet { state: Mutex::new(state), told: Condvar::new(), wanted: Notify::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Another frame begins: workers open its stage. `least` is the largest split, bytes: what a worker must be able to hold.
    pub fn open(&self, stage: Stage, placement: Vec<Vec<u32>>, least: u64) {
        let mut state = self.lock();
        state.whole = (stage.id.clone(), stage.memory);
        state.least = least;
        state.less = false;
        let stage = Stage { memory: state.memory(), ..stage };
        state.placement = placement;
        state.read = Default::default();
        state.stage = Some(stage);
        state.preview.waiting = None;
        state.emptied.clear();
        for worker in state.workers.iter_mut().flatten() {
            // the splits of another scene may have these numbers now
            (worker.open, worker.unfit, worker.holds) = (false, false, Holds::default());
        }
        self.wanted.notify_waiters();
    }
    /// The job is over: workers end.
    pub fn end(&self) {
        self.lock().over = true;
        self.wanted.notify_waiters();
    }
    /// Workers go over to another fleet, which answers them from now on: whoever waits here for an answer is to ask again.
    pub fn retire(&self) {
        self.lock().retired = true;
        self.wanted.notify_waiters();
    }
    /// The job is to end now, with this message.
    pub fn cancel(&self, why: &str) {
        self.lock().cancelled = Some(why.to_owned());
        self.told.notify_all();
    }
    /// Whether the job is to go on.
    ///
    /// # Errors
    /// When it was cancelled.
    pub fn check(&self) -> Result<(), JobError> {
        self.lock().check()
    }
    /// What was done so far.
    pub fn tally(&self) -> Tally {
        let state = self.lock();
        let ready = state.workers.iter().flatten().filter(|w| w.seen.elapsed() < SILENCE).count() as u32;
        let ready_work: usize = state.workers.iter().flatten().map(|w| w.ready.len()).sum();
        let queued = (state.common.len() + ready_work) as u64;
        Tally { ready, queued, running: state.doing.len() as u64, ..state.tally.clone() }
    }
    /// How many of the splits and of the texture tiles nobody has read since the stage began, of so many.
    pub fn never_read(&self, all: [usize; 2]) -> [u64; 2] {
        let state = self.lock();
        std::array::from_fn(|i| all[i].saturating_sub(state.read[i].len()) as u64)
    }
    /// Whether all workers that are there can take a band out of a film part.
    pub fn knows_bands(&self) -> bool {
        self.lock().workers.iter().flatten().all(|w| w.bands || w.unfit)
    }
    /// Workers that are there and cannot do what the stage asks for: of a version that knows no layers beside the picture.
    pub fn unfit(&self) -> Vec<u32> {
        let state = self.lock();
        (0..).zip(&state.workers).filter(|(_, w)| w.as_ref().is_some_and(|w| w.unfit)).map(|(n, _)| n).collect()
    }
    /// The store on the node of each worker, where known.
    pub fn homes(&self) -> Vec<Option<u32>> {
        self.lock().workers.iter().map(|w| w.as_ref().and_then(|w| w.home)).collect()
    }
    /// The process of a worker was killed for lack of memory, of which its pod may take so much. Once for each.
    ///
    /// Its tasks are done again with half of the splits in memory, twice; then, or when it was no task, the job is given up.
    pub fn killed_for_memory(&self, number: u32, limit: Option<&str>) {
        let mut state = self.lock();
        if !state.deaths.is_unexplained(number) && !state.leave(number) {
            // it never asked for work
            state.deaths.left(number, "", Vec::new());
        }
        let limit = limit.unwrap_or("no limit of memory, but its node has one");
        match state.deaths.for_memory(number) {
            Verdict::Again => {
                tracing::warn!("worker {number} was killed for lack of memory (limit of its pod: {limit})")
            }
            Verdict::Less => {
                state.less = true;
                let now = state.memory().map_or_else(|| "nothing less".into(), |m| ByteSize::new(m).to_string());
                tracing::warn!(
                    "worker {number} was killed for lack of memory (limit of its pod: {limit}): tasks hold {now} of the scene from now on"
                );
            }
            Verdict::TooMuch => {
                let size = |m: Option<u64>| m.map_or_else(|| "all".into(), |m| ByteSize::new(m).to_string());
                let tried: Vec<String> =
                    (0..MOST_KILLED).map(|l| size(halved(state.whole.1, l, state.least))).collect();
                state.hopeless = Some(format!(
                    "workers were killed for lack of memory, with {} of the scene in memory at most (the largest split takes {} bytes), and \
                     a pod may take {limit}: {GIVE_MORE}",
                    tried.join(", then "),
                    state.least
                ));
            }
            Verdict::Hopeless(what) => {
                state.hopeless = Some(format!(
                    "{what}: {MOST_KILLED} workers were killed for lack of memory, and a pod may take {limit}: {GIVE_MORE}"
                ));
            }
        }
        drop(state);
        self.tell();
    }

    /// Workers whose pods are known to be gone: what they did goes back at once. `is_there` is told a worker's number and session.
    pub fn only(&self, is_there: impl Fn(u32, &str) -> bool) {
        let mut state = self.lock();
        let known = (0u32..).zip(&state.workers);
        let gone: Vec<u32> =
            known.filter(|(n, w)| w.as_ref().is_some_and(|w| !is_there(*n, &w.session))).map(|(n, _)| n).collect();
        if !gone.is_empty() {
            gone.into_iter().for_each(|number| {
                tracing::warn!("the pod of worker {number} is gone: what it did is done again");
                state.leave(number);
            });
            self.tell();
        }
    }

    fn tell(&self) {
        self.told.notify_all();
        self.wanted.notify_waiters();
    }

    /// Answers a worker that asks for work; after `patience`, or when it is thought gone or replaced meanwhile, with [`Answer::Wait`]: to wait is no
    /// sign of life, and must not cost a successor what it does.
    ///
    /// # Errors
    /// When there is no worker of this number.
    pub async fn poll(&self, poll: &Poll, patience: Duration) -> Result<Answer, Unknown> {
        let end = tokio::time::Instant::now() + patience;
        let mut asks = true;
        loop {
            let wanted = self.wanted.notified();
            tokio::pin!(wanted);
            wanted.as_mut().enable();
            let answer = if std::mem::take(&mut asks) {
                self.answer(poll)?
            } else {
                let mut state = self.lock();
                if !state.knows(&poll.worker) {
                    return Ok(Answer::Wait);
                }
                give(&mut state, poll)?
            };
            if answer != Answer::Wait || self.lock().retired || tokio::time::timeout_at(end, wanted).await.is_err() {
                return Ok(answer);
            }
        }
    }

    /// Answers a worker that asks for work, at once.
    ///
    /// # Errors
    /// When there is no worker of this number.
    pub fn answer(&self, poll: &Poll) -> Result<Answer, Unknown> {
        let mut state = self.lock();
        let newcomer = state.meet(&poll.worker, poll.home)?;
        if newcomer {
            self.told.notify_all();
        }
        give(&mut state, poll)
    }

    /// Takes a report; false when nobody waits for it (any more): the work is garbage.
    ///
    /// # Errors
    /// When there is no worker of this number.
    pub fn report(&self, report: Report) -> Result<bool, Unknown> {
        let mut state = self.lock();
        if !state.hear(&report.worker)? || state.doing.get(&report.id).is_none_or(|d| d.worker != report.worker.number)
        {
            return Ok(false);
        }
        let Some(doing) = state.doing.remove(&report.id) else { return Ok(false) };
        let mut bytes = Bytes::default();
        report.bytes.iter().for_each(|r| bytes.add(r.stage, r.op, r.kind, r.place, r.bytes));
        state.tally.bytes.merge(&bytes);
        state.tally.cpu += report.cpu;
        state.tally.cache_failures += report.cache_failures;
        if !matches!(report.result, Err(Failure::Stopped)) {
            state.deaths.came_out(report.worker.number, &doing.held.keys);
        }
        let of_worker = state.tally.by_worker.entry(report.worker.number).or_default();
        of_worker.cpu += report.cpu;
        of_worker.resident = report.resident;
        // by the name that the stage had before memory was taken away
        if state.stage.is_some() && report.reads.stage.split('+').next() == Some(&state.whole.0) {
            state.read[0].extend(report.reads.splits);
            state.read[1].extend(report.reads.tiles);
            if let Some(worker) = state.workers[report.worker.number as usize].as_mut() {
                worker.told(report.holds.as_ref());
            }
        }
        match (doing.what, report.result) {
            (What::Attempt { task, number, stop }, result) => {
                // once another attempt has done the task, what it read is deleted, and whoever reads it still finds it gone
                let superfluous = stop.is_set() && result.is_err();
                let outcome = if superfluous { Outcome::Stopped } else { Outcome::of(&result) };
                *state.tally.outcomes.entry(outcome).or_default() += 1;
                if let Ok(Done::Made { hops, .. }) = &result {
                    state.tally.hops += hops;
                }
                let result = state.judge(result);
                state.finished.push_back(Finished { task, number, result, cpu: report.cpu, bytes });
            }
            // another worker may do it
            (What::Call { call, work }, Err(Failure::Stopped)) => state.common.push_front((call, work)),
            (What::Call { call, work }, Err(Failure::ForNow { message })) if state.may_pass() => {
                tracing::warn!("{message}; trying again");
                state.common.push_back((call, work));
            }
            (What::Preview { .. }, result) => tracing::debug!("preview: {result:?}"),
            (What::Call { call, .. }, result) => {
                if result.is_ok() {
                    state.succeeded();
                }
                state.answers.insert(call, result);
            }
        }
        drop(state);
        self.tell();
        Ok(true)
    }

    /// Takes a sign of life; the ids of work that need not go on.
    ///
    /// # Errors
    /// When there is no worker of this number.
    pub fn beat(&self, beat: &Beat) -> Result<Vec<String>, Unknown> {
        let mut state = self.lock();
        if !state.hear(&beat.worker)? {
            return Ok(beat.running.clone());
        }
        if state.take_back(beat, UNHEARD) {
            self.tell();
        }
        let superfluous = |id: &&String| match state.doing.get(*id).map(|d| &d.what) {
            None => true,
            Some(What::Attempt { stop, .. } | What::Preview { stop }) => stop.is_set(),
            Some(What::Call { .. }) => false,
        };
        Ok(beat.running.iter().filter(superfluous).cloned().collect())
    }

    /// Has some worker do something, and waits for it.
    ///
    /// # Errors
    /// When it cannot be done.
    pub fn call(&self, work: Work) -> Result<Done, JobError> {
        self.call_all(vec![work])?.pop().ok_or_else(given_up)
    }

    /// Has workers do several things, in whatever order, and waits for all; what came out, in theirs.
    ///
    /// # Errors
    /// When one of them cannot be done; then the rest is given up.
    pub fn call_all(&self, works: Vec<Work>) -> Result<Vec<Done>, JobError> {
        self.ask(works, false)?.into_iter().map(|done| done.ok_or_else(given_up)).collect()
    }

    /// As [`Fleet::call`], as long as a worker is there: none when all are gone, and nobody does it.
    ///
    /// # Errors
    /// When it cannot be done.
    pub fn call_while_staffed(&self, work: Work) -> Result<Option<Done>, JobError> {
        self.ask(vec![work], true)?.pop().ok_or_else(given_up)
    }

    /// As [`Fleet::call_all`], as long as a worker is there: none for what nobody was left to do.
    ///
    /// # Errors
    /// When one of them cannot be done; then the rest is given up.
    pub fn call_all_while_staffed(&self, works: Vec<Work>) -> Result<Vec<Option<Done>>, JobError> {
        self.ask(works, true)
    }

    fn ask(&self, works: Vec<Work>, while_staffed: bool) -> Result<Vec<Option<Done>>, JobError> {
        let mut state = self.lock();
        let first = state.next;
        let calls = first..first + works.len() as u64;
        state.next = calls.end;
        state.common.extend(calls.clone().zip(works));
        self.wanted.notify_waiters();
        let mut done = Vec::new();
        for call in calls.clone() {
            let result = loop {
                if let Some(result) = state.answers.remove(&call) {
                    break result.map(Some).map_err(Failure::into_error);
                }
                if let Err(e) = state.check() {
                    break Err(e);
                }
                if state.sweep() {
                    self.wanted.notify_waiters();
                }
                if while_staffed && !state.is_staffed() {
                    // what a worker had in hand that is gone is back among the common work
                    state.common.retain(|(c, _)| *c != call);
                    break Ok(None);
                }
                state = self.wait(state, Duration::from_millis(200));
            };
            match result {
                Ok(result) => done.push(result),
                Err(e) => {
                    // what runs reports to nobody
                    state.common.retain(|(c, _)| !calls.contains(c));
                    state.doing.retain(|_, d| !matches!(d.what, What::Call { call, .. } if calls.contains(&call)));
                    state.answers.retain(|c, _| !calls.contains(c));
                    return Err(e);
                }
            }
        }
        Ok(done)
    }

    /// Waits until a worker is there.
    ///
    /// # Errors
    /// When the job was cancelled meanwhile.
    pub fn staffed(&self) -> Result<(), JobError> {
        let mut state = self.lock();
        loop {
            state.check()?;
            state.sweep();
            if state.is_staffed() {
                return Ok(());
            }
            state = self.wait(state, Duration::from_millis(200));
        }
    }

    /// Waits until all workers that can have the stage open, or so long.
    ///
    /// # Errors
    /// When the job was cancelled meanwhile.
    pub fn gather(&self, patience: Duration) -> Result<(), JobError> {
        let end = Instant::now() + patience;
        let mut state = self.lock();
        while Instant::now() < end && !state.workers.iter().all(|w| w.as_ref().is_some_and(|w| w.open || w.unfit)) {
            state.check()?;
            state = self.wait(state, Duration::from_millis(50));
        }
        Ok(())
    }

    fn wait<'s>(&self, state: MutexGuard<'s, State>, time: Duration) -> MutexGuard<'s, State> {
        self.told.wait_timeout(state, time).unwrap_or_else(PoisonError::into_inner).0
    }
}

/// What a worker that is there is given to do.
fn give(state: &mut State, poll: &Poll) -> Result<Answer, Unknown> {
    if state.over {
        return Ok(Answer::Over);
    }
    let can = |stage: &Stage| poll.picture == PICTURE && (poll.aovs || stage.frame.aovs.is_empty());
    let unfit = !state.stage.as_ref().is_none_or(can);
    if unfit {
        state.set_unfit(poll.worker.number);
        return Ok(Answer::Wait);
    }
    if state.stage.as_ref().map(|s| &s.id) != poll.stage.as_ref() {
        return Ok(Answer::Open { stage: state.stage.clone().map(Box::new) });
    }
    let id = format!("{}-{}", state.epoch, state.next);
    let level = state.deaths.level();
    let in_stage = poll.stage.is_some();
    let worker = state.workers[poll.worker.number as usize].as_mut().ok_or(Unknown)?;
    worker.open |= in_stage;
    worker.bands = poll.bands;
    worker.told(poll.holds.as_ref());
    let first = state.common_for(poll);
    let (what, work) = if let Some((call, work)) = first.and_then(|at| state.common.remove(at)) {
        (What::Call { call, work: work.clone() }, work)
    } else if !poll.clerk
        && let Some((task, number, work, stop)) =
            state.workers[poll.worker.number as usize].as_mut().and_then(|w| w.ready.pop_front())
    {
        state.tally.first_attempt.get_or_insert_with(Instant::now);
        (What::Attempt { task, number, stop }, work)
    } else if poll.clerk
        && poll.previews
        && poll.tiles
        && let Some(work) = state.preview.waiting.take()
    {
        state.preview.made = true;
        (What::Preview { stop: Default::default() }, work)
    } else {
        return Ok(Answer::Wait);
    };
    state.next += 1;
    let held = Held { keys: keys(&work), level: matches!(what, What::Attempt { .. }).then_some(level) };
    state.doing.insert(id.clone(), Doing { worker: poll.worker.number, since: Instant::now(), what, held });
    Ok(Answer::Work { id, work: Box::new(work) })
}

/// What helps where a pod's memory is too little.
const GIVE_MORE: &str = "raise resources.limits.memory of the container worker in spec.workers.template (without it a pod gets \
     spec.workers.memory and 256Mi, and 256Mi more for each slot), or have fewer spec.workers.slots or a smaller spec.blockSize";

fn given_up() -> JobError {
    JobError::Internal("work was given up that was to be waited for".into())
}

/// There is no worker of this number in the job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the job has no worker of this number")]
pub struct Unknown;

impl Executor for Fleet {
    fn is_up(&self, node: u32) -> bool {
        self.lock().workers.get(node as usize).is_some_and(|w| w.as_ref().is_some_and(|w| w.open))
    }
    fn holders(&self) -> Option<Vec<Vec<u32>>> {
        let state = self.lock();
        let homes: Vec<Option<u32>> = state.workers.iter().map(|w| w.as_ref().and_then(|w| w.home)).collect();
        let near = |on: &Vec<u32>| {
            let near = |&w: &u32| homes[w as usize].is_some_and(|home| on.contains(&home));
            (0..homes.len() as u32).filter(near).collect()
        };
        let mut holders: Vec<Vec<u32>> = state.placement.iter().map(near).collect();
        // where nobody looks where data lies, caches do not count either
        if state.stage.as_ref().is_some_and(|s| s.near) {
            let count = holders.len();
            for (number, worker) in (0..).zip(&state.workers) {
                let held = worker.iter().flat_map(|w| w.holds.splits(count));
                held.for_each(|split| holders[split].push(number));
            }
            for on in &mut holders {
                on.sort_unstable();
                on.dedup();
            }
        }
        Some(holders)
    }
    fn memory(&self) -> Option<u64> {
        self.lock().memory()
    }
    fn has_room(&self) -> bool {
        true
    }
    fn launch(&self, launch: Launch) {
        let Launch { task, number, attempt, stop } = launch;
        let mut state = self.lock();
        let node = attempt.node as usize;
        match state.workers.get_mut(node).and_then(|w| w.as_mut()) {
            Some(worker) => worker.ready.push_back((task, number, Work::Attempt { attempt }, stop)),
            // it went away since it was planned for
            None => state.give_back(task, number),
        }
        drop(state);
        self.tell();
    }
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError> {
        let mut state = self.lock();
        state.check()?;
        state.sweep();
        if state.finished.is_empty() && state.emptied.is_empty() && !state.less {
            state = self.wait(state, wait);
        }
        // here, where whoever plans listens: nothing is launched any more that was planned for more memory
        if std::mem::take(&mut state.less) {
            state.reopen();
            self.wanted.notify_waiters();
            return Ok(Some(Event::LessMemory));
        }
        if let Some(worker) = state.emptied.pop_first() {
            return Ok(Some(Event::MemoryLost(worker)));
        }
        Ok(state.finished.pop_front().map(|f| Event::Finished(f.into())))
    }
}
