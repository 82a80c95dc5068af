//! However a scene is cut, on whatever nodes, by whatever strategy: the film is the same to the bit.

use rayherd_api::Strategy;
use rayherd_herd::job::{JobSettings, NodeSpec, PreparedScene, Sampling, Silent};
use rayherd_herd::local::render_local;
use rayherd_render::aov::Aovs;
use rayherd_render::bvh::Kernel;
use rayherd_render::camera::Camera;
use rayherd_render::film::FilmPart;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;
use rayherd_scene::description::Description;
use rayherd_scene::prepare::{Cut, PrepareSettings};
use rayherd_tests::mutation::{Random, rounds};

use super::cuts::{power, soup};
use super::scenes::{self, Wide};

/// A soup of the worst triangles with a lamp above it, under a sky.
fn scene(random: &mut Random, scale: f32) -> Description {
    let wide = |t: &super::numbers::Triangle| t.map(|p| p.map(f64::from));
    let triangles: Vec<Wide> = soup(random, scale).iter().map(wide).collect();
    let s = f64::from(scale);
    let lamp = [[-s, 3.0 * s, -s], [s, 3.0 * s, -s], [0.0, 3.0 * s, s]];
    let shapes = vec![scenes::shape(&triangles, 0, None), scenes::shape(&[lamp], 0, Some([4.0, 2.0, 1.0]))];
    scenes::under_a_sky(shapes, Some([0.1, 0.2, 0.3]))
}

fn open(description: &Description, settings: &PrepareSettings) -> PreparedScene {
    let (manifest, objects) = scenes::prepared(description, settings);
    PreparedScene::open(manifest, objects).expect("a sound scene")
}

fn film(scene: &PreparedScene, scale: f32, settings: &JobSettings) -> FilmPart {
    let s = f64::from(scale);
    let to_world = [[-1.0, 0.0, 0.0, 0.1 * s], [0.0, 1.0, 0.0, 0.2 * s], [0.0, 0.0, -1.0, 2.5 * s]];
    let size = [12, 12];
    let camera = Camera::new(&to_world, 60.0, size, scene.manifest.offset).expect("a camera");
    let frame = Frame {
        camera,
        size,
        filter: Filter::Box,
        seed: 5,
        max_depth: 5,
        rr_depth: 3,
        split: 2,
        hide_emitters: false,
        aovs: Aovs::NONE,
    };
    let sampling = Sampling { spp: 8, target_error: None, time_limit: None };
    let outcome = render_local(scene, &frame, &sampling, settings, &Silent).expect("a picture");
    assert_eq!(outcome.film.rejected().count, 0);
    outcome.film
}

#[test]
fn the_film_does_not_depend_on_how_the_scene_is_cut() {
    let (mut lit, mut splits, mut cells) = (0, 0, 0);
    let done = rounds("films of a soup cut in every way", 6, |random| {
        let scale = power(random, -20, 20);
        let description = scene(random, scale);
        let one = PrepareSettings { cut: Cut::Splits(1), max_subdiv: 1, ..PrepareSettings::default() };
        let plain =
            JobSettings { kernel: Kernel::Scalar, nodes: vec![NodeSpec { slots: 1 }], ..JobSettings::default() };
        let expected = film(&open(&description, &one), scale, &plain);
        lit += u32::from(expected.touched() > 0);
        for strategy in Strategy::ALL {
            let settings = PrepareSettings {
                // down to a triangle or two in a split
                cut: if random.below(2) == 0 {
                    Cut::Splits(1 + random.below(40) as u32)
                } else {
                    Cut::BlockSize(1 << (8 + random.below(6)))
                },
                overlap_reduction: matches!(strategy, Strategy::SchedulingGridOverlapReduced | Strategy::Auto),
                overlap_threshold: [0.0, 0.2, 1.0][random.below(3)],
                several: [1, 4, 16, 256][random.below(4)],
                max_subdiv: [1, 3, 16, 64][random.below(4)],
            };
            let scene = open(&description, &settings);
            let largest = (0..scene.splits()).map(|s| scene.split_bytes(s)).max().unwrap_or(0);
            let kernels = super::numbers::kernels();
            let nodes = vec![NodeSpec { slots: 1 + random.below(2) as u32 }; 1 + random.below(4)];
            let job = JobSettings {
                strategy,
                replicas: (1 + random.below(2)).min(nodes.len()) as u32,
                nodes,
                memory_per_node: (random.below(2) == 0).then_some(largest * (1 + random.below(4) as u64)),
                kernel: kernels[random.below(kernels.len())].kernel(),
                batch: 1 << random.below(12),
                ..JobSettings::default()
            };
            splits += scene.splits();
            cells += scene.manifest.grid.cells.len();
            let found = film(&scene, scale, &job);
            assert!(found == expected, "{strategy} by {settings:?} on {:?} at {scale}", job.nodes);
        }
    });
    println!("{lit} films with light, {splits} splits, {cells} cells");
    assert!(done.is_none_or(|n| u64::from(lit) == n));
}
