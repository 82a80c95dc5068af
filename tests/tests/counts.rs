//! What a picture costs, in counts: rays, nodes visited, bytes, error at equal samples. The short version of the benches, for every change: it says
//! that something got dearer, the benches say by how many seconds.
//!
//! Bounds stand a little above what was counted when they were set; whoever lowers a count lowers its bound.

mod example;

use rayherd_api::Strategy;
use rayherd_herd::job::{JobSettings, NodeSpec, Sampling, Silent};
use rayherd_herd::local::render_local;
use rayherd_herd::report::Report;
use rayherd_render::bvh::{Forest, Kernel, Serial, Tracer, build_block};
use rayherd_render::ray::{Hit, Ray};
use rayherd_scene::prepare::{Cut, PrepareSettings};

const SIZE: u32 = 64;
const SPP: u32 = 16;

/// The report of an example, cut into so many splits, on nodes of one slot that hold a part of the scene each.
fn report(example: &str, splits: u32, nodes: usize, part: Option<f64>, strategy: Strategy) -> Report {
    let settings = PrepareSettings { cut: Cut::Splits(splits), ..PrepareSettings::default() };
    let (scene, frame) = example::prepared(example, SIZE, 8, &settings);
    let bytes: u64 = (0..scene.splits()).map(|s| scene.split_bytes(s)).sum();
    let settings = JobSettings {
        strategy,
        nodes: vec![NodeSpec { slots: 1 }; nodes],
        memory_per_node: part.map(|p| (bytes as f64 * p) as u64),
        ..JobSettings::default()
    };
    let sampling = Sampling { spp: SPP, target_error: None, time_limit: None };
    render_local(&scene, &frame, &sampling, &settings, &Silent).unwrap().report
}

#[test]
fn a_picture_takes_no_more_rays_and_keeps_its_error() {
    let samples = u64::from(SIZE * SIZE * SPP);
    // closest and shadow rays a sample, relMSE: counted, and a hundredth or a tenth above
    for (example, closest, shadow, error) in
        [("cornell-box.xml", 3.4552, 2.0453, 0.01214), ("veach-mis.xml", 2.4595, 1.4022, 0.01888)]
    {
        let r = report(example, 1, 1, None, Strategy::Auto);
        let each = |rays: u64| rays as f64 / samples as f64;
        let found = (each(r.rays.closest), each(r.rays.shadow), r.rel_mse.unwrap());
        println!("{example}: {found:?}");
        assert_eq!((r.rays.camera, r.rays.merged, r.hops, r.network_bytes), (samples, 0, 0, 0));
        assert_eq!(r.scene_passes, 1.0);
        assert!(found.0 <= 1.01 * closest, "{example}: {} closest rays a sample, {closest} once", found.0);
        assert!(found.1 <= 1.01 * shadow, "{example}: {} shadow rays a sample, {shadow} once", found.1);
        assert!(found.2 <= 1.1 * error, "{example}: relMSE {}, {error} once", found.2);
    }
}

#[test]
fn a_scene_in_parts_moves_no_more() {
    // passes, hops a sample, bytes a hop; `auto` weighs times, and so small a scene is loaded 14 to 20 times
    for (strategy, passes, hops, bytes) in
        [(Strategy::SchedulingGridOverlapReduced, 8.7, 5.4, 31.5), (Strategy::Auto, 40.0, 2.9, 36.0)]
    {
        let r = report("cornell-box.xml", 8, 4, Some(0.5), strategy);
        let each = r.hops as f64 / f64::from(SIZE * SIZE * SPP);
        let found = (r.scene_passes, each, r.bytes_per_hop.unwrap());
        println!("{strategy}: {found:?}");
        assert!(found.0 <= passes, "{strategy}: {} passes, {passes} at most", found.0);
        assert!(found.1 <= hops, "{strategy}: {} hops a sample, {hops} at most", found.1);
        assert!(found.2 <= bytes, "{strategy}: {} bytes a hop, {bytes} at most", found.2);
    }
}

/// A sphere with bumps, in triangles of about one size.
fn bumpy(n: u32) -> Vec<[[f32; 3]; 3]> {
    let at = |i: u32, j: u32| -> [f32; 3] {
        let (theta, phi) = (
            std::f64::consts::PI * f64::from(i) / f64::from(n),
            std::f64::consts::TAU * f64::from(j) / f64::from(2 * n),
        );
        let r = 1.0 + 0.1 * libm::sin(9.0 * theta) * libm::sin(7.0 * phi);
        [r * libm::sin(theta) * libm::cos(phi), r * libm::cos(theta), r * libm::sin(theta) * libm::sin(phi)]
            .map(|x| x as f32)
    };
    let quads = (0..n).flat_map(|i| (0..2 * n).map(move |j| (i, j)));
    let two = |(i, j)| {
        let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
        [[a, b, c], [a, c, d]]
    };
    quads.flat_map(two).filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]).collect()
}

#[test]
fn a_ray_visits_no_more_nodes_and_a_triangle_takes_no_more_bytes() {
    let triangles = bumpy(150);
    let ids: Vec<u64> = (0..triangles.len() as u64).collect();
    let block = build_block(&triangles, &ids, &[], &[], &Serial).unwrap();
    let mut forest = Forest::new(block.len() as u64 + (1 << 20)).unwrap();
    forest.insert(&block).unwrap();
    forest.finish().unwrap();
    // a net of rays from in front, some of which pass by
    let rays: Vec<Ray> = (0..96 * 96)
        .map(|i| [i % 96, i / 96].map(|k| 2.4 * (k as f32 + 0.5) / 96.0 - 1.2))
        .map(|[x, y]| Ray { o: [0.1, 0.2, 3.0], tmin: 0.0, d: [x - 0.1, y - 0.2, -3.0], tmax: f32::INFINITY })
        .collect();
    let mut tracer = Tracer::new(Kernel::Auto).unwrap();
    let mut hits = vec![Hit::miss(0.0); rays.len()];
    tracer.closest(&forest, &rays, &mut hits);
    let each = |n: u64| n as f64 / rays.len() as f64;
    let counted = tracer.counters();
    let found = (each(counted.nodes), each(counted.leaves), block.len() as f64 / triangles.len() as f64);
    println!("{} triangles: {found:?}", triangles.len());
    let (nodes, leaves, bytes) = (6.21, 1.31, 52.4);
    assert!(found.0 <= nodes && found.1 <= leaves && found.2 <= bytes, "{found:?}, at most {nodes}, {leaves}, {bytes}");
}
