//! What a fleet has done, in numbers.

use std::collections::BTreeMap;
use std::time::Instant;

use super::super::message::{Done, Failure};
use crate::report::Bytes;

/// How an attempt at a task ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Outcome {
    /// With a result.
    Made,
    /// It was given back, or another one had done the task.
    Stopped,
    /// Its worker, which had begun it, went away.
    Gone,
    /// What it was to work on was lost.
    Lost,
    /// It failed.
    Failed,
}

impl Outcome {
    /// All of them.
    pub const ALL: [Outcome; 5] = [Outcome::Made, Outcome::Stopped, Outcome::Gone, Outcome::Lost, Outcome::Failed];

    /// Its name in metrics.
    pub fn name(self) -> &'static str {
        match self {
            Outcome::Made => "made",
            Outcome::Stopped => "stopped",
            Outcome::Gone => "gone",
            Outcome::Lost => "lost",
            Outcome::Failed => "failed",
        }
    }

    pub(super) fn of(result: &Result<Done, Failure>) -> Self {
        match result {
            Ok(_) => Outcome::Made,
            Err(Failure::Stopped) => Outcome::Stopped,
            Err(Failure::Lost { .. }) => Outcome::Lost,
            Err(Failure::ForNow { .. } | Failure::ForGood { .. }) => Outcome::Failed,
        }
    }
}

/// What one worker has done so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WorkerTally {
    /// CPU-seconds of its work.
    pub cpu: f64,
    /// Bytes of scene data that it held in memory when it reported last.
    pub resident: u64,
}

/// What a fleet has done so far, for the status of its job.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Workers that are there.
    pub ready: u32,
    /// Bytes moved.
    pub bytes: Bytes,
    /// CPU-seconds of all work.
    pub cpu: f64,
    /// Copies that workers' caches could not keep, or have lost.
    pub cache_failures: u64,
    /// Rays that left a task for a split that it did not hold.
    pub hops: u64,
    /// Attempts that ended, by how.
    pub outcomes: BTreeMap<Outcome, u64>,
    /// By worker.
    pub by_worker: BTreeMap<u32, WorkerTally>,
    /// Work that nobody has taken yet.
    pub queued: u64,
    /// Work in workers' hands.
    pub running: u64,
    /// When the first attempt was handed out.
    pub first_attempt: Option<Instant>,
}
