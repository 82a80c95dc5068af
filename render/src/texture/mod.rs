//! Textures: values that vary over a surface with its texture coordinates.
//!
//! The description ([`Texture`]) is part of the world. A bitmap's texels lie in tiles of [`TILE`] x [`TILE`], which whoever renders hands
//! out ([`Textures`]) and reads on demand. What a look-up gives is Mitsuba 3's: texel centres at (i + 0.5) / n, row 0 at v = 0, sRGB decoded
//! before filtering.

mod bitmap;
mod checkerboard;
#[cfg(test)]
mod tests;
mod texel;
mod tiles;

use serde::{Deserialize, Serialize};

use crate::math::luminance;
use crate::real::{Vec3, f32};

pub(crate) use bitmap::Spot;
pub use bitmap::{Bitmap, Filter, Wrap};
pub use checkerboard::Checkerboard;
#[cfg(test)]
pub(crate) use tests::Tiles;
pub use texel::{Texel, decode_srgb};
pub use tiles::{NoTextures, TILE, Textures};

/// An affine map of texture coordinates, rows of a 2 x 3 matrix: `u' = m[0][0] u + m[0][1] v + m[0][2]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct UvMap(pub [[f32; 3]; 2]);

impl UvMap {
    /// The map that changes nothing.
    pub const IDENTITY: UvMap = UvMap([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);

    /// Image of a point.
    #[inline(always)]
    pub fn point(&self, [u, v]: [f32; 2]) -> [f32; 2] {
        let along = |row: [f32; 3]| row[0] * u + row[1] * v + row[2];
        [along(self.0[0]), along(self.0[1])]
    }
}

/// Where on a surface a texture is looked up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct At {
    /// Texture coordinates.
    pub uv: [f32; 2],
    /// The mesh's attribute, interpolated; 0 where it has none.
    pub attribute: Vec3,
}

impl At {
    /// Where there is no attribute.
    #[inline(always)]
    pub fn uv(uv: [f32; 2]) -> At {
        At { uv, attribute: Vec3::ZERO }
    }
}

/// A texture. It is no function of anything but the texture coordinates and the mesh's attribute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Texture {
    /// An image.
    Bitmap(Bitmap),
    /// Squares of two colours.
    Checkerboard(Checkerboard),
    /// The mesh's attribute.
    Attribute {
        /// What it is multiplied by.
        scale: f32,
    },
}

impl Texture {
    /// The colour at texture coordinates, linear Rec. 709; a grey image's value in all channels. 0 where a tile cannot be had.
    #[inline]
    pub fn color(&self, tiles: &dyn Textures, at: At) -> Vec3 {
        self.color_at(tiles, at, &self.spot(at))
    }

    /// What a look-up reads.
    #[inline]
    pub(crate) fn spot(&self, at: At) -> Spot {
        match self {
            Texture::Bitmap(bitmap) => bitmap.spot(at.uv),
            Texture::Checkerboard(_) | Texture::Attribute { .. } => Spot::default(),
        }
    }

    /// [`Texture::color`] where it is known what it reads.
    #[inline]
    pub(crate) fn color_at(&self, tiles: &dyn Textures, at: At, spot: &Spot) -> Vec3 {
        match self {
            Texture::Bitmap(bitmap) => bitmap.color_at(tiles, spot),
            Texture::Checkerboard(checkerboard) => checkerboard.color(at.uv),
            Texture::Attribute { scale } => at.attribute * *scale,
        }
    }

    /// The colour as light: what is below 0 or no number is 0.
    #[inline]
    pub fn light(&self, tiles: &dyn Textures, at: At) -> Vec3 {
        let light = |x: f32| if x > 0.0 && x < f32::INFINITY { x } else { 0.0 };
        let [r, g, b] = self.color(tiles, at).to_array().map(light);
        Vec3::new(r, g, b)
    }

    /// One number at texture coordinates: a grey image's value, the luminance of a colour. Of a checkerboard the number of the *other* square, as
    /// Mitsuba has it.
    #[inline]
    pub fn amount(&self, tiles: &dyn Textures, at: At) -> f32 {
        match self {
            Texture::Bitmap(bitmap) => bitmap.amount(bitmap.color(tiles, at.uv)),
            Texture::Checkerboard(checkerboard) => luminance(checkerboard.other(at.uv)),
            Texture::Attribute { scale } => luminance(at.attribute * *scale),
        }
    }

    /// Derivatives of the number by u and v, of a bilinear image; 0 of everything else, which has steps only.
    #[inline]
    pub fn gradient(&self, tiles: &dyn Textures, uv: [f32; 2]) -> [f32; 2] {
        match self {
            Texture::Bitmap(bitmap) => bitmap.gradient(tiles, uv),
            Texture::Checkerboard(_) | Texture::Attribute { .. } => [0.0; 2],
        }
    }

    /// Asks for the texels of a look-up that will come.
    #[inline]
    pub(crate) fn foresee(&self, tiles: &dyn Textures, spot: &Spot) {
        if let Texture::Bitmap(bitmap) = self {
            bitmap.foresee(tiles, spot);
        }
    }

    /// Its first tile and how many it has.
    pub fn tiles(&self) -> std::ops::Range<u32> {
        match self {
            Texture::Bitmap(bitmap) => bitmap.tiles(),
            Texture::Checkerboard(_) | Texture::Attribute { .. } => 0..0,
        }
    }
}
