//! A store that fails on purpose, as a seed says: for tests and fault schedules.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, Pulse, StoreError, Version};

/// What goes wrong and how often: shares of 1000 operations.
///
/// Each draw is a function of (seed, operation, key, how often that was done before), so that it does not depend on how
/// the operations of different keys interleave, and the seed replays it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FaultPlan {
    /// Draws everything.
    pub seed: u64,
    /// Fails with `Unavailable` and is not done.
    pub unavailable: u32,
    /// Put and delete: done, but fails with `Unavailable`.
    pub lost_reply: u32,
    /// Get: one byte of the answer is changed, or its end is missing.
    pub corrupt: u32,
    /// Waits, up to `longest_delay`.
    pub delayed: u32,
    /// Longest wait.
    pub longest_delay: Duration,
    /// After so many faults an operation on a key is left in peace (delays do not count).
    pub most_per_key: u32,
}

impl Default for FaultPlan {
    /// Nothing goes wrong.
    fn default() -> Self {
        FaultPlan {
            seed: 0,
            unavailable: 0,
            lost_reply: 0,
            corrupt: 0,
            delayed: 0,
            longest_delay: Duration::ZERO,
            most_per_key: u32::MAX,
        }
    }
}

/// What went wrong so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Injected {
    /// Operations refused.
    pub unavailable: u64,
    /// Operations done and denied.
    pub lost_replies: u64,
    /// Bodies changed.
    pub corrupt: u64,
    /// Operations that waited.
    pub delayed: u64,
}

/// A store around another that fails as its plan says, and that can be lost like a node.
pub struct Faulty {
    inner: RwLock<Arc<dyn BlockStore>>,
    plan: FaultPlan,
    lost: AtomicBool,
    hangs: AtomicBool,
    emptied: AtomicBool,
    hung: AtomicU64,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// By operation and key: how often done, how often failed.
    seen: HashMap<(&'static str, String), (u32, u32)>,
    injected: Injected,
}

#[derive(Clone, Copy, PartialEq)]
enum Fault {
    None,
    Unavailable,
    LostReply,
    Corrupt(u64),
}

impl Faulty {
    /// Around a store.
    pub fn new(inner: Arc<dyn BlockStore>, plan: FaultPlan) -> Self {
        Self {
            inner: RwLock::new(inner),
            plan,
            lost: AtomicBool::new(false),
            hangs: AtomicBool::new(false),
            emptied: AtomicBool::new(false),
            hung: AtomicU64::new(0),
            state: Mutex::default(),
        }
    }

    /// From now on nothing answers, as when the node is gone.
    pub fn lose(&self) {
        self.lost.store(true, Ordering::SeqCst);
    }

    /// The node is back; with `disk`, it is another one (an empty store: the old disk is gone).
    pub fn restore(&self, disk: Option<Arc<dyn BlockStore>>) {
        if let Some(disk) = disk {
            *self.inner.write().unwrap_or_else(PoisonError::into_inner) = disk;
        }
        self.emptied.store(false, Ordering::SeqCst);
        self.lost.store(false, Ordering::SeqCst);
    }

    /// From now on there is no bucket, as when a server is back with another disk.
    pub fn empty(&self) {
        self.emptied.store(true, Ordering::SeqCst);
    }

    /// From now on operations do not end, as when the plug of its machine is pulled; or they do again.
    pub fn hang(&self, hangs: bool) {
        self.hangs.store(hangs, Ordering::SeqCst);
    }

    /// Operations that found their machine without power.
    pub fn hung(&self) -> u64 {
        self.hung.load(Ordering::SeqCst)
    }

    /// Whether the node is lost now.
    pub fn is_lost(&self) -> bool {
        self.lost.load(Ordering::SeqCst)
    }

    /// What went wrong so far.
    pub fn injected(&self) -> Injected {
        self.lock().injected
    }

    /// Damages the stored object itself: a byte drawn from the seed is changed, or half of it cut off.
    pub async fn damage(&self, key: &str) -> Result<(), StoreError> {
        let inner = self.inner();
        let body = inner.get(key).await?;
        let draw = self.draw("damage", key, 0);
        inner.put(key, corrupted(&body, draw)).await
    }

    fn inner(&self) -> Arc<dyn BlockStore> {
        self.inner.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn draw(&self, action: &'static str, key: &str, number: u32) -> u64 {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.plan.seed.to_le_bytes()).update(&number.to_le_bytes());
        hasher.update(action.as_bytes()).update(b" ").update(key.as_bytes());
        u64::from_le_bytes(std::array::from_fn(|i| hasher.finalize().as_bytes()[i]))
    }

    /// Decides on an operation, and waits if that was drawn.
    async fn begin(&self, action: &'static str, key: &str) -> Result<Fault, StoreError> {
        if self.hangs.load(Ordering::SeqCst) {
            self.hung.fetch_add(1, Ordering::SeqCst);
            while self.hangs.load(Ordering::SeqCst) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        }
        let (fault, delay) = self.decide(action, key);
        if !delay.is_zero() {
            tokio::time::sleep(delay).await;
        }
        if self.is_lost() {
            return Err(self.unavailable(action, key, "the node is lost"));
        }
        if self.emptied.load(Ordering::SeqCst) {
            return Err(StoreError::NoBucket { store: self.describe(), bucket: "test".to_owned() });
        }
        if fault == Fault::Unavailable {
            return Err(self.unavailable(action, key, "injected"));
        }
        Ok(fault)
    }

    fn decide(&self, action: &'static str, key: &str) -> (Fault, Duration) {
        let plan = &self.plan;
        let mut state = self.lock();
        let State { seen, injected } = &mut *state;
        let (done, failed) = seen.entry((action, key.to_owned())).or_default();
        let draw = self.draw(action, key, *done);
        *done += 1;
        let mut delay = Duration::ZERO;
        if (draw >> 40) % 1000 < u64::from(plan.delayed) {
            injected.delayed += 1;
            delay = plan.longest_delay.mul_f64(((draw >> 20) & 0xffff) as f64 / 65536.0);
        }
        if *failed >= plan.most_per_key {
            return (Fault::None, delay);
        }
        let writes = matches!(action, "put" | "delete");
        let mut share = draw % 1000;
        let mut falls = |width: u32| {
            let hit = share < u64::from(width);
            share = share.saturating_sub(u64::from(width));
            hit
        };
        let fault = if falls(plan.unavailable) {
            injected.unavailable += 1;
            Fault::Unavailable
        } else if writes && falls(plan.lost_reply) {
            injected.lost_replies += 1;
            Fault::LostReply
        } else if action == "get" && falls(plan.corrupt) {
            injected.corrupt += 1;
            Fault::Corrupt(draw)
        } else {
            Fault::None
        };
        *failed += u32::from(fault != Fault::None);
        (fault, delay)
    }

    fn unavailable(&self, action: &'static str, key: &str, message: &str) -> StoreError {
        StoreError::Unavailable { store: self.describe(), action, key: key.to_owned(), message: message.to_owned() }
    }

    /// Answers after an operation was done.
    fn end<T>(&self, action: &'static str, key: &str, fault: Fault, done: T) -> Result<T, StoreError> {
        match fault {
            Fault::LostReply => Err(self.unavailable(action, key, "injected: done, but the reply is lost")),
            _ => Ok(done),
        }
    }
}

/// The body with a byte changed or without its second half; an empty one gets a byte.
fn corrupted(body: &Bytes, draw: u64) -> Bytes {
    let mut bytes = body.to_vec();
    let place = (draw >> 10) as usize;
    match bytes.len() {
        0 => bytes.push(0),
        n if place.is_multiple_of(4) => bytes.truncate(n / 2),
        n => bytes[place % n] ^= 1 << (draw % 8),
    }
    bytes.into()
}

#[async_trait]
impl Pulse for Faulty {
    async fn take(&self) -> Result<(), String> {
        if self.is_lost() || self.hangs.load(Ordering::SeqCst) { Err("no pulse".to_owned()) } else { Ok(()) }
    }
}

#[async_trait]
impl BlockStore for Faulty {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        let fault = self.begin("put", key).await?;
        let done = self.inner().put(key, body).await?;
        self.end("put", key, fault, done)
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let fault = self.begin("get", key).await?;
        let body = self.inner().get(key).await?;
        Ok(if let Fault::Corrupt(draw) = fault { corrupted(&body, draw) } else { body })
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        self.begin("size", key).await?;
        self.inner().size(key).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.begin("list", prefix).await?;
        self.inner().list(prefix).await
    }

    async fn list_versions(&self, prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        self.begin("list", prefix).await?;
        self.inner().list_versions(prefix).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        let first = keys.first().map_or("", String::as_str);
        let fault = self.begin("delete", first).await?;
        let done = self.inner().delete(keys).await?;
        self.end("delete", first, fault, done)
    }

    fn describe(&self) -> String {
        self.inner().describe()
    }
}

#[cfg(test)]
mod tests {
    use super::super::MemoryStore;
    use super::super::conformance::conformance;
    use super::*;

    #[tokio::test]
    async fn conforms_when_nothing_is_planned() {
        let delays = FaultPlan { delayed: 3, longest_delay: Duration::from_millis(2), ..FaultPlan::default() };
        let store = Faulty::new(Arc::new(MemoryStore::new()), delays);
        conformance(&store).await;
        assert!(store.injected().delayed > 0);
    }

    #[tokio::test]
    async fn the_seed_replays_whatever_the_order() {
        let plan = FaultPlan { seed: 3, unavailable: 300, corrupt: 300, ..FaultPlan::default() };
        let keys: Vec<String> = (0..50).map(|i| format!("k{i}")).collect();
        let mut outcomes = Vec::new();
        for reversed in [false, true] {
            let store = Faulty::new(Arc::new(MemoryStore::new()), plan);
            let order: Vec<&String> = if reversed { keys.iter().rev().collect() } else { keys.iter().collect() };
            let mut seen = Vec::new();
            for key in order {
                while store.put(key, Bytes::from_static(b"body")).await.is_err() {}
                let got: Vec<_> = [store.get(key).await.ok(), store.get(key).await.ok()].into();
                seen.push((key.clone(), got));
            }
            seen.sort();
            assert!(store.injected().unavailable > 10 && store.injected().corrupt > 10);
            outcomes.push(seen);
        }
        assert_eq!(outcomes[0], outcomes[1]);
    }

    #[tokio::test]
    async fn a_lost_reply_was_done_and_a_lost_node_comes_back_empty() {
        let plan = FaultPlan { lost_reply: 1000, most_per_key: 1, ..FaultPlan::default() };
        let store = Faulty::new(Arc::new(MemoryStore::new()), plan);
        let body = Bytes::from_static(b"body");
        assert!(matches!(store.put("a", body.clone()).await, Err(StoreError::Unavailable { .. })));
        assert_eq!(store.get("a").await.unwrap(), body);
        store.put("a", body.clone()).await.unwrap();
        store.damage("a").await.unwrap();
        assert_ne!(store.get("a").await.unwrap(), body);
        store.lose();
        assert!(matches!(store.get("a").await, Err(StoreError::Unavailable { .. })));
        store.restore(Some(Arc::new(MemoryStore::new())));
        assert!(matches!(store.get("a").await, Err(StoreError::NotFound { .. })));
    }
}
