//! What a picture may hold beside its light: AOVs (arbitrary output variables), by name.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// One of them. Unless said otherwise a pixel's value is the mean over all of its samples of what the camera ray comes upon first, as of
/// Mitsuba's `aov` integrator, and a sample that comes upon nothing counts as 0. A surface with holes (`mask`) is come upon there too; what
/// `hide_emitters` hides is not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Aov {
    /// Linear RGB: of the diffuse part (of the base, where there is a coat); of metal what it reflects head-on; of glass the factor on what
    /// passes. Times the opacity; of what is blended that of the part that the path meets.
    Albedo,
    /// Unit shading normal of the surface's front, in the world, with its relief; the geometric one where the ray would see the back of the
    /// shading normal.
    Normal,
    /// Distance along the camera ray from where it starts.
    Depth,
    /// Place in the scene's coordinates.
    Position,
    /// Texture coordinates; a triangle's own where it has none.
    Uv,
    /// Number of the shape in source order, from 1, that the pixel's first sample comes upon; 0 for none. Of one sample, as numbers have no mean.
    ObjectId,
    /// Likewise of the material.
    MaterialId,
    /// Estimated variance of the picture's red, green and blue, from its even and odd samples; infinite for a single one, which tells nothing.
    Variance,
    /// Work: vertices of paths and shadow rays that could bring light.
    Cost,
}

/// A name that is no AOV's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no AOV: give {list}", list = names())]
pub struct UnknownAov(String);

fn names() -> String {
    Aov::ALL.map(Aov::name).join(", ")
}

impl Aov {
    /// All of them.
    pub const ALL: [Aov; 9] = [
        Aov::Albedo,
        Aov::Normal,
        Aov::Depth,
        Aov::Position,
        Aov::Uv,
        Aov::ObjectId,
        Aov::MaterialId,
        Aov::Variance,
        Aov::Cost,
    ];

    /// Its name, which is its layer's in a file too.
    pub const fn name(self) -> &'static str {
        match self {
            Aov::Albedo => "albedo",
            Aov::Normal => "normal",
            Aov::Depth => "depth",
            Aov::Position => "position",
            Aov::Uv => "uv",
            Aov::ObjectId => "objectId",
            Aov::MaterialId => "materialId",
            Aov::Variance => "variance",
            Aov::Cost => "cost",
        }
    }

    /// Names of its channels in a file.
    pub const fn channels(self) -> &'static [&'static str] {
        match self {
            Aov::Albedo => &["albedo.R", "albedo.G", "albedo.B"],
            Aov::Normal => &["normal.X", "normal.Y", "normal.Z"],
            Aov::Depth => &["depth.Z"],
            Aov::Position => &["position.X", "position.Y", "position.Z"],
            Aov::Uv => &["uv.U", "uv.V"],
            Aov::ObjectId => &["objectId.Y"],
            Aov::MaterialId => &["materialId.Y"],
            Aov::Variance => &["variance.R", "variance.G", "variance.B"],
            Aov::Cost => &["cost.Y"],
        }
    }

    /// Sums of a pixel that it takes: of a position also in how many samples there is one, since the sums are of recentred coordinates; none
    /// of the variance, which the picture itself tells.
    pub const fn sums(self) -> usize {
        match self {
            Aov::Variance => 0,
            Aov::Position => 4,
            _ => self.channels().len(),
        }
    }
}

impl fmt::Display for Aov {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Aov {
    type Err = UnknownAov;
    fn from_str(text: &str) -> Result<Aov, UnknownAov> {
        let found = Aov::ALL.into_iter().find(|a| a.name() == text);
        found.ok_or_else(|| UnknownAov(text.chars().take(60).collect()))
    }
}

/// Any of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<String>", into = "Vec<String>")]
pub struct Aovs {
    /// A bit for each.
    bits: u16,
}

impl Aovs {
    /// None of them.
    pub const NONE: Aovs = Aovs { bits: 0 };
    /// All of them.
    pub const ALL: Aovs = Aovs { bits: (1 << Aov::ALL.len()) - 1 };

    /// Whether there is none.
    #[inline(always)]
    pub const fn is_empty(self) -> bool {
        self.bits == 0
    }
    /// Whether this is one of them.
    #[inline(always)]
    pub const fn contains(self, aov: Aov) -> bool {
        self.bits >> aov as u32 & 1 == 1
    }
    /// They, in the order of [`Aov::ALL`].
    pub fn iter(self) -> impl Iterator<Item = Aov> {
        Aov::ALL.into_iter().filter(move |&a| self.contains(a))
    }
    /// Names of all their channels, in this order.
    pub fn channels(self) -> impl Iterator<Item = &'static str> {
        self.iter().flat_map(|aov| aov.channels().iter().copied())
    }
    /// Sums of a pixel that all of them take.
    pub fn sums(self) -> usize {
        self.iter().map(Aov::sums).sum()
    }
    /// From bits, of which each must be one's.
    pub(crate) fn from_bits(bits: u16) -> Option<Aovs> {
        (bits & !Aovs::ALL.bits == 0).then_some(Aovs { bits })
    }
    /// A bit for each.
    pub(crate) const fn bits(self) -> u16 {
        self.bits
    }
}

impl FromIterator<Aov> for Aovs {
    fn from_iter<I: IntoIterator<Item = Aov>>(aovs: I) -> Aovs {
        Aovs { bits: aovs.into_iter().fold(0, |bits, a| bits | 1 << a as u32) }
    }
}

impl fmt::Display for Aovs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_empty() {
            return f.write_str("none");
        }
        let names: Vec<&str> = self.iter().map(Aov::name).collect();
        f.write_str(&names.join(", "))
    }
}

impl From<Aovs> for Vec<String> {
    fn from(aovs: Aovs) -> Self {
        aovs.iter().map(|a| a.name().to_owned()).collect()
    }
}

impl TryFrom<Vec<String>> for Aovs {
    type Error = UnknownAov;
    fn try_from(names: Vec<String>) -> Result<Aovs, UnknownAov> {
        names.iter().map(|n| n.parse()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_sets_are_one_to_one() {
        for (i, aov) in Aov::ALL.into_iter().enumerate() {
            assert_eq!((aov as usize, aov.name().parse()), (i, Ok(aov)));
            assert!(aov.channels().iter().all(|c| c.starts_with(&format!("{aov}."))));
            let one = Aovs::from_iter([aov]);
            assert!(Aov::ALL.into_iter().all(|a| one.contains(a) == (a == aov) && Aovs::ALL.contains(a)));
            assert!(!one.is_empty() && Aovs::from_bits(one.bits()) == Some(one));
        }
        assert_eq!(Aovs::from_bits(Aovs::ALL.bits() + 1), None);
        let message = "albedos".parse::<Aov>().unwrap_err().to_string();
        assert!(Aov::ALL.into_iter().all(|a| message.contains(a.name())), "{message}");
        // whatever the order in which they were asked for, they are written in one
        let two: Aovs = serde_json::from_str(r#"["depth", "albedo", "depth"]"#).unwrap();
        assert_eq!(serde_json::to_string(&two).unwrap(), r#"["albedo","depth"]"#);
        assert_eq!((two.to_string(), Aovs::NONE.to_string()), ("albedo, depth".into(), "none".into()));
        assert!(serde_json::from_str::<Aovs>(r#"["wurst"]"#).is_err());
    }
}
