//! One attempt of a task, on the thread of a slot.

use std::cell::{OnceCell, RefCell};
use std::collections::BTreeMap;

use rayherd_render::aov::Aovs;
use rayherd_render::film::{BoundedFilm, FilmPart, Layout};
use rayherd_render::frame::Frame;
use rayherd_render::path::{Context, PathRay};
use rayherd_render::skip::{Skip, SkipCounts};
use serde::{Deserialize, Serialize};

use super::nodes::{NodeBlocks, Nodes};
use crate::flight::{Flights, PathFlight, ShadowFlight, Visit};
use crate::job::{JobError, JobSettings, PreparedScene};
use crate::ledger::{Destination, FilmRef, GroupRef, Outputs};
use crate::plan::Set;
use crate::profile::{Clock, Part, Profile};
use crate::report::Kind;
use crate::resident::{Lease, Resident, ResidentSurfaces};
use crate::task::codec;
use crate::task::groups::{GroupSink, Groups};
use crate::task::{CameraFeed, Loop, Outbox, Shading, Stop};
use crate::textures::TaskTextures;
use crate::wave::CameraUnit;
use crate::wire::ray_group;

/// What an attempt works on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// Name of its objects.
    pub name: String,
    /// Where it runs.
    pub node: u32,
    /// With what data.
    pub set: Set,
    /// Rays to trace.
    pub groups: Vec<GroupRef>,
    /// Camera rays to make.
    pub camera: Vec<CameraUnit>,
}

/// What an attempt made.
#[derive(Clone)]
pub struct Made {
    /// To be committed.
    pub outputs: Outputs,
    /// Its part of the film, where it is handed over in memory.
    pub film: Option<FilmPart>,
    /// Rays that left the split set.
    pub hops: u64,
    /// What it did not do.
    pub skipped: SkipCounts,
    /// What its stages cost, if that was asked for.
    pub profile: Option<Profile>,
}

/// What all attempts share.
pub struct Shared<'a> {
    /// The scene.
    pub scene: &'a PreparedScene,
    /// The picture.
    pub frame: &'a Frame,
    /// How the job runs.
    pub settings: &'a JobSettings,
    /// The nodes.
    pub nodes: Nodes<'a>,
    /// What becomes of the tasks' film.
    pub film: FilmUse,
    /// Number of buckets of the reduce step.
    pub buckets: u32,
}

/// What becomes of the film of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilmUse {
    /// It is handed over in memory, to whoever holds all of it; and stored as one part, if so.
    Handed {
        /// Whether it is stored.
        stored: bool,
    },
    /// It is stored only, a part for each band ([`crate::remote::bands`]).
    Banded {
        /// Tiles of a band.
        band: u32,
        /// The task holds as sums the memory of so many tiles of light at most.
        most: usize,
    },
}

impl Shared<'_> {
    fn context<'c>(&'c self, textures: &'c TaskTextures) -> Context<'c> {
        self.scene.context(self.frame).with(textures)
    }
    fn lease<'n>(&'n self, node: u32, set: &[u32]) -> Result<Lease<'n>, JobError> {
        let blocks = self.nodes.blocks(node);
        let bytes = set.iter().map(|&s| self.scene.split_bytes(s)).sum();
        let lease = self.nodes.memory(node).acquire(set, bytes, || Resident::load(self.scene, set, &blocks))?;
        if lease.warm {
            blocks.count_warm(set);
        }
        Ok(lease)
    }
}

struct Store<'a> {
    shared: &'a Shared<'a>,
    attempt: &'a Attempt,
    clock: RefCell<Clock>,
}

impl GroupSink for Store<'_> {
    fn store(&self, to: Destination, number: u32, rays: &Flights) -> Result<GroupRef, JobError> {
        let key = format!("rays/{}-{}-{number}", self.shared.scene.cut, self.attempt.name);
        let wrong = |source| JobError::Wire { key: key.clone(), source };
        let mut clock = self.clock.borrow_mut();
        clock.start();
        let body = ray_group::encode(self.shared.frame, rays).map_err(wrong)?;
        let bytes = body.len() as u64;
        let holders = self.shared.nodes.put(self.attempt.node, Kind::Rays, &key, body)?;
        clock.lap(Part::Rays, rays.len());
        Ok(GroupRef { key, to, rays: rays.len() as u32, bytes, holders })
    }
}

/// Runs an attempt to its end.
pub fn run(shared: &Shared, attempt: &Attempt, stop: &dyn Stop) -> Result<Made, JobError> {
    let clock = || Clock::new(shared.settings.profile);
    let sink = Store { shared, attempt, clock: RefCell::new(clock()) };
    let mut groups = Groups::new(&sink, shared.settings.ray_buffer);
    let skips = shared.scene.skips();
    let aovs = if skips.makes(Skip::Aovs) { shared.frame.aovs } else { Aovs::ALL };
    let mut film = BoundedFilm::new(
        Layout { aovs, ..shared.frame.layout() },
        match shared.film {
            FilmUse::Handed { .. } => usize::MAX,
            FilmUse::Banded { most, .. } => most,
        },
    );
    let mut camera = CameraFeed::new(shared.frame, attempt.camera.clone(), skips);
    let mut trace = Loop::new(shared.settings.kernel, shared.settings.batch as usize, skips, clock())?;
    let tiles = shared.nodes.blocks(attempt.node);
    let slots = shared.settings.nodes[attempt.node as usize].slots;
    let textures = TaskTextures::new(shared.scene, shared.nodes.tiles(attempt.node), &tiles, slots);
    let stop = Watch { stop, textures: &textures };
    let mut task = Task {
        shared,
        attempt,
        stop: &stop,
        textures: &textures,
        trace: &mut trace,
        camera: &mut camera,
        film: &mut film,
        unread: 0,
    };
    match &attempt.set {
        Set::Resident(set) => task.resident(set, &mut groups)?,
        Set::Any => task.any()?,
        Set::Sharing(split) => task.sharing(*split, &mut groups)?,
        Set::Reduce => task.reduce(&mut groups)?,
    }
    let unread = task.unread;
    textures.check()?;
    film.keep_aovs(shared.frame.aovs);
    if !skips.makes(Skip::Film) {
        film.touch_all();
    }
    let mut skipped = trace.skipped();
    skipped.add(Skip::Attributes, unread);
    skipped.add(Skip::Film, (film.tiles() - film.touched()) as u64);
    let hops = if attempt.set == Set::Reduce { 0 } else { groups.rays };
    let rays = trace.rays;
    let within = sink.clock.borrow().profile();
    let groups = groups.finish()?;
    let non_finite = film.rejected().count;
    trace.clock.start();
    let (parts, film) = store_film(shared, attempt, film)?;
    trace.clock.lap(Part::Store, parts.len());
    let mut profile = trace.clock.profile();
    if let (Some(all), Some(within), Some(stored)) = (&mut profile, within, sink.clock.borrow().profile()) {
        // groups that were full went to the store while rays were sent on
        all.less(Part::Walk, within.cpu_s());
        *all += &stored;
    }
    Ok(Made { outputs: Outputs { groups, film: parts, rays, non_finite }, film, hops, skipped, profile })
}

/// Stores the film as it is to be; its parts, and itself if it is to be handed over.
fn store_film(
    shared: &Shared,
    attempt: &Attempt,
    film: BoundedFilm,
) -> Result<(Vec<FilmRef>, Option<FilmPart>), JobError> {
    let mut parts = Vec::new();
    let mut store = |band: Option<u32>, part: Vec<u8>| {
        let name = &attempt.name;
        let key = band.map_or_else(|| format!("film/{name}"), |b| format!("film/{name}-b{b:05}"));
        let body = codec::seal_film(&part);
        let bytes = body.len() as u64;
        let holders = shared.nodes.put(attempt.node, Kind::Film, &key, body)?;
        parts.push(FilmRef { key, band, bytes, holders });
        Ok::<(), JobError>(())
    };
    match shared.film {
        FilmUse::Handed { stored } => {
            let film = film.into_part();
            if stored && !film.is_empty() {
                store(None, film.encode())?;
            }
            Ok((parts, Some(film)))
        }
        FilmUse::Banded { band: size, .. } => {
            let several = film.tiles() > size as usize;
            film.into_bands(size, |band, part| store(several.then_some(band), part))?;
            Ok((parts, None))
        }
    }
}

/// Stops also when a texture cannot be had: what is shaded without it is wrong.
struct Watch<'a> {
    stop: &'a dyn Stop,
    textures: &'a TaskTextures<'a>,
}

impl Stop for Watch<'_> {
    fn check(&self) -> Result<(), JobError> {
        self.textures.check()?;
        self.stop.check()
    }
}

struct Task<'a, 'f> {
    shared: &'a Shared<'a>,
    attempt: &'a Attempt,
    stop: &'a dyn Stop,
    textures: &'a TaskTextures<'a>,
    trace: &'a mut Loop,
    camera: &'a mut CameraFeed<'f>,
    film: &'a mut BoundedFilm,
    /// Splits that were used without their attributes.
    unread: u64,
}

/// A lease's surfaces: read when a hit is to be shaded, or at once.
struct Lazy<'l> {
    lease: &'l Lease<'l>,
    scene: &'l PreparedScene,
    blocks: &'l NodeBlocks<'l, 'l>,
    surfaces: OnceCell<ResidentSurfaces<'l>>,
}

impl<'l> Lazy<'l> {
    fn new(lease: &'l Lease<'l>, scene: &'l PreparedScene, blocks: &'l NodeBlocks<'l, 'l>) -> Result<Self, JobError> {
        let out = Lazy { lease, scene, blocks, surfaces: OnceCell::new() };
        if !scene.skips().makes(Skip::Attributes) {
            out.surfaces()?;
        }
        Ok(out)
    }

    /// How many splits were used without.
    fn unread(&self) -> u64 {
        if self.surfaces.get().is_none() { self.lease.splits().iter().count() as u64 } else { 0 }
    }
}

impl<'l> Shading for Lazy<'l> {
    type Surfaces = ResidentSurfaces<'l>;
    fn surfaces(&self) -> Result<&ResidentSurfaces<'l>, JobError> {
        if self.surfaces.get().is_none() {
            if self.lease.has_attributes() {
                self.blocks.count_warm_attributes(self.lease.splits().iter());
            }
            // nobody else sets it: a task has one thread
            let _ = self.surfaces.set(self.lease.surfaces(self.scene, self.blocks)?);
        }
        self.surfaces.get().ok_or_else(|| JobError::Internal("surfaces vanished".into()))
    }
}

impl<'a> Task<'a, '_> {
    /// Rays of a few batches: for tasks that hold all that they need, so that no more of them wait in memory than need to.
    fn few(&self) -> usize {
        4 * self.shared.settings.batch as usize
    }

    /// Rays that fill the ray buffer: for tasks that go through several splits, each of which is loaded once for all of these.
    fn many(&self) -> usize {
        (self.shared.settings.ray_buffer / size_of::<PathFlight>() as u64).max(1) as usize
    }

    /// The splits, in memory.
    fn lease(&mut self, set: &[u32]) -> Result<Lease<'a>, JobError> {
        self.trace.clock.start();
        let lease = self.shared.lease(self.attempt.node, set)?;
        self.trace.clock.lap(Part::Load, set.len());
        Ok(lease)
    }

    /// Hands the input rays over, `least` and at most one group more at a time, and at last what is left, maybe none, for the
    /// camera rays.
    fn inputs(
        &mut self,
        least: usize,
        mut each: impl FnMut(&mut Self, Flights) -> Result<(), JobError>,
    ) -> Result<(), JobError> {
        let mut flights = Flights::default();
        for group in &self.attempt.groups {
            let open = |body: &bytes::Bytes| {
                let rays = ray_group::decode(self.shared.frame, body)?;
                codec::check_rays(self.shared.scene, &rays)?;
                Ok(rays)
            };
            self.trace.clock.start();
            let mut rays = self.shared.nodes.get(self.attempt.node, Kind::Rays, &group.key, &group.holders, open)?;
            self.trace.clock.lap(Part::Rays, rays.len());
            flights.append(&mut rays);
            if flights.len() >= least {
                each(self, std::mem::take(&mut flights))?;
            }
        }
        each(self, flights)
    }

    fn resident(&mut self, set: &[u32], groups: &mut Groups) -> Result<(), JobError> {
        let (shared, node, stop) = (self.shared, self.attempt.node, self.stop);
        let lease = self.lease(set)?;
        let blocks = shared.nodes.blocks(node);
        let surfaces = Lazy::new(&lease, shared.scene, &blocks)?;
        let (context, grid) = (shared.context(self.textures), &shared.scene.grid);
        let complete = lease.is_complete() && context.skips.makes(Skip::Walk);
        self.inputs(self.few(), |t, mut flights| {
            if complete {
                t.trace.run_complete(&context, &lease, &surfaces, &mut flights, t.camera, t.film, stop)
            } else {
                t.trace.run(&context, grid, &lease, &surfaces, &mut flights, t.camera, t.film, groups, stop)
            }
        })?;
        self.unread += surfaces.unread();
        Ok(())
    }

    /// Demand driven: rays wait in the task for the splits that they need, which come and go one after the other.
    fn any(&mut self) -> Result<(), JobError> {
        let (shared, node, stop) = (self.shared, self.attempt.node, self.stop);
        let (context, grid) = (shared.context(self.textures), &shared.scene.grid);
        let limit = self.many();
        let mut queues = Queues::default();
        let mut none = CameraFeed::new(shared.frame, Vec::new(), context.skips);
        self.inputs(limit, |t, flights| {
            for ray in queues.route(shared, flights)? {
                t.trace.miss(&context, ray, t.film);
            }
            let mut made: Vec<PathRay> = Vec::new();
            loop {
                while queues.len() < limit {
                    made.clear();
                    t.trace.clock.start();
                    t.camera.fill(&mut made, shared.settings.batch as usize);
                    t.trace.clock.lap(Part::Camera, made.len());
                    if made.is_empty() {
                        break;
                    }
                    t.trace.count_camera(made.len() as u64, &context);
                    for &ray in &made {
                        match t.trace.next(Visit::START, grid, &ray.ray(), grid.everywhere()) {
                            Some((to, visit)) => queues.path(to, PathFlight { visit, ..PathFlight::new(ray) })?,
                            None => t.trace.miss(&context, ray, t.film),
                        }
                    }
                    t.trace.clock.lap(Part::Walk, made.len());
                }
                let Some((split, mut flights)) = queues.fullest() else { return Ok(()) };
                let lease = t.lease(&[split])?;
                let blocks = shared.nodes.blocks(node);
                let surfaces = Lazy::new(&lease, shared.scene, &blocks)?;
                t.trace.run(&context, grid, &lease, &surfaces, &mut flights, &mut none, t.film, &mut queues, stop)?;
                t.unread += surfaces.unread();
            }
        })
    }

    /// The scheduling grid without overlap reduction: a cell may have several owners, so rays are tested against all
    /// splits that share a cell with the chosen one, and a reduce step decides on the nearest hit.
    fn sharing(&mut self, split: u32, groups: &mut Groups) -> Result<(), JobError> {
        let (shared, node, stop) = (self.shared, self.attempt.node, self.stop);
        let (context, grid) = (shared.context(self.textures), &shared.scene.grid);
        let together = grid.sharing(split);
        let outside = grid.outside(&together.iter().copied().collect());
        let limit = self.many();
        self.inputs(limit, |t, mut flights| {
            loop {
                let room = limit.saturating_sub(flights.paths.len());
                let mut made: Vec<PathRay> = Vec::new();
                t.trace.clock.start();
                t.camera.fill(&mut made, room);
                t.trace.clock.lap(Part::Camera, made.len());
                t.trace.count_camera(made.len() as u64, &context);
                flights.paths.extend(made.iter().map(|&r| PathFlight::new(r)));
                if flights.is_empty() {
                    return Ok(());
                }
                t.shade_decided(split, &context, &mut flights)?;
                // what the node holds comes first: in a fixed order each split would drive out the one that is needed next
                let warm = shared.nodes.memory(node).warm();
                let (held, cold): (Vec<u32>, Vec<u32>) = together.iter().partition(|s| warm.contains(s));
                for &s in held.iter().chain(&cold) {
                    let lease = t.lease(&[s])?;
                    // nothing is shaded here: the hits are decided elsewhere
                    let blocks = shared.nodes.blocks(node);
                    t.unread += Lazy::new(&lease, shared.scene, &blocks)?.unread();
                    for batch in flights.paths.chunks_mut(shared.settings.batch as usize) {
                        stop.check()?;
                        t.trace.closest(&lease, batch);
                    }
                    for batch in std::mem::take(&mut flights.shadows).chunks(shared.settings.batch as usize) {
                        stop.check()?;
                        t.trace.unoccluded(&lease, batch, &mut flights.shadows);
                    }
                }
                let asked = flights.len();
                let mut brought = 0;
                t.trace.clock.start();
                for flight in flights.paths.drain(..) {
                    let next = t.trace.next(flight.visit, grid, &flight.bounded(context.skips), &outside);
                    let visit = next.map_or(Visit::DECIDED, |n| n.1);
                    let bucket = flight.ray.key.pixel % shared.buckets;
                    groups.add_path(Destination::Reduce(bucket), PathFlight { visit, ..flight })?;
                }
                for flight in flights.shadows.drain(..) {
                    match t.trace.next(flight.visit, grid, &flight.ray.ray(), &outside) {
                        Some((to, visit)) => groups.shadow(to, ShadowFlight { visit, ..flight })?,
                        None => {
                            let light = flight.ray.light();
                            t.film.add(light.pixel, light.sample, light.value);
                            brought += 1;
                        }
                    }
                }
                t.trace.clock.count(Part::Film, brought);
                t.trace.clock.lap(Part::Walk, asked);
            }
        })
    }

    /// Shades the rays whose hit was decided, in the split that holds it; what they spawn takes their place.
    fn shade_decided(&mut self, split: u32, context: &Context, flights: &mut Flights) -> Result<(), JobError> {
        let (mut decided, undecided): (Vec<PathFlight>, Vec<PathFlight>) =
            std::mem::take(&mut flights.paths).into_iter().partition(|f| f.visit == Visit::DECIDED);
        flights.paths = undecided;
        if decided.is_empty() {
            return Ok(());
        }
        let lease = self.lease(&[split])?;
        let blocks = self.shared.nodes.blocks(self.attempt.node);
        let shading = Lazy::new(&lease, self.shared.scene, &blocks)?;
        let surfaces = shading.surfaces()?;
        for batch in decided.chunks_mut(self.shared.settings.batch as usize) {
            self.stop.check()?;
            self.trace.shade_decided(context, &lease, surfaces, batch, flights, self.film)?;
        }
        Ok(())
    }

    /// Merges what map tasks found: of each ray the nearest candidate; it goes on to the next cell, or to its hit.
    fn reduce(&mut self, groups: &mut Groups) -> Result<(), JobError> {
        let (shared, context) = (self.shared, self.shared.context(self.textures));
        self.inputs(self.few(), |t, mut flights| {
            t.trace.clock.start();
            let merged = flights.len();
            flights.paths.sort_by_key(|f| (f.ray.key, f.candidate.t.to_bits(), f.candidate.prim));
            flights.paths.dedup_by_key(|f| f.ray.key);
            for flight in flights.paths.drain(..) {
                if let Some(cell) = flight.visit.progress.0.checked_sub(1) {
                    let owners = shared.scene.grid.owners(cell);
                    let to = owners.get(usize::from(flight.visit.owner)).copied();
                    let to = to.ok_or_else(|| JobError::Internal("a ray waits for an owner that is none".into()))?;
                    groups.path(to, flight)?;
                } else if flight.candidate.is_hit() {
                    groups.path(flight.candidate.split, flight)?;
                } else {
                    t.trace.miss(&context, flight.ray, t.film);
                }
            }
            t.trace.clock.lap(Part::Walk, merged);
            Ok(())
        })
    }
}

/// Rays that wait inside a task, by split.
#[derive(Default)]
struct Queues {
    waiting: BTreeMap<u32, Flights>,
    len: usize,
}

impl Queues {
    fn len(&self) -> usize {
        self.len
    }
    /// The split with most rays, with them.
    fn fullest(&mut self) -> Option<(u32, Flights)> {
        let (&split, _) = self.waiting.iter().max_by_key(|(s, f)| (f.len(), std::cmp::Reverse(**s)))?;
        let flights = self.waiting.remove(&split)?;
        self.len -= flights.len();
        Some((split, flights))
    }
    /// Rays from elsewhere, which wait for the cell that they were sent to, or for their hit's attributes. Returns those that hit
    /// nothing: a reduce step of another strategy, which an earlier run left, was to say so.
    fn route(&mut self, shared: &Shared, mut flights: Flights) -> Result<Vec<PathRay>, JobError> {
        let owner = |visit: Visit, decided: u32| match visit.progress.0.checked_sub(1) {
            Some(cell) => shared.scene.grid.owners(cell).get(usize::from(visit.owner)).copied(),
            None => Some(decided),
        };
        let lost = || JobError::Internal("a ray waits for an owner that is none".into());
        let mut missed = Vec::new();
        for flight in flights.paths.drain(..) {
            if flight.visit == Visit::DECIDED && !flight.candidate.is_hit() {
                missed.push(flight.ray);
                continue;
            }
            self.path(owner(flight.visit, flight.candidate.split).ok_or_else(lost)?, flight)?;
        }
        for flight in flights.shadows.drain(..) {
            self.shadow(owner(flight.visit, u32::MAX).filter(|&s| s != u32::MAX).ok_or_else(lost)?, flight)?;
        }
        Ok(missed)
    }
}

impl Outbox for Queues {
    fn path(&mut self, to: u32, flight: PathFlight) -> Result<(), JobError> {
        self.waiting.entry(to).or_default().paths.push(flight);
        self.len += 1;
        Ok(())
    }
    fn shadow(&mut self, to: u32, flight: ShadowFlight) -> Result<(), JobError> {
        self.waiting.entry(to).or_default().shadows.push(flight);
        self.len += 1;
        Ok(())
    }
}
