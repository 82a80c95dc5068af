//! Keeps what was read in memory, up to so many bytes; reads an object once however many ask at a time.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;
use lru::LruCache;
use tokio::sync::OnceCell;

use super::{BlockStore, Counters, StoreError};
use crate::report::{Op, Place, Stage};

/// What an entry takes beside its key and body.
const OVERHEAD: u64 = 128;

/// A read cache around a store: least recently used out first.
pub struct Caching {
    inner: Arc<dyn BlockStore>,
    limit: u64,
    state: Mutex<State>,
    counters: Option<(Counters, Stage)>,
}

struct State {
    cached: LruCache<String, Bytes>,
    bytes: u64,
    /// Reads under way. Whoever asks meanwhile waits for the same.
    flights: HashMap<String, Arc<OnceCell<Bytes>>>,
}

impl Caching {
    /// Around a store, keeping at most `limit` bytes. Reads that are answered from memory are counted as
    /// [`Place::Cache`].
    pub fn new(inner: Arc<dyn BlockStore>, limit: u64, counters: Option<(Counters, Stage)>) -> Self {
        let state = State { cached: LruCache::unbounded(), bytes: 0, flights: HashMap::new() };
        Self { inner, limit, state: Mutex::new(state), counters }
    }

    /// Bytes kept now.
    pub fn bytes(&self) -> u64 {
        self.lock().bytes
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn count_hit(&self, key: &str, body: &Bytes) {
        if let Some((counters, stage)) = &self.counters {
            counters.add(*stage, Op::Read, key, Place::Cache, body.len() as u64);
        }
    }
}

impl State {
    /// A body that is kept, or the read to wait for.
    fn find(&mut self, key: &str) -> Result<Bytes, Arc<OnceCell<Bytes>>> {
        if let Some(body) = self.cached.get(key) {
            return Ok(body.clone());
        }
        Err(self.flights.entry(key.to_owned()).or_default().clone())
    }

    /// Ends a read; what a write has overtaken meanwhile is not kept.
    fn land(&mut self, key: &str, flight: &Arc<OnceCell<Bytes>>, limit: u64) {
        if !self.flights.get(key).is_some_and(|f| Arc::ptr_eq(f, flight)) {
            return;
        }
        self.flights.remove(key);
        let Some(body) = flight.get() else { return };
        if cost(key, body) > limit {
            return;
        }
        self.bytes += cost(key, body);
        if let Some(old) = self.cached.put(key.to_owned(), body.clone()) {
            self.bytes -= cost(key, &old);
        }
        while self.bytes > limit {
            let Some((key, body)) = self.cached.pop_lru() else { break };
            self.bytes -= cost(&key, &body);
        }
    }

    fn forget(&mut self, key: &str) {
        self.flights.remove(key);
        if let Some(body) = self.cached.pop(key) {
            self.bytes -= cost(key, &body);
        }
    }
}

fn cost(key: &str, body: &Bytes) -> u64 {
    body.len() as u64 + key.len() as u64 + OVERHEAD
}

#[async_trait]
impl BlockStore for Caching {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        let done = self.inner.put(key, body).await;
        // also when it failed: it may have been done
        self.lock().forget(key);
        done
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let found = self.lock().find(key);
        let flight = match found {
            Ok(body) => {
                self.count_hit(key, &body);
                return Ok(body);
            }
            Err(flight) => flight,
        };
        let mut read = false;
        // of all that wait, one reads; when it fails or is dropped, the next one does
        let fetched = flight
            .get_or_try_init(|| {
                read = true;
                self.inner.get(key)
            })
            .await
            .cloned();
        self.lock().land(key, &flight, self.limit);
        if let (Ok(body), false) = (&fetched, read) {
            self.count_hit(key, body);
        }
        fetched
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        if let Some(body) = self.lock().cached.peek(key) {
            return Ok(Some(body.len() as u64));
        }
        self.inner.size(key).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.inner.list(prefix).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        let done = self.inner.delete(keys).await;
        let mut state = self.lock();
        keys.iter().for_each(|key| state.forget(key));
        done
    }

    fn describe(&self) -> String {
        self.inner.describe()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures::future::join_all;

    use super::super::conformance::conformance;
    use super::super::{Counting, FaultPlan, Faulty, MemoryStore};
    use super::*;

    fn counted(limit: u64) -> (Caching, Arc<MemoryStore>, Counters) {
        let (memory, counters) = (Arc::new(MemoryStore::new()), Counters::new());
        let slow = FaultPlan { delayed: 1000, longest_delay: Duration::from_millis(5), ..FaultPlan::default() };
        let slow = Arc::new(Faulty::new(memory.clone(), slow));
        let inner = Counting::new(slow, counters.clone(), Stage::Trace, Place::Remote);
        (Caching::new(Arc::new(inner), limit, Some((counters.clone(), Stage::Trace))), memory, counters)
    }

    #[tokio::test]
    async fn conforms_small_and_large() {
        for limit in [0, 300_000, 1 << 30] {
            let store = Caching::new(Arc::new(MemoryStore::new()), limit, None);
            conformance(&store).await;
            assert!(store.bytes() <= limit);
        }
    }

    #[tokio::test]
    async fn reads_once_for_all_who_ask_at_a_time() {
        let (store, memory, counters) = counted(0);
        memory.put("a", Bytes::from_static(&[1; 10])).await.unwrap();
        let got = join_all((0..20).map(|_| store.get("a"))).await;
        assert!(got.into_iter().all(|body| body.unwrap() == [1u8; 10][..]));
        assert_eq!(counters.sums().sum(|_, _, _, place| place == Place::Remote), 10);
        assert_eq!(counters.sums().sum(|_, _, _, place| place == Place::Cache), 190);
        assert!(join_all((0..3).map(|_| store.get("b"))).await.into_iter().all(|r| r.is_err()));
        assert!(store.lock().flights.is_empty());
    }

    #[tokio::test]
    async fn keeps_what_was_used_last_within_its_limit() {
        let (store, memory, counters) = counted(3 * (1000 + 1 + OVERHEAD));
        for key in ["a", "b", "c", "d"] {
            memory.put(key, Bytes::from(vec![0; 1000])).await.unwrap();
        }
        for key in ["a", "b", "c", "a", "d", "a", "b"] {
            store.get(key).await.unwrap();
        }
        // b was the oldest when d came
        assert_eq!(counters.sums().sum(|_, _, _, place| place == Place::Remote), 5000);
        assert_eq!(store.bytes(), 3 * (1001 + OVERHEAD));
        store.delete(&["a".to_owned()]).await.unwrap();
        assert!(matches!(store.get("a").await, Err(StoreError::NotFound { .. })));
        assert_eq!(store.bytes(), 2 * (1001 + OVERHEAD));
    }

    #[tokio::test]
    async fn a_read_that_a_write_overtook_is_not_kept() {
        let (store, memory, _) = counted(1 << 20);
        memory.put("a", Bytes::from_static(b"old")).await.unwrap();
        let (_, put) = tokio::join!(store.get("a"), store.put("a", Bytes::from_static(b"new")));
        put.unwrap();
        assert_eq!(store.get("a").await.unwrap(), "new");
    }
}
