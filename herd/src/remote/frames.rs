//! A whole job, as its operator runs it: prepare the scene, then render frame by frame.

use std::sync::Arc;
use std::time::Duration;

use rayherd_api::{PictureFile, Placement, RenderJobSpec};
use rayherd_render::skip::Skip;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{ObjectHash, ObjectRef, ObjectStore};
use tokio::runtime::Handle;

use super::bands;
use super::guard::Guard;
use super::homes::{Homes, bytes_read};
use super::message::Stage;
use super::parts::Parts;
use super::preparing::prepared;
use super::{Depot, Fleet, Turns};
use crate::driver::{Driver, Pointer, Start};
use crate::job::{JobError, JobSettings, NodeSpec, PreparedScene, Progress, Sampling, spec as from_spec};
use crate::ledger::{FilmRef, Ledger, Scope, Snapshot, is_of_cut, record_key};
use crate::local::attempt::{FilmUse, Shared};
use crate::local::journal;
use crate::local::nodes::Nodes;
use crate::report;
use crate::scenes;
use crate::store::{BlockStore, SceneObjects, StoreError, object_key};

/// How long the end of a job waits for whoever makes a preview of it to stop: it hears that it is to with its next sign of life.
const STOPS: Duration = Duration::from_secs(5);
/// How long the first plan of a frame waits for workers that are not there yet.
const GATHER: Duration = Duration::from_secs(3);

/// Whoever keeps the state of a job where it outlives the operator.
pub trait Keeper: Send + Sync {
    /// The newest record of a frame that counts: its place in the chain and its name.
    ///
    /// # Errors
    /// When that cannot be looked up for now.
    fn newest(&self, frame: u32) -> Result<Option<(u64, String)>, JobError>;
    /// Moves the pointer of a frame to a record that is durable.
    ///
    /// # Errors
    /// [`JobError::Owned`] when somebody else moved it.
    fn move_to(&self, frame: u32, sequence: u64, name: &str) -> Result<(), JobError>;
    /// The scene is cut, and its blocks are to be built by as many workers as there can be: bytes by store.
    fn cut(&self, bytes: &[u64]) {
        self.placed(bytes);
    }
    /// No scene is known that was prepared from the source, which lies on the stores so: bytes by store, nothing where that is not known. A worker is
    /// about to be asked.
    fn source(&self, _bytes: &[u64]) {}
    /// The scene is prepared.
    fn prepared(&self, scene: &ObjectRef, reused: bool);
    /// Which nodes' stores hold the scene: bytes by store.
    fn placed(&self, bytes: &[u64]);
    /// Of something there are fewer copies than asked for; none: there are enough (again).
    fn below(&self, what: Option<&str>);
    /// A frame is done.
    fn done(&self, frame: u32, picture: &[String], report: &report::Report);
}

/// A job to run.
pub struct Job<'a> {
    /// Its checked spec.
    pub spec: &'a RenderJobSpec,
    /// Names of the pictures: one for each frame.
    pub pictures: Vec<String>,
    /// Hash of the manifest of the scene as these settings prepare it, if that is known: then the source need not be read.
    pub known: Option<String>,
    /// A store that is silent for so long is lost: what lies on it is copied again.
    pub patience: Duration,
    /// Where its own objects are in each store.
    pub prefix: String,
    /// Names this run of the operator; objects of another run never have its names.
    pub session: String,
    /// All stores.
    pub depot: &'a Depot,
    /// Its workers.
    pub fleet: &'a Fleet,
    /// Who prepares which scene.
    pub turns: &'a Turns,
    /// Slots of each worker.
    pub slots: Vec<u32>,
    /// Tiles of a band of a film without AOVs ([`super::bands`]).
    pub band: u32,
    /// Primitives of a scene from which on its blocks are built by all workers ([`super::preparing`]).
    pub apart: u64,
    /// Whether its reports say what the stages of attempts cost.
    pub profile: bool,
    /// Where input and output runs; not the caller's thread.
    pub runtime: Handle,
}

/// Runs a job to its end. Blocks.
///
/// # Errors
/// When it cannot be finished; what was committed stays.
pub fn run(job: &Job, keeper: &Arc<dyn Keeper>, progress: &dyn Progress) -> Result<(), JobError> {
    let no_bucket = |e: JobError| if e.may_pass() { job.depot.without_bucket().map_or(e, JobError::from) } else { e };
    let done = frames(job, keeper, progress).map_err(no_bucket);
    // whoever goes on with the job makes another
    if !matches!(done, Err(JobError::Owned(_))) && job.fleet.end_previews(STOPS) {
        let key = [preview_key(&job.prefix)];
        let gone = futures::future::join_all(job.depot.stores().iter().map(|store| store.delete(&key)));
        for e in job.runtime.block_on(gone).into_iter().filter_map(Result::err) {
            tracing::warn!("a preview goes with the job: {e}");
        }
    }
    done
}

/// The key of the preview of a job whose own objects are below a prefix: of the frame that is being rendered.
pub fn preview_key(prefix: &str) -> String {
    format!("{prefix}/preview.png")
}

fn frames(job: &Job, keeper: &Arc<dyn Keeper>, progress: &dyn Progress) -> Result<(), JobError> {
    let spec = job.spec;
    let replicas = spec.replicas.map_or(1, |r| r as u32).max(1);
    if replicas > job.depot.len() {
        let servers = job.depot.len();
        return Err(JobError::Settings(format!(
            "spec.replicas is {replicas}, but the storage has {servers} server(s): ask for at most one copy on each"
        )));
    }
    // until it is known which scene it is, and that is marked
    let looking = job.turns.look(|| job.fleet.check())?;
    let (reference, reused, cells_passed) = match (known(job, replicas)?, &spec.scene.prepared) {
        (Some(known), _) => (known, true, 0),
        (None, Some(hash)) => {
            return Err(JobError::Settings(format!(
                "spec.scene.prepared: {} has no prepared scene {hash}: name spec.scene.source instead, or the hash that status.scene of \
                 a job of this storage says",
                job.depot.replicated(replicas)?.describe()
            )));
        }
        (None, None) => prepared_for_good(job, keeper.as_ref(), replicas)?,
    };
    drop(looking);
    keeper.prepared(&reference, reused);
    let store = Arc::new(job.depot.replicated(replicas)?);
    let objects: Arc<dyn ObjectStore> = Arc::new(SceneObjects::new(store, job.runtime.clone())?);
    let scene = PreparedScene::open(Manifest::load(objects.as_ref(), &reference)?, objects)?;
    let homes = Homes::of(&scene, job.depot.len(), replicas);
    let places = homes.splits();
    keeper.placed(&bytes_read(&scene, places, job.depot.len(), |split| scene.split_bytes(split)));
    let sampling = Sampling {
        spp: from_spec::samples(spec, &scene.manifest),
        target_error: spec.sampling.target_error,
        time_limit: spec.sampling.time_limit,
    };
    for (number, picture) in job.pictures.iter().enumerate() {
        let frame = from_spec::frame(spec, &scene.manifest, spec.image.cameras.get(number))?;
        let number = number as u32;
        let stage = Stage {
            id: format!("{}-{number}", job.session),
            scene: reference,
            band: bands::tiles(job.band, frame.layout()),
            frame,
            prefix: format!("{}/{number}", job.prefix),
            strategy: spec.strategy,
            memory: spec.workers.memory.map(|m| m.bytes()),
            replicas,
            near: spec.placement != Placement::None,
            buckets: job.slots.iter().sum(),
            exposure: spec.image.writes(PictureFile::Png).then(|| spec.image.exposure.unwrap_or(0.0)),
            exr: spec.image.writes(PictureFile::Exr),
            profile: job.profile,
        };
        let (at, mut report) = render(job, keeper, progress, &scene, &stage, places, &sampling, (number, picture))?;
        // known to whoever prepared the scene
        let kept = if reused { scene.manifest.objects().count() as u64 } else { 0 };
        for (skip, count) in [(Skip::Prepared, kept), (Skip::Volume, cells_passed)] {
            report.skips.insert(skip.name().to_owned(), count);
        }
        keeper.done(number, &at, &report);
    }
    Ok(())
}

/// Times that a scene is prepared that is gone when it is looked for.
const PREPARED_AGAIN: u32 = 3;

/// As [`prepared`], and marks it as used. Where another operator deletes it meanwhile it is prepared once more.
fn prepared_for_good(job: &Job, keeper: &dyn Keeper, replicas: u32) -> Result<(ObjectRef, bool, u64), JobError> {
    for _ in 0..PREPARED_AGAIN {
        let made = prepared(job, keeper, replicas)?;
        if used(job, replicas, &made.0.hash)?.is_some() {
            return Ok(made);
        }
        tracing::warn!("scene {} went away as soon as it was found: it is prepared again", made.0.hash);
    }
    let place = job.depot.replicated(replicas)?.describe();
    Err(JobError::Scene(format!("it is gone from {place} each time that it is prepared: see what else deletes there")))
}

/// Marks a scene as used, then looks whether it is there all the same.
fn used(job: &Job, replicas: u32, hash: &ObjectHash) -> Result<Option<ObjectRef>, StoreError> {
    if let Err(e) = job.runtime.block_on(scenes::mark(job.depot.stores(), hash, scenes::unix_now())) {
        tracing::warn!("scene {hash} is not marked as used: {e}");
    }
    let size = job.runtime.block_on(job.depot.replicated(replicas)?.size(&object_key(hash)))?;
    Ok(size.map(|bytes| ObjectRef { hash: *hash, bytes }))
}

/// The manifest that is known by its hash, if it is there still. A job that goes on needs its source no more, which may lie on a store
/// that is silent.
fn known(job: &Job, replicas: u32) -> Result<Option<ObjectRef>, JobError> {
    let Some(hash) = job.known.as_deref().and_then(|h| h.parse().ok()) else { return Ok(None) };
    match used(job, replicas, &hash) {
        Ok(found) => Ok(found),
        Err(e @ StoreError::Unavailable { .. }) if job.spec.scene.prepared.is_none() => {
            tracing::warn!("{e}: the scene is prepared again");
            Ok(None)
        }
        Err(e) => Err(e.into()),
    }
}

fn render(
    job: &Job,
    keeper: &Arc<dyn Keeper>,
    progress: &dyn Progress,
    scene: &PreparedScene,
    stage: &Stage,
    places: &[Vec<u32>],
    sampling: &Sampling,
    (number, picture): (u32, &str),
) -> Result<(Vec<String>, report::Report), JobError> {
    let defaults = JobSettings::default();
    let settings = JobSettings {
        strategy: stage.strategy,
        nodes: job.slots.iter().map(|&slots| NodeSpec { slots }).collect(),
        memory_per_node: stage.memory,
        replicas: stage.replicas,
        profile: stage.profile,
        barrier: job.spec.barrier,
        task_seconds: job.spec.task_seconds.unwrap_or(defaults.task_seconds),
        ..defaults
    };
    crate::local::check(scene, &stage.frame, sampling, &settings)?;
    let part = Arc::new(job.depot.part(&stage.prefix, stage.replicas)?);
    let shared = Shared {
        scene,
        frame: &stage.frame,
        settings: &settings,
        nodes: Nodes::real(scene, &settings, part.clone(), job.depot.len(), None)?,
        film: FilmUse::Banded { band: stage.band, most: 0 },
        buckets: stage.buckets,
    };
    let image = scene.image_name(&stage.frame)?;
    let states = resume(&shared.nodes, &image, &journal::scope(scene, &stage.frame), keeper.newest(number)?)?;
    let pointer = FramePointer { keeper: keeper.clone(), frame: number };
    // where nobody looks where data lies, nobody holds any
    let places = if stage.near { places.to_vec() } else { vec![Vec::new(); places.len()] };
    let least = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap_or(0);
    job.fleet.open(stage.clone(), places, least);
    let film = (stage.frame.size, stage.band);
    let (resumed, film_lost) = whole(job.fleet, film, states)?;
    // rays that wait for splits of another cut of the scene are of no use
    let other_cut = resumed.ledger.waiting().find(|g| !is_of_cut(g, &scene.cut)).map(|g| g.key.clone());
    let other_cut = other_cut.map(|name| JobError::Lost { name, why: journal::OTHER_CUT.into() });
    let lost = film_lost.or(other_cut);
    let start = Start {
        reused: if lost.is_some() { resumed.settled.0.commits } else { resumed.ledger.commits() },
        ledger: resumed.ledger,
        film: Parts::new(job.fleet, film, resumed.film, resumed.settled.1)
            .shown(preview_key(&job.prefix), job.spec.image.exposure.unwrap_or(0.0)),
        settled: resumed.settled.0,
        pointer: Some(Arc::new(pointer)),
        session: job.session.clone(),
        redone: resumed.lost,
    };
    // the first plan decides who holds what: better with all who are about to come
    job.fleet.gather(GATHER)?;
    let mut driver = Driver::new(&shared, start, sampling, progress);
    if let Some(why) = lost {
        driver.go_back(&why)?;
    }
    let guard = Guard::new((job.fleet, job.depot, &part), keeper.as_ref(), &job.runtime, job.patience);
    if let Err(e) = driver.run(&guard) {
        driver.stop_all();
        return Err(e);
    }
    driver.stop_all();
    let (film, samples, mut report) = driver.finish()?;
    let made = film.picture(&samples, picture)?;
    report.note_non_finite(stage.frame.size[0], &made.non_finite);
    let m = &scene.manifest;
    let never = job.fleet.never_read([m.splits.len(), m.tiles.len()]);
    for (skip, count) in [Skip::Splits, Skip::Textures].into_iter().zip(never) {
        report.skips.insert(skip.name().to_owned(), count);
    }
    Ok((made.at, report))
}

struct FramePointer {
    keeper: Arc<dyn Keeper>,
    frame: u32,
}

impl Pointer for FramePointer {
    fn move_to(&self, sequence: u64, name: &str) -> Result<(), JobError> {
        self.keeper.move_to(self.frame, sequence, name)
    }
}

/// A state to go on from, with film parts by reference.
struct Resumed {
    ledger: Ledger,
    film: Vec<FilmRef>,
    settled: (Snapshot, Vec<FilmRef>),
    /// Records of the pointer's chain that are lost.
    lost: u64,
}

/// Follows the chain that ends at the pointer, from its newest snapshot on, and then from each older one. Records beyond the pointer do
/// not count: whoever wrote them did not move it.
///
/// Where the pointer's record cannot be read, or what it stands on, the newest chain before it is followed: what came later is
/// computed again. Where it is of another picture, which a version of other formulas began, the picture begins anew: films of the two are never
/// added up.
fn resume(nodes: &Nodes, image: &str, scope: &Scope, pointer: Option<(u64, String)>) -> Result<Vec<Resumed>, JobError> {
    let begin = || {
        let ledger = Ledger::new(image, scope.tiles);
        Resumed { settled: (ledger.snapshot(Vec::new()), Vec::new()), ledger, film: Vec::new(), lost: 0 }
    };
    let Some((sequence, name)) = pointer else { return Ok(vec![begin()]) };
    let mut records = nodes.wait(journal::read(nodes.store().as_ref()))?;
    if records.get(&name).is_some_and(|newest| newest.image != image) {
        tracing::warn!("{name} was begun by a version that makes another picture of the scene: it is rendered anew");
        return Ok(vec![begin()]);
    }
    // those of a picture that was begun before, too, stay until the job ends
    records.retain(|n, r| r.image == image && (r.sequence < sequence || *n == name));
    let chain = journal::newest_of(image, records)?;
    let place = nodes.store().describe();
    let Some((tip, last)) = chain.records.last() else {
        return Err(JobError::Lost { name, why: format!("{place} lacks the newest round record and all before it") });
    };
    let lost = sequence.saturating_sub(last.sequence);
    if *tip != name {
        let newest = record_key(sequence, &name);
        tracing::warn!("{place}: {newest}, or what it stands on, is lost: {lost} record(s) before it are gone back");
    }
    let replayed = chain.starts().into_iter().map(|start| {
        let mut state = Resumed { lost, ..begin() };
        for (number, (name, record)) in chain.records[start..].iter().enumerate() {
            // the parts so far are the sum of a snapshot of the same state
            let anew = record.snapshot.as_ref().filter(|s| number == 0 || !state.ledger.is_as(s));
            scope.replay(&mut state.ledger, record, name.clone())?;
            if let Some(snapshot) = anew {
                state.film.clone_from(&snapshot.film);
            }
            state.film.extend(record.made.film.clone());
            if state.ledger.is_settled() {
                state.settled = (state.ledger.snapshot(Vec::new()), state.film.clone());
            }
        }
        Ok(state)
    });
    replayed.collect()
}

/// The first of some states whose film is whole; else the one with most in it of those that can be gone back to, and what is lost.
fn whole(fleet: &Fleet, film: ([u32; 2], u32), states: Vec<Resumed>) -> Result<(Resumed, Option<JobError>), JobError> {
    let is_whole = |parts: &[FilmRef]| match Parts::new(fleet, film, parts.to_vec(), Vec::new()).look(&1.into()) {
        Ok(_) => Ok(None),
        Err(e @ JobError::Lost { .. }) => Ok(Some(e)),
        Err(e) => Err(e),
    };
    let mut best: Option<(Resumed, Option<JobError>)> = None;
    for mut state in states {
        // nothing to read, and nobody there to read it yet
        let lost = if state.film.is_empty() { None } else { is_whole(&state.film)? };
        let Some(why) = lost else { return Ok((state, None)) };
        tracing::warn!("{why}; an older snapshot is tried");
        if !state.settled.1.is_empty() && is_whole(&state.settled.1)?.is_some() {
            let nothing = Ledger::new(state.ledger.image(), state.ledger.done().tiles());
            state.settled = (nothing.snapshot(Vec::new()), Vec::new());
        }
        if best.as_ref().is_none_or(|(b, _)| state.settled.0.commits > b.settled.0.commits) {
            best = Some((state, Some(why)));
        }
    }
    best.ok_or_else(|| JobError::Internal("no state to go on from".into()))
}
