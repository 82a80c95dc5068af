//! The chain of round records in a store: written before a commit counts, read to go on.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use bytes::Bytes;
use rayherd_render::film::{FilmPart, Layout};
use rayherd_render::frame::Frame;

use super::nodes::Nodes;
use super::owner::Ownership;
use crate::job::{JobError, PreparedScene};
use crate::ledger::{Chain, ChainError, FilmRef, Ledger, Record, Scope, Snapshot, is_of_cut, newest, record_key};
use crate::report::{Kind as ByteKind, Op, Place, Stage};
use crate::store::{BlockStore, StoreError};
use crate::task::camera::{tile_pixels, tiles};
use crate::task::codec;
use crate::wire::envelope::{Compress, Kind, WireError, open, seal};

const RECORDS: &str = "records/";
/// Largest record that is read: a snapshot of a large job holds a line for each group and tile.
const RECORD_LIMIT: usize = 1 << 30;
/// Largest ray group that is read: its number of rays is bounded by the format.
const GROUP_LIMIT: usize = 1 << 27;

/// Why rays cannot be taken over though they are there.
pub const OTHER_CUT: &str = "its rays wait for splits of the scene as it was cut otherwise";

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

/// Stores a record; its name, the hash of its body.
pub fn write(nodes: &Nodes, record: &Record) -> Result<String, JobError> {
    let json = serde_json::to_vec(record).map_err(|e| JobError::Internal(e.to_string()))?;
    let body = seal(Kind::RoundRecord, &json, Compress::Lz4);
    let name = blake3::hash(&body).to_hex().to_string();
    nodes.count(Stage::Trace, Op::Write, ByteKind::Film, 0, Place::Local, body.len() as u64);
    nodes.wait(nodes.store().put(&record_key(record.sequence, &name), body))?;
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

/// What the records of a frame may name.
pub fn scope(scene: &PreparedScene, frame: &Frame) -> Scope {
    let tiles = tiles(frame);
    let pixels = (0..tiles).map(|t| u64::from(tile_pixels(frame, t))).collect();
    Scope { tiles, pixels: Some(pixels), splits: Some((scene.cut.clone(), scene.splits())) }
}

/// The newest chain of an image's records; what else there is, is told.
pub fn newest_of(image: &str, records: BTreeMap<String, Record>) -> Result<Chain, JobError> {
    let chain = newest(image, records)?;
    for fork in &chain.forks {
        tracing::warn!(
            "two writers were at work: record {} has {} children; {} is followed",
            fork.parent,
            fork.children.len(),
            fork.children[0]
        );
    }
    Ok(chain)
}

/// The state to go on from.
///
/// It is found from the newest snapshot on. Where that names what is lost, it is found from an older one, which reaches the same
/// state by the parts that were added since; where that does not help either, the last state is taken whose film is whole and that
/// has no rays on their way.
pub fn resume(nodes: &Nodes, image: &str, scope: &Scope, layout: Layout) -> Result<Resumed, JobError> {
    let chain = newest_of(image, nodes.wait(read(nodes.store().as_ref()))?)?;
    let mut best: Option<Replayed> = None;
    for start in chain.starts() {
        let found = replay(nodes, image, scope, layout, &chain.records[start..])?;
        if let Some(why) = &found.lost {
            tracing::warn!("from the snapshot at place {}: {why}", chain.records[start].1.sequence);
        }
        let commits = |r: &Replayed| (r.lost.is_none(), r.settled.0.commits);
        if best.as_ref().is_none_or(|b| commits(&found) > commits(b)) {
            best = Some(found);
        }
        if best.as_ref().is_some_and(|b| b.lost.is_none()) {
            break;
        }
    }
    let Some(Replayed { mut ledger, film, settled, lost }) = best else {
        let (ledger, film) = (Ledger::new(image, scope.tiles), FilmPart::new(layout));
        let settled = (ledger.snapshot(Vec::new()), film.clone());
        return Ok(Resumed { ledger, film, settled, reused: 0, lost: 0 });
    };
    let reused = ledger.commits();
    let Some(why) = lost else { return Ok(Resumed { ledger, film, settled, reused, lost: 0 }) };
    tracing::warn!("{why}; what was committed after the last state without it is computed again");
    let (mut snapshot, film) = settled;
    snapshot.film = store_film(nodes, &film, &format!("film/back-{}", ledger.commits()))?;
    let kept = snapshot.commits;
    let record = ledger.record_of(snapshot);
    let name = write(nodes, &record)?;
    ledger.go_back(&record, name)?;
    let settled = (ledger.snapshot(Vec::new()), film.clone());
    Ok(Resumed { ledger, film, settled, reused: kept, lost: reused.saturating_sub(kept) })
}

/// What records lead to.
struct Replayed {
    ledger: Ledger,
    film: FilmPart,
    settled: (Snapshot, FilmPart),
    /// What of it is lost, if anything: then `film` is not that of the state.
    lost: Option<JobError>,
}

/// Follows records from a snapshot, or from the first one, to the last.
fn replay(
    nodes: &Nodes,
    image: &str,
    scope: &Scope,
    layout: Layout,
    records: &[(String, Record)],
) -> Result<Replayed, JobError> {
    let (mut ledger, mut film) = (Ledger::new(image, scope.tiles), FilmPart::new(layout));
    let mut settled = (ledger.snapshot(Vec::new()), film.clone());
    let mut lost = None;
    for (number, (name, record)) in records.iter().enumerate() {
        // the sum so far is that of a snapshot of the same state
        let anew = record.snapshot.as_ref().filter(|s| number == 0 || !ledger.is_as(s));
        scope.replay(&mut ledger, record, name.clone())?;
        if lost.is_some() {
            continue;
        }
        let mut parts = record.made.film.as_slice();
        if let Some(snapshot) = anew {
            film = FilmPart::new(layout);
            parts = snapshot.film.as_slice();
        }
        match parts.iter().try_for_each(|part| merge(nodes, &mut film, part, layout)) {
            Ok(()) if ledger.is_settled() => settled = (ledger.snapshot(Vec::new()), film.clone()),
            Ok(()) => {}
            Err(e @ JobError::Lost { .. }) => lost = Some(e),
            Err(e) => return Err(e),
        }
    }
    if lost.is_none() {
        match whole(nodes, scope, &ledger) {
            Err(e @ JobError::Lost { .. }) => lost = Some(e),
            other => other?,
        }
    }
    Ok(Replayed { ledger, film, settled, lost })
}

/// Whether each group that waits has a whole copy, and waits for splits of this scene.
fn whole(nodes: &Nodes, scope: &Scope, ledger: &Ledger) -> Result<(), JobError> {
    for group in ledger.waiting() {
        if scope.splits.as_ref().is_some_and(|(cut, _)| !is_of_cut(group, cut)) {
            return Err(JobError::Lost { name: group.key.clone(), why: OTHER_CUT.into() });
        }
        let open = |body: &Bytes| open(Kind::RayGroup, body, GROUP_LIMIT).map(|_| ());
        nodes.get(0, ByteKind::Rays, &group.key, &group.holders, open)?;
    }
    Ok(())
}

fn merge(nodes: &Nodes, film: &mut FilmPart, part: &FilmRef, layout: Layout) -> Result<(), JobError> {
    let part = nodes.get(0, ByteKind::Film, &part.key, &part.holders, |body| codec::open_film(layout, body))?;
    Ok(film.add_encoded(&part, 0..u32::MAX)?)
}

/// Stores a whole film under `prefix` and its hash: whoever names it means these bytes, whatever is stored later.
pub fn store_film(nodes: &Nodes, film: &FilmPart, prefix: &str) -> Result<Vec<FilmRef>, JobError> {
    if film.is_empty() {
        return Ok(Vec::new());
    }
    let body = codec::seal_film(&film.encode());
    let bytes = body.len() as u64;
    let key = format!("{prefix}-{}", &blake3::hash(&body).to_hex()[..16]);
    let holders = nodes.put(0, ByteKind::Film, &key, body)?;
    Ok(vec![FilmRef { key, band: None, bytes, holders }])
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
    let chain = newest(&image, records)?;
    // the last two snapshots stay, with all that leads from there to here: should the newer one turn out to be unreadable
    let from = chain.starts().get(1).copied().unwrap_or(0);
    let records = &chain.records[from..];
    let tiles_of = |r: &Record| {
        let taken = r.took.camera.iter().map(|u| u.tile.saturating_add(1)).max();
        r.snapshot.as_ref().map(|s| s.done.tiles()).max(taken).unwrap_or(0)
    };
    let tiles = records.iter().map(|r| tiles_of(&r.1)).max().unwrap_or(0);
    let scope = Scope { tiles, ..Scope::default() };
    let mut ledger = Ledger::new(&image, tiles);
    let (mut names, mut keys) = (BTreeSet::new(), BTreeSet::new());
    for (name, record) in records {
        scope.replay(&mut ledger, record, name.clone())?;
        let film = record.snapshot.as_ref().map_or(&record.made.film, |s| &s.film);
        names.extend(film.iter().map(|f| f.key.clone()));
        keys.insert(record_key(record.sequence, name));
    }
    names.extend(ledger.waiting().map(|g| g.key.clone()));
    let mut done = Collected::default();
    let mut garbage = Vec::new();
    for prefix in [RECORDS, "nodes/"] {
        for (key, bytes) in store.list(prefix).await? {
            // nodes/N/name
            let name = key.splitn(3, '/').nth(2).unwrap_or_default();
            if keys.contains(&key) || (prefix != RECORDS && names.contains(name)) {
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
