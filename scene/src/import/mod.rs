//! Reading scenes: a file or folder of any supported format to a [`Description`], and its records.

pub mod isosurface;
mod mitsuba;
mod placement;
mod shapes;
mod stream;
pub(crate) mod vector;
pub mod volume;

use std::path::Path;

pub use placement::Placement;
pub use stream::{DescriptionSource, StreamOptions};

use crate::ImportError;
use crate::description::{Description, Place};

/// What the caller decides about an import.
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Unsupported elements are replaced by named stand-ins instead of being an error.
    pub substitute: bool,
    /// Values of a Mitsuba scene's `$names`; they win over its defaults. A name that the scene lacks is an error.
    pub defines: Vec<(String, String)>,
    /// Width and height instead of the source's; a field of view along y follows it.
    pub size: Option<[u32; 2]>,
}

/// Reads a scene.
///
/// # Errors
/// The file cannot be read, is malformed, or has elements that are not supported (all are listed).
pub fn import(path: &Path, options: &ImportOptions) -> Result<Description, ImportError> {
    let description = mitsuba::import(path, options)?;
    let lit = description.environment.is_some_and(|rgb| rgb.iter().any(|v| *v > 0.0))
        || description.shapes.iter().any(|s| s.emission.is_some());
    if !lit {
        return Err(ImportError::Malformed {
            place: Place { file: path.into(), line: 0 },
            message: "nothing in this scene emits light, its image is black: add an emitter, or pass --light or --sky"
                .into(),
        });
    }
    Ok(description)
}
