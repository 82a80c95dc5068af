//! What a scene does not need: the same picture with it done and left out, and counters that tell.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use rayherd_render::aov::Aovs;
use rayherd_render::frame::Frame;
use rayherd_render::skip::{Skip, Skips};

use super::*;
use crate::job::{NodeSpec, Silent};
use crate::plan::Strategy;
use crate::report::{Kind, Op, Place, Stage};
use crate::testing;

/// A scene and how it is rendered.
struct Case {
    name: String,
    scene: PreparedScene,
    frame: Frame,
    settings: JobSettings,
    spp: u32,
}

/// Many small tasks on two nodes that hold two splits each.
fn settings(scene: &PreparedScene, strategy: Strategy) -> JobSettings {
    let largest = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap();
    JobSettings {
        strategy,
        nodes: vec![NodeSpec { slots: 1 }; 2],
        memory_per_node: (strategy != Strategy::Auto).then_some(2 * largest),
        threads: NonZeroU32::new(2),
        task_seconds: 0.01,
        batch: 300,
        ray_buffer: 1 << 16,
        ..JobSettings::default()
    }
}

/// The bundled scenes through all strategies, each in several splits; some with AOVs.
fn cases() -> Vec<Case> {
    let folder = tempfile::tempdir().unwrap();
    // its pictures are stored when it is prepared
    let textured = testing::textured(folder.path());
    let mut out = Vec::new();
    for (name, description, size, spp) in [
        ("cornell", testing::cornell(), [40, 24], 3),
        ("textured", textured, [2, 1], 1),
        ("lamps", testing::lamps(), [36, 12], 3),
        ("scan", testing::scan(), [36, 12], 3),
    ] {
        for strategy in Strategy::ALL {
            let reduced = matches!(strategy, Strategy::SchedulingGridOverlapReduced | Strategy::Auto);
            let scene = testing::prepared(&description, 9, reduced);
            let aovs = if out.len() % 3 == 0 { Aovs::ALL } else { Aovs::NONE };
            let frame = Frame { aovs, ..testing::frame(&scene, size, 3) };
            let settings = settings(&scene, strategy);
            out.push(Case { name: format!("{name}, {strategy}"), scene, frame, settings, spp });
        }
    }
    out
}

impl Case {
    fn render(&self, skips: Skips) -> JobOutcome {
        self.render_by(skips, &self.settings)
    }

    fn render_by(&self, skips: Skips, settings: &JobSettings) -> JobOutcome {
        let scene = PreparedScene::open(self.scene.manifest.clone(), self.scene.objects.clone()).unwrap();
        let sampling = Sampling { spp: self.spp, target_error: None, time_limit: None };
        render_local(&scene.skipping(skips), &self.frame, &sampling, settings, &Silent)
            .unwrap_or_else(|e| panic!("{}: {e}", self.name))
    }
}

fn same(a: &JobOutcome, b: &JobOutcome) -> bool {
    let bits = |o: &JobOutcome| o.image.pixels.as_flattened().iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
    let aovs = |o: &JobOutcome| o.film.channels(&o.samples, [0.0; 3]);
    (bits(a), aovs(a), a.film.rejected(), &a.samples) == (bits(b), aovs(b), b.film.rejected(), &b.samples)
}

/// Known to whoever prepares, and tested with the program (cli/tests/skips.rs); only where there is a target error (`allotted`).
const ELSEWHERE: [Skip; 3] = [Skip::Prepared, Skip::Volume, Skip::Tiles];

#[test]
fn what_is_left_out_changes_no_byte_and_is_counted() {
    let mut made: BTreeMap<Skip, u64> = BTreeMap::new();
    for (number, case) in cases().into_iter().enumerate() {
        let usual = case.render(Skips::ALL);
        let mut none = Skips::ALL;
        let (scene, strategy) = (number / Strategy::ALL.len(), number % Strategy::ALL.len());
        for (turn, skip) in Skip::ALL.into_iter().filter(|s| !ELSEWHERE.contains(s)).enumerate() {
            *made.entry(skip).or_default() += usual.report.skips[skip.name()];
            if !skip.keeps_bytes() {
                continue;
            }
            none = none.without(skip);
            // each alone on each scene, by one strategy or another
            if (turn + scene) % Strategy::ALL.len() != strategy {
                continue;
            }
            let other = case.render(Skips::ALL.without(skip));
            assert!(same(&usual, &other), "{}: without {} it is another picture", case.name, skip.name());
            assert_eq!(other.report.skips[skip.name()], 0, "{}: {} is switched off", case.name, skip.name());
        }
        let thorough = case.render(none);
        assert!(same(&usual, &thorough), "{}: without any it is another picture", case.name);
    }
    println!("{made:?}");
    let never: Vec<_> = made.iter().filter(|(_, n)| **n == 0).map(|(s, _)| s.name()).collect();
    assert!(never.is_empty(), "{never:?} was never left out");
}

/// What is done when it is not left out shows in what else is counted.
#[test]
fn what_is_not_left_out_is_done() {
    let cases = cases();
    let find = |name: &str| cases.iter().find(|c| c.name == name).unwrap();
    let reads = |o: &JobOutcome, kind| {
        let rows = o.report.bytes.iter();
        rows.filter(|r| (r.stage, r.op, r.kind) == (Stage::Trace, Op::Read, kind) && r.place != Place::Cache)
            .map(|r| r.bytes)
            .sum::<u64>()
    };
    let case = find("cornell, scheduling-grid-overlap-reduced");
    let usual = case.render(Skips::ALL);
    let without = |skip| case.render(Skips::ALL.without(skip));
    assert!(without(Skip::Cells).report.hops > usual.report.hops, "more cells are visited");
    assert!(without(Skip::Beaten).report.hops > usual.report.hops, "cells beyond are visited");
    let (rays, all) = (usual.report.rays, without(Skip::Shadows).report.rays);
    assert!(all.shadow > rays.shadow && all.closest == rays.closest, "{all:?}, {rays:?}");
    let apart = without(Skip::Merged).report.rays;
    assert_eq!((apart.closest, apart.camera, apart.merged), (rays.closest + rays.merged, rays.camera, 0));
    // on one node that holds all, whose reads do not hang on which task ends first
    let alone = |name: &str, skip, kind| {
        let case = find(name);
        let nodes = vec![NodeSpec { slots: 1 }];
        let threads = NonZeroU32::new(1);
        let settings = JobSettings { nodes, memory_per_node: None, threads, ..case.settings.clone() };
        let made = |skips| reads(&case.render_by(skips, &settings), kind);
        let [usual, all] = [Skips::ALL, Skips::ALL.without(skip)].map(made);
        assert!(all > usual, "{name}: {all} bytes without {}, {usual} with it", skip.name());
    };
    alone("cornell, scheduling-grid-overlap-reduced", Skip::Splits, Kind::Geometry);
    alone("scan, scheduling-grid", Skip::Attributes, Kind::Attributes);
    alone("textured, auto", Skip::Textures, Kind::Texture);
}

/// Skips by probability: the same mean, and another picture.
#[test]
fn what_is_left_out_by_probability_keeps_the_mean() {
    let scene = || testing::prepared(&testing::lamps(), 1, true);
    let usual = scene();
    let frame = Frame { max_depth: 8, ..testing::frame(&usual, [12, 9], 1) };
    let all_lights = scene().skipping(Skips::ALL.without(Skip::Lights));
    assert_ne!(usual.image_name(&frame).unwrap(), all_lights.image_name(&frame).unwrap());
    let settings = JobSettings { nodes: vec![NodeSpec { slots: 2 }], ..JobSettings::default() };
    let sampling = Sampling { spp: 64, target_error: None, time_limit: None };
    let means = |scene: &PreparedScene, frame: &Frame, skip: Skip, made: bool| -> Vec<f64> {
        let one = |seed| {
            let frame = Frame { seed, ..*frame };
            let o = render_local(scene, &frame, &sampling, &settings, &Silent).unwrap();
            assert_eq!(o.report.skips[skip.name()] > 0, made, "{}", skip.name());
            let values = o.image.pixels.as_flattened();
            values.iter().map(|&x| f64::from(x)).sum::<f64>() / values.len() as f64
        };
        (0..12).map(one).collect()
    };
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let thorough = Frame { rr_depth: 65535, ..frame };
    for (skip, scene, frame_without) in [(Skip::Lights, &all_lights, &frame), (Skip::Roulette, &usual, &thorough)] {
        let (with, without) = (means(&usual, &frame, skip, true), means(scene, frame_without, skip, false));
        assert!(with != without, "{} does nothing", skip.name());
        // seed by seed: what both see alike is no error
        let differences: Vec<f64> = with.iter().zip(&without).map(|(a, b)| a - b).collect();
        let (n, a, difference) = (with.len() as f64, mean(&with), mean(&differences));
        let variance = differences.iter().map(|d| (d - difference).powi(2)).sum::<f64>() / (n - 1.0);
        let error = (variance / n).sqrt();
        println!("{}: {a} with, {difference} more than without, standard error {error}", skip.name());
        assert!(
            difference.abs() < 4.0 * error && error < 0.02 * a,
            "{}: {a}, {difference} more +- {error}",
            skip.name()
        );
    }
}

#[test]
fn rays_on_their_way_through_other_boxes_are_of_another_cut() {
    let scene = |skips| testing::prepared(&testing::cornell(), 4, true).skipping(skips).cut;
    assert_ne!(scene(Skips::ALL), scene(Skips::ALL.without(Skip::Cells)));
    assert_eq!(scene(Skips::ALL), scene(Skips::ALL.without(Skip::Beaten)));
}
