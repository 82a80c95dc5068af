//! Pure path tracing: rays, blocks, materials, light, film.
//!
//! This crate does no I/O, knows no clock, starts no thread and awaits nothing. What it computes is a function of
//! its arguments, to the bit, on every machine.

pub mod bvh;
pub mod filter;
pub mod material;
pub mod ray;
pub mod world;
