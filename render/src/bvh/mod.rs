//! Trees over triangles and spheres: building, storing, checking, tracing.
//!
//! [`block::build_block`] makes a split's geometry object: a built tree with its primitives and their global ids.
//! [`forest::Forest`] holds the splits that are resident in one task, [`trace::Tracer`] traces rays through it.

mod arena;
mod below;
mod binary;
pub mod block;
mod boxes;
mod cells;
mod check;
mod collapse;
mod divide;
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
mod few;
pub mod forest;
mod ids;
mod layout;
mod order;
mod parts;
mod regions;
mod reinsert;
mod sah;
mod top;
pub mod trace;
mod wide;

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;

pub use block::{BuildError, Sphere, build_block};
pub use check::BlockError;
pub use forest::{BlockHandle, Forest, ForestError};
pub use layout::MAX_COORDINATE;
pub use trace::{Counters, Kernel, Tracer, UnsupportedKernel};

/// Runs two pieces of work, in parallel or not: how a caller with threads lends them to this crate, which has none.
///
/// What is computed through it does not depend on the implementation.
pub trait Fork: Sync {
    /// Runs `a` and `b`, each exactly once, and returns when both are done.
    fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send));
}

/// Runs both, and returns what they have found.
fn join<A: Send, B: Send>(fork: &dyn Fork, a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    let (mut a, mut b) = (Some(a), Some(b));
    let (mut first, mut second) = (None, None);
    fork.join(&mut || first = a.take().map(|a| a()), &mut || second = b.take().map(|b| b()));
    (first.expect("both were run"), second.expect("both were run"))
}

/// One after the other, on the calling thread.
#[derive(Clone, Copy, Debug, Default)]
pub struct Serial;

impl Fork for Serial {
    fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
        a();
        b();
    }
}
