//! Pictures out and in: EXR, PNG, and how a file is replaced.

pub mod exr_file;
pub mod grid_picture;
pub mod png_file;
pub mod replace;

/// A picture in linear RGB (Rec. 709), rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: u32,
    /// `width * height` colours.
    pub pixels: Vec<[f32; 3]>,
}

impl Picture {
    /// Number of rows.
    pub fn height(&self) -> u32 {
        (self.pixels.len() / self.width as usize) as u32
    }
}
