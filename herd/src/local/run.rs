//! A whole job in this process: takes the store, goes on where it ends, runs the loop over rounds on threads.

use std::sync::Arc;
use std::sync::mpsc::channel;

use rayherd_render::film::FilmPart;
use rayherd_render::frame::Frame;

use super::attempt::{FilmUse, Shared};
use super::faults::Schedule;
use super::film::{MemoryFilm, image};
use super::nodes::Nodes;
use super::owner::Ownership;
use super::slots::Gate;
use super::threads::Threads;
use super::{JobOutcome, check, check_copies, journal};
use crate::allot::total;
use crate::driver::{Driver, Pointer, Start};
use crate::job::{JobError, JobSettings, PreparedScene, Progress, Sampling};
use crate::ledger::Ledger;
use crate::store::{BlockStore, Spilling};
use crate::task::camera::{tile_pixels, tiles};
use crate::wave::Done;

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
    check_copies(settings)?;
    let spilling = settings.commits.is_none().then(|| Arc::new(Spilling::new(AT_REST_IN_MEMORY, |_| ())));
    let store = match (&settings.commits, &spilling) {
        (Some(commits), _) => commits.store.clone(),
        (None, Some(spilling)) => spilling.clone() as Arc<dyn BlockStore>,
        (None, None) => return Err(JobError::Internal("a job without a place for its rays".into())),
    };
    let shared = Shared {
        scene,
        frame,
        settings,
        nodes: Nodes::new(scene, settings, store)?,
        film: FilmUse::Handed { stored: settings.commits.is_some() || settings.nodes.len() > 1 },
        buckets: settings.slots(),
    };
    shared.nodes.read_unasked()?;
    let Some(commits) = &settings.commits else {
        let ledger = Ledger::new(&scene.image_name(frame)?, tiles(frame));
        let start = Start {
            settled: ledger.snapshot(Vec::new()),
            ledger,
            film: MemoryFilm::new(&shared.nodes, FilmPart::new(frame.layout()), FilmPart::new(frame.layout())),
            pointer: None,
            session: "job".to_owned(),
            reused: 0,
            redone: 0,
        };
        let mut made = rounds(&shared, start, sampling, progress)?;
        made.report.spilled_bytes = spilling.map_or(0, |s| s.spilled());
        return Ok(made);
    };
    let nodes = &shared.nodes;
    if commits.takeover {
        // what cannot be done must not cost somebody's run
        may_go_on(&shared, commits.resume, sampling)?;
    }
    let owner = Ownership::take(nodes.store().clone(), commits.takeover);
    let owner = Arc::new(nodes.wait(owner)?);
    let result =
        resume(&shared, &owner, commits.resume, sampling).and_then(|start| rounds(&shared, start, sampling, progress));
    // the result is what counts: if this fails, the next run finds a dead owner
    if let Err(e) = nodes.wait(owner.give_back()) {
        tracing::warn!("{e}");
    }
    result
}

/// Refuses what [`resume`] would refuse, as far as it is known without reading pictures.
fn may_go_on(shared: &Shared, may_resume: bool, sampling: &Sampling) -> Result<(), JobError> {
    let place = shared.nodes.store().describe();
    let records = shared.nodes.wait(journal::read(shared.nodes.store().as_ref()))?;
    if !may_resume && !records.is_empty() {
        return Err(holds_a_job(&place));
    }
    let chain = journal::newest_of(&shared.scene.image_name(shared.frame)?, records)?;
    let done = chain.records.iter().rev().find_map(|(_, r)| r.snapshot.as_ref()).map(|s| &s.done);
    done.map_or(Ok(()), |done| enough(&place, shared, done, sampling))
}

fn holds_a_job(place: &str) -> JobError {
    JobError::Settings(format!("{place} holds a job already: resume it, or use another store"))
}

/// Refuses fewer samples than there are: than there are on average, where more are shared out.
fn enough(place: &str, shared: &Shared, done: &Done, sampling: &Sampling) -> Result<(), JobError> {
    let spp = sampling.spp;
    let held = match sampling.target_error {
        None => done.reach(),
        Some(_) => {
            let pixels: Vec<u64> = (0..done.tiles()).map(|t| u64::from(tile_pixels(shared.frame, t))).collect();
            (total(&done.begin(), &pixels) / total(&1.into(), &pixels)) as u32
        }
    };
    if held <= spp {
        return Ok(());
    }
    let message = format!("{place} holds {held} samples per pixel, {spp} were asked for: ask for at least as many");
    Err(JobError::Settings(message))
}

/// Reads the state to go on from.
fn resume<'n, 'a>(
    shared: &'n Shared<'a>,
    owner: &Arc<Ownership>,
    may_resume: bool,
    sampling: &Sampling,
) -> Result<Start<MemoryFilm<'n, 'a>>, JobError> {
    let nodes = &shared.nodes;
    let place = nodes.store().describe();
    if !may_resume && !nodes.wait(nodes.store().list("records/"))?.is_empty() {
        return Err(holds_a_job(&place));
    }
    let image = shared.scene.image_name(shared.frame)?;
    let resumed = journal::resume(nodes, &image, &journal::scope(shared.scene, shared.frame), shared.frame.layout())?;
    enough(&place, shared, resumed.ledger.done(), sampling)?;
    let (settled, settled_film) = resumed.settled;
    Ok(Start {
        ledger: resumed.ledger,
        film: MemoryFilm::new(nodes, resumed.film, settled_film),
        settled,
        pointer: Some(owner.clone() as Arc<dyn Pointer>),
        session: owner.session().to_owned(),
        reused: resumed.reused,
        redone: resumed.lost,
    })
}

/// Runs the loop over rounds on threads.
fn rounds(
    shared: &Shared,
    start: Start<MemoryFilm>,
    sampling: &Sampling,
    progress: &dyn Progress,
) -> Result<JobOutcome, JobError> {
    let settings = shared.settings;
    let threads = settings
        .threads
        .map_or_else(|| std::thread::available_parallelism().map_or(1, |n| n.get()), |n| n.get() as usize);
    let gate = Gate::new(threads);
    let (send, receive) = channel();
    let mut driver = Driver::new(shared, start, sampling, progress);
    let mut late = Vec::new();
    let result = std::thread::scope(|scope| {
        let threads = Threads::new(scope, shared, &gate, (send, &receive));
        let result = match &settings.faults {
            None => driver.run(&threads),
            Some(faults) => {
                let serial = settings.threads.is_some_and(|n| n.get() == 1);
                let schedule = Schedule::new(faults.clone(), &threads, &shared.nodes, serial);
                let result = driver.run(&schedule);
                late = schedule.left();
                result
            }
        };
        driver.stop_all();
        result
    });
    let discarded = driver.discard_late(late.into_iter().chain(receive.try_iter()));
    result?;
    // garbage that stays costs room, not the picture
    if let Err(e) = discarded {
        tracing::warn!("what came too late to count was not deleted: {e}");
    }
    let (film, samples, mut report) = driver.finish()?;
    let film = film.into_sum();
    report.note_non_finite(film.size()[0], &film.rejected().keys);
    Ok(JobOutcome { image: image(&film, &samples), film, samples, report })
}
