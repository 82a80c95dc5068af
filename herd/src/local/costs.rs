//! What the stages of tasks cost (`--profile`): each counts what the rays say, and measuring changes no byte.

use std::num::NonZeroU32;

use rayherd_render::skip::Skips;

use super::*;
use crate::job::{NodeSpec, Silent};
use crate::plan::Strategy;
use crate::profile::Part;
use crate::testing;

fn render(scene: &PreparedScene, frame: &Frame, settings: &JobSettings) -> JobOutcome {
    let sampling = Sampling { spp: 3, target_error: None, time_limit: None };
    render_local(scene, frame, &sampling, settings, &Silent).unwrap()
}

#[test]
fn stages_count_what_the_rays_say() {
    for (splits, reduced) in [(1, true), (9, true), (9, false)] {
        let scene = testing::prepared(&testing::cornell(), splits, reduced).skipping(Skips::ALL);
        let frame = testing::frame(&scene, [40, 24], 2);
        let largest = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap();
        for strategy in Strategy::ALL {
            let plain = JobSettings {
                strategy,
                nodes: vec![NodeSpec { slots: 1 }; 2],
                memory_per_node: Some(2 * largest),
                threads: NonZeroU32::new(2),
                task_seconds: 0.01,
                batch: 300,
                // groups become full while rays are sent on
                ray_buffer: 1 << 14,
                ..JobSettings::default()
            };
            let name = format!("{strategy} on {} splits", scene.splits());
            let without = render(&scene, &frame, &plain);
            assert_eq!(without.report.profile, None, "{name}");
            let made = render(&scene, &frame, &JobSettings { profile: true, ..plain });
            assert!(made.film == without.film, "{name}");
            let report = &made.report;
            let profile = report.profile.unwrap();
            let [camera, closest, shading, shadow, film, walk, load, rays, store] =
                Part::ALL.map(|part| profile.of(part).items);
            assert_eq!((camera, shading), (report.rays.camera, report.rays.closest), "{name}: {profile:?}");
            // where a hit is decided elsewhere its ray is tested again
            let once = scene.splits() == 1 && strategy != Strategy::SchedulingGrid;
            assert!(if once { closest <= shading } else { closest >= shading / 2 }, "{name}: {profile:?}");
            assert!(shadow >= report.rays.shadow && (shadow == report.rays.shadow || scene.splits() > 1), "{name}");
            assert!(film > 0 && film <= shading + report.rays.shadow, "{name}: {profile:?}");
            assert!(load > 0 && store > 0 && store <= report.tasks, "{name}: {profile:?}");
            // each ray that is stored is read once; those that a reduce step sends on are no hops
            let reduces = strategy == Strategy::SchedulingGrid;
            assert!(
                rays.is_multiple_of(2) && rays >= 2 * report.hops && (rays == 2 * report.hops || reduces),
                "{name}"
            );
            assert!(walk > 0 || scene.splits() == 1, "{name}: {profile:?}");
            // of one clock: what is booked was spent
            let busy: f64 = report.nodes_detail.iter().map(|n| n.busy).sum();
            assert!(profile.cpu_s() > 0.0 && profile.cpu_s() <= busy, "{name}: {profile:?} of {busy} s");
        }
    }
}
