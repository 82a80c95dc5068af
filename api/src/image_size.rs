//! The size of a picture, written `WIDTHxHEIGHT`.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// Width and height in pixels, each 1 to 65535: then a pixel's number fits a u32.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ImageSize {
    width: i32,
    height: i32,
}

/// Why a text is no picture size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no picture size: write WIDTHxHEIGHT such as 1280x720, each 1 to 65535")]
pub struct ImageSizeError(String);

impl ImageSize {
    /// Longest side, in pixels.
    pub const MAX_SIDE: u32 = 65535;

    /// A size, if it is in range.
    pub fn new(width: u32, height: u32) -> Result<Self, ImageSizeError> {
        let side = 1..=Self::MAX_SIDE;
        if !side.contains(&width) || !side.contains(&height) {
            return Err(ImageSizeError(format!("{width}x{height}")));
        }
        Ok(ImageSize { width: width as i32, height: height as i32 })
    }
    /// Pixels in a row.
    pub const fn width(self) -> u32 {
        self.width as u32
    }
    /// Rows.
    pub const fn height(self) -> u32 {
        self.height as u32
    }
}

impl FromStr for ImageSize {
    type Err = ImageSizeError;
    fn from_str(text: &str) -> Result<Self, ImageSizeError> {
        let error = || ImageSizeError(text.chars().take(40).collect());
        let side = |s: &str| {
            if s.bytes().all(|b| b.is_ascii_digit()) { s.parse::<u32>().map_err(|_| error()) } else { Err(error()) }
        };
        let (width, height) = text.split_once('x').ok_or_else(error)?;
        ImageSize::new(side(width)?, side(height)?).map_err(|_| error())
    }
}

impl fmt::Display for ImageSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

impl Serialize for ImageSize {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ImageSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(de::Error::custom)
    }
}

impl schemars::JsonSchema for ImageSize {
    fn schema_name() -> Cow<'static, str> {
        "ImageSize".into()
    }
    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        // 1 to 65535, twice
        let side = "([1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])";
        schemars::json_schema!({"type": "string", "pattern": format!("^{side}x{side}$")})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_parse_and_print() {
        let size: ImageSize = "1280x720".parse().unwrap();
        assert_eq!((size.width(), size.height()), (1280, 720));
        assert_eq!(size.to_string(), "1280x720");
        assert!("65535x65535".parse::<ImageSize>().is_ok());
        for bad in
            ["", "x", "1280", "1280x", "x720", "0x1", "1x0", "-1x4", "+1x4", "4X4", "65536x1", "1x65536", "1x2x3"]
        {
            let error = bad.parse::<ImageSize>().unwrap_err().to_string();
            assert!(error.contains("WIDTHxHEIGHT"), "{error}");
        }
    }
}
