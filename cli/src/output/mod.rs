//! Pictures out and in: EXR, PNG, and how a file is replaced.

pub mod distinct;
pub mod exr_file;
pub mod png_file;
pub mod replace;
