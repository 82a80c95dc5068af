//! Preparing in two steps: one process reads the source and deals its primitives to splits, others build the splits' blocks.
//!
//! Between them stands a *draft*: the manifest as it will be, but that each split's geometry names its primitives, packed, instead of the block
//! that is to be built of them. All else is stored with the draft: what a primitive looks like needs no tree. Everything goes the way of
//! [`super::prepare`], whose manifest and objects come out.

use rayherd_render::bvh::{Fork, Serial};

use super::build::{Keep, Rayon, block};
use super::records::{Records, packed_bytes};
use super::{PrepareError, PrepareProgress, PrepareSettings, Prepared, SpoolSettings, passes};
use crate::description::Description;
use crate::manifest::{Manifest, SplitEntry};
use crate::objects::{ObjectRef, ObjectStore};
use crate::record::RecordSource;

/// Blocks are to be built by others.
pub struct Apart<'a> {
    /// A scene of fewer usable primitives is prepared here, and so is one of a single split.
    pub least: u64,
    /// Takes the primitives of each split. Called from several threads at once.
    pub keep: &'a Keep<'a>,
}

/// What [`draft`] has come to.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// All is done.
    Prepared(Box<Prepared>),
    /// Blocks are to be built. Nothing names the draft yet.
    Draft(Box<Manifest>),
}

impl From<Prepared> for Outcome {
    fn from(prepared: Prepared) -> Self {
        Outcome::Prepared(Box::new(prepared))
    }
}

/// As [`super::prepare`], but for the blocks of a large scene, which [`build`] makes and [`complete`] puts in their places.
///
/// # Errors
/// See [`PrepareError`].
pub fn draft(
    description: &Description,
    source: &dyn RecordSource,
    settings: &PrepareSettings,
    spool: &SpoolSettings,
    (store, apart): (&dyn ObjectStore, &Apart),
    progress: &dyn PrepareProgress,
) -> Result<Outcome, PrepareError> {
    passes(description, source, settings, spool, (store, Some(apart)), progress)
}

/// Bytes of so many packed primitives at most.
pub fn packed_most(primitives: u64) -> u64 {
    packed_bytes(primitives, 0)
}

/// The block of a split's packed primitives. With `alone` all threads build it, else the calling one; it is the same block.
///
/// # Errors
/// When the bytes are something else, or no tree can be built.
pub fn build(number: u32, packed: &[u8], alone: bool) -> Result<Vec<u8>, PrepareError> {
    let records = Records::unpack(packed).filter(|r| r.len() > 0);
    let wrong = || {
        PrepareError::Inconsistent(format!(
            "the primitives of split {number} are not what was packed; the workers' machines must be of one byte order"
        ))
    };
    let fork: &dyn Fork = if alone { &Rayon } else { &Serial };
    block(number, &records.ok_or_else(wrong)?, fork)
}

/// A draft with the blocks of its splits, by their numbers.
///
/// # Errors
/// When there are not as many as splits.
pub fn complete(mut draft: Manifest, blocks: &[ObjectRef]) -> Result<Manifest, PrepareError> {
    if blocks.len() != draft.splits.len() {
        let message = format!("{} blocks were built of {} splits", blocks.len(), draft.splits.len());
        return Err(PrepareError::Inconsistent(message));
    }
    for (split, block) in draft.splits.iter_mut().zip(blocks) {
        split.geometry = *block;
    }
    draft.choice.rewritten_bytes = rewritten(&draft.splits);
    Ok(draft)
}

/// Bytes of copied splits.
pub(super) fn rewritten(splits: &[SplitEntry]) -> u64 {
    splits.iter().filter(|s| s.copied).map(|s| s.geometry.bytes + s.attributes.bytes).sum()
}
