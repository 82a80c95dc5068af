//! Textures through every strategy: the same bytes, counted, within their budget, and an error when they cannot be had.

use std::sync::Arc;

use rayherd_render::bvh::Kernel;
use rayherd_scene::import::{DescriptionSource, StreamOptions};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};

use super::*;
use crate::job::{NodeSpec, Silent};
use crate::plan::Strategy;
use crate::report::{Kind, Op, Place, Stage};
use crate::testing;

const SAMPLING: Sampling = Sampling { spp: 5, target_error: None, time_limit: None };

fn settings(strategy: Strategy, slots: &[u32], texture_memory: u64) -> JobSettings {
    JobSettings {
        strategy,
        nodes: slots.iter().map(|&slots| NodeSpec { slots }).collect(),
        replicas: slots.len().min(2) as u32,
        task_seconds: 0.01,
        batch: 300,
        ray_buffer: 1 << 16,
        texture_memory,
        ..JobSettings::default()
    }
}

fn read(report: &Report, place: Place) -> u64 {
    let rows = report.bytes.iter();
    let rows = rows.filter(|r| (r.stage, r.op, r.kind, r.place) == (Stage::Trace, Op::Read, Kind::Texture, place));
    rows.map(|r| r.bytes).sum()
}

#[test]
fn textures_are_the_same_bytes_whatever_the_strategy() {
    let folder = tempfile::tempdir().unwrap();
    let description = testing::textured(folder.path());
    let scenes = [(1, true), (5, true), (5, false)].map(|(n, r)| testing::prepared(&description, n, r));
    let frame = testing::frame(&scenes[0], [36, 24], 2);
    let plain = JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() };
    let expected = render_local(&scenes[0], &frame, &SAMPLING, &plain, &Silent).unwrap();
    // two images of 300 x 200 texels of three bytes in 3 x 2 tiles, whose bytes are the same, read raw or not
    let manifest = &scenes[0].manifest;
    assert_eq!((manifest.tiles.len(), manifest.texture_bytes()), (12, 180_000));
    assert_eq!(read(&expected.report, Place::Local), 360_000, "each tile once");
    assert_eq!(expected.report.nodes_detail[0].peak_texture_bytes, 360_000);
    let largest = manifest.tiles.iter().map(|t| t.bytes).max().unwrap();
    let mut n = 0;
    for scene in &scenes {
        for strategy in Strategy::ALL {
            for slots in [&[1][..], &[2, 1, 1]] {
                // one tile; some; all
                let budget = [1, 100_000, 1 << 28][n % 3];
                n += 1;
                let settings = settings(strategy, slots, budget);
                let made = render_local(scene, &frame, &SAMPLING, &settings, &Silent);
                let made = made.unwrap_or_else(|e| panic!("{settings:?}: {e}"));
                assert!(made.film == expected.film, "{settings:?} on {} splits", scene.splits());
                for node in &made.report.nodes_detail {
                    let held = budget.max(u64::from(node.slots + 1) * largest);
                    assert!(node.peak_texture_bytes <= held, "{settings:?}: {node:?}");
                }
                let read = read(&made.report, Place::Local) + read(&made.report, Place::Remote);
                assert!(if budget == 1 { read > 1 << 20 } else { read > 0 }, "{settings:?}: {read}");
            }
        }
    }
}

#[test]
fn a_tile_that_is_gone_or_broken_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let description = testing::textured(folder.path());
    for bytes in [None, Some(vec![1, 2, 3])] {
        let objects = Arc::new(MemoryObjects::default());
        let source = DescriptionSource::new(&description, StreamOptions::default());
        let (cut, spool) = (PrepareSettings::default(), SpoolSettings::default());
        let made = prepare(&description, &source, &cut, &spool, objects.as_ref(), &NoProgress).unwrap();
        let scene = PreparedScene::open(made.manifest, objects.clone()).unwrap();
        let tile = scene.manifest.tiles[0];
        objects.tamper(tile.hash, bytes);
        let frame = testing::frame(&scene, [36, 24], 1);
        for slots in [&[1][..], &[1, 1]] {
            let made = render_local(&scene, &frame, &SAMPLING, &settings(Strategy::Auto, slots, 1 << 28), &Silent);
            let error = made.err().expect("a picture without its texture");
            assert!(matches!(error, JobError::Object(_)), "{error}");
            assert!(error.to_string().contains(&tile.hash.to_string()), "{error}");
        }
    }
}
