//! One writer at a time: an object with a heartbeat says who writes to a store.

use std::fs::read_to_string;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use tokio::sync::Notify;
use tokio::task::JoinHandle;

use crate::driver::Pointer;
use crate::job::JobError;
use crate::store::{BlockStore, StoreError};

const KEY: &str = "owner";
/// A heartbeat older than this is nobody's, seconds.
const STALE: u64 = 60;
/// Who cannot beat stops writing so long after its last heartbeat, seconds: before anybody may take the store for nobody's, with room
/// for a write that is under way and for clocks that differ.
const SILENT: u64 = 45;
/// Time between looks at who has the store: whoever is deposed commits no longer than this.
const LOOK: Duration = if cfg!(test) { Duration::from_millis(5) } else { Duration::from_secs(1) };
/// Time between heartbeats; tests do not wait so long.
const BEAT: Duration = if cfg!(test) { Duration::from_millis(20) } else { Duration::from_secs(10) };

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

/// The right to write, kept up by heartbeats, whatever else goes on, until it is given back or dropped.
pub struct Ownership {
    writer: Arc<Writer>,
    beating: Mutex<Option<JoinHandle<()>>>,
}

/// What beats.
struct Writer {
    own: Owner,
    store: Arc<dyn BlockStore>,
    /// Who took the store over, once somebody did.
    taken: Mutex<Option<String>>,
    /// When the last heartbeat that was written began, seconds since 1970.
    beaten: AtomicU64,
    over: Notify,
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
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
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
    /// Takes the store, unless somebody alive has it and `takeover` is false. The heart beats on the runtime that this is
    /// called on.
    ///
    /// # Errors
    /// [`JobError::Owned`] when somebody else has it, or takes it at the same moment.
    pub async fn take(store: Arc<dyn BlockStore>, takeover: bool) -> Result<Ownership, JobError> {
        let own = Owner::this_process();
        match read(store.as_ref()).await? {
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
        let beaten = AtomicU64::new(own.beat);
        let writer = Arc::new(Writer { own, store, taken: Mutex::default(), beaten, over: Notify::new() });
        writer.write().await?;
        // of two that begin together the later one stays
        writer.check().await?;
        let beating = tokio::spawn(writer.clone().beat());
        Ok(Ownership { writer, beating: Mutex::new(Some(beating)) })
    }

    /// Session's name, for names of objects.
    pub fn session(&self) -> &str {
        &self.writer.own.session
    }

    /// Gives the store back. Once is enough; more do no harm.
    ///
    /// # Errors
    /// When somebody else has taken it over, or it cannot be written to.
    pub async fn give_back(&self) -> Result<(), JobError> {
        self.writer.over.notify_one();
        let beating = self.beating.lock().unwrap_or_else(PoisonError::into_inner).take();
        // given back already: it may be another's by now
        let Some(beating) = beating else { return Ok(()) };
        if let Err(e) = beating.await {
            tracing::warn!("{}: the heartbeat ended: {e}", self.writer.store.describe());
        }
        self.writer.check().await?;
        Ok(self.writer.store.delete(&[KEY.to_owned()]).await?)
    }
}

impl Drop for Ownership {
    fn drop(&mut self) {
        self.writer.over.notify_one();
    }
}

/// What was committed is found by its records; all that is to be said is whether it may be.
impl Pointer for Ownership {
    fn check(&self) -> Result<(), JobError> {
        self.writer.may_write(now())
    }
    fn move_to(&self, _: u64, _: &str) -> Result<(), JobError> {
        self.check()
    }
}

impl Writer {
    /// Whether the store is this process's for certain at this time.
    fn may_write(&self, now: u64) -> Result<(), JobError> {
        if let Some(who) = &*self.taken.lock().unwrap_or_else(PoisonError::into_inner) {
            return Err(JobError::Owned(who.clone()));
        }
        let silent = now.saturating_sub(self.beaten.load(Ordering::Relaxed));
        if silent < SILENT {
            return Ok(());
        }
        Err(JobError::Owned(format!(
            "{} took no heartbeat for {silent} s, so that others may take it over: run again with --resume when it answers",
            self.store.describe()
        )))
    }

    /// Beats until the end, or until somebody else has the store.
    async fn beat(self: Arc<Self>) {
        let mut beaten = Instant::now();
        while tokio::time::timeout(LOOK, self.over.notified()).await.is_err() {
            let beat = async {
                self.check().await?;
                if beaten.elapsed() >= BEAT {
                    self.write().await?;
                    beaten = Instant::now();
                }
                Ok(())
            };
            match beat.await {
                Ok(()) => {}
                Err(JobError::Owned(who)) => {
                    *self.taken.lock().unwrap_or_else(PoisonError::into_inner) = Some(who);
                    return;
                }
                // whatever the job writes next fails as well, or it has passed by then
                Err(e) => tracing::warn!("no heartbeat: {e}"),
            }
        }
    }

    async fn check(&self) -> Result<(), JobError> {
        let store = &self.store;
        match read(store.as_ref()).await? {
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

    async fn write(&self) -> Result<(), JobError> {
        let own = Owner { beat: now(), ..self.own.clone() };
        let body = serde_json::to_vec(&own).map_err(|e| JobError::Internal(e.to_string()))?;
        self.store.put(KEY, Bytes::from(body)).await?;
        self.beaten.store(own.beat, Ordering::Relaxed);
        Ok(())
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
    use crate::store::{FaultPlan, Faulty, MemoryStore};

    async fn put(store: &dyn BlockStore, owner: &Owner) {
        store.put(KEY, serde_json::to_vec(owner).unwrap().into()).await.unwrap();
    }

    #[tokio::test]
    async fn a_live_writer_is_refused_and_a_dead_one_is_no_obstacle() {
        let store: Arc<dyn BlockStore> = Arc::new(MemoryStore::default());
        let first = Ownership::take(store.clone(), false).await.unwrap();
        let refused = Ownership::take(store.clone(), false).await.err().unwrap().to_string();
        assert!(refused.contains("--takeover"), "{refused}");
        let second = Ownership::take(store.clone(), true).await.unwrap();
        assert!(matches!(first.give_back().await, Err(JobError::Owned(_))));
        second.give_back().await.unwrap();
        // killed: the number is in use, but by another process
        let mut dead = Owner::this_process();
        dead.started += 1;
        put(store.as_ref(), &dead).await;
        assert!(!is_owned(store.as_ref()).await.unwrap());
        let third = Ownership::take(store.clone(), false).await.unwrap();
        assert!(is_owned(store.as_ref()).await.unwrap());
        third.give_back().await.unwrap();
        third.give_back().await.expect("once more is nothing");
        assert!(!is_owned(store.as_ref()).await.unwrap());
        // on another machine, or in another container of this one, only the heartbeat tells
        let container = Owner::this_process().boot.replace("pid:[", "pid:[1");
        for (age, owned) in [(STALE - 5, true), (STALE + 1, false)] {
            let mut other = Owner::this_process();
            assert_ne!(other.boot, container);
            (other.boot, other.beat) = (if owned { container.clone() } else { "elsewhere".into() }, now() - age);
            // a number that nobody has here says nothing
            other.pid = u32::MAX;
            put(store.as_ref(), &other).await;
            assert_eq!(Ownership::take(store.clone(), false).await.is_err(), owned);
        }
    }

    #[tokio::test]
    async fn who_cannot_beat_stops_writing_before_others_may_begin() {
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::default()), FaultPlan::default()));
        let owner = Ownership::take(faulty.clone(), false).await.unwrap();
        faulty.lose();
        tokio::time::sleep(2 * BEAT).await;
        let beat = owner.writer.beaten.load(Ordering::Relaxed);
        assert!(owner.writer.may_write(beat + SILENT - 1).is_ok());
        let late = owner.writer.may_write(beat + SILENT).unwrap_err().to_string();
        assert!(late.contains("no heartbeat for 45 s") && SILENT < STALE, "{late}");
        // it comes back, and so does the right to write
        faulty.restore(None);
        while owner.writer.beaten.load(Ordering::Relaxed) == beat && owner.writer.may_write(now()).is_ok() {
            tokio::time::sleep(BEAT).await;
        }
        assert!(owner.check().is_ok());
    }

    #[tokio::test]
    async fn who_was_taken_over_learns_of_it_at_the_next_look() {
        let store: Arc<dyn BlockStore> = Arc::new(MemoryStore::default());
        let first = Ownership::take(store.clone(), false).await.unwrap();
        assert!(first.move_to(0, "a").is_ok());
        let second = Ownership::take(store.clone(), true).await.unwrap();
        while first.move_to(1, "b").is_ok() {
            tokio::time::sleep(BEAT).await;
        }
        assert!(second.move_to(1, "b").is_ok());
        second.give_back().await.unwrap();
    }
}
