//! Wavefront OBJ: `v`, `vt`, `vn` and `f`, with negative (relative) indices and continued lines; polygons are fanned from
//! their first corner. Materials (`usemtl`) cut a file into parts; groups, lines, points and free-form surfaces are passed over.

use std::collections::HashMap;
use std::path::Path;

use bytemuck::{Pod, Zeroable};

use super::mesh::{Corners, Positions, TriangleReader, budget};
use super::number::{Number, number};
use super::source::{Source, Words, show};
use super::spill::{Budget, Column};
use super::stream::StreamOptions;
use crate::ImportError;
use crate::description::Parts;

/// Longest line with its continuations.
const MAX_LINE: usize = 1 << 20;

/// Numbers of a corner's `v`, `vt` and `vn`, [`NONE`] where it has none.
type Corner = [u32; 3];
const NONE: u32 = u32::MAX;

/// An OBJ file being read.
pub(super) struct ObjReader {
    source: Source,
    budget: Budget,
    positions: Positions,
    uv: Column<[f32; 2]>,
    normals: Column<[f32; 3]>,
    /// Corners of the polygon being fanned, and the triangles made of it.
    polygon: Vec<Corner>,
    fanned: usize,
    line: Vec<u8>,
    /// Where in it each of the file's lines begins, but the first: of a line that goes on in others.
    joints: Vec<usize>,
    /// Whether anything was read that an OBJ file has.
    recognized: bool,
    parts: Option<PartNumbers>,
    /// Of what is read now.
    part: u32,
}

/// Which part a name means.
struct PartNumbers {
    by_name: HashMap<Vec<u8>, u32>,
    parts: Parts,
}

/// A triangle as numbers of what its corners have, and its part.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
pub(super) struct Face {
    corners: [Corner; 3],
    part: u32,
}

/// A `mtllib` statement: what it says, the line, and how many bytes of that stand before it.
pub(super) type LibraryNames = Vec<(String, u32, usize)>;

/// What stands before and in a file's first vertex.
pub(super) struct Head {
    /// The `mtllib` statements before the first vertex, face or `usemtl`.
    pub libraries: LibraryNames,
    /// Numbers of the first vertex, if that is what comes first.
    pub numbers: usize,
    /// Line of it.
    pub line: u32,
    /// Bytes read to find them.
    pub bytes_read: u64,
}

impl Head {
    /// What vertices have beside a position, which nothing here uses.
    pub fn passed_over(&self) -> Option<&'static str> {
        match self.numbers {
            0..=3 => None,
            4 | 5 => Some("weights of the obj's vertices are passed over"),
            _ => Some("colours of the obj's vertices are passed over: a ply with colours is read with them"),
        }
    }
}

/// The head of a file.
pub(super) fn head(path: &Path) -> Result<Head, ImportError> {
    let mut reader = ObjReader::new(Source::open_head(path)?, &StreamOptions::default(), None);
    let mut out = Head { libraries: vec![], numbers: 0, line: 0, bytes_read: 0 };
    while reader.read_line()? {
        let line = reader.line.trim_ascii_start();
        let (keyword, rest) = line.split_at(line.iter().position(u8::is_ascii_whitespace).unwrap_or(line.len()));
        match keyword {
            b"mtllib" => {
                let (line, at) = reader.place(reader.line.len() - rest.trim_ascii_start().len());
                out.libraries.push((name_of(rest), line, at));
            }
            b"v" => {
                let words = rest.split(|b| b.is_ascii_whitespace()).filter(|w| !w.is_empty());
                out.numbers = words.take_while(|w| w[0] != b'#').count();
                out.line = reader.source.place().1;
                break;
            }
            b"vn" | b"vt" | b"f" | b"usemtl" => break,
            _ => {}
        }
    }
    out.bytes_read = reader.source.bytes_read();
    Ok(out)
}

/// A name as messages and maps have it.
fn name_of(text: &[u8]) -> String {
    String::from_utf8_lossy(text.trim_ascii()).into_owned()
}

impl ObjReader {
    /// Opens a file whose materials are these parts.
    pub fn open(path: &Path, options: &StreamOptions, parts: Option<&Parts>) -> Result<Self, ImportError> {
        Ok(ObjReader::new(Source::open(path)?, options, parts))
    }

    fn new(source: Source, options: &StreamOptions, parts: Option<&Parts>) -> Self {
        let numbers = |parts: &Parts| PartNumbers {
            by_name: (1u32..).zip(&parts.names).map(|(n, name)| (name.clone().into_bytes(), n)).collect(),
            parts: parts.clone(),
        };
        ObjReader {
            source,
            budget: budget(options),
            positions: Positions::Double(Column::new()),
            uv: Column::new(),
            normals: Column::new(),
            polygon: vec![],
            fanned: 0,
            line: vec![],
            joints: vec![],
            recognized: false,
            parts: parts.map(numbers),
            part: 0,
        }
    }

    /// The part of what follows; its name stands at this byte of the line.
    fn use_material(&mut self, rest: &[u8], at: usize) -> Result<(), ImportError> {
        let Some(parts) = &self.parts else { return Ok(()) };
        let name = name_of(rest);
        self.part = match parts.by_name.get(name.as_bytes()) {
            Some(&part) => part,
            None if parts.parts.lenient || parts.parts.libraries.is_empty() => 0,
            None => {
                let message = format!(
                    "usemtl \"{name}\", which no mtllib of this file defines: add it there, or pass --albedo to use no materials"
                );
                return self.fail_at(at, message);
            }
        };
        Ok(())
    }

    /// Libraries are read before the file is.
    fn library(&self, rest: &[u8], at: usize) -> Result<(), ImportError> {
        let name = name_of(rest);
        match &self.parts {
            Some(parts) if !parts.parts.lenient && !parts.parts.libraries.contains(&name) => self.fail_at(
                at,
                format!("mtllib \"{name}\" stands after the first vertex, face or usemtl: move it to the top of the file, or pass --albedo to use no materials"),
            ),
            _ => Ok(()),
        }
    }

    /// Reads a line with its continuations into `self.line`; false at the end.
    fn read_line(&mut self) -> Result<bool, ImportError> {
        self.line.clear();
        self.joints.clear();
        loop {
            let Some(part) = self.source.line_bytes()? else {
                // the last one ends in a backslash
                self.joints.pop();
                return Ok(!self.line.is_empty());
            };
            let Some(part) = part.strip_suffix(b"\\") else {
                self.line.extend_from_slice(part);
                return Ok(true);
            };
            self.line.extend_from_slice(part);
            self.line.push(b' ');
            self.joints.push(self.line.len());
            if self.line.len() > MAX_LINE {
                let message = format!(
                    "a line longer than {MAX_LINE} bytes with its continuations: this is no OBJ file, or it is broken"
                );
                return self.source.fail_at(0, message);
            }
        }
    }

    /// Reads on to the next polygon; false at the end.
    fn next_polygon(&mut self) -> Result<bool, ImportError> {
        while self.read_line()? {
            let line = std::mem::take(&mut self.line);
            let mut words = Words::new(&line);
            let keyword = words.next().unwrap_or(b"");
            let is_face = keyword == b"f";
            match keyword {
                b"v" => self.vertex(words)?,
                b"vt" => self.texture_coordinate(words)?,
                b"vn" => self.normal(words)?,
                b"f" => self.face(words)?,
                b"usemtl" | b"mtllib" => {
                    words.next();
                    let (rest, at) = (after(&line, keyword), words.at());
                    if keyword == b"usemtl" { self.use_material(rest, at)? } else { self.library(rest, at)? }
                }
                _ => {}
            }
            self.line = line;
            if is_face {
                self.recognized = true;
                if self.polygon.len() >= 3 {
                    self.fanned = 0;
                    return Ok(true);
                }
            }
        }
        if !self.recognized && self.positions.len() == 0 {
            return self.source.fail_in(1, 0, "no vertex and no face in this file: it is no OBJ file, or it is empty");
        }
        Ok(false)
    }

    fn vertex(&mut self, words: Words) -> Result<(), ImportError> {
        let p = self.numbers::<f64, 3>(words, "v", 3)?;
        match &mut self.positions {
            Positions::Double(column) => column.push(p, &mut self.budget).map_err(|e| self.source.io(e)),
            Positions::Single(_) => unreachable!("made as double"),
        }
    }

    fn texture_coordinate(&mut self, words: Words) -> Result<(), ImportError> {
        let uv = self.numbers::<f32, 2>(words, "vt", 1)?;
        self.uv.push(uv, &mut self.budget).map_err(|e| self.source.io(e))
    }

    fn normal(&mut self, words: Words) -> Result<(), ImportError> {
        let n = self.numbers::<f32, 3>(words, "vn", 3)?;
        self.normals.push(n, &mut self.budget).map_err(|e| self.source.io(e))
    }

    /// The line of the file, and the byte of it, that a byte of the line with its continuations is.
    fn place(&self, at: usize) -> (u32, usize) {
        let before = self.joints.partition_point(|&joint| joint <= at);
        let start = if before == 0 { 0 } else { self.joints[before - 1] };
        (self.source.place().1 - (self.joints.len() - before) as u32, at - start)
    }

    /// An error at a byte of the line with its continuations.
    fn fail_at<T>(&self, at: usize, message: String) -> Result<T, ImportError> {
        let (line, at) = self.place(at);
        self.source.fail_in(line, at, message)
    }

    /// An error at the last word.
    fn fail_word<T>(&self, words: &Words, message: String) -> Result<T, ImportError> {
        self.fail_at(words.at(), message)
    }

    /// The first `N` numbers of a line, of which `least` must be there (others are 0).
    fn numbers<T: Number + Default + Copy, const N: usize>(
        &self,
        mut words: Words,
        keyword: &str,
        least: usize,
    ) -> Result<[T; N], ImportError> {
        let mut out = [T::default(); N];
        for (i, slot) in out.iter_mut().enumerate() {
            match words.next() {
                Some(word) => match number(word) {
                    Some(value) => *slot = value,
                    None => {
                        return self
                            .fail_word(&words, format!("\"{}\" where a number of {keyword} should be", show(word)));
                    }
                },
                None if i < least => {
                    let message = format!(
                        "{keyword} needs {least} number(s) and has {i}: the line is cut off, export the file again"
                    );
                    return self.fail_word(&words, message);
                }
                None => break,
            }
        }
        Ok(out)
    }

    /// Fills `self.polygon`.
    fn face(&mut self, mut words: Words) -> Result<(), ImportError> {
        self.polygon.clear();
        while let Some(word) = words.next() {
            if word[0] == b'#' {
                break;
            }
            let mut corner = [NONE; 3];
            let mut parts = word.split(|b| *b == b'/');
            for (k, slot) in corner.iter_mut().enumerate() {
                if let Some(part) = parts.next().filter(|p| !p.is_empty()) {
                    *slot = self.index(part, k, &words, word)?;
                }
            }
            if corner[0] == NONE || parts.next().is_some() {
                let message = format!("\"{}\" is no corner of the form v, v/vt, v//vn or v/vt/vn", show(word));
                return self.fail_word(&words, message);
            }
            self.polygon.push(corner);
        }
        Ok(())
    }

    /// A number from 1, or from -1 backwards, as a place in the array of `v`, `vt` or `vn`.
    fn index(&self, part: &[u8], kind: usize, words: &Words, word: &[u8]) -> Result<u32, ImportError> {
        let Some(value) = number::<i64>(part) else {
            return self.fail_word(words, format!("\"{}\" where a corner of a face should be", show(word)));
        };
        let seen = [self.positions.len(), self.uv.len(), self.normals.len()][kind] as i64;
        let index = if value < 0 { seen.checked_add(value) } else { value.checked_sub(1) };
        match index {
            Some(i) if (0..seen).contains(&i) && i < i64::from(NONE) => Ok(i as u32),
            Some(i) if (0..seen).contains(&i) => self
                .source
                .fail_limit(format!("more than {NONE} of one kind of vertex: cut the mesh into several files")),
            _ => {
                let name = ["v", "vt", "vn"][kind];
                let message = format!(
                    "index {value} of {name}, but {seen} of them stand above: a face names what stands before it, from 1, or from -1 backwards"
                );
                self.fail_word(words, message)
            }
        }
    }
}

/// What of a line stands after its first word.
fn after<'l>(line: &'l [u8], keyword: &[u8]) -> &'l [u8] {
    &line.trim_ascii_start()[keyword.len()..]
}

impl TriangleReader for ObjReader {
    type Triangle = Face;

    fn next(&mut self) -> Result<Option<Face>, ImportError> {
        if self.fanned + 2 >= self.polygon.len() && !self.next_polygon()? {
            return Ok(None);
        }
        self.fanned += 1;
        Ok(Some(Face { corners: [0, self.fanned, self.fanned + 1].map(|i| self.polygon[i]), part: self.part }))
    }

    fn corners(&self, triangle: &Face) -> Corners {
        // every index was compared with the numbers of its kind
        let all = |k: usize| {
            let has = triangle.corners.iter().all(|c| c[k] != NONE);
            has.then(|| triangle.corners.map(|c| c[k] as usize))
        };
        Corners {
            p: Self::vertices(triangle).map(|i| self.positions.get(i).unwrap_or([f64::NAN; 3])),
            n: all(2).map(|n| n.map(|i| self.normals.get(i).unwrap_or_default())),
            uv: all(1).map(|uv| uv.map(|i| self.uv.get(i).unwrap_or_default())),
            attribute: None,
        }
    }

    fn has_normals(&self, triangle: &Face) -> bool {
        triangle.corners.iter().all(|c| c[2] != NONE)
    }

    fn vertices(triangle: &Face) -> [usize; 3] {
        triangle.corners.map(|c| c[0] as usize)
    }

    fn part(triangle: &Face) -> u32 {
        triangle.part
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
