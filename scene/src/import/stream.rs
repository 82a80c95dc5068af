//! The records of a description, shape after shape.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use rayherd_render::skip::{Skip, Skips};

use super::isosurface::IsoSurfaceSource;
use super::mesh::{Corners, MeshOptions, MeshStream};
use super::obj::ObjReader;
use super::placement::Placement;
use super::ply::PlyReader;
use super::serialized::SerializedReader;
use super::stl::StlReader;
use crate::ImportError;
use crate::description::{Description, Geometry, MeshFormat, Shape};
use crate::record::{Record, RecordSource, RecordStream, SphereRecord};

/// How much memory reading may take, and what it leaves out. No record depends on it.
#[derive(Clone, Debug)]
pub struct StreamOptions {
    /// Most bytes of one mesh's vertex arrays in memory; larger ones spill to a mapped temporary file.
    pub vertex_budget: u64,
    /// Most bytes of that file; a mesh that needs more is an error.
    pub spill_limit: u64,
    /// Its folder; the system's temporary folder when `None`.
    pub spill_folder: Option<PathBuf>,
    /// Of these [`Skip::Volume`].
    pub skips: Skips,
}

impl Default for StreamOptions {
    /// 512 MiB in memory, then up to 64 GiB in the system's temporary folder.
    fn default() -> Self {
        StreamOptions { vertex_budget: 512 << 20, spill_limit: 64 << 30, spill_folder: None, skips: Skips::ALL }
    }
}

/// A description as a source of records.
#[derive(Debug)]
pub struct DescriptionSource<'a> {
    description: &'a Description,
    options: StreamOptions,
    spilled: AtomicU64,
    /// By shape: volumes that have been opened.
    volumes: Vec<Option<OnceLock<IsoSurfaceSource>>>,
}

impl<'a> DescriptionSource<'a> {
    /// The records of `description`, in the order of its shapes.
    pub fn new(description: &'a Description, options: StreamOptions) -> Self {
        let is_volume = |s: &Shape| matches!(s.geometry, Geometry::IsoSurface { .. });
        let volumes = description.shapes.iter().map(|s| is_volume(s).then(OnceLock::new)).collect();
        DescriptionSource { description, options, spilled: AtomicU64::new(0), volumes }
    }

    /// The surface of a volume; its headers are read once for all passes. And the bytes that were read for it now.
    fn surface(
        &self,
        number: usize,
        path: &Path,
        iso: f64,
        shape: &Shape,
    ) -> Result<(&IsoSurfaceSource, u64), ImportError> {
        let Some(slot) = &self.volumes[number] else { unreachable!("made for each surface of a volume") };
        let mut read = 0;
        if slot.get().is_none() {
            let source = IsoSurfaceSource::new(path, iso)?.placed(&shape.to_world, number as u32);
            read = source.file().header_bytes();
            let source = if self.options.skips.makes(Skip::Volume) { source } else { source.thorough() };
            // two passes that begin at once read the headers twice; the first to finish is kept
            let _ = slot.set(source);
        }
        let Some(source) = slot.get() else { unreachable!("set above") };
        Ok((source, read))
    }

    /// Bytes of vertex arrays that went to temporary files, over all passes so far.
    pub fn spilled_bytes(&self) -> u64 {
        self.spilled.load(Ordering::Relaxed)
    }

    /// Cells of volumes that their surfaces do not cross and that were not looked into, over all passes so far.
    pub fn cells_passed(&self) -> u64 {
        self.volumes.iter().flatten().filter_map(OnceLock::get).map(IsoSurfaceSource::cells_passed).sum()
    }

    /// A pass over one shape.
    pub(super) fn open_one(&self, number: usize) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        self.open_shape(number, &self.description.shapes[number], true)
    }

    /// The records of one shape. Smooth normals are what costs: every triangle of a mesh must be read before the first is known.
    fn open_shape(
        &self,
        number: usize,
        shape: &'a Shape,
        normals: bool,
    ) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        let number = number as u32;
        let placement = Placement::new(shape, number);
        Ok(match &shape.geometry {
            Geometry::Inline { positions, normals, uv, triangles } => {
                Box::new(InlineStream { placement, positions, normals, uv, triangles: triangles.iter() })
            }
            Geometry::Sphere { center, radius } => Box::new(Once(Some(sphere(shape, number, *center, *radius)))),
            Geometry::Part => Box::new(Once(None)),
            Geometry::MeshFile { path, format, flip_v, smooth, attribute, parts } => {
                let smooth = *smooth && normals;
                let options = MeshOptions { placement, flip_v: *flip_v, smooth, spilled: &self.spilled };
                match format {
                    MeshFormat::Ply => {
                        Box::new(MeshStream::new(PlyReader::open(path, &self.options, attribute.as_ref())?, options)?)
                    }
                    MeshFormat::Obj => {
                        Box::new(MeshStream::new(ObjReader::open(path, &self.options, parts.as_ref())?, options)?)
                    }
                    MeshFormat::Serialized(index) => {
                        let reader = SerializedReader::open(path, *index, &self.options)?;
                        let options = MeshOptions { smooth: smooth && !reader.face_normals(), ..options };
                        Box::new(MeshStream::new(reader, options)?)
                    }
                    MeshFormat::Stl => {
                        // a format without vertices that triangles share has nothing to smooth
                        let options = MeshOptions { smooth: false, ..options };
                        Box::new(MeshStream::new(StlReader::open(path, &self.options)?, options)?)
                    }
                }
            }
            Geometry::IsoSurface { path, iso } => {
                let (surface, read) = self.surface(number as usize, path, *iso, shape)?;
                let records = Box::new(surface.stream()?.after(read));
                if shape.flip_normals { Box::new(Flipped(records)) } else { records }
            }
        })
    }
}

impl RecordSource for DescriptionSource<'_> {
    fn open(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        Ok(Box::new(DescriptionStream { source: self, normals: true, shape: 0, current: None, bytes_read: 0 }))
    }
    fn open_places(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        Ok(Box::new(DescriptionStream { source: self, normals: false, shape: 0, current: None, bytes_read: 0 }))
    }
}

struct DescriptionStream<'a> {
    source: &'a DescriptionSource<'a>,
    normals: bool,
    /// The shape after the current one.
    shape: usize,
    current: Option<Box<dyn RecordStream + 'a>>,
    /// Of the shapes that are done.
    bytes_read: u64,
}

impl RecordStream for DescriptionStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let mut appended = 0;
        while appended < max {
            if let Some(current) = &mut self.current {
                match current.next(out, max - appended)? {
                    0 => {
                        self.bytes_read += current.bytes_read();
                        self.current = None;
                    }
                    n => appended += n,
                }
            } else if let Some(shape) = self.source.description.shapes.get(self.shape) {
                self.current = Some(self.source.open_shape(self.shape, shape, self.normals)?);
                self.shape += 1;
            } else {
                break;
            }
        }
        Ok(appended)
    }

    fn bytes_read(&self) -> u64 {
        self.bytes_read + self.current.as_ref().map_or(0, |c| c.bytes_read())
    }
}

/// A sphere under a similarity.
fn sphere(shape: &Shape, number: u32, center: [f64; 3], radius: f64) -> Record {
    let mirrored = shape.to_world.determinant() < 0.0;
    let scale = shape.to_world.vector([1.0, 0.0, 0.0]).iter().map(|x| x * x).sum::<f64>().sqrt();
    Record::Sphere(SphereRecord {
        center: shape.to_world.point(center),
        radius: radius * scale,
        flipped: mirrored != shape.flip_normals,
        shape: number,
    })
}

struct Once(Option<Record>);

impl RecordStream for Once {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let taken = if max > 0 { self.0.take() } else { None };
        out.extend(taken);
        Ok(usize::from(taken.is_some()))
    }
    fn bytes_read(&self) -> u64 {
        0
    }
}

struct InlineStream<'a> {
    placement: Placement,
    positions: &'a [[f64; 3]],
    normals: &'a [[f32; 3]],
    uv: &'a [[f32; 2]],
    triangles: std::slice::Iter<'a, [u32; 3]>,
}

impl RecordStream for InlineStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let before = out.len();
        for triangle in self.triangles.by_ref().take(max) {
            let p = triangle.map(|i| self.positions[i as usize]);
            let n = (!self.normals.is_empty()).then(|| triangle.map(|i| self.normals[i as usize]));
            let uv = (!self.uv.is_empty()).then(|| triangle.map(|i| self.uv[i as usize]));
            out.push(self.placement.triangle(Corners { p, n, uv, attribute: None }, 0));
        }
        Ok(out.len() - before)
    }
    fn bytes_read(&self) -> u64 {
        0
    }
}

/// Triangles turned round.
struct Flipped<'a>(Box<dyn RecordStream + 'a>);

impl RecordStream for Flipped<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let before = out.len();
        let n = self.0.next(out, max)?;
        for record in &mut out[before..] {
            if let Record::Triangle(t) = record {
                t.p.swap(1, 2);
            }
        }
        Ok(n)
    }
    fn bytes_read(&self) -> u64 {
        self.0.bytes_read()
    }
}
