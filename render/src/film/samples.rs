//! How many samples the pixels of a film have: one number for each tile.

use serde::{Deserialize, Serialize};

/// Samples per pixel, by tile.
pub trait PerTile {
    /// Those of each pixel of a tile.
    fn of_tile(&self, tile: usize) -> u32;
}

/// The same everywhere.
impl PerTile for u32 {
    #[inline]
    fn of_tile(&self, _: usize) -> u32 {
        *self
    }
}

impl<P: PerTile> PerTile for &P {
    #[inline]
    fn of_tile(&self, tile: usize) -> u32 {
        (*self).of_tile(tile)
    }
}

/// Samples per pixel of all tiles. Written as a number where all have the same, and else as one for each tile.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Samples {
    /// The same everywhere.
    Even(u32),
    /// By tile, row by row.
    Each(Vec<u32>),
}

impl Samples {
    /// Of each tile; there is at least one.
    pub fn of(tiles: Vec<u32>) -> Samples {
        match tiles.first() {
            Some(&first) if tiles.iter().all(|&n| n == first) => Samples::Even(first),
            _ => Samples::Each(tiles),
        }
    }

    /// Fewest that a tile has.
    pub fn least(&self) -> u32 {
        match self {
            Samples::Even(n) => *n,
            Samples::Each(tiles) => tiles.iter().copied().min().unwrap_or(0),
        }
    }

    /// Most that a tile has.
    pub fn most(&self) -> u32 {
        match self {
            Samples::Even(n) => *n,
            Samples::Each(tiles) => tiles.iter().copied().max().unwrap_or(0),
        }
    }

    /// Whether it fits a film of so many tiles.
    pub fn is_of(&self, count: usize) -> bool {
        match self {
            Samples::Even(_) => true,
            Samples::Each(tiles) => tiles.len() == count,
        }
    }
}

impl PerTile for Samples {
    /// # Panics
    /// When there is no such tile.
    #[inline]
    fn of_tile(&self, tile: usize) -> u32 {
        match self {
            Samples::Even(n) => *n,
            Samples::Each(tiles) => tiles[tile],
        }
    }
}

impl From<u32> for Samples {
    fn from(samples: u32) -> Self {
        Samples::Even(samples)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_number_stands_for_all_tiles() {
        let even = Samples::of(vec![4; 3]);
        assert_eq!((&even, even.least(), even.most(), even.of_tile(2)), (&Samples::Even(4), 4, 4, 4));
        assert!(even.is_of(3) && even.is_of(7));
        let each = Samples::of(vec![4, 16, 8]);
        assert_eq!((each.least(), each.most(), each.of_tile(1)), (4, 16, 16));
        assert!(each.is_of(3) && !each.is_of(4));
        for (samples, text) in [(even, "4"), (each, "[4,16,8]")] {
            assert_eq!(serde_json::to_string(&samples).unwrap(), text);
            assert_eq!(serde_json::from_str::<Samples>(text).unwrap(), samples);
        }
    }
}
