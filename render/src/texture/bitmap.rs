//! Images.

use serde::{Deserialize, Serialize};

use super::UvMap;
use super::texel::Texel;
use super::tiles::{TILE, Textures};
use crate::math::luminance;
use crate::memory::prefetch;
use crate::real::{Vec3, f32};

/// What is beyond the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Wrap {
    /// The image again.
    Repeat,
    /// The image again, every other one turned round.
    Mirror,
    /// Its edge.
    Clamp,
}

/// What is between texels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Filter {
    /// The four nearest ones, weighted.
    Bilinear,
    /// The nearest one.
    Nearest,
}

/// Which texels a look-up reads, and how much of each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Spot {
    /// Columns and rows of the nearest ones; both the same unless there is anything between texels.
    x: [u32; 2],
    y: [u32; 2],
    /// Weights of the right and the lower ones.
    within: [f32; 2],
}

/// An image: row 0 begins at v = 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bitmap {
    /// Width and height in texels, each from 1 to [`Bitmap::MOST`].
    pub size: [u32; 2],
    /// 1 or 3.
    pub channels: u8,
    /// Of one channel.
    pub texel: Texel,
    /// Beyond the image.
    pub wrap: Wrap,
    /// Between texels.
    pub filter: Filter,
    /// Texture coordinates to those of the image, whose corners are (0, 0) and (1, 1).
    pub to_uv: UvMap,
    /// Number of its first tile among those of all textures of the world; the others follow, row by row.
    pub first_tile: u32,
}

impl Bitmap {
    /// Largest width and height: texel numbers fit f32.
    pub const MOST: u32 = 1 << 16;

    /// Tiles in a row, and rows of tiles.
    #[inline(always)]
    pub fn tiles_each_way(&self) -> [u32; 2] {
        [self.size[0].div_ceil(TILE), self.size[1].div_ceil(TILE)]
    }

    /// Numbers of its tiles.
    pub fn tiles(&self) -> std::ops::Range<u32> {
        let [x, y] = self.tiles_each_way();
        self.first_tile..self.first_tile.saturating_add(x.saturating_mul(y))
    }

    /// Width and height of the tile at a place in the grid of tiles.
    #[inline(always)]
    pub fn tile_size(&self, at: [u32; 2]) -> [u32; 2] {
        [TILE.min(self.size[0] - at[0] * TILE), TILE.min(self.size[1] - at[1] * TILE)]
    }

    /// Bytes of a texel.
    #[inline(always)]
    pub fn texel_bytes(&self) -> usize {
        usize::from(self.channels) * self.texel.bytes()
    }

    /// Bytes of one of its tiles, by its number in the world.
    pub fn tile_bytes(&self, number: u32) -> u64 {
        let n = number - self.first_tile;
        let across = self.tiles_each_way()[0];
        let [w, h] = self.tile_size([n % across, n / across]);
        u64::from(w) * u64::from(h) * self.texel_bytes() as u64
    }

    /// The colour at texture coordinates.
    #[inline]
    pub fn color(&self, tiles: &dyn Textures, uv: [f32; 2]) -> Vec3 {
        self.color_at(tiles, &self.spot(uv))
    }

    /// What [`Bitmap::color`] reads.
    #[inline(always)]
    pub(super) fn spot(&self, uv: [f32; 2]) -> Spot {
        match self.filter {
            Filter::Nearest => {
                let at = self.place(uv, 0.0);
                let [x, y] = [self.wrapped(down(at[0]), 0), self.wrapped(down(at[1]), 1)];
                Spot { x: [x; 2], y: [y; 2], within: [0.0; 2] }
            }
            Filter::Bilinear => {
                let at = self.place(uv, 0.5);
                // written out: `map` on arrays is a call
                let corner = [down(at[0]), down(at[1])];
                let within = [at[0] - corner[0] as f32, at[1] - corner[1] as f32];
                Spot { x: self.pair(corner[0], 0), y: self.pair(corner[1], 1), within }
            }
        }
    }

    /// The colour there.
    #[inline]
    pub(super) fn color_at(&self, tiles: &dyn Textures, spot: &Spot) -> Vec3 {
        if self.filter == Filter::Nearest {
            let Some(texels) = tiles.tile(self.tile_at([spot.x[0], spot.y[0]])) else { return Vec3::ZERO };
            return self.texel.read(self.channels, &texels, self.in_tile([spot.x[0], spot.y[0]]));
        }
        let ([v00, v10, v01, v11], [s, t]) = (self.four(tiles, spot.x, spot.y), spot.within);
        let v0 = v00 * (1.0 - s) + v10 * s;
        let v1 = v01 * (1.0 - s) + v11 * s;
        v0 * (1.0 - t) + v1 * t
    }

    /// Asks for the texels there; where they lie in several tiles, for those of the first.
    #[inline]
    pub(super) fn foresee(&self, tiles: &dyn Textures, spot: &Spot) {
        let first = [spot.x[0], spot.y[0]];
        let Some(texels) = tiles.at_hand(self.tile_at(first)) else { return };
        let n = self.in_tile(first);
        let row = self.tile_size([first[0] / TILE, first[1] / TILE])[0] as usize * self.texel_bytes();
        for at in [n, n + row] {
            if let Some(texel) = texels.get(at) {
                prefetch(texel);
            }
        }
    }

    /// The tile that holds a texel.
    #[inline(always)]
    fn tile_at(&self, [x, y]: [u32; 2]) -> u32 {
        self.first_tile + (y / TILE) * self.tiles_each_way()[0] + x / TILE
    }

    /// Where in its tile a texel begins, bytes.
    #[inline(always)]
    fn in_tile(&self, [x, y]: [u32; 2]) -> usize {
        let [w, _] = self.tile_size([x / TILE, y / TILE]);
        ((y % TILE) * w + x % TILE) as usize * self.texel_bytes()
    }

    /// One number for a colour of this image.
    #[inline(always)]
    pub(super) fn amount(&self, color: Vec3) -> f32 {
        if self.channels == 1 { color.x } else { luminance(color) }
    }

    /// Derivatives of the number by u and v; 0 unless bilinear. At a texel's centre those on its right.
    pub fn gradient(&self, tiles: &dyn Textures, uv: [f32; 2]) -> [f32; 2] {
        if self.filter == Filter::Nearest {
            return [0.0; 2];
        }
        let Spot { x, y, within: [s, t] } = self.spot(uv);
        let [f00, f10, f01, f11] = self.four(tiles, x, y).map(|c| self.amount(c));
        let along = [(1.0 - t) * (f10 - f00) + t * (f11 - f01), (1.0 - s) * (f01 - f00) + s * (f11 - f10)];
        let [x, y] = [along[0] * self.size[0] as f32, along[1] * self.size[1] as f32];
        let m = &self.to_uv.0;
        [m[0][0] * x + m[1][0] * y, m[0][1] * x + m[1][1] * y]
    }

    /// Texture coordinates in texels, less `shift`. Where nothing is left of the fraction (2^24 texels from the image, NaN): 0.
    #[inline(always)]
    fn place(&self, uv: [f32; 2], shift: f32) -> [f32; 2] {
        let at = self.to_uv.point(uv);
        let along = |a: usize| {
            let x = at[a] * self.size[a] as f32 - shift;
            if x.abs() < 16_777_216.0 { x } else { 0.0 }
        };
        [along(0), along(1)]
    }

    /// The texels that stand for number `i` along an axis and the next.
    #[inline(always)]
    fn pair(&self, i: i32, axis: usize) -> [u32; 2] {
        let first = self.wrapped(i, axis);
        let next = match self.wrap {
            // a division less
            Wrap::Repeat if first + 1 < self.size[axis] => first + 1,
            Wrap::Repeat => 0,
            _ => self.wrapped(i + 1, axis),
        };
        [first, next]
    }

    /// The texel that stands for number `i` along an axis.
    #[inline(always)]
    fn wrapped(&self, i: i32, axis: usize) -> u32 {
        let n = self.size[axis] as i32;
        if (0..n).contains(&i) {
            return i as u32;
        }
        let inside = match self.wrap {
            Wrap::Repeat => i.rem_euclid(n),
            Wrap::Mirror => {
                let k = i.rem_euclid(2 * n);
                if k < n { k } else { 2 * n - 1 - k }
            }
            Wrap::Clamp => i.clamp(0, n - 1),
        };
        inside as u32
    }

    /// The texels of two columns and two rows, row by row.
    #[inline(always)]
    fn four(&self, tiles: &dyn Textures, x: [u32; 2], y: [u32; 2]) -> [Vec3; 4] {
        let at = [[x[0], y[0]], [x[1], y[0]], [x[0], y[1]], [x[1], y[1]]];
        if x[0] / TILE == x[1] / TILE && y[0] / TILE == y[1] / TILE {
            let Some(texels) = tiles.tile(self.tile_at(at[0])) else { return [Vec3::ZERO; 4] };
            let [a, b, c, d] = at;
            let places = [self.in_tile(a), self.in_tile(b), self.in_tile(c), self.in_tile(d)];
            return self.texel.read_each(self.channels, &texels, places);
        }
        self.four_apart(tiles, at)
    }

    /// Of several tiles.
    #[inline(never)]
    fn four_apart(&self, tiles: &dyn Textures, at: [[u32; 2]; 4]) -> [Vec3; 4] {
        let read = |p| {
            let texels = tiles.tile(self.tile_at(p))?;
            Some(self.texel.read(self.channels, &texels, self.in_tile(p)))
        };
        at.map(|p| read(p).unwrap_or(Vec3::ZERO))
    }
}

/// The next whole number down, for |x| < 2^24: `floor` is a call where vectors of 2008 may not be presumed.
#[inline(always)]
fn down(x: f32) -> i32 {
    let i = x as i32;
    i - i32::from((i as f32) > x)
}
