//! The loop over rounds: plan, run attempts on threads, commit, until every ray has come to its end.

mod attempts;
mod commit;
mod ending;
mod losses;
mod planning;
mod steps;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::Scope;
use std::time::{Duration, Instant};

use rayherd_render::film::FilmPart;
use rayherd_render::frame::Frame;

use super::attempt::{Attempt, Made, Shared};
use super::cameras::Cameras;
use super::faults::Faults;
use super::journal;
use super::nodes::Nodes;
use super::owner::Ownership;
use super::slots::{Gate, StopFlag};
use super::{JobOutcome, check};
use crate::job::{Image, JobError, JobSettings, PreparedScene, Progress, Sampling};
use crate::ledger::{Ledger, Snapshot, TaskId};
use crate::plan::cost::Traffic;
use crate::plan::rate::Rate;
use crate::report::RayCounts;
use crate::store::Spilling;
use crate::task::camera::tiles;

/// Ray groups and film parts of a job without a store that stay in memory; what is more goes to a temporary folder.
const AT_REST_IN_MEMORY: u64 = 128 << 20;

/// Renders a frame of a prepared scene on virtual nodes in this process.
///
/// The image is a function of (scene, frame, samples) alone, to the byte: not of the settings, not of time.
///
/// # Errors
/// When settings, scene or store do not allow it; see [`JobError`].
pub fn render_local(
    scene: &PreparedScene,
    frame: &Frame,
    sampling: &Sampling,
    settings: &JobSettings,
    progress: &dyn Progress,
) -> Result<JobOutcome, JobError> {
    check(scene, frame, sampling, settings)?;
    let store = match &settings.commits {
        Some(commits) => commits.store.clone(),
        None => Arc::new(Spilling::new(AT_REST_IN_MEMORY)) as _,
    };
    let nodes = Nodes::new(scene, settings, store)?;
    let durable = settings.commits.is_some();
    let shared = Shared {
        scene,
        frame,
        settings,
        nodes,
        store_film: durable || settings.nodes.len() > 1,
        buckets: settings.slots(),
    };
    let image = image_name(scene, frame)?;
    let start = begin(&shared, &image, sampling)?;
    let threads = settings
        .threads
        .map_or_else(|| std::thread::available_parallelism().map_or(1, |n| n.get()), |n| n.get() as usize);
    let gate = Gate::new(threads);
    let (send, receive) = channel();
    let mut driver = Driver::new(&shared, &gate, start, sampling, progress, send);
    let result = std::thread::scope(|scope| {
        let result = driver.run(scope, &receive);
        driver.stop_all();
        result
    });
    driver.discard_late(&receive)?;
    match result {
        Ok(()) => driver.finish(),
        Err(e) => {
            give_back(&shared.nodes, driver.owner.as_ref());
            Err(e)
        }
    }
}

/// Takes the store, if the job keeps commits, and reads the state to go on from.
fn begin(shared: &Shared, image: &str, sampling: &Sampling) -> Result<Start, JobError> {
    let (nodes, size, tiles) = (&shared.nodes, shared.frame.size, tiles(shared.frame));
    let Some(commits) = &shared.settings.commits else {
        let (ledger, film) = (Ledger::new(image, tiles), FilmPart::new(size));
        return Ok(Start { ledger, film, settled: None, owner: None, reused: 0, redone: 0 });
    };
    let owner = nodes.wait(Ownership::take(nodes.store().as_ref(), commits.takeover))?;
    let resume = || {
        let place = nodes.store().describe();
        let refuse = |message: String| Err(JobError::Settings(message));
        if !commits.resume && !nodes.wait(nodes.store().list("records/"))?.is_empty() {
            return refuse(format!("{place} holds a job already: resume it, or use another store"));
        }
        let resumed = journal::resume(nodes, image, tiles, size)?;
        let (reach, spp) = (resumed.ledger.done().reach(), sampling.spp);
        if reach > spp {
            return refuse(format!(
                "{place} holds {reach} samples per pixel, {spp} were asked for: ask for at least as many"
            ));
        }
        Ok(resumed)
    };
    match resume() {
        Ok(r) => Ok(Start {
            ledger: r.ledger,
            film: r.film,
            settled: r.settled,
            owner: Some(owner),
            reused: r.reused,
            redone: r.lost,
        }),
        Err(e) => {
            give_back(nodes, Some(&owner));
            Err(e)
        }
    }
}

/// Gives the store back after an error, which is the one to report: if this fails too, the next run finds a dead owner.
fn give_back(nodes: &Nodes, owner: Option<&Ownership>) {
    if let Some(owner) = owner
        && let Err(e) = nodes.wait(owner.give_back(nodes.store().as_ref()))
    {
        tracing::warn!("{e}");
    }
}

/// Names what defines the image: the scene's content and the frame.
fn image_name(scene: &PreparedScene, frame: &Frame) -> Result<String, JobError> {
    let frame = serde_json::to_vec(frame).map_err(|e| JobError::Internal(e.to_string()))?;
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"rayherd image 1\0").update(&scene.manifest.content.0).update(&frame);
    Ok(hasher.finalize().to_hex().to_string())
}

/// Where a job begins: at nothing, or where an earlier run stopped.
struct Start {
    ledger: Ledger,
    film: FilmPart,
    settled: Option<(Snapshot, FilmPart)>,
    owner: Option<Ownership>,
    reused: u64,
    redone: u64,
}

/// What a thread reports.
struct Message {
    task: TaskId,
    number: u32,
    result: Result<Made, JobError>,
    cpu: f64,
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
    /// Its place among all attempts of the job.
    ordinal: u64,
}

/// Objects by name, with the nodes that hold them.
type Objects = Vec<(String, Vec<u32>)>;

struct Driver<'s, 'a> {
    shared: &'s Shared<'a>,
    gate: &'s Gate,
    ledger: Ledger,
    film: FilmPart,
    cameras: Cameras,
    sampling: &'s Sampling,
    progress: &'s dyn Progress,
    send: Sender<Message>,
    /// Samples whose units were queued.
    queued: u32,
    /// Splits that rays can need along the curve through space, and their places in it.
    order: Vec<u32>,
    rank: Vec<u32>,
    /// How `auto` cuts the scene, in places along the curve, and what each node holds of it.
    cut: Option<Vec<Range<u32>>>,
    windows: Vec<BTreeSet<u32>>,
    traffic: Traffic,
    free: Vec<u32>,
    running: BTreeMap<TaskId, Running>,
    live: BTreeMap<(TaskId, u32), Live>,
    committed: BTreeSet<(TaskId, u32)>,
    launched: u64,
    faults: Option<Faults>,
    owner: Option<Ownership>,
    /// Names of this run's objects begin with it.
    session: String,
    /// State to go back to when rays are lost: the last one without rays on their way.
    settled: (Snapshot, FilmPart),
    /// Objects that the last snapshot made superfluous, and those that the next one will.
    superfluous: [Objects; 2],
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
    error: Option<f64>,
    /// When the error that is shown is found again.
    next_error: Instant,
}

impl<'s, 'a> Driver<'s, 'a> {
    fn new(
        shared: &'s Shared<'a>,
        gate: &'s Gate,
        begin: Start,
        sampling: &'s Sampling,
        progress: &'s dyn Progress,
        send: Sender<Message>,
    ) -> Self {
        let scene = shared.scene;
        let order = scene.owning_order();
        let mut rank = vec![0; scene.splits() as usize];
        order.iter().enumerate().for_each(|(r, &s)| rank[s as usize] = r as u32);
        let starts = scene.start_splits(shared.frame).into_iter().map(|s| rank[s as usize]).collect();
        Driver {
            shared,
            gate,
            queued: begin.ledger.done().complete(),
            settled: begin.settled.unwrap_or_else(|| {
                (Ledger::new("", tiles(shared.frame)).snapshot(None), FilmPart::new(shared.frame.size))
            }),
            taken_over: begin.ledger.rays(),
            session: begin.owner.as_ref().map_or_else(|| "job".to_owned(), |o| o.session().to_owned()),
            ledger: begin.ledger,
            film: begin.film,
            owner: begin.owner,
            reused: begin.reused,
            redone: begin.redone,
            faults: shared.settings.faults,
            cameras: Cameras::new(shared.frame, starts),
            sampling,
            progress,
            send,
            order,
            rank,
            cut: None,
            windows: vec![BTreeSet::new(); shared.settings.nodes.len()],
            traffic: Traffic::default(),
            free: shared.settings.nodes.iter().map(|n| n.slots).collect(),
            running: BTreeMap::new(),
            live: BTreeMap::new(),
            committed: BTreeSet::new(),
            launched: 0,
            superfluous: Default::default(),
            old_records: Default::default(),
            rate: Rate::UNKNOWN,
            start: Instant::now(),
            begun: false,
            rounds: 0,
            tasks: 0,
            hops: 0,
            hop_bytes: 0,
            error: None,
            next_error: Instant::now(),
        }
    }

    fn run<'scope>(&mut self, scope: &'scope Scope<'scope, '_>, receive: &Receiver<Message>) -> Result<(), JobError>
    where
        's: 'scope,
        'a: 'scope,
    {
        let barrier = self.shared.settings.has_barrier();
        loop {
            if self.queued > 0 && self.is_step_over() && self.step_done() {
                return Ok(());
            }
            if self.progress.is_cancelled() {
                return Err(JobError::Cancelled);
            }
            self.queue_steps();
            let mut started = false;
            if !barrier || self.running.is_empty() {
                for task in self.plan() {
                    started |= self.start(scope, task)?;
                }
                self.rounds += u64::from(started && barrier);
            }
            if self.live.is_empty() {
                if self.is_step_over() {
                    continue;
                }
                return Err(JobError::Internal("rays wait, but nothing was planned".into()));
            }
            if !started {
                self.second_attempts(scope);
            }
            match receive.recv_timeout(Duration::from_millis(100)) {
                Ok(message) => self.handle(message)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(JobError::Internal("all threads are gone".into())),
            }
            if let Some(owner) = &mut self.owner {
                let nodes = &self.shared.nodes;
                nodes.wait(owner.beat(nodes.store().as_ref()))?;
            }
            self.tell();
        }
    }

    fn stop_all(&mut self) {
        self.live.values().for_each(|l| l.stop.set());
    }
}

fn image(film: &FilmPart, spp: u32) -> Image {
    let [width, height] = film.size();
    Image { width, height, pixels: film.resolve(spp) }
}
