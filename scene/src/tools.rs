//! Larger and worse-ordered scenes out of one, as binary PLY: what `rayherd scene subdivide|replicate|interleave` does.
//!
//! All of them stream: memory does not grow with the mesh. Positions are written in double precision, so that the points computed
//! here are exact; normals, texture coordinates and materials are left out. Each triangle has vertices of its own (with those
//! it was divided into it shares them): a closed surface stays closed because equal corners have equal coordinates.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::ImportError;
use crate::import::temporary_file;
use crate::record::{Record, RecordSource};

/// Most levels of [`subdivide`]: one triangle becomes 65,536, which are in memory together.
pub const MAX_LEVELS: u32 = 8;
/// Most strands of [`interleave`].
pub const MAX_STRANDS: u32 = 4096;

type Triangle = [[f64; 3]; 3];

/// Why a tool did not write its file.
#[derive(Debug, thiserror::Error)]
pub enum ToolError {
    /// The source cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// The file cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A setting is out of range, or the source has what the tool cannot take.
    #[error("{0}")]
    Refused(String),
}

/// What was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Written {
    /// Triangles in the source.
    pub read: u64,
    /// Triangles in the file.
    pub triangles: u64,
    /// Bytes of the file.
    pub bytes: u64,
}

/// Each triangle becomes four by the midpoints of its edges, `levels` times: the same surface of 4^levels as many triangles.
///
/// A midpoint is `a / 2 + b / 2` in f64, the same from both sides of an edge, so a closed mesh stays closed.
///
/// # Errors
/// The source cannot be read or has spheres, the file cannot be written or would have more vertices than PLY can number, or
/// there are more than [`MAX_LEVELS`].
pub fn subdivide(source: &dyn RecordSource, levels: u32, out: &Path) -> Result<Written, ToolError> {
    if levels > MAX_LEVELS {
        return Err(ToolError::Refused(format!(
            "{levels} levels: give at most {MAX_LEVELS}, or subdivide the result again"
        )));
    }
    let grid = Grid::new(levels);
    check_vertices(source, grid.len() as u64)?;
    let mut file = PlyWriter::new(out)?;
    let mut points = vec![];
    let read = each(source, &mut |t| {
        grid.points(t, &mut points);
        points.iter().try_for_each(|p| file.vertex(*p))
    })?;
    file.finish(read, &grid.triangles(), grid.len())
}

/// Copies on a grid of `copies` along x, y and z, `step` apart: one whole copy after another, x fastest. The source is read once
/// for each.
///
/// # Errors
/// As [`subdivide`]; and no copies along an axis, or a step that is not finite.
pub fn replicate(
    source: &dyn RecordSource,
    copies: [u32; 3],
    step: [f64; 3],
    out: &Path,
) -> Result<Written, ToolError> {
    if copies.contains(&0) {
        return Err(ToolError::Refused(format!("{copies:?} copies: give at least 1 along each axis")));
    }
    if step.iter().any(|x| !x.is_finite()) {
        return Err(ToolError::Refused(format!("copies {step:?} apart: the distances should be finite")));
    }
    check_vertices(source, copies.iter().fold(3u64, |n, &c| n.saturating_mul(c.into())))?;
    let mut file = PlyWriter::new(out)?;
    let mut read = 0;
    for z in 0..copies[2] {
        for y in 0..copies[1] {
            for x in 0..copies[0] {
                let offset = [f64::from(x) * step[0], f64::from(y) * step[1], f64::from(z) * step[2]];
                read =
                    each(source, &mut |t| t.iter().try_for_each(|p| file.vertex([0, 1, 2].map(|k| p[k] + offset[k]))))?;
            }
        }
    }
    file.finish(read, &[[0, 1, 2]], 3)
}

/// The same triangles in a bad order: cut into `strands` equal runs, then one of each run in turn, so that what is together in the
/// file is far apart in the source. With as many strands as splits every split spans the whole scene.
///
/// The triangles go through a temporary file in the folder of `out`.
///
/// # Errors
/// As [`subdivide`]; and a number of strands outside 1..=[`MAX_STRANDS`].
pub fn interleave(source: &dyn RecordSource, strands: u32, out: &Path) -> Result<Written, ToolError> {
    if !(1..=MAX_STRANDS).contains(&strands) {
        return Err(ToolError::Refused(format!("{strands} strands: give 1 to {MAX_STRANDS}")));
    }
    let mut file = PlyWriter::new(out)?;
    let io = |source| ToolError::Write { path: out.into(), source };
    let mut raw = BufWriter::with_capacity(1 << 20, temporary_file(folder_of(out)).map_err(io)?);
    let read = each(source, &mut |t| raw.write_all(bytemuck::bytes_of(&t)).map_err(io))?;
    let mut raw = raw.into_inner().map_err(|e| io(e.into_error()))?;
    refuse_vertices(read, 3)?;

    let length = read.div_ceil(strands.into()).max(1);
    let strand = |first: u64| Strand { next: first, end: (first + length).min(read), waiting: vec![].into_iter() };
    let mut all: Vec<Strand> = (0..read).step_by(length as usize).map(strand).collect();
    for _ in 0..length {
        for strand in &mut all {
            if let Some(t) = strand.next(&mut raw).map_err(io)? {
                t.iter().try_for_each(|p| file.vertex(*p))?;
            }
        }
    }
    file.finish(read, &[[0, 1, 2]], 3)
}

/// A run of triangles in a raw file, read in blocks.
struct Strand {
    next: u64,
    end: u64,
    waiting: std::vec::IntoIter<Triangle>,
}

impl Strand {
    /// Triangles of one block: with the most strands, 74 MB in memory.
    const BLOCK: u64 = 256;

    fn next(&mut self, raw: &mut File) -> io::Result<Option<Triangle>> {
        if self.waiting.len() == 0 && self.next < self.end {
            let mut block: Vec<Triangle> = vec![[[0.0; 3]; 3]; (self.end - self.next).min(Self::BLOCK) as usize];
            raw.seek(SeekFrom::Start(self.next * size_of::<Triangle>() as u64))?;
            raw.read_exact(bytemuck::cast_slice_mut(&mut block))?;
            self.next += block.len() as u64;
            self.waiting = block.into_iter();
        }
        Ok(self.waiting.next())
    }
}

/// The points of a triangle divided `n` times along each edge, n a power of two: (i, j) with i + j <= n, j slowest.
struct Grid {
    n: usize,
}

impl Grid {
    fn new(levels: u32) -> Self {
        Grid { n: 1 << levels }
    }

    fn len(&self) -> usize {
        (self.n + 1) * (self.n + 2) / 2
    }

    fn index(&self, i: usize, j: usize) -> usize {
        // rows of n + 1, n, n - 1, ... points
        j * (self.n + 1) - j * j.saturating_sub(1) / 2 + i
    }

    fn points(&self, [a, b, c]: Triangle, out: &mut Vec<[f64; 3]>) {
        let n = self.n;
        out.clear();
        out.resize(self.len(), [0.0; 3]);
        out[self.index(0, 0)] = a;
        out[self.index(n, 0)] = b;
        out[self.index(0, n)] = c;
        let mut half = n / 2;
        while half > 0 {
            for j in (0..=n).step_by(half) {
                for i in (0..=n - j).step_by(half) {
                    let (p, q) = match (i / half % 2, j / half % 2) {
                        (0, 0) => continue,
                        (1, 0) => ((i - half, j), (i + half, j)),
                        (0, _) => ((i, j - half), (i, j + half)),
                        _ => ((i - half, j + half), (i + half, j - half)),
                    };
                    let (p, q) = (out[self.index(p.0, p.1)], out[self.index(q.0, q.1)]);
                    out[self.index(i, j)] = [0, 1, 2].map(|k| p[k] / 2.0 + q[k] / 2.0);
                }
            }
            half /= 2;
        }
    }

    fn triangles(&self) -> Vec<[u32; 3]> {
        let mut out = vec![];
        for j in 0..self.n {
            for i in 0..self.n - j {
                let at = |i, j| self.index(i, j) as u32;
                out.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 2 <= self.n {
                    out.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
        out
    }
}

/// Refuses what would have too many vertices before any is written: for it the source is read once more.
fn check_vertices(source: &dyn RecordSource, each_makes: u64) -> Result<(), ToolError> {
    let mut stream = source.open_places()?;
    let (mut records, mut n) = (Vec::with_capacity(4096), 0);
    while stream.next(&mut records, 4096)? > 0 {
        n += records.len() as u64;
        refuse_vertices(n, each_makes)?;
        records.clear();
    }
    Ok(())
}

fn refuse_vertices(triangles: u64, each_makes: u64) -> Result<(), ToolError> {
    let vertices = triangles.saturating_mul(each_makes);
    if vertices > u64::from(u32::MAX) {
        return Err(ToolError::Refused(format!(
            "{triangles} triangles or more would have {vertices} vertices; PLY numbers 4294967295 at most: take fewer levels or \
             copies, or make several files (a folder of meshes is a scene)"
        )));
    }
    Ok(())
}

/// Passes every triangle of a source to `f`; how many there are.
fn each(source: &dyn RecordSource, f: &mut dyn FnMut(Triangle) -> Result<(), ToolError>) -> Result<u64, ToolError> {
    let mut stream = source.open()?;
    let (mut records, mut n) = (Vec::with_capacity(4096), 0);
    loop {
        records.clear();
        if stream.next(&mut records, 4096)? == 0 {
            return Ok(n);
        }
        for record in &records {
            match record {
                Record::Triangle(t) => f(t.p)?,
                Record::Sphere(_) => {
                    return Err(ToolError::Refused(
                        "the source has exact spheres, which are no triangles: take a mesh".into(),
                    ));
                }
            }
            n += 1;
        }
    }
}

/// Writes vertices as they come, then triangles by a pattern that repeats; the counts are filled in at the end.
struct PlyWriter {
    path: PathBuf,
    partial: PathBuf,
    file: BufWriter<File>,
    vertices: u64,
    done: bool,
}

/// Length of the header: a comment makes up for the lengths of the counts.
const HEADER: usize = 256;

impl PlyWriter {
    fn new(path: &Path) -> Result<Self, ToolError> {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
        let Some(name) = name else {
            return Err(ToolError::Refused(format!("{} is no name of a file", path.display())));
        };
        let partial = path.with_file_name(format!(".{name}.{}.partial", std::process::id()));
        let io = |source| ToolError::Write { path: partial.clone(), source };
        let mut file = BufWriter::with_capacity(1 << 20, File::create(&partial).map_err(io)?);
        file.write_all(&[b' '; HEADER]).map_err(io)?;
        Ok(PlyWriter { path: path.into(), partial, file, vertices: 0, done: false })
    }

    fn vertex(&mut self, p: [f64; 3]) -> Result<(), ToolError> {
        self.vertices += 1;
        // a source that grew since it was counted
        refuse_vertices(self.vertices, 1)?;
        let bytes = p.map(f64::to_le_bytes);
        self.file.write_all(bytes.as_flattened()).map_err(|e| self.error(e))
    }

    /// Writes `pattern` once for every `group` vertices, and the header; then the file gets its name.
    fn finish(mut self, read: u64, pattern: &[[u32; 3]], group: usize) -> Result<Written, ToolError> {
        let groups = self.vertices / group as u64;
        let triangles = groups * pattern.len() as u64;
        self.complete(groups, pattern, group as u32, triangles).map_err(|e| self.error(e))?;
        self.done = true;
        let bytes = HEADER as u64 + 24 * self.vertices + 13 * triangles;
        Ok(Written { read, triangles, bytes })
    }

    fn complete(&mut self, groups: u64, pattern: &[[u32; 3]], group: u32, triangles: u64) -> io::Result<()> {
        for g in 0..groups {
            // below 2^32: the vertices were counted
            let base = g as u32 * group;
            for t in pattern {
                let mut face = [3u8; 13];
                face[1..].copy_from_slice(t.map(|i| (base + i).to_le_bytes()).as_flattened());
                self.file.write_all(&face)?;
            }
        }
        let text = format!(
            "element vertex {}\nproperty double x\nproperty double y\nproperty double z\nelement face {triangles}\n\
             property list uchar uint vertex_indices\nend_header\n",
            self.vertices
        );
        let head = "ply\nformat binary_little_endian 1.0\ncomment ";
        let padding = ".".repeat(HEADER - head.len() - 1 - text.len());
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(format!("{head}{padding}\n{text}").as_bytes())?;
        self.file.flush()?;
        std::fs::rename(&self.partial, &self.path)
    }

    fn error(&self, source: io::Error) -> ToolError {
        ToolError::Write { path: self.path.clone(), source }
    }
}

impl Drop for PlyWriter {
    fn drop(&mut self) {
        if !self.done {
            // nothing is left of a file that could not be finished; an error here would hide the first one
            let _ = std::fs::remove_file(&self.partial);
        }
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests;
