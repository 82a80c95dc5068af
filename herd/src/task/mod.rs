//! One task: its inputs, the trace loop, what comes out.

pub mod camera;
pub mod codec;
pub mod groups;
pub mod trace;

pub use camera::CameraFeed;
pub use trace::{Loop, Outbox, Shading, Stop};
