//! A worker: slots that ask for work, do it next to their own store, and report.

use std::collections::BTreeMap;
use std::io::BufWriter;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant};

use rayherd_render::film::ErrorSum;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{ObjectRef, ObjectStore};
use tokio::runtime::{Handle, Runtime};

use super::Depot;
use super::bands::Adder;
use super::blocks::{build_blocks, is_large};
use super::holdings::Holdings;
use super::homes::Homes;
use super::message::{Answer, Beat, Done, Failure, Holds, Poll, Reads, Report, Stage, Work, WorkerId};
use super::prepare::prepare_scene;
use super::traffic::Traffic;
use crate::job::spec::definition;
use crate::job::{JobError, JobSettings, NodeSpec, PreparedScene};
use crate::ledger::FilmRef;
use crate::local::attempt::{self, Attempt, FilmUse, Shared};
use crate::local::nodes::{Fetch, Nodes, Part};
use crate::local::slots::StopFlag;
use crate::local::usage::{process_cpu, thread_cpu};
use crate::png_file;
use crate::report::{Bytes, Kind, Place};
use crate::store::{BlockStore, Caching, Copies, SceneObjects, StoreError, object_key, promised_hash};
use crate::task::{Stop, codec};

/// Between two signs of life.
const BEAT: Duration = Duration::from_secs(1);
/// Before an operator that did not answer is asked again.
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
    running: Mutex<BTreeMap<String, StopFlag>>,
    /// Held by one piece of work that takes all threads, or by several that build small blocks.
    threads: RwLock<()>,
    traffic: Traffic,
    leaving: AtomicBool,
    panicked: AtomicBool,
    /// Pieces of work in a row that did not come out for now.
    failures: AtomicU32,
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
        let failures = AtomicU32::new(0);
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
        self.lock().values().for_each(StopFlag::set);
    }

    /// Whether nothing runs, and nothing is about to.
    pub fn is_idle(&self) -> bool {
        self.is_leaving() && self.lock().is_empty()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, StopFlag>> {
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
                    superfluous.iter().filter_map(|id| running.get(id)).for_each(StopFlag::set);
                }
                Err(e) => tracing::debug!("{e}"),
            }
            std::thread::sleep(BEAT);
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
                    std::thread::sleep(PAUSE);
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
                holds: open.and_then(Opened::holds),
            };
            match self.link.poll(&poll) {
                Ok(Answer::Wait) => {}
                Ok(Answer::Work { id, work }) => self.work(id, &work, open),
                Ok(Answer::Open { stage }) => return Next::Open(stage),
                Ok(Answer::Over) => return Next::Over,
                Err(e) => {
                    tracing::warn!("{e}");
                    std::thread::sleep(PAUSE);
                }
            }
        }
        Next::Over
    }

    fn work(&self, id: String, work: &Work, open: Option<&Opened>) {
        let stop = StopFlag::default();
        self.lock().insert(id.clone(), stop.clone());
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
            std::thread::sleep(PAUSE);
        }
        self.lock().remove(&id);
        // others may take it meanwhile
        let end = Instant::now() + rest;
        while Instant::now() < end && !self.is_leaving() {
            std::thread::sleep(end.saturating_duration_since(Instant::now()).min(PAUSE));
        }
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

    fn done(&self, work: &Work, open: Option<&Opened>, stop: &StopFlag) -> Result<Done, JobError> {
        let not_open = || JobError::Internal("work of a stage that is not open".into());
        let open = || open.map(|o| (o.stage, &o.shared)).ok_or_else(not_open);
        match work {
            Work::Prepare { spec, replicas, apart, .. } => {
                prepare_scene(self.place(), spec, *replicas, apart.as_ref(), &self.scratch)
            }
            Work::Build { prefix, splits, replicas } => {
                let alone = self.takes_all_threads(work);
                let blocks = build_blocks(self.place(), prefix, splits, *replicas, alone, stop)?;
                tracing::info!(splits = blocks.len(), "blocks built");
                Ok(Done::Built { blocks })
            }
            Work::Attempt { attempt } => {
                let (_, shared) = open()?;
                let attempt = Attempt { node: self.node(), ..attempt.clone() };
                let made = attempt::run(shared, &attempt, stop)?;
                let attempt::Made { outputs, hops, skipped, profile, .. } = made;
                Ok(Done::Made { outputs, hops, skipped, profile: profile.map(Box::new) })
            }
            Work::Merge { name, parts, spp, picture, band } => {
                let (stage, shared) = open()?;
                let read = self.reads_film(stage, shared);
                let adder = Adder { layout: stage.frame.layout(), band: stage.band, read: &read };
                match picture {
                    Some(key) => self.picture(&adder, (stage, shared), parts, *spp, key),
                    None => self.merge(&adder, shared, name.as_deref(), (parts, *band), *spp),
                }
            }
            Work::Preview { parts, spp, key, exposure } => {
                let (stage, shared) = open()?;
                let read = self.reads_film(stage, shared);
                let adder = Adder { layout: stage.frame.layout(), band: stage.band, read: &read };
                self.preview(&adder, parts, *spp, (key, *exposure), stop)
            }
            Work::Copy { objects, gone } => {
                let (_, shared) = open()?;
                let mut copied = Vec::new();
                for (name, holders) in objects {
                    stop.check()?;
                    let now = shared.nodes.copy_elsewhere(name, holders, *gone)?;
                    copied.extend(now.map(|holders| (name.clone(), holders)));
                }
                Ok(Done::Copied { objects: copied })
            }
            Work::Restore { gone } => {
                let (stage, shared) = open()?;
                self.restore(stage, shared.scene, *gone, stop)
            }
        }
    }

    /// Copies of the scene's objects that lay on a store which is silent, made again where there is one.
    fn restore(&self, stage: &Stage, scene: &PreparedScene, gone: u32, stop: &StopFlag) -> Result<Done, JobError> {
        let (count, replicas, m) = (self.depot.len(), stage.replicas, &scene.manifest);
        let homes = Homes::of(scene, count, replicas);
        let splits = m.splits.iter().zip(homes.splits()).filter(|(_, on)| on.contains(&gone));
        let tiles = (0..).zip(&m.tiles).filter(|(n, _)| homes.tile(*n).contains(&gone));
        // what belongs to no place may be anywhere
        let others = [&m.world, &stage.scene].into_iter().chain(&m.sky_map);
        let objects = splits.flat_map(|(s, _)| [&s.geometry, &s.attributes]).chain(tiles.map(|t| t.1)).chain(others);
        let store = self.depot.replicated(replicas)?;
        let (mut copies, mut few) = (0, 0);
        for object in objects {
            stop.check()?;
            let (copied, enough) = self.runtime.block_on(store.replicated().keep_up(&object_key(&object.hash)));
            copies += copied;
            few += u64::from(!enough);
        }
        Ok(Done::Restored { copies, few })
    }

    /// Where preparing works.
    fn place(&self) -> (&Depot, &Handle, &Traffic) {
        (&self.depot, self.runtime.handle(), &self.traffic)
    }

    /// Whether work is done by all threads of the process together, and nothing beside it.
    fn takes_all_threads(&self, work: &Work) -> bool {
        match work {
            Work::Prepare { .. } => true,
            Work::Build { splits, .. } => is_large(splits, self.slots),
            _ => false,
        }
    }

    /// Our place among the stores; one past them when none is here.
    fn node(&self) -> u32 {
        self.depot.home().unwrap_or(self.depot.len())
    }

    fn reads_film<'a>(
        &'a self,
        stage: &'a Stage,
        shared: &'a Shared,
    ) -> impl Fn(&FilmRef) -> Result<Vec<u8>, JobError> + 'a {
        move |part| {
            let open = |body: &bytes::Bytes| codec::open_film(stage.frame.layout(), body);
            shared.nodes.get(self.node(), Kind::Film, &part.key, &part.holders, open)
        }
    }

    fn no_room(&self, e: std::io::Error) -> JobError {
        JobError::Settings(format!("cannot write a picture in {}: {e}; give it room", self.scratch.display()))
    }

    fn merge(
        &self,
        adder: &Adder,
        shared: &Shared,
        name: Option<&str>,
        (parts, band): (&[FilmRef], Option<u32>),
        spp: u32,
    ) -> Result<Done, JobError> {
        let sum = adder.sum(parts, band)?;
        let film = match name {
            Some(key) if !sum.is_empty() => {
                let body = codec::seal_film(&sum.encode());
                let bytes = body.len() as u64;
                let holders = shared.nodes.put(self.node(), Kind::Film, key, body)?;
                Some(FilmRef { key: key.to_owned(), band, bytes, holders })
            }
            _ => None,
        };
        let non_finite = sum.rejected().keys.iter().copied().collect();
        Ok(merged(adder, film, sum.error_sum(spp), non_finite, Vec::new()))
    }

    /// Makes a PNG of a film that is not finished, in a file of our own, then puts it on the stores that take it.
    fn preview(
        &self,
        adder: &Adder,
        parts: &[FilmRef],
        spp: u32,
        (key, exposure): (&str, f64),
        stop: &StopFlag,
    ) -> Result<Done, JobError> {
        let io = |e| self.no_room(e);
        std::fs::create_dir_all(&self.scratch).map_err(io)?;
        let file = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let mut rows = png_file::Rows::new(file.reopen().map_err(io)?, adder.layout.size, exposure).map_err(io)?;
        adder.show(parts, spp, |row| {
            stop.check()?;
            rows.add(row).map_err(io)
        })?;
        rows.finish().and_then(|()| png_file::check_end(file.as_file())).map_err(io)?;
        for store in self.depot.stores() {
            stop.check()?;
            if let Err(e) = self.runtime.block_on(store.put_file(key, file.path())) {
                tracing::warn!("no preview: {e}");
            }
        }
        Ok(Done::Previewed)
    }

    /// Makes a picture in a file of our own, and the PNG beside it, then puts those that are wanted on the stores that take them.
    fn picture(
        &self,
        adder: &Adder,
        (stage, shared): (&Stage, &Shared),
        parts: &[FilmRef],
        spp: u32,
        key: &str,
    ) -> Result<Done, JobError> {
        let io = |e| self.no_room(e);
        std::fs::create_dir_all(&self.scratch).map_err(io)?;
        // gone with the value
        let file = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let definition = definition(&shared.scene.manifest, shared.frame, spp)?;
        let offset = shared.scene.manifest.offset;
        let shown = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let rows = |e| png_file::Rows::new(shown.reopen()?, shared.frame.size, e);
        let mut rows = stage.exposure.map(rows).transpose().map_err(io)?;
        let seen = |row: &[[f32; 3]]| rows.as_mut().map_or(Ok(()), |r| r.add(row)).map_err(io);
        let totals = adder.picture(parts, spp, offset, &definition, BufWriter::new(file.as_file()), seen)?;
        let beside =
            rows.map(|r| r.finish().and_then(|()| png_file::check_end(shown.as_file())).map_err(io)).transpose()?;
        let beside = beside.map(|()| (format!("{}.png", key.strip_suffix(".exr").unwrap_or(key)), shown.path()));
        // the PNG first: where the EXR is, it stands beside it
        let files: Vec<(String, &Path)> =
            beside.into_iter().chain(stage.exr.then(|| (key.to_owned(), file.path()))).collect();
        let main = files.last().map_or(key, |(key, _)| key);
        let mut at = Vec::new();
        let mut error: Option<StoreError> = None;
        // on every store, so that each of them shows it
        for store in self.depot.stores() {
            let put = async {
                for (key, file) in &files {
                    store.put_file(key, file).await?;
                }
                Ok(())
            };
            match self.runtime.block_on(put) {
                Ok(()) => at.push(format!("{}/{main}", store.describe())),
                Err(e) => {
                    tracing::warn!("{e}");
                    error = Some(e);
                }
            }
        }
        match error {
            Some(e) if at.is_empty() => Err(e.into()),
            _ => Ok(merged(adder, None, totals.error, totals.non_finite.into_iter().collect(), at)),
        }
    }
}

impl Opened<'_> {
    fn holds(&self) -> Option<Holds> {
        self.holdings.as_ref().map(Holdings::now)
    }
}

/// What came out of adding up. The mean is for operators that know no bands.
fn merged(
    adder: &Adder,
    film: Option<FilmRef>,
    error: Option<ErrorSum>,
    non_finite: Vec<(u32, u32)>,
    picture: Vec<String>,
) -> Done {
    Done::Merged { film, rel_mse: error.map(|e| e.mean(adder.layout.size)), error, non_finite, picture }
}

/// Reads blocks from the cache and the store at home first, then from where they belong, then from anywhere.
struct Near<'s, 'l> {
    station: &'s Station<'l>,
    homes: Homes,
    /// The store that is asked first, wherever the object belongs.
    home: Option<u32>,
}

impl Fetch for Near<'_, '_> {
    fn fetch(&self, part: Part, object: &ObjectRef) -> Result<(Vec<u8>, Place), JobError> {
        let Station { depot, copies, runtime, .. } = self.station;
        let key = object_key(&object.hash);
        // nothing is kept there that is not what this key promises, and it is checked again
        if let Some(body) = copies.as_ref().and_then(|c| runtime.block_on(c.get(&key))) {
            return Ok((body.into(), Place::Local));
        }
        let (home, first) = (depot.home(), self.home);
        let mut holders = match part {
            Part::Split(n) => self.homes.splits()[n as usize].clone(),
            Part::Tile(n) => self.homes.tile(n),
        };
        if first.is_none() && !holders.is_empty() {
            // nobody is near: the copies share what is read
            let turn = usize::from(blake3::hash(object.hash.to_string().as_bytes()).as_bytes()[0]) % holders.len();
            holders.rotate_left(turn);
        }
        let holders = holders.into_iter().filter(|&h| Some(h) != first);
        let mut order: Vec<u32> = first.into_iter().chain(holders).collect();
        order.extend((0..depot.len()).filter(|n| !order.contains(n)).collect::<Vec<u32>>());
        let mut error = None;
        for number in order {
            let store = &depot.stores()[number as usize];
            let why = match runtime.block_on(store.get(&key)) {
                Ok(body) => match object.verify(&body) {
                    Ok(()) if Some(number) == home => return Ok((body.into(), Place::Local)),
                    Ok(()) => {
                        if let Some(copies) = copies {
                            runtime.block_on(copies.keep(&key, &body));
                        }
                        return Ok((body.into(), Place::Remote));
                    }
                    Err(message) => StoreError::Corrupt { store: store.describe(), key: key.clone(), message },
                },
                Err(e) => e,
            };
            if !matches!(why, StoreError::NotFound { .. }) {
                tracing::warn!("{why}");
            }
            // the one that may pass tells whether to try again
            error = match error {
                Some(e @ StoreError::Unavailable { .. }) => Some(e),
                _ => Some(why),
            };
        }
        Err(error.map_or_else(|| JobError::Internal("no store was asked".into()), JobError::from))
    }
}
