//! What a running job tells whoever watches.

use std::time::Duration;

use crate::report::RayCounts;

/// How far a job is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Status {
    /// Since the start.
    pub elapsed: Duration,
    /// Rays of committed tasks.
    pub rays: RayCounts,
    /// Camera samples started by committed tasks.
    pub samples: u64,
    /// What of `rays` (and of the samples, its camera rays) earlier runs made: not in `elapsed`.
    pub taken_over: RayCounts,
    /// Camera samples that there will be, unless a target error or a time limit ends the job before.
    pub samples_total: u64,
    /// Rays that wait in groups.
    pub waiting: u64,
    /// Rounds (commits) so far.
    pub rounds: u64,
    /// Estimated relMSE at the last complete step, if there was one.
    pub error: Option<f64>,
}

/// An unfinished or finished picture: linear RGB, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width * height` pixels.
    pub pixels: Vec<[f32; 3]>,
}

/// Watches a job. Calls come from the thread that runs it, between commits; they should return soon.
pub trait Progress: Send + Sync {
    /// After each commit, and some times a second while tasks run.
    fn status(&self, status: &Status);
    /// Whether a preview is wanted now; asked after a commit.
    fn wants_preview(&self) -> bool {
        false
    }
    /// Whether the job is to end now, with what is committed kept; asked some times a second.
    fn is_cancelled(&self) -> bool {
        false
    }
    /// Whether the error of the picture so far is wanted; asked after a commit. It costs up to 2 % of the time.
    fn wants_error(&self) -> bool {
        false
    }
    /// The image so far.
    fn preview(&self, _image: &Image) {}
}

/// Nobody watches.
pub struct Silent;

impl Progress for Silent {
    fn status(&self, _: &Status) {}
}
