//! What tests of several crates share. Tests across crates live in `tests/`.

pub mod mutation;
pub mod shared;
