//! From a description and its records to a prepared scene: the passes.
//!
//! 1. *Bounds*: the source is read for its f64 bounds, unless importing has found them. Their centre becomes the origin. If its records take at most 64
//!    MiB they are kept.
//! 2. *Reading*: else the source is read once more (at most twice in all). Records are recentred, rounded to f32, checked, and put in a
//!    spool: in memory while they are few, else in a temporary file.
//!    Textures are read one after the other and stored as tiles.
//! 3. *Counting*: now the number of splits is known. All candidate grids are counted in one pass over the spool.
//! 4. *Building*: per split, what lies in which cell of the chosen grid; its tree and attributes are built and stored; primitives of
//!    cells that are copied are dealt to groups.
//! 5. *Reducing*: groups are joined to new splits, which are built and stored.
//!
//! Memory: one batch of the source or a small one's records, the spool's share, the grid tables, and as many splits as there are threads. Every step that runs
//! in parallel is a pure function of one split or one candidate, and results are joined in their order: the bytes do not
//! depend on threads.

mod build;
mod building;
mod clock;
mod counting;
mod draft;
mod fingerprint;
mod incidence;
mod ingest;
mod progress;
mod records;
mod reduce;
mod report;
mod settings;
mod spool;
#[cfg(test)]
mod tests;
mod textures;
mod usable;
mod world;

use std::io;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use rayherd_render::bvh::BuildError;
use rayherd_render::skip::Skip;
use rayon::prelude::*;

use crate::ImportError;
use crate::description::{Description, Place};
use crate::grid::count::{Counter, Primitives, candidates, choose};
use crate::grid::{CellData, GridData, Lattice};
use crate::import;
use crate::manifest::{Defaults, FORMAT, GridChoice, Manifest, ManifestError};
use crate::objects::{ObjectError, ObjectKind, ObjectRef, ObjectStore};
use crate::overlap;
use crate::record::RecordSource;
use crate::split::{Capacity, bytes_each, cut, windows};

use build::{Blocks, Rayon};
use building::Building;
use counting::CountingStore;
use incidence::{CellBox, ChosenCells};
use ingest::{Ingested, Seen};
use spool::Spool;

pub use build::Keep;
pub use building::AT_ONCE;
pub use draft::{Apart, Outcome, build, complete, draft, packed_most};
pub use fingerprint::{fingerprint, source_files};
pub use progress::{NoProgress, PrepareProgress, Stage};
pub use report::{ByteKind, ByteOp, ByteRow, PrepareReport};
pub use settings::{Cut, PrepareSettings, SpoolSettings};
pub use usable::foresee;

/// A prepared scene.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// What it is.
    pub manifest: Manifest,
    /// Name of the manifest in the store.
    pub reference: ObjectRef,
    /// It was there already: nothing was read or written but the manifest, which holds the camera and size of now.
    pub reused: bool,
    /// What it took.
    pub report: PrepareReport,
}

impl Prepared {
    /// Objects that were not made and stored again, as they were there: those that the manifest names.
    pub fn kept(&self) -> u64 {
        if self.reused { self.manifest.objects().count() as u64 } else { 0 }
    }
}

/// Why a scene cannot be prepared.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The source cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// The store cannot be used.
    #[error(transparent)]
    Store(#[from] ObjectError),
    /// A setting is out of range.
    #[error("{0}")]
    Settings(String),
    /// Nothing can be hit.
    #[error(
        "the scene has no primitive that can be hit, lights aside: of {records} records, {degenerate} have no area, \
         {non_finite} hold NaN or infinity and {out_of_range} lie beyond 2^39 units; check that the file is the right one \
         and not cut off, that its scale is sane, and that a volume has values on both sides of the iso value"
    )]
    Empty {
        /// Records in the source.
        records: u64,
        /// Of zero area.
        degenerate: u64,
        /// With NaN or infinity.
        non_finite: u64,
        /// Too far away.
        out_of_range: u64,
    },
    /// What emits has no area.
    #[error(
        "{place}: shape {shape:?} emits, but has no area (it is flat or empty, or its vertices are not finite or too far away), and nothing else \
         gives light: give it a size, or pass --light or --sky"
    )]
    Dark {
        /// Name of the first such shape.
        shape: String,
        /// Where it stands.
        place: Place,
    },
    /// A record names a shape or material that the description lacks: a mistake of the importer.
    #[error("{0}")]
    Inconsistent(String),
    /// A split's tree cannot be built.
    #[error("split {split}: {source}; use a smaller block size or more splits")]
    Build {
        /// Which.
        split: u32,
        /// Why.
        source: BuildError,
    },
    /// More splits than a manifest holds.
    #[error("{0} splits are too many (4194303 at most); use a larger block size")]
    TooManySplits(u64),
    /// The temporary file cannot be written or read.
    #[error("cannot use a temporary file in {}: {source}; free some space or name another folder", folder.display())]
    Spool {
        /// Its folder.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// Prepares a scene, or finds that it is prepared already.
///
/// `source` yields the records of `description`. The bytes of every object are a function of source and settings alone, not of threads
/// (rayon's current pool is used), `spool` or `store`.
///
/// # Errors
/// See [`PrepareError`]. What was stored until then stays, without a name.
pub fn prepare(
    description: &Description,
    source: &dyn RecordSource,
    settings: &PrepareSettings,
    spool: &SpoolSettings,
    store: &dyn ObjectStore,
    progress: &dyn PrepareProgress,
) -> Result<Prepared, PrepareError> {
    match passes(description, source, settings, spool, (store, None), progress)? {
        Outcome::Prepared(prepared) => Ok(*prepared),
        Outcome::Draft(_) => Err(PrepareError::Inconsistent("a draft that nobody asked for".to_owned())),
    }
}

/// All passes; with `apart` those of a large scene end before its blocks are built.
fn passes(
    description: &Description,
    source: &dyn RecordSource,
    settings: &PrepareSettings,
    spool: &SpoolSettings,
    (store, apart): (&dyn ObjectStore, Option<&Apart>),
    progress: &dyn PrepareProgress,
) -> Result<Outcome, PrepareError> {
    settings.check().map_err(PrepareError::Settings)?;
    let print = fingerprint(description)?;
    let found = if spool.skips.makes(Skip::Prepared) { Manifest::find(store, &print, settings) } else { Ok(None) };
    match found {
        Ok(Some((reference, manifest))) => {
            let report = PrepareReport::reused(reference.bytes);
            let defaults = Defaults::of(description);
            if manifest.defaults == defaults {
                return Ok(Prepared { manifest, reference, reused: true, report }.into());
            }
            // the same scene for another picture: a new list of the same objects
            let manifest = Manifest { defaults, ..manifest };
            let reference = manifest.store(store)?;
            return Ok(Prepared { manifest, reference, reused: true, report }.into());
        }
        Ok(None) => {}
        Err(ManifestError::Store(error)) => return Err(error.into()),
        // find() takes a manifest that it cannot read for none
        Err(other) => return Err(PrepareError::Inconsistent(other.to_string())),
    }
    let store = CountingStore::new(store);

    // 1, 2
    let (offset, mut ingested) = read(description, source, spool, progress)?;
    let textures = textures::store(&description.textures, world::shining(description, &mut ingested), &store)?;
    ingested.counts.source_bytes += textures.bytes_read;
    let tiles = textures.tiles;
    let world = world::world(description, &offset, &mut ingested, textures.textures)?;
    let world_bytes = serde_json::to_vec(&world).map_err(|e| PrepareError::Inconsistent(e.to_string()))?;
    let sky_map = match import::sky_map(description.environment.as_ref())? {
        Some(map) => Some(store.put(ObjectKind::Texture, &map.encode())?),
        None => None,
    };
    let content = world::content_hash(&offset, &ingested.hash, &world_bytes, sky_map.as_ref(), &tiles);
    let inner = ingested.inner();
    let Ingested { spool, counts, lo, hi, .. } = ingested;
    let spool_error = |source| PrepareError::Spool { folder: spool.folder().clone(), source };

    // 3
    let primitives = counts.triangles + counts.spheres;
    let capacity = Capacity::new(settings.cut, primitives, bytes_each(&sample(&spool, settings.cut, primitives)?));
    let ranges = cut(settings.cut, primitives, capacity);
    if ranges.len() >= 1 << 22 {
        return Err(PrepareError::TooManySplits(ranges.len() as u64));
    }
    let keep = apart.filter(|a| ranges.len() > 1 && primitives >= a.least).map(|a| a.keep);
    let (cells, mut choice) =
        choose_grid(&spool, &ranges, (inner, lo, hi), capacity, settings, progress).map_err(spool_error)?;

    // 4
    let sizes: Vec<u64> = ranges.iter().map(|r| r.end - r.start).collect();
    let copied = if settings.overlap_reduction { overlap::copied(&cells.counted, &sizes) } else { Vec::new() };
    choice.copied_cells = copied.iter().filter(|&&c| c).count() as u64;
    let groups = settings
        .overlap_reduction
        .then(|| overlap::group(&cells.lattice, &cells.indices, &cells.primitives, &copied, capacity.copied));
    let mut building = Building {
        blocks: Blocks { store: &store, keep },
        cells: &cells,
        groups: groups.as_ref(),
        spool,
        splits: Vec::new(),
        boxes: vec![CellBox::EMPTY; cells.len()],
        owners: vec![Vec::new(); cells.len()],
        parts: vec![Vec::new(); groups.as_ref().map_or(0, |g| g.count as usize)],
        contested: 0,
        tree: Duration::ZERO,
    };
    building.source_splits(&ranges, progress)?;
    choice.contested_primitives = building.contested;
    choice.contested_cells = cells.contested.iter().filter(|&&c| c).count() as u64;

    // 5
    building.reduce(capacity.copied, progress)?;
    let Building { splits, boxes, owners, spool, tree, .. } = building;
    choice.copies = splits.iter().filter(|s| s.copied).map(|s| s.triangles + s.spheres).sum();
    choice.rewritten_bytes = draft::rewritten(&splits);

    let world = store.put(ObjectKind::Manifest, &world_bytes)?;
    let grid = grid_data(&cells, &boxes, owners, (inner, lo, hi));
    let defaults = Defaults::of(description);
    let settings = settings.clone();
    let manifest = Manifest {
        format: FORMAT,
        settings,
        source: print,
        content,
        offset,
        lo,
        hi,
        world,
        sky_map,
        tiles,
        splits,
        grid,
        choice,
        defaults,
        counts,
        homes: None,
    };
    if keep.is_some() {
        return Ok(Outcome::Draft(Box::new(manifest)));
    }
    let reference = manifest.store(&store)?;
    let report = PrepareReport::new(&manifest, &store, spool.traffic(), tree);
    Ok(Prepared { manifest, reference, reused: false, report }.into())
}

/// Reads the source: at most twice, the importer's own reading for bounds included. Once where nobody has to look for bounds (a volume), or where all records
/// were kept when they were looked for.
fn read(
    description: &Description,
    source: &dyn RecordSource,
    spool: &SpoolSettings,
    progress: &dyn PrepareProgress,
) -> Result<([f64; 3], Ingested), PrepareError> {
    let known = description.bounds.filter(ingest::usable_bounds);
    let Seen { bounds, bytes, kept } = match known {
        Some(_) => Seen { bounds: known, bytes: 0, kept: None },
        None => ingest::bounds(source, ingest::to_keep(description), progress)?,
    };
    // where nothing is usable, what follows counts why
    let [lo, hi] = bounds.unwrap_or_default();
    let offset = std::array::from_fn(|a| 0.5 * (lo[a] + hi[a]));
    let again = kept.is_none();
    let mut ingested = ingest::ingest(description, (source, kept), offset, spool, progress)?;
    for text in usable::judge(description, &ingested.counts, &ingested.had)? {
        tracing::warn!("{text}");
    }
    ingested.counts.source_reads = description.passes + u32::from(known.is_none()) + u32::from(again);
    ingested.counts.source_bytes += bytes + description.bytes_read;
    Ok((offset, ingested))
}

/// Builds a few small blocks to see what a primitive takes: (bytes, primitives) of each.
fn sample(spool: &Spool, cut: Cut, primitives: u64) -> Result<Vec<(u64, u64)>, PrepareError> {
    let build = |range: &Range<u64>| {
        let records =
            spool.range(range).map_err(|source| PrepareError::Spool { folder: spool.folder().clone(), source })?;
        Ok((build::block(0, &records, &Rayon)?.len() as u64, records.len() as u64))
    };
    windows(cut, primitives).iter().map(build).collect()
}

/// Counts all candidates in one pass over the spool and picks one.
fn choose_grid(
    spool: &Spool,
    ranges: &[Range<u64>],
    (inner, lo, hi): ([[f32; 3]; 2], [f32; 3], [f32; 3]),
    capacity: Capacity,
    settings: &PrepareSettings,
    progress: &dyn PrepareProgress,
) -> io::Result<(ChosenCells, GridChoice)> {
    let splits = ranges.len() as u32;
    progress.begin(Stage::Counting, Some(ranges.len() as u64));
    let mut counters = Vec::new();
    for subdiv in candidates(splits, settings) {
        counters.push(Counter::new(Lattice::around(subdiv, inner, lo, hi).map_err(io::Error::other)?));
    }
    for (split, range) in (0..).zip(ranges) {
        let records = spool.range(range)?;
        let spheres = records.spheres.iter().map(|s| (s.center, s.radius)).collect();
        let primitives = Primitives::new(counters[0].lattice(), &records.triangles, spheres);
        counters.par_iter_mut().for_each(|counter| counter.add(split, &primitives));
        progress.advance(1);
    }
    let counted: Vec<_> = counters.iter().map(Counter::summary).collect();
    let (chosen, stopped_by) = choose(&counted, splits, capacity.source, settings);
    let cells = ChosenCells::new(&counters[chosen]);
    let choice = GridChoice {
        subdiv: counted[chosen].subdiv,
        candidates: counted,
        stopped_by,
        capacity: capacity.source,
        contested_cells: 0,
        copied_cells: 0,
        contested_primitives: 0,
        copies: 0,
        rewritten_bytes: 0,
    };
    Ok((cells, choice))
}

fn grid_data(
    cells: &ChosenCells,
    boxes: &[CellBox],
    owners: Vec<Vec<u32>>,
    ([inner_lo, inner_hi], lo, hi): ([[f32; 3]; 2], [f32; 3], [f32; 3]),
) -> GridData {
    let mut out = GridData { subdiv: cells.lattice.subdiv(), inner_lo, inner_hi, lo, hi, cells: Vec::new() };
    for (n, owners) in owners.into_iter().enumerate() {
        // a conservative test may have named a cell that nothing reaches
        if !boxes[n].is_empty() {
            let CellBox { lo, hi } = boxes[n];
            let primitives = u64::from(cells.primitives[n]);
            out.cells.push(CellData { index: cells.indices[n], lo, hi, primitives, owners });
        }
    }
    out
}
