//! Squares of two colours.

use serde::{Deserialize, Serialize};

use super::UvMap;
use crate::real::{Vec3, f32};

/// Four squares in the unit square of the mapped coordinates, repeated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Checkerboard {
    /// Texture coordinates to those of the squares.
    pub to_uv: UvMap,
    /// Linear Rec. 709 of the square at (0, 0) and its diagonal neighbour, and of the other two.
    pub colors: [[f32; 3]; 2],
}

impl Checkerboard {
    #[inline]
    fn square(&self, uv: [f32; 2]) -> usize {
        // the middle belongs to the lower square
        let [x, y] = self.to_uv.point(uv).map(|x| x - x.floor() > 0.5);
        usize::from(x != y)
    }

    /// The colour at texture coordinates.
    #[inline]
    pub fn color(&self, uv: [f32; 2]) -> Vec3 {
        self.colors[self.square(uv)].into()
    }

    /// The colour that is not there.
    #[inline]
    pub fn other(&self, uv: [f32; 2]) -> Vec3 {
        self.colors[1 - self.square(uv)].into()
    }
}
