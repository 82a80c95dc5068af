//! Numbers in text.

/// A kind of number that text is read as.
pub(super) trait Number: std::str::FromStr {
    /// The value of a plain decimal `m 10^e`, if it is found this way exactly as [`std::str::FromStr`] rounds it.
    fn from_decimal(negative: bool, m: u64, e: i32) -> Option<Self>;
}

/// A number in text; infinities and NaN are numbers here, and preparing skips what has them.
#[inline]
pub(super) fn number<T: Number>(text: &[u8]) -> Option<T> {
    if let Some((negative, m, e)) = decimal(text)
        && let Some(value) = T::from_decimal(negative, m, e)
    {
        return Some(value);
    }
    std::str::from_utf8(text).ok()?.parse().ok()
}

/// Powers of ten that f64 holds exactly.
const EXACT: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

impl Number for f64 {
    /// Below 2^53 and with a power of ten that f64 holds there is one rounding, that of the product or quotient (Clinger,
    /// "How to read floating point numbers accurately", PLDI 1990).
    #[inline]
    fn from_decimal(negative: bool, m: u64, e: i32) -> Option<f64> {
        if m >> 53 != 0 {
            return None;
        }
        let power = *EXACT.get(e.unsigned_abs() as usize)?;
        let value = if e < 0 { m as f64 / power } else { m as f64 * power };
        Some(if negative { -value } else { value })
    }
}

impl Number for f32 {
    /// By way of f64. Rounding twice differs from rounding once only where the first result lies in the middle
    /// between two f32, which is left to the slow way. The range of normal f32 is wider than what comes here.
    #[inline]
    fn from_decimal(negative: bool, m: u64, e: i32) -> Option<f32> {
        let value = f64::from_decimal(negative, m, e)?;
        // f64 has 29 more bits
        let below = value.to_bits() & ((1 << 29) - 1);
        (below != 1 << 28).then_some(value as f32)
    }
}

impl Number for i64 {
    #[inline]
    fn from_decimal(negative: bool, m: u64, e: i32) -> Option<i64> {
        let value = i64::try_from(m).ok().filter(|_| e == 0)?;
        Some(if negative { -value } else { value })
    }
}

/// Sign, digits and power of ten of `[+-] digits [. digits] [e [+-] digits]`, if it is short enough for its digits to fit
/// 64 bits; `None` for everything else, numbers or not. A power of zero comes only of digits alone: `1.0` has -1, and
/// `1.` and `1e0` are left to the slow way, so that none of them is taken for a whole number.
#[inline]
fn decimal(text: &[u8]) -> Option<(bool, u64, i32)> {
    let negative = *text.first()? == b'-';
    let rest = if negative || text[0] == b'+' { &text[1..] } else { text };
    // 10^19 is below 2^64
    if rest.is_empty() || rest.len() > 19 {
        return None;
    }
    let mut m = 0u64;
    let mut digits = |from: usize| {
        let mut at = from;
        while let Some(digit) = rest.get(at).map(|b| b.wrapping_sub(b'0')).filter(|d| *d < 10) {
            m = m * 10 + u64::from(digit);
            at += 1;
        }
        at
    };
    let whole = digits(0);
    if whole == rest.len() {
        return Some((negative, m, 0));
    }
    let (mut end, mut fraction) = (whole, 0);
    if rest[whole] == b'.' {
        end = digits(whole + 1);
        fraction = end - whole - 1;
    }
    if end == rest.len() {
        return (fraction > 0).then_some((negative, m, -(fraction as i32)));
    }
    if whole + fraction == 0 || !matches!(rest[end], b'e' | b'E') {
        return None;
    }
    let e = exponent(&rest[end + 1..])? - fraction as i32;
    (e != 0).then_some((negative, m, e))
}

/// `[+-] digits`, at most three of them.
fn exponent(text: &[u8]) -> Option<i32> {
    let (sign, digits) = match text.split_first()? {
        (b'-', rest) => (-1, rest),
        (b'+', rest) => (1, rest),
        _ => (1, text),
    };
    if digits.is_empty() || digits.len() > 3 || !digits.iter().all(u8::is_ascii_digit) {
        return None;
    }
    Some(sign * digits.iter().fold(0, |e, d| e * 10 + i32::from(d - b'0')))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn same(text: &str) {
        let bytes = text.as_bytes();
        assert_eq!(number::<f32>(bytes).map(f32::to_bits), text.parse::<f32>().ok().map(f32::to_bits), "{text}");
        assert_eq!(number::<f64>(bytes).map(f64::to_bits), text.parse::<f64>().ok().map(f64::to_bits), "{text}");
        assert_eq!(number::<i64>(bytes), text.parse::<i64>().ok(), "{text}");
    }

    #[test]
    fn odd_forms_read_as_std_reads_them() {
        for text in [
            "",
            "-",
            "+",
            ".",
            "-.",
            "1.",
            ".5",
            "-.5e3",
            "1e",
            "1e+",
            "1e-7",
            "1E22",
            "1e23",
            "1e0",
            "1.0",
            "-0",
            "-0.0",
            "+7",
            "inf",
            "-NaN",
            "infinity",
            "1_000",
            "1,5",
            "0x10",
            "1.2.3",
            "1e5.0",
            "9223372036854775807",
            "-9223372036854775808",
            "9223372036854775808",
            "9007199254740993",
            "123456789012345678",
            "0.000000000000000001",
            // exactly between two f32, and a little to both sides in digits that f64 cannot tell
            "16777217",
            "16777217.0000000001",
            "16777216.9999999999",
            "1.00000005960464477539",
            "1e39",
            "1e-46",
            "000000000000000000000001",
            "1e0000",
            "12e10",
        ] {
            same(text);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4000))]
        #[test]
        fn numbers_are_those_of_std(text in "[+-]?[0-9]{0,12}(\\.[0-9]{0,12})?([eE][+-]?[0-9]{1,3})?", f: f32, d: f64, i: i64) {
            same(&text);
            same(&f.to_string());
            same(&format!("{f:e}"));
            same(&d.to_string());
            same(&format!("{d:e}"));
            same(&i.to_string());
        }
    }
}
