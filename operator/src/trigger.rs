//! When a job is looked at before its next turn: at a change of what it asks for or of what it is, not at each number that we ourselves write
//! into its status.

use std::hash::{DefaultHasher, Hash, Hasher};

use futures::channel::mpsc::UnboundedSender;
use kube::Resource;
use kube::runtime::reflector::ObjectRef;
use rayherd_api::resource::RenderJobObject;

use crate::reconcile::Seen;

/// Equal for two states of a job between which nothing happened but progress: a step after each record of the ledger, and a status after each
/// step, would be most of what the API server does.
pub fn stirs(job: &Seen) -> Option<u64> {
    let (meta, mut hash) = (job.meta(), DefaultHasher::new());
    (&meta.generation, &meta.finalizers, &meta.annotations).hash(&mut hash);
    meta.deletion_timestamp.is_some().hash(&mut hash);
    match &job.0 {
        Err(invalid) => invalid.error.hash(&mut hash),
        Ok(job) => {
            let Some(status) = &job.status else { return Some(hash.finish()) };
            (&status.phase, &status.workers).hash(&mut hash);
            (status.start_time.is_some(), status.completion_time.is_some()).hash(&mut hash);
            for condition in &status.conditions {
                (&condition.type_, &condition.status, &condition.reason).hash(&mut hash);
            }
        }
    }
    Some(hash.finish())
}

/// Has one job looked at now.
#[derive(Clone)]
pub struct Wake(UnboundedSender<ObjectRef<Seen>>, ObjectRef<Seen>);

impl Wake {
    /// Of this job.
    pub fn of(job: &RenderJobObject, steps: &UnboundedSender<ObjectRef<Seen>>) -> Self {
        let (name, namespace) = (job.metadata.name.as_deref(), job.metadata.namespace.as_deref());
        Wake(steps.clone(), ObjectRef::new(name.unwrap_or_default()).within(namespace.unwrap_or_default()))
    }
    /// Now; nothing is waited for.
    pub fn now(&self) {
        // nobody looks any more: the operator ends
        let _ = self.0.unbounded_send(self.1.clone());
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn seen(value: &Value) -> Option<u64> {
        stirs(&serde_json::from_value(value.clone()).unwrap())
    }

    #[test]
    fn progress_stirs_nobody_and_all_else_does() {
        let job = json!({
            "apiVersion": "rayherd.io/v1alpha1", "kind": "RenderJob",
            "metadata": {"name": "box", "namespace": "studio", "uid": "u-1", "generation": 3, "resourceVersion": "7"},
            "spec": {"scene": {"source": "scenes/box/box.xml"}},
            "status": {"phase": "Rendering", "workers": "3/3", "conditions": [{"type": "Running", "status": "True",
                "reason": "Rendering", "message": "", "lastTransitionTime": "2026-01-01T00:00:00Z"}]},
        });
        let with = |pointer: &str, value: Value| {
            let (folder, name) = pointer.rsplit_once('/').unwrap();
            let mut changed = job.clone();
            match changed.pointer_mut(folder).unwrap() {
                Value::Object(map) => map.insert(name.to_owned(), value),
                _ => panic!("{folder} is no object"),
            };
            seen(&changed)
        };
        for (pointer, value) in [
            ("/metadata/resourceVersion", json!("8")),
            ("/metadata/managedFields", json!([])),
            ("/status/progress", json!("50%")),
            ("/status/relMse", json!("1e-3")),
            ("/status/rounds", json!(7)),
            ("/status/raysWaiting", json!(7)),
            ("/status/cpuSeconds", json!(7)),
            ("/status/ledger", json!([{"frame": 0, "sequence": 7, "record": "00"}])),
            ("/status/conditions/0/message", json!("more of the same")),
        ] {
            assert_eq!(with(pointer, value), seen(&job), "{pointer}");
        }
        for (pointer, value) in [
            ("/metadata/generation", json!(4)),
            ("/metadata/finalizers", json!(["rayherd.io/storage"])),
            ("/metadata/annotations", json!({"rayherd.io/preview": "now"})),
            ("/metadata/deletionTimestamp", json!("2026-01-01T00:00:00Z")),
            ("/status/phase", json!("Complete")),
            ("/status/workers", json!("2/3")),
            ("/status/completionTime", json!("2026-01-01T00:00:00Z")),
            ("/status/conditions", json!([])),
            ("/status", Value::Null),
            ("/spec", json!({"scene": {"source": 7}})),
        ] {
            assert_ne!(with(pointer, value), seen(&job), "{pointer}");
        }
    }
}
