//! The pods of a job. Pure: a function of the job, its storage and what lies where.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::Pod;
use rayherd_api::ByteSize;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::remote::Storage;
use serde_json::{Value, json};

use crate::config::Config;
use crate::storage::secret_name;

/// Marks a job's pods; its value is the job's uid.
pub const LABEL: &str = "rayherd.io/job";
/// The number of a worker in its job.
pub const NUMBER: &str = "rayherd.io/worker";
/// Whom the workers' tokens are for.
pub const AUDIENCE: &str = "rayherd";
/// Scene data that a worker holds when the job says nothing.
const DEFAULT_MEMORY: u64 = 1 << 30;
/// Memory beside the scene's: the process, and per slot its rays, groups and film.
const PROCESS_BYTES: u64 = 256 << 20;
const SLOT_BYTES: u64 = 256 << 20;
/// Longer than a batch of rays and a report take.
const GRACE_SECONDS: u32 = 30;

/// Slots of each worker. A job that was checked has them.
pub fn slots(job: &RenderJobObject) -> Vec<u32> {
    job.spec.workers.slots_per_node(1).unwrap_or_else(|| vec![1])
}

/// Scene data that a worker holds, bytes.
pub fn memory(job: &RenderJobObject) -> u64 {
    job.spec.workers.memory.map_or(DEFAULT_MEMORY, ByteSize::bytes)
}

/// The pod of a worker. `held` are the scene's bytes by node, `trusted` the certificates that the operator is known by.
///
/// # Errors
/// When the job has no name or uid, which the API server excludes, or the pod cannot be written down.
pub fn pod(
    job: &RenderJobObject,
    config: &Config,
    storage: &Storage,
    held: &BTreeMap<String, u64>,
    trusted: &str,
    number: u32,
    name: &str,
) -> Result<Pod, serde_json::Error> {
    let slots = slots(job).get(number as usize).copied().unwrap_or(1);
    let memory = memory(job) + PROCESS_BYTES + u64::from(slots) * SLOT_BYTES;
    let resources = json!({"cpu": slots.to_string(), "memory": memory.to_string()});
    let uid = job.metadata.uid.clone().unwrap_or_default();
    let value = |name: &str, value: &str| json!({"name": name, "value": value});
    let field = |name: &str, path: &str| json!({"name": name, "valueFrom": {"fieldRef": {"fieldPath": path}}});
    let env = vec![
        value("RAYHERD_OPERATOR", &config.url),
        value("RAYHERD_CA", trusted),
        value("RAYHERD_JOB", &uid),
        value("RAYHERD_WORKER", &number.to_string()),
        value("RAYHERD_SLOTS", &slots.to_string()),
        value("RAYHERD_STORAGE", &serde_json::to_string(storage)?),
        value("RAYHERD_SCRATCH", "/scratch"),
        value("RAYHERD_TOKEN_FILE", "/var/run/secrets/rayherd/token"),
        value("TMPDIR", "/scratch"),
        field("RAYHERD_POD", "metadata.name"),
        field("RAYHERD_NODE", "spec.nodeName"),
    ];
    serde_json::from_value(json!({
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            "name": name,
            "namespace": job.metadata.namespace,
            "labels": {
                LABEL: uid,
                NUMBER: number.to_string(),
                "app.kubernetes.io/name": "rayherd-worker",
                "app.kubernetes.io/managed-by": "rayherd-operator",
            },
            "ownerReferences": [{
                "apiVersion": rayherd_api::API_VERSION,
                "kind": rayherd_api::KIND,
                "name": job.metadata.name,
                "uid": uid,
                "controller": true,
                "blockOwnerDeletion": true,
            }],
        },
        "spec": {
            "automountServiceAccountToken": false,
            "enableServiceLinks": false,
            "restartPolicy": "OnFailure",
            "terminationGracePeriodSeconds": GRACE_SECONDS,
            "affinity": affinity(&uid, held),
            "securityContext": {
                "runAsNonRoot": true,
                "runAsUser": 65532,
                "runAsGroup": 65532,
                "fsGroup": 65532,
                "seccompProfile": {"type": "RuntimeDefault"},
            },
            "containers": [{
                "name": "worker",
                "image": config.image,
                "env": env,
                "envFrom": [{"secretRef": {"name": secret_name(&job.spec.storage)}}],
                "resources": {"requests": resources, "limits": resources},
                "securityContext": {
                    "allowPrivilegeEscalation": false,
                    "readOnlyRootFilesystem": true,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": [
                    {"name": "scratch", "mountPath": "/scratch"},
                    {"name": "token", "mountPath": "/var/run/secrets/rayherd", "readOnly": true},
                ],
            }],
            "volumes": [
                {"name": "scratch", "emptyDir": {}},
                {"name": "token", "projected": {"sources": [
                    {"serviceAccountToken": {"audience": AUDIENCE, "expirationSeconds": 3600, "path": "token"}},
                ]}},
            ],
        },
    }))
}

/// Nodes are preferred by the bytes that they hold, and one worker to a node before two.
fn affinity(uid: &str, held: &BTreeMap<String, u64>) -> Value {
    let most = held.values().copied().max().unwrap_or(0);
    let weight = |bytes: u64| (u128::from(bytes) * 100).div_ceil(u128::from(most.max(1))).clamp(1, 100) as u64;
    let terms: Vec<Value> = held
        .iter()
        .filter(|(_, bytes)| **bytes > 0)
        .map(|(node, &bytes)| {
            let expression = json!({"key": "kubernetes.io/hostname", "operator": "In", "values": [node]});
            json!({"weight": weight(bytes), "preference": {"matchExpressions": [expression]}})
        })
        .collect();
    let mut affinity = json!({"podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [{
        "weight": 100,
        "podAffinityTerm": {
            "topologyKey": "kubernetes.io/hostname",
            "labelSelector": {"matchLabels": {LABEL: uid}},
        },
    }]}});
    if !terms.is_empty() {
        affinity["nodeAffinity"] = json!({"preferredDuringSchedulingIgnoredDuringExecution": terms});
    }
    affinity
}

/// What to do about the pods of a job.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// Workers to make pods for, with the pods' names.
    pub make: Vec<(u32, String)>,
    /// Pods to delete.
    pub delete: Vec<String>,
}

/// Compares the pods that there are with those that there should be: one that lives for each of the workers `0..wanted`.
///
/// A pod that is being deleted is no worker any more; on a node that is gone it may stay for long, so the next one has
/// another name.
pub fn plan(job: &str, pods: &[Pod], wanted: u32) -> Plan {
    let mut plan = Plan::default();
    let mut living = vec![false; wanted as usize];
    for pod in pods {
        let name = pod.metadata.name.clone().unwrap_or_default();
        let phase = pod.status.as_ref().and_then(|s| s.phase.as_deref()).unwrap_or("Pending");
        let number = number(pod);
        if pod.metadata.deletion_timestamp.is_some() {
            continue;
        }
        match number.and_then(|n| living.get_mut(n as usize)) {
            Some(alive) if !*alive && !matches!(phase, "Failed" | "Succeeded") => *alive = true,
            _ => plan.delete.push(name),
        }
    }
    let taken = |name: &str| pods.iter().any(|p| p.metadata.name.as_deref() == Some(name));
    for number in (0..wanted).filter(|&n| !living[n as usize]) {
        let first = format!("{job}-w{number}");
        let mut others = (1..).map(|k| format!("{job}-w{number}-{k}"));
        let name = if taken(&first) { others.find(|n| !taken(n)).unwrap_or(first) } else { first };
        plan.make.push((number, name));
    }
    plan
}

/// The number of a pod's worker.
pub fn number(pod: &Pod) -> Option<u32> {
    pod.metadata.labels.as_ref()?.get(NUMBER)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use rayherd_herd::remote::Endpoint;

    use super::*;

    pub fn job() -> RenderJobObject {
        serde_json::from_value(json!({
            "apiVersion": "rayherd.io/v1alpha1",
            "kind": "RenderJob",
            "metadata": {"name": "box", "namespace": "studio", "uid": "u-1", "generation": 1},
            "spec": {"scene": {"source": "scenes/box/box.xml"}, "workers": {"nodes": 3, "slots": [2], "memory": "512Mi"}},
        }))
        .unwrap()
    }

    fn config() -> Config {
        Config {
            namespace: "rayherd".into(),
            pod: "operator-1".into(),
            lease: "lease".into(),
            authority: "authority".into(),
            url: "https://operator".into(),
            image: "worker:1".into(),
            listen: "127.0.0.1:0".parse().unwrap(),
            metrics: "127.0.0.1:0".parse().unwrap(),
            watch: None,
        }
    }

    #[test]
    fn a_pod_is_restricted_and_drawn_to_its_data() {
        let storage = Storage {
            bucket: "herd".into(),
            prefix: String::new(),
            region: "r".into(),
            endpoints: vec![Endpoint { url: "http://m".into(), node: Some("node1".into()) }],
        };
        let held = BTreeMap::from([("node1".to_owned(), 1000), ("node2".to_owned(), 1), ("node3".to_owned(), 0)]);
        let pod = pod(&job(), &config(), &storage, &held, "PEM", 1, "box-w1").unwrap();
        let spec = pod.spec.unwrap();
        assert_eq!(spec.automount_service_account_token, Some(false));
        let container = &spec.containers[0];
        let security = container.security_context.as_ref().unwrap();
        assert_eq!(
            (security.allow_privilege_escalation, security.read_only_root_filesystem),
            (Some(false), Some(true))
        );
        let resources = container.resources.as_ref().unwrap();
        assert_eq!(resources.requests, resources.limits);
        assert_eq!(resources.limits.as_ref().unwrap()["memory"].0, ((512u64 + 256 + 512) << 20).to_string());
        let affinity = spec.affinity.unwrap();
        let terms = affinity.node_affinity.unwrap().preferred_during_scheduling_ignored_during_execution.unwrap();
        assert_eq!(terms.iter().map(|t| t.weight).collect::<Vec<_>>(), [100, 1]);
        let owner = &pod.metadata.owner_references.unwrap()[0];
        assert_eq!((owner.uid.as_str(), owner.controller), ("u-1", Some(true)));
    }

    #[test]
    fn each_worker_has_one_living_pod() {
        let pod = |name: &str, number: &str, phase: &str, going: bool| -> Pod {
            let mut pod = json!({"metadata": {"name": name, "labels": {NUMBER: number}}, "status": {"phase": phase}});
            if going {
                pod["metadata"]["deletionTimestamp"] = json!("2026-01-01T00:00:00Z");
            }
            serde_json::from_value(pod).unwrap()
        };
        let names = |plan: &Plan| plan.make.iter().map(|(_, n)| n.clone()).collect::<Vec<_>>();
        assert_eq!(names(&plan("a", &[], 2)), ["a-w0", "a-w1"]);
        let there = [pod("a-w0", "0", "Running", false), pod("a-w1", "1", "Pending", false)];
        assert_eq!(plan("a", &there, 2), Plan::default());
        assert_eq!(plan("a", &there, 1).delete, ["a-w1"]);
        let mixed = [
            pod("a-w0", "0", "Running", true),
            pod("a-w0-1", "0", "Running", true),
            pod("a-w1", "1", "Failed", false),
            pod("a-wx", "x", "Running", false),
        ];
        let planned = plan("a", &mixed, 2);
        assert_eq!(planned.delete, ["a-w1", "a-wx"]);
        assert_eq!(names(&planned), ["a-w0-2", "a-w1-1"]);
    }
}
