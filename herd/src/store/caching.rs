//! Copies of what was read from a store that is far away, in one that is near.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, StoreError};

/// Reads of objects that never change, kept up to a budget of bytes; what was used longest ago goes first. A copy that is lost, or is not what
/// was read, is read again from afar: the cache changes no answer, and an error of the near store is none of the caller's.
pub struct Caching {
    far: Arc<dyn BlockStore>,
    near: Arc<dyn BlockStore>,
    budget: u64,
    keeps: fn(&str) -> bool,
    held: Mutex<Held>,
}

/// What lies near.
#[derive(Default)]
struct Held {
    copies: BTreeMap<String, Kept>,
    /// Keys by when they were used last.
    by_use: BTreeMap<u64, String>,
    clock: u64,
    bytes: u64,
    counts: CacheCounts,
}

struct Kept {
    bytes: u64,
    hash: blake3::Hash,
    used: u64,
}

/// Bytes of kept kinds that were asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheCounts {
    /// Found near.
    pub near: u64,
    /// Read from afar.
    pub far: u64,
}

impl Held {
    fn touch(&mut self, key: &str) -> Option<blake3::Hash> {
        let copy = self.copies.get_mut(key)?;
        self.clock += 1;
        self.by_use.remove(&copy.used);
        copy.used = self.clock;
        self.by_use.insert(self.clock, key.to_owned());
        Some(copy.hash)
    }

    fn forget(&mut self, key: &str) -> bool {
        let Some(copy) = self.copies.remove(key) else { return false };
        self.by_use.remove(&copy.used);
        self.bytes -= copy.bytes;
        true
    }

    /// Notes a copy, and says which must go for it.
    fn note(&mut self, key: &str, body: &Bytes, budget: u64) -> Vec<String> {
        let bytes = body.len() as u64;
        self.forget(key);
        let mut out = Vec::new();
        while self.bytes + bytes > budget {
            let Some(oldest) = self.by_use.values().next().cloned() else { break };
            self.forget(&oldest);
            out.push(oldest);
        }
        self.clock += 1;
        self.bytes += bytes;
        self.by_use.insert(self.clock, key.to_owned());
        self.copies.insert(key.to_owned(), Kept { bytes, hash: blake3::hash(body), used: self.clock });
        out
    }
}

impl Caching {
    /// Around `far`; copies of what `keeps` says of its key, which must never change, lie in `near`, up to `budget` bytes of bodies.
    pub fn new(far: Arc<dyn BlockStore>, near: Arc<dyn BlockStore>, budget: u64, keeps: fn(&str) -> bool) -> Self {
        Caching { far, near, budget, keeps, held: Mutex::default() }
    }

    /// What was found where so far.
    pub fn counts(&self) -> CacheCounts {
        self.held().counts
    }

    /// Bytes that lie near.
    pub fn bytes(&self) -> u64 {
        self.held().bytes
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        // nothing is changed half
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn copy(&self, key: &str) -> Option<Bytes> {
        let hash = self.held().touch(key)?;
        let body = self.near.get(key).await.ok().filter(|body| blake3::hash(body) == hash);
        if body.is_none() {
            self.forget(&[key.to_owned()]).await;
        }
        body
    }

    async fn keep(&self, key: &str, body: &Bytes) {
        if body.len() as u64 > self.budget {
            return;
        }
        let gone = self.held().note(key, body, self.budget);
        let made_room = if gone.is_empty() { Ok(()) } else { self.near.delete(&gone).await };
        let kept = match made_room {
            Ok(()) => self.near.put(key, body.clone()).await,
            Err(e) => Err(e),
        };
        if let Err(e) = kept {
            tracing::warn!("{key} is not kept near: {e}");
            self.held().forget(key);
        }
    }

    /// Of keys whose bodies may have changed or gone.
    async fn forget(&self, keys: &[String]) {
        let gone: Vec<String> = {
            let mut held = self.held();
            keys.iter().filter(|key| held.forget(key)).cloned().collect()
        };
        if !gone.is_empty()
            && let Err(e) = self.near.delete(&gone).await
        {
            tracing::warn!("copies in {} stay: {e}", self.near.describe());
        }
    }
}

impl Drop for Caching {
    fn drop(&mut self) {
        let CacheCounts { near, far } = self.counts();
        if far > 0 {
            tracing::info!("{far} bytes were read from {}, and {near} again from the cache", self.far.describe());
        }
    }
}

#[async_trait]
impl BlockStore for Caching {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        self.far.put(key, body).await?;
        self.forget(&[key.to_owned()]).await;
        Ok(())
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        self.far.put_file(key, file).await?;
        self.forget(&[key.to_owned()]).await;
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        if !(self.keeps)(key) {
            return self.far.get(key).await;
        }
        if let Some(body) = self.copy(key).await {
            self.held().counts.near += body.len() as u64;
            return Ok(body);
        }
        let body = self.far.get(key).await?;
        self.held().counts.far += body.len() as u64;
        self.keep(key, &body).await;
        Ok(body)
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        self.far.size(key).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.far.list(prefix).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.far.delete(keys).await?;
        self.forget(keys).await;
        Ok(())
    }

    fn describe(&self) -> String {
        self.far.describe()
    }
}

#[cfg(test)]
mod tests {
    use super::super::MemoryStore;
    use super::super::conformance::conformance;
    use super::*;

    fn all(_: &str) -> bool {
        true
    }

    fn body(byte: u8) -> Bytes {
        Bytes::from(vec![byte; 100])
    }

    #[tokio::test]
    async fn conforms_with_and_without_room() {
        for budget in [0, 100_000, u64::MAX] {
            let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
            conformance(&Caching::new(far, near, budget, all)).await;
        }
    }

    #[tokio::test]
    async fn what_was_read_is_near_until_others_need_the_room() {
        let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
        let cache = Caching::new(far.clone(), near.clone(), 250, |key| key != "c");
        for (key, byte) in [("a", 1), ("b", 2), ("c", 3), ("d", 4)] {
            far.put(key, body(byte)).await.unwrap();
        }
        for key in ["a", "b", "a", "c", "c", "d", "a", "b"] {
            cache.get(key).await.unwrap();
        }
        // d took the place of b, which was used before a; c is none of the kind
        assert_eq!(cache.counts(), CacheCounts { near: 200, far: 400 });
        let held: Vec<String> = near.list("").await.unwrap().into_iter().map(|k| k.0).collect();
        assert_eq!((held, cache.bytes()), (vec!["a".to_owned(), "b".to_owned()], 200));
        // more than all of the room: not kept
        far.put("e", Bytes::from(vec![5; 251])).await.unwrap();
        cache.get("e").await.unwrap();
        assert_eq!(cache.bytes(), 200);
        // what is deleted is gone near too
        cache.delete(&["a".to_owned()]).await.unwrap();
        assert!(matches!(cache.get("a").await, Err(StoreError::NotFound { .. })));
        assert_eq!((cache.bytes(), near.size("a").await.unwrap()), (100, None));
    }

    #[tokio::test]
    async fn a_copy_that_is_lost_or_wrong_or_finds_no_room_is_read_from_afar() {
        let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
        let cache = Caching::new(far.clone(), near.clone(), 1000, all);
        far.put("a", body(1)).await.unwrap();
        cache.get("a").await.unwrap();
        near.put("a", body(9)).await.unwrap();
        assert_eq!(cache.get("a").await.unwrap(), body(1));
        near.delete(&["a".to_owned()]).await.unwrap();
        assert_eq!(cache.get("a").await.unwrap(), body(1));
        assert_eq!(cache.counts(), CacheCounts { near: 0, far: 300 });
        assert_eq!(cache.get("a").await.unwrap(), body(1));
        assert_eq!(cache.counts().near, 100);
        let full = Caching::new(far, Arc::new(MemoryStore::with_limit(50)), 1000, all);
        for _ in 0..2 {
            assert_eq!(full.get("a").await.unwrap(), body(1));
        }
        assert_eq!((full.bytes(), full.counts()), (0, CacheCounts { near: 0, far: 200 }));
    }
}
