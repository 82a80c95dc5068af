//! What preparing says while it works.

/// What is going on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The source is read for its bounds; progress counts records.
    Bounds,
    /// The source is read; progress counts records.
    Reading,
    /// Candidate grids are counted; progress counts splits.
    Counting,
    /// Splits are built and stored; progress counts splits.
    Building,
    /// Contested cells are copied into splits of their own; progress counts groups of cells.
    Reducing,
}

/// Told how far preparing is, from the thread that called it.
pub trait PrepareProgress: Sync {
    /// A stage begins; `total` is what its steps add up to, if that is known.
    fn begin(&self, stage: Stage, total: Option<u64>);
    /// So much more is done.
    fn advance(&self, steps: u64);
}

/// Says nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoProgress;

impl PrepareProgress for NoProgress {
    fn begin(&self, _: Stage, _: Option<u64>) {}
    fn advance(&self, _: u64) {}
}
