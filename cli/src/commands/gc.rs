//! `rayherd gc`: deletes what nothing names.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use rayherd_herd::local::{Collected, collect};
use rayherd_herd::store::object_key;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{DirectoryObjects, ObjectHash};

use super::{print, size};
use crate::fault::Mistake;
use crate::store::{JOBS, S3Options, Store};

/// Delete what nothing in a store names: losing attempts, consumed rays, half-written files
///
/// Objects of no scene go too. A job that is being written is refused. Do not prepare a scene into the store at the same time: its objects have no
/// name until it is complete.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  rayherd gc results\n  rayherd gc s3://bucket/renders --s3-endpoint http://localhost:9000"
)]
pub struct Arguments {
    /// A folder, or s3://bucket/prefix
    store: String,
    #[command(flatten)]
    s3: S3Options,
}

/// Collects jobs first, then objects.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let place = &arguments.store;
    let nothing = || Mistake(format!("{place} holds nothing of Rayherd's, so nothing of it is deleted: name a store"));
    // a folder that is no store must not become one by looking
    let folder = Path::new(place);
    let holds = |name: &str| folder.join(name).is_dir();
    if !place.starts_with("s3://") && folder.is_dir() && !["names", "objects", JOBS].into_iter().any(holds) {
        return Err(nothing().into());
    }
    let store = Store::existing(place, &arguments.s3)?;
    let jobs = jobs(&store)?;
    // a first preparing that was killed leaves objects without a name
    let has_objects = || -> anyhow::Result<bool> {
        Ok(store.wait(store.blocks.list("objects/"))?.iter().any(|(key, _)| is_object_key(key)))
    };
    if jobs.is_empty() && !store.objects.names()?.iter().any(|n| n.starts_with("scene-")) && !has_objects()? {
        return Err(nothing().into());
    }
    let mut total = Collected::default();
    for job in jobs {
        let done = store.wait(collect(store.part(&job)?)).with_context(|| format!("cannot collect {job}"))?;
        total.objects += done.objects;
        total.bytes += done.bytes;
        total.kept += done.kept;
    }
    let named = named(&store)?;
    let mut garbage = Vec::new();
    for (key, bytes) in store.wait(store.blocks.list("objects/"))? {
        if named.contains(&key) || !is_object_key(&key) {
            total.kept += 1;
        } else {
            total.objects += 1;
            total.bytes += bytes;
            garbage.push(key);
        }
    }
    store.wait(store.blocks.delete(&garbage))?;
    if !place.starts_with("s3://") {
        let (files, bytes) = DirectoryObjects::open(place)?.remove_unfinished()?;
        total.objects += files;
        total.bytes += bytes;
    }
    let Collected { objects, bytes, kept } = total;
    print(&format!("{}: {objects} objects deleted, {}; {kept} kept\n", arguments.store, size(bytes)))?;
    Ok(ExitCode::SUCCESS)
}

/// Whether a key is one that an object of ours has, by its form: `objects/ab/abcd..`, 64 digits.
fn is_object_key(key: &str) -> bool {
    let hex = key.rsplit('/').next().unwrap_or_default();
    hex.parse().is_ok_and(|hash: ObjectHash| object_key(&hash) == key)
}

/// Prefixes of the jobs: what has records, or the owner that a first one is about to have.
fn jobs(store: &Store) -> anyhow::Result<BTreeSet<String>> {
    let keys = store.wait(store.blocks.list(JOBS))?;
    let job = |key: &str| {
        let (job, rest) = key[JOBS.len()..].split_once('/')?;
        (rest == "owner" || rest.starts_with("records/")).then(|| format!("{JOBS}{job}"))
    };
    Ok(keys.iter().filter_map(|(key, _)| job(key)).collect())
}

/// Keys of all objects that belong to a prepared scene with a name.
fn named(store: &Store) -> anyhow::Result<BTreeSet<String>> {
    let mut keys = BTreeSet::new();
    for name in store.objects.names()? {
        let Some(object) = store.objects.name(&name)? else { continue };
        keys.insert(object_key(&object.hash));
        // one that cannot be read must not cost the objects of which it is the only list
        let manifest = Manifest::load(store.objects.as_ref(), &object);
        let manifest = manifest.with_context(|| format!("{name}: delete this name to give the scene up"))?;
        keys.extend(manifest.objects().map(|o| object_key(&o.hash)));
    }
    Ok(keys)
}
