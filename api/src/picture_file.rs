//! Which files a picture is written to.

use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A file of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
pub enum PictureFile {
    /// OpenEXR: linear floats, and the layers.
    Exr,
    /// PNG: 8-bit sRGB, with the exposure.
    Png,
}

impl PictureFile {
    /// All of them.
    pub const ALL: [PictureFile; 2] = [PictureFile::Exr, PictureFile::Png];

    /// The extension of its files' names.
    pub const fn extension(self) -> &'static str {
        match self {
            PictureFile::Exr => "exr",
            PictureFile::Png => "png",
        }
    }
}

/// Why a text names no such file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no file of a picture: give exr, png, or both between a comma")]
pub struct PictureFileError(String);

impl FromStr for PictureFile {
    type Err = PictureFileError;
    fn from_str(text: &str) -> Result<Self, PictureFileError> {
        let found = PictureFile::ALL.into_iter().find(|f| f.extension() == text);
        found.ok_or_else(|| PictureFileError(text.chars().take(60).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_by_their_extension() {
        assert_eq!("exr".parse(), Ok(PictureFile::Exr));
        assert_eq!("png".parse(), Ok(PictureFile::Png));
        let error = "jpg".parse::<PictureFile>().unwrap_err().to_string();
        assert!(error.contains("jpg") && error.contains("exr, png"), "{error}");
    }
}
