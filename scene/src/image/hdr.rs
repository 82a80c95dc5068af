//! Radiance HDR (RGBE; Ward 1991, "Real Pixels", and Radiance's `color.c`): run-length coded and plain scanlines, as floats.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};

use rayherd_render::texture::Texel;

use super::{AGAIN, Header, Image, check, plausible};

/// Most bytes of a header: a line and all lines.
const MOST_HEADER: u64 = 64 << 10;
/// A run of two bytes makes at most 127 of a channel's, of which four make 12.
const MOST_EXPANSION: u64 = 200;

fn open(file: &mut BufReader<File>, length: u64) -> Result<Header, String> {
    let mut left = MOST_HEADER;
    let mut line = |file: &mut BufReader<File>| -> Result<String, String> {
        let mut bytes = Vec::new();
        let n = file.take(left).read_until(b'\n', &mut bytes).map_err(|e| format!("cannot be read: {e}"))?;
        left -= n as u64;
        if bytes.pop() != Some(b'\n') {
            return Err(format!("is cut off in its header: {AGAIN}"));
        }
        Ok(String::from_utf8_lossy(&bytes).trim_end().to_owned())
    };
    loop {
        let text = line(file)?;
        if text.is_empty() {
            break;
        }
        if let Some(format) = text.strip_prefix("FORMAT=")
            && format != "32-bit_rle_rgbe"
        {
            return Err(format!("has format {format}; only 32-bit_rle_rgbe is read"));
        }
    }
    let size = line(file)?;
    let words: Vec<&str> = size.split_whitespace().collect();
    let ["-Y", height, "+X", width] = words[..] else {
        return Err(format!("has its rows in another order than from the upper left (\"{size}\"): save it anew"));
    };
    let side = |text: &str| text.parse::<u32>().map_err(|_| format!("has no size in \"{size}\": {AGAIN}"));
    let header = Header { size: [side(width)?, side(height)?], channels: 3, texel: Texel::Float };
    check(header.size)?;
    plausible(&header, length, MOST_EXPANSION)?;
    Ok(header)
}

pub(super) fn header(mut file: BufReader<File>, length: u64) -> Result<Header, String> {
    open(&mut file, length)
}

pub(super) fn read(mut file: BufReader<File>, length: u64) -> Result<Image, String> {
    let header = open(&mut file, length)?;
    let [width, height] = header.size.map(|n| n as usize);
    let mut bytes = Vec::with_capacity(header.bytes() as usize);
    let mut row = vec![[0u8; 4]; width];
    for y in 0..height {
        scanline(&mut file, &mut row).map_err(|why| format!("row {y}: {why}: {AGAIN}"))?;
        for &[r, g, b, e] in &row {
            // 2^(e - 136): an exact power of two, smallest 2^-135
            let scale = if e == 0 { 0.0 } else { libm::ldexp(1.0, i32::from(e) - 136) };
            for c in [r, g, b] {
                bytes.extend(((f64::from(c) * scale) as f32).to_le_bytes());
            }
        }
    }
    Ok(Image { header, bytes })
}

fn scanline(file: &mut BufReader<File>, row: &mut [[u8; 4]]) -> Result<(), String> {
    let mut exact = |bytes: &mut [u8]| file.read_exact(bytes).map_err(|_| "the file is cut off".to_owned());
    let width = row.len();
    let mut head = [0; 4];
    exact(&mut head)?;
    let coded = (8..0x8000).contains(&width) && head[..2] == [2, 2] && head[2] < 0x80;
    if !coded {
        if head[..3] == [1, 1, 1] {
            return Err("has runs of the oldest kind, which are not read".into());
        }
        row[0] = head;
        return row[1..].iter_mut().try_for_each(|texel| exact(texel));
    }
    if usize::from(head[2]) << 8 | usize::from(head[3]) != width {
        return Err("it says another width than the header".into());
    }
    for channel in 0..4 {
        let mut x = 0;
        while x < width {
            let mut code = [0; 2];
            exact(&mut code[..1])?;
            let run = code[0] > 128;
            let n = usize::from(if run { code[0] - 128 } else { code[0] });
            if n == 0 || n > width - x {
                return Err("a run passes its end".into());
            }
            if run {
                exact(&mut code[1..])?;
            }
            for texel in &mut row[x..x + n] {
                if !run {
                    exact(&mut code[1..])?;
                }
                texel[channel] = code[1];
            }
            x += n;
        }
    }
    Ok(())
}
