//! Pictures of a film that is not finished, for whoever watches a job: nobody waits for them, and nothing depends on them.
//!
//! They are made by clerks, who take no attempts, when these have nothing else to do, one at a time and only while somebody asks for them. One
//! that fails, or whose worker goes, is not made again: the next one comes soon.

use std::time::{Duration, Instant};

use super::Fleet;
use super::state::{State, What};
use crate::remote::message::Work;

/// What is known of them.
#[derive(Default)]
pub struct Preview {
    /// Somebody watches.
    pub wanted: bool,
    /// When one was asked for last.
    pub last: Option<Instant>,
    /// One that nobody has begun.
    pub waiting: Option<Work>,
    /// One was begun: it may lie in the stores.
    pub made: bool,
}

impl Fleet {
    /// Whether somebody watches the job, and wants to see its picture.
    pub fn show(&self, wanted: bool) {
        self.lock().preview.wanted = wanted;
    }

    /// Whether a preview is to be made now: somebody wants to see one, none is waiting or being made, and the last one was begun that long ago.
    pub fn wants_preview(&self, every: Duration) -> bool {
        let state = self.lock();
        let Preview { wanted, last, waiting, .. } = &state.preview;
        *wanted && last.is_none_or(|t| t.elapsed() >= every) && waiting.is_none() && !is_previewing(&state)
    }

    /// Leaves a preview to a clerk who has nothing else to do.
    pub fn preview(&self, work: Work) {
        let mut state = self.lock();
        state.preview.last = Some(Instant::now());
        state.preview.waiting = Some(work);
        drop(state);
        self.wanted.notify_waiters();
    }

    /// Has none made any more, and waits until whoever makes one has stopped, but not longer than this. Whether one may lie in the stores: one
    /// that was made here, or by an earlier operator for the same person.
    pub fn end_previews(&self, patience: Duration) -> bool {
        let end = Instant::now() + patience;
        let mut state = self.lock();
        state.preview.waiting = None;
        for doing in state.doing.values() {
            if let What::Preview { stop } = &doing.what {
                stop.set();
            }
        }
        while is_previewing(&state) && Instant::now() < end {
            state.sweep();
            state = self.wait(state, Duration::from_millis(50));
        }
        state.preview.made || state.preview.wanted
    }
}

fn is_previewing(state: &State) -> bool {
    state.doing.values().any(|d| matches!(d.what, What::Preview { .. }))
}
