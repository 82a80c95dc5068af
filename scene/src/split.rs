//! Cutting the source into splits, in its own order; a record is never cut.

use std::ops::Range;

use crate::prepare::Cut;

/// Geometry bytes per primitive in a block: 40 in a leaf, a 224-byte node for every 18 or so, rounding (measured by the
/// kernel's prototype: 52.0 to 52.3 at 1 M and 8 M triangles), and a run of ids now and then. Spheres lie in the same leaves.
const SOURCE_BYTES: u64 = 53;
/// The same in a copied split, whose ids have gaps and take 8 bytes each.
const COPIED_BYTES: u64 = SOURCE_BYTES + 8;
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
    /// For a scene of `primitives` usable primitives.
    pub fn new(cut: Cut, primitives: u64) -> Capacity {
        match cut {
            Cut::BlockSize(bytes) => {
                let hold = |each: u64| (bytes.saturating_sub(FIXED_BYTES) / each).clamp(1, MOST);
                Capacity { source: hold(SOURCE_BYTES), copied: hold(COPIED_BYTES) }
            }
            Cut::Splits(n) => {
                let each = primitives.div_ceil(u64::from(n.max(1))).clamp(1, MOST);
                Capacity { source: each, copied: each }
            }
        }
    }
}

/// The splits as ranges over the usable primitives, numbered in source order. None is empty.
///
/// By block size: each but the last is full. By number: as even as can be, `min(n, primitives)` of them (more when one
/// would not fit a block).
pub fn cut(cut: Cut, primitives: u64) -> Vec<Range<u64>> {
    let n = match cut {
        Cut::BlockSize(_) => {
            let each = Capacity::new(cut, primitives).source;
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
        fn splits_partition_the_source_in_order(primitives in 0u64..5000, n in 1u32..200, bytes in 1u64..100_000) {
            for how in [Cut::Splits(n), Cut::BlockSize(bytes)] {
                let splits = cut(how, primitives);
                let mut next = 0;
                for s in &splits {
                    prop_assert!(s.start == next && s.end > s.start);
                    next = s.end;
                }
                prop_assert_eq!(next, primitives);
                let most = splits.iter().map(|s| s.end - s.start).max().unwrap_or(0);
                prop_assert!(most <= Capacity::new(how, primitives).source);
                if let Cut::Splits(n) = how {
                    prop_assert_eq!(splits.len() as u64, u64::from(n).min(primitives));
                }
            }
        }
    }

    #[test]
    fn a_huge_request_is_cut_to_what_a_block_holds() {
        assert_eq!(cut(Cut::Splits(1), 3 * MOST).len(), 3);
        assert_eq!(cut(Cut::BlockSize(u64::MAX), 3 * MOST).len(), 3);
        assert_eq!(cut(Cut::BlockSize(1), 3).len(), 3);
    }
}
