//! Preparing a scene that lies in the storage, and putting its blocks on the nodes where they belong.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, UNIX_EPOCH};

use rayherd_api::RenderJobSpec;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::objects::{DirectoryObjects, ObjectError, ObjectKind, ObjectRef, ObjectStore};
use rayherd_scene::prepare::{self, NoProgress, Outcome, SpoolSettings, draft, prepare};
use tokio::runtime::Handle;

use super::Depot;
use super::blocks;
use super::homes::Homes;
use super::message::{Apart, Done};
use super::traffic::Traffic;
use crate::job::spec::{import_options, prepare_settings};
use crate::job::{JobError, PreparedScene};
use crate::report::Kind;
use crate::store::{BlockStore, NodeView, SceneObjects, StoreError, check_key, object_key};

/// Prepares the scene of a checked job, unless it is prepared. With `apart` the blocks of a large one are left to others: then what they are
/// built of lies where they are to lie.
///
/// `scratch` holds the source and the prepared objects on their way; what is left in it is deleted.
pub fn prepare_scene(
    (depot, runtime, traffic): (&Depot, &Handle, &Traffic),
    spec: &RenderJobSpec,
    replicas: u32,
    apart: Option<&Apart>,
    scratch: &Path,
) -> Result<Done, JobError> {
    let stores = |kind| traffic.stores(depot, replicas, kind, None);
    let store = stores(Kind::Manifest)?;
    let folder = scratch.join("source");
    // one copy: reading must not make more of what is not ours
    let from = traffic.stores(depot, 1, Kind::Source, None)?;
    let source = download(&from, runtime, &spec.scene.source, &folder)?;
    drop(from);
    let settings = |e: &dyn std::fmt::Display| JobError::Settings(e.to_string());
    let description = import(&source, &import_options(spec)).map_err(|e| settings(&e))?;
    let records = DescriptionSource::new(&description, StreamOptions::default());
    let built = scratch.join("objects");
    let staged = Arc::new(Staged {
        built: DirectoryObjects::open(&built)?,
        stored: SceneObjects::new(Arc::new(NodeView::clone(&store)), runtime.clone())?,
        name: Mutex::default(),
    });
    let spool = SpoolSettings { folder: Some(scratch.to_owned()), ..SpoolSettings::default() };
    let keep = |packed: &[u8]| staged.built.put(ObjectKind::Geometry, &blocks::sealed(packed));
    let how = prepare_settings(spec);
    let outcome = match apart {
        Some(apart) => {
            let apart = prepare::Apart { least: apart.least, keep: &keep };
            draft(&description, &records, &how, &spool, (staged.as_ref(), &apart), &NoProgress)
        }
        None => prepare(&description, &records, &how, &spool, staged.as_ref(), &NoProgress).map(Outcome::from),
    };
    let (manifest, mut reference, reused, drafted) = match outcome.map_err(|e| JobError::Scene(e.to_string()))? {
        Outcome::Prepared(p) => (p.manifest, p.reference, p.reused, None),
        Outcome::Draft(draft) => {
            let reference = draft.reference();
            (*draft, reference, false, apart)
        }
    };
    let mut made = None;
    if !reused {
        // as many homes as there are to be workers
        let workers = spec.workers.slots_per_node(1).map_or(1, |slots| slots.len() as u32);
        let mut scene = PreparedScene::open(manifest, staged.clone())?;
        scene.manifest.homes = Homes::chosen(&scene, depot.len(), workers, depot.home());
        let homes = Homes::of(&scene, depot.len(), replicas);
        let put = |on: &[u32], to: &NodeView, key: &str, object: &ObjectRef| -> Result<(), JobError> {
            let on: Vec<usize> = on.iter().map(|&n| n as usize).collect();
            let body = staged.built.get(object)?;
            Ok(runtime.block_on(to.put_on(&on, key, body.into()))?)
        };
        let object = |on: &[u32], to: &NodeView, object: &ObjectRef| put(on, to, &object_key(&object.hash), object);
        let geometry = stores(if drafted.is_some() { Kind::Spool } else { Kind::Geometry })?;
        let (attributes, texture) = (stores(Kind::Attributes)?, stores(Kind::Texture)?);
        let m = &scene.manifest;
        for (split, on) in m.splits.iter().zip(homes.splits()) {
            match drafted {
                Some(apart) => put(on, &geometry, &blocks::key(&apart.prefix, &split.geometry), &split.geometry)?,
                None => object(on, &geometry, &split.geometry)?,
            }
            object(on, &attributes, &split.attributes)?;
        }
        for (number, tile) in (0..).zip(&m.tiles) {
            object(&homes.tile(number), &texture, tile)?;
        }
        object(&[], &store, &m.world)?;
        if let Some(map) = &m.sky_map {
            object(&[], &texture, map)?;
        }
        reference = m.reference();
        made = Some(m.encode());
    }
    if let (Some(apart), Some(body)) = (drafted, &made) {
        runtime.block_on(store.put(&blocks::key(&apart.prefix, &reference), body.clone().into()))?;
    } else if made.is_some() || staged.built.has(&reference)? {
        // a new one, or the same scene for another picture
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
    let cells_passed = records.cells_passed();
    Ok(match drafted {
        Some(_) => Done::Drafted { draft: reference, cells_passed },
        None => Done::Prepared { scene: reference, reused, cells_passed },
    })
}

/// What the keys of all files begin with that a source may need.
pub fn prefix(source: &str) -> Result<String, StoreError> {
    check_key(source)?;
    Ok(source.rsplit_once('/').map_or_else(|| source.to_owned(), |(parent, _)| format!("{parent}/")))
}

/// Whether such a key is one of the source's files: those that a scene file names lie beside or below it; a folder is a scene by itself.
pub fn belongs(source: &str, is_file: bool, key: &str) -> bool {
    is_file || key.strip_prefix(source).is_some_and(|rest| rest.starts_with('/'))
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
    let prefix = prefix(source).map_err(|e| wrong(&format!("on a cluster it is a key in the job's storage ({e})")))?;
    let listed = runtime.block_on(store.list(&prefix))?;
    let below = format!("{source}/");
    let is_file = listed.iter().any(|(key, _)| key == source);
    if !is_file && !listed.iter().any(|(key, _)| key.starts_with(&below)) {
        return Err(wrong(&format!("{} has no such object: upload the scene first", store.describe())));
    }
    for (key, _) in listed.into_iter().filter(|(key, _)| belongs(source, is_file, key)) {
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
