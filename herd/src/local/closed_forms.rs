//! Direct light in closed form, through every strategy: rays leave their tasks and come back, and the light is still right.

use rayherd_render::aov::Aovs;
use rayherd_render::camera::Camera;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;

use super::render_local;
use crate::job::{JobSettings, NodeSpec, PreparedScene, Sampling, Silent};
use crate::plan::Strategy;
use crate::testing::{self, Lamp};

type V = [f64; 3];

fn sub(a: V, b: V) -> V {
    [0, 1, 2].map(|k| a[k] - b[k])
}

fn dot(a: V, b: V) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

fn cross(a: V, b: V) -> V {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(a: V) -> V {
    let length = dot(a, a).sqrt();
    a.map(|x| x / length)
}

/// The point that the narrow camera sees.
const SEEN: V = [0.2, 0.0, 0.3];

/// Irradiance at [`SEEN`] of a polygon of radiance 1 above the floor (Lambert 1760).
fn polygon(vertices: &[V]) -> f64 {
    let sides = vertices.iter().zip(vertices.iter().cycle().skip(1));
    let sum: f64 = sides
        .map(|(a, b)| {
            let (a, b) = (unit(sub(*a, SEEN)), unit(sub(*b, SEEN)));
            unit(cross(a, b))[1] * dot(a, b).acos()
        })
        .sum();
    0.5 * sum.abs()
}

/// Four by four pixels, together 0.02 degrees wide, from obliquely above.
fn frame(scene: &PreparedScene) -> Frame {
    let s = 0.5f64.sqrt();
    let to_world = [[1.0, 0.0, 0.0, SEEN[0]], [0.0, s, -s, 3.0], [0.0, s, s, SEEN[2] - 3.0]];
    let camera = Camera::new(&to_world, 0.02, [4, 4], scene.manifest.offset).unwrap();
    Frame {
        camera,
        size: [4, 4],
        filter: Filter::Box,
        seed: 3,
        max_depth: 2,
        rr_depth: 10,
        split: 1,
        hide_emitters: false,
        aovs: Aovs::NONE,
    }
}

#[test]
fn direct_light_through_every_strategy() {
    let pi = std::f64::consts::PI;
    // front below: a x b points down
    let (c, a, b) = ([-0.5, 2.0, -0.4], [1.5, 0.0, 0.2], [0.0, 0.4, 1.3]);
    let add = |p: V, q: V| [0, 1, 2].map(|k| p[k] + q[k]);
    let (center, radius) = ([1.2, 3.0, 1.0], 0.8);
    let way = sub(center, SEEN);
    let distance2 = dot(way, way);
    for (name, lamp, expected) in [
        ("rectangle", Lamp::Rectangle([c, a, b]), 0.5 / pi * polygon(&[c, add(c, a), add(add(c, a), b), add(c, b)])),
        // E = pi L (r / d)^2 cos
        ("sphere", Lamp::Sphere(center, radius), 0.5 * radius * radius / distance2 * way[1] / distance2.sqrt()),
        ("sky", Lamp::Sky, 0.5),
    ] {
        let mut files = Vec::new();
        for (strategy, reduced) in [
            (Strategy::DemandDriven, false),
            (Strategy::SchedulingGrid, false),
            (Strategy::SchedulingGridOverlapReduced, true),
            (Strategy::Auto, true),
        ] {
            let scene = testing::prepared(&testing::floor(&lamp), 6, reduced);
            let largest = scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap();
            let settings = JobSettings {
                strategy,
                nodes: vec![NodeSpec { slots: 1 }, NodeSpec { slots: 1 }],
                memory_per_node: Some(2 * largest),
                task_seconds: 0.01,
                batch: 300,
                ..JobSettings::default()
            };
            let sampling = Sampling { spp: 2048, target_error: None, time_limit: None };
            let made = render_local(&scene, &frame(&scene), &sampling, &settings, &Silent).unwrap();
            let pixels = &made.image.pixels;
            let mean = pixels.iter().map(|p| f64::from(p[1])).sum::<f64>() / pixels.len() as f64;
            println!("{name} {strategy}: {mean} {expected}");
            assert!((mean / expected - 1.0).abs() < 0.003, "{name}, {strategy}: {mean} is not {expected}");
            files.push(made.film);
        }
        assert!(files.windows(2).all(|f| f[0] == f[1]), "{name}");
    }
}
