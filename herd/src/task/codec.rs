//! Rays and film parts as the bodies of objects, checked against the scene.

use bytes::Bytes;
use rayherd_render::film::{FilmPart, Layout};
use rayherd_render::ray::PathKey;

use crate::flight::{Flights, PathFlight, ShadowFlight};
use crate::job::PreparedScene;
use crate::wire::WireError;
use crate::wire::envelope::{Compress, Kind, open, seal};

/// Largest film of this layout, bytes: 96 of sums a pixel and 16 for each sum of its AOVs, with their heads, and what comes once.
fn film_limit(Layout { size: [width, height], aovs }: Layout) -> usize {
    (width as usize * height as usize).saturating_mul(128 + 20 * aovs.sums()).saturating_add(1 << 20)
}

/// Whether rays name only splits and cells that the scene has, and are made of numbers that a ray can be made of: what is none there would be taken
/// for a miss, for a path without a density or for light that nothing is in the way of, so that the picture would be wrong and nothing would
/// tell. Light that is no number (throughput, contribution) is left to the film, which counts it and names its sample, wherever it came from.
pub fn check_rays(scene: &PreparedScene, rays: &Flights) -> Result<(), WireError> {
    let (splits, cells) = (scene.splits(), scene.grid.occupied());
    let visits = rays.paths.iter().map(|f| f.visit).chain(rays.shadows.iter().map(|f| f.visit));
    let lost = rays.paths.iter().any(|f| f.candidate.is_hit() && f.candidate.split >= splits);
    if lost || visits.into_iter().any(|v| v.progress.0 > cells) {
        return Err(WireError::corrupt("a ray names a split or a cell that the scene lacks"));
    }
    let paths = rays.paths.iter().map(|f| (f.ray.key, wrong_path(f)));
    let shadows = rays.shadows.iter().map(|f| (f.ray.key, wrong_shadow(f)));
    match paths.chain(shadows).find_map(|(key, wrong)| Some((key, wrong?))) {
        None => Ok(()),
        Some((PathKey { pixel, sample, vertex, .. }, what)) => Err(WireError::corrupt(format!(
            "vertex {vertex} of sample {sample} of pixel {pixel} has {what} that no ray has"
        ))),
    }
}

/// What of a path's ray is no number that it can be.
fn wrong_path(flight: &PathFlight) -> Option<&'static str> {
    let (ray, candidate) = (&flight.ray, &flight.candidate);
    if ray.o.iter().any(|x| !x.is_finite()) {
        return Some("an origin");
    }
    // NaN is not at least 0
    if !at_least_0(ray.pdf) {
        return Some("a density");
    }
    (candidate.is_hit() && !(at_least_0(candidate.t) && candidate.t.is_finite())).then_some("a hit")
}

/// The same of a shadow ray, which ends nowhere if its light is a sky.
fn wrong_shadow(flight: &ShadowFlight) -> Option<&'static str> {
    if flight.ray.o.iter().any(|x| !x.is_finite()) {
        return Some("an origin");
    }
    (!at_least_0(flight.ray.tmax)).then_some("an end")
}

/// False for NaN.
fn at_least_0(x: f32) -> bool {
    x >= 0.0
}

/// An encoded film part as an object.
pub fn seal_film(part: &[u8]) -> Bytes {
    seal(Kind::FilmPart, part, Compress::Lz4)
}

/// An encoded film part from an object, checked: [`FilmPart::add_encoded`] takes it.
pub fn open_film(layout: Layout, body: &[u8]) -> Result<Vec<u8>, WireError> {
    let part = open(Kind::FilmPart, body, film_limit(layout))?;
    FilmPart::check(&part, layout).map_err(|e| WireError::corrupt(e.to_string()))?;
    Ok(part)
}
