//! The `RenderJob` types, shared by the command line, the local run and the operator. Knows no client.
//!
//! The same YAML goes to `rayherd render -f` and to `kubectl apply -f`. Types parse ([`serde`]), describe themselves
//! ([`schemars`]) and are checked by one pure function, [`validate()`]. Numbers are `i64`, `i32` or `f64` with ranges,
//! because an OpenAPI schema knows no unsigned types.

pub mod aov;
pub mod byte_size;
pub mod image_size;
pub mod job;
pub mod picture_file;
#[cfg(all(test, feature = "kube"))]
mod reference;
#[cfg(feature = "kube")]
pub mod resource;
#[cfg(feature = "kube")]
pub mod rules;
pub mod strategy;
pub mod validate;

pub use aov::{Aov, AovList};
pub use byte_size::ByteSize;
pub use image_size::ImageSize;
pub use job::{
    API_VERSION, CameraSpec, ImageSpec, KIND, LightSpec, MANAGED_BY, Metadata, PREVIEW, Placement, RenderJob,
    RenderJobSpec, SamplingSpec, SceneSpec, StorageSpec, WorkersSpec,
};
pub use picture_file::PictureFile;
pub use strategy::Strategy;
pub use validate::{Problem, local_nodes, validate, validate_local};
