//! What travels and what is kept: byte formats with version, checksum and bounded lengths.

pub mod envelope;
pub mod ray_group;

pub use envelope::{Compress, Kind, WireError, open, seal};
