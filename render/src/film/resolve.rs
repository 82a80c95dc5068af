//! From sums to a picture and its error.

use super::{FilmPart, Sums};
use crate::aov::Aov;

/// 2^-64.
const UNIT: f64 = 1.0 / 18_446_744_073_709_551_616.0;

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
    pub fn resolve(&self, samples: u32) -> Vec<[f32; 3]> {
        let mut out = Vec::with_capacity(self.size[0] as usize * self.size[1] as usize);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                let [a, b] = self.sums(x, y);
                out.push(std::array::from_fn(|c| quotient(a[c].wrapping_add(b[c]), samples)));
            }
        }
        out
    }

    /// Estimate of the picture's relative error after `samples` samples per pixel: the mean over pixels and channels of
    /// Var / (M^2 + 0.01), M being the mean of all samples and Var the estimate of its variance from the means A and B of the two halves:
    /// (A - B)^2 n_A n_B / n^2, which is (A - B)^2 / 4 when both have the same number; of an odd number the even
    /// half has one more. `None` for fewer than two samples: one half is empty.
    pub fn rel_mse(&self, samples: u32) -> Option<f64> {
        let mut sum = 0.0;
        for y in 0..self.size[1] {
            let mut row = 0.0;
            for x in 0..self.size[0] {
                row += pixel_error(self.sums(x, y), samples)?;
            }
            sum += row;
        }
        Some(sum / (3.0 * f64::from(self.size[0]) * f64::from(self.size[1])))
    }

    /// The same per pixel, mean over its channels, row by row.
    pub fn rel_mse_map(&self, samples: u32) -> Option<Vec<f32>> {
        let mut out = Vec::with_capacity(self.size[0] as usize * self.size[1] as usize);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                out.push((pixel_error(self.sums(x, y), samples)? / 3.0) as f32);
            }
        }
        Some(out)
    }

    /// The channels of its AOVs after `samples` samples per pixel (at least 1), in the order of [`Aov::ALL`]; see there what they mean. `offset`
    /// is what was taken from the scene's coordinates to recentre them: positions get it back, in f64, before they are rounded.
    pub fn channels(&self, samples: u32, offset: [f64; 3]) -> Vec<Channel> {
        let mut out = Vec::new();
        for aov in self.aovs().iter() {
            let first = out.len();
            let pixels = self.size[0] as usize * self.size[1] as usize;
            out.extend(aov.channels().iter().map(|name| Channel { name, values: Vec::with_capacity(pixels) }));
            for y in 0..self.size[1] {
                for x in 0..self.size[0] {
                    let sums = self.planes.sums(aov, self.place_at(x, y));
                    for (c, channel) in out[first..].iter_mut().enumerate() {
                        channel.values.push(match (aov, sums) {
                            (Aov::Variance, _) => {
                                variance(self.sums(x, y), c, samples).map_or(f32::INFINITY, |v| v as f32)
                            }
                            (_, None) => 0.0,
                            (Aov::ObjectId | Aov::MaterialId, Some(sums)) => quotient(sums[c], 1),
                            (Aov::Position, Some(sums)) => {
                                let (sum, times) = (sums[c] as f64 * UNIT, sums[3] as f64 * UNIT);
                                ((sum + offset[c] * times) / f64::from(samples)) as f32
                            }
                            (_, Some(sums)) => quotient(sums[c], samples),
                        });
                    }
                }
            }
        }
        out
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
