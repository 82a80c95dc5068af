//! Objects in memory: for tests, for small runs, and as the plain twin of the other stores.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, StoreError, Version, check_key, check_prefix};

/// Objects in this process's memory, up to a limit.
pub struct MemoryStore {
    objects: Mutex<Objects>,
    limit: u64,
}

#[derive(Default)]
struct Objects {
    by_key: BTreeMap<String, Bytes>,
    bytes: u64,
}

impl Default for MemoryStore {
    fn default() -> Self {
        Self::new()
    }
}

impl MemoryStore {
    /// An empty store without a limit.
    pub fn new() -> Self {
        Self::with_limit(u64::MAX)
    }

    /// An empty store that is full at `limit` bytes of bodies.
    pub fn with_limit(limit: u64) -> Self {
        Self { objects: Mutex::default(), limit }
    }

    /// Bytes of all bodies.
    pub fn bytes(&self) -> u64 {
        self.lock().bytes
    }

    // the map is whole between any two statements that can panic, so a poisoned lock is as good as another
    fn lock(&self) -> MutexGuard<'_, Objects> {
        self.objects.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[async_trait]
impl BlockStore for MemoryStore {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        check_key(key)?;
        let mut objects = self.lock();
        if let Some(other) = objects.folder_clash(key) {
            let message = format!("a key cannot be a folder of another, and there is {other}");
            return Err(StoreError::InvalidKey { key: key.to_owned(), message });
        }
        let old = objects.by_key.get(key).map_or(0, |b| b.len() as u64);
        let bytes = objects.bytes - old + body.len() as u64;
        if bytes > self.limit {
            return Err(StoreError::Full { store: self.describe(), key: key.to_owned(), bytes: body.len() as u64 });
        }
        objects.bytes = bytes;
        objects.by_key.insert(key.to_owned(), body);
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        check_key(key)?;
        let found = self.lock().by_key.get(key).cloned();
        found.ok_or_else(|| StoreError::NotFound { store: self.describe(), key: key.to_owned() })
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        check_key(key)?;
        Ok(self.lock().by_key.get(key).map(|b| b.len() as u64))
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        check_prefix(prefix)?;
        let objects = self.lock();
        let from = objects.by_key.range(prefix.to_owned()..);
        Ok(from.take_while(|(k, _)| k.starts_with(prefix)).map(|(k, b)| (k.clone(), b.len() as u64)).collect())
    }

    async fn list_versions(&self, prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        check_prefix(prefix)?;
        let objects = self.lock();
        let from = objects.by_key.range(prefix.to_owned()..).take_while(|(k, _)| k.starts_with(prefix));
        let version = |(key, body): (&String, &Bytes)| {
            let tag = blake3::hash(body).to_hex().to_string();
            Version { key: key.clone(), bytes: body.len() as u64, tag, put: None }
        };
        Ok(Some(from.map(version).collect()))
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        keys.iter().try_for_each(|key| check_key(key))?;
        let mut objects = self.lock();
        for key in keys {
            if let Some(body) = objects.by_key.remove(key) {
                objects.bytes -= body.len() as u64;
            }
        }
        Ok(())
    }

    fn describe(&self) -> String {
        "memory".to_owned()
    }
}

impl Objects {
    /// An object that stands where `key` needs a folder, or below `key`.
    fn folder_clash(&self, key: &str) -> Option<String> {
        let above = key.match_indices('/').map(|(i, _)| &key[..i]).find(|folder| self.by_key.contains_key(*folder));
        if let Some(folder) = above {
            return Some(folder.to_owned());
        }
        let below = format!("{key}/");
        self.by_key.range(below.clone()..).next().map(|(k, _)| k.clone()).filter(|k| k.starts_with(&below))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn conforms() {
        super::super::conformance::conformance(&MemoryStore::new()).await;
    }

    #[tokio::test]
    async fn is_full_at_its_limit_and_counts_replacements_once() {
        let store = MemoryStore::with_limit(10);
        store.put("a", Bytes::from_static(b"12345678")).await.unwrap();
        store.put("a", Bytes::from_static(b"1234567890")).await.unwrap();
        assert!(matches!(store.put("b", Bytes::from_static(b"1")).await, Err(StoreError::Full { .. })));
        assert_eq!(store.bytes(), 10);
        store.delete(&["a".to_owned()]).await.unwrap();
        assert_eq!(store.bytes(), 0);
    }

    #[tokio::test]
    async fn refuses_a_key_that_is_a_folder() {
        let store = MemoryStore::new();
        store.put("a/b", Bytes::new()).await.unwrap();
        assert!(matches!(store.put("a", Bytes::new()).await, Err(StoreError::InvalidKey { .. })));
        assert!(matches!(store.put("a/b/c", Bytes::new()).await, Err(StoreError::InvalidKey { .. })));
        store.put("a-b", Bytes::new()).await.unwrap();
    }
}
