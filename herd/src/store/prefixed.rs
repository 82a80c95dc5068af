//! A part of a store as a store: what lies below one prefix.

use std::path::Path;
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, StoreError, check_key, check_prefix};

/// The keys below `PREFIX/` of another store, without it: a virtual node's disk, a job's folder.
#[derive(Clone)]
pub struct Prefixed {
    inner: Arc<dyn BlockStore>,
    /// Ends with a slash.
    prefix: String,
}

impl Prefixed {
    /// Below a prefix, which is itself a key (no slash at its ends).
    pub fn new(inner: Arc<dyn BlockStore>, prefix: &str) -> Result<Self, StoreError> {
        check_key(prefix)?;
        Ok(Self { inner, prefix: format!("{prefix}/") })
    }

    fn path(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    /// Errors speak of our keys, as their callers know them.
    fn own(&self, error: StoreError) -> StoreError {
        let own = |key: String| key.strip_prefix(&self.prefix).map(str::to_owned).unwrap_or(key);
        match error {
            StoreError::NotFound { store, key } => StoreError::NotFound { store, key: own(key) },
            StoreError::Denied { store, action, key, message } => {
                StoreError::Denied { store, action, key: own(key), message }
            }
            StoreError::Unavailable { store, action, key, message } => {
                StoreError::Unavailable { store, action, key: own(key), message }
            }
            StoreError::Full { store, key, bytes } => StoreError::Full { store, key: own(key), bytes },
            StoreError::Corrupt { store, key, message } => StoreError::Corrupt { store, key: own(key), message },
            StoreError::InvalidKey { key, message } => StoreError::InvalidKey { key: own(key), message },
            error @ (StoreError::Misconfigured { .. } | StoreError::NoBucket { .. }) => error,
        }
    }
}

#[async_trait]
impl BlockStore for Prefixed {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        check_key(key)?;
        self.inner.put(&self.path(key), body).await.map_err(|e| self.own(e))
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        check_key(key)?;
        self.inner.put_file(&self.path(key), file).await.map_err(|e| self.own(e))
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        check_key(key)?;
        self.inner.get(&self.path(key)).await.map_err(|e| self.own(e))
    }

    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        check_key(key)?;
        self.inner.get_file(&self.path(key), file).await.map_err(|e| self.own(e))
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        check_key(key)?;
        self.inner.size(&self.path(key)).await.map_err(|e| self.own(e))
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        check_prefix(prefix)?;
        let found = self.inner.list(&self.path(prefix)).await.map_err(|e| self.own(e))?;
        let own = |(key, size): (String, u64)| key.strip_prefix(&self.prefix).map(|key| (key.to_owned(), size));
        Ok(found.into_iter().filter_map(own).collect())
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        keys.iter().try_for_each(|key| check_key(key))?;
        let paths: Vec<String> = keys.iter().map(|key| self.path(key)).collect();
        self.inner.delete(&paths).await.map_err(|e| self.own(e))
    }

    fn describe(&self) -> String {
        format!("{}/{}", self.inner.describe(), self.prefix.trim_end_matches('/'))
    }
}

#[cfg(test)]
mod tests {
    use super::super::MemoryStore;
    use super::super::conformance::conformance;
    use super::*;

    #[tokio::test]
    async fn conforms_and_keeps_to_itself() {
        let memory = Arc::new(MemoryStore::new());
        memory.put("nodes/11/x", Bytes::from_static(b"another's")).await.unwrap();
        let store = Prefixed::new(memory.clone(), "nodes/1").unwrap();
        conformance(&store).await;
        store.put("x", Bytes::from_static(b"ours")).await.unwrap();
        assert_eq!(store.list("").await.unwrap(), [("x".to_owned(), 4)]);
        assert_eq!(memory.get("nodes/1/x").await.unwrap(), "ours");
        assert!(Prefixed::new(memory, "/nodes").is_err());
    }
}
