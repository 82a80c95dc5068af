//! Where blocks, ray groups and film parts live: one trait, several backends, layers around them.

mod caching;
#[cfg(any(test, feature = "testing"))]
pub mod conformance;
mod copies;
mod counting;
mod directory;
mod faulty;
mod key;
mod memory;
mod objects;
mod prefixed;
mod replicated;
mod retrying;
mod s3;
#[cfg(any(test, feature = "testing"))]
pub mod s3_server;
mod spilling;
mod temporary;
mod watched;

use std::path::Path;

use async_trait::async_trait;
use bytes::Bytes;

pub use caching::{CacheCounts, Caching};
pub use copies::Copies;
pub use counting::{Counters, Counting, kind_of_key};
pub use directory::DirectoryStore;
pub use faulty::{FaultPlan, Faulty, Injected};
pub use key::{check_key, check_prefix};
pub use memory::MemoryStore;
pub use objects::{SceneObjects, object_is_users, object_key, promised_hash};
pub use prefixed::Prefixed;
pub use replicated::{NodeView, Replicated, ReplicationCounts, Verify};
pub use retrying::{RetryPolicy, Retrying};
pub use s3::{Identity, S3Credentials, S3Key, S3Settings, S3Store};
pub use spilling::Spilling;
pub use temporary::TemporaryFolder;
pub use watched::{Patience, Pulse, TcpPulse, Watched};

/// A flat space of named, immutable objects.
///
/// A `put` is atomic: readers see the whole object or none. Keys are `/`-separated segments of `[A-Za-z0-9._-]`, none
/// empty, none beginning with a dot ([`check_key`]). Putting a key again replaces it (content-addressed keys make that
/// harmless). A key must not be a folder of another (`a` beside `a/b`): some backends cannot hold both.
///
/// A `put` that fails with [`StoreError::Unavailable`] may have happened all the same; putting again is safe.
#[async_trait]
pub trait BlockStore: Send + Sync {
    /// Stores an object.
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError>;
    /// Stores the content of a file, which must not change meanwhile. Backends for which it matters do not hold it in memory.
    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        let body = tokio::fs::read(file).await.map_err(|e| unreadable(self.describe(), file, &e))?;
        self.put(key, body.into()).await
    }
    /// Reads a whole object.
    async fn get(&self, key: &str) -> Result<Bytes, StoreError>;
    /// Reads a whole object into a file, which is made or replaced; its size in bytes. Backends for which it matters do not hold it in
    /// memory. After an error the file holds anything.
    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        let body = self.get(key).await?;
        tokio::fs::write(file, &body).await.map_err(|e| unwritable(self.describe(), file, &e))?;
        Ok(body.len() as u64)
    }
    /// Size of an object in bytes, `None` when there is none.
    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError>;
    /// Keys that begin with the prefix (any string prefix, not only whole segments), ascending by bytes, with sizes.
    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError>;
    /// The same with what tells contents apart; `None` where the store cannot say that of all of them.
    async fn list_versions(&self, _prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        Ok(None)
    }
    /// Deletes objects; those that are not there are no error.
    async fn delete(&self, keys: &[String]) -> Result<(), StoreError>;
    /// Where this is, for messages: `s3://bucket/prefix`, a folder, `memory`.
    fn describe(&self) -> String;
}

/// An object as it is now.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Version {
    /// Its key.
    pub key: String,
    /// Its size.
    pub bytes: u64,
    /// Another one for another content. The same content may have several (S3: an ETag is the MD5 of what was put in one piece, and made of
    /// the MD5s of its parts otherwise).
    pub tag: String,
    /// When it was put, seconds, if the store knows: tells the same content that was put again.
    pub put: Option<i64>,
}

fn unreadable(store: String, file: &Path, e: &std::io::Error) -> StoreError {
    StoreError::Misconfigured { store, message: format!("cannot read {}, which is to be put: {e}", file.display()) }
}

fn unwritable(store: String, file: &Path, e: &std::io::Error) -> StoreError {
    let message = format!("cannot write {}: {e}; give it room, or another folder", file.display());
    StoreError::Misconfigured { store, message }
}

/// Why a store did not do it, named by what the caller can do.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// There is no such object: rebuild it or give up.
    #[error("{store}: no object {key}")]
    NotFound {
        /// Which store.
        store: String,
        /// Which object.
        key: String,
    },
    /// Not allowed: check credentials, bucket, permissions.
    #[error("{store}: {action} {key} refused: {message}")]
    Denied {
        /// Which store.
        store: String,
        /// What was tried.
        action: &'static str,
        /// On which object.
        key: String,
        /// What the store said.
        message: String,
    },
    /// May work later: try again.
    #[error("{store}: {action} {key} failed for now: {message}")]
    Unavailable {
        /// Which store.
        store: String,
        /// What was tried.
        action: &'static str,
        /// On which object.
        key: String,
        /// What happened.
        message: String,
    },
    /// No room: free some.
    #[error(
        "{store}: no room for {key} ({bytes} bytes): free some or add some, then start again; what is there is used"
    )]
    Full {
        /// Which store.
        store: String,
        /// Which object.
        key: String,
        /// Its size.
        bytes: u64,
    },
    /// What was read is not what was written: read another copy, or rebuild it.
    #[error("{store}: {key} is corrupt: {message}")]
    Corrupt {
        /// Which store.
        store: String,
        /// Which object.
        key: String,
        /// What does not match.
        message: String,
    },
    /// It cannot work as it was set up: correct the address, the bucket or the environment.
    #[error("{store}: {message}")]
    Misconfigured {
        /// Which store.
        store: String,
        /// What is wrong, and what to do.
        message: String,
    },
    /// The server has no such bucket, and so none of what was in it: create it.
    #[error("{store}: there is no bucket {bucket}: create it")]
    NoBucket {
        /// Which store.
        store: String,
        /// Which bucket.
        bucket: String,
    },
    /// The key breaks the rules.
    #[error("{key:?} is no valid key: {message}")]
    InvalidKey {
        /// The key.
        key: String,
        /// Which rule.
        message: String,
    },
}

impl StoreError {
    /// Whether the caller can put it right: by another address, key or bucket, or by making again what is gone. Otherwise it
    /// is the network's or the machine's.
    pub fn is_users(&self) -> bool {
        match self {
            StoreError::Unavailable { .. } | StoreError::Full { .. } => false,
            StoreError::NotFound { .. }
            | StoreError::Denied { .. }
            | StoreError::Corrupt { .. }
            | StoreError::InvalidKey { .. }
            | StoreError::NoBucket { .. }
            | StoreError::Misconfigured { .. } => true,
        }
    }
}
