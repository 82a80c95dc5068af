//! Messages between workers and operator. Small: names, numbers and counts; rays, film and blocks go through the stores.

use rayherd_api::{RenderJobSpec, Strategy};
use rayherd_render::film::{ErrorSum, Samples};
use rayherd_render::frame::Frame;
use rayherd_render::skip::SkipCounts;
use rayherd_scene::objects::ObjectRef;
use serde::{Deserialize, Serialize};

use crate::job::JobError;
use crate::ledger::{FilmRef, Outputs};
use crate::local::attempt::Attempt;
use crate::profile::Profile;
use crate::report::BytesRow;

/// Which worker speaks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct WorkerId {
    /// Its number in the job, from 0.
    pub number: u32,
    /// Names this start of its process: another session has nothing of what this one held.
    pub session: String,
}

/// A worker asks for work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Poll {
    /// Who.
    pub worker: WorkerId,
    /// The endpoint on its own node, if there is one.
    pub home: Option<u32>,
    /// The stage that it has open.
    pub stage: Option<String>,
    /// It takes no attempts: so that film is added up while all slots compute.
    pub clerk: bool,
    /// It can take a band out of a film part; workers of earlier versions add all of it.
    #[serde(default)]
    pub bands: bool,
    /// It makes the layers that a frame asks for; workers of earlier versions leave them out, and say nothing.
    #[serde(default)]
    pub aovs: bool,
    /// It builds blocks of scenes that others cut.
    #[serde(default)]
    pub builds: bool,
    /// It makes pictures of films that are not finished.
    #[serde(default)]
    pub previews: bool,
    /// It knows tiles with samples of their own; workers of earlier versions take one number for all.
    #[serde(default)]
    pub tiles: bool,
    /// Which picture it makes of a scene and frame ([`crate::job::PICTURE`]); that of a worker that does not say so is another.
    #[serde(default)]
    pub picture: u32,
    /// What its cache holds of the stage's scene, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holds: Option<Holds>,
}

/// Splits that lie in a worker's cache.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Holds {
    /// Grows with each change, from 0 when it holds nothing: of two messages of one session the higher one is the later.
    pub version: u64,
    /// First and last of each run of splits, ascending.
    pub splits: Vec<[u32; 2]>,
}

/// What it is told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", tag = "answer")]
pub enum Answer {
    /// Nothing to do yet: ask again.
    Wait,
    /// Something to do in the stage that is open.
    Work {
        /// Names this piece of work in the report.
        id: String,
        /// What.
        work: Box<Work>,
    },
    /// Another stage is on: open it (none: close this one).
    Open {
        /// Which.
        stage: Option<Box<Stage>>,
    },
    /// The job is over: end.
    Over,
}

/// One frame that is rendered: all that a worker needs besides the attempts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Stage {
    /// Names it.
    pub id: String,
    /// The manifest of the scene.
    pub scene: ObjectRef,
    /// The picture.
    pub frame: Frame,
    /// Where the frame's objects are in each store, without slashes at its ends.
    pub prefix: String,
    /// Which data a task holds.
    pub strategy: Strategy,
    /// Scene data that a worker may hold, bytes; no bound if none.
    pub memory: Option<u64>,
    /// Copies of each object.
    pub replicas: u32,
    /// Whether the copy at home is read first, where there is one; else any, as hashing has it.
    pub near: bool,
    /// Buckets of the reduce step.
    pub buckets: u32,
    /// Tiles of a band of the film.
    #[serde(default = "whole")]
    pub band: u32,
    /// Exposure in stops of the PNG that is written beside the picture; without one there is none.
    #[serde(default)]
    pub exposure: Option<f64>,
    /// Whether the EXR is kept.
    #[serde(default = "yes")]
    pub exr: bool,
    /// Whether workers tell what the stages of attempts cost.
    #[serde(default)]
    pub profile: bool,
}

/// Operators of versions that know no choice want the EXR.
fn yes() -> bool {
    true
}

/// Operators of versions without bands take films as a whole.
fn whole() -> u32 {
    u32::MAX
}

/// Something to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", tag = "work")]
pub enum Work {
    /// Import and prepare the job's scene, unless it is prepared, and put its blocks where they belong.
    Prepare {
        /// The checked job.
        spec: Box<RenderJobSpec>,
        /// Copies of each block.
        replicas: u32,
        /// The blocks of a large scene are built by others; whoever prepares builds them without it, or knowing nothing of it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        apart: Option<Apart>,
        /// Stores that hold the source: better a worker beside one of them than one that is beside none.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        beside: Vec<u32>,
    },
    /// Build blocks of a scene that is cut, and put them where they belong.
    Build {
        /// Below this their primitives lie.
        prefix: String,
        /// Which.
        splits: Vec<ToBuild>,
        /// Copies of each block.
        replicas: u32,
    },
    /// Trace.
    Attempt {
        /// What.
        attempt: Attempt,
    },
    /// Add film parts, or make a picture of their sum.
    Merge {
        /// The sum is stored under this name; not at all without one.
        name: Option<String>,
        /// What to add.
        parts: Vec<FilmRef>,
        /// Samples per pixel in the sum, for its error and the picture.
        spp: Samples,
        /// The picture is written under this key of the storage, as OpenEXR, band by band; then nothing else is stored.
        picture: Option<String>,
        /// Only this band of the film; the whole without one.
        #[serde(default)]
        band: Option<u32>,
        /// The errors of its tiles are told, too.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        tiles: bool,
    },
    /// Make a picture of a film that is not finished, for whoever watches. Nobody waits for it.
    Preview {
        /// What to add.
        parts: Vec<FilmRef>,
        /// Samples per pixel, about: what waits or is being made is missing.
        spp: Samples,
        /// The key of the storage where it is written, as PNG.
        key: String,
        /// Its exposure in stops.
        exposure: f64,
    },
    /// Copy rays and film whose copies on one store cannot be had, from those that are left.
    Copy {
        /// Names, with the stores that hold each.
        objects: Vec<(String, Vec<u32>)>,
        /// The store that is silent.
        gone: u32,
    },
    /// Copy the scene's objects of which there are too few copies without one store.
    Restore {
        /// The store that is silent.
        gone: u32,
    },
}

/// Where what lies between cutting a scene and building its blocks is put.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Apart {
    /// Prefix of its keys, without a slash at its end.
    pub prefix: String,
    /// Scenes of fewer primitives are built by whoever cuts them.
    pub least: u64,
}

/// A block to build.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct ToBuild {
    /// Number of its split.
    pub number: u32,
    /// Primitives in it.
    pub primitives: u64,
    /// Its primitives, packed and sealed.
    pub packed: ObjectRef,
    /// Stores that it belongs on, its home first.
    pub on: Vec<u32>,
}

/// What a worker did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Report {
    /// Who.
    pub worker: WorkerId,
    /// Which piece of work.
    pub id: String,
    /// What came out.
    pub result: Result<Done, Failure>,
    /// CPU-seconds.
    pub cpu: f64,
    /// Bytes moved.
    pub bytes: Vec<BytesRow>,
    /// What this worker has read of the scene for the first time.
    #[serde(default)]
    pub reads: Reads,
    /// What its cache holds of the scene of the stage that `reads` names, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holds: Option<Holds>,
    /// Copies that its cache could not keep, or has lost, since it told last.
    #[serde(default)]
    pub cache_failures: u64,
    /// Bytes of scene data that it holds in memory.
    #[serde(default)]
    pub resident: u64,
}

/// Objects of a scene that a worker has read in a stage, and has not told of before.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Reads {
    /// The stage.
    pub stage: String,
    /// Splits, by number.
    pub splits: Vec<u32>,
    /// Texture tiles, by number.
    pub tiles: Vec<u32>,
}

/// What came out of a piece of work.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", tag = "done")]
pub enum Done {
    /// Of preparing.
    Prepared {
        /// The manifest.
        scene: ObjectRef,
        /// It was there already.
        reused: bool,
        /// Cells of volumes that were not looked into.
        #[serde(default)]
        cells_passed: u64,
    },
    /// Of preparing a large scene: blocks are to be built.
    Drafted {
        /// The manifest as it will be, with packed primitives in place of blocks.
        draft: ObjectRef,
        /// Cells of volumes that were not looked into.
        cells_passed: u64,
    },
    /// Of building blocks.
    Built {
        /// They, in the order that they were asked for.
        blocks: Vec<ObjectRef>,
    },
    /// Of an attempt.
    Made {
        /// To be committed.
        outputs: Outputs,
        /// Rays that left the split set.
        hops: u64,
        /// What it did not do.
        #[serde(default)]
        skipped: SkipCounts,
        /// What its stages cost, if the stage asks for it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        profile: Option<Box<Profile>>,
    },
    /// Of a merge.
    Merged {
        /// The sum, if it was to be stored and is not empty.
        film: Option<FilmRef>,
        /// Estimated relMSE, of whoever knows no bands.
        #[serde(default)]
        rel_mse: Option<f64>,
        /// Sum of the errors that relMSE is the mean of.
        #[serde(default)]
        error: Option<ErrorSum>,
        /// Those of the band's tiles, or of all, if they were asked for and there are any.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        tiles: Vec<ErrorSum>,
        /// Pixel and sample of the first contributions that were not finite.
        non_finite: Vec<(u32, u32)>,
        /// Where the picture lies, if it was asked for.
        picture: Vec<String>,
    },
    /// Of a picture of a film that is not finished.
    Previewed,
    /// Of copying.
    Copied {
        /// Where the objects lie now; those without a copy that can be had are left out.
        objects: Vec<(String, Vec<u32>)>,
    },
    /// Of restoring.
    Restored {
        /// Copies written.
        copies: u64,
        /// Objects of which there are too few all the same.
        few: u64,
    },
}

/// Why a piece of work did not come out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", tag = "failure")]
pub enum Failure {
    /// It was given back, or need not go on.
    Stopped,
    /// An input is gone with all its copies.
    Lost {
        /// Which.
        name: String,
        /// How that was found.
        why: String,
    },
    /// May work later or elsewhere.
    ForNow {
        /// What went wrong.
        message: String,
    },
    /// Will not work.
    ForGood {
        /// What went wrong, and what to do.
        message: String,
    },
}

impl Failure {
    /// What it means to whoever had the work done.
    pub fn into_error(self) -> JobError {
        match self {
            Failure::Lost { name, why } => JobError::Lost { name, why },
            Failure::Stopped => JobError::Stopped,
            Failure::ForNow { message } | Failure::ForGood { message } => JobError::Settings(message),
        }
    }
}

impl From<&JobError> for Failure {
    fn from(e: &JobError) -> Self {
        use crate::store::StoreError;
        match e {
            JobError::Stopped => Failure::Stopped,
            JobError::Lost { name, why } => Failure::Lost { name: name.clone(), why: why.clone() },
            JobError::Store(StoreError::Unavailable { .. } | StoreError::Full { .. }) | JobError::Object(_) => {
                Failure::ForNow { message: e.to_string() }
            }
            e => Failure::ForGood { message: e.to_string() },
        }
    }
}

/// A sign of life, sent while work runs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Beat {
    /// Who.
    pub worker: WorkerId,
    /// What runs.
    pub running: Vec<String>,
}
