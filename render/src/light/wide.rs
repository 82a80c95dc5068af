//! What is computed of a sky's directions, compiled for the vectors of this machine.
#![allow(unsafe_code)] // see `compiled`

use super::picture::{Directions, Picture};
use super::sky::Sky;
use crate::wide::compiled;

compiled!(
    /// Turns spots of the picture, and numbers for the sun, into directions as they travel.
    turn, turn, Directions, Sky
);
compiled!(
    /// Finds where directions lie in the picture.
    place, place, Directions, Picture
);
