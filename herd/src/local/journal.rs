//! The chain of round records in a store: written before a commit counts, read to go on.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use rayherd_render::film::FilmPart;

use super::nodes::Nodes;
use super::owner::Ownership;
use crate::job::JobError;
use crate::ledger::{Chain, ChainError, FilmRef, Ledger, Record, Snapshot, newest};
use crate::report::{Kind as ByteKind, Op, Place, Stage};
use crate::store::{BlockStore, StoreError};
use crate::task::codec;
use crate::wire::envelope::{Compress, Kind, WireError, open, seal};

const RECORDS: &str = "records/";
/// Largest record that is read: a snapshot of a large job holds a line for each group and tile.
const RECORD_LIMIT: usize = 1 << 30;
/// Largest ray group that is read: its number of rays is bounded by the format.
const GROUP_LIMIT: usize = 1 << 27;

/// What a store held.
pub struct Resumed {
    /// The state.
    pub ledger: Ledger,
    /// Sum of all committed film parts.
    pub film: FilmPart,
    /// The last state without rays on their way; rays that are lost later lead back to it.
    pub settled: (Snapshot, FilmPart),
    /// Commits taken over.
    pub reused: u64,
    /// Commits whose outputs are lost: to be computed again.
    pub lost: u64,
}

/// Key of a record: its place first, so that a listing is in order.
pub fn key(sequence: u64, name: &str) -> String {
    format!("{RECORDS}{sequence:010}-{name}")
}

/// Stores a record; its name, the hash of its body.
pub fn write(nodes: &Nodes, record: &Record) -> Result<String, JobError> {
    let json = serde_json::to_vec(record).map_err(|e| JobError::Internal(e.to_string()))?;
    let body = seal(Kind::RoundRecord, &json, Compress::Lz4);
    let name = blake3::hash(&body).to_hex().to_string();
    nodes.count(Stage::Trace, Op::Write, ByteKind::Film, 0, Place::Local, body.len() as u64);
    nodes.wait(nodes.store().put(&key(record.sequence, &name), body))?;
    Ok(name)
}

/// All whole records of a store. Those that are corrupt are named and left out.
///
/// # Errors
/// A record is whole but not for this program (another version), or there are records and none of them is whole: what they say must not be
/// taken for nothing.
pub async fn read(store: &dyn BlockStore) -> Result<BTreeMap<String, Record>, JobError> {
    let mut records = BTreeMap::new();
    let mut broken = 0;
    for (key, _) in store.list(RECORDS).await? {
        let body = match store.get(&key).await {
            Ok(body) => body,
            Err(e @ (StoreError::NotFound { .. } | StoreError::Corrupt { .. })) => {
                tracing::warn!("{e}");
                broken += 1;
                continue;
            }
            Err(e) => return Err(e.into()),
        };
        match record(&key, &body) {
            Ok((name, record)) => {
                records.insert(name, record);
            }
            Err(WireError::Corrupt(message)) => {
                tracing::warn!("{}: {key} is corrupt and left out: {message}", store.describe());
                broken += 1;
            }
            Err(source) => return Err(JobError::Wire { key: format!("{}: {key}", store.describe()), source }),
        }
    }
    if records.is_empty() && broken > 0 {
        return Err(ChainError::Unreadable { store: store.describe(), records: broken }.into());
    }
    Ok(records)
}

fn record(key: &str, body: &Bytes) -> Result<(String, Record), WireError> {
    let json = open(Kind::RoundRecord, body, RECORD_LIMIT)?;
    let name = blake3::hash(body).to_hex().to_string();
    if !key.ends_with(&name) {
        return Err(WireError::corrupt("its name is not its hash"));
    }
    Ok((name, serde_json::from_slice(&json).map_err(|e| WireError::corrupt(e.to_string()))?))
}

/// The state to go on from.
pub fn resume(nodes: &Nodes, image: &str, tiles: u32, size: [u32; 2]) -> Result<Resumed, JobError> {
    let chain = newest(image, nodes.wait(read(nodes.store().as_ref()))?)?;
    for fork in &chain.forks {
        tracing::warn!(
            "two writers were at work: record {} has {} children; {} is followed",
            fork.parent,
            fork.children.len(),
            fork.children[0]
        );
    }
    let (mut ledger, mut film) = (Ledger::new(image, tiles), FilmPart::new(size));
    let mut settled = (ledger.snapshot(None), film.clone());
    let mut lost = None;
    for (name, record) in &chain.records {
        ledger.replay(record, name.clone())?;
        if lost.is_none() {
            let mut parts = record.made.film.iter().collect::<Vec<_>>();
            if let Some(snapshot) = &record.snapshot {
                film = FilmPart::new(size);
                parts = snapshot.film.iter().collect();
            }
            match parts.into_iter().try_for_each(|part| merge(nodes, &mut film, part, size)) {
                Ok(()) if ledger.is_settled() => settled = (ledger.snapshot(None), film.clone()),
                Ok(()) => {}
                Err(e @ JobError::Lost { .. }) => lost = Some(e),
                Err(e) => return Err(e),
            }
        }
    }
    if lost.is_none()
        && let Err(e) = whole(nodes, &ledger)
    {
        lost = Some(e);
    }
    let reused = ledger.commits();
    let Some(why) = lost else { return Ok(Resumed { ledger, film, settled, reused, lost: 0 }) };
    if !matches!(why, JobError::Lost { .. }) {
        return Err(why);
    }
    tracing::warn!("{why}; what was committed after the last state without it is computed again");
    let (mut snapshot, film) = settled;
    snapshot.film = store_film(nodes, &film, &format!("film/back-{}", ledger.commits()))?;
    let kept = snapshot.commits;
    let record = ledger.record_of(snapshot);
    let name = write(nodes, &record)?;
    ledger.go_back(&record, name)?;
    let settled = (ledger.snapshot(None), film.clone());
    Ok(Resumed { ledger, film, settled, reused: kept, lost: reused.saturating_sub(kept) })
}

/// Whether each group that waits has a whole copy.
fn whole(nodes: &Nodes, ledger: &Ledger) -> Result<(), JobError> {
    for group in ledger.waiting() {
        let open = |body: &Bytes| open(Kind::RayGroup, body, GROUP_LIMIT).map(|_| ());
        nodes.get(0, ByteKind::Rays, &group.key, &group.holders, open)?;
    }
    Ok(())
}

fn merge(nodes: &Nodes, film: &mut FilmPart, part: &FilmRef, size: [u32; 2]) -> Result<(), JobError> {
    let part = nodes.get(0, ByteKind::Film, &part.key, &part.holders, |body| codec::decode_film(size, body))?;
    Ok(film.merge(&part)?)
}

/// Stores a whole film under `prefix` and its hash: whoever names it means these bytes, whatever is stored later.
pub fn store_film(nodes: &Nodes, film: &FilmPart, prefix: &str) -> Result<Option<FilmRef>, JobError> {
    if film.touched() == 0 && film.rejected().count == 0 {
        return Ok(None);
    }
    let body = codec::encode_film(film);
    let bytes = body.len() as u64;
    let key = format!("{prefix}-{}", &blake3::hash(&body).to_hex()[..16]);
    let holders = nodes.put(0, ByteKind::Film, &key, body)?;
    Ok(Some(FilmRef { key, bytes, holders }))
}

/// What a collection deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Collected {
    /// Objects deleted.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Objects that stay.
    pub kept: u64,
}

/// Deletes what the newest chain of records does not name: losing attempts, consumed groups, older records.
///
/// # Errors
/// When somebody writes to the store, or no chain can be followed (then nothing is deleted).
pub async fn collect(store: Arc<dyn BlockStore>) -> Result<Collected, JobError> {
    if super::owner::is_owned(store.as_ref()).await? {
        return Err(JobError::Owned(format!("{}: a job is writing to it: wait for its end", store.describe())));
    }
    // nobody may begin to write between reading the records and deleting
    let owner = Ownership::take(store.clone(), false).await?;
    let collected = collect_owned(store.as_ref()).await;
    owner.give_back().await?;
    collected
}

async fn collect_owned(store: &dyn BlockStore) -> Result<Collected, JobError> {
    let records = read(store).await?;
    let image = records.values().next().map(|r| r.image.clone()).unwrap_or_default();
    let Chain { records, .. } = newest(&image, records)?;
    let tiles_of = |r: &Record| {
        let taken = r.took.camera.iter().map(|u| u.tile.saturating_add(1)).max();
        r.snapshot.as_ref().map(|s| s.done.tiles()).max(taken).unwrap_or(0)
    };
    let mut ledger = Ledger::new(&image, records.iter().map(|r| tiles_of(&r.1)).max().unwrap_or(0));
    let mut names = Vec::new();
    let mut keys = Vec::new();
    for (name, record) in &records {
        if let Some(snapshot) = &record.snapshot {
            // it holds the sum of all parts before it
            names = snapshot.film.iter().map(|f| f.key.clone()).collect();
        }
        ledger.replay(record, name.clone())?;
        names.extend(record.made.film.iter().map(|f| f.key.clone()));
        keys.push(key(record.sequence, name));
    }
    names.extend(ledger.waiting().map(|g| g.key.clone()));
    let mut done = Collected::default();
    let mut garbage = Vec::new();
    for prefix in [RECORDS, "nodes/"] {
        for (key, bytes) in store.list(prefix).await? {
            // nodes/N/name
            let name = key.splitn(3, '/').nth(2).unwrap_or_default();
            if keys.contains(&key) || (prefix != RECORDS && names.iter().any(|n| n == name)) {
                done.kept += 1;
            } else {
                done.objects += 1;
                done.bytes += bytes;
                garbage.push(key);
            }
        }
    }
    store.delete(&garbage).await?;
    Ok(done)
}
