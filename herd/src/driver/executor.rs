//! What the loop over rounds needs of its surroundings: where tasks run, where their film is summed, who keeps the ledger.

use std::time::Duration;

use rayherd_render::film::{ErrorSum, Samples};

use crate::job::{Image, JobError};
use crate::ledger::{FilmRef, TaskId};
use crate::local::attempt::{Attempt, Made};
use crate::local::slots::StopFlag;
use crate::report::Bytes;

/// Objects by name, with the nodes that hold them.
pub type Objects = Vec<(String, Vec<u32>)>;

/// An attempt to start.
pub struct Launch {
    /// Of which task.
    pub task: TaskId,
    /// Which attempt of it.
    pub number: u32,
    /// What to do, and on which node.
    pub attempt: Attempt,
    /// Set when the attempt need not go on.
    pub stop: StopFlag,
}

/// An attempt that came to its end.
pub struct Finished {
    /// Of which task.
    pub task: TaskId,
    /// Which attempt of it.
    pub number: u32,
    /// What it made. [`JobError::Stopped`] when it ended, or its node did, without a result.
    pub result: Result<Made, JobError>,
    /// CPU-seconds that it took.
    pub cpu: f64,
    /// Bytes that it moved, unless the job's own nodes have counted them.
    pub bytes: Bytes,
}

/// What an executor tells of.
pub enum Event {
    /// An attempt came to its end.
    Finished(Box<Finished>),
    /// A node has lost its memory and its disk, and is there again, empty.
    NodeLost(u32),
    /// A node has lost what it held in memory.
    MemoryLost(u32),
    /// Workers were killed for lack of memory: what is planned from now on must fit [`Executor::memory`], and all of them have lost what
    /// they held.
    LessMemory,
    /// A store is silent, and has been for so long that what lay on it is to be copied again.
    StoreLost(u32),
}

/// Where tasks run.
pub trait Executor {
    /// Whether the node takes tasks now.
    fn is_up(&self, node: u32) -> bool;
    /// Nodes next to a copy of each split, where the executor knows better than the job's own nodes.
    fn holders(&self) -> Option<Vec<Vec<u32>>> {
        None
    }
    /// Scene data that a task may hold, bytes, where that is less than the job's settings say.
    fn memory(&self) -> Option<u64> {
        None
    }
    /// Copies objects that lie on a store which is silent, from the copies that are left; where they lie now.
    ///
    /// # Errors
    /// When nothing can be copied.
    fn copy_again(&self, _objects: Objects, _gone: u32) -> Result<Objects, JobError> {
        Ok(Vec::new())
    }
    /// What else lay on that store, the scene and the records, is copied again. Of the rays and film, so many have too few copies all
    /// the same.
    ///
    /// # Errors
    /// When nothing can be copied.
    fn restore(&self, _gone: u32, _few: usize) -> Result<(), JobError> {
        Ok(())
    }
    /// Whether one more attempt would compute at once.
    fn has_room(&self) -> bool;
    /// Starts an attempt. It is told of by [`Executor::next`], at least once.
    fn launch(&self, launch: Launch);
    /// What happens next; none after `wait`.
    ///
    /// # Errors
    /// When nothing can run any more.
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError>;
}

/// The sum of all committed film parts, and a state of it to go back to.
pub trait FilmSum {
    /// Adds the part of a commit.
    ///
    /// # Errors
    /// When it is of another size.
    fn add(&mut self, made: &Made) -> Result<(), JobError>;
    /// Keeps the sum as it is, to go back to.
    fn settle(&mut self);
    /// Goes back to what was kept.
    fn go_back(&mut self);
    /// Stores the sum in objects whose names begin so, as far as it is not stored yet; where all of it lies then: nowhere when it is
    /// empty.
    ///
    /// # Errors
    /// When it cannot be stored.
    fn store(&mut self, name: &str) -> Result<Vec<FilmRef>, JobError>;
    /// Estimated relMSE of so many samples per pixel, if there are two.
    ///
    /// # Errors
    /// When the sum cannot be had.
    fn rel_mse(&mut self, samples: &Samples) -> Result<Option<f64>, JobError>;
    /// What it is the mean of, by tile.
    ///
    /// # Errors
    /// When the sum cannot be had.
    fn tile_errors(&mut self, samples: &Samples) -> Result<Option<Vec<ErrorSum>>, JobError>;
    /// Stored objects that lie on a store.
    fn on_store(&self, _store: u32) -> Objects {
        Vec::new()
    }
    /// An object lies elsewhere now.
    fn relocate(&mut self, _name: &str, _holders: &[u32]) {}
    /// Whether a stored object is still needed.
    fn needs(&self, name: &str) -> bool;
    /// The error of the sum as it is, about, for whoever watches: only where it costs little.
    fn shown_error(&self, _samples: &Samples) -> Option<f64> {
        None
    }
    /// The picture of the sum as it is, likewise.
    fn preview(&self, _samples: &Samples) -> Option<Image> {
        None
    }
}

/// Where it is kept which record is the newest: the one place that must be consistent.
pub trait Pointer: Send + Sync {
    /// Whether it may be moved, as far as is known: asked before a record is written.
    ///
    /// # Errors
    /// [`JobError::Owned`] when somebody else may have moved it.
    fn check(&self) -> Result<(), JobError> {
        Ok(())
    }
    /// Moves the pointer to a record that is durable.
    ///
    /// # Errors
    /// [`JobError::Owned`] when somebody else moved it.
    fn move_to(&self, sequence: u64, name: &str) -> Result<(), JobError>;
}
