//! A film part as bytes.
//!
//! Little endian: `RHF1`, width u32, height u32, rejected count u64, number of keys u8, keys (pixel u32, sample u32) ascending, number of
//! tiles u32; then the tiles by ascending number: number u32; a bitmap of 128 bytes with a bit for each pixel that has a sum other
//! than 0; six header bytes for each of those (half by half, channel by channel); the values' bytes in the same order. A value is
//! stored without the zero bytes at its low end and without the bytes of mere sign at its high end: the header's low nibble is the
//! number of zero bytes below, its high nibble the number of bytes less 1. 0xff stands for a value of 0.
//!
//! With AOVs the first four bytes are `RHF2`; after the height comes a bit for each AOV, u16, and at the end the number of their tiles u32,
//! and these tiles in the same form, with as many values for each pixel as the AOVs have sums.

use std::ops::Range;

use super::bounded::add;
use super::{FilmPart, KEPT_KEYS, LIGHT, Layout, Planes, Rejected, TILE, Tile};
use crate::aov::Aovs;

const MAGIC: &[u8; 4] = b"RHF1";
const MAGIC_AOVS: &[u8; 4] = b"RHF2";
const ZERO: u8 = 0xff;

/// Why bytes are no film part, or parts do not belong together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FilmError {
    /// Not this format, or another version of it.
    #[error("this is no film part of version 1 or 2")]
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
    /// With other AOVs.
    #[error("a film part with these AOVs: {found}; expected: {expected}")]
    Aovs {
        /// Of this film.
        expected: Aovs,
        /// Of the part.
        found: Aovs,
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
        let Planes { aovs, stride, .. } = self.planes;
        let mut out = Vec::new();
        out.extend(if aovs.is_empty() { MAGIC } else { MAGIC_AOVS });
        out.extend(self.size[0].to_le_bytes());
        out.extend(self.size[1].to_le_bytes());
        if !aovs.is_empty() {
            out.extend(aovs.bits().to_le_bytes());
        }
        out.extend(rejected.count.to_le_bytes());
        out.push(rejected.keys.len() as u8);
        for (pixel, sample) in &rejected.keys {
            out.extend(pixel.to_le_bytes());
            out.extend(sample.to_le_bytes());
        }
        push_tiles(&mut out, LIGHT, tiles.clone().filter_map(|n| Some((n, self.tiles[n].as_ref()?.sums()))));
        if !aovs.is_empty() {
            push_tiles(&mut out, stride, tiles.clone().filter_map(|n| Some((n, self.planes.get(n)?))));
        }
        out
    }

    /// From bytes of a film of this layout; takes no more memory than the film has tiles.
    pub fn decode(bytes: &[u8], layout: impl Into<Layout>) -> Result<FilmPart, FilmError> {
        let mut part = FilmPart::new(layout);
        let all = 0..part.tiles.len();
        part.read(bytes, &all)?;
        Ok(part)
    }

    /// Whether bytes are a part of a film of this layout, found in no memory.
    pub fn check(bytes: &[u8], layout: impl Into<Layout>) -> Result<(), FilmError> {
        let Layout { size, aovs } = layout.into();
        let planes = Planes::new(aovs, 0);
        FilmPart { size, tiles: Vec::new(), planes, rejected: Rejected::default() }.read(bytes, &(0..0))
    }

    /// Adds some tiles of a part that is given as bytes, and what was rejected of their pixels. Nothing is added when the bytes are no
    /// part of this film.
    pub fn add_encoded(&mut self, bytes: &[u8], tiles: Range<u32>) -> Result<(), FilmError> {
        FilmPart::check(bytes, self.layout())?;
        let tiles = tiles.start as usize..self.tiles.len().min(tiles.end as usize);
        self.read(bytes, &tiles)
    }

    /// Adds the tiles of `take`; all others are looked at.
    fn read(&mut self, bytes: &[u8], take: &Range<usize>) -> Result<(), FilmError> {
        let mut r = Reader { bytes, at: 0 };
        let magic = r.take(4)?;
        if magic != MAGIC && magic != MAGIC_AOVS {
            return Err(FilmError::Magic);
        }
        let found @ [width, height] = [r.u32()?, r.u32()?];
        if found != self.size {
            return Err(FilmError::Size { expected: self.size, found });
        }
        let Planes { aovs, stride, .. } = self.planes;
        let found = if magic == MAGIC { Aovs::NONE } else { r.aovs()? };
        if found != aovs {
            return Err(FilmError::Aovs { expected: aovs, found });
        }
        let rejected = r.rejected(u64::from(width) * u64::from(height))?;
        let own = rejected.of(|pixel| take.contains(&self.place(pixel).0));
        self.rejected.merge(&own);
        let tiles = width.div_ceil(TILE) as usize * height.div_ceil(TILE) as usize;
        r.tiles(tiles, |r, number| {
            if !take.contains(&number) {
                return r.tile(LIGHT, |_, _| ());
            }
            let tile = self.tiles[number].get_or_insert_with(Tile::new).sums_mut();
            r.tile(LIGHT, |i, sum| add(tile, i, sum))
        })?;
        if !aovs.is_empty() {
            // without sums there is no tile of them
            r.tiles(if stride > 0 { tiles } else { 0 }, |r, number| {
                if !take.contains(&number) {
                    return r.tile(stride, |_, _| ());
                }
                let tile = self.planes.tile(number);
                r.tile(stride, |i, sum| add(tile, i, sum))
            })?;
        }
        if r.at != bytes.len() {
            return Err(FilmError::Corrupt(r.at));
        }
        Ok(())
    }
}

/// Appends how many tiles there are, and each with its number.
fn push_tiles<'a>(out: &mut Vec<u8>, stride: usize, tiles: impl Iterator<Item = (usize, &'a [i128])> + Clone) {
    out.extend((tiles.clone().count() as u32).to_le_bytes());
    for (number, sums) in tiles {
        out.extend((number as u32).to_le_bytes());
        push_tile(out, stride, sums);
    }
}

/// Appends a tile of `stride` sums for each pixel: bitmap, headers, values.
pub(super) fn push_tile(out: &mut Vec<u8>, stride: usize, tile: &[i128]) {
    let bitmap = out.len();
    out.resize(bitmap + (TILE * TILE / 8) as usize, 0);
    let mut body = Vec::new();
    for (i, sums) in tile.chunks_exact(stride).enumerate() {
        if sums.iter().all(|&s| s == 0) {
            continue;
        }
        out[bitmap + i / 8] |= 1 << (i % 8);
        for &sum in sums {
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

    fn aovs(&mut self) -> Result<Aovs, FilmError> {
        let place = self.at;
        let bytes = self.take(2)?;
        let aovs = Aovs::from_bits(u16::from_le_bytes([bytes[0], bytes[1]]));
        aovs.filter(|a| !a.is_empty()).ok_or(FilmError::Corrupt(place))
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

    /// Hands over the number of each tile, of `most`, to read its sums.
    fn tiles(
        &mut self,
        most: usize,
        mut each: impl FnMut(&mut Self, usize) -> Result<(), FilmError>,
    ) -> Result<(), FilmError> {
        let mut next = 0;
        for _ in 0..self.u32()? {
            let place = self.at;
            let number = self.u32()? as usize;
            if number < next || number >= most {
                return Err(FilmError::Corrupt(place));
            }
            next = number + 1;
            each(self, number)?;
        }
        Ok(())
    }

    /// Hands over each of the `stride` sums of a tile's pixels that have any: its place, pixel after pixel, and itself.
    pub fn tile(&mut self, stride: usize, mut each: impl FnMut(usize, i128)) -> Result<(), FilmError> {
        let bitmap = self.take((TILE * TILE / 8) as usize)?;
        let touched: usize = bitmap.iter().map(|b| b.count_ones() as usize).sum();
        let headers_at = self.at;
        let headers = self.take(stride * touched)?;
        let mut next = 0;
        for pixel in (0..(TILE * TILE) as usize).filter(|i| bitmap[i / 8] >> (i % 8) & 1 != 0) {
            for i in 0..stride {
                each(stride * pixel + i, self.value(headers[next], headers_at + next)?);
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
