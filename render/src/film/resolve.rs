//! From sums to a picture and its error.

use std::ops::AddAssign;

use serde::{Deserialize, Serialize};

use super::{FilmPart, PerTile, Sums, TILE, Tile};
use crate::aov::Aov;

/// 2^-64, in which sums of errors are counted as sums of light are.
const UNIT: f64 = 1.0 / 18_446_744_073_709_551_616.0;

/// Sum of Var / (M^2 + 0.01) over pixels and channels (see [`FilmPart::rel_mse`]), in units of 2^-64: what is below a unit in a tile is
/// cut off, and the sums of parts of a film add up to that of the film, whatever the parts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[u64; 2]", into = "[u64; 2]")]
pub struct ErrorSum(u128);

impl ErrorSum {
    /// A sum, which is not negative and below 2^36; what is below a unit is cut off.
    pub fn of(value: f64) -> ErrorSum {
        ErrorSum((value / UNIT) as u128)
    }

    /// The sum itself.
    pub fn value(self) -> f64 {
        self.0 as f64 * UNIT
    }

    /// Of all parts of a film.
    pub fn total(parts: &[ErrorSum]) -> ErrorSum {
        let mut sum = ErrorSum::default();
        parts.iter().for_each(|&part| sum += part);
        sum
    }

    /// The mean over the channels of all pixels of a film.
    pub fn mean(self, [width, height]: [u32; 2]) -> f64 {
        self.value() / (3.0 * f64::from(width) * f64::from(height))
    }
}

impl AddAssign for ErrorSum {
    fn add_assign(&mut self, other: ErrorSum) {
        // an error is at most 2 (one half holds everything), and there are fewer than 2^34 channels
        self.0 = self.0.wrapping_add(other.0);
    }
}

impl From<[u64; 2]> for ErrorSum {
    fn from([high, low]: [u64; 2]) -> Self {
        ErrorSum(u128::from(high) << 64 | u128::from(low))
    }
}

impl From<ErrorSum> for [u64; 2] {
    fn from(sum: ErrorSum) -> Self {
        [(sum.0 >> 64) as u64, sum.0 as u64]
    }
}

/// A channel of a picture, beside its light.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// `LAYER.NAME`.
    pub name: &'static str,
    /// Row by row, width * height values.
    pub values: Vec<f32>,
}

impl FilmPart {
    /// The picture after `samples` samples per pixel (at least 1): sum / samples, exact, rounded once to the nearest float. Row by row, width *
    /// height pixels of RGB.
    pub fn resolve(&self, samples: impl PerTile) -> Vec<[f32; 3]> {
        let mut out = Vec::with_capacity(self.size[0] as usize * self.size[1] as usize);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                let ([a, b], n) = (self.sums(x, y), samples.of_tile(self.place_at(x, y).0));
                out.push(std::array::from_fn(|c| quotient(a[c].wrapping_add(b[c]), n)));
            }
        }
        out
    }

    /// Estimate of the picture's relative error after `samples` samples per pixel: the mean over pixels and channels of
    /// Var / (M^2 + 0.01), M being the mean of all samples and Var the estimate of its variance from the means A and B of the two halves:
    /// (A - B)^2 n_A n_B / n^2, which is (A - B)^2 / 4 when both have the same number; of an odd number the even
    /// half has one more. `None` for fewer than two samples: one half is empty.
    pub fn rel_mse(&self, samples: impl PerTile) -> Option<f64> {
        Some(self.error_sum(samples)?.mean(self.size))
    }

    /// What [`FilmPart::rel_mse`] is the mean of.
    pub fn error_sum(&self, samples: impl PerTile) -> Option<ErrorSum> {
        self.tile_errors(samples).map(|errors| ErrorSum::total(&errors))
    }

    /// The same by tile: those that were not touched have no error. `None` where a tile has fewer than two samples.
    pub fn tile_errors(&self, samples: impl PerTile) -> Option<Vec<ErrorSum>> {
        let of_tile = |(number, tile): (usize, &Option<Tile>)| {
            let n = samples.of_tile(number);
            let mut error = 0.0;
            for sums in tile.iter().flat_map(|tile| tile.0.iter()) {
                error += pixel_error(sums, n)?;
            }
            // below 2^13, and not negative
            (n >= 2).then_some(ErrorSum::of(error))
        };
        self.tiles.iter().enumerate().map(of_tile).collect()
    }

    /// The picture's pixels in a tile, as [`FilmPart::resolve`] has them: column, row and value of each; none where nothing was touched.
    pub fn resolve_tile(&self, number: u32, samples: impl PerTile, mut put: impl FnMut(u32, u32, [f32; 3])) {
        let Some(tile) = &self.tiles[number as usize] else { return };
        let n = samples.of_tile(number as usize);
        self.pixels_of(number, |x, y, at| {
            let [a, b] = &tile.0[at];
            put(x, y, std::array::from_fn(|c| quotient(a[c].wrapping_add(b[c]), n)));
        });
    }

    /// Column and row of each of a tile's pixels, and its place in the tile.
    fn pixels_of(&self, number: u32, mut each: impl FnMut(u32, u32, usize)) {
        let [width, height] = self.size;
        let across = width.div_ceil(TILE);
        let (left, top) = (number % across * TILE, number / across * TILE);
        for y in top..height.min(top + TILE) {
            for x in left..width.min(left + TILE) {
                each(x, y, ((y - top) * TILE + x - left) as usize);
            }
        }
    }

    /// The same per pixel, mean over its channels, row by row.
    pub fn rel_mse_map(&self, samples: impl PerTile) -> Option<Vec<f32>> {
        let mut out = Vec::with_capacity(self.size[0] as usize * self.size[1] as usize);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                let n = samples.of_tile(self.place_at(x, y).0);
                out.push((pixel_error(self.sums(x, y), n)? / 3.0) as f32);
            }
        }
        Some(out)
    }

    /// The channels of its AOVs after `samples` samples per pixel (at least 1), in the order of [`crate::aov::Aovs::channels`]; see [`Aov`] for what they
    /// mean. `offset` is what was taken from the scene's coordinates to recentre them: positions get it back, in f64, before they are rounded.
    pub fn channels(&self, samples: impl PerTile, offset: [f64; 3]) -> Vec<Channel> {
        let pixels = self.size[0] as usize * self.size[1] as usize;
        let empty = |name| Channel { name, values: vec![0.0; pixels] };
        let mut out: Vec<Channel> = self.aovs().channels().map(empty).collect();
        for tile in 0..self.tiles() as u32 {
            self.channels_of_tile(tile, &samples, offset, |x, y, channel, value| {
                out[channel].values[y as usize * self.size[0] as usize + x as usize] = value;
            });
        }
        out
    }

    /// Their values in a tile, touched or not: column, row, number of the channel, and value.
    pub fn channels_of_tile(
        &self,
        number: u32,
        samples: impl PerTile,
        offset: [f64; 3],
        mut put: impl FnMut(u32, u32, usize, f32),
    ) {
        let samples = samples.of_tile(number as usize);
        let mut first = 0;
        for aov in self.aovs().iter() {
            let channels = aov.channels().len();
            self.pixels_of(number, |x, y, at| {
                let sums = self.planes.sums(aov, (number as usize, at));
                for c in 0..channels {
                    let value = match (aov, sums) {
                        (Aov::Variance, _) => variance(self.sums(x, y), c, samples).map_or(f32::INFINITY, |v| v as f32),
                        (_, None) => 0.0,
                        (Aov::ObjectId | Aov::MaterialId, Some(sums)) => quotient(sums[c], 1),
                        (Aov::Position, Some(sums)) => {
                            let (sum, times) = (sums[c] as f64 * UNIT, sums[3] as f64 * UNIT);
                            ((sum + offset[c] * times) / f64::from(samples)) as f32
                        }
                        (_, Some(sums)) => quotient(sums[c], samples),
                    };
                    put(x, y, first + c, value);
                }
            });
            first += channels;
        }
    }
}

/// Estimated variance of a channel's mean, as in [`FilmPart::rel_mse`].
fn variance([a, b]: &Sums, c: usize, samples: u32) -> Option<f64> {
    if samples < 2 {
        return None;
    }
    let n = f64::from(samples);
    let n_b = f64::from(samples / 2);
    let n_a = n - n_b;
    let difference = a[c] as f64 * UNIT / n_a - b[c] as f64 * UNIT / n_b;
    Some(difference * difference * (n_a * n_b / (n * n)))
}

/// Sum over the channels of Var / (M^2 + 0.01).
fn pixel_error(sums: &Sums, samples: u32) -> Option<f64> {
    let [a, b] = sums;
    let mut error = 0.0;
    for c in 0..3 {
        let mean = (a[c] as f64 * UNIT + b[c] as f64 * UNIT) / f64::from(samples);
        error += variance(sums, c, samples)? / (mean * mean + 0.01);
    }
    Some(error)
}

/// `sum 2^-64 / n`, rounded once to the nearest float, ties to even.
fn quotient(sum: i128, n: u32) -> f32 {
    if sum == 0 || n == 0 {
        return 0.0;
    }
    let magnitude = sum.unsigned_abs();
    // the quotient keeps at least 128 - 32 bits
    let shift = magnitude.leading_zeros();
    let wide = magnitude << shift;
    let (q, rest) = (wide / u128::from(n), wide % u128::from(n));
    // to 62 bits with a sticky one below, which no later rounding can take for a tie
    let drop = 128 - q.leading_zeros() - 62;
    let sticky = rest != 0 || q & ((1 << drop) - 1) != 0;
    let q = (q >> drop) as u64 | u64::from(sticky);
    // an integer to f32 rounds to nearest, ties to even; in f64 the scaling is exact, and at least 2^-96 is a normal float
    let exponent = drop as i32 - shift as i32 - 64;
    let value = (f64::from(q as f32) * f64::from_bits(((exponent + 1023) as u64) << 52)) as f32;
    if sum < 0 { -value } else { value }
}
