//! Blocks of a scene that another worker has cut: built of what it packed, and put where they belong.
//!
//! The packed primitives lie below the job's own prefix, sealed, under the hash of what lies there. They go when the scene is prepared.

use std::sync::Arc;

use rayherd_scene::objects::{ObjectHash, ObjectRef};
use rayherd_scene::prepare::{AT_ONCE, build, packed_most};
use tokio::runtime::Handle;

use super::Depot;
use super::message::ToBuild;
use super::traffic::Traffic;
use crate::job::JobError;
use crate::report::Kind;
use crate::store::{BlockStore, StoreError, Verify, object_key};
use crate::task::Stop;
use crate::wire::envelope::{self, Compress, seal};

/// The body of the object that holds a split's packed primitives.
pub fn sealed(packed: &[u8]) -> bytes::Bytes {
    seal(envelope::Kind::Primitives, packed, Compress::Lz4)
}

/// Its key, and that of a draft.
pub fn key(prefix: &str, object: &ObjectRef) -> String {
    format!("{prefix}/{}", object.hash)
}

/// What lies under such a key is what its name says.
pub fn by_name() -> Verify {
    Arc::new(|key, body| {
        let hash = ObjectHash::of(body);
        if key.ends_with(&hash.to_string()) { Ok(()) } else { Err(format!("its bytes hash to {hash}")) }
    })
}

/// What is gone, or broken in all its copies, is cut again; a store that is silent may be back soon.
pub fn lost(error: StoreError) -> JobError {
    match error {
        StoreError::NotFound { ref key, .. } | StoreError::Corrupt { ref key, .. } => {
            JobError::Lost { name: key.clone(), why: error.to_string() }
        }
        error => error.into(),
    }
}

/// Whether one of these splits is so large that all threads of a worker build it, and nothing else beside it: its tree takes ten times its
/// block for a while.
pub fn is_large(splits: &[ToBuild], slots: u32) -> bool {
    splits.iter().any(|s| s.primitives.saturating_mul(u64::from(slots)) > AT_ONCE)
}

/// Builds blocks, and puts each on the stores where it belongs; their names in the order of the splits. With `alone` all threads of the
/// process help.
///
/// # Errors
/// [`JobError::Lost`] when the primitives of one are gone.
pub fn build_blocks(
    (depot, runtime, traffic): (&Depot, &Handle, &Traffic),
    prefix: &str,
    splits: &[ToBuild],
    replicas: u32,
    alone: bool,
    stop: &dyn Stop,
) -> Result<Vec<ObjectRef>, JobError> {
    // one copy: reading must not make more of what goes soon
    let from = traffic.stores(depot, 1, Kind::Spool, Some(by_name()))?;
    let to = traffic.stores(depot, replicas, Kind::Geometry, None)?;
    let one = |split: &ToBuild| {
        stop.check()?;
        let key = key(prefix, &split.packed);
        let body = runtime.block_on(from.get(&key)).map_err(lost)?;
        let most = usize::try_from(packed_most(split.primitives)).unwrap_or(usize::MAX);
        let packed = envelope::open(envelope::Kind::Primitives, &body, most)
            .map_err(|e| JobError::Lost { name: key, why: e.to_string() })?;
        drop(body);
        let block = build(split.number, &packed, alone).map_err(|e| JobError::Scene(e.to_string()))?;
        drop(packed);
        let object = ObjectRef::of(&block);
        let on: Vec<usize> = split.on.iter().map(|&n| n as usize).collect();
        runtime.block_on(to.put_on(&on, &object_key(&object.hash), block.into()))?;
        Ok(object)
    };
    splits.iter().map(one).collect()
}
