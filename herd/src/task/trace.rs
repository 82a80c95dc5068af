//! The trace loop: rays in, contributions to the film, rays that leave.
//!
//! Depth first in time: the newest rays are traced first, and camera rays are made only to fill up a batch, so what
//! is in memory is bounded by the batch and the siblings of a first hit, not by the task.

use rayherd_render::bvh::{Kernel, Tracer, UnsupportedKernel};
use rayherd_render::film::BoundedFilm;
use rayherd_render::path::{Context, Outcome, PathRay, Surface, Surfaces, shade, shade_traced, take_aovs};
use rayherd_render::ray::{Hit, MISS, PrimId, Ray};
use rayherd_render::skip::{Skip, SkipCounts, Skips};
use rayherd_scene::grid::{Grid, Outside};

use super::CameraFeed;
use crate::flight::{Candidate, Flights, PathFlight, ShadowFlight, Visit};
use crate::job::JobError;
use crate::profile::{Clock, Part};
use crate::report::RayCounts;
use crate::resident::Resident;

/// Where rays go that leave the resident splits.
pub trait Outbox {
    /// A path's ray for a split.
    fn path(&mut self, to: u32, flight: PathFlight) -> Result<(), JobError>;
    /// A shadow ray for a split.
    fn shadow(&mut self, to: u32, flight: ShadowFlight) -> Result<(), JobError>;
}

/// The surfaces of a task's splits, to be had once a hit is to be shaded.
pub trait Shading {
    /// Of this kind.
    type Surfaces: Surfaces;
    /// They.
    ///
    /// # Errors
    /// When they cannot be read.
    fn surfaces(&self) -> Result<&Self::Surfaces, JobError>;
}

/// Of rays none of which hits anything.
struct NoSurfaces;

impl Surfaces for NoSurfaces {
    fn surface(&self, _: usize, _: &Hit) -> Surface {
        unreachable!("a miss has no surface")
    }
    fn shape(&self, _: usize, _: &Hit) -> u32 {
        unreachable!("a miss has no shape")
    }
    fn prim(&self, _: usize, _: &Hit) -> PrimId {
        unreachable!("a miss has no primitive")
    }
}

/// Asked between batches: an error ends the task (it was killed, the job is over).
pub trait Stop {
    /// Whether to go on.
    fn check(&self) -> Result<(), JobError>;
}

/// Most rays of a batch: with hits and what comes of them, some 300 bytes each, they stay in the second cache. Eight times as many take
/// a tenth longer (docs/benchmarks/tried.md).
const MOST: usize = 2048;

/// Buffers and counts of one thread's loop.
pub struct Loop {
    tracer: Tracer,
    batch: usize,
    /// Rays that were made and traced here; a ray is counted by the task that makes it.
    pub rays: RayCounts,
    /// What its stages cost, if that was asked for.
    pub clock: Clock,
    rays_in: Vec<Ray>,
    hits: Vec<Hit>,
    occluded: Vec<bool>,
    outcome: Outcome,
    skips: Skips,
    skipped: SkipCounts,
    /// Cells whose tight boxes rays missed.
    cells: u64,
}

impl Loop {
    /// A loop that traces `batch` rays together, or 1 or [`MOST`] if it is out of this range.
    pub fn new(kernel: Kernel, batch: usize, skips: Skips, clock: Clock) -> Result<Self, UnsupportedKernel> {
        Ok(Loop {
            tracer: Tracer::new(kernel)?,
            batch: batch.clamp(1, MOST),
            rays: RayCounts::default(),
            clock,
            rays_in: Vec::new(),
            hits: Vec::new(),
            occluded: Vec::new(),
            outcome: Outcome::default(),
            skips,
            skipped: SkipCounts::default(),
            cells: 0,
        })
    }

    /// What was left out.
    pub fn skipped(&self) -> SkipCounts {
        let mut all = self.skipped;
        all += &self.outcome.counters.skips();
        all.add(Skip::Cells, self.cells);
        all.add(Skip::Merged, self.rays.merged);
        all
    }

    /// Traces everything to its end, where no ray can leave: the plain loop, which nothing beside it slows down.
    ///
    /// The flights must have no candidate elsewhere, as all splits are here.
    pub fn run_complete<S: Shading>(
        &mut self,
        context: &Context,
        resident: &Resident,
        shading: &S,
        flights: &mut Flights,
        camera: &mut CameraFeed,
        film: &mut BoundedFilm,
        stop: &dyn Stop,
    ) -> Result<(), JobError> {
        let forest = resident.forest();
        let mut pending: Vec<PathRay> = flights.paths.drain(..).map(|f| f.ray).collect();
        let mut rays: Vec<Ray> = pending.iter().map(PathRay::ray).collect();
        for flight in flights.shadows.drain(..) {
            self.outcome.shadow.push(flight.ray);
            self.outcome.shadow_rays.push(flight.ray.ray());
        }
        loop {
            stop.check()?;
            self.skipped.add(Skip::Walk, self.outcome.shadow.len() as u64);
            self.clock.start();
            self.occlude(resident, film);
            let from = pending.len().saturating_sub(self.batch);
            let waiting = pending.len();
            camera.fill_traced(&mut pending, &mut rays, from + self.batch);
            self.count_camera((pending.len() - waiting) as u64, context);
            self.clock.lap(Part::Camera, pending.len() - waiting);
            if pending.is_empty() {
                return Ok(());
            }
            self.hits.resize(pending.len() - from, Hit::miss(0.0));
            // the camera's come last
            let (hits, camera_hits) = self.hits.split_at_mut(waiting - from);
            self.tracer.closest(forest, &rays[from..waiting], hits);
            self.tracer.closest_coherent(forest, &rays[waiting..], camera_hits);
            self.clock.lap(Part::Closest, self.hits.len());
            self.skipped.add(Skip::Walk, self.hits.len() as u64);
            let (paths, traced, hits, out) = (&pending[from..], &rays[from..], &self.hits, &mut self.outcome);
            if hits.iter().any(Hit::is_hit) {
                let surfaces = shading.surfaces()?;
                self.clock.lap(Part::Load, 0);
                shade_traced(context, surfaces, paths, traced, hits, out);
                beside_light(context, surfaces, paths, hits, out, film, &mut self.skipped);
            } else {
                shade_traced(context, &NoSurfaces, paths, traced, hits, out);
            }
            self.clock.lap(Part::Shading, paths.len());
            pending.truncate(from);
            rays.truncate(from);
            self.collect(film);
            pending.append(&mut self.outcome.next);
            rays.append(&mut self.outcome.next_rays);
        }
    }

    /// Adds what was shaded to the film, and counts the rays that it made.
    fn collect(&mut self, film: &mut BoundedFilm) {
        let items = self.outcome.light.len();
        film.add_all(self.outcome.light.drain(..).map(|l| (l.pixel, l.sample, l.value)));
        self.clock.lap(Part::Film, items);
        self.rays.closest += self.outcome.next.len() as u64;
        self.rays.shadow += self.outcome.shadow.len() as u64;
    }

    /// Traces the shadow rays of the last batch where nothing else can be in the way.
    fn occlude(&mut self, resident: &Resident, film: &mut BoundedFilm) {
        let (shadows, rays) = (&mut self.outcome.shadow, &mut self.outcome.shadow_rays);
        self.occluded.resize(shadows.len(), false);
        self.tracer.any(resident.forest(), rays, &mut self.occluded);
        self.clock.lap(Part::Shadow, shadows.len());
        let seen = shadows.iter().zip(&self.occluded).filter(|(_, occluded)| !**occluded);
        film.add_all(seen.map(|(s, _)| (s.key.pixel, s.key.sample, s.contribution)));
        self.clock.lap(Part::Film, self.occluded.iter().filter(|occluded| !**occluded).count());
        shadows.clear();
        rays.clear();
    }

    /// Traces rays until all have ended or left the resident splits.
    pub fn run<S: Shading>(
        &mut self,
        context: &Context,
        grid: &Grid,
        resident: &Resident,
        shading: &S,
        flights: &mut Flights,
        camera: &mut CameraFeed,
        film: &mut BoundedFilm,
        outbox: &mut dyn Outbox,
        stop: &dyn Stop,
    ) -> Result<(), JobError> {
        let outside = grid.outside(resident.splits());
        let mut current: Vec<PathFlight> = Vec::new();
        let mut made: Vec<PathRay> = Vec::new();
        let (mut ready, mut ready_hits): (Vec<PathRay>, Vec<Hit>) = Default::default();
        loop {
            stop.check()?;
            while flights.shadows.len() >= self.batch || (flights.paths.is_empty() && !flights.shadows.is_empty()) {
                let from = flights.shadows.len().saturating_sub(self.batch);
                let batch: Vec<ShadowFlight> = flights.shadows.drain(from..).collect();
                self.shadows(grid, &outside, resident, &batch, film, outbox)?;
            }
            let from = flights.paths.len().saturating_sub(self.batch);
            current.clear();
            current.extend(flights.paths.drain(from..));
            if current.is_empty() {
                made.clear();
                self.clock.start();
                camera.fill(&mut made, self.batch);
                self.count_camera(made.len() as u64, context);
                self.clock.lap(Part::Camera, made.len());
                current.extend(made.iter().map(|&r| PathFlight::new(r)));
            }
            if current.is_empty() && flights.shadows.is_empty() {
                return Ok(());
            }
            self.closest(resident, &mut current);
            ready.clear();
            ready_hits.clear();
            for (flight, hit) in current.iter().zip(&self.hits) {
                let ray = flight.bounded(self.skips);
                if let Some((to, visit)) = flight.visit.next(grid, &ray, &outside, &mut self.cells) {
                    outbox.path(to, PathFlight { visit, ..*flight })?;
                } else if flight.candidate.is_hit() && !hit.is_hit() {
                    if flight.visit == Visit::DECIDED {
                        return Err(absent(flight));
                    }
                    outbox.path(flight.candidate.split, PathFlight { visit: Visit::DECIDED, ..*flight })?;
                } else {
                    ready.push(flight.ray);
                    ready_hits.push(*hit);
                }
            }
            self.clock.lap(Part::Walk, current.len());
            if ready_hits.iter().any(Hit::is_hit) {
                let (surfaces, out) = (shading.surfaces()?, &mut self.outcome);
                self.clock.lap(Part::Load, 0);
                shade(context, surfaces, &ready, &ready_hits, out);
                beside_light(context, surfaces, &ready, &ready_hits, out, film, &mut self.skipped);
            } else {
                shade(context, &NoSurfaces, &ready, &ready_hits, &mut self.outcome);
            }
            self.clock.lap(Part::Shading, ready.len());
            self.collect(film);
            self.take_spawned(flights);
        }
    }

    /// Traces a batch and updates its candidates. Afterwards a hit is one of `self.hits` when the candidate is here, and a
    /// miss when there is none or it is elsewhere.
    pub fn closest(&mut self, resident: &Resident, batch: &mut [PathFlight]) {
        self.clock.start();
        self.rays_in.clear();
        let skips = self.skips;
        self.rays_in.extend(batch.iter().map(|f| f.bounded(skips)));
        self.hits.resize(batch.len(), Hit::miss(0.0));
        // a camera's come in batches of their own
        if batch.iter().all(|f| f.ray.key.vertex == 0) {
            self.tracer.closest_coherent(resident.forest(), &self.rays_in, &mut self.hits);
        } else {
            self.tracer.closest(resident.forest(), &self.rays_in, &mut self.hits);
        }
        let mut beaten = 0;
        for (flight, hit) in batch.iter_mut().zip(&mut self.hits) {
            if !hit.is_hit() {
                beaten += u64::from(flight.candidate.is_hit());
                continue;
            }
            let prim = resident.forest().prim_id(hit.prim);
            let found = Candidate { t: hit.t, prim, split: resident.split_of(hit.prim) };
            if found.before(&flight.candidate) || (found.t == flight.candidate.t && found.prim == flight.candidate.prim)
            {
                flight.candidate = found;
            } else {
                // the candidate goes first: its primitive is not here
                hit.prim = MISS;
            }
        }
        if skips.makes(Skip::Beaten) {
            self.skipped.add(Skip::Beaten, beaten);
        }
        self.clock.lap(Part::Closest, batch.len());
    }

    /// Ends a path that leaves the scene. Its time is the caller's: a clock for one ray would cost as much as the ray.
    pub fn miss(&mut self, context: &Context, ray: PathRay, film: &mut BoundedFilm) {
        shade(context, &NoSurfaces, &[ray], &[Hit::miss(f32::INFINITY)], &mut self.outcome);
        self.clock.count(Part::Shading, 1);
        self.clock.count(Part::Film, self.outcome.light.len());
        // nothing was hit, so nothing goes on
        film.add_all(self.outcome.light.drain(..).map(|l| (l.pixel, l.sample, l.value)));
    }

    /// Traces shadow rays: those that pass go on, or bring their light.
    fn shadows(
        &mut self,
        grid: &Grid,
        outside: &Outside,
        resident: &Resident,
        batch: &[ShadowFlight],
        film: &mut BoundedFilm,
        outbox: &mut dyn Outbox,
    ) -> Result<(), JobError> {
        self.clock.start();
        self.occluded.resize(batch.len(), false);
        self.rays_in.clear();
        self.rays_in.extend(batch.iter().map(|f| f.ray.ray()));
        self.tracer.any(resident.forest(), &self.rays_in, &mut self.occluded);
        self.clock.lap(Part::Shadow, batch.len());
        let mut brought = 0;
        for (i, flight) in batch.iter().enumerate() {
            if self.occluded[i] {
                continue;
            }
            if let Some((to, visit)) = flight.visit.next(grid, &self.rays_in[i], outside, &mut self.cells) {
                outbox.shadow(to, ShadowFlight { visit, ..*flight })?;
            } else {
                let light = flight.ray.light();
                film.add(light.pixel, light.sample, light.value);
                brought += 1;
            }
        }
        self.clock.count(Part::Film, brought);
        self.clock.lap(Part::Walk, self.occluded.iter().filter(|occluded| !**occluded).count());
        Ok(())
    }

    /// Keeps the shadow rays that nothing here is in the way of.
    pub fn unoccluded(&mut self, resident: &Resident, batch: &[ShadowFlight], out: &mut Vec<ShadowFlight>) {
        self.clock.start();
        self.occluded.resize(batch.len(), false);
        self.rays_in.clear();
        self.rays_in.extend(batch.iter().map(|f| f.ray.ray()));
        self.tracer.any(resident.forest(), &self.rays_in, &mut self.occluded);
        self.clock.lap(Part::Shadow, batch.len());
        out.extend(batch.iter().zip(&self.occluded).filter(|(_, o)| !**o).map(|(f, _)| *f));
    }

    /// Shades rays whose hit was decided and is here; the rays that they spawn go to `out`.
    pub fn shade_decided<S: Surfaces>(
        &mut self,
        context: &Context,
        resident: &Resident,
        surfaces: &S,
        batch: &mut [PathFlight],
        out: &mut Flights,
        film: &mut BoundedFilm,
    ) -> Result<(), JobError> {
        self.closest(resident, batch);
        let rays: Vec<PathRay> = batch.iter().map(|f| f.ray).collect();
        if let Some(i) = self.hits.iter().position(|h| !h.is_hit()) {
            return Err(absent(&batch[i]));
        }
        shade(context, surfaces, &rays, &self.hits, &mut self.outcome);
        beside_light(context, surfaces, &rays, &self.hits, &self.outcome, film, &mut self.skipped);
        self.clock.lap(Part::Shading, rays.len());
        self.collect(film);
        self.take_spawned(out);
        Ok(())
    }

    fn take_spawned(&mut self, out: &mut Flights) {
        out.paths.extend(self.outcome.next.drain(..).map(PathFlight::new));
        let shadows = self.outcome.shadow.drain(..);
        out.shadows.extend(shadows.map(|ray| ShadowFlight { ray, visit: Visit::START }));
        self.outcome.clear();
    }

    /// Counts camera rays, as a [`CameraFeed`] made them.
    pub fn count_camera(&mut self, made: u64, context: &Context) {
        self.rays.closest += made;
        let siblings = u64::from(context.frame.split);
        if context.skips.makes(Skip::Merged) {
            self.rays.camera += made;
            // siblings share the camera ray that they would each have traced
            self.rays.merged += made * (siblings - 1);
        } else {
            self.rays.camera += made / siblings;
        }
    }

    /// Where a ray goes next; see [`Visit::next`].
    pub fn next(&mut self, visit: Visit, grid: &Grid, ray: &Ray, outside: &Outside) -> Option<(u32, Visit)> {
        visit.next(grid, ray, outside, &mut self.cells)
    }
}

/// What the film's AOVs want of a batch that was shaded: asked once for all of it.
fn beside_light<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    rays: &[PathRay],
    hits: &[Hit],
    shaded: &Outcome,
    film: &mut BoundedFilm,
    skipped: &mut SkipCounts,
) {
    if film.aovs().is_empty() {
        skipped.add(Skip::Aovs, rays.len() as u64);
    } else {
        take_aovs(context, surfaces, rays, hits, &shaded.shadow, film.aovs(), |aov, pixel, sample, values| {
            film.add_aov(aov, pixel, sample, values);
        });
    }
}

/// A ray came for a primitive that is not there.
fn absent(flight: &PathFlight) -> JobError {
    JobError::Internal(format!("split {} lacks primitive {}", flight.candidate.split, flight.candidate.prim))
}
