//! A picture of the sky: light from far away by direction, as Mitsuba 3's `envmap` reads it.
//!
//! Directions are those of the map: +y is up, row 0. A direction (x, y, z) lies at u = atan2(x, -z) / 2 pi of the width and v = acos(y) / pi of
//! the height. Along a row the texels' centres lie at (i + 1/2) / width, and the row goes round; down a column row 0 lies on the pole above and
//! the last row on the pole below (v = j / (height - 1)). In between radiance is bilinear.
//!
//! Sampling takes the patches between four texels: patch (x, y) lies between columns x and x + 1 and rows y and y + 1, and its weight is the mean
//! luminance of its corners times its solid angle. Cells of patches are chosen by their weight, and patches in those where they differ
//! (see `cells`), then a direction evenly by solid angle. So the density is constant over a patch, and it is exact. A patch of less
//! than a number of 2^31 in its row or column is never chosen; its density is 0.

mod cells;
mod choice;
#[cfg(test)]
mod tests;
mod texels;

pub(super) use self::cells::Spot;

use self::cells::Cells;
use self::choice::Choice;
use self::texels::Texels;
use crate::math::{atan2, luminance, sincos_turn};
use crate::memory::spacious;
use crate::real::consts::PI;
use crate::real::{Stored, Vec3, f32, real, stored};

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
    texels: Texels,
    cells: Cells,
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
    pub(super) x: u32,
    pub(super) y: u32,
    pub(super) fx: f32,
    pub(super) fy: f32,
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
        let mut colour = [0.0f64; 3];
        for y in 0..h - 1 {
            let (above, below) = (&texels[y * w..][..w], &texels[(y + 1) * w..][..w]);
            let mut sums = [0.0f64; 3];
            for (a, b) in above.iter().zip(below) {
                (0..3).for_each(|c| sums[c] += f64::from(a[c]) + f64::from(b[c]));
            }
            // each texel lies at two corners of the row's patches; over the sphere cosines differ by 2
            (0..3).for_each(|c| colour[c] += sums[c] / (2 * w) as f64 * (cosines[y] - cosines[y + 1]) / 2.0);
        }
        let light = |i: usize| f64::from(luminance(Vec3::from(texels[i])));
        let cells = Cells::new(w, cosines, |x, y| {
            let next = (x + 1) % w;
            (light(y * w + x) + light(y * w + next) + light((y + 1) * w + x) + light((y + 1) * w + next)) / 4.0
        });
        let mean = Vec3::from(colour.map(|c| c as f32));
        Ok(SkyMap { width, height, texels: Texels::new(texels), cells, mean })
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
        luminance(self.mean) > 0.0 && self.cells.shines()
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
        self.direction(self.spot(&self.choose(u), u))
    }

    /// A cell, its row first.
    #[inline]
    pub(super) fn choose(&self, u: [u32; 2]) -> [Choice; 2] {
        let row = self.cells.row(u[0]);
        let column = self.cells.column(&row, u[1]);
        self.cells.foresee(&row, &column);
        [row, column]
    }

    /// Asks for what [`SkyMap::at`] reads.
    #[inline]
    pub(super) fn foresee(&self, at: &Place) {
        let first = at.y as usize * self.width as usize + at.x as usize;
        self.texels.foresee(first);
        self.texels.foresee(first + self.width as usize);
        self.cells.foresee_density(at.x as usize, at.y as usize);
    }

    /// A spot in a cell, by the numbers that chose it.
    #[inline]
    pub(super) fn spot(&self, [row, column]: &[Choice; 2], u: [u32; 2]) -> Spot {
        self.cells.spot(row, column, u)
    }

    /// Its unit direction. Without branches, as [`SkyMap::place`].
    #[inline(always)]
    pub(super) fn direction(&self, spot: Spot) -> Vec3 {
        let sin = ((1.0 - spot.cos) * (1.0 + spot.cos)).max(0.0).sqrt() as f32;
        let turn = (spot.x + 0.5) / f64::from(self.width);
        // between 0 and 1 and half a texel
        let (s, c) = sincos_turn((if turn < 1.0 { turn } else { turn - 1.0 }) as f32);
        Vec3::new(sin * s, spot.cos as f32, -sin * c)
    }

    /// The patch that a direction lies in: a function of the direction alone, so that a direction has one density whoever asks.
    #[inline(always)]
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
        let texel = |i: usize| self.texels.get(i);
        let above = texel(row + x) * (1.0 - at.fx) + texel(row + next) * at.fx;
        let below = texel(row + w + x) * (1.0 - at.fx) + texel(row + w + next) * at.fx;
        above * (1.0 - at.fy) + below * at.fy
    }

    #[inline]
    fn density_at(&self, at: &Place) -> f32 {
        self.cells.density(at.x as usize, at.y as usize)
    }

    /// The map as bytes: little endian, the same for the same map.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(HEAD + self.width as usize * self.height as usize * 12);
        out.extend(MAGIC);
        out.extend(self.width.to_le_bytes());
        out.extend(self.height.to_le_bytes());
        out.extend(self.texels.iter().flatten().flat_map(|v| stored(v).to_le_bytes()));
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
