//! Objects in memory up to a budget, then in a temporary folder: what a run without a store keeps while it lasts.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, Counters, Counting, DirectoryStore, MemoryStore, StoreError, TemporaryFolder};
use crate::report::{Op, Place, Stage};

/// Objects that vanish with this value. The folder is made when the first object does not fit into memory.
pub struct Spilling {
    memory: MemoryStore,
    folder: Mutex<Option<(TemporaryFolder, Arc<Counting>)>>,
    made: fn(&Path),
    counters: Counters,
}

impl Spilling {
    /// Up to `budget` bytes of bodies stay in memory. `made` is told of the folder when there is one.
    pub fn new(budget: u64, made: fn(&Path)) -> Self {
        let (memory, counters) = (MemoryStore::with_limit(budget), Counters::new());
        Spilling { memory, folder: Mutex::default(), made, counters }
    }

    /// Bytes that were written to the folder so far.
    pub fn spilled(&self) -> u64 {
        self.counters.sums().sum(|_, op, _, _| op == Op::Write)
    }

    fn folder(&self) -> Option<Arc<Counting>> {
        self.folder.lock().unwrap_or_else(PoisonError::into_inner).as_ref().map(|f| f.1.clone())
    }

    fn folder_or_new(&self) -> Result<Arc<Counting>, StoreError> {
        let mut folder = self.folder.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, store)) = folder.as_ref() {
            return Ok(store.clone());
        }
        let made = TemporaryFolder::new("")?;
        (self.made)(made.path());
        let store = Arc::new(DirectoryStore::open_unsynced(made.path())?);
        let store = Arc::new(Counting::new(store, self.counters.clone(), Stage::Trace, Place::Local));
        *folder = Some((made, store.clone()));
        Ok(store)
    }
}

#[async_trait]
impl BlockStore for Spilling {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        match self.memory.put(key, body.clone()).await {
            Ok(()) => match self.folder() {
                // an older body of the key may lie there
                Some(folder) => folder.delete(&[key.to_owned()]).await,
                None => Ok(()),
            },
            Err(StoreError::Full { .. }) => {
                self.folder_or_new()?.put(key, body).await?;
                self.memory.delete(&[key.to_owned()]).await
            }
            Err(e) => Err(e),
        }
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        match (self.memory.get(key).await, self.folder()) {
            (Err(StoreError::NotFound { .. }), Some(folder)) => folder.get(key).await,
            (got, _) => got,
        }
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        match (self.memory.size(key).await?, self.folder()) {
            (None, Some(folder)) => folder.size(key).await,
            (size, _) => Ok(size),
        }
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        let mut all = self.memory.list(prefix).await?;
        if let Some(folder) = self.folder() {
            all.extend(folder.list(prefix).await?);
            all.sort();
        }
        Ok(all)
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.memory.delete(keys).await?;
        match self.folder() {
            Some(folder) => folder.delete(keys).await,
            None => Ok(()),
        }
    }

    fn describe(&self) -> String {
        "memory and a temporary folder".to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn conforms_with_and_without_room() {
        for budget in [0, 100_000, u64::MAX] {
            super::super::conformance::conformance(&Spilling::new(budget, |_| ())).await;
        }
    }

    #[tokio::test]
    async fn what_memory_does_not_hold_is_in_a_folder_that_goes() {
        let store = Spilling::new(10, |_| ());
        store.put("a", Bytes::from_static(b"12345678")).await.unwrap();
        assert!(store.folder().is_none());
        store.put("b", Bytes::from_static(b"123")).await.unwrap();
        assert_eq!(store.spilled(), 3);
        let root = std::path::PathBuf::from(store.folder().unwrap().describe());
        assert!(root.join("b").is_file() && store.get("b").await.unwrap() == "123");
        // a key has one body, wherever the one before was
        store.put("a", Bytes::from_static(b"12345678901")).await.unwrap();
        store.put("b", Bytes::from_static(b"4")).await.unwrap();
        assert_eq!((store.get("a").await.unwrap(), store.get("b").await.unwrap()), ("12345678901".into(), "4".into()));
        assert_eq!(store.list("").await.unwrap(), [("a".to_owned(), 11), ("b".to_owned(), 1)]);
        drop(store);
        assert!(!root.exists());
    }
}
