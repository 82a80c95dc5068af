//! The random numbers: a pure function of (seed, pixel, sample, branch, vertex, dimension).
//!
//! A pixel has two halves, the even and the odd samples, each an Owen-scrambled Sobol sequence of its own: sample `s` is point `s / 2`
//! of half `s & 1`. Dimensions 0 and 1 are the place on the film; vertex v (1 is the first hit) takes eight: [`BSDF`] and the
//! following. The sequence has 58 dimensions, for seven vertices; from the eighth on the numbers are padded: pairs of four-dimensional
//! sets (Sobol dimensions 0 to 3), each with the index shuffled by a key of its own.
//!
//! After splitting, child c of N of a sample with index i uses index `i N + c` for all dimensions but the film's, so that the
//! children of all samples together are one sequence. Indices stay below 2^32 (samples below 2^24, N at most [`MAX_SPLIT`]), so nothing repeats.
//!
//! Scrambling: hash-based Owen scrambling (Laine and Karras 2011; Burley 2020) with Vegdahl's constants, keyed by a
//! 64-bit hash of (seed, pixel, half, vertex) and the dimension.

mod joe_kuo;
#[cfg(test)]
mod tests;

pub use joe_kuo::DIMENSIONS;

use crate::math::hash::{mix32, mix64};
use crate::ray::PathKey;
use joe_kuo::MATRICES;

/// Most siblings at the first hit.
pub const MAX_SPLIT: u32 = 512;
/// Samples per pixel before anything repeats.
pub const MAX_SAMPLES: u32 = 1 << 24;

/// Two numbers for the direction sampled from the BSDF.
pub const BSDF: usize = 0;
/// One number to choose between parts of a BSDF.
pub const LOBE: usize = 2;
/// One number for Russian roulette.
pub const ROULETTE: usize = 3;
/// Two numbers for the point on a light.
pub const LIGHT: usize = 4;
/// One number to choose a light.
pub const LIGHT_CHOICE: usize = 6;
/// Numbers of a vertex.
pub const PER_VERTEX: usize = 8;

/// In place of a vertex's number, which stays below 2^16: the lens.
const LENS: u32 = 1 << 16;
/// Vertices that the sequence serves before padding.
const FULL_VERTICES: u32 = ((DIMENSIONS - 2) / PER_VERTEX) as u32;
/// Where dimensions 0 to 3 stand in [`TABLE`].
const FIRST_DIMENSIONS: usize = DIMENSIONS - 2;

/// The key of one half of one pixel: hash once, use for every vertex.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    key: u64,
    /// Index of the sample in its half.
    index: u32,
}

impl Stream {
    /// The numbers of a sample of a pixel.
    #[inline(always)]
    pub fn new(seed: u64, pixel: u32, sample: u32) -> Stream {
        let place = u64::from(pixel) << 1 | u64::from(sample & 1);
        Stream {
            key: mix64(mix64(seed ^ 0x9e37_79b9_7f4a_7c15) ^ place.wrapping_mul(0xd6e8_feb8_6659_fd93)),
            index: sample >> 1,
        }
    }

    /// The two numbers of the place on the film.
    #[inline(always)]
    pub fn film(&self) -> [u32; 2] {
        film_numbers(self.index, film_keys(self.key))
    }

    /// The two numbers of the place on a lens: padded, so that no other dimension moves.
    #[inline]
    pub fn lens(&self) -> [u32; 2] {
        let [a, b, ..] = self.vertex(LENS, 1, 0);
        [a, b]
    }

    /// The eight numbers of vertex `vertex` (1: first hit) of child `child` of `split`.
    #[inline(always)]
    pub fn vertex(&self, vertex: u32, split: u32, child: u32) -> [u32; PER_VERTEX] {
        let key = vertex_key(self.key, vertex);
        let index = self.index * split + child;
        let mut x = [0; PER_VERTEX];
        if vertex <= FULL_VERTICES {
            add_rows(&mut x, index, (vertex as usize - 1) * PER_VERTEX);
        } else {
            let mut y = [0; PER_VERTEX];
            add_rows(&mut x, shuffle(index, lane_key(key, 8)), FIRST_DIMENSIONS);
            add_rows(&mut y, shuffle(index, lane_key(key, 9)), FIRST_DIMENSIONS);
            x[4..].copy_from_slice(&y[..4]);
        }
        let mut out = [0; PER_VERTEX];
        for i in 0..PER_VERTEX {
            out[i] = scramble(x[i], lane_key(key, i as u32));
        }
        out
    }
}

/// Streams of one sample after the other: where neighbours are of one pixel, its keys are hashed once.
pub(crate) struct Streams {
    seed: u64,
    /// The last pixel; above 32 bits at first.
    pixel: u64,
    keys: [u64; 2],
    film: [[u32; 2]; 2],
}

impl Streams {
    pub(crate) fn new(seed: u64) -> Streams {
        Streams { seed, pixel: u64::MAX, keys: [0; 2], film: [[0; 2]; 2] }
    }

    /// [`Stream::new`].
    #[inline(always)]
    pub(crate) fn get(&mut self, pixel: u32, sample: u32) -> Stream {
        if self.pixel != u64::from(pixel) {
            self.pixel = u64::from(pixel);
            self.keys = [0, 1].map(|half| Stream::new(self.seed, pixel, half).key);
        }
        Stream { key: self.keys[(sample & 1) as usize], index: sample >> 1 }
    }

    /// What [`film_numbers`] wants for a sample.
    #[inline(always)]
    pub(crate) fn film(&mut self, pixel: u32, sample: u32) -> (u32, [u32; 2]) {
        if self.pixel != u64::from(pixel) {
            self.get(pixel, sample);
            self.film = self.keys.map(film_keys);
        }
        (sample >> 1, self.film[(sample & 1) as usize])
    }
}

/// The two numbers of the place on the film of a sample with an index in its half.
#[inline(always)]
pub(crate) fn film_numbers(index: u32, keys: [u32; 2]) -> [u32; 2] {
    // of dimension 0 the index is the point, with its bits reversed
    [scramble(index, keys[0]), scramble(pascal(index), keys[1])]
}

#[inline(always)]
fn film_keys(stream: u64) -> [u32; 2] {
    let key = vertex_key(stream, 0);
    [lane_key(key, 0), lane_key(key, 1)]
}

/// The point of dimension 1, with its bits reversed. Its matrix is Pascal's triangle modulo 2, where entry (k, j) is 1 if the bits of j are
/// among those of k (Lucas): so a bit of the result is the sum of the index's bits at all k that contain its j, an axis at a time.
#[inline(always)]
fn pascal(index: u32) -> u32 {
    let x = index ^ index >> 16;
    let x = x ^ (x & 0xff00_ff00) >> 8;
    let x = x ^ (x & 0xf0f0_f0f0) >> 4;
    let x = x ^ (x & 0xcccc_cccc) >> 2;
    x ^ (x & 0xaaaa_aaaa) >> 1
}

/// The slow twin of [`Stream`], straight from the definitions: the number of one dimension of one vertex; vertex 0 is the film with
/// dimensions 0 and 1.
pub fn number(seed: u64, key: &PathKey, split: u32, vertex: u32, dimension: usize) -> u32 {
    let half = Stream::new(seed, key.pixel, key.sample);
    let scrambles = vertex_key(half.key, vertex);
    let index = if vertex == 0 { half.index } else { half.index * split + u32::from(key.branch) };
    let (index, sobol_dimension) = if vertex == 0 {
        (index, dimension)
    } else if vertex <= FULL_VERTICES {
        (index, 2 + (vertex as usize - 1) * PER_VERTEX + dimension)
    } else {
        let set = dimension / 4;
        (owen(index.reverse_bits(), lane_key(scrambles, 8 + set as u32)).reverse_bits(), dimension % 4)
    };
    let point = (0..32).filter(|k| index >> k & 1 == 1).fold(0, |x, k| x ^ MATRICES[sobol_dimension][k]);
    owen(point.reverse_bits(), lane_key(scrambles, dimension as u32)).reverse_bits()
}

#[inline(always)]
fn vertex_key(stream: u64, vertex: u32) -> u64 {
    mix64(stream.wrapping_add(u64::from(vertex).wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

#[inline(always)]
fn lane_key(vertex_key: u64, lane: u32) -> u32 {
    mix32((vertex_key as u32).wrapping_add(lane.wrapping_mul(0x9e37_79b9))) ^ (vertex_key >> 32) as u32
}

/// Scrambles a number given with its bits reversed, so that each bit is flipped by a hash of those above it (here: below).
/// Constants from N. Vegdahl, "Building a better LK hash" (2021).
#[inline(always)]
fn owen(mut x: u32, key: u32) -> u32 {
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(key);
    x = x.wrapping_mul((key >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^ x.wrapping_mul(0x53a2_2864)
}

#[inline(always)]
fn scramble(reversed: u32, key: u32) -> u32 {
    owen(reversed, key).reverse_bits()
}

/// Permutes indices so that every aligned power-of-two block of them stays one block: nested uniform shuffling (Burley 2020).
#[inline(always)]
fn shuffle(index: u32, key: u32) -> u32 {
    owen(index.reverse_bits(), key).reverse_bits()
}

/// Columns: dimensions 2 to 57, then 0 to 3, then nothing up to 64. By place and value of the index's hexadecimal digits: the xor of
/// that digit's columns of the matrices, bits reversed. 32 KiB; small indices touch little of it.
static TABLE: [[[u32; 64]; 16]; 8] = table();

const fn table() -> [[[u32; 64]; 16]; 8] {
    let mut out = [[[0; 64]; 16]; 8];
    let mut column = 0;
    while column < DIMENSIONS + 2 {
        let d = if column < FIRST_DIMENSIONS { column + 2 } else { column - FIRST_DIMENSIONS };
        let mut digit = 0;
        while digit < 8 {
            let mut value = 1;
            while value < 16 {
                // xor of a smaller value's entry and of the lowest set bit's column
                let low = (value as u32).trailing_zeros() as usize;
                out[digit][value][column] =
                    out[digit][value & (value - 1)][column] ^ MATRICES[d][4 * digit + low].reverse_bits();
                value += 1;
            }
            digit += 1;
        }
        column += 1;
    }
    out
}

#[inline(always)]
fn add_rows(x: &mut [u32; 8], index: u32, column: usize) {
    let mut rest = index;
    let mut digit = 0;
    while rest != 0 {
        let row = &TABLE[digit][(rest & 15) as usize][column..column + 8];
        for i in 0..8 {
            x[i] ^= row[i];
        }
        rest >>= 4;
        digit += 1;
    }
}
