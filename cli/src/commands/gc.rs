//! `rayherd gc`: deletes what nothing names.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::Context;
use clap::Args;
use rayherd_herd::local::{Collected, collect};
use rayherd_herd::scenes;
use rayherd_herd::store::{BlockStore, object_key, promised_hash};
use rayherd_scene::objects::DirectoryObjects;

use super::{print, size};
use crate::fault::Mistake;
use crate::store::{JOBS, S3Options, Store};

/// Delete what nothing in a store names: losing attempts, consumed rays, half-written files
///
/// Objects of no scene go too. A job that is being written is refused. Do not prepare a scene into the store at the same time: its objects have no
/// name until it is complete. The storage of a cluster lies on several servers, of which each may hold what another names: name all of them.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  rayherd gc results\n  rayherd gc s3://bucket/renders --s3-endpoint http://localhost:9000\n  \
    rayherd gc s3://rayherd --s3-endpoint http://localhost:9000 --server http://localhost:9001 --server http://localhost:9002"
)]
pub struct Arguments {
    /// A folder, or s3://bucket/prefix
    store: String,
    #[command(flatten)]
    s3: S3Options,
    /// Another server of the same storage, beside that of --s3-endpoint; repeatable
    #[arg(long, value_name = "URL", requires = "s3_endpoint")]
    server: Vec<String>,
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
    let first = Store::existing(place, &arguments.s3)?;
    let others = arguments
        .server
        .iter()
        .map(|url| Store::existing(place, &S3Options::at(url)))
        .collect::<Result<Vec<_>, _>>()?;
    let all: Vec<&Store> = std::iter::once(&first).chain(&others).collect();
    let stores: Vec<Arc<dyn BlockStore>> = all.iter().map(|s| s.blocks.clone()).collect();
    let jobs = all.iter().map(|store| jobs(store)).collect::<Result<Vec<_>, _>>()?;
    // a first preparing that was killed leaves objects without a name
    let has_objects = |store: &Store| -> anyhow::Result<bool> {
        let is_object = |key: &str| promised_hash(key).is_some_and(|hash| object_key(&hash) == key);
        Ok(store.wait(store.blocks.list("objects/"))?.iter().any(|(key, _)| is_object(key)))
    };
    if jobs.iter().all(BTreeSet::is_empty) && first.wait(scenes::find(&stores))?.all.is_empty() {
        let mut any = false;
        for store in &all {
            any |= has_objects(store)?;
        }
        if !any {
            return Err(nothing().into());
        }
    }
    let mut total = Collected::default();
    let mut add = |done: Collected| {
        total.objects += done.objects;
        total.bytes += done.bytes;
        total.kept += done.kept;
    };
    for (store, jobs) in all.iter().zip(jobs) {
        for job in jobs {
            add(store.wait(collect(store.part(&job)?)).with_context(|| format!("cannot collect {job}"))?);
        }
    }
    let told = || format!("cannot collect the scenes of {place} (--server names further servers)");
    add(first.wait(scenes::collect(&stores)).with_context(told)?);
    if !place.starts_with("s3://") {
        let (files, bytes) = DirectoryObjects::open(place)?.remove_unfinished()?;
        total.objects += files;
        total.bytes += bytes;
    }
    let Collected { objects, bytes, kept } = total;
    print(&format!("{}: {objects} objects deleted, {}; {kept} kept\n", arguments.store, size(bytes)))?;
    Ok(ExitCode::SUCCESS)
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
