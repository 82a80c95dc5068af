//! The phases of a block compiled for the vectors of this machine: the same code, so the same bits (nothing is fused or reordered
//! for it; the compiler may not).
// a call of code compiled for instructions that the build does not presume is unsafe by its nature
#![allow(unsafe_code)]

use super::Context;
use super::block::Block;

/// Runs the phases over the block's vertices.
pub(super) fn compute(block: &mut Block, context: &Context) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: this machine has AVX2, as was just asked.
        return unsafe { compute_avx2(block, context) };
    }
    block.phases(context);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn compute_avx2(block: &mut Block, context: &Context) {
    block.phases(context);
}
