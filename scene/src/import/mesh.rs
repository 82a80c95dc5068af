//! What the mesh formats share: vertex arrays, smooth normals, and triangles to records.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use super::placement::Placement;
use super::source::Source;
use super::spill::{Budget, Column};
use super::stream::StreamOptions;
use super::vector::{cross, dot, normalize, sub};
use crate::ImportError;
use crate::record::{Record, RecordStream};

/// Reads triangles one at a time, in the file's order.
pub(super) trait TriangleReader {
    /// The next triangle; none at the end.
    fn next(&mut self) -> Result<Option<Corners>, ImportError>;
    /// Goes back to before the first triangle.
    fn rewind(&mut self) -> Result<(), ImportError>;
    fn source(&self) -> &Source;
    fn budget(&mut self) -> &mut Budget;
}

/// A triangle in the mesh's own space.
#[derive(Clone, Copy)]
pub(super) struct Corners {
    pub p: [[f64; 3]; 3],
    pub n: Option<[[f32; 3]; 3]>,
    pub uv: Option<[[f32; 2]; 3]>,
    /// Numbers of the vertices, for smooth normals; no format without them asks for any.
    pub vertices: [usize; 3],
}

/// A reader as a stream of records.
pub(super) struct MeshStream<'a, R: TriangleReader> {
    reader: R,
    placement: Placement,
    flip_v: bool,
    /// Sums of weighted normals by vertex, where smooth normals were asked for and the file has none.
    smooth: Option<Vec<[f64; 3]>>,
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
        let smooth = if wanted { vertex_normals(&mut reader)? } else { None };
        Ok(MeshStream {
            reader,
            placement: options.placement,
            flip_v: options.flip_v,
            smooth,
            spilled: options.spilled,
            counted: 0,
        })
    }

    fn normals(&self, vertices: [usize; 3]) -> Option<[[f32; 3]; 3]> {
        let sums = self.smooth.as_ref()?;
        let [a, b, c] = vertices.map(|v| sums.get(v).and_then(|s| normalize(*s)).map(|n| n.map(|x| x as f32)));
        Some([a?, b?, c?])
    }
}

impl<R: TriangleReader> RecordStream for MeshStream<'_, R> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let mut n = 0;
        while n < max {
            let Some(corners) = self.reader.next()? else { break };
            let mut uv = corners.uv;
            if self.flip_v {
                uv.iter_mut().flatten().for_each(|uv| uv[1] = 1.0 - uv[1]);
            }
            let normals = corners.n.or_else(|| self.normals(corners.vertices));
            out.push(self.placement.triangle(corners.p, normals, uv));
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

/// Sums per vertex of the unit normals of its triangles, weighted by the angle at the vertex (Thuermer and Wuethrich,
/// "Computing vertex normals from polygonal facets", JGT 3(1), 1998: Mitsuba's rule); none if the file has normals itself.
fn vertex_normals(reader: &mut impl TriangleReader) -> Result<Option<Vec<[f64; 3]>>, ImportError> {
    let mut sums: Vec<[f64; 3]> = vec![];
    while let Some(corners) = reader.next()? {
        if corners.n.is_some() {
            reader.rewind()?;
            return Ok(None);
        }
        let needed = corners.vertices.into_iter().max().unwrap_or(0) + 1;
        if needed > sums.len() {
            let grown = needed.max(sums.len() + sums.len() / 2);
            if !reader.budget().take(((grown - sums.len()) * size_of::<[f64; 3]>()) as u64) {
                return reader.source().fail_limit(
                    "smooth normals of so many vertices exceed the vertex budget: write normals into the file, set \
                     face_normals, or raise the budget",
                );
            }
            sums.resize(grown, [0.0; 3]);
        }
        let [a, b, c] = corners.p;
        let Some(normal) = normalize(cross(sub(b, a), sub(c, a))) else { continue };
        for (i, vertex) in corners.vertices.into_iter().enumerate() {
            let [at, next, last] = [0, 1, 2].map(|k| corners.p[(i + k) % 3]);
            if let (Some(u), Some(v)) = (normalize(sub(next, at)), normalize(sub(last, at))) {
                let angle = libm::acos(dot(u, v).clamp(-1.0, 1.0));
                for (sum, n) in sums[vertex].iter_mut().zip(normal) {
                    *sum += angle * n;
                }
            }
        }
    }
    reader.rewind()?;
    Ok(Some(sums))
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
