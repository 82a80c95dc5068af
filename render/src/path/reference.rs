//! A frame rendered plainly, one path at a time: for tests and for checking the real thing.

use super::{Context, Counters, Outcome, Surfaces, camera_ray, shade, take_aovs};
use crate::film::FilmPart;
use crate::ray::{Hit, Ray};

/// Something that finds hits.
pub trait Tracer: Surfaces {
    /// The nearest hit.
    fn closest(&self, ray: &Ray) -> Hit;
    /// Whether anything is hit.
    fn occluded(&self, ray: &Ray) -> bool;
}

/// Adds the samples of the range to every pixel of the film.
pub fn render<T: Tracer>(
    context: &Context,
    tracer: &T,
    samples: std::ops::Range<u32>,
    film: &mut FilmPart,
) -> Counters {
    let [width, height] = context.frame.size;
    let mut out = Outcome::default();
    let mut stack = Vec::new();
    for pixel in 0..width * height {
        for sample in samples.clone() {
            stack.push(camera_ray(context.frame, pixel, sample));
            while let Some(ray) = stack.pop() {
                let hit = tracer.closest(&ray.ray());
                shade(context, tracer, &[ray], &[hit], &mut out);
                take_aovs(context, tracer, &[ray], &[hit], &out.shadow, film.aovs(), |aov, pixel, sample, values| {
                    film.add_aov(aov, pixel, sample, values);
                });
                for light in &out.light {
                    film.add(light.pixel, light.sample, light.value);
                }
                for shadow in &out.shadow {
                    if !tracer.occluded(&shadow.ray()) {
                        film.add(shadow.key.pixel, shadow.key.sample, shadow.contribution);
                    }
                }
                stack.extend_from_slice(&out.next);
                out.clear();
            }
        }
    }
    out.counters
}
