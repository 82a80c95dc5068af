//! A job's thread: runs the loop over rounds, and tells how far it is.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use k8s_openapi::jiff::Timestamp;
use kube::Client;
use rayherd_api::ByteSize;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::job::spec::scene_settings;
use rayherd_herd::job::{JobError, Progress, Status};
use rayherd_herd::remote::bands::BAND;
use rayherd_herd::remote::frames::{Job, Keeper, run};
use rayherd_herd::remote::preparing::APART;
use rayherd_herd::remote::{Depot, Fleet, Storage, Turns};
use rayherd_herd::report::Report;
use rayherd_scene::objects::ObjectRef;
use tokio::runtime::Handle;

use crate::build;
use crate::jobs::{Before, Problem, Running, State};
use crate::ledger::{Beside, Ledger};
use crate::trigger::Wake;

/// A store that is silent for so long is lost, and what lies on it is copied again: longer than a server takes to start anew.
const LOST: Duration = Duration::from_secs(15);
/// Previews of a job that somebody watches are made no more often.
const PREVIEW_EVERY: Duration = Duration::from_secs(30);

/// Where a job's own objects are.
pub fn prefix(uid: &str) -> String {
    format!("jobs/{uid}")
}

/// Keys of the pictures: one for each frame.
pub fn pictures(job: &RenderJobObject) -> Vec<String> {
    let name = job.metadata.name.clone().unwrap_or_default();
    let namespace = job.metadata.namespace.clone().unwrap_or_default();
    let file = job.spec.image.output.clone().unwrap_or_else(|| format!("{name}.exr"));
    let cameras = &job.spec.image.cameras;
    let path = |file: &str| job.spec.image.key(&namespace, &name, file);
    if cameras.len() < 2 {
        return vec![path(&file)];
    }
    let stem = file.strip_suffix(".exr").unwrap_or(&file);
    let numbered = cameras.iter().enumerate().map(|(i, c)| {
        let mark = c.name.clone().unwrap_or_else(|| format!("{:04}", i + 1));
        path(&format!("{stem}-{mark}.exr"))
    });
    numbered.collect()
}

/// The manifest of a job's scene, if its spec names it, or the status has one of the settings as they are now.
pub fn known_scene(job: &RenderJobObject) -> Option<String> {
    if job.spec.scene.prepared.is_some() {
        return job.spec.scene.prepared.clone();
    }
    let status = job.status.as_ref()?;
    let settings = status.scene_settings.as_ref()?;
    status.scene.clone().filter(|_| *settings == scene_settings(&job.spec))
}

/// Starts a job. `before` is the run of an earlier spec whose workers it takes over; `wake` is for what the next step is not to wait for.
pub fn start(
    client: Client,
    job: Arc<RenderJobObject>,
    storage: Storage,
    depot: Depot,
    turns: Arc<Turns>,
    before: Option<&Running>,
    wake: Wake,
) -> Arc<Running> {
    let nanos = Timestamp::now().as_nanosecond();
    let slots = build::slots(&job);
    let session = format!("o{nanos:x}");
    let known = known_scene(&job);
    let (pods, held) = before.map(|b| b.lock()).map(|b| (b.pods.clone(), b.held.clone())).unwrap_or_default();
    let begun = State {
        started: Some(Timestamp::now()),
        known: known.is_some(),
        before: Before::of(&job),
        wanted: before.and_then(|b| b.lock().wanted),
        pods,
        held,
        ..State::default()
    };
    let running = Arc::new(Running {
        generation: job.metadata.generation.unwrap_or(0),
        spec: job.spec.clone(),
        fleet: Fleet::new(slots.len() as u32, &session),
        storage: storage.into(),
        state: begun.into(),
    });
    let beside = Beside {
        depot: depot.clone(),
        replicas: job.spec.replicas.map_or(1, |r| r.max(1) as u32),
        prefix: prefix(job.metadata.uid.as_deref().unwrap_or_default()),
    };
    let ledger = Ledger::new(client, &job, Handle::current(), beside);
    let keeper = Kept { ledger, running: running.clone(), wake: wake.clone() };
    let runtime = Handle::current();
    let of_thread = running.clone();
    let name = job.metadata.name.clone().unwrap_or_default();
    let work = move || {
        let mut spec = job.spec.clone();
        spec.workers.memory = Some(ByteSize::new(build::memory(&job)));
        let task = Job {
            spec: &spec,
            pictures: pictures(&job),
            known,
            patience: LOST,
            prefix: prefix(job.metadata.uid.as_deref().unwrap_or_default()),
            session,
            depot: &depot,
            fleet: &of_thread.fleet,
            turns: &turns,
            slots,
            band: BAND,
            apart: APART,
            // a RenderJob does not ask for it
            profile: false,
            runtime,
        };
        let keeper: Arc<dyn Keeper> = Arc::new(keeper);
        let watch = Watch(of_thread.clone(), job.metadata.name.clone().unwrap_or_default());
        let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(&task, &keeper, &watch)));
        let result = caught.unwrap_or_else(|_| Err(JobError::Internal("the job's thread panicked".into())));
        // stores that do not answer the operator for now may do so soon: nothing is wrong with the job either
        let stopped = |e: &JobError| matches!(e, JobError::Owned(_)) || e.may_pass();
        let result = result.map_err(|e| Problem { stopped: stopped(&e), message: e.to_string() });
        if let Err(problem) = &result {
            tracing::warn!(job = %job.metadata.name.clone().unwrap_or_default(), "{}", problem.message);
        }
        // workers of a job that was stopped wait for whoever goes on with it, those that are kept warm for more samples
        let stay = match &result {
            Ok(()) => build::keep_warm(&job).is_some(),
            Err(problem) => problem.stopped,
        };
        if !stay {
            of_thread.fleet.end();
        }
        of_thread.lock().end = Some((Timestamp::now(), result));
        wake.now();
    };
    if let Err(e) = thread::Builder::new().name(format!("job {name}")).spawn(work) {
        let problem = Problem { message: format!("no thread for the job: {e}"), stopped: true };
        running.lock().end = Some((Timestamp::now(), Err(problem)));
    }
    running
}

struct Kept {
    ledger: Ledger,
    running: Arc<Running>,
    wake: Wake,
}

impl Keeper for Kept {
    fn newest(&self, frame: u32) -> Result<Option<(u64, String)>, JobError> {
        self.ledger.newest(frame)
    }
    fn move_to(&self, frame: u32, sequence: u64, name: &str) -> Result<(), JobError> {
        self.ledger.move_to(frame, sequence, name)
    }
    fn prepared(&self, scene: &ObjectRef, reused: bool) {
        let mut state = self.running.lock();
        (state.scene, state.reused) = (Some(scene.hash.to_string()), reused);
    }
    fn cut(&self, bytes: &[u64]) {
        let by_node = self.by_node(bytes);
        {
            let mut state = self.running.lock();
            (state.held, state.cut) = (by_node, true);
        }
        self.wake.now();
    }
    fn source(&self, bytes: &[u64]) {
        let by_node = self.by_node(bytes);
        self.running.lock().source = Some(by_node);
    }
    fn below(&self, what: Option<&str>) {
        self.running.lock().below = what.map(str::to_owned);
        self.wake.now();
    }
    fn placed(&self, bytes: &[u64]) {
        let by_node = self.by_node(bytes);
        self.running.lock().held = by_node;
        self.wake.now();
    }
    fn done(&self, _: u32, picture: &[String], report: &Report) {
        // one address of each picture is enough
        self.running.lock().done(picture.first().cloned(), report.clone());
    }
}

impl Kept {
    /// Bytes by store as bytes by node, as far as nodes are known.
    fn by_node(&self, bytes: &[u64]) -> BTreeMap<String, u64> {
        let mut all = BTreeMap::new();
        for (endpoint, bytes) in self.running.storage().endpoints.iter().zip(bytes) {
            if let Some(node) = &endpoint.node {
                *all.entry(node.clone()).or_default() += bytes;
            }
        }
        all
    }
}

struct Watch(Arc<Running>, String);

impl Progress for Watch {
    fn wants_preview(&self) -> bool {
        self.0.fleet.wants_preview(PREVIEW_EVERY)
    }
    fn status(&self, status: &Status) {
        let first = self.0.fleet.tally().first_attempt;
        let mut state = self.0.lock();
        state.status = *status;
        if state.first_task.is_none()
            && let Some(at) = first
        {
            state.first_task = Timestamp::now().checked_sub(at.elapsed()).ok();
            let began = state.started.map(|t| t.duration_until(Timestamp::now()));
            tracing::info!(job = self.1, ?began, "the first task was handed out");
        }
    }
}
