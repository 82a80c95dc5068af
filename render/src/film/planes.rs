//! Sums of AOVs beside a film's light: exact like it, and without halves.

use super::{FilmError, FilmPart, Layout, TILE, fixed};
use crate::aov::{Aov, Aovs};

/// Pixels of a tile.
const PIXELS: usize = (TILE * TILE) as usize;

/// Sums by tile and pixel, those of a pixel side by side. Without AOVs it takes no memory.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(super) struct Planes {
    pub(super) aovs: Aovs,
    /// Sums of a pixel.
    pub(super) stride: usize,
    /// None at all where there are no sums.
    pub(super) tiles: Vec<Option<Box<[i128]>>>,
}

impl Planes {
    /// Of a film of so many tiles.
    pub(super) fn new(aovs: Aovs, tiles: usize) -> Planes {
        let stride = aovs.sums();
        Planes { aovs, stride, tiles: vec![None; if stride > 0 { tiles } else { 0 }] }
    }

    /// A tile without light.
    pub(super) fn tile(stride: usize) -> Box<[i128]> {
        vec![0; PIXELS * stride].into_boxed_slice()
    }

    /// Place of the first sum of an AOV among those of a pixel.
    pub(super) fn first(&self, aov: Aov) -> usize {
        self.aovs.iter().take_while(|&a| a < aov).map(Aov::sums).sum()
    }

    pub(super) fn touch_all(&mut self) {
        let stride = self.stride;
        self.tiles.iter_mut().for_each(|tile| _ = tile.get_or_insert_with(|| Planes::tile(stride)));
    }

    pub(super) fn memory(&self) -> usize {
        let sums = self.tiles.iter().flatten().map(|t| size_of_val(&t[..])).sum::<usize>();
        sums + size_of_val(&self.tiles[..])
    }

    pub(super) fn merge(&mut self, other: &Planes) -> Result<(), FilmError> {
        if self.aovs != other.aovs {
            return Err(FilmError::Aovs { expected: self.aovs, found: other.aovs });
        }
        for (mine, theirs) in self.tiles.iter_mut().zip(&other.tiles) {
            let Some(theirs) = theirs else { continue };
            match mine {
                None => *mine = Some(theirs.clone()),
                Some(mine) => mine.iter_mut().zip(theirs).for_each(|(a, b)| *a = a.wrapping_add(*b)),
            }
        }
        Ok(())
    }

    /// The sums of an AOV at a place.
    pub(super) fn sums(&self, aov: Aov, (tile, at): (usize, usize)) -> Option<&[i128]> {
        let begin = at * self.stride + self.first(aov);
        self.tiles.get(tile)?.as_ref().map(|tile| &tile[begin..begin + aov.sums()])
    }
}

impl FilmPart {
    /// What is taken beside light.
    #[inline(always)]
    pub fn aovs(&self) -> Aovs {
        self.planes.aovs
    }

    /// Adds to the sums of an AOV, which must be one of the film's: as many values as it has sums. Values may be negative; what is not finite or has
    /// an absolute value of 2^38 or more is rejected as light is.
    pub fn add_aov(&mut self, aov: Aov, pixel: u32, sample: u32, values: &[f32]) {
        // false for NaN too
        if !values.iter().all(|x| x.abs() < super::LIMIT) {
            self.reject(pixel, sample);
            return;
        }
        let (tile, at) = self.place(pixel);
        let Planes { stride, .. } = self.planes;
        let begin = at * stride + self.planes.first(aov);
        let tile = self.planes.tiles[tile].get_or_insert_with(|| Planes::tile(stride));
        for (sum, &x) in tile[begin..begin + aov.sums()].iter_mut().zip(values) {
            // cut off towards 0 on both sides
            *sum = sum.wrapping_add(if x < 0.0 { -fixed(-x) } else { fixed(x) });
        }
    }

    /// Forgets all AOVs but these, which must be among the film's.
    pub fn keep_aovs(&mut self, aovs: Aovs) {
        if aovs == self.planes.aovs {
            return;
        }
        let mut kept = Planes::new(aovs, self.tiles.len());
        let ranges: Vec<_> = aovs.iter().map(|a| (self.planes.first(a), a.sums())).collect();
        for (to, from) in kept.tiles.iter_mut().zip(&self.planes.tiles) {
            let Some(from) = from else { continue };
            let pixel =
                |sums: &[i128]| ranges.iter().flat_map(|&(at, n)| sums[at..at + n].to_vec()).collect::<Vec<_>>();
            let sums: Vec<i128> = from.chunks(self.planes.stride).flat_map(pixel).collect();
            // what another AOV alone has touched is not touched
            *to = sums.iter().any(|&s| s != 0).then(|| sums.into_boxed_slice());
        }
        self.planes = kept;
    }

    /// Its size and AOVs.
    pub fn layout(&self) -> Layout {
        Layout { size: self.size, aovs: self.planes.aovs }
    }
}
