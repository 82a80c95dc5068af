//! From a description and its records to a prepared scene: the passes.
//!
//! 1. *Bounds*: the source is read for its f64 bounds, unless importing has found them. Their centre becomes the origin.
//! 2. *Reading*: the source is read once more (at most twice in all). Records are recentred, rounded to f32, checked, and put in a
//!    spool: in memory while they are few, else in a temporary file.
//!    Textures are read one after the other and stored as tiles.
//! 3. *Counting*: now the number of splits is known. All candidate grids are counted in one pass over the spool.
//! 4. *Building*: per split, what lies in which cell of the chosen grid; its tree and attributes are built and stored; primitives of
//!    cells that are copied are dealt to groups.
//! 5. *Reducing*: groups are joined to new splits, which are built and stored.
//!
//! Memory: one batch of the source, the spool's share, the grid tables, and as many splits as there are threads. Every step that runs
//! in parallel is a pure function of one split or one candidate, and results are joined in their order: the bytes do not
//! depend on threads.

mod build;
mod clock;
mod counting;
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

use std::io;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use rayherd_render::bvh::BuildError;
use rayherd_render::skip::Skip;
use rayherd_render::texture::Texture;
use rayherd_render::world::{Beam, Environment, ShapeInfo, Slide, Sun, World};
use rayon::prelude::*;

use crate::ImportError;
use crate::description::{self, Description, Place};
use crate::grid::count::{Counter, Primitives, candidates, choose};
use crate::grid::{CellData, GridData, Lattice};
use crate::import;
use crate::manifest::{Counts, Defaults, FORMAT, GridChoice, Manifest, ManifestError, SplitEntry};
use crate::objects::{ObjectError, ObjectHash, ObjectKind, ObjectRef, ObjectStore};
use crate::overlap;
use crate::record::RecordSource;
use crate::split::{Capacity, bytes_each, cut, windows};

use build::build_split;
use counting::CountingStore;
use incidence::{CellBox, ChosenCells, Incidence, incidence};
use ingest::Ingested;
use spool::Spool;
use textures::Shining;

pub use fingerprint::{fingerprint, source_files};
pub use progress::{NoProgress, PrepareProgress, Stage};
pub use report::{ByteKind, ByteOp, ByteRow, PrepareReport};
pub use settings::{Cut, PrepareSettings, SpoolSettings};

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
        "{place}: shape {shape:?} emits, but has no area, and nothing else gives light: give it a size, or pass --light or --sky"
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
    settings.check().map_err(PrepareError::Settings)?;
    let print = fingerprint(description)?;
    let found = if spool.skips.makes(Skip::Prepared) { Manifest::find(store, &print, settings) } else { Ok(None) };
    match found {
        Ok(Some((reference, manifest))) => {
            let report = PrepareReport::reused(reference.bytes);
            let defaults = Defaults::of(description);
            if manifest.defaults == defaults {
                return Ok(Prepared { manifest, reference, reused: true, report });
            }
            // the same scene for another picture: a new list of the same objects
            let manifest = Manifest { defaults, ..manifest };
            let reference = manifest.store(store)?;
            return Ok(Prepared { manifest, reference, reused: true, report });
        }
        Ok(None) => {}
        Err(ManifestError::Store(error)) => return Err(error.into()),
        // find() takes a manifest that it cannot read for none
        Err(other) => return Err(PrepareError::Inconsistent(other.to_string())),
    }
    let store = CountingStore::new(store);

    // 1, 2
    let (offset, mut ingested) = read(description, source, spool, progress)?;
    let textures = textures::store(&description.textures, shining(description, &mut ingested), &store)?;
    ingested.counts.source_bytes += textures.bytes_read;
    let tiles = textures.tiles;
    let world = world(description, &offset, &mut ingested, textures.textures)?;
    let world_bytes = serde_json::to_vec(&world).map_err(|e| PrepareError::Inconsistent(e.to_string()))?;
    let sky_map = match import::sky_map(description.environment.as_ref())? {
        Some(map) => Some(store.put(ObjectKind::Texture, &map.encode())?),
        None => None,
    };
    let content = content_hash(&offset, &ingested.hash, &world_bytes, sky_map.as_ref(), &tiles);
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
        store: &store,
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
    let of_copies = || splits.iter().filter(|s| s.copied);
    choice.copies = of_copies().map(|s| s.triangles + s.spheres).sum();
    choice.rewritten_bytes = of_copies().map(|s| s.geometry.bytes + s.attributes.bytes).sum();

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
    let reference = manifest.store(&store)?;
    let report = PrepareReport::new(&manifest, &store, spool.traffic(), tree);
    Ok(Prepared { manifest, reference, reused: false, report })
}

/// Reads the source: at most twice, the importer's own reading for bounds included.
fn read(
    description: &Description,
    source: &dyn RecordSource,
    spool: &SpoolSettings,
    progress: &dyn PrepareProgress,
) -> Result<([f64; 3], Ingested), PrepareError> {
    let known = description.bounds.filter(ingest::usable_bounds);
    let (lo, hi, bytes) = match known {
        Some([lo, hi]) => (lo, hi, 0),
        None => match ingest::bounds(source, progress)? {
            Some(found) => (found.lo, found.hi, found.bytes),
            // nothing usable: the pass below counts why
            None => ([0.0; 3], [0.0; 3], 0),
        },
    };
    let offset = std::array::from_fn(|a| 0.5 * (lo[a] + hi[a]));
    let mut ingested = ingest::ingest(description, source, offset, spool, progress)?;
    let Counts { records, triangles, spheres, degenerate, non_finite, out_of_range, .. } = ingested.counts;
    // lights that were added to a surface are no scene; lights alone that the source has are one
    let meant_dark = description.shapes.iter().any(|s| !ingest::emits(s.emission));
    if triangles + spheres == 0 || (meant_dark && !ingested.has_dark()) {
        return Err(PrepareError::Empty { records, degenerate, non_finite, out_of_range });
    }
    ingested.counts.source_reads = description.passes + u32::from(known.is_none()) + 1;
    ingested.counts.source_bytes += bytes + description.bytes_read;
    Ok((offset, ingested))
}

fn world(
    description: &Description,
    offset: &[f64; 3],
    ingested: &mut Ingested,
    textures: Vec<Texture>,
) -> Result<World, PrepareError> {
    let materials = description.materials.len();
    if let Some(shape) = description.shapes.iter().find(|s| s.material as usize >= materials) {
        let message = format!("shape {:?} has material {} of {materials}", shape.name, shape.material);
        return Err(PrepareError::Inconsistent(message));
    }
    let shapes = description.shapes.iter().map(|s| ShapeInfo {
        name: s.name.clone(),
        material: s.material,
        emission: s.emission,
        emission_texture: s.emission_texture,
    });
    let world = World {
        materials: description.materials.clone(),
        textures,
        shapes: shapes.collect(),
        emissive: std::mem::take(&mut ingested.emissive),
        glows: std::mem::take(&mut ingested.glows),
        beams: description.beams.iter().map(|b| beam(b, offset)).collect(),
        environment: description.environment.as_ref().map(|sky| match sky {
            description::Environment::Constant(radiance) => Environment::Constant(*radiance),
            description::Environment::Map { scale, to_world, .. } => {
                Environment::Map { scale: *scale, to_map: import::to_map(to_world), upper: false }
            }
            description::Environment::Sky(sky) => Environment::Map {
                scale: sky.scale,
                to_map: import::to_map(&sky.to_world.after(&import::PICTURE_TO_SKY)),
                upper: true,
            },
        }),
        sun: description.sun.as_ref().map(|sun| Sun {
            direction: sun.direction.map(|x| x as f32),
            up: sun.up.map(|x| x as f32),
            // as 2 sin^2 of the half: small angles keep their digits
            cap: (2.0 * libm::sin(0.5 * sun.half_angle) * libm::sin(0.5 * sun.half_angle)) as f32,
            radiance: sun.radiance,
        }),
        lo: ingested.lo,
        hi: ingested.hi,
    };
    world.check().map_err(PrepareError::Inconsistent)?;
    Ok(world)
}

/// By texture: the primitives whose emission it gives, to be weighed.
fn shining<'a>(description: &Description, ingested: &'a mut Ingested) -> Shining<'a> {
    let mut out = Shining::new();
    let mut emissive = ingested.emissive.iter();
    for glow in &mut ingested.glows {
        // both by ascending id
        let Some(e) = emissive.find(|e| e.prim == glow.prim) else { break };
        if let Some(texture) = description.shapes[e.shape as usize].emission_texture {
            out.entry(texture).or_default().push((glow, e.geometry));
        }
    }
    out
}

/// A beam in recentred f32.
fn beam(beam: &description::Beam, offset: &[f64; 3]) -> Beam {
    let place = |p: &[f64; 3]| std::array::from_fn(|i| (p[i] - offset[i]) as f32);
    match beam {
        description::Beam::Point { position, intensity } => {
            Beam::Point { position: place(position), intensity: *intensity }
        }
        description::Beam::Spot { position, axis, intensity, beam, cutoff, slide } => Beam::Spot {
            position: place(position),
            axis: axis.map(|x| x as f32),
            intensity: *intensity,
            beam: beam.to_radians() as f32,
            cutoff: cutoff.to_radians() as f32,
            slide: slide.as_ref().map(|slide| Slide {
                texture: slide.texture,
                to_local: slide.to_local.map(|row| row.map(|x| x as f32)),
                tan: libm::tan(cutoff.to_radians()) as f32,
            }),
        },
        description::Beam::Directional { direction, irradiance } => {
            Beam::Directional { direction: direction.map(|x| x as f32), irradiance: *irradiance }
        }
    }
}

fn content_hash(
    offset: &[f64; 3],
    records: &blake3::Hash,
    world: &[u8],
    sky_map: Option<&ObjectRef>,
    tiles: &[ObjectRef],
) -> ObjectHash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"rayherd content\0").update(&FORMAT.to_le_bytes());
    for x in offset {
        hasher.update(&x.to_le_bytes());
    }
    hasher.update(records.as_bytes());
    // the world says how many there are, and whether there is a picture of the sky
    for object in sky_map.into_iter().chain(tiles) {
        hasher.update(&object.hash.0);
    }
    hasher.update(world);
    ObjectHash(*hasher.finalize().as_bytes())
}

/// Builds a few small blocks to see what a primitive takes: (bytes, primitives) of each.
fn sample(spool: &Spool, cut: Cut, primitives: u64) -> Result<Vec<(u64, u64)>, PrepareError> {
    let build = |range: &Range<u64>| {
        let records =
            spool.range(range).map_err(|source| PrepareError::Spool { folder: spool.folder().clone(), source })?;
        Ok((build::block(0, &records)?.len() as u64, records.len() as u64))
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

/// Primitives in all splits that are built at one time: some 300 MiB of records, trees and blocks. A larger split is built alone, by all
/// threads together.
const AT_ONCE: u64 = 1 << 20;

/// How many splits of at most so many primitives are built at one time: each holds its records and its tree.
fn at_once(primitives: u64) -> usize {
    usize::try_from(AT_ONCE / primitives.max(1)).unwrap_or(usize::MAX).clamp(1, rayon::current_num_threads())
}

/// Splits on their way into the store.
struct Building<'a> {
    store: &'a CountingStore<'a>,
    cells: &'a ChosenCells,
    groups: Option<&'a overlap::Groups>,
    spool: Spool,
    splits: Vec<SplitEntry>,
    /// What is in a cell, by its number.
    boxes: Vec<CellBox>,
    /// Who owns a cell, by its number.
    owners: Vec<Vec<u32>>,
    /// Chunks of the spool that hold a group's primitives, by ascending split.
    parts: Vec<Vec<usize>>,
    contested: u64,
    tree: Duration,
}

impl Building<'_> {
    fn spool_error(&self, source: io::Error) -> PrepareError {
        PrepareError::Spool { folder: self.spool.folder().clone(), source }
    }

    fn source_splits(&mut self, ranges: &[Range<u64>], progress: &dyn PrepareProgress) -> Result<(), PrepareError> {
        progress.begin(Stage::Building, Some(ranges.len() as u64));
        let of_cell = self.groups.map_or(&[][..], |g| &g.of_cell);
        for wave in ranges.chunks(at_once(ranges.iter().map(|r| r.end - r.start).max().unwrap_or(0))) {
            let first = self.splits.len() as u32;
            let work = |(split, range): (u32, &Range<u64>)| -> Result<_, PrepareError> {
                let records = self.spool.range(range).map_err(|e| self.spool_error(e))?;
                let found = incidence(self.cells, of_cell, &records);
                let dealt = records.deal(&found.triangles, &found.spheres);
                Ok((build_split(split, &records, false, self.store)?, found, dealt))
            };
            let numbered: Vec<(u32, &Range<u64>)> = (first..).zip(wave).collect();
            // in order, so that the first error is always the same one
            let done: Vec<_> = numbered.into_par_iter().map(work).collect();
            for result in done {
                let (built, found, dealt) = result?;
                let split = self.splits.len() as u32;
                self.splits.push(built.entry);
                self.tree += built.tree;
                self.note(split, &found);
                for (group, records) in dealt {
                    let chunk = self.spool.push(records).map_err(|e| self.spool_error(e))?;
                    self.parts[group as usize].push(chunk);
                }
            }
            progress.advance(wave.len() as u64);
        }
        Ok(())
    }

    /// Adds what a source split has in the cells.
    fn note(&mut self, split: u32, found: &Incidence) {
        self.contested += found.contested;
        for (number, part) in &found.cells {
            let n = *number as usize;
            self.boxes[n].add(part);
            self.owners[n].push(split);
        }
    }
}
