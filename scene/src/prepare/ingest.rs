//! Reading the source: its bounds, then its records, recentred and checked.

use rayherd_render::ray::PrimId;
use rayherd_render::world::{EmissivePrimitive, Glow, Primitive};

use super::progress::{PrepareProgress, Stage};
use super::records::{ATTRIBUTES, Extra, NORMALS, Records, SphereBits, UVS};
use super::spool::Spool;
use super::usable::{Had, emits};
use super::{PrepareError, SpoolSettings};
use crate::description::{Description, Geometry, Shape};
use crate::grid::count::{Box3, box_of};
use crate::grid::lattice::{round_down, round_up};
use crate::manifest::Counts;
use crate::record::{LARGEST, Record, RecordSource, RecordStream, Skip, SphereRecord, TriangleRecord};

/// Records asked for at a time.
const BATCH: usize = 4096;
/// Primitives in a chunk of the spool.
const CHUNK: usize = 16_384;

/// Bytes of records that are kept where the bounds were found, so that the source is not read again; and of files that are tried. No setting: the manifest
/// says how often the source was read. As much as waits in memory anyway ([`SpoolSettings::default`]).
const KEPT: u64 = 64 << 20;

/// A source whose bounds were looked for.
#[derive(Debug)]
pub(crate) struct Seen {
    /// Least and greatest corner, f64; none where nothing is usable.
    pub bounds: Option<[[f64; 3]; 2]>,
    /// Bytes read to find them.
    pub bytes: u64,
    /// All records, if they are few enough.
    pub kept: Option<Vec<Vec<Record>>>,
}

/// All usable records, and what they are together.
#[derive(Debug)]
pub(crate) struct Ingested {
    pub spool: Spool,
    pub counts: Counts,
    pub lo: [f32; 3],
    pub hi: [f32; 3],
    /// Box of what does not emit light, inside out if there is nothing.
    dark: Box3,
    /// By shape.
    pub had: Vec<Had>,
    pub emissive: Vec<EmissivePrimitive>,
    /// Of those of them whose shape's emission a texture gives; weights are still to be found.
    pub glows: Vec<Glow>,
    /// Of all records, whatever the chunks.
    pub hash: blake3::Hash,
}

impl Ingested {
    /// The box that the grid's equal cells fill: that of what does not emit light, if there is anything. Lamps are few, and
    /// may be far away. Its upper corner lies just outside where something is above, since a cell does not hold its
    /// upper face.
    pub fn inner(&self) -> Box3 {
        let [lo, hi] = self.dark;
        if lo[0] > hi[0] {
            return [self.lo, self.hi];
        }
        [lo, std::array::from_fn(|a| if hi[a] < self.hi[a] { hi[a].next_up() } else { hi[a] })]
    }
}

/// Shows the records of a pass to `see`, in order, many at a time, which it may take; the bytes that were read for it.
fn each(
    mut stream: Box<dyn RecordStream + '_>,
    stage: Stage,
    progress: &dyn PrepareProgress,
    mut see: impl FnMut(&mut Vec<Record>) -> Result<(), PrepareError>,
) -> Result<u64, PrepareError> {
    progress.begin(stage, None);
    let mut batch = Vec::new();
    loop {
        batch.clear();
        batch.reserve_exact(BATCH);
        let n = stream.next(&mut batch, BATCH)?;
        if n == 0 {
            return Ok(stream.bytes_read());
        }
        progress.advance(n as u64);
        see(&mut batch)?;
    }
}

/// How many bytes of records are to be kept of a source: none where its files are so large that they would hardly fit.
pub(crate) fn to_keep(description: &Description) -> u64 {
    let size = |shape: &Shape| match &shape.geometry {
        // what cannot be looked at is told when it is read
        Geometry::MeshFile { path, .. } => std::fs::metadata(path).map_or(0, |m| m.len()),
        // nobody knows how many triangles it has
        Geometry::IsoSurface { .. } => u64::MAX,
        Geometry::Inline { .. } | Geometry::Sphere { .. } | Geometry::Part => 0,
    };
    let all = description.shapes.iter().map(size).fold(0, u64::saturating_add);
    if all <= KEPT { KEPT } else { 0 }
}

/// A pass over the source that finds its bounds, and keeps its records if they take no more than `most` bytes.
pub(crate) fn bounds(
    source: &dyn RecordSource,
    most: u64,
    progress: &dyn PrepareProgress,
) -> Result<Seen, PrepareError> {
    let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let mut add = |p: [f64; 3], r: f64| {
        for a in 0..3 {
            lo[a] = lo[a].min(p[a] - r);
            hi[a] = hi[a].max(p[a] + r);
        }
    };
    let (stream, mut kept) = if most > 0 { (source.open()?, Some(Vec::new())) } else { (source.open_places()?, None) };
    let mut left = most;
    let bytes = each(stream, Stage::Bounds, progress, |batch| {
        for record in batch.iter() {
            match record {
                _ if record.sound().is_err() => {}
                Record::Triangle(t) => t.p.iter().for_each(|p| add(*p, 0.0)),
                Record::Sphere(s) => add(s.center, s.radius),
            }
        }
        let bytes = size_of_val(&batch[..]) as u64;
        match &mut kept {
            Some(kept) if bytes <= left => {
                left -= bytes;
                kept.push(std::mem::take(batch));
            }
            _ => kept = None,
        }
        Ok(())
    })?;
    Ok(Seen { bounds: (lo[0] <= hi[0]).then_some([lo, hi]), bytes, kept })
}

/// Whether bounds that an importer found can be used.
pub(crate) fn usable_bounds(bounds: &[[f64; 3]; 2]) -> bool {
    (0..3).all(|a| bounds[0][a] <= bounds[1][a] && bounds[0][a] >= -LARGEST && bounds[1][a] <= LARGEST)
}

/// The pass that takes every record into the spool: those that were kept, else from the source.
pub(crate) fn ingest(
    description: &Description,
    (source, kept): (&dyn RecordSource, Option<Vec<Vec<Record>>>),
    offset: [f64; 3],
    settings: &SpoolSettings,
    progress: &dyn PrepareProgress,
) -> Result<Ingested, PrepareError> {
    let mut reader = Reader {
        offset,
        description,
        chunk: Records::default(),
        spool: Spool::new(settings),
        counts: Counts::default(),
        lo: [f32::INFINITY; 3],
        hi: [f32::NEG_INFINITY; 3],
        dark: [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]],
        had: vec![Had::default(); description.shapes.len()],
        emissive: Vec::new(),
        glows: Vec::new(),
        hashers: Default::default(),
    };
    match kept {
        Some(kept) => {
            progress.begin(Stage::Reading, None);
            for batch in kept {
                progress.advance(batch.len() as u64);
                batch.iter().try_for_each(|record| reader.add(record))?;
            }
        }
        None => {
            let add = |batch: &mut Vec<Record>| batch.iter().try_for_each(|record| reader.add(record));
            reader.counts.source_bytes = each(source.open()?, Stage::Reading, progress, add)?;
        }
    }
    reader.flush()?;
    let mut hasher = blake3::Hasher::new();
    let [always @ .., attributes] = &reader.hashers;
    for part in always {
        hasher.update(part.finalize().as_bytes());
    }
    // few scenes have any: the hashes of all others stay what they were before
    if attributes.count() > 0 {
        hasher.update(attributes.finalize().as_bytes());
    }
    let Reader { spool, counts, lo, hi, dark, had, emissive, glows, .. } = reader;
    Ok(Ingested { spool, counts, lo, hi, dark, had, emissive, glows, hash: hasher.finalize() })
}

struct Reader<'a> {
    offset: [f64; 3],
    description: &'a Description,
    chunk: Records,
    spool: Spool,
    counts: Counts,
    lo: [f32; 3],
    hi: [f32; 3],
    dark: Box3,
    had: Vec<Had>,
    emissive: Vec<EmissivePrimitive>,
    glows: Vec<Glow>,
    /// One for each array, so that the sum does not depend on where chunks end.
    hashers: [blake3::Hasher; 8],
}

impl Reader<'_> {
    fn add(&mut self, record: &Record) -> Result<(), PrepareError> {
        let id = self.counts.records;
        self.counts.records += 1;
        let added = record.sound().and_then(|()| match record {
            Record::Triangle(t) => self.triangle(id, t),
            Record::Sphere(s) => self.sphere(id, s),
        });
        if let Some(had) = self.had.get_mut(record.shape() as usize) {
            had.any = true;
            had.usable |= added.is_ok();
        }
        match added {
            Ok(()) => {}
            Err(Skip::Degenerate) => self.counts.degenerate += 1,
            Err(Skip::NonFinite) => self.counts.non_finite += 1,
            Err(Skip::OutOfRange) => self.counts.out_of_range += 1,
        }
        if self.chunk.len() >= CHUNK { self.flush() } else { Ok(()) }
    }

    fn triangle(&mut self, id: PrimId, t: &TriangleRecord) -> Result<(), Skip> {
        let p: [[f32; 3]; 3] = t.p.map(|p| std::array::from_fn(|a| (p[a] - self.offset[a]) as f32));
        if zero_area(&p) {
            return Err(Skip::Degenerate);
        }
        self.cover(t.shape, box_of(&p));
        self.chunk.triangle_ids.push(id);
        self.chunk.triangles.push(p);
        let mut has = 0;
        if let Some(n) = t.n {
            has |= NORMALS;
            self.chunk.normals.push(n);
        }
        if let Some(uv) = t.uv {
            has |= UVS;
            self.chunk.uvs.push(uv);
        }
        if let Some(attribute) = t.attribute {
            has |= ATTRIBUTES;
            self.chunk.attributes.push(attribute);
        }
        self.chunk.extras.push(Extra { shape: t.shape, has });
        self.counts.triangles += 1;
        self.emit(id, t.shape, Primitive::Triangle(p), (t.uv, t.attribute));
        Ok(())
    }

    fn sphere(&mut self, id: PrimId, s: &SphereRecord) -> Result<(), Skip> {
        let center: [f32; 3] = std::array::from_fn(|a| (s.center[a] - self.offset[a]) as f32);
        let radius = s.radius as f32;
        if radius <= 0.0 {
            return Err(Skip::Degenerate);
        }
        let end = |sign: f64| center.map(|c| f64::from(c) + sign * f64::from(radius));
        self.cover(s.shape, [end(-1.0).map(round_down), end(1.0).map(round_up)]);
        self.chunk.sphere_ids.push(id);
        self.chunk.spheres.push(SphereBits { center, radius, shape: s.shape, flipped: u32::from(s.flipped) });
        self.counts.spheres += 1;
        self.emit(id, s.shape, Primitive::Sphere { center, radius, flipped: s.flipped }, (None, None));
        Ok(())
    }

    /// Adds a primitive's box to those of the scene.
    fn cover(&mut self, shape: u32, [lo, hi]: Box3) {
        let dark = !self.emits(shape);
        for a in 0..3 {
            self.lo[a] = self.lo[a].min(lo[a]);
            self.hi[a] = self.hi[a].max(hi[a]);
            if dark {
                self.dark[0][a] = self.dark[0][a].min(lo[a]);
                self.dark[1][a] = self.dark[1][a].max(hi[a]);
            }
        }
    }

    fn emits(&self, shape: u32) -> bool {
        emits(self.description.shapes.get(shape as usize).and_then(|s| s.emission))
    }

    fn emit(&mut self, prim: PrimId, shape: u32, geometry: Primitive, (uv, attribute): Look) {
        if self.emits(shape) {
            self.emissive.push(EmissivePrimitive { prim, shape, geometry });
            if self.description.shapes[shape as usize].emission_texture.is_some() {
                self.glows.push(Glow { prim, uv, attribute, weight: 0.0 });
            }
        }
    }

    fn flush(&mut self) -> Result<(), PrepareError> {
        let chunk = std::mem::take(&mut self.chunk);
        if chunk.len() == 0 {
            return Ok(());
        }
        let [ids, triangles, extras, normals, uvs, sphere_ids, spheres, attributes] = &mut self.hashers;
        ids.update(bytemuck::cast_slice(&chunk.triangle_ids));
        triangles.update(bytemuck::cast_slice(&chunk.triangles));
        extras.update(bytemuck::cast_slice(&chunk.extras));
        normals.update(bytemuck::cast_slice(&chunk.normals));
        uvs.update(bytemuck::cast_slice(&chunk.uvs));
        attributes.update(bytemuck::cast_slice(&chunk.attributes));
        sphere_ids.update(bytemuck::cast_slice(&chunk.sphere_ids));
        spheres.update(bytemuck::cast_slice(&chunk.spheres));
        self.spool.push(chunk).map_err(|source| PrepareError::Spool { folder: self.spool.folder().clone(), source })?;
        Ok(())
    }
}

/// Texture coordinates and attribute.
type Look = (Option<[[f32; 2]; 3]>, Option<[[f32; 3]; 3]>);

/// Whether a triangle's area vanishes: its cross product is zero in f64. Differences of f32 are exact there (but for
/// exponents more than 29 apart), and so are their products.
fn zero_area(p: &[[f32; 3]; 3]) -> bool {
    let edge = |j: usize| -> [f64; 3] { std::array::from_fn(|a| f64::from(p[j][a]) - f64::from(p[0][a])) };
    let (a, b) = (edge(1), edge(2));
    a[1] * b[2] == a[2] * b[1] && a[2] * b[0] == a[0] * b[2] && a[0] * b[1] == a[1] * b[0]
}
