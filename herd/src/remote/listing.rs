//! A source as its stores list it: enough to find the scene that was prepared from it without reading it.
//!
//! Its files' names, sizes and tags ([`Version`]) with all that decides what is prepared of them make a name, which points to the manifest. A file
//! that changes in any way gets another tag, and the source another name; the same content under another tag is found by preparing, as
//! ever. (S3's tags are made with MD5: against chance and not against forgers. Who may write sources may write scenes as well.)
//!
//! The name is set by whoever had the scene prepared, if the source was listed alike before and after: then it is what was read.

use std::collections::BTreeMap;

use futures::{StreamExt, stream};
use rayherd_api::RenderJobSpec;
use rayherd_scene::manifest::{FORMAT, Manifest};
use rayherd_scene::objects::{ObjectRef, ObjectStore};
use serde_json::json;

use super::frames::Job;
use super::prepare::{belongs, prefix};
use crate::job::JobError;
use crate::job::spec::prepare_settings;
use crate::store::{BlockStore, SceneObjects, Version, object_key};

/// Objects that are asked for at one time.
const ASKED: usize = 64;

/// The files of a source, by store.
#[derive(Debug, PartialEq)]
pub struct Listing {
    stores: Vec<Vec<Version>>,
}

impl Listing {
    /// What all stores list of a job's source; none where one of them does not answer or knows no tags, or where there is no such source.
    pub fn of(job: &Job) -> Option<Self> {
        let source = job.spec.scene.source.trim_end_matches('/');
        let prefix = prefix(source).ok()?;
        let listed = job.depot.stores().iter().map(|s| s.list_versions(&prefix));
        let listed = job.runtime.block_on(futures::future::join_all(listed));
        let mut stores = listed
            .into_iter()
            .map(|listed| listed.inspect_err(|e| tracing::debug!("{e}")).ok().flatten())
            .collect::<Option<Vec<_>>>()?;
        let is_file = stores.iter().flatten().any(|v| v.key == source);
        stores.iter_mut().for_each(|s| s.retain(|v| belongs(source, is_file, &v.key)));
        stores.iter().any(|s| !s.is_empty()).then_some(Listing { stores })
    }

    /// Bytes of it by store.
    pub fn bytes(&self) -> Vec<u64> {
        self.stores.iter().map(|s| s.iter().map(|v| v.bytes).sum()).collect()
    }

    /// Stores that hold most of it.
    pub fn holders(&self) -> Vec<u32> {
        let bytes = self.bytes();
        let most = bytes.iter().copied().max().unwrap_or(0);
        (0..).zip(bytes).filter(|&(_, b)| most > 0 && b == most).map(|(n, _)| n).collect()
    }

    /// The name of a scene that is prepared from it as a job wants; none where two stores hold different files under one name.
    pub fn name(&self, spec: &RenderJobSpec) -> Option<String> {
        let mut files: BTreeMap<&str, (u64, &str)> = BTreeMap::new();
        for v in self.stores.iter().flatten() {
            let file = (v.bytes, v.tag.as_str());
            if *files.entry(&v.key).or_insert(file) != file {
                return None;
            }
        }
        // an importer of another version may make something else of a file
        let how = json!({
            "format": FORMAT,
            "version": env!("CARGO_PKG_VERSION"),
            "scene": spec.scene,
            "size": spec.image.size,
            "settings": prepare_settings(spec),
            "files": files,
        });
        Some(format!("source-{}", blake3::hash(how.to_string().as_bytes()).to_hex()))
    }
}

/// The scene that a name points to, if all of it is there; else it is looked for, and prepared, as if there were no name.
pub fn find(job: &Job, replicas: u32, name: &str) -> Option<ObjectRef> {
    let look = || -> Result<Option<ObjectRef>, JobError> {
        let store = job.depot.replicated(replicas)?;
        let objects = SceneObjects::new(std::sync::Arc::new(store.clone()), job.runtime.clone())?;
        let Some(reference) = objects.name(name)? else { return Ok(None) };
        let manifest = Manifest::load(&objects, &reference)?;
        let sizes = stream::iter(manifest.objects().copied().collect::<Vec<_>>()).map(|object| {
            let store = &store;
            async move { store.size(&object_key(&object.hash)).await.map(|size| size == Some(object.bytes)) }
        });
        let there = job.runtime.block_on(sizes.buffer_unordered(ASKED).collect::<Vec<_>>());
        for there in there {
            if !there? {
                tracing::warn!("of the scene that {name} points to something is gone: it is prepared again");
                return Ok(None);
            }
        }
        Ok(Some(reference))
    };
    look().unwrap_or_else(|e| {
        tracing::warn!("the scene that {name} points to cannot be used: {e}");
        None
    })
}

/// Lets a name point to a scene. Without it the next job asks a worker.
pub fn set(job: &Job, replicas: u32, name: &str, scene: &ObjectRef) {
    let done = job.depot.replicated(replicas).map_err(JobError::from).and_then(|store| {
        let objects = SceneObjects::new(std::sync::Arc::new(store), job.runtime.clone())?;
        Ok(objects.set_name(name, scene)?)
    });
    if let Err(e) = done {
        tracing::warn!("{e}");
    }
}
