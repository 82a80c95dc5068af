//! Pixel filters.

use serde::{Deserialize, Serialize};

/// Pixel reconstruction filter; sampled, so that a sample belongs to one pixel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Filter {
    /// Box of the pixel.
    Box,
    /// Tent of the radius, pixels.
    Tent {
        /// Half width.
        radius: f64,
    },
    /// Gaussian, cut at four standard deviations.
    Gaussian {
        /// Standard deviation, pixels.
        stddev: f64,
    },
}
