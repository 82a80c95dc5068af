//! Why a job could not be run.

use rayherd_render::attributes::AttributeError;
use rayherd_render::bvh::{ForestError, UnsupportedKernel};
use rayherd_render::film::FilmError;
use rayherd_render::frame::FrameError;
use rayherd_scene::manifest::ManifestError;
use rayherd_scene::objects::ObjectError;

use crate::ledger::{ChainError, Refused};
use crate::store::{StoreError, object_is_users};
use crate::wire::WireError;

/// Why a job could not be run. [`JobError::is_users`] tells the user's mistakes from failures.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// Settings that cannot be.
    #[error("{0}")]
    Settings(String),
    /// A node cannot hold what a task needs at once.
    #[error(
        "{given} bytes of memory per node are too few: the largest split takes {needed}; give more \
         --memory, or prepare more --splits or a smaller --block-size"
    )]
    Memory {
        /// What the largest split takes, bytes.
        needed: u64,
        /// What was given, bytes.
        given: u64,
    },
    /// The frame is out of range.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The kernel that was asked for does not run here.
    #[error(transparent)]
    Kernel(#[from] UnsupportedKernel),
    /// The scene does not suit.
    #[error("prepared scene: {0}")]
    Scene(String),
    /// The manifest is broken.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// An object of the scene cannot be had.
    #[error(transparent)]
    Object(#[from] ObjectError),
    /// A block was refused.
    #[error("geometry of split {split}: {source}; prepare the scene again")]
    Forest {
        /// Which split.
        split: u32,
        /// What is wrong.
        source: ForestError,
    },
    /// Attributes were refused.
    #[error("attributes of split {split}: {source}; prepare the scene again")]
    Attributes {
        /// Which split.
        split: u32,
        /// What is wrong.
        source: AttributeError,
    },
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An object of the job is broken in all its copies.
    #[error("{key}: {source}")]
    Wire {
        /// Which object.
        key: String,
        /// What is wrong.
        source: WireError,
    },
    /// All copies of an object of the job are gone or broken; what made it is computed again.
    #[error("{name} is lost: {why}")]
    Lost {
        /// Which object.
        name: String,
        /// What was wrong with the last copy.
        why: String,
    },
    /// Whoever watches the job ended it ([`super::Progress::is_cancelled`]).
    #[error("stopped from outside")]
    Cancelled,
    /// The attempt was ended from outside.
    #[error("the attempt was stopped")]
    Stopped,
    /// A part of the film does not fit.
    #[error("film: {0}")]
    Film(#[from] FilmError),
    /// The store holds no state to go on from.
    #[error(transparent)]
    Chain(#[from] ChainError),
    /// Somebody else writes to the store.
    #[error("{0}")]
    Owned(String),
    /// A record does not follow from the others: a mistake of Rayherd, or a store that lies.
    #[error("ledger: {0}")]
    Ledger(#[from] Refused),
    /// A mistake of Rayherd.
    #[error("internal error: {0}; please report it")]
    Internal(String),
}

impl JobError {
    /// Whether it may pass by itself: a store that does not answer for now.
    pub fn may_pass(&self) -> bool {
        matches!(self, JobError::Store(StoreError::Unavailable { .. }) | JobError::Object(ObjectError::Failed { .. }))
    }

    /// Whether other settings, another scene or another store would help: exit code 2. Otherwise it is ours, the machine's
    /// or the network's: exit code 1.
    pub fn is_users(&self) -> bool {
        match self {
            JobError::Settings(_)
            | JobError::Memory { .. }
            | JobError::Frame(_)
            | JobError::Kernel(_)
            | JobError::Scene(_)
            | JobError::Forest { .. }
            | JobError::Attributes { .. }
            | JobError::Chain(_)
            | JobError::Owned(_) => true,
            JobError::Manifest(ManifestError::Store(e)) | JobError::Object(e) => object_is_users(e),
            JobError::Manifest(ManifestError::Malformed(_) | ManifestError::Format { .. }) => true,
            JobError::Store(e) => e.is_users(),
            JobError::Wire { .. }
            | JobError::Lost { .. }
            | JobError::Cancelled
            | JobError::Stopped
            | JobError::Film(_)
            | JobError::Ledger(_)
            | JobError::Internal(_) => false,
        }
    }
}
