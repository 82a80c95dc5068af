//! A film that is filled in bounded memory: for a task that may touch any part of a large picture.

use std::ops::Range;

use super::code::{Reader, push_tile};
use super::{FilmPart, Rejected, Tile};

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
    /// By tile: whether it was ever touched.
    touched: Vec<bool>,
}

/// Tiles that were held at one time.
#[derive(Clone, Default, Debug)]
struct Packed {
    /// Number of each tile, ascending, and where its bytes begin.
    places: Vec<(u32, usize)>,
    bytes: Vec<u8>,
}

impl Room {
    /// Makes room for one more tile that is held.
    fn make(&mut self, part: &mut FilmPart, tile: usize) {
        if self.held == self.most {
            let mut out = Packed::default();
            for (number, tile) in part.tiles.iter_mut().enumerate() {
                if let Some(tile) = tile.take() {
                    out.places.push((number as u32, out.bytes.len()));
                    push_tile(&mut out.bytes, &tile);
                }
            }
            out.bytes.shrink_to_fit();
            self.packed.push(out);
            self.held = 0;
        }
        self.held += 1;
        self.touched[tile] = true;
    }
}

impl BoundedFilm {
    /// An empty film of `size` pixels that holds at most `most` tiles as sums (96 KiB each).
    pub fn new(size: [u32; 2], most: usize) -> Self {
        let part = FilmPart::new(size);
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
                room.make(part, tile);
            }
        });
    }

    /// As [`FilmPart::touch_all`].
    pub fn touch_all(&mut self) {
        let BoundedFilm { part, room } = self;
        for tile in 0..part.tiles() {
            if !room.touched[tile] {
                room.make(part, tile);
                part.tiles[tile] = Some(Tile::new());
            }
        }
    }

    /// What was not added.
    pub fn rejected(&self) -> &Rejected {
        self.part.rejected()
    }

    /// Tiles that were touched.
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
        let packed = |p: &Packed| p.bytes.capacity() + p.places.capacity() * size_of::<(u32, usize)>();
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
            if rejected.count > 0 || self.part.tiles[range.clone()].iter().any(Option::is_some) {
                each(band as u32, self.part.encode_tiles(&range, &rejected))?;
            }
            self.part.tiles[range].fill(None);
        }
        Ok(())
    }

    /// Adds what was packed of some tiles to the sums.
    fn unpack(&mut self, range: &Range<usize>) {
        for packed in &self.room.packed {
            let at = |tile: usize| packed.places.partition_point(|p| (p.0 as usize) < tile);
            for &(number, place) in &packed.places[at(range.start)..at(range.end)] {
                let tile = self.part.tiles[number as usize].get_or_insert_with(Tile::new);
                let mut reader = Reader { bytes: &packed.bytes, at: place };
                // what was packed here is whole
                let read = reader.tile(|i, sum| add(tile, i, sum));
                debug_assert!(read.is_ok());
            }
        }
    }
}

/// Adds to a sum of a tile: half by half, channel by channel, pixel after pixel.
pub(super) fn add(tile: &mut Tile, i: usize, sum: i128) {
    let place = &mut tile.0[i / 6].as_flattened_mut()[i % 6];
    *place = place.wrapping_add(sum);
}
