//! Allocations of the trace loop, counted: a further batch of rays takes none, however many come. A binary of its own, for its allocator.

#![allow(unsafe_code)]

mod example;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use rayherd_herd::flight::{Flights, PathFlight, ShadowFlight};
use rayherd_herd::job::{JobError, PreparedScene};
use rayherd_herd::profile::Clock;
use rayherd_herd::resident::{Resident, ResidentSurfaces};
use rayherd_herd::task::camera::tiles;
use rayherd_herd::task::{CameraFeed, Loop, Outbox, Shading, Stop};
use rayherd_herd::wave::CameraUnit;
use rayherd_render::bvh::Kernel;
use rayherd_render::film::BoundedFilm;
use rayherd_render::frame::Frame;
use rayherd_scene::prepare::{Cut, PrepareSettings};

/// What one thread allocated: how often, how much it holds, the most that it held.
#[derive(Clone, Copy, Default)]
struct Counts {
    calls: u64,
    held: i64,
    peak: i64,
}

thread_local! {
    static COUNTS: Cell<Counts> = const { Cell::new(Counts { calls: 0, held: 0, peak: 0 }) };
}

fn count(calls: u64, bytes: i64) {
    // a thread that is ending counts no more
    let _ = COUNTS.try_with(|counts| {
        let Counts { calls: before, held, peak } = counts.get();
        let held = held + bytes;
        counts.set(Counts { calls: before + calls, held, peak: peak.max(held) });
    });
}

/// The system's allocator, counted by thread.
struct Counted;

// SAFETY: every call goes to the system's allocator as it came; counting allocates nothing.
unsafe impl GlobalAlloc for Counted {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(1, layout.size() as i64);
        // SAFETY: the caller's promises are those that `System` asks for.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        count(0, -(layout.size() as i64));
        // SAFETY: `place` came from `System`, by `alloc` or `realloc` here.
        unsafe { System.dealloc(place, layout) }
    }
    unsafe fn realloc(&self, place: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(1, size as i64 - layout.size() as i64);
        // SAFETY: as in `dealloc`.
        unsafe { System.realloc(place, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counted = Counted;

/// Counts the batches: it is asked once for each.
struct Batches(Cell<u64>);

impl Stop for Batches {
    fn check(&self) -> Result<(), JobError> {
        self.0.set(self.0.get() + 1);
        Ok(())
    }
}

struct Ready<'a>(ResidentSurfaces<'a>);

impl<'a> Shading for Ready<'a> {
    type Surfaces = ResidentSurfaces<'a>;
    fn surfaces(&self) -> Result<&ResidentSurfaces<'a>, JobError> {
        Ok(&self.0)
    }
}

/// Rays that leave are gone: only what stays is counted.
struct Away;

impl Outbox for Away {
    fn path(&mut self, _: u32, _: PathFlight) -> Result<(), JobError> {
        Ok(())
    }
    fn shadow(&mut self, _: u32, _: ShadowFlight) -> Result<(), JobError> {
        Ok(())
    }
}

/// A scene whose tasks hold everything, or its first split of several.
struct Case {
    scene: PreparedScene,
    frame: Frame,
    resident: Resident,
}

impl Case {
    fn new(example: &str, splits: u32, held: usize) -> Self {
        let settings = PrepareSettings { cut: Cut::Splits(splits), ..PrepareSettings::default() };
        let (scene, frame) = example::prepared(example, 64, 8, &settings);
        let set: Vec<u32> = scene.grid.owning().iter().take(held).collect();
        let resident = Resident::load(&scene, &set, &scene).unwrap();
        Case { scene, frame, resident }
    }

    /// What a loop over so many samples a pixel allocates, and its batches.
    fn counted(&self, samples: u32) -> (Counts, u64) {
        let frame = &self.frame;
        let surfaces = Ready(self.resident.surfaces(&self.scene, &self.scene).unwrap());
        let skips = self.scene.skips();
        let units = (0..tiles(frame)).map(|tile| CameraUnit { tile, first: 0, end: samples }).collect();
        let stop = Batches(Cell::new(0));
        let before = COUNTS.get();
        COUNTS.set(Counts { peak: before.held, ..before });
        let mut camera = CameraFeed::new(frame, units, skips);
        let mut film = BoundedFilm::new(frame.layout(), usize::MAX);
        let mut trace = Loop::new(Kernel::Auto, 2048, skips, Clock::new(false)).unwrap();
        let (context, mut flights) = (self.scene.context(frame), Flights::default());
        if self.resident.is_complete() {
            trace
                .run_complete(&context, &self.resident, &surfaces, &mut flights, &mut camera, &mut film, &stop)
                .unwrap();
        } else {
            let grid = &self.scene.grid;
            trace
                .run(&context, grid, &self.resident, &surfaces, &mut flights, &mut camera, &mut film, &mut Away, &stop)
                .unwrap();
        }
        let after = COUNTS.get();
        assert!(trace.rays.camera == 64 * 64 * u64::from(samples), "{:?}", trace.rays);
        let counts = Counts {
            calls: after.calls - before.calls,
            held: after.held - before.held,
            peak: after.peak - before.held,
        };
        (counts, stop.0.get())
    }
}

#[test]
fn a_further_batch_of_rays_allocates_nothing() {
    for (example, splits, held) in [
        ("cornell-box.xml", 1, 1),
        ("still-life.xml", 1, 1),
        ("veach-mis.xml", 1, 1),
        // rays leave
        ("cornell-box.xml", 8, 3),
    ] {
        let case = Case::new(example, splits, held);
        let complete = case.resident.is_complete();
        assert_eq!(complete, splits == 1, "{example}");
        let (few, few_batches) = case.counted(16);
        let (many, many_batches) = case.counted(64);
        let batches = many_batches - few_batches;
        let more = many.calls.saturating_sub(few.calls);
        println!(
            "{example}, {held} of {splits}: {} and {} allocations in {few_batches} and {many_batches} batches, peaks {} and {}",
            few.calls, many.calls, few.peak, many.peak
        );
        assert!(batches > 50, "{example}: {batches} further batches");
        // buffers grow to the largest batch, some of them late; where rays can leave, a batch of shadow rays is a list of its own
        let bound = if complete { 4 } else { batches / 4 };
        assert!(more <= bound, "{example}: {more} allocations in {batches} further batches, {bound} at most");
        assert!(many.peak <= few.peak + few.peak / 4, "{example}: {} bytes, {} with 16 samples", many.peak, few.peak);
        assert!(many.peak <= 2 << 20, "{example}: {} bytes", many.peak);
    }
}
