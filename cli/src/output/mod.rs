//! Pictures out and in: EXR, PNG, and how a file is replaced.

pub mod distinct;
pub mod exr_file;
pub mod replace;

pub use rayherd_herd::png_file;
