//! An executor with virtual nodes, in one process.

#[cfg(test)]
mod allotted;
#[cfg(test)]
mod aovs;
pub mod attempt;
#[cfg(test)]
mod closed_forms;
#[cfg(test)]
mod costs;
mod disks;
pub mod faults;
mod film;
pub mod journal;
pub mod nodes;
pub mod owner;
#[cfg(test)]
mod poisoned;
mod run;
#[cfg(test)]
mod skipping;
pub mod slots;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod textured;
mod threads;
pub mod usage;

use rayherd_render::aov::Aov;
use rayherd_render::film::{FilmPart, Samples};
use rayherd_render::frame::Frame;
pub use run::render_local;

use crate::job::{Image, JobError, JobSettings, PreparedScene, Sampling};
use crate::report::Report;
use crate::resident::FOREST_BYTES;

pub use journal::{Collected, collect};

/// What a job made.
pub struct JobOutcome {
    /// The picture.
    pub image: Image,
    /// Its exact sums.
    pub film: FilmPart,
    /// Samples per pixel in it.
    pub samples: Samples,
    /// What was done and counted.
    pub report: Report,
}

/// Integers from 1 that a float of 32 bits holds.
const MOST_NUMBERS: usize = 1 << 24;

/// Checks the copies of a job that runs in this process, where nodes are stores as well.
pub(crate) fn check_copies(settings: &JobSettings) -> Result<(), JobError> {
    let nodes = settings.nodes.len() as u32;
    if settings.replicas == 0 || settings.replicas > nodes {
        let message = format!("{} copies on {nodes} node(s): give 1 to {nodes} replicas", settings.replicas);
        return Err(JobError::Settings(message));
    }
    Ok(())
}

/// Checks what can be checked before anything is read, wherever a job runs.
pub(crate) fn check(
    scene: &PreparedScene,
    frame: &Frame,
    sampling: &Sampling,
    settings: &JobSettings,
) -> Result<(), JobError> {
    frame.check()?;
    let refuse = |message: String| Err(JobError::Settings(message));
    if sampling.spp == 0 || sampling.spp > crate::wave::MAX_SPP {
        return refuse(format!("{} samples per pixel: give 1 to {}", sampling.spp, crate::wave::MAX_SPP));
    }
    if sampling.target_error.is_some_and(|e| e.is_nan() || e <= 0.0) {
        return refuse("the target error must be above 0".into());
    }
    if sampling.time_limit.is_some_and(|t| t.is_nan() || t < 0.0) {
        return refuse("the time limit must be 0 or more seconds".into());
    }
    if settings.nodes.is_empty() || settings.nodes.iter().any(|n| n.slots == 0) {
        return refuse("give at least one node, each with at least one slot".into());
    }
    if settings.nodes.len() > 1000 || settings.slots() > 10_000 {
        return refuse("at most 1000 nodes and 10000 slots run in one process".into());
    }
    if !(settings.task_seconds > 0.0 && settings.task_seconds.is_finite()) {
        return refuse("the size of a task must be above 0 seconds".into());
    }
    if settings.batch == 0 {
        return refuse("a batch has at least one ray".into());
    }
    // checked here, before any memory is taken: windows are planned in what top trees leave of a task's arena
    let tops = scene.top_bytes();
    if tops > FOREST_BYTES / 2 {
        return refuse(format!(
            "the scene has {} splits, whose upper nodes alone would fill a task's memory ({tops} bytes of {FOREST_BYTES}): prepare it \
             with fewer --splits or a larger --block-size",
            scene.splits()
        ));
    }
    for (aov, numbers) in [(Aov::ObjectId, scene.world.shapes.len()), (Aov::MaterialId, scene.world.materials.len())] {
        if frame.aovs.contains(aov) && numbers > MOST_NUMBERS {
            return refuse(format!(
                "{aov}: {numbers} of them are more than {MOST_NUMBERS}, which its channel tells apart: leave it out"
            ));
        }
    }
    let needed = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap_or(0);
    match settings.memory_per_node {
        Some(given) if given < needed => Err(JobError::Memory { needed, given }),
        _ => Ok(()),
    }
}
