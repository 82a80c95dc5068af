//! Prepared scenes in a storage: which there are, which objects are theirs, when each was used last.
//!
//! A storage is one store, or several that hold its objects between them (a cluster's servers): of one of several alone nothing can be
//! told. A scene is its manifest, which is found by a name (`names/`) that whoever prepared it gave it, or by its hash, which a job's status
//! says. A mark (`uses/HASH`, the same on every store) says when a job used it last.

mod retention;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use futures::future::join_all;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{ObjectHash, ObjectRef};
use serde::{Deserialize, Serialize};

use crate::job::JobError;
use crate::local::Collected;
use crate::store::{BlockStore, StoreError, object_key, promised_hash};

pub use retention::{Rules, Swept, sweep};

/// Names of scenes.
const NAMES: &str = "names/";
/// Marks of use.
const MARKS: &str = "uses/";
/// Manifests of scenes of which not all objects are deleted yet.
const GOING: &str = "going/";

/// All stores of a storage.
pub type Stores<'s> = &'s [Arc<dyn BlockStore>];

/// When a scene was used last, in the storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Mark {
    /// Seconds since 1970, UTC.
    time: u64,
    /// How many stores the storage has.
    stores: u32,
}

/// What points to a scene.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Scene {
    /// Its names: which store, and the key there.
    pub names: Vec<(usize, String)>,
    /// When it was used last, seconds since 1970, if a job ever marked it.
    pub used: Option<u64>,
}

/// Scenes of a storage, by the hashes of their manifests, which may be missing all the same.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Scenes {
    /// All of them.
    pub all: BTreeMap<ObjectHash, Scene>,
    /// Stores that the storage has, as marks say; 0 where there are none.
    pub stores: u32,
    /// Scenes whose deletion was begun.
    going: BTreeSet<ObjectHash>,
}

/// The time, seconds since 1970; 0 where the clock is before that.
pub fn unix_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_secs())
}

/// Looks for all scenes.
///
/// # Errors
/// When a store does not answer, or has a name or mark that cannot be read.
pub async fn find(stores: Stores<'_>) -> Result<Scenes, JobError> {
    let mut found = Scenes::default();
    for (number, part) in join_all(stores.iter().map(|s| look(s.as_ref()))).await.into_iter().enumerate() {
        let Look { names, marks, going } = part?;
        for (key, hash) in names {
            found.all.entry(hash).or_default().names.push((number, key));
        }
        for (hash, mark) in marks {
            let scene = found.all.entry(hash).or_default();
            // a store that was away has an older one
            scene.used = scene.used.max(Some(mark.time));
            found.stores = found.stores.max(mark.stores);
        }
        found.going.extend(going);
    }
    Ok(found)
}

/// What one store has.
struct Look {
    names: Vec<(String, ObjectHash)>,
    marks: Vec<(ObjectHash, Mark)>,
    going: Vec<ObjectHash>,
}

async fn look(store: &dyn BlockStore) -> Result<Look, JobError> {
    let mut look = Look { names: Vec::new(), marks: Vec::new(), going: Vec::new() };
    for (key, _) in store.list(NAMES).await? {
        if let Some(object) = small::<ObjectRef>(store, &key).await? {
            look.names.push((key, object.hash));
        }
    }
    for (key, _) in store.list(MARKS).await? {
        if let Ok(hash) = key[MARKS.len()..].parse()
            && let Some(mark) = small::<Mark>(store, &key).await?
        {
            look.marks.push((hash, mark));
        }
    }
    look.going = store.list(GOING).await?.iter().filter_map(|(key, _)| key[GOING.len()..].parse().ok()).collect();
    Ok(look)
}

/// A small object; none where it went away since it was listed.
async fn small<T: for<'de> Deserialize<'de>>(store: &dyn BlockStore, key: &str) -> Result<Option<T>, JobError> {
    let body = match store.get(key).await {
        Err(StoreError::NotFound { .. }) => return Ok(None),
        body => body?,
    };
    let wrong = |e| JobError::Scene(format!("{}: {key} cannot be read: {e}; delete it", store.describe()));
    serde_json::from_slice(&body).map(Some).map_err(wrong)
}

/// Notes on every store that a scene is used at `now`, seconds since 1970.
///
/// Whoever uses a scene marks it first and looks then whether it is there: who deletes what is unused takes its manifest away and looks then
/// at its mark. So one of the two sees the other.
///
/// # Errors
/// When no store takes it.
pub async fn mark(stores: Stores<'_>, scene: &ObjectHash, now: u64) -> Result<(), StoreError> {
    let key = format!("{MARKS}{scene}");
    let mark = Mark { time: now, stores: stores.len() as u32 };
    let body: Bytes = serde_json::to_vec(&mark).unwrap_or_default().into();
    let done = join_all(stores.iter().map(|s| s.put(&key, body.clone()))).await;
    let (mut taken, mut failed) = (false, None);
    for result in done {
        match result {
            Ok(()) => taken = true,
            Err(e) => {
                tracing::warn!("a scene is not marked: {e}");
                failed = Some(e);
            }
        }
    }
    failed.filter(|_| !taken).map_or(Ok(()), Err)
}

/// A scene's manifest and its bytes, from whichever store has them whole; none where no store has it.
async fn manifest(stores: Stores<'_>, scene: &ObjectHash) -> Result<Option<(Manifest, Bytes)>, JobError> {
    let key = object_key(scene);
    let mut error = None;
    for store in stores {
        match store.get(&key).await {
            Ok(body) if ObjectHash::of(&body) == *scene => return Ok(Some((Manifest::decode(&body)?, body))),
            Ok(body) => {
                let message = format!("its bytes hash to {}", ObjectHash::of(&body));
                error = Some(StoreError::Corrupt { store: store.describe(), key: key.clone(), message });
            }
            Err(StoreError::NotFound { .. }) => {}
            Err(e) => error = Some(e),
        }
    }
    error.map_or(Ok(None), |e| Err(e.into()))
}

/// Whether a manifest will never be read: it is broken, or of another version.
fn is_unreadable(e: &JobError) -> bool {
    matches!(e, JobError::Manifest(_) | JobError::Store(StoreError::Corrupt { .. }))
}

/// Deletes the objects that belong to no scene that has a name or a mark. Nobody may prepare a scene meanwhile: its objects have no name
/// until it is complete.
///
/// # Errors
/// When a store does not answer, when a manifest cannot be read, on which it depends what may go, or when these are not all of the storage's
/// stores; then nothing is deleted.
pub async fn collect(stores: Stores<'_>) -> Result<Collected, JobError> {
    Ok(collect_if(stores, |_| true).await?.0)
}

/// The same of those objects that belonged to no scene the last time either, `before`; and those that do not now, for the next time. So long after
/// that nobody prepares any more what they were made for, or whoever did is dead.
///
/// # Errors
/// As [`collect`].
pub async fn collect_again(
    stores: Stores<'_>,
    before: &BTreeSet<ObjectHash>,
) -> Result<(Collected, BTreeSet<ObjectHash>), JobError> {
    collect_if(stores, |hash| before.contains(hash)).await
}

/// What was deleted of what belongs to no scene, and what was not.
async fn collect_if(
    stores: Stores<'_>,
    may: impl Fn(&ObjectHash) -> bool,
) -> Result<(Collected, BTreeSet<ObjectHash>), JobError> {
    let found = find(stores).await?;
    let mut known = found.stores;
    let mut kept = BTreeSet::new();
    for (scene, Scene { names, .. }) in &found.all {
        let name = names.first().map_or_else(|| format!("{MARKS}{scene}"), |(_, key)| key.clone());
        let give_up = |why: &str| JobError::Scene(format!("{name}: {why}: delete it to give the scene up"));
        match manifest(stores, scene).await {
            Ok(Some((manifest, _))) => {
                // only scenes of several stores have homes among them
                let homes = manifest.homes.iter().flatten().map(|h| h + 1).max();
                known = known.max(homes.map_or(0, |h| h.max(2)));
                kept.insert(*scene);
                kept.extend(manifest.objects().map(|o| o.hash));
            }
            // the mark of one that is gone
            Ok(None) if names.is_empty() => {}
            Ok(None) => return Err(give_up("its manifest is missing")),
            Err(e) if is_unreadable(&e) => return Err(give_up(&e.to_string())),
            Err(e) => return Err(e),
        }
    }
    if known as usize > stores.len() {
        return Err(JobError::Settings(format!(
            "this is one of {known} or more servers of a cluster's storage, and what one holds may be named on another: nothing is \
             deleted; name all of them"
        )));
    }
    let mut done = Collected::default();
    let mut left = BTreeSet::new();
    let mut garbage = vec![Vec::new(); stores.len()];
    for (store, garbage) in stores.iter().zip(&mut garbage) {
        for (key, bytes) in store.list("objects/").await? {
            // by its form a key of ours
            match promised_hash(&key).filter(|hash| object_key(hash) == key) {
                Some(hash) if !kept.contains(&hash) && !may(&hash) => {
                    left.insert(hash);
                }
                Some(hash) if !kept.contains(&hash) => {
                    (done.objects, done.bytes) = (done.objects + 1, done.bytes + bytes);
                    garbage.push(key);
                }
                _ => done.kept += 1,
            }
        }
    }
    for (store, garbage) in stores.iter().zip(&garbage) {
        store.delete(garbage).await?;
    }
    Ok((done, left))
}
