//! Rays in motion: stores, wire formats, planning, rounds, the local run.

pub mod allot;
pub mod driver;
pub mod flight;
pub mod job;
pub mod ledger;
pub mod local;
pub mod picture;
pub mod plan;
pub mod png_file;
pub mod profile;
pub mod remote;
pub mod report;
pub mod resident;
pub mod scenes;
mod shapes;
pub mod store;
pub mod task;
#[cfg(test)]
mod testing;
pub mod textures;
pub mod wave;
pub mod wire;
