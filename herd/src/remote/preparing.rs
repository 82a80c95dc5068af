//! The operator's side of preparing: one worker cuts the source into splits, all of them build the blocks.
//!
//! What the first one packed lies below the job's own prefix, on the stores where the blocks are to lie, until the scene has its name. A worker
//! that goes takes no more with it than the few splits that it had in hand, and an operator that goes no more than the blocks that were built:
//! the next one finds the draft. A scene that is small, or that is prepared for one worker, is prepared by one.

use std::sync::Arc;

use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{ObjectRef, ObjectStore};
use rayherd_scene::prepare::complete;
use serde::{Deserialize, Serialize};

use super::blocks::{by_name, key, lost};
use super::frames::{Job, Keeper};
use super::homes::{Homes, bytes_read};
use super::listing::{self, Listing};
use super::message::{Apart, Done, ToBuild, Work};
use crate::job::{JobError, PreparedScene};
use crate::store::{BlockStore, SceneObjects};

/// Usable primitives of a scene from which on its blocks are built by all workers: some seconds of one thread's work, for which 44 bytes
/// each are written and read once more.
pub const APART: u64 = 1 << 20;
/// Pieces of work for each slot: what is given out last, or again after a death, is small beside the whole.
const PIECES: u64 = 4;
/// How often a scene is cut again whose primitives were lost on the way.
const MOST_CUTS: u32 = 3;

/// What preparing came to: the manifest, whether it was there already, and cells of volumes that were not looked into.
type Scene = (ObjectRef, bool, u64);

/// Has workers prepare the scene of a job, unless it is prepared.
///
/// # Errors
/// When it cannot be prepared, or the job was cancelled.
pub fn prepared(job: &Job, keeper: &dyn Keeper, replicas: u32) -> Result<Scene, JobError> {
    let listing = Listing::of(job);
    let name = listing.as_ref().and_then(|l| l.name(job.spec));
    if let Some(reference) = name.as_ref().and_then(|name| listing::find(job, replicas, name)) {
        return Ok((reference, true, 0));
    }
    keeper.source(&listing.as_ref().map(Listing::bytes).unwrap_or_default());
    let prefix = format!("{}/prepare", job.prefix);
    let apart = (job.slots.len() > 1).then(|| Apart { prefix: prefix.clone(), least: job.apart });
    let is_apart = apart.is_some();
    let done = by_workers((job, keeper, replicas), apart, listing.as_ref(), name.as_deref());
    // whoever goes on with the job may be at it already
    if is_apart && !matches!(done, Err(JobError::Owned(_))) {
        clean(job, &prefix);
    }
    if let (Ok(scene), Some(name)) = (&done, &name)
        && Listing::of(job) == listing
    {
        listing::set(job, replicas, name, &scene.0);
    }
    done
}

fn by_workers(
    (job, keeper, replicas): (&Job, &dyn Keeper, u32),
    apart: Option<Apart>,
    listing: Option<&Listing>,
    name: Option<&str>,
) -> Result<Scene, JobError> {
    let beside = listing.map(Listing::holders).unwrap_or_default();
    let spec = Box::new(job.spec.clone());
    let work = Work::Prepare { spec, replicas, apart: apart.clone(), beside };
    let prefix = apart.map(|a| a.prefix).unwrap_or_default();
    let (mut begun, mut cuts): (Option<Begun>, u32) = (None, 0);
    loop {
        // whose turn it is must have who does it: jobs that wait with their workers may leave no room for its own
        job.fleet.staffed()?;
        // of two jobs that come at once with one scene, the second finds it prepared
        let _turn = job.turns.take(&job.spec.scene.source, || job.fleet.check())?;
        if begun.is_none() {
            if let Some(reference) = name.and_then(|name| listing::find(job, replicas, name)) {
                return Ok((reference, true, 0));
            }
            // once: what was found and cannot be built of is cut anew
            let left = name.filter(|_| cuts == 0).and_then(|name| Cut::find(job, &prefix, name));
            let cut = match left {
                Some(cut) => cut,
                None => match job.fleet.call_while_staffed(work.clone())? {
                    Some(Done::Prepared { scene, reused, cells_passed }) => {
                        return Ok((scene, reused, cells_passed));
                    }
                    Some(Done::Drafted { draft, cells_passed }) => {
                        let cut = Cut { of: name.map(str::to_owned), draft, cells_passed };
                        cut.keep(job, replicas, &prefix);
                        cut
                    }
                    Some(_) => {
                        return Err(JobError::Internal("a worker reports something else than it was to do".into()));
                    }
                    None => {
                        tracing::warn!("the worker that was to prepare the scene is gone: others come first");
                        continue;
                    }
                },
            };
            cuts += 1;
            begun = match Begun::open(job, replicas, &prefix, &cut) {
                Ok(draft) => {
                    keeper.cut(&draft.bytes(job.depot.len()));
                    Some(draft)
                }
                Err(e) => again(e, cuts)?,
            };
        }
        let Some(draft) = begun.as_mut() else { continue };
        match draft.build(job, replicas, &prefix) {
            Ok(true) => return draft.finish(job, replicas),
            Ok(false) => tracing::warn!("all workers that were to build blocks are gone: others come first"),
            Err(e) => begun = again(e, cuts)?,
        }
    }
}

/// What lies in between is lost: the scene is cut again, but not for ever. Other errors are what they are.
fn again(e: JobError, cuts: u32) -> Result<Option<Begun>, JobError> {
    if cuts >= MOST_CUTS || !matches!(e, JobError::Lost { .. }) {
        return Err(e);
    }
    tracing::warn!("{e}; the scene is cut again");
    Ok(None)
}

/// Where the draft of a scene lies, for whoever goes on with its job.
#[derive(Serialize, Deserialize)]
struct Cut {
    /// The name of the source as it was listed ([`Listing::name`]): of another one, or of one without a name, it is no draft.
    of: Option<String>,
    draft: ObjectRef,
    cells_passed: u64,
}

impl Cut {
    fn key(prefix: &str) -> String {
        format!("{prefix}/cut")
    }

    /// Without it the next operator has the scene cut again.
    fn keep(&self, job: &Job, replicas: u32, prefix: &str) {
        if self.of.is_none() {
            return;
        }
        let kept = serde_json::to_vec(self).map_err(|e| JobError::Internal(e.to_string())).and_then(|body| {
            let store = job.depot.replicated(replicas)?;
            Ok(job.runtime.block_on(store.put(&Cut::key(prefix), body.into()))?)
        });
        if let Err(e) = kept {
            tracing::warn!("where the draft of the scene lies is not kept: {e}");
        }
    }

    fn find(job: &Job, prefix: &str, name: &str) -> Option<Self> {
        // one copy: this must not make more of what goes soon
        let body = job.depot.replicated(1).and_then(|store| job.runtime.block_on(store.get(&Cut::key(prefix))));
        let body = body.inspect_err(|e| tracing::debug!("no draft of the scene: {e}")).ok()?;
        let cut: Cut = serde_json::from_slice(&body)
            .inspect_err(|e| tracing::warn!("{} cannot be read, the scene is cut again: {e}", Cut::key(prefix)))
            .ok()?;
        (cut.of.as_deref() == Some(name)).then_some(cut)
    }
}

/// A scene that is cut and whose blocks are not all built.
struct Begun {
    draft: PreparedScene,
    /// Stores of each split.
    places: Vec<Vec<u32>>,
    blocks: Vec<Option<ObjectRef>>,
    cells_passed: u64,
}

impl Begun {
    fn open(job: &Job, replicas: u32, prefix: &str, cut: &Cut) -> Result<Self, JobError> {
        let store = job.depot.view(1, Some(by_name()), None)?;
        let body = job.runtime.block_on(store.get(&key(prefix, &cut.draft))).map_err(lost)?;
        let draft = PreparedScene::open(Manifest::decode(&body)?, objects(job, replicas)?)?;
        let places = Homes::of(&draft, job.depot.len(), replicas).splits().to_vec();
        let blocks = vec![None; places.len()];
        Ok(Begun { draft, places, blocks, cells_passed: cut.cells_passed })
    }

    /// Bytes of blocks that will be read, by store, as far as they are known.
    fn bytes(&self, stores: u32) -> Vec<u64> {
        bytes_read(&self.draft, &self.places, stores, |split| self.draft.manifest.splits[split as usize].weight())
    }

    /// What is left to do, in pieces of about equal bytes. Those of one home are together, so that a worker beside it reads and writes there.
    fn pieces(&self, slots: u64) -> Vec<Vec<ToBuild>> {
        let splits = (0u32..).zip(&self.draft.manifest.splits).zip(&self.places).zip(&self.blocks);
        let mut left: Vec<ToBuild> = splits
            .filter(|(_, block)| block.is_none())
            .map(|(((number, split), on), _)| ToBuild {
                number,
                primitives: split.triangles + split.spheres,
                packed: split.geometry,
                on: on.clone(),
            })
            .collect();
        left.sort_by_key(|s| (s.on.first().copied(), s.number));
        let most = left.iter().map(|s| s.packed.bytes).sum::<u64>().div_ceil(PIECES * slots.max(1));
        let mut pieces: Vec<Vec<ToBuild>> = Vec::new();
        let mut bytes = 0;
        for split in left {
            let joins = |piece: &&mut Vec<ToBuild>| {
                bytes + split.packed.bytes <= most && piece.last().is_some_and(|l| l.on.first() == split.on.first())
            };
            match pieces.last_mut().filter(joins) {
                Some(piece) => {
                    bytes += split.packed.bytes;
                    piece.push(split);
                }
                None => {
                    bytes = split.packed.bytes;
                    pieces.push(vec![split]);
                }
            }
        }
        pieces
    }

    /// Has blocks built; whether all of them are.
    fn build(&mut self, job: &Job, replicas: u32, prefix: &str) -> Result<bool, JobError> {
        let pieces = self.pieces(job.slots.iter().map(|&s| u64::from(s)).sum());
        let work = |splits: &Vec<ToBuild>| Work::Build { prefix: prefix.to_owned(), splits: splits.clone(), replicas };
        let done = job.fleet.call_all_while_staffed(pieces.iter().map(work).collect())?;
        for (piece, done) in pieces.iter().zip(done) {
            match done {
                Some(Done::Built { blocks }) if blocks.len() == piece.len() => {
                    piece.iter().zip(blocks).for_each(|(s, block)| self.blocks[s.number as usize] = Some(block));
                }
                Some(_) => return Err(JobError::Internal("a worker reports something else than it was to do".into())),
                None => {}
            }
        }
        Ok(self.blocks.iter().all(Option::is_some))
    }

    /// Stores the manifest, and lets its name point to it.
    fn finish(&self, job: &Job, replicas: u32) -> Result<Scene, JobError> {
        let blocks: Vec<ObjectRef> = self.blocks.iter().flatten().copied().collect();
        let manifest = complete(self.draft.manifest.clone(), &blocks).map_err(|e| JobError::Scene(e.to_string()))?;
        // what a worker got wrong must not get a name
        let manifest = Manifest::decode(&manifest.encode())?;
        let reference = manifest.store(objects(job, replicas)?.as_ref())?;
        Ok((reference, false, self.cells_passed))
    }
}

fn objects(job: &Job, replicas: u32) -> Result<Arc<dyn ObjectStore>, JobError> {
    Ok(Arc::new(SceneObjects::new(Arc::new(job.depot.replicated(replicas)?), job.runtime.clone())?))
}

/// Deletes what lay in between. What a store keeps that does not answer goes with the job.
fn clean(job: &Job, prefix: &str) {
    for store in job.depot.stores() {
        let done = job.runtime.block_on(async {
            let keys: Vec<String> = store.list(&format!("{prefix}/")).await?.into_iter().map(|(key, _)| key).collect();
            if keys.is_empty() { Ok(()) } else { store.delete(&keys).await }
        });
        if let Err(e) = done {
            tracing::warn!("what is left of preparing goes with the job: {e}");
        }
    }
}
