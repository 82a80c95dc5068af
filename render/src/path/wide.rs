//! The phases of blocks, compiled for the vectors of this machine.
#![allow(unsafe_code)] // see `compiled`

use super::Context;
use super::block::Block;
use super::primary::CameraBlock;
use crate::frame::Frame;
use crate::wide::compiled;

compiled!(
    /// Shades the block's vertices.
    compute, phases, Block, Context
);
compiled!(
    /// Makes the block's camera rays.
    camera, phases, CameraBlock, Frame
);
