//! The picture of the sky: from its file to what the renderer looks up.

use rayherd_render::light::{SkyMap, SkyMapError};

use super::skylight;
use super::vector::dot;
use crate::ImportError;
use crate::description::{Affine, Environment};
use crate::image;

/// Reads the picture of a sky, or makes that of a clear one. Negative values, which filtering leaves in some pictures, become 0, and a warning says how many.
///
/// # Errors
/// As of [`image::read`]; or the picture has fewer than 1 x 2 pixels, or holds NaN or infinity.
pub fn sky_map(environment: Option<&Environment>) -> Result<Option<SkyMap>, ImportError> {
    let (path, place) = match environment {
        None | Some(Environment::Constant(_)) => return Ok(None),
        Some(Environment::Sky(sky)) => return Ok(Some(skylight::picture(sky))),
        Some(Environment::Map { path, place, .. }) => (path, place),
    };
    let image = image::read(path, false).map_err(|why| image::error(path, place, &why))?;
    let [width, height] = image.header.size;
    let mut negative = 0u64;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let texels = pixels.map(|(x, y)| {
        image.rgb(x, y).map(|v| {
            negative += u64::from(v < 0.0);
            // keeps NaN
            if v < 0.0 { 0.0 } else { v }
        })
    });
    let texels: Vec<[f32; 3]> = texels.collect();
    if negative > 0 {
        tracing::warn!(file = %path.display(), values = negative, "negative values of the sky's picture are taken for 0");
    }
    SkyMap::new(width, height, texels).map(Some).map_err(|e: SkyMapError| ImportError::Malformed {
        place: place.clone(),
        message: format!("{}: {e}", path.display()),
    })
}

/// Rows of the rotation, perhaps mirrored, that undoes `to_world`, which must be a similarity.
pub(crate) fn to_map(to_world: &Affine) -> [[f32; 3]; 3] {
    inverse_rotation(to_world).map(|row| row.map(|v| v as f32))
}

/// The same in f64.
pub(super) fn inverse_rotation(to_world: &Affine) -> [[f64; 3]; 3] {
    // the inverse of an orthogonal map is its transpose: rows are columns, at unit length
    [0, 1, 2].map(|c| {
        let column = [0, 1, 2].map(|r| to_world.0[r][c]);
        let length = dot(column, column).sqrt();
        column.map(|v| v / length)
    })
}
