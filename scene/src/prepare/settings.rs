//! What can be chosen when a scene is prepared.

use std::path::PathBuf;

use rayherd_render::skip::Skips;
use serde::{Deserialize, Serialize};

/// How the source is cut into splits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cut {
    /// By the stored bytes of a split's geometry object, 1 or more.
    BlockSize(u64),
    /// Into this many splits, 1 or more (fewer when there are fewer records).
    Splits(u32),
}

/// Settings that decide what a prepared scene is. They are part of its manifest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrepareSettings {
    /// How the source is cut.
    pub cut: Cut,
    /// Whether contested cells are copied into splits of their own, so that every cell has one owner.
    pub overlap_reduction: bool,
    /// Condition 2: a larger share of primitives in contested cells asks for a finer grid; 0 to 1.
    pub overlap_threshold: f64,
    /// Condition 3: a grid with this many occupied cells per split is fine enough; 1 or more.
    pub several: u32,
    /// Largest subdivision that may be chosen, 1 to [`crate::grid::MAX_SUBDIV`].
    pub max_subdiv: u32,
}

impl Default for PrepareSettings {
    /// Blocks of 128 MiB as in the paper's HDFS, overlap reduction at the paper's 0.2, 16 cells per split.
    fn default() -> Self {
        PrepareSettings {
            cut: Cut::BlockSize(128 << 20),
            overlap_reduction: true,
            overlap_threshold: 0.2,
            several: 16,
            max_subdiv: crate::grid::MAX_SUBDIV,
        }
    }
}

impl PrepareSettings {
    /// Checks ranges; the message says what to change.
    pub fn check(&self) -> Result<(), String> {
        match self.cut {
            Cut::BlockSize(0) => return Err("the block size is 0; give one of at least 1 byte".to_owned()),
            Cut::Splits(0) => return Err("0 splits were asked for; give at least 1".to_owned()),
            _ => {}
        }
        if !(0.0..=1.0).contains(&self.overlap_threshold) {
            return Err(format!("the overlap threshold {} is not between 0 and 1", self.overlap_threshold));
        }
        if self.several == 0 {
            return Err("the number of cells per split is 0; give at least 1".to_owned());
        }
        if !(1..=crate::grid::MAX_SUBDIV).contains(&self.max_subdiv) {
            let most = crate::grid::MAX_SUBDIV;
            return Err(format!("the largest subdivision {} is not in 1..={most}", self.max_subdiv));
        }
        Ok(())
    }
}

/// What preparing may use beside the store, and what it leaves out. It changes no byte of the result.
#[derive(Clone, Debug)]
pub struct SpoolSettings {
    /// Records that wait in memory, bytes; what is more goes to a temporary file.
    pub memory: u64,
    /// Folder of that file; the system's temporary folder when `None`.
    pub folder: Option<PathBuf>,
    /// Of these [`rayherd_render::skip::Skip::Prepared`].
    pub skips: Skips,
}

impl Default for SpoolSettings {
    /// 64 MiB, about what one split of a scene that is worth a spool takes with its tree; then the system's temporary folder.
    fn default() -> Self {
        SpoolSettings { memory: 64 << 20, folder: None, skips: Skips::ALL }
    }
}
