//! A film part as bytes.
//!
//! Little endian: `RHF1`, width u32, height u32, rejected count u64, number of keys u8, keys (pixel u32, sample u32) ascending, number of
//! tiles u32; then the tiles by ascending number: number u32; a bitmap of 128 bytes with a bit for each pixel that has a sum other
//! than 0; six header bytes for each of those (half by half, channel by channel); the values' bytes in the same order. A value is
//! stored without the zero bytes at its low end and without the bytes of mere sign at its high end: the header's low nibble is the
//! number of zero bytes below, its high nibble the number of bytes less 1. 0xff stands for a value of 0.

use std::ops::Range;

use super::bounded::add;
use super::{FilmPart, KEPT_KEYS, Rejected, TILE, Tile};

const MAGIC: &[u8; 4] = b"RHF1";
const ZERO: u8 = 0xff;

/// Why bytes are no film part, or parts do not belong together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FilmError {
    /// Not this format, or another version of it.
    #[error("this is no film part of version 1")]
    Magic,
    /// Ends too early.
    #[error("the film part is cut off at byte {0}")]
    Truncated(usize),
    /// Another picture's.
    #[error("a film part of {found:?} pixels where {expected:?} are expected")]
    Size {
        /// Of this film.
        expected: [u32; 2],
        /// Of the part.
        found: [u32; 2],
    },
    /// Content that `encode` never writes.
    #[error("the film part is corrupt at byte {0}")]
    Corrupt(usize),
}

impl FilmPart {
    /// The part as bytes, the same for the same sums.
    pub fn encode(&self) -> Vec<u8> {
        self.encode_tiles(&(0..self.tiles.len()), &self.rejected)
    }

    /// The part that some of its tiles are.
    pub(super) fn encode_tiles(&self, tiles: &Range<usize>, rejected: &Rejected) -> Vec<u8> {
        let mut out = Vec::new();
        out.extend(MAGIC);
        out.extend(self.size[0].to_le_bytes());
        out.extend(self.size[1].to_le_bytes());
        out.extend(rejected.count.to_le_bytes());
        out.push(rejected.keys.len() as u8);
        for (pixel, sample) in &rejected.keys {
            out.extend(pixel.to_le_bytes());
            out.extend(sample.to_le_bytes());
        }
        let touched = || tiles.clone().zip(&self.tiles[tiles.clone()]).filter_map(|(n, t)| Some((n, t.as_ref()?)));
        out.extend((touched().count() as u32).to_le_bytes());
        for (number, tile) in touched() {
            out.extend((number as u32).to_le_bytes());
            push_tile(&mut out, tile);
        }
        out
    }

    /// From bytes of a film of `size` pixels; reads no more memory than the film has tiles.
    pub fn decode(bytes: &[u8], size: [u32; 2]) -> Result<FilmPart, FilmError> {
        let mut part = FilmPart::new(size);
        let all = 0..part.tiles.len();
        part.read(bytes, &all)?;
        Ok(part)
    }

    /// Whether bytes are a part of a film of `size` pixels, found in no memory.
    pub fn check(bytes: &[u8], size: [u32; 2]) -> Result<(), FilmError> {
        FilmPart { size, tiles: Vec::new(), rejected: Rejected::default() }.read(bytes, &(0..0))
    }

    /// Adds some tiles of a part that is given as bytes, and what was rejected of their pixels. Nothing is added when the bytes are no
    /// part of this film.
    pub fn add_encoded(&mut self, bytes: &[u8], tiles: Range<u32>) -> Result<(), FilmError> {
        FilmPart::check(bytes, self.size)?;
        let tiles = tiles.start as usize..self.tiles.len().min(tiles.end as usize);
        self.read(bytes, &tiles)
    }

    /// Adds the tiles of `take`; all others are looked at.
    fn read(&mut self, bytes: &[u8], take: &Range<usize>) -> Result<(), FilmError> {
        let mut r = Reader { bytes, at: 0 };
        if r.take(4)? != MAGIC {
            return Err(FilmError::Magic);
        }
        let found = [r.u32()?, r.u32()?];
        if found != self.size {
            return Err(FilmError::Size { expected: self.size, found });
        }
        let rejected = r.rejected(u64::from(found[0]) * u64::from(found[1]))?;
        let own = rejected.of(|pixel| take.contains(&self.place(pixel).0));
        self.rejected.merge(&own);
        let (mut next, tiles) = (0, found[0].div_ceil(TILE) as usize * found[1].div_ceil(TILE) as usize);
        for _ in 0..r.u32()? {
            let place = r.at;
            let number = r.u32()? as usize;
            if number < next || number >= tiles {
                return Err(FilmError::Corrupt(place));
            }
            next = number + 1;
            if take.contains(&number) {
                let tile = self.tiles[number].get_or_insert_with(Tile::new);
                r.tile(|i, sum| add(tile, i, sum))?;
            } else {
                r.tile(|_, _| ())?;
            }
        }
        if r.at != bytes.len() {
            return Err(FilmError::Corrupt(r.at));
        }
        Ok(())
    }
}

/// Appends a tile: bitmap, headers, values.
pub(super) fn push_tile(out: &mut Vec<u8>, tile: &Tile) {
    let bitmap = out.len();
    out.resize(bitmap + (TILE * TILE / 8) as usize, 0);
    let mut body = Vec::new();
    for (i, sums) in tile.0.iter().enumerate() {
        if sums.as_flattened().iter().all(|&s| s == 0) {
            continue;
        }
        out[bitmap + i / 8] |= 1 << (i % 8);
        for &sum in sums.as_flattened() {
            out.push(push_value(&mut body, sum));
        }
    }
    out.extend(&body);
}

/// Appends the bytes of a value that are not its sign's or zeros at the end, and returns the header.
fn push_value(body: &mut Vec<u8>, value: i128) -> u8 {
    if value == 0 {
        return ZERO;
    }
    let low = value.trailing_zeros() / 8;
    let value = value >> (8 * low);
    let bits = 129 - if value < 0 { (!value).leading_zeros() } else { value.leading_zeros() };
    let count = bits.div_ceil(8).min(16);
    body.extend(&value.to_le_bytes()[..count as usize]);
    low as u8 | (count as u8 - 1) << 4
}

pub(super) struct Reader<'a> {
    pub bytes: &'a [u8],
    pub at: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8], FilmError> {
        let end =
            self.at.checked_add(n).filter(|&e| e <= self.bytes.len()).ok_or(FilmError::Truncated(self.bytes.len()))?;
        let out = &self.bytes[self.at..end];
        self.at = end;
        Ok(out)
    }

    fn u32(&mut self) -> Result<u32, FilmError> {
        Ok(u32::from_le_bytes(self.take(4)?.try_into().map_err(|_| FilmError::Truncated(self.at))?))
    }

    fn rejected(&mut self, pixels: u64) -> Result<Rejected, FilmError> {
        let count = u64::from(self.u32()?) | u64::from(self.u32()?) << 32;
        let place = self.at;
        let n = self.take(1)?[0] as usize;
        if n > KEPT_KEYS || n as u64 > count {
            return Err(FilmError::Corrupt(place));
        }
        let mut out = Rejected { count, ..Rejected::default() };
        for _ in 0..n {
            let place = self.at;
            let key = (self.u32()?, self.u32()?);
            if u64::from(key.0) >= pixels || out.keys.last().is_some_and(|last| *last >= key) {
                return Err(FilmError::Corrupt(place));
            }
            out.keys.insert(key);
        }
        Ok(out)
    }

    /// Hands over each sum of a tile's pixels that has one: its place, half by half, channel by channel, pixel after pixel, and itself.
    pub fn tile(&mut self, mut each: impl FnMut(usize, i128)) -> Result<(), FilmError> {
        let bitmap = self.take((TILE * TILE / 8) as usize)?;
        let touched: usize = bitmap.iter().map(|b| b.count_ones() as usize).sum();
        let headers_at = self.at;
        let headers = self.take(6 * touched)?;
        let mut next = 0;
        for pixel in (0..(TILE * TILE) as usize).filter(|i| bitmap[i / 8] >> (i % 8) & 1 != 0) {
            for i in 0..6 {
                each(6 * pixel + i, self.value(headers[next], headers_at + next)?);
                next += 1;
            }
        }
        Ok(())
    }

    fn value(&mut self, header: u8, place: usize) -> Result<i128, FilmError> {
        if header == ZERO {
            return Ok(0);
        }
        let (low, count) = (u32::from(header & 15), usize::from(header >> 4) + 1);
        if low as usize + count > 16 {
            return Err(FilmError::Corrupt(place));
        }
        let bytes = self.take(count)?;
        let sign = if bytes[count - 1] & 0x80 != 0 { 0xff } else { 0 };
        let mut wide = [sign; 16];
        wide[..count].copy_from_slice(bytes);
        Ok(i128::from_le_bytes(wide) << (8 * low))
    }
}
