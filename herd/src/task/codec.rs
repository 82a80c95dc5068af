//! Rays and film parts as the bodies of objects, checked against the scene.

use bytes::Bytes;
use rayherd_render::film::{FilmPart, Layout};

use crate::flight::Flights;
use crate::job::PreparedScene;
use crate::wire::WireError;
use crate::wire::envelope::{Compress, Kind, open, seal};

/// Largest film of this layout, bytes: 96 of sums a pixel and 16 for each sum of its AOVs, with their heads, and what comes once.
fn film_limit(Layout { size: [width, height], aovs }: Layout) -> usize {
    (width as usize * height as usize).saturating_mul(128 + 20 * aovs.sums()).saturating_add(1 << 20)
}

/// Whether rays name only splits and cells that the scene has.
pub fn check_rays(scene: &PreparedScene, rays: &Flights) -> Result<(), WireError> {
    let (splits, cells) = (scene.splits(), scene.grid.occupied());
    let visits = rays.paths.iter().map(|f| f.visit).chain(rays.shadows.iter().map(|f| f.visit));
    let lost = rays.paths.iter().any(|f| f.candidate.is_hit() && f.candidate.split >= splits);
    if lost || visits.into_iter().any(|v| v.progress.0 > cells) {
        return Err(WireError::corrupt("a ray names a split or a cell that the scene lacks"));
    }
    Ok(())
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
