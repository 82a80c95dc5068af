//! The film: exact sums, so that order is nothing.
//!
//! A contribution becomes fixed point of 2^-64 in an `i128` (bits of a float below 2^-64 are cut off, always the same ones), and integers
//! add in any order. Each pixel has two halves, the even and the odd samples. A film holds only the tiles of 32 x 32 pixels that were
//! touched; a task commits its [`FilmPart`], and parts merge by adding.
//!
//! A contribution that is not finite, is negative, or is 2^38 or more is not added: it is counted, and the smallest
//! [`KEPT_KEYS`] of the (pixel, sample) that made one are kept to replay them. Sums stay exact below 2^63 per pixel and half.
//!
//! AOVs are summed likewise, beside the light ([`FilmPart::add_aov`]); without any a film is what it is without them.

mod bounded;
mod code;
mod planes;
mod resolve;
mod samples;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::ops::Range;

pub use bounded::BoundedFilm;
pub use code::FilmError;
pub use resolve::{Channel, ErrorSum};
pub use samples::{PerTile, Samples};

use crate::aov::Aovs;
use planes::Planes;

/// Width and height of a tile in pixels.
pub const TILE: u32 = 32;
/// How many keys of rejected contributions are kept.
pub const KEPT_KEYS: usize = 16;

/// Contributions of this size and above are rejected.
const LIMIT: f32 = 274_877_906_944.0; // 2^38

/// Sums of one pixel: by half, by channel.
type Sums = [[i128; 3]; 2];
/// How many these are.
const LIGHT: usize = 6;

/// Sums of one tile, row by row.
#[derive(Clone, PartialEq, Eq, Debug)]
struct Tile(Box<[Sums]>);

impl Tile {
    fn new() -> Tile {
        Tile(vec![[[0; 3]; 2]; (TILE * TILE) as usize].into_boxed_slice())
    }

    /// All sums side by side, [`LIGHT`] of each pixel.
    fn sums(&self) -> &[i128] {
        self.0.as_flattened().as_flattened()
    }

    fn sums_mut(&mut self) -> &mut [i128] {
        self.0.as_flattened_mut().as_flattened_mut()
    }
}

/// What a film holds: only films of one layout add up.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Layout {
    /// Width and height in pixels, each from 1 to 65535.
    pub size: [u32; 2],
    /// What is taken beside light.
    pub aovs: Aovs,
}

impl Layout {
    /// Memory of a pixel's sums in bytes: 96, and 16 for each sum of the AOVs.
    pub fn pixel_bytes(self) -> usize {
        size_of::<Sums>() + self.aovs.sums() * size_of::<i128>()
    }
}

impl From<[u32; 2]> for Layout {
    /// Light alone.
    fn from(size: [u32; 2]) -> Layout {
        Layout { size, aovs: Aovs::NONE }
    }
}

/// A film, or the part of one that some task filled.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct FilmPart {
    size: [u32; 2],
    tiles: Vec<Option<Tile>>,
    planes: Planes,
    rejected: Rejected,
}

/// Contributions that were not added.
#[derive(Clone, Default, PartialEq, Eq, Debug)]
pub struct Rejected {
    /// How many.
    pub count: u64,
    /// The smallest (pixel, sample) among them, at most [`KEPT_KEYS`].
    pub keys: BTreeSet<(u32, u32)>,
}

impl Rejected {
    /// What of it belongs to some of the pixels.
    fn of(&self, belongs: impl Fn(u32) -> bool) -> Rejected {
        let keys: BTreeSet<(u32, u32)> = self.keys.iter().copied().filter(|k| belongs(k.0)).collect();
        let first = self.keys.first().map_or(0, |k| k.0);
        let untold = if belongs(first) { self.count - self.keys.len() as u64 } else { 0 };
        Rejected { count: keys.len() as u64 + untold, keys }
    }
    /// Adds what others rejected.
    pub fn merge(&mut self, other: &Rejected) {
        self.count += other.count;
        other.keys.iter().for_each(|&key| self.insert(key));
    }
    fn insert(&mut self, key: (u32, u32)) {
        self.keys.insert(key);
        if self.keys.len() > KEPT_KEYS {
            self.keys.pop_last();
        }
    }
}

impl FilmPart {
    /// An empty film; of a size alone one without AOVs.
    pub fn new(layout: impl Into<Layout>) -> FilmPart {
        let Layout { size, aovs } = layout.into();
        let tiles = size[0].div_ceil(TILE) as usize * size[1].div_ceil(TILE) as usize;
        FilmPart { size, tiles: vec![None; tiles], planes: Planes::new(aovs, tiles), rejected: Rejected::default() }
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// What was not added.
    pub fn rejected(&self) -> &Rejected {
        &self.rejected
    }

    /// Whether there is nothing to keep: no light, no AOV, nothing rejected.
    pub fn is_empty(&self) -> bool {
        self.rejected.count == 0 && !(0..self.tiles.len()).any(|tile| self.holds(tile))
    }

    /// Tiles that light touched.
    pub fn touched(&self) -> usize {
        self.tiles.iter().flatten().count()
    }

    /// How many tiles it has, touched or not.
    pub fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// Touches all tiles, so that all are held and stored.
    pub fn touch_all(&mut self) {
        self.tiles.iter_mut().for_each(|tile| _ = tile.get_or_insert_with(Tile::new));
        self.planes.touch_all();
    }

    /// Memory of the sums in bytes.
    pub fn memory(&self) -> usize {
        let light = self.touched() * (TILE * TILE) as usize * size_of::<Sums>();
        light + self.tiles.len() * size_of::<Option<Tile>>() + self.planes.memory()
    }

    /// Adds a contribution to pixel `y * width + x` (below width * height).
    #[inline]
    pub fn add(&mut self, pixel: u32, sample: u32, value: [f32; 3]) {
        // false for NaN too; -0 passes and adds nothing
        if !value.iter().all(|&x| (0.0..LIMIT).contains(&x)) {
            self.reject(pixel, sample);
            return;
        }
        let (tile, at) = self.place(pixel);
        let sums = &mut self.tiles[tile].get_or_insert_with(Tile::new).0[at];
        add(&mut sums[(sample & 1) as usize], value);
    }

    /// Adds many: [`FilmPart::add`] of (pixel, sample, value). Where neighbours are of one pixel, which paths of one picture mostly
    /// are, its place is looked up once.
    #[inline]
    pub fn add_all(&mut self, light: impl Iterator<Item = (u32, u32, [f32; 3])>) {
        self.add_with(light, |_, _| ());
    }

    /// The same; `before` is told of the tile that comes next, which it must leave as it is.
    #[inline]
    fn add_with(
        &mut self,
        light: impl Iterator<Item = (u32, u32, [f32; 3])>,
        mut before: impl FnMut(&mut FilmPart, usize),
    ) {
        let (mut last, mut tile, mut at) = (None, 0, 0);
        for (pixel, sample, value) in light {
            if !value.iter().all(|&x| (0.0..LIMIT).contains(&x)) {
                self.reject(pixel, sample);
                continue;
            }
            if last != Some(pixel) {
                last = Some(pixel);
                (tile, at) = self.place(pixel);
                before(self, tile);
            }
            let sums = &mut self.tiles[tile].get_or_insert_with(Tile::new).0[at];
            add(&mut sums[(sample & 1) as usize], value);
        }
    }

    /// Whether there are sums of a tile, of light or of AOVs.
    fn holds(&self, tile: usize) -> bool {
        self.tiles[tile].is_some() || self.planes.get(tile).is_some()
    }

    /// Tile of a pixel, and its place in the tile.
    #[inline]
    fn place(&self, pixel: u32) -> (usize, usize) {
        self.place_at(pixel % self.size[0], pixel / self.size[0])
    }

    #[inline(always)]
    fn place_at(&self, x: u32, y: u32) -> (usize, usize) {
        let tile = y / TILE * self.size[0].div_ceil(TILE) + x / TILE;
        (tile as usize, (y % TILE * TILE + x % TILE) as usize)
    }

    #[cold]
    fn reject(&mut self, pixel: u32, sample: u32) {
        self.rejected.count += 1;
        self.rejected.insert((pixel, sample));
    }

    /// Adds another part of the same film.
    pub fn merge(&mut self, other: &FilmPart) -> Result<(), FilmError> {
        if self.size != other.size {
            return Err(FilmError::Size { expected: self.size, found: other.size });
        }
        self.planes.merge(&other.planes)?;
        for (mine, theirs) in self.tiles.iter_mut().zip(&other.tiles) {
            let Some(theirs) = theirs else { continue };
            let Some(mine) = mine else {
                *mine = Some(theirs.clone());
                continue;
            };
            for (a, b) in mine.sums_mut().iter_mut().zip(theirs.sums()) {
                *a = a.wrapping_add(*b);
            }
        }
        self.rejected.merge(&other.rejected);
        Ok(())
    }

    /// What was rejected of the pixels of some tiles. What is not told by keys goes with the first key, so that the counts of all
    /// tiles add up.
    fn rejected_in(&self, tiles: &Range<usize>) -> Rejected {
        self.rejected.of(|pixel| tiles.contains(&self.place(pixel).0))
    }

    fn sums(&self, x: u32, y: u32) -> &Sums {
        const NONE: Sums = [[0; 3]; 2];
        let (tile, at) = self.place_at(x, y);
        match &self.tiles[tile] {
            Some(tile) => &tile.0[at],
            None => &NONE,
        }
    }
}

#[inline(always)]
fn add(sums: &mut [i128; 3], value: [f32; 3]) {
    for (sum, x) in sums.iter_mut().zip(value) {
        *sum = sum.wrapping_add(fixed(x));
    }
}

/// A float in [0, 2^38) in units of 2^-64, cut off towards 0.
#[inline(always)]
fn fixed(x: f32) -> i128 {
    let bits = x.to_bits();
    let exponent = (bits >> 23 & 255) as i32;
    // subnormals are far below 2^-64
    let mantissa = u64::from(bits & 0x7f_ffff | 0x80_0000);
    // x = mantissa 2^(exponent - 150); a shift of at most 24 to the right keeps any bit, one of 78 to the left is the most below 2^38
    let shift = exponent - 150 + 64;
    if shift >= 0 {
        (u128::from(mantissa) << shift) as i128
    } else if shift > -24 {
        i128::from(mantissa >> -shift)
    } else {
        0
    }
}
