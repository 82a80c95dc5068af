//! From files to a prepared scene: importing, cutting into splits, the scheduling grid, overlap reduction, manifest.

pub mod description;
pub mod grid;
pub mod house;
pub mod image;
pub mod import;
pub mod inspect;
pub mod manifest;
pub mod many_lights;
pub mod objects;
pub mod overlap;
pub mod prepare;
pub mod record;
pub mod split;
pub mod tools;

use std::path::PathBuf;

use description::Place;

/// Why a source could not be read. The message says file, place and what to do.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The content is not what the format says.
    #[error("{place}: {message}")]
    Malformed {
        /// Where.
        place: Place,
        /// What is wrong, and what to do.
        message: String,
    },
    /// Elements that are not supported, all of them.
    #[error("{} unsupported element(s), for which --substitute takes stand-ins:\n{}", .0.len(), list(.0))]
    Unsupported(Vec<(Place, String)>),
    /// A limit was passed before memory was taken.
    #[error("{place}: {message}")]
    Limit {
        /// Where, or the file.
        place: Place,
        /// Which limit, and how to raise it.
        message: String,
    },
}

fn list(elements: &[(Place, String)]) -> String {
    let rows: Vec<String> = elements.iter().map(|(place, what)| format!("  {place}: {what}")).collect();
    rows.join("\n")
}
