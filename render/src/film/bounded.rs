//! A film that is filled in bounded memory: for a task that may touch any part of a large picture.

use std::ops::Range;

use super::code::{Reader, push_tile};
use super::{FilmPart, LIGHT, Layout, Rejected, Sums, Tile};
use crate::aov::{Aov, Aovs};

/// A film part of which so many tiles at most are held as sums; when more are touched, those that are held are packed into bytes first, as
/// they are stored, some 30 for each pixel that light came to. Sums are exact, so whatever was packed when adds up to the same.
#[derive(Clone, Debug)]
pub struct BoundedFilm {
    pub(super) part: FilmPart,
    room: Room,
}

/// What there is beside the sums.
#[derive(Clone, Debug)]
struct Room {
    /// Most tiles that are held as sums, at least 1.
    most: usize,
    held: usize,
    packed: Vec<Packed>,
    /// By tile: whether light ever touched it.
    touched: Vec<bool>,
}

/// Tiles that were held at one time.
#[derive(Clone, Default, Debug)]
struct Packed {
    light: Places,
    /// Of the sums of `aovs`.
    beside: Places,
    aovs: Aovs,
    bytes: Vec<u8>,
}

/// Number of each tile, ascending, and where its bytes begin.
type Places = Vec<(u32, usize)>;

impl Room {
    /// Makes room for one more tile that is held.
    fn make(&mut self, part: &mut FilmPart) {
        if self.held == self.most {
            let mut out = Packed { aovs: part.planes.aovs, ..Packed::default() };
            for (number, tile) in part.tiles.iter_mut().enumerate() {
                if let Some(tile) = tile.take() {
                    out.light.push((number as u32, out.bytes.len()));
                    push_tile(&mut out.bytes, LIGHT, tile.sums());
                }
            }
            for (number, tile) in part.planes.tiles.iter_mut().enumerate() {
                if let Some(tile) = tile.take() {
                    out.beside.push((number as u32, out.bytes.len()));
                    push_tile(&mut out.bytes, part.planes.stride, &tile);
                }
            }
            out.bytes.shrink_to_fit();
            self.packed.push(out);
            self.held = 0;
        }
        self.held += 1;
    }

    /// Makes room for a tile if it is not held.
    #[inline]
    fn hold(&mut self, part: &mut FilmPart, tile: usize) {
        if !part.holds(tile) {
            self.make(part);
        }
    }
}

impl BoundedFilm {
    /// An empty film that holds as sums at most the memory of `most` tiles of light (96 KiB each); with AOVs, whose sums lie beside, these
    /// are fewer tiles.
    pub fn new(layout: impl Into<Layout>, most: usize) -> Self {
        let layout = layout.into();
        let most = most.saturating_mul(size_of::<Sums>()) / layout.pixel_bytes();
        let part = FilmPart::new(layout);
        let touched = vec![false; part.tiles()];
        BoundedFilm { part, room: Room { most: most.max(1), held: 0, packed: Vec::new(), touched } }
    }

    /// As [`FilmPart::add`].
    #[inline]
    pub fn add(&mut self, pixel: u32, sample: u32, value: [f32; 3]) {
        self.add_all(std::iter::once((pixel, sample, value)));
    }

    /// As [`FilmPart::add_all`].
    #[inline]
    pub fn add_all(&mut self, light: impl Iterator<Item = (u32, u32, [f32; 3])>) {
        let BoundedFilm { part, room } = self;
        part.add_with(light, |part, tile| {
            if part.tiles[tile].is_none() {
                room.hold(part, tile);
                room.touched[tile] = true;
            }
        });
    }

    /// As [`FilmPart::add_aov`].
    pub fn add_aov(&mut self, aov: Aov, pixel: u32, sample: u32, values: &[f32]) {
        let BoundedFilm { part, room } = self;
        part.add_aov_with(aov, (pixel, sample), values, |part, tile| room.hold(part, tile));
    }

    /// What is taken beside light.
    #[inline(always)]
    pub fn aovs(&self) -> Aovs {
        self.part.aovs()
    }

    /// As [`FilmPart::keep_aovs`].
    pub fn keep_aovs(&mut self, aovs: Aovs) {
        // what is packed is sorted out when it is unpacked
        self.part.keep_aovs(aovs);
        self.room.held = (0..self.part.tiles()).filter(|&tile| self.part.holds(tile)).count();
    }

    /// As [`FilmPart::touch_all`].
    pub fn touch_all(&mut self) {
        let BoundedFilm { part, room } = self;
        for tile in 0..part.tiles() {
            let beside = part.planes.stride > 0;
            if beside || !room.touched[tile] {
                room.hold(part, tile);
                room.touched[tile] = true;
                part.tiles[tile].get_or_insert_with(Tile::new);
            }
            if beside {
                part.planes.tile(tile);
            }
        }
    }

    /// What was not added.
    pub fn rejected(&self) -> &Rejected {
        self.part.rejected()
    }

    /// Tiles that light touched.
    pub fn touched(&self) -> usize {
        self.room.touched.iter().filter(|&&t| t).count()
    }

    /// How many tiles it has, touched or not.
    pub fn tiles(&self) -> usize {
        self.part.tiles()
    }

    /// How often tiles were packed.
    pub fn packings(&self) -> usize {
        self.room.packed.len()
    }

    /// Memory of sums and of what is packed, bytes.
    pub fn memory(&self) -> usize {
        let places = |p: &Places| p.capacity() * size_of::<(u32, usize)>();
        let packed = |p: &Packed| p.bytes.capacity() + places(&p.light) + places(&p.beside);
        self.part.memory() + self.room.touched.len() + self.room.packed.iter().map(packed).sum::<usize>()
    }

    /// All of it as sums.
    pub fn into_part(mut self) -> FilmPart {
        let all = 0..self.part.tiles();
        self.unpack(&all);
        self.part
    }

    /// Hands the film over by bands of `size` tiles, ascending: number and encoded part of each that was touched or rejected something.
    /// Beside what it holds one band is there as sums and as bytes.
    ///
    /// # Errors
    /// Those of `each`.
    pub fn into_bands<E>(mut self, size: u32, mut each: impl FnMut(u32, Vec<u8>) -> Result<(), E>) -> Result<(), E> {
        let (tiles, size) = (self.part.tiles(), size.max(1) as usize);
        for (band, first) in (0..tiles).step_by(size).enumerate() {
            let range = first..tiles.min(first.saturating_add(size));
            self.unpack(&range);
            let rejected = self.part.rejected_in(&range);
            if rejected.count > 0 || range.clone().any(|tile| self.part.holds(tile)) {
                each(band as u32, self.part.encode_tiles(&range, &rejected))?;
            }
            if let Some(beside) = self.part.planes.tiles.get_mut(range.clone()) {
                beside.fill(None);
            }
            self.part.tiles[range].fill(None);
        }
        Ok(())
    }

    /// Adds what was packed of some tiles to the sums.
    fn unpack(&mut self, range: &Range<usize>) {
        let FilmPart { tiles, planes, .. } = &mut self.part;
        for packed in &self.room.packed {
            let within = |places: &Places| {
                let at = |tile: usize| places.partition_point(|p| (p.0 as usize) < tile);
                places[at(range.start)..at(range.end)].to_vec()
            };
            // what was packed here is whole
            for (number, at) in within(&packed.light) {
                let tile = tiles[number as usize].get_or_insert_with(Tile::new).sums_mut();
                let read = Reader { bytes: &packed.bytes, at }.tile(LIGHT, |i, sum| add(tile, i, sum));
                debug_assert!(read.is_ok());
            }
            if planes.stride == 0 {
                continue;
            }
            let kept = (packed.aovs != planes.aovs).then(|| planes.places(packed.aovs));
            for (number, at) in within(&packed.beside) {
                let mut reader = Reader { bytes: &packed.bytes, at };
                let read = match &kept {
                    None => {
                        let stride = planes.stride;
                        let tile = planes.tile(number as usize);
                        reader.tile(stride, |i, sum| add(tile, i, sum))
                    }
                    Some(places) => {
                        let mut sums = Vec::new();
                        let read = reader.tile(places.len(), |i, sum| sums.push((i, sum)));
                        planes.add_kept(number as usize, places, sums.into_iter());
                        read
                    }
                };
                debug_assert!(read.is_ok());
            }
        }
    }
}

/// Adds to a sum of a tile.
#[inline(always)]
pub(super) fn add(tile: &mut [i128], i: usize, sum: i128) {
    tile[i] = tile[i].wrapping_add(sum);
}
