//! Whether what was read makes a picture: something that can be hit, and something that gives light.

use super::PrepareError;
use crate::description::{Description, Geometry, Shape};
use crate::import::Survey;
use crate::manifest::Counts;

/// Dark lamps that are told of one by one, at most.
const MOST_TOLD: usize = 10;

/// What there was of a shape.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Had {
    /// Records.
    pub any: bool,
    /// And of them some that can be hit.
    pub usable: bool,
}

/// Whether an emission is light.
pub(super) fn emits(emission: Option<[f32; 3]>) -> bool {
    emission.is_some_and(|e| e.iter().any(|&x| x > 0.0))
}

/// What preparing will say of a scene that was surveyed; without errors what is to be told of lamps that give no light.
///
/// # Errors
/// [`PrepareError::Empty`] or [`PrepareError::Dark`].
pub fn foresee(description: &Description, survey: &Survey) -> Result<Vec<String>, PrepareError> {
    let counts = Counts {
        records: survey.sum(|s| s.triangles + s.spheres),
        degenerate: survey.sum(|s| s.flat),
        non_finite: survey.sum(|s| s.not_finite),
        out_of_range: survey.sum(|s| s.out_of_range),
        ..Counts::default()
    };
    let had = survey.shapes.iter().map(|s| Had { any: s.triangles + s.spheres > 0, usable: s.usable() > 0 });
    judge(description, &counts, &had.collect::<Vec<_>>())
}

/// Refuses a scene of which nothing can be seen, or nothing gives light; tells of lamps that give none.
pub(super) fn judge(description: &Description, counts: &Counts, had: &[Had]) -> Result<Vec<String>, PrepareError> {
    let shapes = || description.shapes.iter().zip(had);
    // lights that were added to a surface are no scene; lights alone that the source has are one
    let meant_dark = description.shapes.iter().any(|s| !emits(s.emission));
    if !shapes().any(|(s, had)| had.usable && !(meant_dark && emits(s.emission))) {
        let Counts { records, degenerate, non_finite, out_of_range, .. } = *counts;
        return Err(PrepareError::Empty { records, degenerate, non_finite, out_of_range });
    }
    let lamps = || shapes().filter(|(s, _)| emits(s.emission));
    let Some((first, _)) = lamps().find(|(_, had)| !had.usable) else { return Ok(Vec::new()) };
    let far = description.environment.is_some() || description.sun.is_some();
    if !far && description.beams.is_empty() && !lamps().any(|(_, had)| had.usable) {
        return Err(PrepareError::Dark { shape: first.name.clone(), place: first.place.clone() });
    }
    // a library of materials may well have a lamp that its mesh does not use
    let told = lamps().filter(|(s, had)| !had.usable && (had.any || !matches!(s.geometry, Geometry::Part)));
    let tell = |s: &Shape| {
        format!("{}: shape {:?} emits, but has no area that can be hit: it gives no light", s.place, s.name)
    };
    Ok(told.take(MOST_TOLD).map(|(s, _)| tell(s)).collect())
}
