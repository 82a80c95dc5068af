//! Rays on their way between splits.

use rayherd_render::path::{PathRay, ShadowRay};
use rayherd_render::ray::{PrimId, Ray};
use rayherd_render::skip::{Skip, Skips};
use rayherd_scene::grid::{Grid, Outside, Progress};

/// The nearest hit that a ray found so far.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Ray parameter; infinity for none.
    pub t: f32,
    /// Global id of the primitive.
    pub prim: PrimId,
    /// A split that holds it.
    pub split: u32,
}

impl Candidate {
    /// Nothing was hit.
    pub const NONE: Candidate = Candidate { t: f32::INFINITY, prim: PrimId::MAX, split: u32::MAX };

    /// Whether something was hit.
    pub fn is_hit(&self) -> bool {
        self.split != u32::MAX
    }
    /// Whether this one is nearer: by distance, then by id, so that the order of splits does not matter.
    pub fn before(&self, other: &Candidate) -> bool {
        self.t < other.t || (self.t == other.t && self.prim < other.prim)
    }
}

/// How far a ray has come: the last cell that it was sent to, and which of its owners.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Visit {
    /// The last cell.
    pub progress: Progress,
    /// Place of the split among the cell's owners; [`Visit::DECIDED`]'s when no cell is left to visit.
    pub owner: u16,
}

impl Visit {
    /// No cell yet.
    pub const START: Visit = Visit { progress: Progress::START, owner: 0 };
    /// All cells were visited: the candidate is the hit, and the ray goes where its attributes are.
    pub const DECIDED: Visit = Visit { progress: Progress::START, owner: u16::MAX };

    /// Where a ray goes next that was tested against what is resident: the split, and how far it will be then. None when
    /// nothing `outside` can be hit at or before `ray.tmax`. `missed` as in [`Grid::next_foreign_counted`].
    pub fn next(self, grid: &Grid, ray: &Ray, outside: &Outside, missed: &mut u64) -> Option<(u32, Visit)> {
        if self == Visit::DECIDED {
            return None;
        }
        let resident = outside.resident();
        let foreign = |owners: &[u32], from: usize| {
            owners.iter().enumerate().skip(from).find(|(_, s)| !resident.contains(**s)).map(|(i, &s)| (s, i as u16))
        };
        // a cell with several owners is visited once for each
        if let Some(cell) = self.progress.0.checked_sub(1)
            && let Some((split, owner)) = foreign(grid.owners(cell), usize::from(self.owner) + 1)
        {
            return Some((split, Visit { progress: self.progress, owner }));
        }
        let cell = grid.next_foreign_counted(ray, self.progress, outside, missed)?;
        let (split, owner) = foreign(cell.owners, 0)?;
        Some((split, Visit { progress: cell.progress, owner }))
    }
}

/// A path's ray on its way, looking for its nearest hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathFlight {
    /// The ray.
    pub ray: PathRay,
    /// Nearest hit so far.
    pub candidate: Candidate,
    /// How far it is.
    pub visit: Visit,
}

impl PathFlight {
    /// A ray that was just made.
    pub fn new(ray: PathRay) -> Self {
        PathFlight { ray, candidate: Candidate::NONE, visit: Visit::START }
    }

    /// For kernel and grid: no farther than the hit that it has, if that is a reason not to look.
    pub fn bounded(&self, skips: Skips) -> Ray {
        let tmax = if skips.makes(Skip::Beaten) { self.candidate.t } else { f32::INFINITY };
        Ray { tmax, ..self.ray.ray() }
    }
}

/// A shadow ray on its way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShadowFlight {
    /// The ray.
    pub ray: ShadowRay,
    /// How far it is.
    pub visit: Visit,
}

/// Rays that travel together.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flights {
    /// Looking for their nearest hit.
    pub paths: Vec<PathFlight>,
    /// Asking whether anything is in the way.
    pub shadows: Vec<ShadowFlight>,
}

impl Flights {
    /// How many rays.
    pub fn len(&self) -> usize {
        self.paths.len() + self.shadows.len()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty() && self.shadows.is_empty()
    }
    /// Memory that they take, about.
    pub fn memory(&self) -> u64 {
        (self.paths.len() * size_of::<PathFlight>() + self.shadows.len() * size_of::<ShadowFlight>()) as u64
    }
    /// Takes all of another's rays.
    pub fn append(&mut self, other: &mut Flights) {
        self.paths.append(&mut other.paths);
        self.shadows.append(&mut other.shadows);
    }
}
