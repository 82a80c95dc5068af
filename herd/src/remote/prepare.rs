//! Preparing a scene that lies in the storage, and putting its blocks on the nodes where they belong.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, UNIX_EPOCH};

use rayherd_api::RenderJobSpec;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::objects::{DirectoryObjects, ObjectError, ObjectKind, ObjectRef, ObjectStore};
use rayherd_scene::prepare::{NoProgress, SpoolSettings, prepare};
use tokio::runtime::Handle;

use super::Depot;
use super::homes::Homes;
use crate::job::spec::{import_options, prepare_settings};
use crate::job::{JobError, PreparedScene};
use crate::store::{BlockStore, NodeView, SceneObjects, check_key, object_key};

/// Prepares the scene of a checked job, unless it is prepared; its manifest, whether it was there, and cells of volumes that were not
/// looked into.
///
/// `scratch` holds the source and the prepared objects on their way; what is left in it is deleted.
pub fn prepare_scene(
    depot: &Depot,
    runtime: &Handle,
    spec: &RenderJobSpec,
    replicas: u32,
    scratch: &Path,
) -> Result<(ObjectRef, bool, u64), JobError> {
    let store = depot.replicated(replicas)?;
    let folder = scratch.join("source");
    // one copy: reading must not make more of what is not ours
    let source = download(&depot.replicated(1)?, runtime, &spec.scene.source, &folder)?;
    let settings = |e: &dyn std::fmt::Display| JobError::Settings(e.to_string());
    let description = import(&source, &import_options(spec)).map_err(|e| settings(&e))?;
    let records = DescriptionSource::new(&description, StreamOptions::default());
    let built = scratch.join("objects");
    let staged = Arc::new(Staged {
        built: DirectoryObjects::open(&built)?,
        stored: SceneObjects::new(Arc::new(store.clone()), runtime.clone())?,
        name: Mutex::default(),
    });
    let spool = SpoolSettings { folder: Some(scratch.to_owned()), ..SpoolSettings::default() };
    let prepared = prepare(&description, &records, &prepare_settings(spec), &spool, staged.as_ref(), &NoProgress)
        .map_err(|e| JobError::Scene(e.to_string()))?;
    let mut reference = prepared.reference;
    let mut made = None;
    if !prepared.reused {
        // as many homes as there are to be workers
        let workers = spec.workers.slots_per_node(1).map_or(1, |slots| slots.len() as u32);
        let mut scene = PreparedScene::open(prepared.manifest.clone(), staged.clone())?;
        scene.manifest.homes = Homes::chosen(&scene, depot.len(), workers, depot.home());
        let homes = Homes::of(&scene, depot.len(), replicas);
        let put = |on: &[usize], object: &ObjectRef| -> Result<(), JobError> {
            let body = staged.built.get(object)?;
            Ok(runtime.block_on(store.put_on(on, &object_key(&object.hash), body.into()))?)
        };
        for (split, on) in prepared.manifest.splits.iter().zip(homes.splits()) {
            let on: Vec<usize> = on.iter().map(|&n| n as usize).collect();
            put(&on, &split.geometry)?;
            put(&on, &split.attributes)?;
        }
        for (number, tile) in (0..).zip(&prepared.manifest.tiles) {
            let on: Vec<usize> = homes.tile(number).into_iter().map(|n| n as usize).collect();
            put(&on, tile)?;
        }
        put(&[], &prepared.manifest.world)?;
        if let Some(map) = &prepared.manifest.sky_map {
            put(&[], map)?;
        }
        reference = scene.manifest.reference();
        made = Some(scene.manifest.encode());
    }
    // a new one, or the same scene for another picture
    if made.is_some() || staged.built.has(&reference)? {
        let body = made.map_or_else(|| staged.built.get(&reference), Ok)?;
        runtime.block_on(store.put(&object_key(&reference.hash), body.into()))?;
        // last: whoever finds the name finds everything that it names
        if let Some((name, _)) = staged.name.lock().unwrap_or_else(PoisonError::into_inner).take() {
            staged.stored.set_name(&name, &reference)?;
        }
    }
    drop(staged);
    for folder in [folder, built] {
        let io = |e| JobError::Settings(format!("cannot clean {}: {e}", folder.display()));
        fs::remove_dir_all(&folder).map_err(io)?;
    }
    Ok((reference, prepared.reused, records.cells_passed()))
}

/// Copies the source and what lies beside it from the storage; where it is now.
///
/// A file's time is made from its content, so that the scene's fingerprint (paths, sizes, times) sees contents, on every
/// machine alike.
///
/// # Errors
/// When there is no such source, or it cannot be read or written down.
pub fn download(store: &NodeView, runtime: &Handle, source: &str, folder: &Path) -> Result<PathBuf, JobError> {
    let source = source.trim_end_matches('/');
    let wrong = |why: &str| JobError::Settings(format!("spec.scene.source is {source:?}: {why}"));
    check_key(source).map_err(|e| wrong(&format!("on a cluster it is a key in the job's storage ({e})")))?;
    let parent = source.rsplit_once('/').map(|(parent, _)| parent);
    let prefix = parent.map_or_else(|| source.to_owned(), |p| format!("{p}/"));
    let listed = runtime.block_on(store.list(&prefix))?;
    let below = format!("{source}/");
    let is_file = listed.iter().any(|(key, _)| key == source);
    if !is_file && !listed.iter().any(|(key, _)| key.starts_with(&below)) {
        return Err(wrong(&format!("{} has no such object: upload the scene first", store.describe())));
    }
    // files that a scene file names lie beside or below it; a folder is a scene by itself
    let wanted = listed.into_iter().filter(|(key, _)| if is_file { true } else { key.starts_with(&below) });
    for (key, _) in wanted {
        let path = folder.join(&key);
        let io = |e: std::io::Error| JobError::Settings(format!("cannot write {}: {e}", path.display()));
        fs::create_dir_all(path.parent().unwrap_or(folder)).map_err(io)?;
        // never whole in memory: a file may be larger than what a pod may take
        runtime.block_on(store.get_file(&key, &path))?;
        let file = File::options().read(true).append(true).open(&path).map_err(io)?;
        let hash = blake3::Hasher::new().update_reader(&file).map_err(io)?.finalize();
        let word = |i: usize| u32::from_le_bytes(std::array::from_fn(|k| hash.as_bytes()[i + k]));
        let time = Duration::new(u64::from(word(0) >> 1), word(4) % 1_000_000_000);
        file.set_modified(UNIX_EPOCH + time).map_err(io)?;
    }
    Ok(folder.join(source))
}

/// What is built lies in a folder until it is known where it belongs.
struct Staged {
    built: DirectoryObjects,
    stored: SceneObjects,
    name: Mutex<Option<(String, ObjectRef)>>,
}

impl ObjectStore for Staged {
    fn put(&self, kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        self.built.put(kind, bytes)
    }
    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        if self.built.has(object)? { self.built.get(object) } else { self.stored.get(object) }
    }
    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        Ok(self.built.has(object)? || self.stored.has(object)?)
    }
    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        *self.name.lock().unwrap_or_else(PoisonError::into_inner) = Some((name.to_owned(), *object));
        Ok(())
    }
    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        self.stored.name(name)
    }
    fn names(&self) -> Result<Vec<String>, ObjectError> {
        self.stored.names()
    }
}
