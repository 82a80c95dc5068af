//! Copies of what was read from a store that is far away, in one that is near.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, Copies, StoreError};

/// Reads of objects that never change, of which [`Copies`] are kept near. The cache changes no answer, and an error of the near store is
/// none of the caller's.
pub struct Caching {
    far: Arc<dyn BlockStore>,
    copies: Arc<Copies>,
    keeps: fn(&str) -> bool,
    found: AtomicU64,
    fetched: AtomicU64,
}

/// Bytes of kept kinds that were asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheCounts {
    /// Found near.
    pub near: u64,
    /// Read from afar.
    pub far: u64,
}

impl Caching {
    /// Around `far`; of what `keeps` says of its key, which must never change, `copies` are kept.
    pub fn new(far: Arc<dyn BlockStore>, copies: Arc<Copies>, keeps: fn(&str) -> bool) -> Self {
        Caching { far, copies, keeps, found: AtomicU64::new(0), fetched: AtomicU64::new(0) }
    }

    /// What was found where so far.
    pub fn counts(&self) -> CacheCounts {
        CacheCounts { near: self.found.load(Ordering::Relaxed), far: self.fetched.load(Ordering::Relaxed) }
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
        self.copies.forget(&[key.to_owned()]).await;
        Ok(())
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        self.far.put_file(key, file).await?;
        self.copies.forget(&[key.to_owned()]).await;
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        if !(self.keeps)(key) {
            return self.far.get(key).await;
        }
        if let Some(body) = self.copies.get(key).await {
            self.found.fetch_add(body.len() as u64, Ordering::Relaxed);
            return Ok(body);
        }
        let body = self.far.get(key).await?;
        self.fetched.fetch_add(body.len() as u64, Ordering::Relaxed);
        self.copies.keep(key, &body).await;
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
        self.copies.forget(keys).await;
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

    fn cache(far: &Arc<MemoryStore>, near: &Arc<MemoryStore>, budget: u64, keeps: fn(&str) -> bool) -> Caching {
        Caching::new(far.clone(), Arc::new(Copies::new(near.clone(), budget)), keeps)
    }

    fn body(byte: u8) -> Bytes {
        Bytes::from(vec![byte; 100])
    }

    #[tokio::test]
    async fn conforms_with_and_without_room() {
        for budget in [0, 100_000, u64::MAX] {
            let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
            conformance(&cache(&far, &near, budget, |_| true)).await;
        }
    }

    #[tokio::test]
    async fn what_was_read_is_near_until_others_need_the_room() {
        let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
        let cache = cache(&far, &near, 250, |key| key != "c");
        for (key, byte) in [("a", 1), ("b", 2), ("c", 3), ("d", 4)] {
            far.put(key, body(byte)).await.unwrap();
        }
        for key in ["a", "b", "a", "c", "c", "d", "a", "b"] {
            cache.get(key).await.unwrap();
        }
        // d took the place of b, which was used before a; c is none of the kind
        assert_eq!(cache.counts(), CacheCounts { near: 200, far: 400 });
        let held: Vec<String> = near.list("").await.unwrap().into_iter().map(|k| k.0).collect();
        assert_eq!((held, cache.copies.bytes()), (vec!["a".to_owned(), "b".to_owned()], 200));
        // more than all of the room: not kept
        far.put("e", Bytes::from(vec![5; 251])).await.unwrap();
        cache.get("e").await.unwrap();
        assert_eq!(cache.copies.bytes(), 200);
        // what is deleted is gone near too
        cache.delete(&["a".to_owned()]).await.unwrap();
        assert!(matches!(cache.get("a").await, Err(StoreError::NotFound { .. })));
        assert_eq!((cache.copies.bytes(), near.size("a").await.unwrap()), (100, None));
    }

    #[tokio::test]
    async fn a_copy_that_is_lost_or_wrong_or_finds_no_room_is_read_from_afar() {
        let (far, near) = (Arc::new(MemoryStore::new()), Arc::new(MemoryStore::new()));
        let good = cache(&far, &near, 1000, |_| true);
        far.put("a", body(1)).await.unwrap();
        good.get("a").await.unwrap();
        near.put("a", body(9)).await.unwrap();
        assert_eq!(good.get("a").await.unwrap(), body(1));
        near.delete(&["a".to_owned()]).await.unwrap();
        assert_eq!(good.get("a").await.unwrap(), body(1));
        assert_eq!(good.counts(), CacheCounts { near: 0, far: 300 });
        assert_eq!(good.get("a").await.unwrap(), body(1));
        assert_eq!((good.counts().near, good.copies.take_failures()), (100, 2));
        let full = cache(&far, &Arc::new(MemoryStore::with_limit(50)), 1000, |_| true);
        for _ in 0..2 {
            assert_eq!(full.get("a").await.unwrap(), body(1));
        }
        assert_eq!((full.copies.bytes(), full.counts()), (0, CacheCounts { near: 0, far: 200 }));
        assert_eq!((full.copies.take_failures(), full.copies.take_failures()), (2, 0));
    }
}
