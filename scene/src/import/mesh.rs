//! What the mesh formats share: vertex arrays, smooth normals, and triangles to records.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::Pod;

use super::placement::Placement;
use super::source::Source;
use super::spill::{Budget, Column, Table};
use super::stream::StreamOptions;
use super::vector::{cross, dot, normalize, sub};
use crate::ImportError;
use crate::record::{Record, RecordStream};

/// Reads triangles one at a time, in the file's order, once.
pub(super) trait TriangleReader {
    /// What is kept of a triangle while others are read: numbers into the reader's arrays.
    type Triangle: Pod;
    /// The next triangle; none at the end, then and later.
    fn next(&mut self) -> Result<Option<Self::Triangle>, ImportError>;
    /// Its corners.
    fn corners(&self, triangle: &Self::Triangle) -> Corners;
    /// Whether the file gives it normals.
    fn has_normals(&self, triangle: &Self::Triangle) -> bool;
    /// Numbers of its vertices, below [`TriangleReader::vertex_count`].
    fn vertices(triangle: &Self::Triangle) -> [usize; 3];
    /// The part of the mesh that it belongs to: how many shapes after the mesh's own.
    fn part(_: &Self::Triangle) -> u32 {
        0
    }
    /// Vertices read so far.
    fn vertex_count(&self) -> usize;
    fn source(&self) -> &Source;
    fn budget(&mut self) -> &mut Budget;
}

/// A triangle in the mesh's own space.
#[derive(Clone, Copy)]
pub(super) struct Corners {
    pub p: [[f64; 3]; 3],
    pub n: Option<[[f32; 3]; 3]>,
    pub uv: Option<[[f32; 2]; 3]>,
    pub attribute: Option<[[f32; 3]; 3]>,
}

/// A reader as a stream of records.
pub(super) struct MeshStream<'a, R: TriangleReader> {
    reader: R,
    placement: Placement,
    flip_v: bool,
    /// What was read ahead to smooth it, before what the reader still has.
    kept: Option<Kept<R::Triangle>>,
    spilled: &'a AtomicU64,
    counted: u64,
}

/// What a mesh's stream needs to know.
pub(super) struct MeshOptions<'a> {
    pub placement: Placement,
    pub flip_v: bool,
    pub smooth: bool,
    pub spilled: &'a AtomicU64,
}

impl<'a, R: TriangleReader> MeshStream<'a, R> {
    pub fn new(mut reader: R, options: MeshOptions<'a>) -> Result<Self, ImportError> {
        let wanted = options.smooth && options.placement.keeps_normals();
        let kept = if wanted { Some(Kept::read(&mut reader)?) } else { None };
        Ok(MeshStream {
            reader,
            placement: options.placement,
            flip_v: options.flip_v,
            kept,
            spilled: options.spilled,
            counted: 0,
        })
    }
}

impl<R: TriangleReader> RecordStream for MeshStream<'_, R> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let mut n = 0;
        while n < max {
            let triangle = match self.kept.as_mut().and_then(Kept::next) {
                Some(kept) => Some(kept),
                None => self.reader.next()?,
            };
            let Some(triangle) = triangle else { break };
            let mut corners = self.reader.corners(&triangle);
            if self.flip_v {
                corners.uv.iter_mut().flatten().for_each(|uv| uv[1] = 1.0 - uv[1]);
            }
            let smooth = || self.kept.as_ref()?.normals(R::vertices(&triangle));
            corners.n = corners.n.or_else(smooth);
            out.push(self.placement.triangle(corners, R::part(&triangle)));
            n += 1;
        }
        let spilled = self.reader.budget().spilled();
        self.spilled.fetch_add(spilled.saturating_sub(self.counted), Ordering::Relaxed);
        self.counted = self.counted.max(spilled);
        Ok(n)
    }

    fn bytes_read(&self) -> u64 {
        self.reader.source().bytes_read()
    }
}

/// Triangles that were read ahead of the stream: the normal of a vertex is known when the last triangle around it is, and the file is
/// read only once. Like the vertices they are in memory up to the mesh's budget, then in its spill file.
struct Kept<T> {
    triangles: Column<T>,
    next: usize,
    /// Sums of weighted normals by vertex; none if the file has normals itself, and then not all triangles are kept.
    sums: Option<Table<[f64; 3]>>,
}

impl<T: Pod> Kept<T> {
    fn read<R: TriangleReader<Triangle = T>>(reader: &mut R) -> Result<Self, ImportError> {
        let mut triangles = Column::new();
        while let Some(triangle) = reader.next()? {
            triangles.push(triangle, reader.budget()).map_err(|e| reader.source().io(e))?;
            if reader.has_normals(&triangle) {
                return Ok(Kept { triangles, next: 0, sums: None });
            }
        }
        let vertices = reader.vertex_count();
        let mut sums = Table::zeroed(vertices, reader.budget()).map_err(|e| reader.source().io(e))?;
        add_normals(reader, &triangles, sums.values_mut());
        Ok(Kept { triangles, next: 0, sums: Some(sums) })
    }

    fn next(&mut self) -> Option<T> {
        let triangle = self.triangles.get(self.next)?;
        self.next += 1;
        Some(triangle)
    }

    fn normals(&self, vertices: [usize; 3]) -> Option<[[f32; 3]; 3]> {
        let sums = self.sums.as_ref()?.values();
        let [a, b, c] = vertices.map(|v| sums.get(v).and_then(|s| normalize(*s)).map(|n| n.map(|x| x as f32)));
        Some([a?, b?, c?])
    }
}

/// Adds, per vertex, the unit normals of its triangles, weighted by the angle at the vertex (Thuermer and Wuethrich,
/// "Computing vertex normals from polygonal facets", JGT 3(1), 1998: Mitsuba's rule).
fn add_normals<R: TriangleReader>(reader: &R, triangles: &Column<R::Triangle>, sums: &mut [[f64; 3]]) {
    for triangle in (0..triangles.len()).filter_map(|i| triangles.get(i)) {
        let p = reader.corners(&triangle).p;
        let [a, b, c] = p;
        let Some(normal) = normalize(cross(sub(b, a), sub(c, a))) else { continue };
        for (i, vertex) in R::vertices(&triangle).into_iter().enumerate() {
            let [at, next, last] = [0, 1, 2].map(|k| p[(i + k) % 3]);
            if let (Some(u), Some(v)) = (normalize(sub(next, at)), normalize(sub(last, at))) {
                let angle = libm::acos(dot(u, v).clamp(-1.0, 1.0));
                for (sum, n) in sums[vertex].iter_mut().zip(normal) {
                    *sum += angle * n;
                }
            }
        }
    }
}

/// The budget that the options give one mesh.
pub(super) fn budget(options: &StreamOptions) -> Budget {
    let folder = options.spill_folder.clone().unwrap_or_else(std::env::temp_dir);
    Budget::new(options.vertex_budget, options.spill_limit, folder)
}

/// Positions in the precision that the file has.
pub(super) enum Positions {
    Single(Column<[f32; 3]>),
    Double(Column<[f64; 3]>),
}

impl Positions {
    #[inline]
    pub fn get(&self, i: usize) -> Option<[f64; 3]> {
        match self {
            Positions::Single(column) => column.get(i).map(|p| p.map(f64::from)),
            Positions::Double(column) => column.get(i),
        }
    }
    pub fn len(&self) -> usize {
        match self {
            Positions::Single(column) => column.len(),
            Positions::Double(column) => column.len(),
        }
    }
}

/// Where a format is told by the name of a file, `.gz` set aside.
pub(super) fn extension(path: &std::path::Path) -> String {
    let mut path = PathBuf::from(path);
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz")) {
        path.set_extension("");
    }
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}
