//! The pods of a job. Pure: a function of the job, its storage and what lies where.

use std::collections::BTreeMap;
use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use rayherd_api::resource::RenderJobObject;
use rayherd_api::{ByteSize, Placement, RenderJobSpec};
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

/// Work for each slot, rays or camera samples: some seconds' of it.
const WORK: u64 = 1 << 20;

/// How many workers a job is to have: as many as `slots` has numbers, or where it has bounds, as many as what is `to_do` (rays and camera
/// samples) gives work to. `now` is how many it was to have so far: there are more at once, and fewer when half of them would do, so
/// that a wave's end sends nobody away.
pub fn wanted(job: &RenderJobObject, to_do: u64, now: Option<u32>) -> u32 {
    let (workers, slots) = (&job.spec.workers, slots(job));
    let most = slots.len() as u32;
    let Some(least) = workers.min.and_then(|n| u32::try_from(n).ok()).filter(|_| workers.max.is_some()) else {
        return most;
    };
    let each = u64::from(slots.first().copied().unwrap_or(1).max(1)) * WORK;
    let need = to_do.div_ceil(each).min(u64::from(most)) as u32;
    let now = now.unwrap_or(least);
    let next = if need > now || need * 2 <= now { need } else { now };
    next.clamp(least.min(most), most)
}

/// Scene data that a worker holds, bytes.
pub fn memory(job: &RenderJobObject) -> u64 {
    job.spec.workers.memory.map_or(DEFAULT_MEMORY, ByteSize::bytes)
}

/// How long the workers of a job that came to its end are kept, if at all.
pub fn keep_warm(job: &RenderJobObject) -> Option<Duration> {
    let seconds = job.spec.workers.keep_warm_seconds.and_then(|s| u64::try_from(s).ok())?;
    (seconds > 0).then(|| Duration::from_secs(seconds))
}

/// Whether the workers of one spec can go on with another: pods of the same numbers would be made alike.
pub fn same_workers(old: &RenderJobSpec, new: &RenderJobSpec) -> bool {
    let slots = |s: &RenderJobSpec| s.workers.slots_per_node(1).unwrap_or_else(|| vec![1]);
    let (a, b) = (&old.workers, &new.workers);
    slots(old).iter().zip(slots(new)).all(|(x, y)| *x == y)
        && (a.memory, &a.template, &old.storage, old.placement) == (b.memory, &b.template, &new.storage, new.placement)
}

/// The pod of a worker, as JSON. `held` are the scene's bytes by node, `trusted` the certificates that the operator is known by.
///
/// What the job's template says comes on top of ours, but for what makes the pod a worker: its name, its owner, its labels, its token
/// and its settings.
///
/// # Errors
/// When the pod cannot be written down.
pub fn pod(
    job: &RenderJobObject,
    config: &Config,
    storage: &Storage,
    held: &BTreeMap<String, u64>,
    trusted: &str,
    number: u32,
    name: &str,
) -> Result<Value, serde_json::Error> {
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
    let mut pod = json!({
        "spec": {
            "enableServiceLinks": false,
            "terminationGracePeriodSeconds": GRACE_SECONDS,
            "affinity": affinity(&uid, held, job.spec.placement),
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
                "resources": {"requests": resources, "limits": resources},
                "securityContext": {
                    "allowPrivilegeEscalation": false,
                    "readOnlyRootFilesystem": true,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": [{"name": "scratch", "mountPath": "/scratch"}],
            }],
            "volumes": [{"name": "scratch", "emptyDir": {}}],
        },
    });
    // of a template metadata and spec count; kind and version may be written
    for part in ["metadata", "spec"] {
        if let Some(wanted) = job.spec.workers.template.as_ref().and_then(|t| t.get(part)) {
            merge(&mut pod[part], wanted);
        }
    }
    let ours = json!({
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
        },
        "spec": {
            "automountServiceAccountToken": false,
            "restartPolicy": "OnFailure",
            "containers": [{
                "name": "worker",
                "env": env,
                "envFrom": [{"secretRef": {"name": secret_name(&job.spec.storage)}}],
                "volumeMounts": [{"name": "token", "mountPath": "/var/run/secrets/rayherd", "readOnly": true}],
            }],
            "volumes": [{"name": "token", "projected": {"sources": [
                {"serviceAccountToken": {"audience": AUDIENCE, "expirationSeconds": 3600, "path": "token"}},
            ]}}],
        },
    });
    merge(&mut pod, &ours);
    pod["metadata"]["ownerReferences"] = json!([{
        "apiVersion": rayherd_api::API_VERSION,
        "kind": rayherd_api::KIND,
        "name": job.metadata.name,
        "uid": uid,
        "controller": true,
        "blockOwnerDeletion": true,
    }]);
    Ok(pod)
}

/// Puts one object on top of another. Lists are joined: an item of a name (or mount path) that is there is merged into that one, others
/// are added. Lists of plain values (a command) are replaced.
fn merge(base: &mut Value, top: &Value) {
    match (base, top) {
        (Value::Object(base), Value::Object(top)) => {
            for (name, value) in top {
                match base.get_mut(name) {
                    Some(known) => merge(known, value),
                    None => drop(base.insert(name.clone(), value.clone())),
                }
            }
        }
        (Value::Array(base), Value::Array(top)) if top.iter().all(Value::is_object) => {
            // mounts of one volume differ in their paths
            let key =
                |v: &Value| ["mountPath", "name"].iter().find_map(|k| v.get(k)?.as_str().map(|s| (*k, s.to_owned())));
            for item in top {
                let known = base.iter_mut().find(|b| key(item).is_some() && key(b) == key(item));
                match known {
                    Some(known) => merge(known, item),
                    None => base.push(item.clone()),
                }
            }
        }
        (base, top) => *base = top.clone(),
    }
}

/// Nodes are preferred by the bytes that they hold, and one worker to a node before two.
fn affinity(uid: &str, held: &BTreeMap<String, u64>, placement: Placement) -> Value {
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
    if placement == Placement::None || terms.is_empty() {
        return affinity;
    }
    affinity["nodeAffinity"] = json!({"preferredDuringSchedulingIgnoredDuringExecution": terms});
    if placement == Placement::Required {
        let nodes: Vec<&String> = held.iter().filter(|(_, bytes)| **bytes > 0).map(|(node, _)| node).collect();
        let expression = json!({"key": "kubernetes.io/hostname", "operator": "In", "values": nodes});
        affinity["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"] =
            json!({"nodeSelectorTerms": [{"matchExpressions": [expression]}]});
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
        let pod: Pod =
            serde_json::from_value(pod(&job(), &config(), &storage, &held, "PEM", 1, "box-w1").unwrap()).unwrap();
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
    fn a_template_comes_on_top_but_a_worker_stays_one() {
        let storage = Storage { bucket: "b".into(), prefix: String::new(), region: "r".into(), endpoints: vec![] };
        let held = BTreeMap::from([("node1".to_owned(), 1000)]);
        let made = |job: &RenderJobObject| pod(job, &config(), &storage, &held, "PEM", 1, "box-w1").unwrap();
        let mut with = job();
        with.spec.workers.template = Some(json!({
            "metadata": {"name": "mine", "labels": {"team": "a", LABEL: "other"}, "ownerReferences": [{"name": "x"}]},
            "spec": {
                "restartPolicy": "Never",
                "automountServiceAccountToken": true,
                "priorityClassName": "night",
                "tolerations": [{"key": "spot", "operator": "Exists"}],
                "volumes": [{"name": "fast", "emptyDir": {"medium": "Memory"}}],
                "affinity": {"nodeAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [
                    {"weight": 5, "preference": {"matchExpressions": [{"key": "disk", "operator": "Exists"}]}},
                ]}},
                "containers": [
                    {
                        "name": "worker",
                        "resources": {"limits": {"memory": "8Gi"}},
                        "env": [{"name": "RUST_LOG", "value": "debug"}, {"name": "RAYHERD_JOB", "value": "other"}],
                        "volumeMounts": [{"name": "fast", "mountPath": "/fast"}, {"name": "fast", "mountPath": "/scratch"}],
                    },
                    {"name": "beside", "image": "b:1"},
                ],
            },
        }));
        let both = made(&with);
        let at = |path: &str| both.pointer(path).cloned().unwrap_or_default();
        assert_eq!((at("/metadata/name"), at("/metadata/labels/team")), (json!("box-w1"), json!("a")));
        assert_eq!(both["metadata"]["labels"][LABEL], json!("u-1"));
        assert_eq!(at("/metadata/ownerReferences").as_array().map(Vec::len), Some(1));
        assert_eq!(at("/metadata/ownerReferences/0/uid"), json!("u-1"));
        assert_eq!(
            (at("/spec/restartPolicy"), at("/spec/automountServiceAccountToken")),
            (json!("OnFailure"), json!(false))
        );
        assert_eq!(at("/spec/priorityClassName"), json!("night"));
        let terms = at("/spec/affinity/nodeAffinity/preferredDuringSchedulingIgnoredDuringExecution");
        assert_eq!(terms.as_array().map(Vec::len), Some(2), "ours and theirs");
        let worker = at("/spec/containers/0");
        assert_eq!(at("/spec/containers/1/name"), json!("beside"));
        assert_eq!(worker["resources"]["limits"]["memory"], json!("8Gi"));
        let env = |name: &str| {
            let all = worker["env"].as_array().unwrap().iter().filter(|e| e["name"] == name);
            all.map(|e| e["value"].clone()).collect::<Vec<_>>()
        };
        assert_eq!((env("RUST_LOG"), env("RAYHERD_JOB")), (vec![json!("debug")], vec![json!("u-1")]));
        let mounts: Vec<(String, String)> = (worker["volumeMounts"].as_array().unwrap().iter())
            .map(|m| (m["mountPath"].as_str().unwrap().into(), m["name"].as_str().unwrap().into()))
            .collect();
        let of = |path: &str| mounts.iter().filter(|m| m.0 == path).map(|m| m.1.as_str()).collect::<Vec<_>>();
        assert_eq!((of("/scratch"), of("/fast")), (vec!["fast"], vec!["fast"]));
        assert_eq!(of("/var/run/secrets/rayherd"), ["token"]);
        serde_json::from_value::<Pod>(both).unwrap();
        // where it may run
        with.spec.placement = Placement::Required;
        let path = "/spec/affinity/nodeAffinity/requiredDuringSchedulingIgnoredDuringExecution/nodeSelectorTerms/0/matchExpressions/0/values";
        assert_eq!(made(&with).pointer(path), Some(&json!(["node1"])));
        let mut without = job();
        without.spec.placement = Placement::None;
        assert_eq!(made(&without).pointer("/spec/affinity/nodeAffinity"), None);
    }

    #[test]
    fn workers_follow_the_work_but_not_each_wave() {
        let mut job = job();
        assert_eq!((wanted(&job, 0, None), wanted(&job, u64::MAX, Some(1))), (3, 3), "as many as it asks for");
        let workers = &mut job.spec.workers;
        (workers.nodes, workers.min, workers.max, workers.slots) = (None, Some(2), Some(20), vec![4]);
        let each = 4 * WORK;
        assert_eq!(slots(&job).len(), 20);
        assert_eq!((wanted(&job, 0, None), wanted(&job, u64::MAX, Some(2))), (2, 20));
        assert_eq!((wanted(&job, 5 * each, Some(2)), wanted(&job, 5 * each + 1, Some(2))), (5, 6), "more at once");
        // less to do: all stay, until half of them would do
        assert_eq!((wanted(&job, 7 * each, Some(12)), wanted(&job, 6 * each, Some(12))), (12, 6));
        assert_eq!(wanted(&job, 0, Some(12)), 2);
        // one that goes up and down by less than a half keeps its workers
        let mut now = 10;
        for to_do in [10, 6, 9, 7, 10, 6] {
            now = wanted(&job, to_do * each, Some(now));
            assert_eq!(now, 10);
        }
        // bounds that were changed hold at once
        job.spec.workers.max = Some(3);
        assert_eq!(wanted(&job, 0, Some(20)), 2);
        assert_eq!(wanted(&job, u64::MAX, Some(20)), 3);
    }

    #[test]
    fn workers_stay_when_what_they_are_made_of_does() {
        let old = job().spec;
        let mut new = old.clone();
        new.sampling.spp = Some(64);
        new.workers.nodes = Some(5);
        assert!(same_workers(&old, &new));
        new.workers.template = Some(json!({}));
        assert!(!same_workers(&old, &new));
        let mut new = old.clone();
        new.workers.slots = vec![3];
        assert!(!same_workers(&old, &new));
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
