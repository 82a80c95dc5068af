//! Radiance HDR: RGBE, plain and with either run-length encoding (Ward, "Real Pixels", Graphics Gems II; the file formats of Radiance).

use super::{Image, ImageLimits, Problem, check_size};

pub(super) fn decode(bytes: &[u8], limits: &ImageLimits) -> Result<Image, Problem> {
    let mut rest = bytes;
    let mut line = || -> Result<&str, Problem> {
        let end = rest.iter().take(4096).position(|&b| b == b'\n');
        let end = end.ok_or_else(|| Problem::new("a damaged HDR: its header does not end"))?;
        let text = std::str::from_utf8(&rest[..end]).unwrap_or_default();
        rest = &rest[end + 1..];
        Ok(text.trim_end_matches('\r'))
    };
    line()?;
    loop {
        let text = line()?;
        if text.is_empty() {
            break;
        }
        // EXPOSURE and COLORCORR say by what values were multiplied; they are left as they are, as other readers leave them
        if let Some(format) = text.strip_prefix("FORMAT=")
            && format.trim() != "32-bit_rle_rgbe"
        {
            return Err(Problem::new(format!("an HDR of format {format:?}: only 32-bit_rle_rgbe is read")));
        }
    }
    let words: Vec<&str> = line()?.split_ascii_whitespace().collect();
    let (width, height) = match words[..] {
        ["-Y", h, "+X", w] => match (w.parse(), h.parse()) {
            (Ok(w), Ok(h)) => check_size(w, h, limits)?,
            _ => return Err(Problem::new("a damaged HDR: its size is no pair of numbers")),
        },
        _ => {
            return Err(Problem::new(
                "an HDR whose rows do not run from the top and from the left (-Y height +X width)",
            ));
        }
    };
    let (w, h) = (width as usize, height as usize);
    // a row takes four bytes at least
    if rest.len() / 4 < h {
        return Err(short());
    }
    let mut values: Vec<f32> = vec![];
    let mut row = vec![[0u8; 4]; w];
    for _ in 0..h {
        rest = scanline(rest, &mut row)?;
        values.extend(row.iter().flat_map(|p| rgb(*p)));
    }
    Ok(Image { width, height, channels: 3, srgb: false, values })
}

/// One pixel: mantissas over 256 times 2^(exponent - 128).
fn rgb([r, g, b, e]: [u8; 4]) -> [f32; 3] {
    if e == 0 {
        return [0.0; 3];
    }
    // exact: a power of two, subnormal for the least exponents
    let scale = libm::ldexp(1.0, i32::from(e) - 136);
    [r, g, b].map(|m| (f64::from(m) * scale) as f32)
}

fn short() -> Problem {
    Problem::new("a damaged HDR: the file ends before its last row")
}

/// Reads one row; what follows it.
fn scanline<'a>(mut rest: &'a [u8], row: &mut [[u8; 4]]) -> Result<&'a [u8], Problem> {
    let width = row.len();
    let head: [u8; 4] = *rest.first_chunk().ok_or_else(short)?;
    let new = (8..0x8000).contains(&width) && head[0] == 2 && head[1] == 2 && head[2] & 0x80 == 0;
    if !new {
        return old_scanline(rest, row);
    }
    if usize::from(head[2]) << 8 | usize::from(head[3]) != width {
        return Err(Problem::new("a damaged HDR: a row says another width than the picture"));
    }
    rest = &rest[4..];
    for channel in 0..4 {
        let mut x = 0;
        while x < width {
            let (&count, after) = rest.split_first().ok_or_else(short)?;
            let run = count > 128;
            let n = usize::from(if run { count - 128 } else { count });
            if n == 0 || n > width - x {
                return Err(Problem::new("a damaged HDR: a run is longer than its row"));
            }
            let length = if run { 1 } else { n };
            let data = after.get(..length).ok_or_else(short)?;
            for i in 0..n {
                row[x + i][channel] = data[if run { 0 } else { i }];
            }
            rest = &after[length..];
            x += n;
        }
    }
    Ok(rest)
}

/// Pixels one by one; (1, 1, 1, n) repeats the one before n times, several in a row are digits of base 256, lowest first.
fn old_scanline<'a>(mut rest: &'a [u8], row: &mut [[u8; 4]]) -> Result<&'a [u8], Problem> {
    let (mut x, mut shift) = (0, 0);
    while x < row.len() {
        let pixel: [u8; 4] = *rest.first_chunk().ok_or_else(short)?;
        rest = &rest[4..];
        if pixel[..3] == [1, 1, 1] {
            let n = usize::from(pixel[3]).checked_shl(shift).unwrap_or(usize::MAX);
            if x == 0 || n > row.len() - x {
                return Err(Problem::new("a damaged HDR: a run is longer than its row"));
            }
            let last = row[x - 1];
            row[x..x + n].fill(last);
            x += n;
            shift += 8;
        } else {
            row[x] = pixel;
            x += 1;
            shift = 0;
        }
    }
    Ok(rest)
}
