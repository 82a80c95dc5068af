//! The pointers to the newest round records, in the status of the job: the one place that must be consistent.

use std::sync::{Mutex, PoisonError};

use kube::api::{Patch, PatchParams};
use kube::{Api, Client};
use rayherd_api::resource::{LedgerPointer, RenderJobObject};
use rayherd_herd::job::JobError;
use serde_json::json;
use tokio::runtime::Handle;

/// Field manager of the pointers.
const MANAGER: &str = "rayherd-ledger";
/// Tries, when others write other parts of the status at the same time or the API server does not answer.
const TRIES: u32 = 60;

/// Moves the pointers of one job. Only the operator that has moved them last can: each move names the version of the object that it
/// has seen, and before it tries again it looks whether the pointers are still its own.
pub struct Ledger {
    api: Api<RenderJobObject>,
    name: String,
    uid: String,
    runtime: Handle,
    seen: Mutex<Seen>,
}

struct Seen {
    version: Option<String>,
    pointers: Vec<LedgerPointer>,
}

impl Ledger {
    /// The pointers of a job as it was read.
    pub fn new(client: Client, job: &RenderJobObject, runtime: Handle) -> Self {
        let namespace = job.metadata.namespace.clone().unwrap_or_default();
        let seen = Seen {
            version: job.metadata.resource_version.clone(),
            pointers: job.status.as_ref().map(|s| s.ledger.clone()).unwrap_or_default(),
        };
        Ledger {
            api: Api::namespaced(client, &namespace),
            name: job.metadata.name.clone().unwrap_or_default(),
            uid: job.metadata.uid.clone().unwrap_or_default(),
            runtime,
            seen: Mutex::new(seen),
        }
    }

    /// The newest record of a frame.
    pub fn newest(&self, frame: u32) -> Option<(u64, String)> {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let found = seen.pointers.iter().find(|p| p.frame == frame as i32);
        found.map(|p| (p.sequence as u64, p.record.clone()))
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
        pointers.push(moved);
        pointers.sort_by_key(|p| p.frame);
        let mut why = String::new();
        for attempt in 0..TRIES {
            let patch = json!({
                "metadata": {"resourceVersion": seen.version, "uid": self.uid},
                "status": {"ledger": pointers},
            });
            let params = PatchParams { field_manager: Some(MANAGER.into()), ..PatchParams::default() };
            match self.api.patch_status(&self.name, &params, &Patch::Merge(&patch)).await {
                Ok(job) => {
                    *seen = Seen { version: job.metadata.resource_version, pointers };
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
                    let wait = std::time::Duration::from_millis(100 << attempt.min(5));
                    tokio::time::sleep(wait).await;
                }
            }
        }
        Err(JobError::Owned(format!("the ledger of job {} cannot be written: {why}", self.name)))
    }
}
