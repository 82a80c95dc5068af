//! Numbers, vectors and colours as Mitsuba writes them.

use super::xml::{Value, malformed};
use crate::ImportError;
use crate::description::Place;

/// Tokens between blanks and commas.
fn tokens(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| c == ',' || c.is_whitespace()).filter(|t| !t.is_empty())
}

/// One finite number.
pub(super) fn float(text: &str, place: &Place) -> Result<f64, ImportError> {
    match text.trim().parse::<f64>() {
        Ok(x) if x.is_finite() => Ok(x),
        Ok(_) => malformed(place, format!("\"{text}\" is not finite")),
        Err(_) => malformed(place, format!("\"{text}\" is no number")),
    }
}

/// Several finite numbers.
pub(super) fn floats(text: &str, place: &Place) -> Result<Vec<f64>, ImportError> {
    tokens(text).map(|t| float(t, place)).collect()
}

/// One whole number.
pub(super) fn integer(text: &str, place: &Place) -> Result<i64, ImportError> {
    match text.trim().parse() {
        Ok(i) => Ok(i),
        Err(_) => malformed(place, format!("\"{text}\" is no whole number")),
    }
}

/// `true` or `false`.
pub(super) fn boolean(text: &str, place: &Place) -> Result<bool, ImportError> {
    match text.trim() {
        t if t.eq_ignore_ascii_case("true") => Ok(true),
        t if t.eq_ignore_ascii_case("false") => Ok(false),
        _ => malformed(place, format!("\"{text}\" is neither true nor false")),
    }
}

/// Three numbers in `x`, `y`, `z` (`default` where absent) or in `value` (one for all, or three).
pub(super) fn vector<'a>(
    get: &dyn Fn(&str) -> Option<&'a str>,
    default: f64,
    place: &Place,
) -> Result<[f64; 3], ImportError> {
    if let Some(text) = get("value") {
        if get("x").or(get("y")).or(get("z")).is_some() {
            return malformed(place, "\"value\" beside \"x\", \"y\" or \"z\": write one of them");
        }
        return match floats(text, place)?[..] {
            [v] => Ok([v; 3]),
            [x, y, z] => Ok([x, y, z]),
            _ => malformed(place, format!("\"{text}\" has neither one number nor three")),
        };
    }
    let mut out = [default; 3];
    for (slot, name) in out.iter_mut().zip(["x", "y", "z"]) {
        if let Some(text) = get(name) {
            *slot = float(text, place)?;
        }
    }
    Ok(out)
}

/// Linear RGB of "r, g, b", "r g b", "grey" or "#rrggbb"; `encoded` numbers (and hex always) are sRGB.
pub(super) fn color(text: &str, encoded: bool, place: &Place) -> Result<Value, ImportError> {
    if let Some(hex) = text.trim().strip_prefix('#') {
        return match u32::from_str_radix(hex, 16) {
            Ok(bits) if hex.len() == 6 => {
                Ok(Value::Color([16, 8, 0].map(|shift| decode_srgb(f64::from(bits >> shift & 255) / 255.0))))
            }
            _ => malformed(place, format!("\"{text}\" is no colour of the form #rrggbb")),
        };
    }
    let rgb = match floats(text, place)?[..] {
        [v] => [v; 3],
        [r, g, b] => [r, g, b],
        ref other => return malformed(place, format!("a colour has one number or three, not {}", other.len())),
    };
    Ok(Value::Color(if encoded { rgb.map(decode_srgb) } else { rgb }))
}

/// A spectrum: one value is grey, three are RGB (0.5 and 0.6); wavelength pairs are kept as text.
pub(super) fn spectrum(text: &str, place: &Place) -> Result<Value, ImportError> {
    if text.contains(':') { Ok(Value::Spectrum(text.to_string())) } else { color(text, false, place) }
}

/// IEC 61966-2-1.
fn decode_srgb(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
}
