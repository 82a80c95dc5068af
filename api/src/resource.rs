//! `RenderJob` as a custom resource of Kubernetes: its definition, and what the operator says of it.

use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, MicroTime, Time};
use kube::CustomResourceExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

pub use crate::job::RenderJobObject;
use crate::rules::RULES;
use crate::{API_VERSION, KIND, Metadata, RenderJob};

/// What the operator says of a job. Of bounded size, whatever the job.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct RenderJobStatus {
    /// The generation of the spec that this status is of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed_generation: Option<i64>,
    /// `Accepted`, `Prepared`, `Running`, `Degraded`, `Suspended`, `Complete`, `Failed`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("x-kubernetes-list-type" = "map", "x-kubernetes-list-map-keys" = ["type"]))]
    pub conditions: Vec<Condition>,
    /// `Pending`, `Preparing`, `Rendering`, `Suspended`, `Complete` or `Failed`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<String>,
    /// Camera samples made of those asked for, over all frames, `42%`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<String>,
    /// Estimated relMSE of the last frame that is done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rel_mse: Option<String>,
    /// Rounds (without a barrier: commits) of the current frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rounds: Option<i64>,
    /// Rays that wait in groups.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rays_waiting: Option<i64>,
    /// Scene bytes that were read from other nodes, of all that were read from stores.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remote_read_ratio: Option<String>,
    /// Bytes of that: of the scene, read from stores.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene_bytes_read: Option<i64>,
    /// Those of them that came from other nodes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene_bytes_remote: Option<i64>,
    /// CPU-seconds of all workers' tasks, since the job was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu_seconds: Option<i64>,
    /// Workers that ask for work, of those wanted: `2/3`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub workers: Option<String>,
    /// The prepared scene, by the hash of its manifest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<String>,
    /// Names the settings that it was prepared with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene_settings: Option<String>,
    /// `per node` where each store is on a node of the cluster, else `none`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub locality: Option<String>,
    /// The newest round records that count: of the last frames that were begun, and an object with those of all others.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ledger: Vec<LedgerPointer>,
    /// Committed tasks of the frames that are done that were done again, because all copies of what they made were lost, since the job
    /// was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tasks_redone: Option<i64>,
    /// Frames whose pictures are written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_done: Option<i64>,
    /// Where the pictures are: the picture itself, or of several cameras the folder, which ends in `/`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub output: Option<String>,
    /// When work began, or went on after a suspension.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_time: Option<Time>,
    /// When the first trace task was handed out, to the microsecond.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_task_time: Option<MicroTime>,
    /// When it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub completion_time: Option<Time>,
}

/// Where a frame's chain of round records ends.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct LedgerPointer {
    /// Number of the frame, from 0; -1 stands for an object that holds the pointers of many.
    pub frame: i32,
    /// Place of the record in the chain; of an object, how many pointers it holds.
    pub sequence: i64,
    /// Its name: the hash of its bytes.
    pub record: String,
}

/// Most characters of a condition's message: room for some dozens of problems, each with its place.
pub const MOST_MESSAGE: usize = 4096;

impl RenderJobObject {
    /// The job as a local run reads it from a file.
    pub fn job(&self) -> RenderJob {
        let kube::core::ObjectMeta { name, labels, annotations, .. } = self.metadata.clone();
        let (labels, annotations) = (labels.unwrap_or_default(), annotations.unwrap_or_default());
        let metadata = Metadata { name, labels, annotations };
        RenderJob { api_version: API_VERSION.into(), kind: KIND.into(), metadata, spec: self.spec.clone() }
    }
}

/// The definition of the resource, with its rules.
///
/// # Errors
/// When the derived schema does not have the shape that the rules name, which a test excludes.
pub fn definition() -> Result<CustomResourceDefinition, serde_json::Error> {
    let mut crd = serde_json::to_value(RenderJobObject::crd())?;
    let schema = &mut crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"];
    schema["properties"]["status"]["properties"]["conditions"]["items"]["properties"]["message"]["maxLength"] =
        json!(MOST_MESSAGE);
    tidy(schema);
    schema["description"] =
        json!("One scene, rendered from one or more cameras by worker pods beside the storage that holds it.");
    for (path, rule, message) in RULES {
        let mut at = &mut *schema;
        for name in *path {
            at = if *name == "items" { &mut at["items"] } else { &mut at["properties"][*name] };
        }
        let entry = json!({ "rule": rule, "message": message });
        match at["x-kubernetes-validations"].as_array_mut() {
            Some(rules) => rules.push(entry),
            None => at["x-kubernetes-validations"] = json!([entry]),
        }
    }
    serde_json::from_value(crd)
}

/// Makes a derived schema one that the API server takes: no closed objects beside properties (the server prunes what it does
/// not know), and bounds on what rules walk over, from which it estimates their cost.
fn tidy(schema: &mut Value) {
    match schema {
        Value::Object(map) => {
            if map.get("additionalProperties") == Some(&Value::Bool(false)) {
                map.remove("additionalProperties");
            }
            let is = |t: &str, map: &serde_json::Map<String, Value>| map.get("type").and_then(Value::as_str) == Some(t);
            if is("string", map)
                && !map.contains_key("maxLength")
                && !map.contains_key("enum")
                && !map.contains_key("format")
            {
                map.insert("maxLength".into(), json!(1024));
            }
            if is("array", map) && !map.contains_key("maxItems") {
                map.insert("maxItems".into(), json!(4096));
            }
            if map.contains_key("additionalProperties") && !map.contains_key("maxProperties") {
                map.insert("maxProperties".into(), json!(1024));
            }
            map.values_mut().for_each(tidy);
        }
        Value::Array(items) => items.iter_mut().for_each(tidy),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_definition_is_structural_and_small_and_has_every_rule() {
        let crd = definition().unwrap();
        let text = serde_json::to_string(&crd).unwrap();
        assert!(text.len() < 100_000, "{} bytes", text.len());
        assert!(!text.contains("uint") && !text.contains("additionalProperties\":false"), "{text}");
        assert_eq!(text.matches("\"rule\":").count(), RULES.len());
        let names = &crd.spec.names;
        assert_eq!((names.plural.as_str(), names.short_names.clone()), ("renderjobs", Some(vec!["rj".to_owned()])));
        assert!(crd.spec.versions[0].subresources.as_ref().is_some_and(|s| s.status.is_some()));
        // each column but the age shows a field that there is
        let schema = crd.spec.versions[0].schema.as_ref().and_then(|s| s.open_api_v3_schema.as_ref()).unwrap();
        let status = schema.properties.as_ref().and_then(|of| of["status"].properties.as_ref()).unwrap();
        let columns = crd.spec.versions[0].additional_printer_columns.as_ref().unwrap();
        let shown = columns.iter().map(|c| (c.name.as_str(), c.json_path.strip_prefix(".status."), c.type_.as_str()));
        let (ages, fields): (Vec<_>, Vec<_>) = shown.partition(|(_, field, _)| field.is_none());
        assert_eq!((ages, columns[5].json_path.as_str()), (vec![("Age", None, "date")], ".metadata.creationTimestamp"));
        for (name, field, kind) in fields {
            assert_eq!(status[field.unwrap()].type_.as_deref(), Some(kind), "{name}");
        }
        for (path, ..) in RULES {
            let mut at =
                &serde_json::to_value(&crd).unwrap()["spec"]["versions"][0]["schema"]["openAPIV3Schema"].clone();
            for name in *path {
                at = if *name == "items" { &at["items"] } else { &at["properties"][*name] };
            }
            assert!(at.get("type").is_some(), "{path:?} is no part of the schema");
        }
    }

    #[test]
    fn the_file_is_what_the_types_say() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../crds/renderjob.yaml");
        let want = serde_yaml::to_string(&definition().unwrap()).unwrap();
        if std::env::var_os("RAYHERD_UPDATE_CRD").is_some() {
            std::fs::write(path, &want).unwrap();
        }
        let have = std::fs::read_to_string(path).unwrap_or_default();
        assert!(
            have == want,
            "crds/renderjob.yaml is old: RAYHERD_UPDATE_CRD=1 cargo test -p rayherd-api --features kube"
        );
    }

    #[test]
    fn a_job_of_the_cluster_is_the_job_of_a_file() {
        let text =
            "{apiVersion: rayherd.io/v1alpha1, kind: RenderJob, metadata: {name: a}, spec: {scene: {source: a/b.xml}}}";
        let of_file: RenderJob = serde_yaml::from_str(text).unwrap();
        let object: RenderJobObject = serde_yaml::from_str(text).unwrap();
        assert_eq!(object.job(), of_file);
    }
}
