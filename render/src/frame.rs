//! What defines the picture besides the scene.

use serde::{Deserialize, Serialize};

use crate::aov::Aovs;
use crate::camera::Camera;
use crate::film::Layout;
use crate::filter::Filter;
use crate::sampler::MAX_SPLIT;

/// Everything but the scene and the number of samples that decides the picture's bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// The camera, in recentred coordinates.
    pub camera: Camera,
    /// Width and height in pixels, each from 1 to 65535.
    pub size: [u32; 2],
    /// Pixel filter.
    pub filter: Filter,
    /// Seed of every random number.
    pub seed: u64,
    /// Most rays of a path but shadow rays, at least 1: 1 sees emitters only (Mitsuba's `max_depth`), below 65536.
    pub max_depth: u32,
    /// Ray number from which Russian roulette may end a path (Mitsuba's `rr_depth`), with the chances of [`crate::path::shade`].
    pub rr_depth: u32,
    /// Continuations at the first hit (the paper's N_d); 1 is none.
    pub split: u32,
    /// Camera rays pass through what emits light, and see no sky (Mitsuba's `hide_emitters`).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub hide_emitters: bool,
    /// What is taken beside light.
    #[serde(default, skip_serializing_if = "none")]
    pub aovs: Aovs,
}

fn none(aovs: &Aovs) -> bool {
    aovs.is_empty()
}

/// Why a frame cannot be rendered.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// The size is out of range.
    #[error("size {0} x {1} is out of range: give 1 to 65535 pixels each way")]
    Size(u32, u32),
    /// The depth is out of range.
    #[error("max depth {0} is out of range: give 1 to 65535")]
    MaxDepth(u32),
    /// The number of siblings is out of range.
    #[error("splitting by {0} is out of range: give 1 to {MAX_SPLIT}")]
    Split(u32),
    /// The filter is not one.
    #[error("the filter's width {0} is out of range: give more than 0 and at most 64 pixels")]
    Filter(f64),
}

impl Frame {
    /// What its film holds.
    pub fn layout(&self) -> Layout {
        Layout { size: self.size, aovs: self.aovs }
    }

    /// Checks the ranges that the rest of the crate relies on.
    pub fn check(&self) -> Result<(), FrameError> {
        let [w, h] = self.size;
        if !(1..=65535).contains(&w) || !(1..=65535).contains(&h) {
            return Err(FrameError::Size(w, h));
        }
        if !(1..=65535).contains(&self.max_depth) {
            return Err(FrameError::MaxDepth(self.max_depth));
        }
        if !(1..=MAX_SPLIT).contains(&self.split) {
            return Err(FrameError::Split(self.split));
        }
        match self.filter {
            Filter::Tent { radius: x } | Filter::Gaussian { stddev: x } if !(x > 0.0 && x <= 64.0) => {
                Err(FrameError::Filter(x))
            }
            _ => Ok(()),
        }
    }
}
