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
/// The container of a pod that is a worker.
pub const CONTAINER: &str = "worker";
/// Bytes of the scene that a worker would find on another node, for which it is moved there: what it reads, maybe more than once, while
/// another pod starts.
const MOVED_FOR: u64 = 8 << 20;
/// Whether it was known where the scene lies when a pod was made.
const PLACED: &str = "rayherd.io/placed";
/// Whom the workers' tokens are for.
pub const AUDIENCE: &str = "rayherd";
/// Scene data that a worker holds when the job says nothing.
const DEFAULT_MEMORY: u64 = 1 << 30;
/// Memory beside the scene's: the process, and per slot its rays, groups and film.
const PROCESS_BYTES: u64 = 256 << 20;
const SLOT_BYTES: u64 = 256 << 20;
/// Where workers have their caches, and what a folder takes beside the files in it.
const CACHE: &str = "/cache";
const FOLDER_BYTES: u64 = 64 << 20;
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

/// Where lies what a job works on: bytes by node.
#[derive(Clone, Debug, Default)]
pub struct Lies {
    /// Its scene's blocks, once that is known.
    pub scene: BTreeMap<String, u64>,
    /// Its source, which somebody is to read before.
    pub source: BTreeMap<String, u64>,
}

impl Lies {
    /// What a worker that comes now is to be beside.
    fn nearest(&self) -> &BTreeMap<String, u64> {
        if self.scene.is_empty() { &self.source } else { &self.scene }
    }
}

/// The pod of a worker, as JSON. `trusted` are the certificates that the operator is known by.
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
    lies: &Lies,
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
    let mut env = vec![
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
    let (mut requests, mut mounts, mut volumes) = (
        resources.clone(),
        vec![json!({"name": "scratch", "mountPath": "/scratch"})],
        vec![json!({"name": "scratch", "emptyDir": {}})],
    );
    if storage.cache > 0 {
        let size = storage.cache.saturating_add(FOLDER_BYTES).to_string();
        env.push(value("RAYHERD_CACHE", CACHE));
        mounts.push(json!({"name": "cache", "mountPath": CACHE}));
        volumes.push(json!({"name": "cache", "emptyDir": {"sizeLimit": size}}));
        // no limit: that would be one of the scratch folder too
        requests["ephemeral-storage"] = json!(size);
    }
    let mut pod = json!({
        "spec": {
            "enableServiceLinks": false,
            "serviceAccountName": storage.service_account,
            "terminationGracePeriodSeconds": GRACE_SECONDS,
            "affinity": affinity(&uid, lies.nearest(), job.spec.placement),
            "securityContext": {
                "runAsNonRoot": true,
                "runAsUser": 65532,
                "runAsGroup": 65532,
                "fsGroup": 65532,
                "seccompProfile": {"type": "RuntimeDefault"},
            },
            "containers": [{
                "name": CONTAINER,
                "image": config.image,
                "resources": {"requests": requests, "limits": resources},
                "securityContext": {
                    "allowPrivilegeEscalation": false,
                    "readOnlyRootFilesystem": true,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": mounts,
            }],
            "volumes": volumes,
        },
    });
    if storage.service_account.is_none() {
        drop(pod["spec"].as_object_mut().and_then(|spec| spec.remove("serviceAccountName")));
    }
    // of a template metadata and spec count; kind and version may be written
    for part in ["metadata", "spec"] {
        if let Some(wanted) = job.spec.workers.template.as_ref().and_then(|t| t.get(part)) {
            merge(&mut pod[part], wanted);
        }
    }
    let keys = match storage.identity {
        true => json!([]),
        false => json!([{"secretRef": {"name": secret_name(&job.spec.storage)}}]),
    };
    if job.spec.placement == Placement::Required {
        bind(&mut pod, &holders(&lies.scene));
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
                PLACED: (!lies.scene.is_empty()).to_string(),
                "app.kubernetes.io/name": "rayherd-worker",
                "app.kubernetes.io/managed-by": "rayherd-operator",
            },
        },
        "spec": {
            "automountServiceAccountToken": false,
            "restartPolicy": "OnFailure",
            "containers": [{
                "name": CONTAINER,
                "env": env,
                "envFrom": keys,
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
/// are added; a volume or a variable takes the place of that of its name, as half of each is neither. Lists of plain values (a command)
/// are replaced. What is null is not given.
fn merge(base: &mut Value, top: &Value) {
    match (base, top) {
        (_, Value::Null) => {}
        (Value::Object(base), Value::Object(top)) => {
            for (name, value) in top {
                match base.get_mut(name) {
                    Some(Value::Array(known)) if matches!(name.as_str(), "volumes" | "env") && value.is_array() => {
                        let items = value.as_array().into_iter().flatten();
                        for item in items {
                            known.retain(|k| k.get("name").is_none() || k.get("name") != item.get("name"));
                            known.push(item.clone());
                        }
                    }
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

/// Nodes are preferred by the bytes that they hold of what is worked on, and one worker to a node before two.
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
    affinity
}

/// Nodes that hold some of the scene.
fn holders(held: &BTreeMap<String, u64>) -> Vec<&String> {
    held.iter().filter(|(_, bytes)| **bytes > 0).map(|(node, _)| node).collect()
}

/// Binds a pod to nodes, whatever else its template requires: of a template's terms one must hold, so each gets ours beside its own.
fn bind(pod: &mut Value, nodes: &[&String]) {
    // there is one where data lies; what a template puts there that is no object the API server refuses
    let Some(Value::Object(affinity)) = pod.pointer_mut("/spec/affinity/nodeAffinity") else { return };
    if nodes.is_empty() {
        return;
    }
    let ours = json!({"key": "kubernetes.io/hostname", "operator": "In", "values": nodes});
    let required = affinity.entry("requiredDuringSchedulingIgnoredDuringExecution").or_insert_with(|| json!({}));
    let Value::Object(required) = required else { return };
    let terms = required.entry("nodeSelectorTerms").or_insert_with(|| json!([]));
    match terms {
        Value::Array(terms) if !terms.is_empty() => {
            let of_term =
                |term: &Value, key: &str| term.get(key).and_then(Value::as_array).is_some_and(|l| !l.is_empty());
            // an empty term holds nowhere, and must not begin to
            for term in terms.iter_mut().filter(|t| of_term(t, "matchExpressions") || of_term(t, "matchFields")) {
                let Value::Object(term) = term else { continue };
                if let Value::Array(all) = term.entry("matchExpressions").or_insert_with(|| json!([])) {
                    all.push(ours.clone());
                }
            }
        }
        Value::Array(terms) => terms.push(json!({"matchExpressions": [ours]})),
        _ => {}
    }
}

/// Whether a pod that was made before it was known where the scene lies is better made anew: `Required` allows no other nodes than those
/// that hold some of it, and a worker is to be on one of the nodes that hold most, where the others hold much less.
fn is_misplaced(pod: &Pod, held: &BTreeMap<String, u64>, placement: Placement, wanted: u32) -> bool {
    let label = pod.metadata.labels.as_ref().and_then(|l| l.get(PLACED));
    if label.is_none_or(|l| l != "false") || holders(held).is_empty() {
        return false;
    }
    let node = pod.spec.as_ref().and_then(|s| s.node_name.as_ref());
    let here = node.and_then(|n| held.get(n)).copied().unwrap_or(0);
    match placement {
        Placement::None => false,
        Placement::Required => here == 0,
        // what moving a worker takes is worth many small reads
        Placement::Preferred => {
            let mut most: Vec<u64> = held.values().copied().collect();
            most.sort_unstable_by(|a, b| b.cmp(a));
            let good = most.get((wanted as usize).clamp(1, most.len()) - 1).copied().unwrap_or(0);
            good.saturating_sub(here) >= MOVED_FOR
        }
    }
}

/// What to do about the pods of a job.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// Workers to make pods for, with the pods' names.
    pub make: Vec<(u32, String)>,
    /// Pods to delete.
    pub delete: Vec<String>,
}

/// Compares the pods that there are with those that there should be: one that lives for each of the workers `0..wanted`, where the scene's
/// bytes lie on nodes as in `held` (nowhere as long as that is not known).
///
/// A pod that is being deleted is no worker any more; on a node that is gone it may stay for long, so the next one has
/// another name.
pub fn plan(job: &str, pods: &[Pod], wanted: u32, (held, placement): (&BTreeMap<String, u64>, Placement)) -> Plan {
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
            Some(alive)
                if !*alive
                    && !matches!(phase, "Failed" | "Succeeded")
                    && !is_misplaced(pod, held, placement, wanted) =>
            {
                *alive = true;
            }
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

/// Pods of workers that cannot do what their job asks for, if others would be made of another image: they make room for these.
pub fn outdated<'p>(pods: &'p [Pod], unfit: &[u32], made: &Value) -> Vec<&'p str> {
    let containers = made.pointer("/spec/containers").and_then(Value::as_array);
    let worker = containers.and_then(|c| c.iter().find(|c| c["name"] == "worker"));
    let image = worker.and_then(|c| c["image"].as_str());
    let is_other = |pod: &&Pod| {
        let containers = pod.spec.iter().flat_map(|s| &s.containers);
        containers.filter(|c| c.name == "worker").any(|c| c.image.is_some() && c.image.as_deref() != image)
    };
    let living = pods.iter().filter(|p| p.metadata.deletion_timestamp.is_none());
    let unfit = living.filter(|p| number(p).is_some_and(|n| unfit.contains(&n)));
    unfit.filter(is_other).filter_map(|p| p.metadata.name.as_deref()).collect()
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
            scene_days: 30,
        }
    }

    #[test]
    fn a_pod_is_restricted_and_drawn_to_its_data() {
        let storage = Storage {
            bucket: "herd".into(),
            prefix: String::new(),
            region: "r".into(),
            endpoints: vec![Endpoint { url: "http://m".into(), node: Some("node1".into()) }],
            ..Storage::default()
        };
        let held = BTreeMap::from([("node1".to_owned(), 1000), ("node2".to_owned(), 1), ("node3".to_owned(), 0)]);
        let lies = Lies { scene: held, source: BTreeMap::from([("node9".to_owned(), 5000)]) };
        let pod: Pod =
            serde_json::from_value(pod(&job(), &config(), &storage, &lies, "PEM", 1, "box-w1").unwrap()).unwrap();
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
        // and away from the job's other workers
        let apart = affinity.pod_anti_affinity.unwrap().preferred_during_scheduling_ignored_during_execution.unwrap();
        let [other] = &apart[..] else { panic!("{apart:?}") };
        let selector = other.pod_affinity_term.label_selector.as_ref().unwrap();
        assert_eq!((other.weight, other.pod_affinity_term.topology_key.as_str()), (100, "kubernetes.io/hostname"));
        assert_eq!(selector.match_labels, Some([(LABEL.to_owned(), "u-1".to_owned())].into()));
        let owner = &pod.metadata.owner_references.unwrap()[0];
        assert_eq!((owner.uid.as_str(), owner.controller), ("u-1", Some(true)));
    }

    #[test]
    fn who_prepares_is_drawn_to_the_source_and_bound_to_nothing() {
        let storage = Storage { bucket: "b".into(), region: "r".into(), ..Storage::default() };
        let source = [("node1".to_owned(), 0), ("node2".to_owned(), 70)].into();
        let lies = Lies { source, ..Lies::default() };
        let nodes = "/spec/affinity/nodeAffinity/preferredDuringSchedulingIgnoredDuringExecution";
        let value = "/0/preference/matchExpressions/0/values";
        for placement in [Placement::Preferred, Placement::Required, Placement::None] {
            let mut job = job();
            job.spec.placement = placement;
            let made = pod(&job, &config(), &storage, &lies, "PEM", 0, "box-w0").unwrap();
            let found = made.pointer(&format!("{nodes}{value}"));
            assert_eq!(found, (placement != Placement::None).then(|| json!(["node2"])).as_ref(), "{placement:?}");
            assert!(made.pointer(&format!("{nodes}/1")).is_none());
            // more than one of them are spread, wherever they may be
            assert!(made.pointer("/spec/affinity/podAntiAffinity").is_some(), "{placement:?}");
            assert!(!made.to_string().contains("nodeSelectorTerms"), "where its blocks will lie is not known");
            // so it may be made anew there, when that is known
            assert_eq!(made["metadata"]["labels"][PLACED], json!("false"));
        }
    }

    #[test]
    fn a_template_comes_on_top_but_a_worker_stays_one() {
        let storage = Storage { bucket: "b".into(), region: "r".into(), ..Storage::default() };
        let lies = Lies { scene: BTreeMap::from([("node1".to_owned(), 1000)]), ..Lies::default() };
        let made = |job: &RenderJobObject| pod(job, &config(), &storage, &lies, "PEM", 1, "box-w1").unwrap();
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
        // each of the terms of which one must hold, but for one that holds nowhere
        let affinity = &mut with.spec.workers.template.as_mut().unwrap()["spec"]["affinity"]["nodeAffinity"];
        affinity["requiredDuringSchedulingIgnoredDuringExecution"] = json!({"nodeSelectorTerms": [
            {"matchExpressions": [{"key": "disk", "operator": "Exists"}]},
            {"matchFields": [{"key": "metadata.name", "operator": "In", "values": ["node7"]}]},
            {},
        ]});
        let terms = path.strip_suffix("/0/matchExpressions/0/values").unwrap();
        let ours = json!({"key": "kubernetes.io/hostname", "operator": "In", "values": ["node1"]});
        let both = made(&with);
        let at = |rest: &str| both.pointer(&format!("{terms}{rest}"));
        assert_eq!((at("/0/matchExpressions/1"), at("/1/matchExpressions/0")), (Some(&ours), Some(&ours)));
        assert_eq!((at("/0/matchExpressions/0/key"), at("/2")), (Some(&json!("disk")), Some(&json!({}))));
        // what is null is not given, and what is no object is left to the API server
        for (wanted, bound) in [(json!(null), Some(json!(["node1"]))), (json!("x"), None)] {
            with.spec.workers.template = Some(json!({"spec": {"affinity": wanted}}));
            assert_eq!(made(&with).pointer(path).cloned(), bound);
        }
        let mut without = job();
        without.spec.placement = Placement::None;
        assert_eq!(made(&without).pointer("/spec/affinity/nodeAffinity"), None);
    }

    #[test]
    fn a_worker_with_an_identity_has_an_account_and_no_keys() {
        let made = |storage: &Storage| {
            let pod = pod(&job(), &config(), storage, &Lies::default(), "PEM", 0, "box-w0").unwrap();
            let spec = serde_json::from_value::<Pod>(pod).unwrap().spec.unwrap();
            (spec.service_account_name, spec.containers[0].env_from.clone().unwrap_or_default().len())
        };
        assert_eq!(made(&Storage::default()), (None, 1));
        let account = Some("renderer".to_owned());
        let known = Storage { identity: true, service_account: account.clone(), ..Storage::default() };
        assert_eq!(made(&known), (account, 0));
    }

    #[test]
    fn a_volume_or_a_variable_of_a_template_takes_the_place_of_ours_and_ours_of_what_makes_a_worker() {
        let storage = Storage { bucket: "b".into(), region: "r".into(), ..Storage::default() };
        let mut with = job();
        with.spec.workers.template = Some(json!({"spec": {
            "volumes": [{"name": "scratch", "hostPath": {"path": "/fast"}}, {"name": "token", "emptyDir": {}}],
            "containers": [{"name": "worker", "env": [
                {"name": "RAYHERD_JOB", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}},
                {"name": "MINE", "value": "1"},
            ]}],
        }}));
        let made = pod(&with, &config(), &storage, &Lies::default(), "PEM", 0, "box-w0").unwrap();
        let of = |list: &str, name: &str| {
            let all = made.pointer(list).unwrap().as_array().unwrap().iter();
            all.filter(|v| v["name"] == name).cloned().collect::<Vec<_>>()
        };
        assert_eq!(of("/spec/volumes", "scratch"), [json!({"name": "scratch", "hostPath": {"path": "/fast"}})]);
        let [token] = &of("/spec/volumes", "token")[..] else { panic!("one token") };
        assert!(token.get("emptyDir").is_none() && token.get("projected").is_some());
        let env = "/spec/containers/0/env";
        assert_eq!(of(env, "RAYHERD_JOB"), [json!({"name": "RAYHERD_JOB", "value": "u-1"})]);
        assert_eq!(of(env, "MINE").len(), 1);
    }

    #[test]
    fn a_worker_that_came_before_the_scene_goes_to_it() {
        let pod = |node: Option<&str>, placed: &str| -> Pod {
            let labels = json!({NUMBER: "0", PLACED: placed});
            let pod =
                json!({"metadata": {"name": "a-w0", "labels": labels}, "spec": {"nodeName": node, "containers": []}});
            serde_json::from_value(pod).unwrap()
        };
        let held: BTreeMap<String, u64> =
            [("a", 50), ("b", 50), ("c", 41), ("d", 0)].map(|(n, b)| (n.into(), b << 20)).into();
        let goes = |pod: Pod, placement, wanted| !plan("a", &[pod], wanted, (&held, placement)).delete.is_empty();
        for (node, placement, wanted, away) in [
            (Some("a"), Placement::Required, 2, false),
            (Some("c"), Placement::Required, 2, false),
            (Some("d"), Placement::Required, 2, true),
            (Some("elsewhere"), Placement::Required, 2, true),
            (None, Placement::Required, 2, true),
            (Some("a"), Placement::Preferred, 2, false),
            (Some("c"), Placement::Preferred, 2, true),
            (Some("c"), Placement::Preferred, 3, false),
            (Some("elsewhere"), Placement::Preferred, 9, false),
            (Some("elsewhere"), Placement::Preferred, 3, true),
            (Some("elsewhere"), Placement::None, 2, false),
            (None, Placement::Preferred, 2, true),
        ] {
            assert_eq!(goes(pod(node, "false"), placement, wanted), away, "{node:?} {placement:?} {wanted}");
            assert!(!goes(pod(node, "true"), placement, wanted), "it was made with all that is known");
        }
        // before that is known nobody goes
        assert_eq!(plan("a", &[pod(None, "false")], 1, (&BTreeMap::new(), Placement::Required)), Plan::default());
    }

    #[test]
    fn a_cache_is_a_volume_of_its_size_beside_a_root_that_stays_read_only() {
        let endpoints = vec![Endpoint { url: "https://s3".into(), node: None }];
        let without = Storage { bucket: "b".into(), region: "r".into(), endpoints, ..Storage::default() };
        let with = Storage { cache: 20 << 30, ..without.clone() };
        let made =
            |job: &RenderJobObject, storage| pod(job, &config(), storage, &Lies::default(), "PEM", 0, "a").unwrap();
        let (plain, cached) = (made(&job(), &without), made(&job(), &with));
        let at = |pod: &Value, path: &str| pod.pointer(path).cloned().unwrap_or_default();
        let env = |pod: &Value, name: &str| {
            let all = at(pod, "/spec/containers/0/env");
            all.as_array().unwrap().iter().find(|e| e["name"] == name).map(|e| e["value"].clone())
        };
        let size = json!(((20u64 << 30) + (64 << 20)).to_string());
        assert_eq!(at(&cached, "/spec/volumes/1"), json!({"name": "cache", "emptyDir": {"sizeLimit": size}}));
        assert_eq!(at(&cached, "/spec/containers/0/volumeMounts/1"), json!({"name": "cache", "mountPath": "/cache"}));
        assert_eq!(env(&cached, "RAYHERD_CACHE"), Some(json!("/cache")));
        let told: Storage = serde_json::from_str(env(&cached, "RAYHERD_STORAGE").unwrap().as_str().unwrap()).unwrap();
        assert_eq!(told.cache, 20 << 30);
        let resources = |pod: &Value, of: &str| at(pod, &format!("/spec/containers/0/resources/{of}"));
        assert_eq!(resources(&cached, "requests")["ephemeral-storage"], size);
        assert_eq!(resources(&cached, "limits"), resources(&plain, "requests"), "as many cores and as much memory");
        assert_eq!(at(&cached, "/spec/containers/0/securityContext/readOnlyRootFilesystem"), json!(true));
        serde_json::from_value::<Pod>(cached).unwrap();
        // nothing of it unless it is asked for
        let text = plain.to_string();
        assert!(!text.contains("/cache") && !text.contains("RAYHERD_CACHE") && !text.contains("ephemeral"), "{text}");
        // another volume in its place, for those who have a fast disk
        let mut own = job();
        own.spec.workers.template = Some(json!({"spec": {
            "volumes": [{"name": "fast", "ephemeral": {}}],
            "containers": [{"name": "worker", "volumeMounts": [{"name": "fast", "mountPath": "/cache"}]}],
        }}));
        assert_eq!(at(&made(&own, &with), "/spec/containers/0/volumeMounts/1/name"), json!("fast"));
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
    fn workers_of_another_image_make_room_when_they_cannot_do_the_job() {
        let there = |name: &str, number: &str, image: &str| -> Pod {
            serde_json::from_value(json!({
                "metadata": {"name": name, "labels": {NUMBER: number}},
                "spec": {"containers": [{"name": "beside", "image": "b:1"}, {"name": "worker", "image": image}]},
            }))
            .unwrap()
        };
        let mut going = there("a-w3", "3", "worker:0");
        going.metadata.deletion_timestamp = serde_json::from_value(json!("2026-01-01T00:00:00Z")).unwrap();
        let pods =
            [there("a-w0", "0", "worker:0"), there("a-w1", "1", "worker:0"), there("a-w2", "2", "worker:1"), going];
        let storage = Storage { bucket: "b".into(), region: "r".into(), ..Storage::default() };
        let made = pod(&job(), &config(), &storage, &Lies::default(), "PEM", 0, "a").unwrap();
        // another one of that image would be no better, and one that can do it stays
        assert_eq!(outdated(&pods, &[0, 2, 3], &made), ["a-w0"]);
        assert_eq!(outdated(&pods, &[], &made), [""; 0]);
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
        let (none, anywhere) = (BTreeMap::new(), Placement::Preferred);
        let plan = |job: &str, pods: &[Pod], wanted| plan(job, pods, wanted, (&none, anywhere));
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
