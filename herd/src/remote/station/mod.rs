//! A worker: slots that ask for work, do it next to their own store, and report.

mod films;
mod near;
mod work;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant};

use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::ObjectStore;
use tokio::runtime::Runtime;

use super::Depot;
use super::blocks::is_large;
use super::holdings::Holdings;
use super::homes::Homes;
use super::message::{Answer, Beat, Done, Failure, Holds, Poll, Reads, Report, Stage, Work, WorkerId};
use super::traffic::Traffic;
use crate::job::{JobError, JobSettings, NodeSpec, PICTURE, PreparedScene};
use crate::local::attempt::{FilmUse, Shared};
use crate::local::nodes::Nodes;
use crate::local::slots::StopFlag;
use crate::local::usage::{process_cpu, thread_cpu};
use crate::report::Bytes;
use crate::store::{BlockStore, Caching, Copies, SceneObjects, promised_hash};

use near::Near;

/// Between two signs of life.
const BEAT: Duration = Duration::from_secs(1);
/// Before an operator that did not answer is asked again, at most: all threads of all workers lose it at once, and are not to come back at once.
const PAUSE: Duration = Duration::from_millis(500);
/// After work that did not come out for now, before more is asked for: doubled for each such failure in a row, up to the longest.
const FIRST_REST: Duration = Duration::from_millis(125);
const LONGEST_REST: Duration = Duration::from_secs(4);
/// Film tiles without AOVs whose memory a task's sums take at most: 96 MiB.
const TILES: usize = 1024;
/// How long a report is offered to an operator that does not answer.
const PATIENCE: Duration = Duration::from_secs(120);

/// The way to the operator.
pub trait Link: Send + Sync {
    /// Asks for work; may take its time.
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError>;
    /// Tells what was done.
    fn report(&self, report: &Report) -> Result<(), LinkError>;
    /// Gives a sign of life; what need not go on.
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError>;
}

/// The operator did not answer, or refused.
#[derive(Debug, thiserror::Error)]
#[error("operator: {0}")]
pub struct LinkError(pub String);

/// A worker.
pub struct Station<'l> {
    link: &'l dyn Link,
    depot: Depot,
    slots: u32,
    worker: WorkerId,
    scratch: PathBuf,
    /// Of what lies on no store at home.
    copies: Option<Arc<Copies>>,
    runtime: Runtime,
    running: Mutex<BTreeMap<String, Busy>>,
    /// Held by one piece of work that takes all threads, or by several that build small blocks.
    threads: RwLock<()>,
    traffic: Traffic,
    leaving: AtomicBool,
    panicked: AtomicBool,
    /// Pieces of work in a row that did not come out for now.
    failures: AtomicU32,
    /// How often an answer was waited for in vain.
    pauses: AtomicU32,
}

/// Work that is being done.
struct Busy {
    stop: StopFlag,
    /// Does not look whether it is to stop.
    deaf: bool,
}

/// A stage that is open.
struct Opened<'s> {
    stage: &'s Stage,
    shared: Shared<'s>,
    holdings: Option<Holdings>,
}

/// What comes after a stage.
enum Next {
    Open(Option<Box<Stage>>),
    Over,
}

impl<'l> Station<'l> {
    /// A worker with so many slots. `scratch` is a folder of its own for what is on its way.
    ///
    /// # Errors
    /// When there are no threads for input and output.
    pub fn new(
        link: &'l dyn Link,
        depot: Depot,
        slots: u32,
        worker: WorkerId,
        scratch: PathBuf,
    ) -> Result<Self, JobError> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.map_err(|e| JobError::Internal(format!("no runtime for input and output: {e}")))?;
        let (running, leaving, panicked) = (Mutex::default(), AtomicBool::new(false), AtomicBool::new(false));
        let (failures, pauses) = (AtomicU32::new(0), AtomicU32::new(0));
        let slots = slots.max(1);
        let copies = None;
        let (threads, traffic) = (RwLock::default(), Traffic::default());
        Ok(Station {
            link,
            depot,
            slots,
            worker,
            scratch,
            copies,
            runtime,
            running,
            threads,
            traffic,
            leaving,
            panicked,
            failures,
            pauses,
        })
    }

    /// The same; what is read of scenes from other machines is kept in a cache, and the operator told of it.
    #[must_use]
    pub fn caching(self, copies: Copies) -> Self {
        Station { copies: Some(Arc::new(copies)), ..self }
    }

    /// Works until the job is over, or [`Station::leave`] was called.
    ///
    /// # Errors
    /// When a stage cannot be opened and never will be, or one of its threads panicked.
    pub fn run(&self) -> Result<(), JobError> {
        std::thread::scope(|scope| {
            scope.spawn(|| self.guarded("beating", || self.beat()));
            let result = self.guarded("going through stages", || self.stages()).unwrap_or(Ok(()));
            self.leaving.store(true, Ordering::Relaxed);
            if self.has_panicked() {
                return Err(JobError::Internal("a thread of the worker panicked".into()));
            }
            result
        })
    }

    /// A worker of which a part is dead must not look alive: after a panic all of it leaves.
    fn guarded<T>(&self, what: &str, run: impl FnOnce() -> T) -> Option<T> {
        let done = catch_unwind(AssertUnwindSafe(run)).ok();
        if done.is_none() {
            tracing::error!("panicked while {what}: the worker leaves");
            self.panicked.store(true, Ordering::Relaxed);
            self.leave();
        }
        done
    }

    /// Whether one of its threads panicked.
    pub fn has_panicked(&self) -> bool {
        self.panicked.load(Ordering::Relaxed)
    }

    /// Stops what runs, which is given back, and ends.
    pub fn leave(&self) {
        self.leaving.store(true, Ordering::Relaxed);
        self.lock().values().for_each(|busy| busy.stop.set());
    }

    /// Whether nothing runs, and nothing is about to.
    pub fn is_idle(&self) -> bool {
        self.is_leaving() && self.lock().is_empty()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Busy>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
    fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Relaxed)
    }

    fn beat(&self) {
        while !self.is_leaving() {
            let running: Vec<String> = self.lock().keys().cloned().collect();
            match self.link.beat(&Beat { worker: self.worker.clone(), running }) {
                Ok(superfluous) => {
                    let running = self.lock();
                    superfluous.iter().filter_map(|id| running.get(id)).for_each(|busy| busy.stop.set());
                }
                Err(e) => tracing::debug!("{e}"),
            }
            std::thread::sleep(BEAT);
        }
        self.give_back_deaf();
    }

    /// Preparing may take longer than a worker that leaves has: nothing names what it has written by now, and another worker begins anew.
    fn give_back_deaf(&self) {
        let deaf: Vec<String> = self.lock().iter().filter(|(_, busy)| busy.deaf).map(|(id, _)| id.clone()).collect();
        for id in deaf {
            let (worker, result) = (self.worker.clone(), Err(Failure::Stopped));
            let (bytes, reads, holds) = (self.traffic.take().rows(), Reads::default(), None);
            let report = Report {
                worker,
                id: id.clone(),
                result,
                cpu: 0.0,
                bytes,
                reads,
                holds,
                cache_failures: 0,
                resident: 0,
            };
            if let Err(e) = self.link.report(&report) {
                tracing::warn!("{e}");
            }
            self.lock().remove(&id);
        }
    }

    fn stages(&self) -> Result<(), JobError> {
        let mut stage: Option<Box<Stage>> = None;
        while !self.is_leaving() {
            let next = match &stage {
                None => self.slots(None),
                Some(stage) => self.in_stage(stage)?,
            };
            match next {
                Next::Open(next) => stage = next,
                Next::Over => return Ok(()),
            }
        }
        Ok(())
    }

    fn in_stage(&self, stage: &Stage) -> Result<Next, JobError> {
        let scene = loop {
            match self.open(stage) {
                Ok(scene) => break scene,
                // whoever leaves needs it no more
                Err(_) if self.is_leaving() => return Ok(Next::Over),
                Err(e) if matches!(Failure::from(&e), Failure::ForNow { .. }) => {
                    tracing::warn!("{e}; trying again");
                    self.pause();
                }
                Err(e) => return Err(e),
            }
        };
        let disks = self.depot.len();
        // one more than there are disks: who has none at home stands on no disk's node
        let settings = JobSettings {
            strategy: stage.strategy,
            nodes: vec![NodeSpec { slots: self.slots }; disks as usize + 1],
            memory_per_node: stage.memory,
            replicas: stage.replicas,
            profile: stage.profile,
            ..JobSettings::default()
        };
        let part = Arc::new(self.depot.part(&stage.prefix, stage.replicas)?);
        let homes = Homes::of(&scene, disks, stage.replicas);
        let near = Near { station: self, homes, home: self.depot.home().filter(|_| stage.near) };
        let nodes = Nodes::real(&scene, &settings, part, disks, Some(Box::new(near)))?.noting_reads();
        let shared = Shared {
            scene: &scene,
            frame: &stage.frame,
            settings: &settings,
            nodes,
            film: FilmUse::Banded { band: stage.band, most: TILES },
            buckets: stage.buckets,
        };
        let holdings = self.copies.clone().map(|copies| Holdings::new(&scene.manifest, copies));
        Ok(self.slots(Some(&Opened { stage, shared, holdings })))
    }

    fn open(&self, stage: &Stage) -> Result<PreparedScene, JobError> {
        let mut store: Arc<dyn BlockStore> = Arc::new(self.depot.replicated(stage.replicas)?);
        if let Some(copies) = self.copies.clone().filter(|_| self.depot.home().is_none()) {
            // what is named by its hash never changes
            store = Arc::new(Caching::new(store, copies, |key| promised_hash(key).is_some()));
        }
        let objects: Arc<dyn ObjectStore> = Arc::new(SceneObjects::new(store, self.runtime.handle().clone())?);
        PreparedScene::open(Manifest::load(objects.as_ref(), &stage.scene)?, objects)
    }

    /// Runs all slots, and a clerk, until one is told of another stage, as then all are.
    fn slots(&self, open: Option<&Opened>) -> Next {
        std::thread::scope(|scope| {
            let slot = |n| move || self.guarded("asking for work", || self.slot(open, n == self.slots));
            let threads: Vec<_> = (0..=self.slots).map(|n| scope.spawn(slot(n))).collect();
            let mut next = Next::Over;
            for thread in threads {
                // a panic was told and ends all
                if let Ok(Some(open @ Next::Open(_))) = thread.join() {
                    next = open;
                }
            }
            next
        })
    }

    fn slot(&self, open: Option<&Opened>, clerk: bool) -> Next {
        while !self.is_leaving() {
            let poll = Poll {
                worker: self.worker.clone(),
                home: self.depot.home(),
                stage: open.map(|o| o.stage.id.clone()),
                clerk,
                bands: true,
                aovs: true,
                builds: true,
                previews: true,
                tiles: true,
                picture: PICTURE,
                holds: open.and_then(Opened::holds),
            };
            match self.link.poll(&poll) {
                Ok(Answer::Wait) => {}
                Ok(Answer::Work { id, work }) => self.work(id, &work, open),
                Ok(Answer::Open { stage }) => return Next::Open(stage),
                Ok(Answer::Over) => return Next::Over,
                Err(e) => {
                    tracing::warn!("{e}");
                    self.pause();
                }
            }
        }
        Next::Over
    }

    fn work(&self, id: String, work: &Work, open: Option<&Opened>) {
        let stop = StopFlag::default();
        let deaf = matches!(work, Work::Prepare { .. });
        self.lock().insert(id.clone(), Busy { stop: stop.clone(), deaf });
        if self.is_leaving() {
            stop.set();
        }
        let alone = self.takes_all_threads(work);
        let all_threads = alone.then(|| self.threads.write().unwrap_or_else(PoisonError::into_inner));
        let beside = !alone && matches!(work, Work::Build { .. });
        let some_threads = beside.then(|| self.threads.read().unwrap_or_else(PoisonError::into_inner));
        let clock = if alone { process_cpu } else { thread_cpu };
        let before = clock();
        let result = catch_unwind(AssertUnwindSafe(|| self.done(work, open, &stop)))
            .unwrap_or_else(|_| Err(JobError::Internal("a task panicked".into())));
        let cpu = clock() - before;
        drop((all_threads, some_threads));
        let result = result.map_err(|e| {
            let no_bucket = if matches!(e, JobError::Stopped) { None } else { self.depot.without_bucket() };
            let e = no_bucket.map_or(e, JobError::from);
            let failure = Failure::from(&e);
            if failure != Failure::Stopped {
                tracing::warn!("{e}");
            }
            failure
        });
        let rest = self.rest(&result);
        let mut bytes = open.map_or_else(Bytes::default, |o| o.shared.nodes.take_bytes());
        bytes.merge(&self.traffic.take());
        let bytes = bytes.rows();
        let (splits, tiles) = open.map(|o| o.shared.nodes.take_reads()).unwrap_or_default();
        let reads = Reads { stage: open.map(|o| o.stage.id.clone()).unwrap_or_default(), splits, tiles };
        let cache_failures = self.copies.as_ref().map_or(0, |c| c.take_failures());
        let resident = open.map_or(0, |o| o.shared.nodes.resident());
        let (worker, holds) = (self.worker.clone(), open.and_then(Opened::holds));
        let report = Report { worker, id: id.clone(), result, cpu, bytes, reads, holds, cache_failures, resident };
        let since = Instant::now();
        while let Err(e) = self.link.report(&report) {
            tracing::warn!("{e}");
            // nobody answers: what was made is done again by others
            if since.elapsed() > PATIENCE || self.is_leaving() {
                break;
            }
            self.pause();
        }
        self.lock().remove(&id);
        // others may take it meanwhile
        let end = Instant::now() + rest;
        while Instant::now() < end && !self.is_leaving() {
            std::thread::sleep(end.saturating_duration_since(Instant::now()).min(PAUSE));
        }
    }

    /// From half of [`PAUSE`] to all of it, each time and for each thread another part.
    fn pause(&self) {
        let number = self.pauses.fetch_add(1, Ordering::Relaxed);
        let mut hasher = blake3::Hasher::new();
        hasher.update(self.worker.session.as_bytes()).update(&number.to_le_bytes());
        let part = f64::from(hasher.finalize().as_bytes()[0]) / 255.0;
        std::thread::sleep(PAUSE.mul_f64(0.5 + 0.5 * part));
    }

    /// How long to wait before more work is asked for: what fails for now would fail again at once.
    fn rest(&self, result: &Result<Done, Failure>) -> Duration {
        match result {
            Ok(_) => self.failures.store(0, Ordering::Relaxed),
            Err(Failure::ForNow { .. }) => {
                let before = self.failures.fetch_add(1, Ordering::Relaxed);
                return FIRST_REST.saturating_mul(1 << before.min(8)).min(LONGEST_REST);
            }
            Err(_) => {}
        }
        Duration::ZERO
    }

    /// Whether work is done by all threads of the process together, and nothing beside it.
    fn takes_all_threads(&self, work: &Work) -> bool {
        match work {
            Work::Prepare { .. } => true,
            Work::Build { splits, .. } => is_large(splits, self.slots),
            _ => false,
        }
    }
}

impl Opened<'_> {
    fn holds(&self) -> Option<Holds> {
        self.holdings.as_ref().map(Holdings::now)
    }
}
