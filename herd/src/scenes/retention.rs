//! Scenes that nobody has used for long go.
//!
//! In this order: the names, so that nobody finds it any more; the manifest, without which a job prepares it again; then its mark is looked
//! at once more, and if somebody has used it meanwhile manifest and names are put back; then the objects that no other scene has; the mark
//! last. What ends between is gone on with: the manifest lies aside (`going/`) until the objects are deleted.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use bytes::Bytes;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{ObjectHash, ObjectRef};

use super::{GOING, MARKS, Scene, Scenes, Stores, find, is_unreadable, manifest, mark};
use crate::job::JobError;
use crate::store::{StoreError, object_key};

/// Objects that are deleted at a time.
const BATCH: usize = 1000;

/// What may go.
pub struct Rules<'u> {
    /// The time, seconds since 1970.
    pub now: u64,
    /// How long a scene stays that nobody uses.
    pub keep: Duration,
    /// Scenes that are used now, whatever their marks say, by the hashes of their manifests: their marks are renewed.
    pub used: &'u BTreeSet<ObjectHash>,
}

impl Rules<'_> {
    fn is_due(&self, hash: &ObjectHash, scene: &Scene) -> bool {
        let unused = |used: u64| self.now.saturating_sub(used) >= self.keep.as_secs();
        !self.used.contains(hash) && scene.used.is_some_and(unused)
    }
}

/// What went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Swept {
    /// Scenes.
    pub scenes: u64,
    /// Objects that were theirs alone, copies not counted.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// Marks the scenes that are used, and those that nobody has marked yet, and deletes those whose marks are too old. `alone` is asked before
/// each: nobody may look for a scene or prepare one as long as what it returns lives; when it returns none, the rest stays for another time.
///
/// # Errors
/// When a store does not answer, or something cannot be read on which it depends what may go. What was begun is gone on with next time.
pub async fn sweep<G>(stores: Stores<'_>, rules: &Rules<'_>, alone: impl Fn() -> Option<G>) -> Result<Swept, JobError> {
    let found = find(stores).await?;
    for hash in rules.used {
        if found.all.contains_key(hash) || is_there(stores, hash).await? {
            mark(stores, hash, rules.now).await?;
        }
    }
    for (hash, _) in found.all.iter().filter(|(hash, s)| s.used.is_none() && !rules.used.contains(*hash)) {
        mark(stores, hash, rules.now).await?;
    }
    let due: BTreeSet<ObjectHash> = found.all.iter().filter(|(h, s)| rules.is_due(h, s)).map(|(h, _)| *h).collect();
    let mut sweeper = Sweeper { stores, rules, scenes: BTreeMap::new(), swept: Swept::default() };
    for hash in due.union(&found.going) {
        let Some(_alone) = alone() else { break };
        sweeper.remove(hash).await?;
    }
    Ok(sweeper.swept)
}

async fn is_there(stores: Stores<'_>, hash: &ObjectHash) -> Result<bool, StoreError> {
    Ok(!holders(stores, hash).await?.is_empty())
}

/// The stores that have a manifest.
async fn holders(stores: Stores<'_>, hash: &ObjectHash) -> Result<Vec<usize>, StoreError> {
    let mut holders = Vec::new();
    for (number, store) in stores.iter().enumerate() {
        if store.size(&object_key(hash)).await?.is_some() {
            holders.push(number);
        }
    }
    Ok(holders)
}

/// Each object of a scene once.
fn objects(manifest: &Manifest) -> BTreeSet<ObjectRef> {
    manifest.objects().copied().collect()
}

struct Sweeper<'s> {
    stores: Stores<'s>,
    rules: &'s Rules<'s>,
    /// Scenes that have been read, with their objects.
    scenes: BTreeMap<ObjectHash, BTreeSet<ObjectHash>>,
    swept: Swept,
}

impl Sweeper<'_> {
    /// Reads the scenes that were not read yet.
    async fn follow(&mut self, found: &Scenes) -> Result<(), JobError> {
        self.scenes.retain(|hash, _| found.all.contains_key(hash));
        for (hash, scene) in &found.all {
            if self.scenes.contains_key(hash) {
                continue;
            }
            let theirs = match manifest(self.stores, hash).await {
                Ok(Some((manifest, _))) => objects(&manifest).into_iter().map(|o| o.hash).collect(),
                Ok(None) => BTreeSet::new(),
                Err(e) if is_unreadable(&e) && self.rules.is_due(hash, scene) => BTreeSet::new(),
                Err(e) => return Err(e),
            };
            self.scenes.insert(*hash, theirs);
        }
        Ok(())
    }

    async fn everywhere(&self, keys: &[String]) -> Result<(), StoreError> {
        for store in self.stores {
            store.delete(keys).await?;
        }
        Ok(())
    }

    /// Deletes a scene that is due, or what is left of it.
    async fn remove(&mut self, hash: &ObjectHash) -> Result<(), JobError> {
        let found = find(self.stores).await?;
        let aside = format!("{GOING}{hash}");
        // it was looked for before nobody else did
        let due = found.all.get(hash).is_none_or(|s| self.rules.is_due(hash, s));
        let holders = holders(self.stores, hash).await?;
        if !due {
            // used again; prepared again, if it had gone
            if found.going.contains(hash) && !holders.is_empty() {
                self.everywhere(&[aside]).await?;
            }
            return Ok(());
        }
        self.follow(&found).await?;
        let read = match manifest(self.stores, hash).await {
            Err(e) if is_unreadable(&e) => {
                tracing::warn!("{e}: the scene is forgotten, its objects stay until rayherd gc is run");
                None
            }
            read => read?,
        };
        let names = found.all.get(hash).map(|s| s.names.clone()).unwrap_or_default();
        let mut forgotten = Vec::new();
        for (number, key) in names {
            // it may point to another scene by now
            let store = self.stores[number].as_ref();
            if super::small::<ObjectRef>(store, &key).await?.is_some_and(|o| o.hash == *hash) {
                let body = store.get(&key).await?;
                store.delete(std::slice::from_ref(&key)).await?;
                forgotten.push((number, key, body));
            }
        }
        if let Some((_, body)) = &read {
            for store in self.stores {
                store.put(&aside, body.clone()).await?;
            }
        }
        self.everywhere(&[object_key(hash)]).await?;
        let now = find(self.stores).await?;
        if now.all.get(hash).is_some_and(|s| !self.rules.is_due(hash, s)) {
            return self.put_back(hash, read.map(|r| r.1), &holders, &forgotten).await;
        }
        self.follow(&now).await?;
        let theirs = match read {
            Some((manifest, _)) => objects(&manifest),
            None => self.aside(&aside).await?,
        };
        let others: Vec<&BTreeSet<ObjectHash>> =
            self.scenes.iter().filter(|(other, _)| *other != hash).map(|(_, o)| o).collect();
        let alone: Vec<ObjectRef> =
            theirs.into_iter().filter(|o| !others.iter().any(|objects| objects.contains(&o.hash))).collect();
        for batch in alone.chunks(BATCH) {
            let keys: Vec<String> = batch.iter().map(|o| object_key(&o.hash)).collect();
            self.everywhere(&keys).await?;
            self.swept.objects += batch.len() as u64;
            self.swept.bytes += batch.iter().map(|o| o.bytes).sum::<u64>();
        }
        self.everywhere(&[format!("{MARKS}{hash}"), aside]).await?;
        self.scenes.remove(hash);
        self.swept.scenes += 1;
        Ok(())
    }

    /// The objects of a scene whose manifest is deleted already.
    async fn aside(&self, key: &str) -> Result<BTreeSet<ObjectRef>, JobError> {
        for store in self.stores {
            match store.get(key).await {
                Ok(body) => match Manifest::decode(&body) {
                    Ok(manifest) => return Ok(objects(&manifest)),
                    Err(e) => tracing::warn!("{}: {key}: {e}", store.describe()),
                },
                Err(StoreError::NotFound { .. }) => {}
                Err(e) => return Err(e.into()),
            }
        }
        Ok(BTreeSet::new())
    }

    /// Somebody has used it meanwhile: it stays, where it was.
    async fn put_back(
        &self,
        hash: &ObjectHash,
        body: Option<Bytes>,
        holders: &[usize],
        names: &[(usize, String, Bytes)],
    ) -> Result<(), JobError> {
        if let Some(body) = body {
            for &number in holders {
                self.stores[number].put(&object_key(hash), body.clone()).await?;
            }
        }
        for (number, key, body) in names {
            // unless it was prepared again
            if self.stores[*number].size(key).await?.is_none() {
                self.stores[*number].put(key, body.clone()).await?;
            }
        }
        Ok(self.everywhere(&[format!("{GOING}{hash}")]).await?)
    }
}
