//! The `RenderJob`: what to render, how well, and on what.

// a resource has one `printcolumn` for each column, and their types repeat
#![allow(clippy::duplicated_attributes)]

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Aov, ByteSize, ImageSize, PictureFile, Strategy};

/// The group and version of [`RenderJob`].
pub const API_VERSION: &str = "rayherd.io/v1alpha1";
/// The kind of [`RenderJob`].
pub const KIND: &str = "RenderJob";

/// What `spec.managedBy` is for the jobs that the operator works on.
pub const MANAGED_BY: &str = "rayherd.io/operator";

/// The annotation of a job that somebody watches: as long as it is there, whatever its value, previews of the picture are made.
pub const PREVIEW: &str = "rayherd.io/preview";

/// One scene, rendered from one or more cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct RenderJob {
    /// `rayherd.io/v1alpha1`.
    pub api_version: String,
    /// `RenderJob`.
    pub kind: String,
    /// Name and labels.
    #[serde(default)]
    pub metadata: Metadata,
    /// What is wanted.
    pub spec: RenderJobSpec,
}

/// The part of Kubernetes' object metadata that a local run has a use for; other fields are let through.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub struct Metadata {
    /// Name of the job; outputs are named after it when it is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Labels.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub labels: BTreeMap<String, String>,
    /// Annotations: [`PREVIEW`] among them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub annotations: BTreeMap<String, String>,
}

/// What is wanted of a render. What is left out is taken from the scene file, or else from the defaults named here.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[cfg_attr(feature = "kube", derive(kube::CustomResource))]
#[cfg_attr(
    feature = "kube",
    kube(
        group = "rayherd.io",
        version = "v1alpha1",
        kind = "RenderJob",
        root = "RenderJobObject",
        namespaced,
        status = "crate::resource::RenderJobStatus",
        shortname = "rj",
        derive = "PartialEq",
        printcolumn(name = "Phase", type_ = "string", json_path = ".status.phase"),
        printcolumn(name = "Progress", type_ = "string", json_path = ".status.progress"),
        printcolumn(name = "Error", type_ = "string", json_path = ".status.relMse"),
        printcolumn(name = "Remote", type_ = "string", json_path = ".status.remoteReadRatio"),
        printcolumn(name = "Workers", type_ = "string", json_path = ".status.workers"),
        printcolumn(name = "Age", type_ = "date", json_path = ".metadata.creationTimestamp")
    )
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct RenderJobSpec {
    /// The scene and how it is imported.
    pub scene: SceneSpec,
    /// The picture or pictures.
    #[serde(default)]
    pub image: ImageSpec,
    /// How many paths, and how long.
    #[serde(default)]
    pub sampling: SamplingSpec,
    /// How rays and scene data meet. The image is the same bytes for all of them.
    #[serde(default)]
    pub strategy: Strategy,
    /// Bytes of one split of the scene, measured as stored geometry; 128Mi by default. Not together with `splits`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub block_size: Option<ByteSize>,
    /// Number of splits, instead of `blockSize`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 1_000_000))]
    pub splits: Option<i64>,
    /// Share of primitives in contested cells above which the scheduling grid is refined; 0.2 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.0, max = 1.0), extend("default" = 0.2))]
    pub overlap_threshold: Option<f64>,
    /// The machines: real ones on a cluster, virtual ones in a local run.
    #[serde(default)]
    pub workers: WorkersSpec,
    /// Nodes that hold a copy of each block, at most as many as the storage has servers (in a local run as there are nodes); 1 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 16), extend("default" = 1))]
    pub replicas: Option<i32>,
    /// Whether all tasks of a round end before the next begins; by default false for `Auto`, true for the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub barrier: Option<bool>,
    /// Seconds of work that a task is sized to; 10 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.01, max = 3600.0), extend("default" = 10.0))]
    pub task_seconds: Option<f64>,
    /// Who works on the job on a cluster: `rayherd.io/operator`, and so it is by default. An operator leaves a job of another name
    /// alone, for whoever has it to dispatch it elsewhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(extend("maxLength" = 63, "pattern" = "^[a-z0-9.-]+/[a-zA-Z0-9._-]+$"))]
    pub managed_by: Option<String>,
    /// How much a cluster cares that workers run beside the data. The image is the same bytes for all of them.
    #[serde(default)]
    pub placement: Placement,
    /// Where a cluster keeps scenes, rays and pictures. A local run has no use for it.
    #[serde(default)]
    pub storage: StorageSpec,
    /// Whether a cluster is not to work on the job for now: it has no workers, and goes on later from what was committed.
    #[serde(default)]
    pub suspend: bool,
    /// Seconds after which a cluster gives up a job that is not done, from its start or the end of a suspension.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub active_deadline_seconds: Option<i64>,
    /// Seconds after its end at which a cluster deletes the job, but not its pictures; never by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0))]
    pub ttl_seconds_after_finished: Option<i64>,
}

/// Where a cluster keeps scenes, rays and pictures.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct StorageSpec {
    /// Name of a profile that whoever runs the operator has set up; `default` by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(extend("default" = "default", "maxLength" = 200))]
    pub profile: Option<String>,
    /// Secret in the job's namespace that holds `AWS_ACCESS_KEY_ID` and `AWS_SECRET_ACCESS_KEY`; `rayherd-storage` by
    /// default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(extend("default" = "rayherd-storage", "maxLength" = 253))]
    pub secret: Option<String>,
}

/// How much a cluster cares that workers run beside the data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Placement {
    /// Workers are drawn to the nodes that hold most of the scene; where there is no room they run elsewhere.
    #[default]
    Preferred,
    /// Workers run on nodes that hold some of the scene, and nowhere else: they wait until there is room.
    Required,
    /// Nobody looks where data lies: not for placing workers, not for dealing out work, not for choosing which copy to read. To
    /// measure what the others gain.
    None,
}

/// The scene and how it is imported.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct SceneSpec {
    /// A Mitsuba XML file, a mesh (PLY, OBJ, STL), a folder of meshes, or a CT volume (DICOM folder, NRRD, NIfTI).
    /// A relative path in a job file is relative to that file.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub source: String,
    /// Instead of a source, and of all that says how to import and cut it: a scene that is prepared in the job's storage, by the hash
    /// that `status.scene` of an earlier job says. Nothing is read of its source, nor prepared. On a cluster only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(extend("pattern" = "^[0-9a-f]{64}$", "maxLength" = 64))]
    pub prepared: Option<String>,
    /// Value of the surface to extract from a volume, in its rescaled units (Hounsfield for CT).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub iso: Option<f64>,
    /// Rectangular lights: of a mesh or volume instead of the two that frame it, of an XML scene beside its own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lights: Vec<LightSpec>,
    /// Radiance of a constant sky: one number or three (linear RGB), instead of the scene's; 0 is no sky.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 3), inner(range(min = 0.0)))]
    pub sky: Option<Vec<f64>>,
    /// Reflectance of a mesh or volume: one number or three (linear RGB) in 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 3), inner(range(min = 0.0, max = 1.0)))]
    pub albedo: Option<Vec<f64>>,
    /// Whether each unsupported element is replaced by a named stand-in instead of being an error.
    #[serde(default)]
    pub substitute: bool,
    /// Values for the parameters of a Mitsuba file (`$name`).
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub define: BTreeMap<String, String>,
}

/// A rectangle that shines from `origin` towards `target`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct LightSpec {
    /// Its centre, in the scene's coordinates.
    pub origin: [f64; 3],
    /// A point that its front looks at.
    pub target: [f64; 3],
    /// Width and height, above 0.
    pub size: [f64; 2],
    /// Radiance (W/sr/m2): one number or three (linear RGB).
    #[schemars(length(min = 1, max = 3), inner(range(min = 0.0)))]
    pub radiance: Vec<f64>,
}

/// The picture or pictures.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ImageSpec {
    /// `WIDTHxHEIGHT` in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<ImageSize>,
    /// One frame per camera, all from one prepared scene; without any, the scene's own camera or one that frames it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<CameraSpec>,
    /// The EXR file; the PNG stands beside it. With several cameras `-NAME` or `-0001`.. comes before the extension. A cluster writes
    /// them as `prefix`, a slash and this path, onto each server of the job's storage.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub output: Option<String>,
    /// The folder of the job's storage in which a cluster writes the pictures; `output/NAMESPACE/NAME` by default, which no other job has.
    /// Jobs that name the same folder and file overwrite each other's. `rayherd render` does not look at it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prefix: Option<String>,
    /// Which of the files are written; both by default. May change: a finished job writes what is asked for anew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 2), extend("default" = ["Exr", "Png"], "x-kubernetes-list-type" = "set"))]
    pub files: Option<Vec<PictureFile>>,
    /// Layers of the EXR beside the picture; those that the scene asks for by default, and an empty list is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aovs: Option<Vec<Aov>>,
    /// Exposure of the PNG in stops; 0 by default. The EXR is not changed by it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = -32.0, max = 32.0), extend("default" = 0.0))]
    pub exposure: Option<f64>,
}

impl ImageSpec {
    /// Folders of a storage that are Rayherd's own.
    pub const TAKEN: [&str; 6] = ["deleted", "going", "jobs", "names", "objects", "uses"];

    /// The key of a picture of a cluster's job, from its path as `output` gives it.
    pub fn key(&self, namespace: &str, job: &str, path: &str) -> String {
        match &self.prefix {
            Some(prefix) => format!("{prefix}/{path}"),
            None => format!("output/{namespace}/{job}/{path}"),
        }
    }
}

/// A perspective camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct CameraSpec {
    /// Name of the frame, of `[A-Za-z0-9._-]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(extend("pattern" = "^[A-Za-z0-9._-]+$", "maxLength" = 200))]
    pub name: Option<String>,
    /// Where it stands, in the scene's coordinates.
    pub origin: [f64; 3],
    /// A point that it looks at.
    pub target: [f64; 3],
    /// The direction that is up in the image; [0, 1, 0] by default.
    #[serde(default = "default_up")]
    pub up: [f64; 3],
    /// Full field of view along the width, degrees.
    #[schemars(range(min = 0.001, max = 179.0))]
    pub fov: f64,
}

fn default_up() -> [f64; 3] {
    [0.0, 1.0, 0.0]
}

/// How many paths, and how long.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct SamplingSpec {
    /// Samples per pixel; with a target error or a time limit, the most that are taken: with a target error on average, as tiles that need fewer get fewer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 16_777_216))]
    pub spp: Option<i32>,
    /// Relative squared error (relMSE, estimated from the two halves of the film) at which sampling stops.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.0))]
    pub target_error: Option<f64>,
    /// Seconds after which no further step of samples is started.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.0))]
    pub time_limit: Option<f64>,
    /// Most rays in a path, shadow rays not counted: 1 sees emitters only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 65535))]
    pub max_depth: Option<i32>,
    /// Vertex from which Russian roulette ends paths; the scene's, or 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 65535))]
    pub rr_depth: Option<i32>,
    /// Paths that go on from the first hit of each sample; 1 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 512), extend("default" = 1))]
    pub split: Option<i32>,
    /// Seed of every random number; 0 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0), extend("default" = 0))]
    pub seed: Option<i64>,
}

/// The machines.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct WorkersSpec {
    /// Number of nodes; 1 by default, or as many as `slots` has numbers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 4096))]
    pub nodes: Option<i32>,
    /// The fewest workers that a cluster keeps, together with `max` and instead of `nodes`: how many there are follows the rays that wait
    /// and the camera samples that are not made yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 4096))]
    pub min: Option<i32>,
    /// The most workers that a cluster keeps. A local run has so many nodes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 4096))]
    pub max: Option<i32>,
    /// Tasks at a time per node: one number for all nodes, or one for each. By default 1 on a cluster, and in a local run the threads of
    /// the machine.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(inner(range(min = 1, max = 1024)))]
    pub slots: Vec<i32>,
    /// Scene data (geometry and attributes) that one node may hold in memory; rays and film come on top, bounded apart from it. By
    /// default 1Gi on a cluster, and no limit in a local run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory: Option<ByteSize>,
    /// Seconds for which a cluster keeps a finished job's workers, so that the same job with more samples goes on at once; 0 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0, max = 86400), extend("default" = 0))]
    pub keep_warm_seconds: Option<i64>,
    /// What a cluster's worker pods have beside what the operator gives them, as a PodTemplateSpec: labels, annotations, tolerations,
    /// node selectors, priority classes, pull secrets, and of the container `worker` its resources and more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "any_object")]
    pub template: Option<serde_json::Value>,
}

/// What another schema says, which is the API server's own.
fn any_object(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
    schemars::json_schema!({"type": "object", "nullable": true, "x-kubernetes-preserve-unknown-fields": true})
}

impl RenderJob {
    /// A job of the current version with this specification.
    pub fn new(spec: RenderJobSpec) -> Self {
        RenderJob { api_version: API_VERSION.into(), kind: KIND.into(), metadata: Metadata::default(), spec }
    }
}

impl ImageSpec {
    /// Whether this file of each picture is to be written.
    pub fn writes(&self, file: PictureFile) -> bool {
        self.files.as_ref().is_none_or(|files| files.contains(&file))
    }
}

impl WorkersSpec {
    /// Slots of each node, of as many as there are at most, `default` where none are given. `None` when the numbers contradict each other.
    pub fn slots_per_node(&self, default: u32) -> Option<Vec<u32>> {
        let nodes = self.nodes.or(self.max).map(|n| n as usize);
        match (&self.slots[..], nodes) {
            ([], n) => Some(vec![default; n.unwrap_or(1)]),
            ([one], n) => Some(vec![*one as u32; n.unwrap_or(1)]),
            (many, n) if n.is_none_or(|n| n == many.len()) => Some(many.iter().map(|&s| s as u32).collect()),
            _ => None,
        }
    }
}
