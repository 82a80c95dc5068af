//! Workers that were killed for lack of memory, as their pods tell. Pure.

use k8s_openapi::api::core::v1::{ContainerState, Pod};

use crate::build;

/// A container of a worker that was killed, or a worker's pod that was evicted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Kill {
    /// Names it: each is told of once.
    pub id: String,
    /// The worker.
    pub number: u32,
    /// What its container may take, as its pod says.
    pub limit: Option<String>,
}

/// All that are to be seen in these pods.
pub fn kills(pods: &[Pod]) -> Vec<Kill> {
    let mut found = Vec::new();
    for pod in pods {
        let (Some(number), Some(status)) = (build::number(pod), &pod.status) else { continue };
        let uid = pod.metadata.uid.as_deref().unwrap_or_default();
        let container = pod.spec.iter().flat_map(|s| &s.containers).find(|c| c.name == build::CONTAINER);
        let limits = container.and_then(|c| c.resources.as_ref()?.limits.as_ref());
        let limit = limits.and_then(|l| l.get("memory")).map(|q| q.0.clone());
        let kill = |id: String| Kill { id, number, limit: limit.clone() };
        let killed = |state: &Option<ContainerState>| {
            let end = state.as_ref()?.terminated.as_ref().filter(|t| t.reason.as_deref() == Some("OOMKilled"))?;
            // a container that starts again has another name; without one the time of its end tells
            let time = end.finished_at.as_ref().map(|t| t.0.to_string()).unwrap_or_default();
            Some(kill(format!("{uid} {}", end.container_id.clone().unwrap_or(time))))
        };
        for container in status.container_statuses.iter().flatten().filter(|c| c.name == build::CONTAINER) {
            found.extend([&container.last_state, &container.state].into_iter().filter_map(killed));
        }
        // its node had too little, and the kubelet chose this pod
        let of_memory = status.message.as_deref().is_some_and(|m| m.contains("memory"));
        if status.reason.as_deref() == Some("Evicted") && of_memory {
            found.push(kill(format!("{uid} evicted")));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn pod(status: Value) -> Pod {
        serde_json::from_value(json!({
            "metadata": {"name": "a-w1", "uid": "p", "labels": {build::NUMBER: "1"}},
            "spec": {"containers": [
                {"name": "beside", "resources": {"limits": {"memory": "1Gi"}}},
                {"name": "worker", "resources": {"limits": {"memory": "200Mi"}}},
            ]},
            "status": status,
        }))
        .unwrap()
    }

    #[test]
    fn each_kill_for_lack_of_memory_is_seen_once() {
        let end =
            |reason: &str, id: &str| json!({"terminated": {"exitCode": 137, "reason": reason, "containerID": id}});
        let container = |name: &str, state: Value, last: Value| json!({"name": name, "state": state, "lastState": last, "restartCount": 1, "ready": false, "image": "i", "imageID": "i"});
        let of = |containers: Vec<Value>| kills(&[pod(json!({"phase": "Running", "containerStatuses": containers}))]);
        let killed = |id: &str| Kill { id: format!("p {id}"), number: 1, limit: Some("200Mi".into()) };
        assert_eq!(of(vec![container("worker", json!({"running": {}}), json!({}))]), []);
        assert_eq!(of(vec![container("worker", end("Error", "c1"), json!({}))]), []);
        assert_eq!(of(vec![container("beside", end("OOMKilled", "c1"), json!({}))]), [], "not ours");
        // now, and when it waits for its next start, and when that runs: one and the same
        let waits = json!({"waiting": {"reason": "CrashLoopBackOff"}});
        for (state, last) in [
            (end("OOMKilled", "c1"), json!({})),
            (waits, end("OOMKilled", "c1")),
            (json!({"running": {}}), end("OOMKilled", "c1")),
        ] {
            assert_eq!(of(vec![container("worker", state, last)]), [killed("c1")]);
        }
        let both = of(vec![container("worker", end("OOMKilled", "c2"), end("OOMKilled", "c1"))]);
        assert_eq!(both, [killed("c1"), killed("c2")]);
        let evicted = |why: &str| kills(&[pod(json!({"phase": "Failed", "reason": "Evicted", "message": why}))]);
        assert_eq!(evicted("The node was low on resource: memory. Threshold quantity: 100Mi"), [killed("evicted")]);
        assert_eq!(evicted("The node was low on resource: ephemeral-storage."), []);
    }
}
