//! The scheduling grid as a picture.

use std::io;

use rayherd_scene::grid::GridData;

use super::png_file::encode_rgb8;

/// The picture is not wider or higher than about this.
const LARGEST: u32 = 2048;
const GAP: u32 = 4;
const AROUND: [u8; 3] = [128; 3];
const EMPTY: [u8; 3] = [16; 3];
const CONTESTED: [u8; 3] = [255; 3];

/// Draws layer by layer along z, from left to right and top to bottom; x to the right, y upwards. An occupied cell has
/// the colour of its first owner, with a white corner where it has several.
pub fn draw(grid: &GridData) -> io::Result<Vec<u8>> {
    let n = grid.subdiv;
    let columns = (1..=n).find(|c| c * c >= n).unwrap_or(1);
    let rows = n.div_ceil(columns);
    let scale = (LARGEST.saturating_sub(columns * GAP) / (columns * n)).clamp(1, 16);
    let layer = n * scale + GAP;
    let (width, height) = (columns * layer + GAP, rows * layer + GAP);
    let mut texels = vec![AROUND; width as usize * height as usize];
    let mut fill = |x: u32, y: u32, z: u32, edge: u32, colour: [u8; 3]| {
        let left = GAP + z % columns * layer + x * scale;
        let top = GAP + z / columns * layer + (n - 1 - y) * scale;
        for row in top..top + edge {
            let start = row as usize * width as usize + left as usize;
            texels[start..start + edge as usize].fill(colour);
        }
    };
    for z in 0..n {
        for (x, y) in (0..n).flat_map(|y| (0..n).map(move |x| (x, y))) {
            fill(x, y, z, scale, EMPTY);
        }
    }
    for cell in &grid.cells {
        let (x, y, z) = (cell.index % n, cell.index / n % n, cell.index / (n * n));
        fill(x, y, z, scale, owner_colour(cell.owners.first().copied().unwrap_or(0)));
        if cell.owners.len() > 1 {
            fill(x, y, z, scale.div_ceil(2), CONTESTED);
        }
    }
    encode_rgb8(width, height, texels.as_flattened())
}

/// Colours of the number line by the golden angle: neighbours in number are far apart in hue.
fn owner_colour(owner: u32) -> [u8; 3] {
    let hue = (f64::from(owner) * 0.618_033_988_749_895).fract() * 6.0;
    let value = 230.0 - 30.0 * f64::from(owner % 4);
    [5.0, 3.0, 1.0].map(|shift: f64| {
        let k = (shift + hue) % 6.0;
        (value * (1.0 - 0.8 * k.min(4.0 - k).clamp(0.0, 1.0))) as u8
    })
}

#[cfg(test)]
mod tests {
    use rayherd_scene::grid::CellData;

    use super::*;

    #[test]
    fn cells_are_where_the_legend_says() {
        let cell = |index, owners: &[u32]| CellData {
            index,
            lo: [0.0; 3],
            hi: [1.0; 3],
            primitives: 1,
            owners: owners.to_vec(),
        };
        // x = 1, y = 0, z = 0 and x = 0, y = 1, z = 1 of 2^3
        let cells = vec![cell(1, &[0]), cell(6, &[1, 2])];
        let png = draw(&GridData { subdiv: 2, lo: [0.0; 3], hi: [1.0; 3], cells }).unwrap();
        let mut reader = png::Decoder::new(io::Cursor::new(&png)).read_info().unwrap();
        let mut texels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut texels).unwrap();
        let layer = 2 * 16 + GAP;
        assert_eq!((info.width, info.height), (2 * layer + GAP, layer + GAP));
        let at = |x: u32, y: u32| {
            let i = 3 * (y * info.width + x) as usize;
            [texels[i], texels[i + 1], texels[i + 2]]
        };
        assert_eq!(at(0, 0), AROUND);
        assert_eq!(at(GAP, GAP), EMPTY);
        assert_eq!(at(GAP + 16, GAP + 16), owner_colour(0));
        assert_eq!(at(GAP + layer, GAP), CONTESTED);
        assert_eq!(at(GAP + layer + 15, GAP + 15), owner_colour(1));
        assert_eq!(at(GAP + layer + 16, GAP + 16), EMPTY);
        // the largest grid still gives a picture of bounded size
        let png = draw(&GridData { subdiv: 256, lo: [0.0; 3], hi: [1.0; 3], cells: vec![] }).unwrap();
        let info = png::Decoder::new(io::Cursor::new(&png)).read_info().unwrap().info().size();
        assert!(info.0 < 4500 && info.1 < 4500, "{info:?}");
    }
}
