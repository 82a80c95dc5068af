//! Numbers under stress: the ray kernels, the film and the sampler where rounding is worst.
//!
//! Short by default; `RAYHERD_STRESS_RAYS=N` traces about N rays in each test of the kernels. `RAYHERD_FUZZ_SEED=S` runs the round of a random test
//! that failed. What the numbers mean and why they hold: docs/numerics.md.

mod cells;
mod cuts;
mod film;
mod leaks;
mod light;
mod numbers;
mod sampler;
mod scenes;
