//! `rayherd`: renders, prepares, compares, replays.

fn main() {}
