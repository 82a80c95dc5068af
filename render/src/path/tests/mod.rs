//! Tests of light transport: closed forms, and a plain intersector to trace with.

mod brute;
mod furnace;
