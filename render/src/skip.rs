//! What is not done because a scene does not need it: named switches, and how often each was made.
//!
//! A skip is made unless it is switched off, which is for whoever wants to see what it saves, or doubts it. All but [`Skip::Roulette`],
//! [`Skip::Lights`] and [`Skip::Tiles`] leave every byte of the image as it is; the first two choose by probability and leave its mean, the third
//! chooses where a picture with a target error gets its samples. `docs/skips.md` says what each saves.

use std::collections::BTreeMap;
use std::ops::AddAssign;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// One thing that is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Skip {
    /// Cells of the grid, and with them splits, whose tight boxes a ray misses are not visited. Counted: cells on rays' ways.
    Cells,
    /// Cells beyond a hit that another split has found are not visited, and nothing beyond it is looked for. Counted: rays that arrived
    /// with such a hit and met nothing nearer.
    Beaten,
    /// Rays of a task that holds all that they can meet do not ask the grid. Counted: rays.
    Walk,
    /// Splits that no ray asks for are not read. Counted: splits.
    Splits,
    /// A task that shades nothing in its splits does not read their attributes. Counted: splits, once for each task.
    Attributes,
    /// Texture tiles that no look-up asks for are not read. Counted: tiles.
    Textures,
    /// Rays towards light that would bring nothing are not cast: the light's back, below the horizon, black. Counted: vertices without
    /// a shadow ray.
    Shadows,
    /// The light tree leaves out lights that cannot shine at a point. Counted: choices with some of them left out.
    Lights,
    /// Where only single directions are scattered (mirrors, smooth glass) no light is chosen. Counted: vertices.
    Lobes,
    /// Materials without opacity, textures, relief, other back or blend are not asked for these. Counted: hits.
    Details,
    /// Without a sky none is looked up where nothing is met. Counted: rays.
    Sky,
    /// Siblings share the camera ray that each would have traced. Counted: rays not traced.
    Merged,
    /// Paths are ended by Russian roulette. Counted: paths.
    Roulette,
    /// AOVs that nobody asked for are not found. Counted: rays of batches that met something.
    Aovs,
    /// Film tiles that no light reached are neither held nor stored. Counted: tiles, once for each task.
    Film,
    /// A picture with a target error gets fewer samples in film tiles that need them less. Counted: camera samples that all tiles would have had
    /// more, if each had as many as the one with most.
    Tiles,
    /// What is prepared is not prepared again. Counted: objects.
    Prepared,
    /// Cells of a volume that its surface does not cross are not looked into. Counted: cells, once for each pass.
    Volume,
}

/// A name that is no skip's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is nothing that is skipped: give {list}", list = names())]
pub struct UnknownSkip(String);

fn names() -> String {
    let names = Skip::ALL.map(Skip::name);
    format!("{} or all", names.join(", "))
}

impl Skip {
    /// All of them.
    pub const ALL: [Skip; 18] = [
        Skip::Cells,
        Skip::Beaten,
        Skip::Walk,
        Skip::Splits,
        Skip::Attributes,
        Skip::Textures,
        Skip::Shadows,
        Skip::Lights,
        Skip::Lobes,
        Skip::Details,
        Skip::Sky,
        Skip::Merged,
        Skip::Roulette,
        Skip::Aovs,
        Skip::Film,
        Skip::Tiles,
        Skip::Prepared,
        Skip::Volume,
    ];

    /// Its name on the command line and in the report.
    pub const fn name(self) -> &'static str {
        match self {
            Skip::Cells => "cells",
            Skip::Beaten => "beaten",
            Skip::Walk => "walk",
            Skip::Splits => "splits",
            Skip::Attributes => "attributes",
            Skip::Textures => "textures",
            Skip::Shadows => "shadows",
            Skip::Lights => "lights",
            Skip::Lobes => "lobes",
            Skip::Details => "details",
            Skip::Sky => "sky",
            Skip::Merged => "merged",
            Skip::Roulette => "roulette",
            Skip::Aovs => "aovs",
            Skip::Film => "film",
            Skip::Tiles => "tiles",
            Skip::Prepared => "prepared",
            Skip::Volume => "volume",
        }
    }

    /// Whether the image is the same bytes with and without it; else it is the same in the mean, or has as little error.
    pub const fn keeps_bytes(self) -> bool {
        !matches!(self, Skip::Lights | Skip::Roulette | Skip::Tiles)
    }
}

impl FromStr for Skip {
    type Err = UnknownSkip;
    fn from_str(text: &str) -> Result<Skip, UnknownSkip> {
        Skip::ALL.into_iter().find(|s| s.name() == text).ok_or_else(|| UnknownSkip(text.to_owned()))
    }
}

/// Which skips are made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Skips {
    /// A bit for each that is switched off.
    off: u32,
}

impl Default for Skips {
    fn default() -> Self {
        Skips::ALL
    }
}

impl Skips {
    /// Every skip is made.
    pub const ALL: Skips = Skips { off: 0 };
    /// None is.
    pub const NONE: Skips = Skips { off: u32::MAX };

    /// The same, but for this one.
    #[must_use]
    pub const fn without(self, skip: Skip) -> Skips {
        Skips { off: self.off | 1 << skip as u32 }
    }

    /// Whether it is made.
    #[inline(always)]
    pub const fn makes(self, skip: Skip) -> bool {
        self.off >> skip as u32 & 1 == 0
    }
}

/// How often each skip was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "BTreeMap<String, u64>", into = "BTreeMap<String, u64>")]
pub struct SkipCounts([u64; Skip::ALL.len()]);

impl SkipCounts {
    /// Of one.
    pub fn of(&self, skip: Skip) -> u64 {
        self.0[skip as usize]
    }
    /// Counts one more often.
    #[inline]
    pub fn add(&mut self, skip: Skip, times: u64) {
        self.0[skip as usize] += times;
    }
}

impl AddAssign<&SkipCounts> for SkipCounts {
    fn add_assign(&mut self, other: &SkipCounts) {
        self.0.iter_mut().zip(other.0).for_each(|(a, b)| *a += b);
    }
}

impl From<SkipCounts> for BTreeMap<String, u64> {
    fn from(counts: SkipCounts) -> Self {
        Skip::ALL.into_iter().map(|s| (s.name().to_owned(), counts.of(s))).collect()
    }
}

impl From<BTreeMap<String, u64>> for SkipCounts {
    /// Names that this version does not know are left out.
    fn from(map: BTreeMap<String, u64>) -> Self {
        let mut out = SkipCounts::default();
        map.into_iter().filter_map(|(name, n)| Some((name.parse().ok()?, n))).for_each(|(skip, n)| out.add(skip, n));
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_switches_are_one_to_one() {
        for (i, skip) in Skip::ALL.into_iter().enumerate() {
            assert_eq!((skip as usize, skip.name().parse()), (i, Ok(skip)));
            let without = Skips::ALL.without(skip);
            assert!(Skip::ALL.into_iter().all(|s| Skips::ALL.makes(s) && !Skips::NONE.makes(s)));
            assert!(Skip::ALL.into_iter().all(|s| without.makes(s) == (s != skip)));
        }
        let message = "shadow".parse::<Skip>().unwrap_err().to_string();
        assert!(Skip::ALL.into_iter().all(|s| message.contains(s.name())) && message.ends_with("or all"), "{message}");
    }

    #[test]
    fn counts_are_added_and_come_back_from_the_wire() {
        let mut a = SkipCounts::default();
        Skip::ALL.into_iter().zip(1..).for_each(|(skip, n)| a.add(skip, n));
        let mut b = a;
        b += &a;
        assert!(Skip::ALL.into_iter().all(|s| b.of(s) == 2 * a.of(s) && a.of(s) > 0));
        let text = serde_json::to_string(&b).unwrap();
        assert_eq!(serde_json::from_str::<SkipCounts>(&text).unwrap(), b);
        assert_eq!(serde_json::from_str::<SkipCounts>(r#"{"of a later version": 3}"#).unwrap(), SkipCounts::default());
    }
}
