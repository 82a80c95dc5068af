//! AOVs of whole jobs: the same bytes however they are made, and the picture beside them as without.

use std::num::NonZeroU32;
use std::sync::Arc;

use rayherd_render::aov::{Aov, Aovs};
use rayherd_render::bvh::Kernel;
use rayherd_render::frame::Frame;

use super::*;
use crate::job::{Commits, NodeSpec, Silent};
use crate::plan::Strategy;
use crate::report::Kind;
use crate::store::MemoryStore;
use crate::testing;

fn sampling(spp: u32) -> Sampling {
    Sampling { spp, target_error: None, time_limit: None }
}

fn plain() -> JobSettings {
    JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() }
}

/// Many small tasks on nodes that hold two splits each.
fn settings(scene: &PreparedScene, strategy: Strategy, slots: &[u32]) -> JobSettings {
    let largest = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap();
    JobSettings {
        strategy,
        nodes: slots.iter().map(|&slots| NodeSpec { slots }).collect(),
        replicas: slots.len().min(2) as u32,
        memory_per_node: Some(2 * largest),
        threads: NonZeroU32::new(2),
        task_seconds: 0.01,
        batch: 300,
        ray_buffer: 1 << 16,
        ..JobSettings::default()
    }
}

fn with_store(store: &Arc<MemoryStore>, resume: bool, settings: &JobSettings) -> JobSettings {
    JobSettings { commits: Some(Commits { store: store.clone(), resume, takeover: false }), ..settings.clone() }
}

#[test]
fn they_are_the_same_bytes_whatever_the_strategy_nodes_splits_and_faults() {
    let folder = tempfile::tempdir().unwrap();
    for (name, description) in [("cornell", testing::cornell()), ("textured", testing::textured(folder.path()))] {
        let whole = testing::prepared(&description, 1, true);
        let frame = Frame { aovs: Aovs::ALL, ..testing::frame(&whole, [38, 20], 2) };
        let expected = render_local(&whole, &frame, &sampling(3), &plain(), &Silent).unwrap();
        let channels = expected.film.channels(3, whole.manifest.offset);
        let names: Vec<&str> = channels.iter().map(|c| c.name).collect();
        assert_eq!(names, Aov::ALL.iter().flat_map(|a| a.channels()).copied().collect::<Vec<_>>());
        assert!(channels.iter().all(|c| c.values.len() == 38 * 20 && c.values.iter().any(|&x| x != 0.0)));
        // the picture, its error and its counts are those of a job without
        let without = Frame { aovs: Aovs::NONE, ..frame.clone() };
        let without = render_local(&whole, &without, &sampling(3), &plain(), &Silent).unwrap();
        assert!(without.image == expected.image && without.report.rel_mse == expected.report.rel_mse);
        assert_eq!(without.report.rays, expected.report.rays);
        let mut light = expected.film.clone();
        light.keep_aovs(Aovs::NONE);
        assert!(light == without.film);
        let mut n = 0;
        for (splits, reduced) in [(1, true), (5, true), (5, false)] {
            let scene = testing::prepared(&description, splits, reduced);
            for strategy in Strategy::ALL {
                for slots in [&[1][..], &[2, 1, 1]] {
                    n += 1;
                    let faults = (n % 2 == 0).then(|| faults::Faults::new(n));
                    let settings = JobSettings { faults, ..settings(&scene, strategy, slots) };
                    let made = render_local(&scene, &frame, &sampling(3), &settings, &Silent);
                    let made = made.unwrap_or_else(|e| panic!("{name}, {settings:?}: {e}"));
                    assert!(made.film == expected.film, "{name}, {settings:?} on {splits} splits");
                }
            }
        }
    }
}

#[test]
fn they_go_on_with_their_picture_and_no_other() {
    let description = testing::cornell();
    let scene = testing::prepared(&description, 4, true);
    let frame = Frame { aovs: Aovs::ALL, ..testing::frame(&scene, [38, 20], 2) };
    let longer = render_local(&scene, &frame, &sampling(5), &plain(), &Silent).unwrap();
    for strategy in Strategy::ALL {
        let store = Arc::new(MemoryStore::default());
        let settings = settings(&scene, strategy, &[1, 2]);
        render_local(&scene, &frame, &sampling(2), &with_store(&store, false, &settings), &Silent).unwrap();
        let more = render_local(&scene, &frame, &sampling(5), &with_store(&store, true, &settings), &Silent).unwrap();
        assert!(more.film == longer.film && more.report.tasks_reused > 0, "{strategy}");
        let other = Frame { aovs: [Aov::Depth].into_iter().collect(), ..frame.clone() };
        assert_ne!(scene.image_name(&other).unwrap(), scene.image_name(&frame).unwrap());
        let other = render_local(&scene, &other, &sampling(5), &with_store(&store, true, &settings), &Silent);
        assert!(matches!(other, Err(JobError::Chain(_))));
    }
}

/// What is stored of a film without AOVs is what it is with a program that knows of none; of one with them it is more.
#[test]
fn without_any_no_byte_is_stored_for_them() {
    let scene = testing::prepared(&testing::cornell(), 4, true);
    let frame = testing::frame(&scene, [38, 20], 2);
    let stored = |aovs: Aovs| {
        let settings = JobSettings { threads: NonZeroU32::new(1), ..settings(&scene, Strategy::Auto, &[1, 1]) };
        let made = render_local(&scene, &Frame { aovs, ..frame.clone() }, &sampling(2), &settings, &Silent).unwrap();
        let of = |kind: Kind| made.report.bytes.iter().filter(|r| r.kind == kind).map(|r| r.bytes).sum::<u64>();
        // the number of tasks follows the clock, the size of a part of the film does not
        (crate::task::codec::seal_film(&made.film.encode()).len(), of(Kind::Film), made.report.skips["aovs"])
    };
    let (plain, film, skipped) = stored(Aovs::NONE);
    let (with, more, none) = stored(Aovs::ALL);
    assert!(plain < with && film < more, "{plain}, {with}, {film}, {more}");
    assert!(skipped > 38 * 20 * 2 && none == 0, "{skipped}, {none}");
    // the variance is the picture's own: not a byte of the film
    let (variance, _, _) = stored([Aov::Variance].into_iter().collect());
    assert!(variance <= plain + 8, "{variance}, {plain}");
}

#[test]
fn numbers_that_a_float_does_not_hold_are_refused() {
    let mut scene = testing::prepared(&testing::cornell(), 1, true);
    let shape = scene.world.shapes[0].clone();
    scene.world.shapes.resize((1 << 24) + 1, shape);
    let frame = Frame { aovs: [Aov::ObjectId].into_iter().collect(), ..testing::frame(&scene, [2, 2], 1) };
    let error = check(&scene, &frame, &sampling(1), &plain()).unwrap_err();
    assert!(error.is_users() && error.to_string().contains("objectId"), "{error}");
    let frame = Frame { aovs: [Aov::Depth].into_iter().collect(), ..frame };
    check(&scene, &frame, &sampling(1), &plain()).unwrap();
}
