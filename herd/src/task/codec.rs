//! Rays and film parts as the bodies of objects.

use bytes::Bytes;
use rayherd_render::film::FilmPart;

use crate::wire::WireError;
use crate::wire::envelope::{Compress, Kind, open, seal};
pub use crate::wire::ray_group::{decode as decode_rays, encode as encode_rays};

/// Largest body that is read.
pub const LIMIT: usize = 1 << 30;

/// A film part as an object.
pub fn encode_film(film: &FilmPart) -> Bytes {
    seal(Kind::FilmPart, &film.encode(), Compress::Lz4)
}

/// A film part from an object.
pub fn decode_film(size: [u32; 2], body: &[u8]) -> Result<FilmPart, WireError> {
    let payload = open(Kind::FilmPart, body, LIMIT)?;
    FilmPart::decode(&payload, size).map_err(|e| WireError::corrupt(e.to_string()))
}
