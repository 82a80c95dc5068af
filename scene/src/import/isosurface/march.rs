//! Marching cubes over two slices at a time.
//!
//! No vertex is cached: a vertex is a pure function of its edge (place and values of the lower and the upper corner), so every
//! cell around the edge computes the same bits, and computing it four times costs less than keeping it.

use super::{interior, tables};
use crate::description::Affine;
use tables::{FACE_CORNERS, MAX_CENTERS, TABLES};

/// One slice of samples with a bit per sample: inside or not. Rows of bits begin at a word.
#[derive(Clone, Debug, Default)]
pub struct Slice {
    /// Samples, x fastest.
    pub samples: Vec<f64>,
    bits: Vec<u64>,
}

impl Slice {
    /// Marks the samples above `iso`. A sample that is NaN is outside.
    pub fn mark(&mut self, width: usize, iso: f64) {
        self.bits.clear();
        for row in self.samples.chunks_exact(width) {
            for chunk in row.chunks(64) {
                let word = chunk.iter().enumerate().fold(0, |w, (i, &v)| w | u64::from(v > iso) << i);
                self.bits.push(word);
            }
        }
    }
}

/// What does not change during a pass.
#[derive(Clone, Copy, Debug)]
pub struct Grid {
    /// Samples per row.
    pub width: usize,
    /// Rows per slice.
    pub height: usize,
    /// The surface's value.
    pub iso: f64,
    /// From sample numbers to the world.
    pub to_world: Affine,
    /// Whether `to_world` mirrors, so that triangles are turned over.
    pub mirrored: bool,
    /// Cells that the surface does not cross are looked into all the same.
    pub thorough: bool,
}

/// Where a pass stands within a slab: cells are visited by row, then along the row.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cursor {
    row: usize,
    word: usize,
    /// Cells of the current word that are still to be done.
    cells: u64,
    started: bool,
    /// Cells that were not looked into.
    pub passed: u64,
}

/// Cells of a slab between two slices.
#[derive(Clone, Copy, Debug)]
pub struct Slab<'a> {
    /// Number of the lower slice.
    pub z: usize,
    /// The lower slice.
    pub low: &'a Slice,
    /// The upper slice.
    pub high: &'a Slice,
}

impl Grid {
    /// Gives the triangles of the slab's next cell that the surface crosses to `emit`, in world space, counter-clockwise seen
    /// from outside the material; false at the slab's end.
    pub fn next_cell(&self, slab: &Slab, at: &mut Cursor, emit: impl FnMut([[f64; 3]; 3])) -> bool {
        let words = self.width.div_ceil(64);
        loop {
            if at.cells != 0 {
                let bit = at.cells.trailing_zeros() as usize;
                at.cells &= at.cells - 1;
                self.cell(slab, at.word * 64 + bit, at.row, emit);
                return true;
            }
            if !at.started {
                at.started = true;
            } else if at.word + 1 < words {
                at.word += 1;
            } else {
                at.word = 0;
                at.row += 1;
            }
            if at.row + 1 >= self.height {
                return false;
            }
            let valid = self.valid(at.word);
            at.cells = if self.thorough { valid } else { self.crossed(slab, at.row, at.word, words) & valid };
            at.passed += u64::from((valid & !at.cells).count_ones());
        }
    }

    /// Cells of a word of cells that are there.
    fn valid(&self, word: usize) -> u64 {
        let cells = (self.width - 1).saturating_sub(word * 64).min(64);
        if cells == 64 { !0 } else { (1 << cells) - 1 }
    }

    /// Cells of a word of cells that have corners on both sides; beyond the row anything.
    fn crossed(&self, slab: &Slab, row: usize, word: usize, words: usize) -> u64 {
        let (mut any, mut all) = (0, !0);
        for bits in [&slab.low.bits, &slab.high.bits] {
            for r in [row, row + 1] {
                let at = r * words + word;
                let here = bits[at];
                // the upper neighbour in x
                let next = here >> 1 | if word + 1 < words { bits[at + 1] << 63 } else { 0 };
                any |= here | next;
                all &= here & next;
            }
        }
        any & !all
    }

    #[inline]
    fn cell(&self, slab: &Slab, x: usize, y: usize, mut emit: impl FnMut([[f64; 3]; 3])) {
        let at = y * self.width + x;
        let (low, high) = (&slab.low.samples, &slab.high.samples);
        let up = at + self.width;
        let values = [low[at], low[at + 1], low[up], low[up + 1], high[at], high[at + 1], high[up], high[up + 1]];
        let d = values.map(|v| v - self.iso);
        let (entry, edges) = classify(&d);
        let (mut triangles, mut centers) = (&entry.triangles, &entry.centers);
        if !entry.tubes.is_empty() {
            let mut region = entry.region;
            interior::connect(&d, &mut region);
            let by_lewiner = entry.outsides_opposed && interior::lewiner_joins_outsides(&d);
            let tube =
                entry.tubes.iter().find(|t| by_lewiner || region[t.joins[0] as usize] == region[t.joins[1] as usize]);
            if let Some(tube) = tube {
                (triangles, centers) = (&tube.triangles, &tube.centers);
            }
        }
        let corner = [x as f64, y as f64, slab.z as f64];
        let mut vertices = [[0.0; 3]; 12 + MAX_CENTERS];
        let mut edges = edges;
        while edges != 0 {
            let e = edges.trailing_zeros() as usize;
            edges &= edges - 1;
            vertices[e] = self.vertex(corner, e, &values);
        }
        for (i, &of) in centers.iter().enumerate() {
            vertices[12 + i] = mean(&vertices, of);
        }
        for t in triangles {
            let [a, b, c] = t.map(|v| vertices[v as usize]);
            emit(if self.mirrored { [a, c, b] } else { [a, b, c] });
        }
    }

    /// The surface's place on an edge, in the world.
    #[inline]
    fn vertex(&self, corner: [f64; 3], edge: usize, values: &[f64; 8]) -> [f64; 3] {
        let [a, b] = tables::EDGE_CORNERS[edge];
        let (low, high) = (values[a as usize], values[b as usize]);
        // within [0, 1], as rounding is monotonic
        let t = (self.iso - low) / (high - low);
        let mut p = [corner[0] + f64::from(a & 1), corner[1] + f64::from(a >> 1 & 1), corner[2] + f64::from(a >> 2)];
        p[edge / 4] += t;
        self.to_world.point(p)
    }
}

/// The table's entry for corner values minus the surface's value, and the crossed edges.
#[inline]
pub fn classify(d: &[f64; 8]) -> (&'static tables::Entry, u16) {
    let config = d.iter().enumerate().fold(0, |m, (i, &v)| m | usize::from(v > 0.0) << i);
    let case = &TABLES.cases[config];
    let mut index = case.first as usize;
    if case.ambiguous != 0 {
        let mut bit = 1;
        for (f, c) in FACE_CORNERS.iter().enumerate() {
            if case.ambiguous >> f & 1 == 1 {
                let [a, b, p, q] = c.map(|c| d[c as usize]);
                if joined(a, b, p, q) {
                    index += bit;
                }
                bit <<= 1;
            }
        }
    }
    (&TABLES.entries[index], case.edges)
}

/// The asymptotic decider: whether the insides of an ambiguous face are joined, its corners given around. The same from both
/// sides of the face: the products do not depend on where the walk starts. A tie leaves the insides apart.
fn joined(a: f64, b: f64, c: f64, d: f64) -> bool {
    if a > 0.0 { a * c > b * d } else { b * d > a * c }
}

fn mean(vertices: &[[f64; 3]], of: u16) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for e in (0..12).filter(|e| of >> e & 1 == 1) {
        for k in 0..3 {
            sum[k] += vertices[e][k];
        }
    }
    sum.map(|s| s / f64::from(of.count_ones()))
}
