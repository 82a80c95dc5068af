//! From a description and its records to a prepared scene: the passes.

mod fingerprint;
mod settings;

pub use fingerprint::fingerprint;
pub use settings::{Cut, PrepareSettings, SpoolSettings};
