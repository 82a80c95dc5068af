//! Pure path tracing: rays, blocks, materials, light, film.
//!
//! This crate does no I/O, knows no clock, starts no thread and awaits nothing. What it computes is a function of
//! its arguments, to the bit, on every machine.

// `!(x > 0.0)` is true of NaN, which is what is meant
#![allow(clippy::neg_cmp_op_on_partial_ord)]
// the tests are of f32: where all targets are asked for, the ones of the build in f64 are none
#![cfg(not(all(test, feature = "double")))]
// in f64 some conversions convert nothing, and what only the vector code uses is not used
#![cfg_attr(
    feature = "double",
    allow(clippy::useless_conversion, clippy::unnecessary_cast, dead_code, unused_imports, unused_qualifications)
)]

pub mod aov;
pub mod attributes;
pub mod bvh;
pub mod camera;
pub mod film;
pub mod filter;
pub mod frame;
pub mod light;
pub mod material;
pub mod math;
pub mod memory;
pub mod path;
pub mod ray;
mod real;
pub mod sampler;
pub mod skip;
#[cfg(test)]
mod testing;
pub mod texture;
mod wide;
pub mod world;
