//! Tests of light transport: closed forms, and a plain intersector to trace with.

mod aovs;
mod brute;
mod cornell;
mod direct;
mod furnace;
mod step;
mod textured;

use brute::Scene;

use super::{Context, reference};
use crate::film::FilmPart;
use crate::frame::Frame;

/// Mean of the picture's red; nothing may be rejected.
fn mean_of(scene: &Scene, frame: &Frame, samples: u32) -> f64 {
    let world = scene.world();
    let lights = scene.lights();
    let context = Context::new(&world, &lights, frame).with(&scene.tiles);
    let mut film = FilmPart::new(frame.size);
    reference::render(&context, scene, 0..samples, &mut film);
    assert_eq!(film.rejected().count, 0);
    let picture = film.resolve(samples);
    picture.iter().map(|p| f64::from(p[0])).sum::<f64>() / picture.len() as f64
}
