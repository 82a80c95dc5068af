//! Rays and film parts as the bodies of objects, checked against the scene.

use bytes::Bytes;
use rayherd_render::film::FilmPart;

use crate::flight::Flights;
use crate::job::PreparedScene;
use crate::wire::WireError;
use crate::wire::envelope::{Compress, Kind, open, seal};

/// Largest film that is read, bytes: 96 a pixel at most, so some ten million pixels.
const FILM_LIMIT: usize = 1 << 30;

/// Whether rays name only splits and cells that the scene has.
pub fn check_rays(scene: &PreparedScene, rays: &Flights) -> Result<(), WireError> {
    let (splits, cells) = (scene.splits(), scene.grid.occupied());
    let visits = rays.paths.iter().map(|f| f.visit).chain(rays.shadows.iter().map(|f| f.visit));
    let lost = rays.paths.iter().any(|f| f.candidate.is_hit() && f.candidate.split >= splits);
    if lost || visits.into_iter().any(|v| v.progress.0 > cells) {
        return Err(WireError::corrupt("a ray names a split or a cell that the scene lacks"));
    }
    Ok(())
}

/// A film part as an object.
pub fn encode_film(film: &FilmPart) -> Bytes {
    seal(Kind::FilmPart, &film.encode(), Compress::Lz4)
}

/// A film part from an object.
pub fn decode_film(size: [u32; 2], body: &[u8]) -> Result<FilmPart, WireError> {
    let payload = open(Kind::FilmPart, body, FILM_LIMIT)?;
    FilmPart::decode(&payload, size).map_err(|e| WireError::corrupt(e.to_string()))
}
