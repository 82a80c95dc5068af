//! The loop over rounds: plan, run attempts, commit, until every ray has come to its end.
//!
//! One loop for every way to run: tasks run where an [`Executor`] runs them, their film is summed by a [`FilmSum`], and which
//! record is the newest is kept by a [`Pointer`].

mod attempts;
mod cameras;
mod commit;
mod ending;
pub mod executor;
mod losses;
mod planning;
mod steps;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayherd_render::film::{ErrorSum, Samples};
use rayherd_render::skip::SkipCounts;

use crate::job::{JobError, Progress, Sampling};
use crate::ledger::{Ledger, Snapshot, TaskId};
use crate::local::attempt::{Attempt, Shared};
use crate::local::slots::StopFlag;
use crate::plan::Window;
use crate::plan::cost::Traffic;
use crate::plan::rate::Rate;
use crate::profile::Profile;
use crate::report::RayCounts;
use cameras::Cameras;
pub use executor::{Event, Executor, FilmSum, Finished, Launch, Objects, Pointer};

/// Where a job begins: at nothing, or where an earlier run stopped.
pub struct Start<F> {
    /// The state.
    pub ledger: Ledger,
    /// The film of its commits.
    pub film: F,
    /// State to go back to when rays are lost: the last one without rays on their way, whose film is the one kept in `film`.
    pub settled: Snapshot,
    /// Where it is kept which record is the newest; none if the job keeps no records.
    pub pointer: Option<Arc<dyn Pointer>>,
    /// Names of this run's objects begin with it.
    pub session: String,
    /// Commits taken over from earlier runs.
    pub reused: u64,
    /// Commits whose outputs are lost.
    pub redone: u64,
}

/// A task that runs.
struct Running {
    spec: Attempt,
    started: Instant,
    attempts: u32,
}

/// An attempt that runs, of a task that may be committed already.
struct Live {
    node: u32,
    stop: StopFlag,
}

/// The loop over rounds of one frame.
pub struct Driver<'s, 'a, F> {
    shared: &'s Shared<'a>,
    ledger: Ledger,
    film: F,
    cameras: Cameras,
    sampling: &'s Sampling,
    progress: &'s dyn Progress,
    /// Samples whose units were queued.
    queued: Samples,
    /// The errors of tiles when these were made, where that was asked for.
    learned: Option<Vec<ErrorSum>>,
    /// Splits that rays can need along the curve through space, and their places in it.
    order: Vec<u32>,
    rank: Vec<u32>,
    /// How `auto` cuts the scene, in places along the curve, and what each node holds of it.
    cut: Option<Vec<Window>>,
    /// In how many parts the cut divides the scene.
    parts: f64,
    windows: Vec<BTreeSet<u32>>,
    /// Where tasks run on other machines: what each node was given last, as far as its memory holds it, the newest at the end.
    recent: Vec<Vec<u32>>,
    /// What a node may hold of the scene, where it is less than was given: bytes.
    memory: u64,
    traffic: Traffic,
    free: Vec<u32>,
    running: BTreeMap<TaskId, Running>,
    live: BTreeMap<(TaskId, u32), Live>,
    /// Attempts that have reported, and those of them that were committed.
    reported: BTreeSet<(TaskId, u32)>,
    committed: BTreeSet<(TaskId, u32)>,
    pointer: Option<Arc<dyn Pointer>>,
    session: String,
    /// Films stored so far, so that none has the name of another.
    stored: u64,
    settled: Snapshot,
    /// Objects that the last snapshot made superfluous, and those that the next one will.
    superfluous: [Objects; 2],
    /// Film that the last snapshot names, and those to which the job went back since.
    named: BTreeSet<String>,
    old_records: [Vec<String>; 2],
    rate: Rate,
    /// Rays of earlier runs.
    taken_over: RayCounts,
    start: Instant,
    begun: bool,
    rounds: u64,
    tasks: u64,
    reused: u64,
    redone: u64,
    hops: u64,
    hop_bytes: u64,
    skipped: SkipCounts,
    profile: Option<Profile>,
    error: Option<f64>,
    /// When the error that is shown is found again.
    next_error: Instant,
}

impl<'s, 'a, F: FilmSum> Driver<'s, 'a, F> {
    /// A loop that has run nothing yet.
    pub fn new(shared: &'s Shared<'a>, begin: Start<F>, sampling: &'s Sampling, progress: &'s dyn Progress) -> Self {
        let scene = shared.scene;
        let order = scene.owning_order();
        let mut rank = vec![0; scene.splits() as usize];
        order.iter().enumerate().for_each(|(r, &s)| rank[s as usize] = r as u32);
        let starts: Vec<u32> = scene.start_splits(shared.frame).into_iter().map(|s| rank[s as usize]).collect();
        let made = begin.ledger.done().begin();
        let planned = begin.ledger.step().and_then(|step| Some(step.after(step.parts(&made, starts.len())?)));
        Driver {
            shared,
            queued: planned.unwrap_or(Samples::Even(made.least())),
            learned: None,
            settled: begin.settled,
            taken_over: begin.ledger.rays(),
            session: begin.session,
            ledger: begin.ledger,
            film: begin.film,
            pointer: begin.pointer,
            stored: 0,
            reused: begin.reused,
            redone: begin.redone,
            cameras: Cameras::new(shared.frame, starts),
            sampling,
            progress,
            order,
            rank,
            cut: None,
            parts: 1.0,
            windows: vec![BTreeSet::new(); shared.settings.nodes.len()],
            recent: vec![Vec::new(); shared.settings.nodes.len()],
            memory: u64::MAX,
            traffic: Traffic::default(),
            free: shared.settings.nodes.iter().map(|n| n.slots).collect(),
            running: BTreeMap::new(),
            live: BTreeMap::new(),
            reported: BTreeSet::new(),
            committed: BTreeSet::new(),
            superfluous: Default::default(),
            named: BTreeSet::new(),
            old_records: Default::default(),
            rate: Rate::UNKNOWN,
            start: Instant::now(),
            begun: false,
            rounds: 0,
            tasks: 0,
            hops: 0,
            hop_bytes: 0,
            skipped: SkipCounts::default(),
            profile: shared.settings.profile.then(Profile::default),
            error: None,
            next_error: Instant::now(),
        }
    }

    /// Runs the job to its end. Afterwards, whatever came of it, attempts may still run: see [`Driver::stop_all`].
    ///
    /// # Errors
    /// When it cannot be finished; what was committed stays.
    pub fn run(&mut self, executor: &dyn Executor) -> Result<(), JobError> {
        let barrier = self.shared.settings.has_barrier();
        self.memory = executor.memory().unwrap_or(u64::MAX);
        loop {
            if self.queued.most() > 0 && self.is_step_over() && self.step_done()? {
                return Ok(());
            }
            if self.progress.is_cancelled() {
                return Err(JobError::Cancelled);
            }
            self.queue_steps()?;
            let mut started = false;
            // asked before planning: one that comes up meanwhile was not planned for
            let all_up = (0..self.free.len() as u32).all(|n| executor.is_up(n));
            if !barrier || self.running.is_empty() {
                for task in self.plan(executor) {
                    started |= self.start(executor, task)?;
                }
                self.rounds += u64::from(started && barrier);
            }
            if self.live.is_empty() {
                if self.is_step_over() {
                    continue;
                }
                if all_up {
                    return Err(JobError::Internal("rays wait, but nothing was planned".into()));
                }
            }
            if !started {
                self.second_attempts(executor);
            }
            match executor.next(Duration::from_millis(100))? {
                Some(Event::Finished(finished)) => self.handle(*finished)?,
                Some(Event::NodeLost(node)) => self.lose_node(node)?,
                // what it is planned to hold must be loaded again, by whoever is nearest
                Some(Event::MemoryLost(node)) => self.forget(node),
                Some(Event::LessMemory) => self.take_less(executor),
                Some(Event::StoreLost(store)) => self.lose_copies(executor, store)?,
                None => {}
            }
            self.tell();
        }
    }

    /// Tells all attempts to stop.
    pub fn stop_all(&mut self) {
        self.live.values().for_each(|l| l.stop.set());
    }

    /// Whether commits are kept, so that another run can go on from them.
    fn is_durable(&self) -> bool {
        self.pointer.is_some()
    }
}
