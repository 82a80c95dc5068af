//! What a prepared scene looks like from outside: a summary in words and a picture of its grid.

use std::fmt::Write;

use crate::grid::CellData;
use crate::manifest::{Manifest, StoppedBy};

/// A picture, 8 bits per channel, sRGB.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: u32,
    /// Rows, top first.
    pub height: u32,
    /// Red, green, blue of each pixel.
    pub rgb: Vec<u8>,
}

/// A summary in lines of text: sizes, splits, cells, owners, duplicates.
pub fn summary(manifest: &Manifest) -> String {
    let mut out = String::new();
    // writing to a string cannot fail
    let _ = write_summary(manifest, &mut out);
    out
}

fn write_summary(m: &Manifest, out: &mut String) -> std::fmt::Result {
    let c = &m.counts;
    writeln!(out, "content      {}", m.content)?;
    writeln!(out, "primitives   {} triangles, {} spheres of {} records", c.triangles, c.spheres, c.records)?;
    writeln!(
        out,
        "skipped      {} of zero area, {} with NaN or infinity, {} out of range",
        c.degenerate, c.non_finite, c.out_of_range
    )?;
    writeln!(out, "source       {} in {} reads", size(c.source_bytes), c.source_reads)?;
    let extent: Vec<String> = (0..3).map(|a| format!("{}", m.hi[a] - m.lo[a])).collect();
    writeln!(out, "box          {}, centred at {:?}", extent.join(" x "), m.offset)?;

    for (name, copied) in [("splits", false), ("copied", true)] {
        let splits = || m.splits.iter().filter(move |s| s.copied == copied);
        let count = splits().count();
        if count == 0 {
            continue;
        }
        let geometry = splits().map(|s| s.geometry.bytes);
        let (least, most) = (geometry.clone().min().unwrap_or(0), geometry.clone().max().unwrap_or(0));
        let attributes: u64 = splits().map(|s| s.attributes.bytes).sum();
        let primitives: u64 = splits().map(|s| s.triangles + s.spheres).sum();
        let each = if least == most { size(least) } else { format!("{} to {}", size(least), size(most)) };
        writeln!(
            out,
            "{name:<12} {count} with {primitives} primitives, geometry {} ({each}), attributes {}",
            size(geometry.sum()),
            size(attributes)
        )?;
    }

    let g = &m.grid;
    let choice = &m.choice;
    let stride = g.lattice().map_or(g.subdiv, |l| l.stride());
    let cells = u64::from(stride).pow(3);
    let why = match choice.stopped_by {
        StoppedBy::Threshold => format!("share of contested primitives at most {}", m.settings.overlap_threshold),
        StoppedBy::Several => format!("at least {} occupied cells per split", m.settings.several),
        StoppedBy::Limit => "no finer one was allowed".to_owned(),
    };
    writeln!(
        out,
        "grid         {0} x {0} x {0}{2}, {1} of {cells} cells occupied; stopped by: {why}",
        g.subdiv,
        g.cells.len(),
        if stride > g.subdiv { " and a layer around" } else { "" }
    )?;
    let fullest = g.cells.iter().map(|c| c.primitives).max().unwrap_or(0);
    writeln!(out, "fullest cell {fullest} primitives; a split holds {}", choice.capacity)?;
    let all = c.triangles + c.spheres;
    writeln!(
        out,
        "contested    {} cells with {} primitives ({:.1} %)",
        choice.contested_cells,
        choice.contested_primitives,
        100.0 * choice.contested_primitives as f64 / all.max(1) as f64
    )?;
    if m.settings.overlap_reduction {
        writeln!(
            out,
            "duplicates   {} primitives of {} cells in copied splits, {} written again ({:.1} % of the scene)",
            choice.copies,
            choice.copied_cells,
            size(choice.rewritten_bytes),
            100.0 * choice.rewritten_bytes as f64 / m.scene_bytes().max(1) as f64
        )?;
    }
    writeln!(out, "owners       {}", owners(&g.cells))?;
    for t in &choice.candidates {
        let mark = if t.subdiv == choice.subdiv { "*" } else { " " };
        writeln!(
            out,
            "  {mark} subdiv {:>3}: {} occupied, fullest {}, {:.1} % of (primitive, cell) pairs contested",
            t.subdiv,
            t.occupied,
            t.fullest,
            100.0 * t.contested_share()
        )?;
    }
    Ok(())
}

/// How many cells have how many owners.
fn owners(cells: &[CellData]) -> String {
    let mut counts = std::collections::BTreeMap::new();
    for cell in cells {
        *counts.entry(cell.owners.len()).or_insert(0u64) += 1;
    }
    let most = 4;
    let mut parts: Vec<String> = counts.range(..=most).map(|(n, cells)| format!("{cells} cells with {n}")).collect();
    let more: u64 = counts.range(most + 1..).map(|(_, cells)| cells).sum();
    if more > 0 {
        let largest = counts.keys().next_back().copied().unwrap_or(0);
        parts.push(format!("{more} with more, up to {largest}"));
    }
    parts.join(", ")
}

/// Bytes for people, in binary units.
pub fn size(bytes: u64) -> String {
    let units = ["KiB", "MiB", "GiB", "TiB"];
    if bytes < 1024 {
        return format!("{bytes} B");
    }
    let mut value = bytes as f64 / 1024.0;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < units.len() {
        value /= 1024.0;
        unit += 1;
    }
    format!("{value:.1} {}", units[unit])
}

const BACKGROUND: [u8; 3] = [16, 16, 20];
const EMPTY: [u8; 3] = [40, 40, 46];
const CONTESTED: [u8; 3] = [255, 255, 255];

/// The grid as slices along z, from the lowest at the top left, row by row. In a slice x goes right and y up. A cell has the
/// colour of its owner; one with several owners shows two of them in a checkerboard with a white rim.
pub fn picture(manifest: &Manifest) -> Picture {
    // a manifest that was checked has a lattice
    let n = manifest.grid.lattice().map_or(manifest.grid.subdiv, |l| l.stride());
    // one row or column of background around each slice, some 1024 pixels in all, 2 to 24 a cell
    let columns = (1..=n).find(|c| c * c >= n).unwrap_or(1);
    let rows = n.div_ceil(columns);
    let cell = (1024 / (columns * (n + 1))).clamp(2, 24);
    let gap = cell.max(4);
    let (width, height) = (columns * (n * cell + gap) + gap, rows * (n * cell + gap) + gap);
    let mut out = Picture { width, height, rgb: BACKGROUND.repeat((width * height) as usize) };
    let corner = |x: u32, y: u32, z: u32| {
        let slice_x = gap + z % columns * (n * cell + gap);
        let slice_y = gap + z / columns * (n * cell + gap);
        (slice_x + x * cell, slice_y + (n - 1 - y) * cell)
    };
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                out.fill(corner(x, y, z), cell, |_, _| EMPTY);
            }
        }
    }
    for c in &manifest.grid.cells {
        let (x, y, z) = (c.index % n, c.index / n % n, c.index / n / n);
        // a checked manifest has no other cells and no cell without owner
        let Some(&first) = c.owners.first().filter(|_| z < n) else { continue };
        let last = c.owners.last().copied().unwrap_or(first);
        out.fill(corner(x, y, z), cell, |i, j| {
            let rim = c.owners.len() > 1 && cell > 3 && (i == 0 || j == 0);
            match (rim, (i / 2 + j / 2) % 2) {
                (true, _) => CONTESTED,
                (_, 0) => colour(first),
                _ => colour(last),
            }
        });
    }
    out
}

impl Picture {
    fn fill(&mut self, (x, y): (u32, u32), size: u32, colour: impl Fn(u32, u32) -> [u8; 3]) {
        for j in 0..size {
            for i in 0..size {
                let at = 3 * ((y + j) * self.width + x + i) as usize;
                self.rgb[at..at + 3].copy_from_slice(&colour(i, j));
            }
        }
    }
}

/// A colour for a split: neighbours in number are far apart in hue (steps of the golden ratio), and brightness
/// changes every other round.
fn colour(split: u32) -> [u8; 3] {
    // 2^32 / golden ratio: multiplication wraps around the circle of hues
    let hue = split.wrapping_mul(2_654_435_769);
    let bright = if split.count_ones().is_multiple_of(2) { 235 } else { 180 };
    let sixth = (hue >> 8) * 6;
    let (sector, f) = (sixth >> 24, (sixth >> 16) & 0xff);
    let floor = bright / 4;
    let (rise, fall) = (floor + (bright - floor) * f / 255, bright - (bright - floor) * f / 255);
    let [r, g, b] = match sector {
        0 => [bright, rise, floor],
        1 => [fall, bright, floor],
        2 => [floor, bright, rise],
        3 => [floor, fall, bright],
        4 => [rise, floor, bright],
        _ => [bright, floor, fall],
    };
    [r as u8, g as u8, b as u8]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::manifest::tests::sample;

    #[test]
    fn the_summary_has_what_was_counted() {
        let text = summary(&sample());
        for part in [
            "6 triangles, 2 spheres of 10 records",
            "2 of zero area",
            "copied       1 with 4 primitives",
            "2 x 2 x 2, 2 of 8 cells occupied; stopped by: at least 16 occupied cells per split",
            "1 cells with 4 primitives (50.0 %)",
            "2 cells with 1",
            "* subdiv   2",
        ] {
            assert!(text.contains(part), "{part:?} is not in\n{text}");
        }
        assert_eq!(
            [size(1023), size(1024), size(3 << 40), size(u64::MAX)],
            ["1023 B", "1.0 KiB", "3.0 TiB", "16777216.0 TiB"]
        );
    }

    #[test]
    fn the_picture_shows_owners_where_they_are() {
        let mut manifest = sample();
        let picture = |m: &Manifest| {
            let p = picture(m);
            assert_eq!(p.rgb.len() as u32, 3 * p.width * p.height);
            p
        };
        let first = picture(&manifest);
        // two slices side by side: cell (0, 0, 0) is at the bottom left of the first
        let (gap, cell) = (24, 24);
        let at = |p: &Picture, x: u32, y: u32| -> [u8; 3] {
            let i = 3 * (y * p.width + x) as usize;
            [p.rgb[i], p.rgb[i + 1], p.rgb[i + 2]]
        };
        assert_eq!(at(&first, 0, 0), BACKGROUND);
        assert_eq!(at(&first, gap + cell / 2, gap + cell + cell / 2), colour(2));
        assert_eq!(at(&first, gap + cell + cell / 2, gap + cell + cell / 2), colour(1));
        assert_eq!(at(&first, gap + cell / 2, gap + cell / 2), EMPTY);
        manifest.grid.cells[0].owners = vec![0, 2];
        let contested = picture(&manifest);
        assert_eq!(at(&contested, gap, gap + cell), CONTESTED);
        assert_ne!(contested, first);
        // any allowed grid has a picture of reasonable size
        for subdiv in [1, 3, 17, 100, 256] {
            manifest.grid.subdiv = subdiv;
            let p = picture(&manifest);
            assert!(p.width <= 9000 && p.height <= 9000, "{subdiv}: {} x {}", p.width, p.height);
        }
    }

    #[test]
    fn the_first_splits_have_colours_of_their_own() {
        let colours: std::collections::BTreeSet<_> = (0..64).map(colour).collect();
        assert!(colours.len() > 60);
    }
}
