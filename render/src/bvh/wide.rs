//! The steps of building a tree, compiled for the vectors of this machine.
#![allow(unsafe_code)] // see `compiled`

use super::sah::{Division, Subtree};
use crate::wide::compiled;

compiled!(
    /// Divides many boxes.
    divide, run, Division<'_>, ()
);
compiled!(
    /// Builds all of a subtree.
    subtree, run, Subtree<'_>, ()
);
