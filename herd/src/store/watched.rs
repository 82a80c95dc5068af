//! A store whose machine may fall silent: found out soon, and not waited for again and again.
//!
//! A server that is gone refuses connections, which costs nothing. A machine whose plug is pulled does not even do that: each request
//! would wait for its time-out, on a connection that is open still, and a job that asks it at every step would not come to its end. So
//! who waits long for an answer takes the machine's pulse beside it, and what has none is not asked until it has one again.
//!
//! A server that has come back with another disk has not even the bucket. It holds nothing then, and says so: reads go to other copies. Nor
//! does it take anything, until somebody makes the bucket again.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout};

use super::{BlockStore, StoreError, Version};

/// Whether a machine answers at all, however busy its server is.
#[async_trait]
pub trait Pulse: Send + Sync {
    /// Looks now.
    ///
    /// # Errors
    /// What there was instead of an answer.
    async fn take(&self) -> Result<(), String>;
}

/// The pulse of a TCP server: it takes a connection.
pub struct TcpPulse {
    /// `host:port`.
    pub address: String,
    /// Longest wait. Kernels repeat a lost first packet after 1 s.
    pub longest: Duration,
}

#[async_trait]
impl Pulse for TcpPulse {
    async fn take(&self) -> Result<(), String> {
        match timeout(self.longest, TcpStream::connect(&self.address)).await {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(e)) => Err(format!("{}: {e}", self.address)),
            Err(_) => Err(format!("{} takes no connection within {:?}", self.address, self.longest)),
        }
    }
}

/// When to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// A request that takes longer has the pulse taken, and again after each further such time.
    pub answer: Duration,
    /// A silent machine's pulse is taken again after this, by whoever comes first.
    pub pause: Duration,
}

impl Default for Patience {
    /// A pulled plug costs each process that asks some 4 s once, and one of its requests some 2 s of every 5 s.
    fn default() -> Self {
        Patience { answer: Duration::from_secs(2), pause: Duration::from_secs(5) }
    }
}

/// A store with an eye on its machine. Requests to a silent one fail at once with [`StoreError::Unavailable`].
pub struct Watched {
    inner: Arc<dyn BlockStore>,
    pulse: Arc<dyn Pulse>,
    patience: Patience,
    silence: Mutex<Option<Silence>>,
}

#[derive(Clone, Debug)]
struct Silence {
    since: Instant,
    /// When to look again.
    next: Instant,
    why: String,
    /// It answers, and its bucket is gone.
    emptied: bool,
}

/// Below this nothing lies: whether there is a bucket is asked so.
const PROBE: &str = "rayherd-bucket-probe/";

impl Watched {
    /// Around a store, which is taken to answer until it does not.
    pub fn new(inner: Arc<dyn BlockStore>, pulse: Arc<dyn Pulse>, patience: Patience) -> Self {
        Watched { inner, pulse, patience, silence: Mutex::default() }
    }

    /// For how long it has been known to be silent; none if it answers, as far as is known.
    pub fn silent_for(&self) -> Option<Duration> {
        self.lock().as_ref().map(|s| s.since.elapsed())
    }

    /// Whether it was seen last without its bucket.
    pub fn is_emptied(&self) -> bool {
        self.lock().as_ref().is_some_and(|s| s.emptied)
    }

    /// Takes the pulse of a machine that is known to be silent, when it is time to; so that whoever has nothing to ask it learns that it
    /// is back.
    pub async fn look(&self) {
        // what it would have been refused for is in the silence itself
        let _ = self.admit().await;
    }

    fn lock(&self) -> MutexGuard<'_, Option<Silence>> {
        self.silence.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether to ask at all; else why not.
    async fn admit(&self) -> Result<(), Silence> {
        {
            let mut silence = self.lock();
            let Some(s) = silence.as_mut() else { return Ok(()) };
            if Instant::now() < s.next {
                return Err(s.clone());
            }
            // this request looks, others are refused meanwhile
            s.next = Instant::now() + self.patience.pause;
        }
        self.look_now().await
    }

    async fn look_now(&self) -> Result<(), Silence> {
        let found = match self.pulse.take().await {
            Err(why) => Err((why, false)),
            // its server may be without its bucket still
            Ok(()) if self.is_emptied() => match timeout(self.patience.answer, self.inner.list(PROBE)).await {
                Ok(Ok(_)) => Ok(()),
                Ok(Err(e)) => Err((e.to_string(), true)),
                Err(_) => Err(("whether its bucket is there is not known".to_owned(), true)),
            },
            Ok(()) => Ok(()),
        };
        match found {
            Ok(()) => {
                if let Some(s) = self.lock().take() {
                    tracing::info!("{} answers again after {:?}", self.inner.describe(), s.since.elapsed());
                }
                Ok(())
            }
            Err((why, emptied)) => Err(self.leave_out(why, emptied)),
        }
    }

    /// Notes why it is not asked.
    fn leave_out(&self, why: String, emptied: bool) -> Silence {
        let mut silence = self.lock();
        let now = Instant::now();
        let since = silence.as_ref().map_or(now, |s| s.since);
        if silence.as_ref().is_none_or(|s| s.emptied != emptied) {
            let what = if emptied { "has lost what it held" } else { "is silent" };
            tracing::warn!("{} {what}: {why}; it is left out", self.inner.describe());
        }
        silence.insert(Silence { since, next: now + self.patience.pause, why, emptied }).clone()
    }

    /// Asks; none when the server holds nothing.
    async fn ask<T>(
        &self,
        action: &'static str,
        key: &str,
        request: impl Future<Output = Result<T, StoreError>> + Send,
    ) -> Result<Option<T>, StoreError> {
        let refuse = |s: Silence| {
            if s.emptied {
                return Ok(None);
            }
            let message = format!("its machine is silent: {}", s.why);
            Err(StoreError::Unavailable { store: self.inner.describe(), action, key: key.to_owned(), message })
        };
        if let Err(silence) = self.admit().await {
            return refuse(silence);
        }
        tokio::pin!(request);
        loop {
            let done = match timeout(self.patience.answer, &mut request).await {
                Ok(done) => done,
                Err(_) => tokio::select! {
                    biased;
                    done = &mut request => done,
                    found = self.look_now() => match found {
                        Ok(()) => continue,
                        Err(silence) => return refuse(silence),
                    },
                },
            };
            return match done {
                Err(e @ StoreError::NoBucket { .. }) => {
                    self.leave_out(e.to_string(), true);
                    Ok(None)
                }
                Err(e @ StoreError::Unavailable { .. }) => {
                    // a server that is there and busy is no silent machine
                    let _ = self.look_now().await;
                    Err(e)
                }
                done => done.map(Some),
            };
        }
    }

    /// Of what it would have to take.
    fn without_bucket(&self, action: &'static str, key: &str) -> StoreError {
        let message = self.lock().as_ref().map_or_else(|| "its bucket is gone".to_owned(), |s| s.why.clone());
        StoreError::Unavailable { store: self.inner.describe(), action, key: key.to_owned(), message }
    }
}

#[async_trait]
impl BlockStore for Watched {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        let put = self.ask("put", key, self.inner.put(key, body)).await?;
        put.ok_or_else(|| self.without_bucket("put", key))
    }
    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        let put = self.ask("put", key, self.inner.put_file(key, file)).await?;
        put.ok_or_else(|| self.without_bucket("put", key))
    }
    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let none = || StoreError::NotFound { store: self.inner.describe(), key: key.to_owned() };
        self.ask("get", key, self.inner.get(key)).await?.ok_or_else(none)
    }
    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        let none = || StoreError::NotFound { store: self.inner.describe(), key: key.to_owned() };
        self.ask("get", key, self.inner.get_file(key, file)).await?.ok_or_else(none)
    }
    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        Ok(self.ask("size", key, self.inner.size(key)).await?.flatten())
    }
    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        Ok(self.ask("list", prefix, self.inner.list(prefix)).await?.unwrap_or_default())
    }
    async fn list_versions(&self, prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        // one that has lost what it held says nothing of it
        Ok(self.ask("list", prefix, self.inner.list_versions(prefix)).await?.flatten())
    }
    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        // what is gone with the bucket need not be deleted
        self.ask("delete", keys.first().map_or("", String::as_str), self.inner.delete(keys)).await.map(drop)
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

    const SOON: Patience = Patience { answer: Duration::from_millis(20), pause: Duration::from_millis(50) };

    fn watched() -> (Arc<Faulty>, Arc<Watched>) {
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), FaultPlan::default()));
        let watched = Watched::new(faulty.clone(), faulty.clone(), SOON);
        (faulty, Arc::new(watched))
    }

    #[tokio::test]
    async fn conforms() {
        conformance(watched().1.as_ref()).await;
    }

    #[tokio::test]
    async fn a_silent_machine_is_waited_for_once_and_asked_again_when_it_is_back() {
        let (faulty, store) = watched();
        let body = Bytes::from_static(b"body");
        store.put("a", body.clone()).await.unwrap();
        faulty.hang(true);
        // several at once, as slots do, and then many more
        let first = futures::future::join_all((0..4).map(|_| store.get("a"))).await;
        assert!(first.iter().all(|r| matches!(r, Err(StoreError::Unavailable { .. }))));
        let waited = faulty.hung();
        assert_eq!(waited, 4);
        for _ in 0..200 {
            let error = store.get("a").await.unwrap_err().to_string();
            assert!(error.contains("silent"), "{error}");
        }
        assert_eq!(faulty.hung(), waited, "none of these has reached it");
        assert!(store.silent_for().is_some());
        faulty.hang(false);
        let mut tries = 0;
        while store.get("a").await.ok() != Some(body.clone()) {
            tries += 1;
            assert!(tries < 1000, "it is not asked again");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(store.silent_for(), None);
    }

    #[tokio::test]
    async fn a_server_without_its_bucket_holds_nothing_and_takes_nothing_until_it_has_one() {
        let (faulty, store) = watched();
        let body = Bytes::from_static(b"body");
        store.put("a", body.clone()).await.unwrap();
        faulty.empty();
        assert!(matches!(store.get("a").await, Err(StoreError::NotFound { .. })));
        assert!(store.is_emptied() && store.silent_for().is_some());
        assert_eq!((store.size("a").await.unwrap(), store.list("").await.unwrap()), (None, vec![]));
        store.delete(&["a".to_owned()]).await.unwrap();
        let error = store.put("a", body.clone()).await.unwrap_err();
        assert!(matches!(error, StoreError::Unavailable { .. }), "another one may take it");
        assert!(error.to_string().contains("there is no bucket test: create it"), "{error}");
        // its machine goes, and comes back as it was
        faulty.hang(true);
        tokio::time::sleep(2 * SOON.pause).await;
        assert!(matches!(store.get("a").await, Err(StoreError::Unavailable { .. })));
        assert!(!store.is_emptied());
        faulty.hang(false);
        faulty.restore(Some(Arc::new(MemoryStore::new())));
        let mut tries = 0;
        while store.put("a", body.clone()).await.is_err() {
            tries += 1;
            assert!(tries < 1000, "it is not asked again");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!((store.is_emptied(), store.silent_for()), (false, None));
    }

    #[tokio::test]
    async fn a_slow_server_on_a_machine_that_lives_is_waited_for() {
        let slow = FaultPlan { delayed: 1000, longest_delay: Duration::from_millis(400), ..FaultPlan::default() };
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), slow));
        let store = Watched::new(faulty.clone(), faulty.clone(), SOON);
        for key in ["a", "b", "c", "d"] {
            store.put(key, Bytes::from_static(b"body")).await.unwrap();
            store.get(key).await.unwrap();
        }
        assert_eq!((faulty.injected().delayed, store.silent_for()), (8, None));
        // nor does one that says no for now, and is there, count as silent
        let busy = FaultPlan { unavailable: 1000, ..FaultPlan::default() };
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), busy));
        let store = Watched::new(faulty.clone(), faulty.clone(), SOON);
        store.get("a").await.unwrap_err();
        assert_eq!(store.silent_for(), None);
    }

    #[tokio::test]
    async fn the_pulse_of_a_server_is_that_it_takes_connections() {
        let server = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = server.local_addr().unwrap().to_string();
        let pulse = TcpPulse { address, longest: Duration::from_secs(20) };
        pulse.take().await.unwrap();
        drop(server);
        assert!(pulse.take().await.unwrap_err().contains(&pulse.address));
    }
}
