//! Sums of AOVs beside a film's light: exact like it, and without halves.

use super::bounded::add;
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

    /// The sums of a tile, if there are any.
    pub(super) fn get(&self, tile: usize) -> Option<&[i128]> {
        self.tiles.get(tile)?.as_deref()
    }

    /// The sums of a tile, which there are from now on; only where pixels have sums at all.
    pub(super) fn tile(&mut self, tile: usize) -> &mut [i128] {
        let stride = self.stride;
        self.tiles[tile].get_or_insert_with(|| vec![0; PIXELS * stride].into_boxed_slice())
    }

    /// Place of the first sum of an AOV among those of a pixel.
    pub(super) fn first(&self, aov: Aov) -> usize {
        self.aovs.iter().take_while(|&a| a < aov).map(Aov::sums).sum()
    }

    /// For each sum of a pixel with other AOVs its place among the sums of a pixel here; none where its AOV is not among these.
    pub(super) fn places(&self, others: Aovs) -> Vec<Option<usize>> {
        let of = |aov: Aov| (0..aov.sums()).map(move |i| self.aovs.contains(aov).then(|| self.first(aov) + i));
        others.iter().flat_map(of).collect()
    }

    pub(super) fn touch_all(&mut self) {
        (0..self.tiles.len()).for_each(|tile| _ = self.tile(tile));
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

    /// Adds to a tile the sums of pixels with other AOVs, of which `places` has those that are kept ([`Planes::places`]). What another AOV
    /// alone has touched is not touched.
    pub(super) fn add_kept(
        &mut self,
        tile: usize,
        places: &[Option<usize>],
        sums: impl Iterator<Item = (usize, i128)>,
    ) {
        for (i, sum) in sums.filter(|s| s.1 != 0) {
            if let Some(place) = places[i % places.len()] {
                let at = i / places.len() * self.stride + place;
                add(self.tile(tile), at, sum);
            }
        }
    }

    /// The sums of an AOV at a place.
    pub(super) fn sums(&self, aov: Aov, (tile, at): (usize, usize)) -> Option<&[i128]> {
        let begin = at * self.stride + self.first(aov);
        self.get(tile).map(|tile| &tile[begin..begin + aov.sums()])
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
        self.add_aov_with(aov, (pixel, sample), values, |_, _| ());
    }

    /// The same; `before` is told of the tile, which it must leave as it is.
    pub(super) fn add_aov_with(
        &mut self,
        aov: Aov,
        (pixel, sample): (u32, u32),
        values: &[f32],
        before: impl FnOnce(&mut FilmPart, usize),
    ) {
        // false for NaN too
        if !values.iter().all(|x| x.abs() < super::LIMIT) {
            self.reject(pixel, sample);
            return;
        }
        let (tile, at) = self.place(pixel);
        before(self, tile);
        let begin = at * self.planes.stride + self.planes.first(aov);
        let tile = self.planes.tile(tile);
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
        let places = kept.places(self.planes.aovs);
        for (number, tile) in self.planes.tiles.iter().enumerate() {
            let Some(tile) = tile else { continue };
            kept.add_kept(number, &places, tile.iter().copied().enumerate());
        }
        self.planes = kept;
    }

    /// Its size and AOVs.
    pub fn layout(&self) -> Layout {
        Layout { size: self.size, aovs: self.planes.aovs }
    }
}
