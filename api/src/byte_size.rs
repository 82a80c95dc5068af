//! Sizes in bytes as people write them: `1073741824`, `1Gi`, `1GiB`, `1G`, `1.5 GB`.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A number of bytes, 0 to 2^63 - 1.
///
/// Read from an integer or from a decimal number with a unit: `Ki Mi Gi Ti Pi Ei` (powers of 1024), `k M G T P E`
/// (powers of 1000), each with or without `B`. A fraction of a byte is rounded up, as Kubernetes does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ByteSize(i64);

/// Why a text is no size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no size: {why}")]
pub struct SizeError {
    text: String,
    why: &'static str,
}

const SYNTAX: &str = "write bytes, or a number with Ki, Mi, Gi, Ti (1024) or k, M, G, T (1000), such as 64Mi";
/// More digits than any size below 2^63 needs; bounds the arithmetic below to u128.
const MAX_DIGITS: usize = 19;

impl ByteSize {
    /// A size of so many bytes.
    ///
    /// # Panics
    /// When `bytes` is 2^63 or more.
    pub const fn new(bytes: u64) -> Self {
        assert!(bytes <= i64::MAX as u64);
        ByteSize(bytes as i64)
    }

    /// Bytes.
    pub const fn bytes(self) -> u64 {
        self.0 as u64
    }
}

impl FromStr for ByteSize {
    type Err = SizeError;

    fn from_str(text: &str) -> Result<Self, SizeError> {
        let error = |why| SizeError { text: text.chars().take(40).collect(), why };
        let trimmed = text.trim();
        let end = trimmed.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(trimmed.len());
        let (number, unit) = (&trimmed[..end], trimmed[end..].trim_start());
        if number.is_empty() {
            return Err(error(if trimmed.starts_with('-') { "a size is not negative" } else { SYNTAX }));
        }
        let unit = unit_bytes(unit).map_err(error)?;
        let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
        if fraction.contains('.') || (whole.is_empty() && fraction.is_empty()) {
            return Err(error(SYNTAX));
        }
        let (whole, fraction) = (whole.trim_start_matches('0'), fraction.trim_end_matches('0'));
        if whole.len() > MAX_DIGITS {
            return Err(error("it must be below 2^63 bytes"));
        }
        if fraction.len() > MAX_DIGITS {
            return Err(error("it has too many digits"));
        }
        // below 10^19 * 2^60 < 2^124, and the same for the fraction's numerator
        let digits = |s: &str| s.bytes().fold(0u128, |n, b| n * 10 + u128::from(b - b'0'));
        let scale = 10u128.pow(fraction.len() as u32);
        let total = digits(whole) * unit + (digits(fraction) * unit).div_ceil(scale);
        i64::try_from(total).map(ByteSize).map_err(|_| error("it must be below 2^63 bytes"))
    }
}

fn unit_bytes(unit: &str) -> Result<u128, &'static str> {
    let power = |letter: u8| b"KMGTPE".iter().position(|&u| u == letter).map(|i| i as u32 + 1);
    Ok(match unit.strip_suffix('B').unwrap_or(unit).as_bytes() {
        [] => 1,
        [letter, b'i'] => 1024u128.pow(power(*letter).ok_or(SYNTAX)?),
        [b'k'] => 1000,
        [b'K'] => return Err("K is ambiguous: write k for 1000 or Ki for 1024"),
        [b'm'] => return Err("m would be a thousandth: write M for 1000^2 or Mi for 1024^2"),
        [letter] => 1000u128.pow(power(*letter).ok_or(SYNTAX)?),
        _ => return Err(SYNTAX),
    })
}

/// The shortest exact form with a power of 1024: `64Mi`, `1536Ki`, `1000`. Parses back to the same size.
impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (mut n, mut unit) = (self.0, "");
        for next in ["Ki", "Mi", "Gi", "Ti", "Pi", "Ei"] {
            if n == 0 || n % 1024 != 0 {
                break;
            }
            (n, unit) = (n / 1024, next);
        }
        write!(f, "{n}{unit}")
    }
}

impl Serialize for ByteSize {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Size;
        impl Visitor<'_> for Size {
            type Value = ByteSize;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a size such as 64Mi or a number of bytes")
            }
            fn visit_i64<E: de::Error>(self, n: i64) -> Result<ByteSize, E> {
                u64::try_from(n).map_err(|_| E::custom(format!("{n} is no size: a size is not negative")))?;
                Ok(ByteSize(n))
            }
            fn visit_u64<E: de::Error>(self, n: u64) -> Result<ByteSize, E> {
                let n = i64::try_from(n).map_err(|_| E::custom(format!("{n} is no size: it must be below 2^63")))?;
                Ok(ByteSize(n))
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<ByteSize, E> {
                text.parse().map_err(E::custom)
            }
        }
        deserializer.deserialize_any(Size)
    }
}

impl schemars::JsonSchema for ByteSize {
    fn schema_name() -> Cow<'static, str> {
        "ByteSize".into()
    }
    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        // the form that Kubernetes allows for its own quantities
        schemars::json_schema!({
            "anyOf": [{"type": "integer"}, {"type": "string"}],
            "pattern": r"^([0-9]+\.?[0-9]*|\.[0-9]+) ?([KMGTPE]i|[kMGTPE])?B?$",
            "x-kubernetes-int-or-string": true,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(text: &str) -> u64 {
        text.parse::<ByteSize>().unwrap().bytes()
    }

    #[test]
    fn units_are_what_people_mean() {
        for (text, want) in [
            ("0", 0),
            ("123", 123),
            ("123B", 123),
            ("1Ki", 1 << 10),
            ("1KiB", 1 << 10),
            ("64MiB", 64 << 20),
            ("64 Mi", 64 << 20),
            ("1.5Gi", 3 << 29),
            ("2Ti", 2 << 40),
            ("3Pi", 3 << 50),
            ("7Ei", 7 << 60),
            ("1k", 1000),
            ("1kB", 1000),
            ("128M", 128_000_000),
            ("1.5GB", 1_500_000_000),
            (".5k", 500),
            ("5.k", 5000),
            ("0.3Gi", 322_122_548), // 322122547.2, rounded up
            ("0.0000001", 1),
            (" 9223372036854775807 ", i64::MAX as u64),
            ("0000000000000000000000000000001", 1),
        ] {
            assert_eq!(bytes(text), want, "{text}");
        }
    }

    #[test]
    fn what_is_no_size_says_why() {
        for (text, part) in [
            ("", "write bytes"),
            ("Mi", "write bytes"),
            (".", "write bytes"),
            ("1.2.3", "write bytes"),
            ("-1Mi", "not negative"),
            ("1Xi", "write bytes"),
            ("1MiBB", "write bytes"),
            ("1mib", "write bytes"),
            ("64K", "ambiguous"),
            ("64KB", "ambiguous"),
            ("64m", "thousandth"),
            ("8Ei", "below 2^63"),
            ("9223372036854775808", "below 2^63"),
            ("99999999999999999999999999Ei", "below 2^63"),
            ("1.00000000000000000000000000000001", "too many digits"),
            ("1é", "write bytes"),
        ] {
            let error = text.parse::<ByteSize>().unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn display_parses_back() {
        for n in [0, 1, 1000, 1024, 1025, 3 << 29, 64 << 20, 7 << 60, i64::MAX as u64] {
            assert_eq!(bytes(&ByteSize::new(n).to_string()), n);
        }
        assert_eq!(ByteSize::new(64 << 20).to_string(), "64Mi");
        assert_eq!(ByteSize::new(1536 << 10).to_string(), "1536Ki");
    }

    #[test]
    fn yaml_takes_numbers_and_texts() {
        let parse = serde_yaml::from_str::<ByteSize>;
        assert_eq!(parse("4096").unwrap().bytes(), 4096);
        assert_eq!(parse("4Ki").unwrap().bytes(), 4096);
        assert!(parse("-1").unwrap_err().to_string().contains("not negative"));
        assert!(parse("9223372036854775808").unwrap_err().to_string().contains("below 2^63"));
        assert!(parse("[1]").unwrap_err().to_string().contains("a size such as 64Mi"));
        assert_eq!(serde_yaml::to_string(&ByteSize::new(4096)).unwrap().trim(), "4Ki");
    }
}
