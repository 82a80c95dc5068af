//! Mitsuba's built-in shapes as triangles, in its own order of vertices and triangles.

use crate::description::Geometry;

/// `[-1, 1]^2` at z = 0, front towards +z (src/shapes/rectangle.cpp).
pub(super) fn rectangle() -> Geometry {
    Geometry::Inline {
        positions: vec![[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]],
        uv: vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
        triangles: vec![[1, 2, 0], [1, 3, 2]],
    }
}

/// `[-1, 1]^3`, front outside, each face with its own uv square (src/shapes/cube.cpp).
pub(super) fn cube() -> Geometry {
    // bit k of a corner's number is the sign of axis k
    const CORNERS: [u8; 24] = [1, 5, 4, 0, 3, 2, 6, 7, 1, 3, 7, 5, 5, 7, 6, 4, 4, 6, 2, 0, 3, 1, 0, 2];
    const UV: [[f32; 2]; 4] = [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let sign = |c: u8, axis: u8| if c >> axis & 1 == 1 { 1.0 } else { -1.0 };
    Geometry::Inline {
        positions: CORNERS.iter().map(|&c| [sign(c, 0), sign(c, 1), sign(c, 2)]).collect(),
        uv: (0..24).map(|i| UV[i % 4]).collect(),
        triangles: (0..6).flat_map(|s| [[4 * s, 4 * s + 1, 4 * s + 2], [4 * s + 3, 4 * s, 4 * s + 2]]).collect(),
    }
}
