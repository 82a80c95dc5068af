//! Where texels come from.

use std::cell::Ref;
use std::fmt;

/// Edge of a tile in texels. Tiles at the right and lower edge of an image hold what is there, no more.
pub const TILE: u32 = 128;

/// Hands out tiles: to one thread at a time.
pub trait Textures {
    /// The texels of a tile, by rows without gaps, as [`super::Bitmap::tile_bytes`] says; `None` when they cannot be had. Then the look-up
    /// gives 0: whoever shades asks the implementor for its error before anything that was shaded counts.
    fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>>;
    /// The same if it costs nothing: a tile that would have to be read is left where it is.
    fn at_hand(&self, _: u32) -> Option<Ref<'_, [u8]>> {
        None
    }
}

impl fmt::Debug for dyn Textures + '_ {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("textures")
    }
}

/// No tiles: for worlds without bitmaps.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoTextures;

impl Textures for NoTextures {
    fn tile(&self, _: u32) -> Option<Ref<'_, [u8]>> {
        None
    }
}
