//! The jobs that this operator runs, each on a thread of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use k8s_openapi::jiff::Timestamp;
use rayherd_api::RenderJobSpec;
use rayherd_herd::job::Status;
use rayherd_herd::remote::{Fleet, Storage};
use rayherd_herd::report::Report;

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

/// How far a job is.
#[derive(Clone, Debug, Default)]
pub struct State {
    /// When its thread began.
    pub started: Option<Timestamp>,
    /// When the first trace task was handed out.
    pub first_task: Option<Timestamp>,
    /// The scene's manifest, when it is prepared.
    pub scene: Option<String>,
    /// It was prepared before.
    pub reused: bool,
    /// Its manifest was known from the job's status: workers of an earlier run may be there.
    pub known: bool,
    /// Of what there are too few copies.
    pub below: Option<String>,
    /// The scene's bytes by node.
    pub held: BTreeMap<String, u64>,
    /// Of the current frame.
    pub status: Status,
    /// Of the frames that are done.
    pub reports: Vec<Report>,
    /// The finished pictures.
    pub pictures: Vec<String>,
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
