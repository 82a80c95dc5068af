//! The pointers to the newest round records, in the status of the job: the one place that must be consistent.
//!
//! A status holds [`INLINE`] of them. Those of a job of more frames lie in an object in its storage, which the status names by its hash,
//! and so counts as they do. It is read when a frame is asked for that the status does not tell of.

use std::sync::{Mutex, PoisonError};

use kube::api::{Patch, PatchParams};
use kube::{Api, Client};
use rayherd_api::resource::{LedgerPointer, RenderJobObject};
use rayherd_herd::job::JobError;
use rayherd_herd::remote::Depot;
use rayherd_herd::store::{BlockStore, StoreError};
use rayherd_scene::objects::ObjectHash;
use serde_json::json;
use tokio::runtime::Handle;

use crate::backoff::part;

/// Field manager of the pointers.
const MANAGER: &str = "rayherd-ledger";
/// Tries, when others write other parts of the status at the same time or the API server does not answer.
const TRIES: u32 = 60;

/// So many pointers stand in a status; then all but the one that moves go into an object.
const INLINE: usize = 32;
/// In the place of a frame's number: `record` is the hash of such an object, `sequence` how many pointers it holds.
const FOLDED: i32 = -1;

/// Where pointers lie that the status has no room for.
pub struct Beside {
    /// The job's stores.
    pub depot: Depot,
    /// Copies of each object.
    pub replicas: u32,
    /// Where the job's objects are.
    pub prefix: String,
}

impl Beside {
    fn key(&self, hash: &str) -> String {
        format!("{}/pointers/{hash}", self.prefix)
    }
    async fn put(&self, pointers: &[LedgerPointer]) -> Result<LedgerPointer, JobError> {
        let body = serde_json::to_vec(pointers).map_err(|e| JobError::Internal(e.to_string()))?;
        let record = ObjectHash::of(&body).to_string();
        self.depot.replicated(self.replicas)?.put(&self.key(&record), body.into()).await?;
        Ok(LedgerPointer { frame: FOLDED, sequence: pointers.len() as i64, record })
    }
    /// None where no copy is left: then the frames begin anew.
    async fn get(&self, hash: &str) -> Result<Option<Vec<LedgerPointer>>, JobError> {
        let body = match self.depot.replicated(self.replicas)?.get(&self.key(hash)).await {
            Ok(body) => body,
            Err(StoreError::NotFound { .. }) => return Ok(None),
            Err(e) => return Err(e.into()),
        };
        if ObjectHash::of(&body).to_string() != hash {
            return Ok(None);
        }
        Ok(serde_json::from_slice(&body).ok())
    }
}

/// Moves the pointers of one job. Only the operator that has moved them last can: each move names the version of the object that it
/// has seen, and before it tries again it looks whether the pointers are still its own.
pub struct Ledger {
    api: Api<RenderJobObject>,
    name: String,
    uid: String,
    runtime: Handle,
    beside: Beside,
    seen: Mutex<Seen>,
}

struct Seen {
    version: Option<String>,
    pointers: Vec<LedgerPointer>,
    /// What the object holds that the pointers name; none until it is read.
    folded: Option<Vec<LedgerPointer>>,
}

impl Ledger {
    /// The pointers of a job as it was read.
    pub fn new(client: Client, job: &RenderJobObject, runtime: Handle, beside: Beside) -> Self {
        let namespace = job.metadata.namespace.clone().unwrap_or_default();
        let seen = Seen {
            version: job.metadata.resource_version.clone(),
            pointers: job.status.as_ref().map(|s| s.ledger.clone()).unwrap_or_default(),
            folded: None,
        };
        Ledger {
            api: Api::namespaced(client, &namespace),
            name: job.metadata.name.clone().unwrap_or_default(),
            uid: job.metadata.uid.clone().unwrap_or_default(),
            runtime,
            beside,
            seen: Mutex::new(seen),
        }
    }

    /// The newest record of a frame. Blocks; not to be called from async code.
    pub fn newest(&self, frame: u32) -> Result<Option<(u64, String)>, JobError> {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let of = |all: &[LedgerPointer]| {
            let found = all.iter().find(|p| p.frame == frame as i32);
            found.map(|p| (p.sequence as u64, p.record.clone()))
        };
        if let Some(found) = of(&seen.pointers) {
            return Ok(Some(found));
        }
        Ok(of(self.runtime.block_on(self.folded(&mut seen))?))
    }

    /// What lies beside the status, read once.
    async fn folded<'s>(&self, seen: &'s mut Seen) -> Result<&'s mut Vec<LedgerPointer>, JobError> {
        if seen.folded.is_none() {
            let name = seen.pointers.iter().find(|p| p.frame == FOLDED).map(|p| p.record.clone());
            let found = match &name {
                None => Vec::new(),
                Some(name) => self.beside.get(name).await?.unwrap_or_else(|| {
                    tracing::warn!(job = self.name, "the pointers of frames that are done are lost: these begin anew");
                    Vec::new()
                }),
            };
            seen.folded = Some(found);
        }
        Ok(seen.folded.get_or_insert_default())
    }

    /// Moves a pointer. Blocks; not to be called from async code.
    pub fn move_to(&self, frame: u32, sequence: u64, record: &str) -> Result<(), JobError> {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        self.runtime.block_on(self.write(&mut seen, frame, sequence, record))
    }

    async fn write(&self, seen: &mut Seen, frame: u32, sequence: u64, record: &str) -> Result<(), JobError> {
        let moved = LedgerPointer { frame: frame as i32, sequence: sequence as i64, record: record.to_owned() };
        let mut pointers = seen.pointers.clone();
        pointers.retain(|p| p.frame != moved.frame);
        pointers.push(moved.clone());
        pointers.sort_by_key(|p| p.frame);
        let mut folded = None;
        if pointers.iter().filter(|p| p.frame != FOLDED).count() > INLINE {
            let mut all = self.folded(seen).await?.clone();
            let old = pointers.iter().filter(|p| p.frame != FOLDED && p.frame != moved.frame);
            for pointer in old {
                all.retain(|p| p.frame != pointer.frame);
                all.push(pointer.clone());
            }
            all.sort_by_key(|p| p.frame);
            pointers = vec![self.beside.put(&all).await?, moved];
            folded = Some(all);
        }
        let mut why = String::new();
        for attempt in 0..TRIES {
            let patch = json!({
                "metadata": {"resourceVersion": seen.version, "uid": self.uid},
                "status": {"ledger": pointers},
            });
            let params = PatchParams { field_manager: Some(MANAGER.into()), ..PatchParams::default() };
            match self.api.patch_status(&self.name, &params, &Patch::Merge(&patch)).await {
                Ok(job) => {
                    let folded = folded.or(seen.folded.take());
                    *seen = Seen { version: job.metadata.resource_version, pointers, folded };
                    return Ok(());
                }
                Err(kube::Error::Api(e)) if e.code == 404 => {
                    return Err(JobError::Owned(format!("job {} is gone", self.name)));
                }
                Err(e) => why = e.to_string(),
            }
            // somebody wrote to the object, or our write's answer was lost: look at it anew
            match self.api.get(&self.name).await {
                Ok(job) => {
                    let found = job.status.map(|s| s.ledger).unwrap_or_default();
                    if job.metadata.uid.as_deref() != Some(&self.uid) {
                        return Err(JobError::Owned(format!("job {} was made anew", self.name)));
                    }
                    seen.version = job.metadata.resource_version;
                    if found == pointers {
                        seen.pointers = pointers;
                        seen.folded = folded.or(seen.folded.take());
                        return Ok(());
                    }
                    if found != seen.pointers {
                        return Err(JobError::Owned(format!("another operator runs job {}", self.name)));
                    }
                }
                Err(kube::Error::Api(e)) if e.code == 404 => {
                    return Err(JobError::Owned(format!("job {} is gone", self.name)));
                }
                Err(e) => {
                    tracing::warn!("{e}");
                    let wait = part(std::time::Duration::from_millis(100 << attempt.min(5)), &self.name, attempt);
                    tokio::time::sleep(wait).await;
                }
            }
        }
        Err(JobError::Owned(format!("the ledger of job {} cannot be written: {why}", self.name)))
    }
}
