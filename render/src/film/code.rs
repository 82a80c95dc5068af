//! A film part as bytes.
//!
//! Little endian: `RHF1`, width u32, height u32, rejected count u64, number of keys u8, keys (pixel u32, sample u32) ascending, number of
//! tiles u32; then the tiles by ascending number: number u32; a bitmap of 128 bytes with a bit for each pixel that has a sum other
//! than 0; six header bytes for each of those (half by half, channel by channel); the values' bytes in the same order. A value is
//! stored without the zero bytes at its low end and without the bytes of mere sign at its high end: the header's low nibble is the
//! number of zero bytes below, its high nibble the number of bytes less 1. 0xff stands for a value of 0.

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
        let mut out = Vec::new();
        out.extend(MAGIC);
        out.extend(self.size[0].to_le_bytes());
        out.extend(self.size[1].to_le_bytes());
        out.extend(self.rejected.count.to_le_bytes());
        out.push(self.rejected.keys.len() as u8);
        for (pixel, sample) in &self.rejected.keys {
            out.extend(pixel.to_le_bytes());
            out.extend(sample.to_le_bytes());
        }
        out.extend((self.touched() as u32).to_le_bytes());
        let mut body = Vec::new();
        for (number, tile) in self.tiles.iter().enumerate() {
            let Some(tile) = tile else { continue };
            out.extend((number as u32).to_le_bytes());
            let bitmap = out.len();
            out.resize(bitmap + (TILE * TILE / 8) as usize, 0);
            body.clear();
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
        out
    }

    /// From bytes of a film of `size` pixels; reads no more memory than the film has tiles.
    pub fn decode(bytes: &[u8], size: [u32; 2]) -> Result<FilmPart, FilmError> {
        let mut r = Reader { bytes, at: 0 };
        if r.take(4)? != MAGIC {
            return Err(FilmError::Magic);
        }
        let found = [r.u32()?, r.u32()?];
        if found != size {
            return Err(FilmError::Size { expected: size, found });
        }
        let mut part = FilmPart::new(size);
        part.rejected = r.rejected(size[0] as u64 * size[1] as u64)?;
        let mut next = 0;
        for _ in 0..r.u32()? {
            let place = r.at;
            let number = r.u32()? as usize;
            if number < next || number >= part.tiles.len() {
                return Err(FilmError::Corrupt(place));
            }
            next = number + 1;
            let tile = r.tile()?;
            part.tiles[number] = Some(tile);
        }
        if r.at != bytes.len() {
            return Err(FilmError::Corrupt(r.at));
        }
        Ok(part)
    }
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

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
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

    fn tile(&mut self) -> Result<Tile, FilmError> {
        let bitmap = self.take((TILE * TILE / 8) as usize)?;
        let touched: usize = bitmap.iter().map(|b| b.count_ones() as usize).sum();
        let headers_at = self.at;
        let headers = self.take(6 * touched)?;
        let mut tile = Tile::new();
        let mut next = 0;
        for (i, sums) in tile.0.iter_mut().enumerate() {
            if bitmap[i / 8] >> (i % 8) & 1 == 0 {
                continue;
            }
            for sum in sums.as_flattened_mut() {
                *sum = self.value(headers[next], headers_at + next)?;
                next += 1;
            }
        }
        Ok(tile)
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
