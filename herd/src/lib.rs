//! Rays in motion: stores, wire formats, planning, rounds, the local run.

pub mod store;
pub mod wire;
