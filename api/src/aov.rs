//! What a picture's file holds beside its light.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A layer of the EXR beside the picture: of what camera rays come upon first, unless said otherwise, the mean over a pixel's samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase")]
pub enum Aov {
    /// Colour of the surface.
    Albedo,
    /// Shading normal of its front.
    Normal,
    /// Distance along the camera ray.
    Depth,
    /// Place in the scene's coordinates.
    Position,
    /// Texture coordinates.
    Uv,
    /// Number of the shape in source order, from 1, of the first sample.
    ObjectId,
    /// Number of the material, likewise.
    MaterialId,
    /// Estimated variance of the picture.
    Variance,
    /// Vertices of paths and shadow rays.
    Cost,
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

    /// Its name in files and on the command line.
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
}

impl fmt::Display for Aov {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Names between commas, or `all`, or `none`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AovList(pub Vec<Aov>);

/// Why a text is no list of AOVs.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no AOV: give some of {list} between commas, or all, or none", list = Aov::ALL.map(Aov::name).join(", "))]
pub struct AovError(String);

impl FromStr for AovList {
    type Err = AovError;
    fn from_str(text: &str) -> Result<Self, AovError> {
        let one = |name: &str| {
            let found = Aov::ALL.into_iter().find(|a| a.name() == name);
            found.ok_or_else(|| AovError(name.chars().take(60).collect()))
        };
        match text {
            "all" => Ok(AovList(Aov::ALL.to_vec())),
            "none" => Ok(AovList::default()),
            names => names.split(',').map(|n| one(n.trim())).collect::<Result<_, _>>().map(AovList),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_file() {
        for aov in Aov::ALL {
            assert_eq!(aov.name().parse(), Ok(AovList(vec![aov])));
            assert_eq!(serde_json::to_value(aov).unwrap(), aov.name());
        }
        assert_eq!("depth, albedo".parse(), Ok(AovList(vec![Aov::Depth, Aov::Albedo])));
        assert_eq!("all".parse(), Ok(AovList(Aov::ALL.to_vec())));
        assert_eq!("none".parse(), Ok(AovList(vec![])));
        for bad in ["", "depth,", "Depth", "object_id", "all,depth"] {
            let error = bad.parse::<AovList>().unwrap_err().to_string();
            assert!(error.contains("albedo, normal, depth") && error.contains("or all"), "{error}");
        }
    }
}
