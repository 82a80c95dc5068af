//! A job: its settings, who watches it, how it is run to its end.

mod error;
mod progress;
mod scene;
mod settings;
pub mod spec;

pub use error::JobError;
pub use progress::{Image, Progress, Silent, Status};
pub use scene::{PICTURE, PreparedScene};
pub use settings::{Commits, JobSettings, NodeSpec, Sampling};
