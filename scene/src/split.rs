//! Cutting the source into splits, in its own order; a record is never cut.

use std::ops::Range;

use crate::prepare::Cut;

/// Geometry bytes per primitive of a good mesh: 40 in a leaf, a 224-byte node for every 18 or so (measured by the kernel's
/// prototype: 52.0 to 52.3 at 1 M and 8 M triangles). Where primitives of all sizes cross each other, leaves hold fewer and it is up
/// to 90: see [`windows`].
pub(crate) const MESH_BYTES: u64 = 53;
/// Ids of a copied split have gaps and take 8 bytes each; those of a split in source order are a few runs.
const COPIED_ID_BYTES: u64 = 8;
/// Header and root node of a block.
const FIXED_BYTES: u64 = 128 + 256;
/// No split holds more, whatever was asked for: a block's arena ends at 4 GiB.
const MOST: u64 = 1 << 26;

/// How much a split holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacity {
    /// Primitives in a split cut from the source: what condition 1 compares with.
    pub source: u64,
    /// Primitives in a copied split.
    pub copied: u64,
}

impl Capacity {
    /// For a scene of `primitives` usable primitives that take `each` bytes in a block (see [`windows`]).
    pub fn new(cut: Cut, primitives: u64, each: u64) -> Capacity {
        match cut {
            Cut::BlockSize(bytes) => {
                let hold = |each: u64| (bytes.saturating_sub(FIXED_BYTES) / each.max(1)).clamp(1, MOST);
                Capacity { source: hold(each), copied: hold(each + COPIED_ID_BYTES) }
            }
            Cut::Splits(n) => {
                let each = primitives.div_ceil(u64::from(n.max(1))).clamp(1, MOST);
                Capacity { source: each, copied: each }
            }
        }
    }
}

/// Parts of the source to build blocks of, to see how many bytes a primitive takes; none when the cut does not ask.
///
/// Eight at most, spread evenly, each of a split's size or 4096 primitives.
pub fn windows(cut: Cut, primitives: u64) -> Vec<Range<u64>> {
    let Cut::BlockSize(bytes) = cut else { return Vec::new() };
    let len = (bytes.saturating_sub(FIXED_BYTES) / MESH_BYTES).clamp(1, 4096).min(primitives);
    let count = primitives.checked_div(len).unwrap_or(0).min(8);
    let begin = |i: u64| ((primitives - len) as u128 * u128::from(i) / u128::from((count - 1).max(1))) as u64;
    (0..count).map(|i| begin(i)..begin(i) + len).collect()
}

/// Bytes per primitive, rounded up, of blocks of the [`windows`]: (bytes, primitives) of each.
pub fn bytes_each(blocks: &[(u64, u64)]) -> u64 {
    let bytes: u64 = blocks.iter().map(|b| b.0.saturating_sub(FIXED_BYTES)).sum();
    let primitives: u64 = blocks.iter().map(|b| b.1).sum();
    if primitives == 0 { MESH_BYTES } else { bytes.div_ceil(primitives).max(1) }
}

/// The splits as ranges over the usable primitives, numbered in source order. None is empty.
///
/// By block size: each but the last is full. By number: as even as can be, `min(n, primitives)` of them (more when one
/// would not fit a block).
pub fn cut(cut: Cut, primitives: u64, capacity: Capacity) -> Vec<Range<u64>> {
    let n = match cut {
        Cut::BlockSize(_) => {
            let each = capacity.source;
            let ends = (1..=primitives.div_ceil(each)).map(|i| (i * each).min(primitives));
            return ranges(ends);
        }
        Cut::Splits(n) => u64::from(n).max(primitives.div_ceil(MOST)).min(primitives),
    };
    // u128: a product of two u64
    let end = |i: u64| (u128::from(i) * u128::from(primitives) / u128::from(n)) as u64;
    ranges((1..=n).map(end))
}

fn ranges(ends: impl Iterator<Item = u64>) -> Vec<Range<u64>> {
    let mut begin = 0;
    ends.map(|end| std::mem::replace(&mut begin, end)..end).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn splits_partition_the_source_in_order(
            primitives in 0u64..5000, n in 1u32..200, bytes in 1u64..100_000, each in 0u64..100,
        ) {
            for how in [Cut::Splits(n), Cut::BlockSize(bytes)] {
                let capacity = Capacity::new(how, primitives, each);
                let splits = cut(how, primitives, capacity);
                let mut next = 0;
                for s in &splits {
                    prop_assert!(s.start == next && s.end > s.start);
                    next = s.end;
                }
                prop_assert_eq!(next, primitives);
                let most = splits.iter().map(|s| s.end - s.start).max().unwrap_or(0);
                prop_assert!(most <= capacity.source);
                if let Cut::Splits(n) = how {
                    prop_assert_eq!(splits.len() as u64, u64::from(n).min(primitives));
                }
                let windows = windows(how, primitives);
                prop_assert!(windows.len() <= 8 && windows.iter().all(|w| w.start < w.end && w.end <= primitives));
                prop_assert!(windows.windows(2).all(|w| w[0].end <= w[1].start));
            }
        }
    }

    #[test]
    fn a_huge_request_is_cut_to_what_a_block_holds() {
        let splits = |how, primitives| cut(how, primitives, Capacity::new(how, primitives, MESH_BYTES)).len();
        assert_eq!(splits(Cut::Splits(1), 3 * MOST), 3);
        assert_eq!(splits(Cut::BlockSize(u64::MAX), 3 * MOST), 3);
        assert_eq!(splits(Cut::BlockSize(1), 3), 3);
        assert_eq!(bytes_each(&[]), MESH_BYTES);
        assert_eq!(bytes_each(&[(FIXED_BYTES + 100, 2), (FIXED_BYTES + 101, 2)]), 51);
    }
}
