//! The surface where a volume passes through a value, as a stream of triangles: marching cubes, slab by slab.
//!
//! Samples above the value are inside the material (for CT: what is denser), and triangles are counter-clockwise seen from
//! outside it. The surface is closed, but for the volume's border, where it ends. Its topology is that of the trilinear
//! interpolant, but for one case (see the tables). In memory are two slices of samples, and nothing grows with the volume.
//! Triangles of zero area are in the stream and keep their ids: they come of samples that equal the value. Samples that
//! are NaN are outside, and the vertices beside them are NaN.

mod interior;
mod march;
mod tables;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use march::{Cursor, Grid, Slab, Slice};

use crate::ImportError;
use crate::description::{Affine, Place};
use crate::import::volume::{self, Slices, VolumeFile};
use crate::record::{Record, RecordSource, RecordStream, TriangleRecord};

/// An isosurface that can be streamed any number of times.
#[derive(Clone, Debug)]
pub struct IsoSurfaceSource {
    file: VolumeFile,
    grid: Grid,
    shape: u32,
    /// Cells that all passes so far did not look into.
    passed: Arc<AtomicU64>,
}

impl IsoSurfaceSource {
    /// Opens the volume at `path` (see [`volume::open`]) and checks it. `iso` is in rescaled units (HU for CT).
    pub fn new(path: &Path, iso: f64) -> Result<Self, ImportError> {
        let file = volume::open(path)?;
        let limit = |message| Err(ImportError::Limit { place: Place::file(path), message });
        if !iso.is_finite() {
            return limit(format!("the surface's value {iso} is not a number that samples can pass through"));
        }
        let dims = file.volume().dims;
        if dims.iter().any(|&d| d < 2) {
            let [x, y, z] = dims;
            return limit(format!("{x} x {y} x {z} samples hold no surface: at least 2 are needed along each axis"));
        }
        let grid =
            Grid { width: dims[0], height: dims[1], iso, to_world: Affine::IDENTITY, mirrored: false, thorough: false };
        Ok(IsoSurfaceSource { file, grid, shape: 0, passed: Arc::default() }.placed(&Affine::IDENTITY, 0))
    }

    /// The same, looking also into cells that the surface does not cross: to see what passing them by saves.
    pub fn thorough(mut self) -> Self {
        self.grid.thorough = true;
        self
    }

    /// Cells that all passes so far did not look into, as the surface does not cross them.
    pub fn cells_passed(&self) -> u64 {
        self.passed.load(Ordering::Relaxed)
    }

    /// The same, moved by `to_world` after the volume's own placement, as shape number `shape`.
    pub fn placed(mut self, to_world: &Affine, shape: u32) -> Self {
        self.grid.to_world = to_world.after(&self.file.volume().to_world);
        self.grid.mirrored = self.grid.to_world.determinant() < 0.0;
        self.shape = shape;
        self
    }

    /// The volume.
    pub fn file(&self) -> &VolumeFile {
        &self.file
    }

    /// The world's box around all samples, and so around the surface: least and greatest corner.
    pub fn world_box(&self) -> [[f64; 3]; 2] {
        volume::Volume { to_world: self.grid.to_world, ..self.file.volume().clone() }.world_box()
    }

    /// Starts a pass, as [`RecordSource::open`] does.
    pub fn stream(&self) -> Result<IsoSurfaceStream<'_>, ImportError> {
        let mut stream = IsoSurfaceStream {
            grid: self.grid,
            shape: self.shape,
            slices: self.file.slices(),
            low: Slice::default(),
            high: Slice::default(),
            z: 0,
            cursor: Cursor::default(),
            kept: Vec::new(),
            ended: false,
            before: 0,
            passed: &self.passed,
        };
        stream.slices.next(&mut stream.low.samples)?;
        stream.low.mark(stream.grid.width, stream.grid.iso);
        stream.ended = !stream.read()?;
        Ok(stream)
    }
}

impl RecordSource for IsoSurfaceSource {
    fn open(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        Ok(Box::new(self.stream()?))
    }
}

/// A pass over an isosurface.
pub struct IsoSurfaceStream<'a> {
    grid: Grid,
    shape: u32,
    slices: Slices<'a>,
    low: Slice,
    high: Slice,
    /// Number of the lower slice.
    z: usize,
    cursor: Cursor,
    /// The rest of a cell that did not fit.
    kept: Vec<Record>,
    ended: bool,
    /// Bytes that were read for this pass before it began.
    before: u64,
    passed: &'a AtomicU64,
}

impl IsoSurfaceStream<'_> {
    /// The same pass, for which so many bytes of headers were read already.
    pub(super) fn after(self, before: u64) -> Self {
        IsoSurfaceStream { before, ..self }
    }

    /// Reads the upper slice; false when there is none.
    fn read(&mut self) -> Result<bool, ImportError> {
        let more = self.slices.next(&mut self.high.samples)?;
        self.high.mark(self.grid.width, self.grid.iso);
        Ok(more)
    }
}

impl RecordStream for IsoSurfaceStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let start = out.len();
        let end = start + max;
        out.extend(self.kept.drain(..self.kept.len().min(max)));
        while out.len() < end && !self.ended {
            let slab = Slab { z: self.z, low: &self.low, high: &self.high };
            let (kept, shape) = (&mut self.kept, self.shape);
            let more = self.grid.next_cell(&slab, &mut self.cursor, |p| {
                let record = Record::Triangle(TriangleRecord { p, n: None, uv: None, attribute: None, shape });
                if out.len() < end { out.push(record) } else { kept.push(record) }
            });
            if !more {
                std::mem::swap(&mut self.low, &mut self.high);
                self.z += 1;
                self.passed.fetch_add(self.cursor.passed, Ordering::Relaxed);
                self.cursor = Cursor::default();
                self.ended = !self.read()?;
            }
        }
        Ok(out.len() - start)
    }

    fn bytes_read(&self) -> u64 {
        self.before + self.slices.bytes_read()
    }
}
