//! Mitsuba's `serialized` meshes, versions 3 and 4: zlib data of little-endian arrays, several meshes in a file with a list of their places at its end.

use std::path::Path;

use super::mesh::{Corners, Positions, TriangleReader, budget};
use super::source::Source;
use super::spill::{Budget, Column};
use super::stream::StreamOptions;
use crate::ImportError;

/// First number of every mesh.
const MAGIC: u16 = 0x041c;
const HAS_NORMALS: u32 = 1;
const HAS_UV: u32 = 2;
const HAS_COLORS: u32 = 8;
const FACE_NORMALS: u32 = 0x10;
const SINGLE: u32 = 0x1000;
const DOUBLE: u32 = 0x2000;
/// Longest name of a mesh, bytes.
const MAX_NAME: usize = 4096;

/// A mesh whose vertices are read, at its triangles.
pub(super) struct SerializedReader {
    source: Source,
    budget: Budget,
    positions: Positions,
    normals: Option<Column<[f32; 3]>>,
    uv: Option<Column<[f32; 2]>>,
    face_normals: bool,
    /// Bytes of an index: 4, or 8 in meshes of more than 2^32 vertices.
    index: usize,
    count: u64,
    done: u64,
}

impl SerializedReader {
    /// Finds mesh number `index` and reads its vertices.
    pub fn open(path: &Path, index: u32, options: &StreamOptions) -> Result<Self, ImportError> {
        let mut file = Source::open(path)?;
        let (at, version) = find(&mut file, index)?;
        let mut source = file.into_zlib(at + 4)?;
        let flags = u32_of(&mut source)?;
        if version == 4 {
            let mut length = 0;
            while source.exact(1)?[0] != 0 {
                length += 1;
                if length > MAX_NAME {
                    return source.fail_byte("the mesh's name does not end: this is no serialized mesh");
                }
            }
        }
        let double = match flags & (SINGLE | DOUBLE) {
            SINGLE => false,
            DOUBLE => true,
            _ => return source.fail_byte(format!("flags {flags:#x} say neither single nor double precision")),
        };
        let (vertices, count) = (u64_of(&mut source)?, u64_of(&mut source)?);
        let size = if double { 8 } else { 4 };
        let numbers = |flag, n| if flags & flag != 0 { n } else { 0 };
        let (normal, uv, color) = (numbers(HAS_NORMALS, 3), numbers(HAS_UV, 2), numbers(HAS_COLORS, 3));
        let index = if vertices > u64::from(u32::MAX) { 8 } else { 4 };
        let needed = vertices
            .checked_mul((3 + normal + uv + color) * size)
            .and_then(|v| v.checked_add(count.checked_mul(3 * index)?));
        let left = source.most_left();
        if needed.is_none_or(|needed| needed > left) {
            return source.fail_limit(format!(
                "the head says {vertices} vertices and {count} triangles, more than the file can hold: it is truncated or broken, export it again"
            ));
        }
        let mut budget = budget(options);
        let positions = if double {
            Positions::Double(column(&mut source, &mut budget, vertices, true, |v: [f64; 3]| v)?)
        } else {
            Positions::Single(column(&mut source, &mut budget, vertices, false, |v: [f64; 3]| v.map(|x| x as f32))?)
        };
        let normals = match normal {
            0 => None,
            _ => Some(column(&mut source, &mut budget, vertices, double, |v: [f64; 3]| v.map(|x| x as f32))?),
        };
        let uv = match uv {
            0 => None,
            _ => Some(column(&mut source, &mut budget, vertices, double, |v: [f64; 2]| v.map(|x| x as f32))?),
        };
        source.skip(vertices * color * size)?;
        let face_normals = flags & FACE_NORMALS != 0;
        let (normals, index) = (normals.filter(|_| !face_normals), index as usize);
        Ok(SerializedReader { source, budget, positions, normals, uv, face_normals, index, count, done: 0 })
    }

    /// Whether mesh number `index` of a file has colours, and the bytes read to know.
    pub fn has_colors(path: &Path, index: u32) -> Result<(bool, u64), ImportError> {
        let mut file = Source::open_head(path)?;
        let (at, _) = find(&mut file, index)?;
        let mut source = file.into_zlib(at + 4)?;
        let flags = u32_of(&mut source)?;
        Ok((flags & HAS_COLORS != 0, source.bytes_read()))
    }

    /// The mesh says that it has no smooth normals and wants none.
    pub fn face_normals(&self) -> bool {
        self.face_normals
    }
}

/// Byte where mesh number `index` begins, and its version.
fn find(file: &mut Source, index: u32) -> Result<(u64, u16), ImportError> {
    let Some(length) = file.length() else {
        return file.fail_byte("a gzip file of serialized meshes, which are packed already: unpack it");
    };
    let version = header(file, length, 0)?;
    if index == 0 {
        return Ok((0, version));
    }
    if length < 8 {
        return file.fail_byte("the file is too short for a list of meshes");
    }
    let count = u32::from_le_bytes(bytes_at(file, length - 4)?);
    if index >= count {
        return file.fail_byte(format!("shape_index {index}, but the file has {count} meshes"));
    }
    let size = if version == 4 { 8 } else { 4 };
    let Some(entry) = (length - 4).checked_sub(size * u64::from(count - index)) else {
        return file.fail_byte(format!("a list of {count} meshes is longer than the file"));
    };
    let at = match version {
        4 => u64::from_le_bytes(bytes_at(file, entry)?),
        _ => u32::from_le_bytes(bytes_at(file, entry)?).into(),
    };
    if at >= length {
        return file.fail_byte(format!("mesh {index} begins at byte {at}, beyond the end of the file"));
    }
    Ok((at, header(file, length, at)?))
}

fn bytes_at<const N: usize>(file: &mut Source, at: u64) -> Result<[u8; N], ImportError> {
    let mut out = [0; N];
    file.read_at(at, &mut out)?;
    Ok(out)
}

/// Version of the mesh that begins at a byte.
fn header(file: &mut Source, length: u64, at: u64) -> Result<u16, ImportError> {
    if length - at < 4 {
        return file.fail_byte("the file ends within the head of a mesh: it is truncated, get it again");
    }
    let head: [u8; 4] = bytes_at(file, at)?;
    let word = |i: usize| u16::from_le_bytes([head[i], head[i + 1]]);
    match (word(0), word(2)) {
        (MAGIC, version @ (3 | 4)) => Ok(version),
        (MAGIC, version) => file.fail_byte(format!("a serialized mesh of version {version}; 3 and 4 are read")),
        _ => file.fail_byte("this is no serialized mesh: it does not begin with 0x041c"),
    }
}

/// Rows of `N` numbers, single or double.
fn column<const N: usize, T: bytemuck::Pod>(
    source: &mut Source,
    budget: &mut Budget,
    rows: u64,
    double: bool,
    to: impl Fn([f64; N]) -> T,
) -> Result<Column<T>, ImportError> {
    let mut out = Column::new();
    let size = if double { 8 } else { 4 };
    for _ in 0..rows {
        let bytes = source.exact(N * size)?;
        let row: [f64; N] = std::array::from_fn(|i| {
            let b = &bytes[i * size..];
            if double {
                f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]])
            } else {
                f32::from_le_bytes([b[0], b[1], b[2], b[3]]).into()
            }
        });
        out.push(to(row), budget).map_err(|e| source.io(e))?;
    }
    Ok(out)
}

fn u32_of(source: &mut Source) -> Result<u32, ImportError> {
    let b = source.exact(4)?;
    Ok(u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

fn u64_of(source: &mut Source) -> Result<u64, ImportError> {
    let b = source.exact(8)?;
    Ok(u64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
}

impl TriangleReader for SerializedReader {
    type Triangle = [u64; 3];

    fn next(&mut self) -> Result<Option<[u64; 3]>, ImportError> {
        if self.done == self.count {
            return Ok(None);
        }
        let mut vertices = [0; 3];
        for vertex in &mut vertices {
            *vertex = if self.index == 8 { u64_of(&mut self.source)? } else { u32_of(&mut self.source)?.into() };
            if *vertex >= self.positions.len() as u64 {
                let message = format!("triangle {}: vertex {vertex} of {}", self.done, self.positions.len());
                return self.source.fail_byte(message);
            }
        }
        self.done += 1;
        Ok(Some(vertices))
    }

    fn corners(&self, triangle: &[u64; 3]) -> Corners {
        // every index was compared with the number of vertices
        let vertices = Self::vertices(triangle);
        Corners {
            p: vertices.map(|i| self.positions.get(i).unwrap_or([f64::NAN; 3])),
            n: self.normals.as_ref().map(|n| vertices.map(|i| n.get(i).unwrap_or_default())),
            uv: self.uv.as_ref().map(|uv| vertices.map(|i| uv.get(i).unwrap_or_default())),
            attribute: None,
        }
    }

    fn has_normals(&self, _: &[u64; 3]) -> bool {
        self.normals.is_some()
    }

    fn vertices(triangle: &[u64; 3]) -> [usize; 3] {
        triangle.map(|i| i as usize)
    }

    fn vertex_count(&self) -> usize {
        self.positions.len()
    }

    fn source(&self) -> &Source {
        &self.source
    }

    fn budget(&mut self) -> &mut Budget {
        &mut self.budget
    }
}

#[cfg(test)]
mod tests;
