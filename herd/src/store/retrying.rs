//! Tries again what may work later.

use std::hash::{BuildHasher, RandomState};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use futures::future::BoxFuture;

use super::{BlockStore, StoreError, Version};

/// How often and how fast to try again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RetryPolicy {
    /// Tries in all, at least 1.
    pub attempts: u32,
    /// Wait before the second try; doubles with each further one.
    pub first: Duration,
    /// Longest wait.
    pub longest: Duration,
}

impl Default for RetryPolicy {
    /// Seven tries within some 10 s: a server that starts again is waited for, one that is gone is soon given up.
    fn default() -> Self {
        RetryPolicy { attempts: 7, first: Duration::from_millis(100), longest: Duration::from_secs(5) }
    }
}

impl RetryPolicy {
    /// The wait after a try failed (tries count from 1), `random` in [0, 1): between half and all of the doubled wait,
    /// so that those who failed together do not come back together.
    fn wait(&self, attempt: u32, random: f64) -> Duration {
        let doubled = self.first.saturating_mul(1u32.checked_shl(attempt - 1).unwrap_or(u32::MAX));
        doubled.min(self.longest).mul_f64(0.5 + 0.5 * random)
    }
}

/// A store whose operations are tried again when the error is [`StoreError::Unavailable`], and only then.
pub struct Retrying {
    inner: Arc<dyn BlockStore>,
    policy: RetryPolicy,
    retries: AtomicU64,
    random: RandomState,
}

impl Retrying {
    /// Around a store.
    pub fn new(inner: Arc<dyn BlockStore>, policy: RetryPolicy) -> Self {
        Self { inner, policy, retries: AtomicU64::new(0), random: RandomState::new() }
    }

    /// Tries beyond the first, so far.
    pub fn retries(&self) -> u64 {
        self.retries.load(Ordering::Relaxed)
    }

    async fn retry<'a, T>(
        &self,
        mut operation: impl FnMut() -> BoxFuture<'a, Result<T, StoreError>> + Send,
    ) -> Result<T, StoreError> {
        let mut attempt = 0;
        loop {
            attempt += 1;
            match operation().await {
                Err(StoreError::Unavailable { store, action, key, message }) => {
                    if attempt >= self.policy.attempts {
                        let message = format!("{message} (tried {attempt} times)");
                        return Err(StoreError::Unavailable { store, action, key, message });
                    }
                    let number = self.retries.fetch_add(1, Ordering::Relaxed);
                    let wait = self.policy.wait(attempt, self.random.hash_one(number) as f64 / u64::MAX as f64);
                    tracing::debug!(%store, action, %key, %message, attempt, ?wait, "trying again");
                    tokio::time::sleep(wait).await;
                }
                done => return done,
            }
        }
    }
}

#[async_trait]
impl BlockStore for Retrying {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        self.retry(|| self.inner.put(key, body.clone())).await
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        self.retry(|| self.inner.put_file(key, file)).await
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        self.retry(|| self.inner.get(key)).await
    }

    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        self.retry(|| self.inner.get_file(key, file)).await
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        self.retry(|| self.inner.size(key)).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.retry(|| self.inner.list(prefix)).await
    }

    async fn list_versions(&self, prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        self.retry(|| self.inner.list_versions(prefix)).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.retry(|| self.inner.delete(keys)).await
    }

    fn describe(&self) -> String {
        self.inner.describe()
    }
}

#[cfg(test)]
mod tests {
    use super::super::conformance::conformance;
    use super::super::{FaultPlan, Faulty, MemoryStore};
    use super::*;

    fn soon(attempts: u32) -> RetryPolicy {
        RetryPolicy { attempts, first: Duration::from_millis(1), longest: Duration::from_millis(4) }
    }

    #[tokio::test]
    async fn conforms_over_a_store_that_fails() {
        let plan = FaultPlan { seed: 7, unavailable: 150, lost_reply: 100, most_per_key: 5, ..FaultPlan::default() };
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), plan));
        let store = Retrying::new(faulty.clone(), soon(6));
        conformance(&store).await;
        let injected = faulty.injected();
        assert!(injected.unavailable > 100 && injected.lost_replies > 100, "{injected:?}");
        // a lost reply to a put that is refused for its key is no reason to retry
        let (retries, faults) = (store.retries(), injected.unavailable + injected.lost_replies);
        assert!(retries <= faults && retries > faults * 9 / 10, "{retries} retries, {faults} faults");
    }

    #[tokio::test]
    async fn gives_up_after_so_many_tries_and_never_retries_what_is_final() {
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), FaultPlan::default()));
        let store = Retrying::new(faulty.clone(), soon(3));
        assert!(matches!(store.get("a").await, Err(StoreError::NotFound { .. })));
        assert_eq!(store.retries(), 0);
        faulty.lose();
        let error = store.get("a").await.unwrap_err().to_string();
        assert!(error.contains("tried 3 times"), "{error}");
        assert_eq!(store.retries(), 2);
    }

    #[test]
    fn waits_double_up_to_the_longest() {
        let policy = RetryPolicy::default();
        let longest = |attempt| policy.wait(attempt, 1.0).as_millis();
        assert_eq!([1, 2, 3, 6, 7, 40, 90].map(longest), [100, 200, 400, 3200, 5000, 5000, 5000]);
        assert_eq!(policy.wait(2, 0.0).as_millis(), 100);
    }
}
