//! Code compiled for the vectors of this machine: the same code, so the same bits (nothing is fused or reordered for it; the compiler
//! may not).

/// A function `$name` that compiles `$block.$method($with)` for each instruction set, and calls the best that this machine has. A
/// call of code compiled for instructions that the build does not presume is unsafe by its nature: modules that use this say so.
macro_rules! compiled {
    ($(#[$doc:meta])* $name:ident, $method:ident, $block:ty, $with:ty) => {
        $(#[$doc])*
        pub(super) fn $name(block: &mut $block, with: &$with) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn avx2(block: &mut $block, with: &$with) {
                    block.$method(with);
                }
                #[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
                fn avx512(block: &mut $block, with: &$with) {
                    block.$method(with);
                }
                if is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
                {
                    // SAFETY: this machine has them, as was just asked.
                    return unsafe { avx512(block, with) };
                }
                if is_x86_feature_detected!("avx2") {
                    // SAFETY: as above.
                    return unsafe { avx2(block, with) };
                }
            }
            block.$method(with);
        }
    };
}
pub(crate) use compiled;
