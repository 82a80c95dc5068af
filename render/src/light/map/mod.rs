//! A picture of the sky: light from far away by direction, as Mitsuba 3's `envmap` reads it.
//!
//! Directions are those of the map: +y is up, row 0. A direction (x, y, z) lies at u = atan2(x, -z) / 2 pi of the width and v = acos(y) / pi of
//! the height. Along a row the texels' centres lie at (i + 1/2) / width, and the row goes round; down a column row 0 lies on the pole above and
//! the last row on the pole below (v = j / (height - 1)). In between radiance is bilinear.
//!
//! Sampling takes the patches between four texels: patch (x, y) lies between columns x and x + 1 and rows y and y + 1, and is chosen by the mean
//! luminance of its corners times its solid angle, then a direction in it evenly by solid angle. So the density is constant over a
//! patch, and it is exact: probabilities are multiples of 2^-31 of a row, and of 2^-31 of a column in its row, and these
//! multiples are what both sides of MIS see. A patch of less is never chosen; its density is 0.

#[cfg(test)]
mod tests;

use crate::math::{luminance, sincos_turn};
use crate::memory::{prefetch, spacious};
use crate::real::consts::PI;
use crate::real::{Stored, Vec3, atan2, f32, real, stored};

/// All numbers that choose.
const WHOLE: u32 = 1 << 31;
/// First bytes of the object: name and version of the format.
const MAGIC: [u8; 8] = *b"rhsky\0\0\x01";
/// Bytes before the texels: magic, width and height as u32.
const HEAD: usize = 16;

/// A map with its tables.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyMap {
    width: u32,
    height: u32,
    /// Radiance by row from the top.
    texels: Vec<[f32; 3]>,
    /// Upper ends of the intervals of rows of patches; the last is [`WHOLE`].
    rows: Vec<u32>,
    /// The same of the patches in each row.
    columns: Vec<u32>,
    /// Where to look in `rows`, and in each row of `columns`.
    row_guide: Guide,
    column_guides: Guide,
    /// By row of patches: the density in solid angle of a patch that is all of its row.
    density: Vec<f32>,
    /// Cosine of the angle from the top, by row of texels.
    cosines: Vec<f64>,
    mean: Vec3,
}

/// Why bytes are no map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SkyMapError {
    /// They were not written by [`SkyMap::encode`] of this version.
    #[error("these bytes are no sky map of this version; prepare the scene again")]
    Format,
    /// Too few texels.
    #[error("a sky map of {0} x {1} texels: it needs 1 x 2 at least")]
    Size(u32, u32),
    /// Radiance that is negative or not finite.
    #[error("the sky map holds {what} in column {x} of row {y} (both from 0): repair the picture")]
    Value {
        /// Which.
        what: &'static str,
        /// Column.
        x: u32,
        /// Row.
        y: u32,
    },
}

/// A patch, and where in it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Place {
    x: u32,
    y: u32,
    fx: f32,
    fy: f32,
}

impl SkyMap {
    /// From radiances by row from the top, `width` x `height` of them.
    ///
    /// # Errors
    /// The size is too small or not that of `texels`, or a value is negative, NaN or infinite.
    pub fn new(width: u32, height: u32, texels: Vec<[f32; 3]>) -> Result<SkyMap, SkyMapError> {
        let (w, h) = (width as usize, height as usize);
        if w < 1 || h < 2 || w.checked_mul(h) != Some(texels.len()) {
            return Err(SkyMapError::Size(width, height));
        }
        for (i, texel) in texels.iter().enumerate() {
            let what = if texel.iter().any(|v| !v.is_finite()) {
                "NaN or infinity"
            } else if texel.iter().any(|v| *v < 0.0) {
                "a negative value"
            } else {
                continue;
            };
            return Err(SkyMapError::Value { what, x: (i % w) as u32, y: (i / w) as u32 });
        }
        let cosines: Vec<f64> = (0..h).map(|y| libm::cos(std::f64::consts::PI * y as f64 / (h - 1) as f64)).collect();
        let mut columns = spacious(w * (h - 1));
        let mut of_rows = Vec::with_capacity(h - 1);
        let mut row = vec![0.0f64; w];
        let mut colour = [0.0f64; 3];
        for y in 0..h - 1 {
            let (above, below) = (&texels[y * w..][..w], &texels[(y + 1) * w..][..w]);
            let solid = cosines[y] - cosines[y + 1];
            let mut sums = [0.0f64; 3];
            for (x, weight) in row.iter_mut().enumerate() {
                let next = (x + 1) % w;
                let light = |t: &[f32; 3]| f64::from(luminance(Vec3::from(*t)));
                *weight = light(&above[x]) + light(&above[next]) + light(&below[x]) + light(&below[next]);
                for c in 0..3 {
                    sums[c] += f64::from(above[x][c]) + f64::from(below[x][c]);
                }
            }
            // each texel lies at two corners of the row's patches; over the sphere cosines differ by 2
            (0..3).for_each(|c| colour[c] += sums[c] / (2 * w) as f64 * solid / 2.0);
            of_rows.push(row.iter().sum::<f64>() * solid);
            columns.extend(ends(&row));
        }
        let rows = ends(&of_rows);
        let density = (0..h - 1)
            .map(|y| {
                let count = rows[y] - before(&rows, y);
                let turns = 2.0 * std::f64::consts::PI / w as f64;
                (f64::from(count) / f64::from(WHOLE) / (turns * (cosines[y] - cosines[y + 1]))) as f32
            })
            .collect();
        let mean = Vec3::from(colour.map(|c| c as f32));
        let (row_guide, column_guides) = (Guide::new(&rows, h - 1), Guide::new(&columns, w));
        Ok(SkyMap { width, height, texels, rows, columns, row_guide, column_guides, density, cosines, mean })
    }

    /// Width and height in texels.
    pub fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// Radiance averaged over all directions; the integral of the bilinear one but for how the sine of the angle from the pole varies in a row.
    pub fn mean(&self) -> Vec3 {
        self.mean
    }

    /// Whether some direction is ever sampled.
    pub(super) fn shines(&self) -> bool {
        luminance(self.mean) > 0.0 && self.rows.last() == Some(&WHOLE)
    }

    /// Radiance from the unit direction `d` of the map.
    pub fn radiance(&self, d: Vec3) -> Vec3 {
        self.bilinear(&self.place(d))
    }

    /// Density in solid angle of [`SkyMap::sample`].
    pub fn pdf(&self, d: Vec3) -> f32 {
        self.density_at(&self.place(d))
    }

    /// Both.
    #[cfg(test)]
    pub(super) fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        self.at(&self.place(d))
    }

    /// Radiance and density of a place.
    #[inline]
    pub(super) fn at(&self, place: &Place) -> (Vec3, f32) {
        (self.bilinear(place), self.density_at(place))
    }

    /// A unit direction of the map, by two numbers of 32 random bits.
    pub fn sample(&self, u: [u32; 2]) -> Vec3 {
        self.sample_row(self.choose_row(u[0]), u[1])
    }

    /// A row of patches and how far down in it, by the first number.
    #[inline]
    pub(super) fn choose_row(&self, number: u32) -> (usize, f64) {
        choose(&self.rows, self.row_guide.range(0, number), number)
    }

    /// Asks for where in a row's columns to look for the second number.
    #[inline]
    pub(super) fn foresee_guide(&self, row: usize, number: u32) {
        prefetch(&self.column_guides.firsts[self.column_guides.place(row, number)]);
    }

    /// Asks for the columns there.
    #[inline]
    pub(super) fn foresee_columns(&self, row: usize, number: u32) {
        let range = self.column_guides.range(row, number);
        let row = row * self.width as usize;
        // as many as a part has on the average, and what begins in another line; where it is dark there may be many more
        for i in [range.start, range.end] {
            if let Some(end) = self.columns.get(row + i) {
                prefetch(end);
            }
        }
    }

    /// Asks for what [`SkyMap::at`] reads.
    #[inline]
    pub(super) fn foresee(&self, at: &Place) {
        let first = at.y as usize * self.width as usize + at.x as usize;
        prefetch(&self.texels[first]);
        prefetch(&self.texels[first + self.width as usize]);
        prefetch(&self.columns[first]);
    }

    /// A direction in a row of patches, by the second number.
    #[inline]
    pub(super) fn sample_row(&self, (y, down): (usize, f64), number: u32) -> Vec3 {
        let w = self.width as usize;
        let (x, along) = choose(&self.columns[y * w..][..w], self.column_guides.range(y, number), number);
        // whoever samples wants the radiance
        prefetch(&self.texels[y * w + x]);
        prefetch(&self.texels[(y + 1) * w + x]);
        let cos = self.cosines[y] + (self.cosines[y + 1] - self.cosines[y]) * down;
        let sin = ((1.0 - cos) * (1.0 + cos)).max(0.0).sqrt() as f32;
        let turn = (x as f64 + 0.5 + along) / f64::from(self.width);
        let (s, c) = sincos_turn((turn - turn.floor()) as f32);
        Vec3::new(sin * s, cos as f32, -sin * c)
    }

    /// The patch that a direction lies in: a function of the direction alone, so that a direction has one density whoever asks.
    #[inline]
    pub(super) fn place(&self, d: Vec3) -> Place {
        let u = atan2(d.x, -d.z) * (0.5 / PI);
        let v = atan2((d.x * d.x + d.z * d.z).sqrt(), d.y) * (1.0 / PI);
        let width = self.width as f32;
        let at = u * width - 0.5;
        let at = if at < 0.0 { at + width } else { at };
        // rounding may bring it to the width itself
        let x = (at as u32).min(self.width - 1);
        let down = v * (self.height - 1) as f32;
        let y = (down as u32).min(self.height - 2);
        Place { x, y, fx: (at - x as f32).min(1.0), fy: (down - y as f32).min(1.0) }
    }

    #[inline]
    fn bilinear(&self, at: &Place) -> Vec3 {
        let w = self.width as usize;
        let (x, row) = (at.x as usize, at.y as usize * w);
        let next = if x + 1 == w { 0 } else { x + 1 };
        let texel = |i: usize| Vec3::from(self.texels[i]);
        let above = texel(row + x) * (1.0 - at.fx) + texel(row + next) * at.fx;
        let below = texel(row + w + x) * (1.0 - at.fx) + texel(row + w + next) * at.fx;
        above * (1.0 - at.fy) + below * at.fy
    }

    #[inline]
    fn density_at(&self, at: &Place) -> f32 {
        let w = self.width as usize;
        let row = &self.columns[at.y as usize * w..][..w];
        let x = at.x as usize;
        let count = row[x] - before(row, x);
        self.density[at.y as usize] * (count as f32 * (1.0 / WHOLE as f32))
    }

    /// The map as bytes: little endian, the same for the same map.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(HEAD + self.texels.len() * 12);
        out.extend(MAGIC);
        out.extend(self.width.to_le_bytes());
        out.extend(self.height.to_le_bytes());
        out.extend(self.texels.iter().flatten().flat_map(|v| stored(*v).to_le_bytes()));
        out
    }

    /// The map of [`SkyMap::encode`]'s bytes.
    ///
    /// # Errors
    /// As [`SkyMap::new`], or the bytes are others.
    pub fn decode(bytes: &[u8]) -> Result<SkyMap, SkyMapError> {
        let word = |at: usize| bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        let (Some(width), Some(height)) = (word(8), word(12)) else { return Err(SkyMapError::Format) };
        let texels = u64::from(width) * u64::from(height);
        if bytes[..8] != MAGIC || texels.checked_mul(12) != Some((bytes.len() - HEAD) as u64) {
            return Err(SkyMapError::Format);
        }
        let value = |b: &[u8]| real(Stored::from_le_bytes([b[0], b[1], b[2], b[3]]));
        let mut all = spacious(texels as usize);
        all.extend(bytes[HEAD..].chunks_exact(12).map(|t| [value(&t[..4]), value(&t[4..8]), value(&t[8..])]));
        SkyMap::new(width, height, all)
    }
}

/// Upper ends of consecutive intervals of [0, [`WHOLE`]) in proportion to the weights; all 0 if the weights are.
fn ends(weights: &[f64]) -> Vec<u32> {
    let total: f64 = weights.iter().sum();
    if !(total > 0.0) {
        return vec![0; weights.len()];
    }
    let last = weights.iter().rposition(|w| *w > 0.0).unwrap_or(0);
    let mut sum = 0.0;
    let end = |(i, w): (usize, &f64)| {
        sum += w;
        // what is dark lies before or after all numbers, whatever rounding does to the sums
        if i >= last { WHOLE } else { ((sum / total * f64::from(WHOLE)) as u32).min(WHOLE) }
    };
    weights.iter().enumerate().map(end).collect()
}

#[inline]
fn before(ends: &[u32], i: usize) -> u32 {
    if i == 0 { 0 } else { ends[i - 1] }
}

/// For each of equal parts of the numbers the first interval that reaches into it, so that a search touches a line or two of a row of many
/// thousand ends, most of which lie in no cache (Chen and Asau, "On Generating Random Variates from an Empirical Distribution",
/// AIIE Transactions 1974).
#[derive(Clone, Debug, PartialEq)]
struct Guide {
    /// Parts of a row, as a shift of a number of 31 bits.
    shift: u32,
    /// By row: one for each part, and one more.
    firsts: Vec<u32>,
}

impl Guide {
    /// Intervals to a part, about: a line of ends.
    const COARSE: usize = 16;

    /// Over rows of so many ends each.
    fn new(ends: &[u32], width: usize) -> Guide {
        let parts = (width / Guide::COARSE).max(1).next_power_of_two();
        let shift = 31 - parts.trailing_zeros();
        let mut firsts = Vec::with_capacity(ends.len() / width * (parts + 1));
        for row in ends.chunks_exact(width) {
            let mut i = 0;
            for part in 0..=parts as u64 {
                let start = part << shift;
                i += row[i..].iter().take_while(|&&end| u64::from(end) <= start).count();
                firsts.push(i as u32);
            }
        }
        Guide { shift, firsts }
    }

    /// Where the part of a row that holds a number stands.
    #[inline]
    fn place(&self, row: usize, number: u32) -> usize {
        row * ((WHOLE >> self.shift) as usize + 1) + (number >> 1 >> self.shift) as usize
    }

    /// Where in a row the interval is that holds a number (its lowest bit aside): the first whose end is above it, or the range's end.
    #[inline]
    fn range(&self, row: usize, number: u32) -> std::ops::Range<usize> {
        let at = self.place(row, number);
        self.firsts[at] as usize..self.firsts[at + 1] as usize
    }
}

/// The interval that holds a number (its lowest bit aside), and where in it that lies, in (0, 1).
#[inline]
fn choose(ends: &[u32], among: std::ops::Range<usize>, number: u32) -> (usize, f64) {
    let n = number >> 1;
    // all ends are 0 only where nothing leads
    let i = (among.start + ends[among].partition_point(|&end| end <= n)).min(ends.len() - 1);
    let start = before(ends, i);
    let count = ends[i].saturating_sub(start).max(1);
    let within = f64::from(n.wrapping_sub(start)) + 0.25 + 0.5 * f64::from(number & 1);
    (i, within / f64::from(count))
}
