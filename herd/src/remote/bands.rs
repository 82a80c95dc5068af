//! The film of a frame by bands of tiles: whoever adds it up, or makes a picture of it, holds one band at a time, however large it is.
//!
//! A band is so many tiles, row by row ([`Stage::band`](super::Stage)); tasks store a part of the film for each band that they touched.
//! A film of one band is stored as a whole. Parts that name no band (of earlier versions) may have something of any.

use std::collections::BTreeSet;
use std::io::{Seek, Write};
use std::ops::Range;

use rayherd_render::film::{ErrorSum, FilmPart, KEPT_KEYS, Layout, Samples, TILE};
use serde_json::{Map, Value};

use crate::job::JobError;
use crate::ledger::FilmRef;
use crate::picture::{self, Row};

/// Tiles of a band of a film without AOVs: 48 MiB of sums.
pub const BAND: u32 = 512;

/// Tiles of a band of another film, that take no more memory than `band` tiles without AOVs; one at least.
pub fn tiles(band: u32, layout: Layout) -> u32 {
    let light = Layout::from(layout.size).pixel_bytes() as u64;
    // at most as many as there were
    ((u64::from(band) * light / layout.pixel_bytes() as u64) as u32).max(1)
}

/// How many bands a film of `size` pixels has, each of so many tiles.
pub fn count([width, height]: [u32; 2], band: u32) -> u32 {
    (width.div_ceil(TILE) * height.div_ceil(TILE)).div_ceil(band.max(1))
}

/// Adds up the film of a frame.
pub struct Adder<'a> {
    /// What it holds.
    pub layout: Layout,
    /// Tiles of a band.
    pub band: u32,
    /// Reads a part: encoded and checked.
    pub read: &'a dyn Fn(&FilmRef) -> Result<Vec<u8>, JobError>,
}

/// What is known of a film when all of it was looked at.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Sum of the errors; none for one sample per pixel.
    pub error: Option<ErrorSum>,
    /// Pixel and sample of the first contributions that were not finite.
    pub non_finite: BTreeSet<(u32, u32)>,
}

impl Totals {
    /// Adds those of another part of the film.
    pub fn add(&mut self, error: Option<ErrorSum>, non_finite: impl IntoIterator<Item = (u32, u32)>) {
        if let Some(error) = error {
            *self.error.get_or_insert_default() += error;
        }
        self.non_finite.extend(non_finite);
        while self.non_finite.len() > KEPT_KEYS {
            self.non_finite.pop_last();
        }
    }
}

impl Adder<'_> {
    /// Tiles of a band.
    pub fn tiles(&self, band: u32) -> Range<u32> {
        let first = band.saturating_mul(self.band);
        first..first.saturating_add(self.band)
    }

    /// The sum of a band, or of the whole film.
    ///
    /// # Errors
    /// When a part cannot be read.
    pub fn sum(&self, parts: &[FilmRef], band: Option<u32>) -> Result<FilmPart, JobError> {
        let mut sum = FilmPart::new(self.layout);
        let tiles = band.map_or(0..u32::MAX, |b| self.tiles(b));
        for part in parts.iter().filter(|p| band.is_none() || p.band.is_none() || p.band == band) {
            sum.add_encoded(&(self.read)(part)?, tiles.clone())?;
        }
        Ok(sum)
    }

    /// Writes the picture of `samples` samples per pixel with the layers of its AOVs, from the top down; `offset` as for
    /// [`FilmPart::channels`]. What is `seen` are the rows as they are written.
    ///
    /// # Errors
    /// When a part cannot be read, or the picture cannot be written.
    pub fn picture(
        &self,
        parts: &[FilmRef],
        samples: &Samples,
        offset: [f64; 3],
        definition: &Map<String, Value>,
        out: impl Write + Seek,
        mut seen: impl FnMut(&[[f32; 3]]) -> Result<(), JobError>,
    ) -> Result<Totals, JobError> {
        let beside: Vec<&str> = self.layout.aovs.channels().collect();
        let mut rows = Rows::new(self, parts, samples, (offset, beside.len()));
        let mut lit = false;
        let next = |y: u32, row: &mut Row| -> Result<(), JobError> {
            rows.next(y, row)?;
            lit |= row.light.iter().any(|pixel| *pixel != [0.0; 3]);
            seen(&row.light)
        };
        picture::write(self.layout.size, &beside, definition, next, out)?;
        if !lit {
            tracing::warn!(
                "the picture is black: no light reached the camera; rayherd check SCENE says whether it stands inside of a shape"
            );
        }
        Ok(rows.totals)
    }

    /// The rows of that picture alone, from the top down, without its layers: of a film that may not be finished.
    ///
    /// # Errors
    /// When a part cannot be read, or a row is not taken.
    pub fn show(
        &self,
        parts: &[FilmRef],
        samples: &Samples,
        mut seen: impl FnMut(&[[f32; 3]]) -> Result<(), JobError>,
    ) -> Result<(), JobError> {
        let [width, height] = self.layout.size;
        let mut rows = Rows::new(self, parts, samples, ([0.0; 3], 0));
        let mut row = Row::new(width as usize, 0);
        for y in 0..height {
            rows.next(y, &mut row)?;
            seen(&row.light)?;
        }
        Ok(())
    }
}

/// The rows of a picture, of which one band of the film is in memory at a time.
struct Rows<'a> {
    adder: &'a Adder<'a>,
    parts: &'a [FilmRef],
    samples: &'a Samples,
    offset: [f64; 3],
    totals: Totals,
    current: Option<(u32, FilmPart)>,
    /// Of the tiles that are side by side, one after the other.
    rows: Row,
}

impl<'a> Rows<'a> {
    /// With so many channels beside the picture: all, or none.
    fn new(adder: &'a Adder, parts: &'a [FilmRef], samples: &'a Samples, (offset, beside): ([f64; 3], usize)) -> Self {
        let rows = Row::new(adder.layout.size[0] as usize * TILE as usize, beside);
        Rows { adder, parts, samples, offset, totals: Totals::default(), current: None, rows }
    }

    /// Row `y`, after the one above it.
    fn next(&mut self, y: u32, row: &mut Row) -> Result<(), JobError> {
        let width = self.adder.layout.size[0];
        let at = |x: u32, y: u32| (y % TILE * width + x) as usize;
        if y.is_multiple_of(TILE) {
            let across = width.div_ceil(TILE);
            self.rows.light.fill([0.0; 3]);
            for tile in (y / TILE * across)..(y / TILE + 1) * across {
                let band = tile / self.adder.band.max(1);
                if self.current.as_ref().is_none_or(|c| c.0 != band) {
                    // the one before goes first
                    self.current = None;
                    let sum = self.adder.sum(self.parts, Some(band))?;
                    self.totals.add(sum.error_sum(self.samples), sum.rejected().keys.iter().copied());
                    self.current = Some((band, sum));
                }
                if let Some((_, sum)) = &self.current {
                    let Row { light, beside } = &mut self.rows;
                    sum.resolve_tile(tile, self.samples, |x, y, value| light[at(x, y)] = value);
                    if !beside.is_empty() {
                        sum.channels_of_tile(tile, self.samples, self.offset, |x, y, channel, value| {
                            beside[channel][at(x, y)] = value;
                        });
                    }
                }
            }
        }
        row.copy_from(&self.rows, at(0, y));
        Ok(())
    }
}
