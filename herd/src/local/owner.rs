//! One writer at a time: an object with a heartbeat says who writes to a store.

use std::fs::read_to_string;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use crate::job::JobError;
use crate::store::{BlockStore, StoreError};

const KEY: &str = "owner";
/// A heartbeat older than this is nobody's.
const STALE: u64 = 60;
/// Time between heartbeats.
const BEAT: Duration = Duration::from_secs(10);

/// Who writes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Owner {
    /// Names one opening of the store.
    pub session: String,
    /// Within what process numbers mean something: the running machine (changes when it starts again) and its process namespace
    /// (containers of one machine count their processes apart).
    pub boot: String,
    /// Process number.
    pub pid: u32,
    /// When the process started, in ticks since the machine did: tells it from a later one with its number.
    pub started: u64,
    /// Last heartbeat, seconds since 1970.
    pub beat: u64,
}

/// The right to write, kept up by heartbeats.
pub struct Ownership {
    own: Owner,
    last: Instant,
}

impl Owner {
    /// This process, now.
    pub fn this_process() -> Owner {
        let machine = read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let boot = match (machine.trim(), std::fs::read_link("/proc/self/ns/pid")) {
            ("", _) | (_, Err(_)) => String::new(),
            (machine, Ok(namespace)) => format!("{machine} {}", namespace.display()),
        };
        let pid = std::process::id();
        let nanos = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        // several jobs may run in one process
        static COUNT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
        let count = COUNT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let mut hasher = blake3::Hasher::new();
        hasher
            .update(boot.as_bytes())
            .update(&pid.to_le_bytes())
            .update(&nanos.to_le_bytes())
            .update(&count.to_le_bytes());
        let session = hasher.finalize().to_hex()[..12].to_owned();
        Owner { session, boot, pid, started: started(pid).unwrap_or(0), beat: now() }
    }

    /// Whether it may still write: its process runs on this machine, or it is elsewhere and its heartbeat is fresh.
    fn is_alive(&self, here: &Owner) -> bool {
        if self.boot == here.boot && !self.boot.is_empty() {
            return started(self.pid) == Some(self.started);
        }
        now().saturating_sub(self.beat) < STALE
    }
}

impl Ownership {
    /// Takes the store, unless somebody alive has it and `takeover` is false.
    pub async fn take(store: &dyn BlockStore, takeover: bool) -> Result<Ownership, JobError> {
        let own = Owner::this_process();
        match read(store).await? {
            Some(other) if other.is_alive(&own) && !takeover => {
                return Err(JobError::Owned(format!(
                    "{}: process {} writes to it (last sign {} s ago): wait for it, stop it, or force with --takeover",
                    store.describe(),
                    other.pid,
                    now().saturating_sub(other.beat)
                )));
            }
            Some(other) if other.is_alive(&own) => {
                tracing::warn!("taking {} over from process {}", store.describe(), other.pid)
            }
            Some(other) => tracing::info!("process {}, which wrote to {}, is gone", other.pid, store.describe()),
            None => {}
        }
        let ownership = Ownership { own, last: Instant::now() };
        ownership.write(store).await?;
        // of two that begin together the later one stays
        ownership.check(store).await?;
        Ok(ownership)
    }

    /// Session's name, for names of objects.
    pub fn session(&self) -> &str {
        &self.own.session
    }

    /// Writes a heartbeat when one is due.
    ///
    /// # Errors
    /// When somebody else took the store over.
    pub async fn beat(&mut self, store: &dyn BlockStore) -> Result<(), JobError> {
        if self.last.elapsed() < BEAT {
            return Ok(());
        }
        self.check(store).await?;
        self.last = Instant::now();
        self.own.beat = now();
        self.write(store).await
    }

    /// Gives the store back.
    pub async fn give_back(&self, store: &dyn BlockStore) -> Result<(), JobError> {
        self.check(store).await?;
        Ok(store.delete(&[KEY.to_owned()]).await?)
    }

    async fn check(&self, store: &dyn BlockStore) -> Result<(), JobError> {
        match read(store).await? {
            Some(other) if other.session != self.own.session => {
                Err(JobError::Owned(format!("{} was taken over by process {}", store.describe(), other.pid)))
            }
            Some(_) => Ok(()),
            None => Err(JobError::Owned(format!(
                "{} was taken over by a process that has ended since: run again with --resume",
                store.describe()
            ))),
        }
    }
    async fn write(&self, store: &dyn BlockStore) -> Result<(), JobError> {
        let body = serde_json::to_vec(&self.own).map_err(|e| JobError::Internal(e.to_string()))?;
        Ok(store.put(KEY, Bytes::from(body)).await?)
    }
}

/// Whether somebody alive writes to the store.
pub async fn is_owned(store: &dyn BlockStore) -> Result<bool, JobError> {
    Ok(read(store).await?.is_some_and(|o| o.is_alive(&Owner::this_process())))
}

/// The owner, if any; one that cannot be read is none, as whoever wrote it cannot prove anything by it.
async fn read(store: &dyn BlockStore) -> Result<Option<Owner>, JobError> {
    match store.get(KEY).await {
        Ok(body) => Ok(serde_json::from_slice(&body).ok()),
        Err(StoreError::NotFound { .. } | StoreError::Corrupt { .. }) => Ok(None),
        Err(e) => Err(e.into()),
    }
}

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Start of a process on this machine in ticks; none if there is no such process, or it is dead and not buried yet.
fn started(pid: u32) -> Option<u64> {
    let stat = read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let mut fields = stat.rsplit(')').next()?.split_whitespace();
    // field 3 is the state, field 22 the start
    let state = fields.next()?;
    if matches!(state, "Z" | "X") {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::MemoryStore;

    #[tokio::test]
    async fn a_live_writer_is_refused_and_a_dead_one_is_no_obstacle() {
        let store = MemoryStore::default();
        let first = Ownership::take(&store, false).await.unwrap();
        let refused = Ownership::take(&store, false).await.err().unwrap().to_string();
        assert!(refused.contains("--takeover"), "{refused}");
        let mut second = Ownership::take(&store, true).await.unwrap();
        assert!(matches!(first.give_back(&store).await, Err(JobError::Owned(_))));
        // killed: the number is in use, but by another process
        second.own.started += 1;
        second.write(&store).await.unwrap();
        assert!(!is_owned(&store).await.unwrap());
        let third = Ownership::take(&store, false).await.unwrap();
        assert!(is_owned(&store).await.unwrap());
        third.give_back(&store).await.unwrap();
        assert!(!is_owned(&store).await.unwrap());
        // on another machine, or in another container of this one, only the heartbeat tells
        let container = Owner::this_process().boot.replace("pid:[", "pid:[1");
        for (age, owned) in [(STALE - 5, true), (STALE + 1, false)] {
            let mut other = Owner::this_process();
            assert_ne!(other.boot, container);
            (other.boot, other.beat) = (if owned { container.clone() } else { "elsewhere".into() }, now() - age);
            // a number that nobody has here says nothing
            other.pid = u32::MAX;
            store.put(KEY, serde_json::to_vec(&other).unwrap().into()).await.unwrap();
            assert_eq!(Ownership::take(&store, false).await.is_err(), owned);
        }
    }
}
