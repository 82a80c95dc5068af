//! The jobs that this operator runs, each on a thread of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use k8s_openapi::jiff::Timestamp;
use rayherd_api::RenderJobSpec;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::job::Status;
use rayherd_herd::remote::{Fleet, Storage};
use rayherd_herd::report::{RayCounts, Report};

use crate::backoff::Rests;
use crate::storage::is_local;

/// A job that runs, or has run.
pub struct Running {
    /// The generation of the spec that it runs.
    pub generation: i64,
    /// That spec.
    pub spec: RenderJobSpec,
    /// Its workers.
    pub fleet: Fleet,
    /// Its storage, with the nodes that its servers were on when they were last looked for.
    pub storage: RwLock<Storage>,
    /// How far it is.
    pub state: Mutex<State>,
}

/// What was counted of a job before its thread began: by an earlier operator, before a suspension, or of an earlier spec.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Before {
    /// CPU-seconds.
    pub cpu: i64,
    /// Bytes of the scene that were read, and those of them that came from other nodes.
    pub read: [i64; 2],
    /// Tasks that were done again.
    pub redone: i64,
}

impl Before {
    /// As a job's status has it.
    pub fn of(job: &RenderJobObject) -> Self {
        let Some(s) = &job.status else { return Before::default() };
        Before {
            cpu: s.cpu_seconds.unwrap_or(0),
            read: [s.scene_bytes_read.unwrap_or(0), s.scene_bytes_remote.unwrap_or(0)],
            redone: s.tasks_redone.unwrap_or(0),
        }
    }
}

/// How far a job is.
#[derive(Clone, Debug, Default)]
pub struct State {
    /// What was counted before.
    pub before: Before,
    /// How many workers it is to have, where that follows the work.
    pub wanted: Option<u32>,
    /// When its thread began.
    pub started: Option<Timestamp>,
    /// When the first trace task was handed out.
    pub first_task: Option<Timestamp>,
    /// The scene's manifest, when it is prepared.
    pub scene: Option<String>,
    /// It is cut, and its blocks are being built: by all workers.
    pub cut: bool,
    /// It was prepared before.
    pub reused: bool,
    /// Its manifest was known from the job's status: workers of an earlier run may be there.
    pub known: bool,
    /// Of what there are too few copies.
    pub below: Option<String>,
    /// The scene's bytes by node.
    pub held: BTreeMap<String, u64>,
    /// The source's, when its scene is known not to be prepared yet.
    pub source: Option<BTreeMap<String, u64>>,
    /// Of the current frame.
    pub status: Status,
    /// Of the frames that are done.
    pub reports: Vec<Report>,
    /// Address of the last picture that is finished.
    pub picture: Option<String>,
    /// How it ended, and when.
    pub end: Option<(Timestamp, Result<(), Problem>)>,
    /// Containers that were killed for lack of memory, as far as that was told; none before the pods were looked at first, when those
    /// of an earlier run are noted.
    pub killed: Option<BTreeSet<String>>,
    /// Workers whose pods failed or were refused.
    pub rests: Rests,
    /// Why the API server takes no more pods, if that is so.
    pub refused: Option<String>,
    /// Pods whose tokens count, by uid, with the worker that each is.
    pub pods: BTreeMap<String, u32>,
}

/// Why a job did not come to its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// What, and what to do.
    pub message: String,
    /// This operator was told to stop running it: nothing is wrong with the job.
    pub stopped: bool,
}

impl State {
    /// Camera samples made of those asked for, over all of so many frames: 0 to 1.
    pub fn progress(&self, frames: usize) -> f64 {
        let s = &self.status;
        let part = if s.samples_total == 0 { 0.0 } else { (s.samples as f64 / s.samples_total as f64).min(1.0) };
        ((self.reports.len() as f64 + part) / frames.max(1) as f64).min(1.0)
    }
    /// Rays of the frames that are done and of the current one.
    pub fn rays(&self) -> RayCounts {
        let mut rays = self.status.rays;
        self.reports.iter().for_each(|r| rays.merge(&r.rays));
        rays
    }
    /// A frame is done: what is told of the current one is of the next, but for its rounds.
    pub fn done(&mut self, picture: Option<String>, report: Report) {
        self.picture = picture.or(self.picture.take());
        self.reports.push(report);
        (self.status.samples, self.status.rays) = (0, RayCounts::default());
    }
    /// How much there is for workers to do: rays that wait, and camera samples of the current frame that are not made yet.
    pub fn to_do(&self) -> u64 {
        self.status.waiting + self.status.samples_total.saturating_sub(self.status.samples)
    }
}

impl Running {
    /// How far it is.
    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Its storage.
    pub fn storage(&self) -> Storage {
        self.storage.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
    /// Whether the storage has servers on nodes; one that is away just now is on none.
    pub fn is_local(&self) -> bool {
        is_local(&self.storage())
    }
    /// Whether its thread has ended.
    pub fn is_over(&self) -> bool {
        self.lock().end.is_some()
    }
}

/// All of them, by uid.
#[derive(Default)]
pub struct Jobs(Mutex<BTreeMap<String, Arc<Running>>>);

impl Jobs {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Running>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// A job, if it runs or has run here.
    pub fn get(&self, uid: &str) -> Option<Arc<Running>> {
        self.lock().get(uid).cloned()
    }
    /// Adds a job.
    pub fn insert(&self, uid: &str, running: Arc<Running>) {
        self.lock().insert(uid.to_owned(), running);
    }
    /// Forgets a job, whose workers are told that it is over.
    pub fn remove(&self, uid: &str) {
        if let Some(running) = self.lock().remove(uid) {
            running.fleet.end();
        }
    }
    /// Forgets a job whose workers wait for whoever goes on with it.
    pub fn hand_over(&self, uid: &str) {
        if let Some(running) = self.lock().remove(uid) {
            running.fleet.retire();
        }
    }
    /// All of them.
    pub fn all(&self) -> Vec<Arc<Running>> {
        self.lock().values().cloned().collect()
    }
    /// Stops all; what was committed stays, and workers wait for the next operator.
    pub fn stop_all(&self, why: &str) {
        self.all().iter().for_each(|r| r.fleet.cancel(why));
    }
}
