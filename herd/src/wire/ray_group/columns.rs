//! Columns of integers as planes of bytes, and the differences that make them small.

use crate::wire::envelope::WireError;

/// An unsigned integer of a column.
pub(super) trait Word: Copy + Eq + Default {
    fn wide(self) -> u64;
    /// `None` when it does not fit.
    fn narrow(wide: u64) -> Option<Self>;
    fn xor(self, other: Self) -> Self;
}

macro_rules! word {
    ($type:ty) => {
        impl Word for $type {
            fn wide(self) -> u64 {
                u64::from(self)
            }
            fn narrow(wide: u64) -> Option<Self> {
                wide.try_into().ok()
            }
            fn xor(self, other: Self) -> Self {
                self ^ other
            }
        }
    };
}
word!(u32);
word!(u64);

/// Appends columns.
#[derive(Default)]
pub(super) struct Writer {
    pub bytes: Vec<u8>,
}

impl Writer {
    pub fn word(&mut self, word: u32) {
        self.bytes.extend_from_slice(&word.to_le_bytes());
    }

    /// A column with its number of planes, the fewest that hold its largest value.
    pub fn narrow<W: Word>(&mut self, column: impl Iterator<Item = W> + Clone) {
        let used = column.clone().fold(0, |used, word| used | word.wide());
        let planes = used.checked_ilog2().map_or(0, |bit| bit / 8 + 1);
        self.bytes.push(planes as u8);
        self.full(planes, column);
    }

    /// A column of so many planes.
    pub fn full<W: Word>(&mut self, planes: u32, column: impl Iterator<Item = W> + Clone) {
        for plane in 0..planes {
            self.bytes.extend(column.clone().map(|word| (word.wide() >> (8 * plane)) as u8));
        }
    }

    /// A column of bits, the lowest of a byte first.
    pub fn bits(&mut self, mut column: impl Iterator<Item = bool>) {
        while let Some(first) = column.next() {
            let rest = column.by_ref().take(7).zip(1..);
            self.bytes.push(rest.fold(u8::from(first), |byte, (bit, place)| byte | u8::from(bit) << place));
        }
    }
}

/// Takes columns off, never past the end.
pub(super) struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    fn take(&mut self, n: usize) -> Result<&'a [u8], WireError> {
        let (taken, rest) = self.rest.split_at_checked(n).ok_or_else(|| WireError::corrupt("ray group is cut off"))?;
        self.rest = rest;
        Ok(taken)
    }

    pub fn word(&mut self) -> Result<u32, WireError> {
        let bytes = self.take(4)?;
        Ok(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
    }

    /// What [`Writer::narrow`] wrote: `n` values.
    pub fn narrow<W: Word>(&mut self, n: usize) -> Result<Vec<W>, WireError> {
        let planes = u32::from(self.take(1)?[0]);
        if planes > 8 {
            return Err(WireError::corrupt(format!("a column of {planes} planes")));
        }
        let top = (planes as usize * n).checked_sub(n).and_then(|at| self.rest.get(at..)?.get(..n));
        // also when a column of no values has planes
        if planes > 0 && top.is_some_and(|top| top.iter().all(|&byte| byte == 0)) {
            return Err(WireError::corrupt("a column of more planes than it needs"));
        }
        self.full(planes, n)
    }

    /// What [`Writer::full`] wrote: `n` values.
    pub fn full<W: Word>(&mut self, planes: u32, n: usize) -> Result<Vec<W>, WireError> {
        let bytes = self.take(planes as usize * n)?;
        let mut wide = vec![0u64; n];
        for (plane, bytes) in bytes.chunks_exact(n.max(1)).enumerate() {
            for (word, &byte) in wide.iter_mut().zip(bytes) {
                *word |= u64::from(byte) << (8 * plane);
            }
        }
        let fits = |word| W::narrow(word).ok_or_else(|| WireError::corrupt("a value larger than its column"));
        wide.into_iter().map(fits).collect()
    }

    /// What [`Writer::bits`] wrote: `n` bits.
    pub fn bits(&mut self, n: usize) -> Result<Vec<bool>, WireError> {
        let bytes = self.take(n.div_ceil(8))?;
        if let Some(&last) = bytes.last()
            && !n.is_multiple_of(8)
            && last >> (n % 8) != 0
        {
            return Err(WireError::corrupt("bits beyond the last ray"));
        }
        Ok((0..n).map(|i| bytes[i / 8] >> (i % 8) & 1 == 1).collect())
    }

    /// Nothing is left.
    pub fn end(&self) -> Result<(), WireError> {
        if self.rest.is_empty() { Ok(()) } else { Err(WireError::corrupt("bytes after the last ray")) }
    }
}

/// Each value's distance from the one before, for ascending values.
pub(super) fn steps(values: impl Iterator<Item = u32> + Clone) -> impl Iterator<Item = u32> + Clone {
    values.scan(0u32, |before, value| {
        let step = value.wrapping_sub(*before);
        *before = value;
        Some(step)
    })
}

/// Back from [`steps`].
pub(super) fn undo_steps(mut steps: Vec<u32>) -> Vec<u32> {
    let mut value = 0u32;
    for step in &mut steps {
        value = value.wrapping_add(*step);
        *step = value;
    }
    steps
}

/// Each value's distance from the one before, small in either direction: 0, -1, 1, -2, .. become 0, 1, 2, 3, ..
pub(super) fn zigzag_steps(values: impl Iterator<Item = u32> + Clone) -> impl Iterator<Item = u32> + Clone {
    steps(values).map(|step| (step << 1) ^ ((step as i32 >> 31) as u32))
}

/// Back from [`zigzag_steps`].
pub(super) fn undo_zigzag_steps(steps: Vec<u32>) -> Vec<u32> {
    undo_steps(steps.into_iter().map(|step| (step >> 1) ^ (step & 1).wrapping_neg()).collect())
}

/// The bits in which each value differs from the one before.
pub(super) fn changes<W: Word>(values: impl Iterator<Item = W> + Clone) -> impl Iterator<Item = W> + Clone {
    values.scan(W::default(), |before, value| {
        let change = value.xor(*before);
        *before = value;
        Some(change)
    })
}

/// Back from [`changes`].
pub(super) fn undo_changes<W: Word>(mut changes: Vec<W>) -> Vec<W> {
    let mut value = W::default();
    for change in &mut changes {
        value = value.xor(*change);
        *change = value;
    }
    changes
}
