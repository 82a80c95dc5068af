//! The Cornell box of Mitsuba's documentation against the mean of Mitsuba 3.9.1's picture of it (16384 samples per pixel, max_depth 8; shared/peers/refs).

use glam::{DAffine3, DVec3};

use super::brute::Scene;
use crate::aov::Aovs;
use crate::camera::Camera;
use crate::film::FilmPart;
use crate::filter::Filter;
use crate::frame::Frame;
use crate::light::Lights;
use crate::material::Bsdf;
use crate::path::{Context, reference};

/// Mean of the picture.
const MEAN: [f64; 3] = [0.240_139_43, 0.141_116_44, 0.059_975_23];
/// Means of its 4 x 4 blocks, red.
const BLOCKS: [[f64; 4]; 4] = [
    [0.11403, 1.01844, 0.98358, 0.04956],
    [0.19328, 0.29368, 0.29175, 0.05394],
    [0.1195, 0.11941, 0.18803, 0.04314],
    [0.11606, 0.17452, 0.0309, 0.05243],
];

pub fn scene() -> Scene {
    let mut s = Scene::default();
    let mut diffuse = |r: [f32; 3]| s.material(Bsdf::Diffuse { reflectance: r }, false);
    let white = diffuse([0.885809, 0.698859, 0.666422]);
    let green = diffuse([0.105421, 0.37798, 0.076425]);
    let red = diffuse([0.570068, 0.0430135, 0.0443706]);
    let turn = |axis: DVec3, degrees: f64| DAffine3::from_axis_angle(axis, degrees.to_radians());
    let (x, y) = (DVec3::X, DVec3::Y);
    let shift = DAffine3::from_translation;
    let mut rectangle = |m: DAffine3, material: u32, emission: Option<[f32; 3]>| {
        let shape = s.shape(material, emission);
        let corner = m.transform_point3(DVec3::new(-1.0, -1.0, 0.0));
        let side = |v: DVec3| m.transform_vector3(v * 2.0).as_vec3().to_array();
        s.quad(shape, corner.as_vec3().to_array(), side(x), side(y));
    };
    let light = shift(DVec3::new(0.0, 0.99, 0.01)) * turn(x, 90.0) * DAffine3::from_scale(DVec3::new(0.23, 0.19, 0.19));
    rectangle(light, white, Some([18.387, 13.9873, 6.75357]));
    rectangle(shift(-y) * turn(x, -90.0), white, None);
    rectangle(shift(y) * turn(x, 90.0), white, None);
    rectangle(shift(-DVec3::Z), white, None);
    rectangle(shift(x) * turn(y, -90.0), green, None);
    rectangle(shift(-x) * turn(y, 90.0), red, None);
    for (scale, angle, at) in [
        (DVec3::splat(0.3), -17.0, DVec3::new(0.335, -0.7, 0.38)),
        (DVec3::new(0.3, 0.61, 0.3), 18.25, DVec3::new(-0.33, -0.4, -0.28)),
    ] {
        let m = shift(at) * turn(y, angle) * DAffine3::from_scale(scale);
        let faces = [turn(y, 0.0), turn(y, 90.0), turn(y, 180.0), turn(y, 270.0), turn(x, 90.0), turn(x, -90.0)];
        for face in faces {
            rectangle(m * face * shift(DVec3::Z), white, None);
        }
    }
    s
}

pub fn frame(size: u32) -> Frame {
    let rows = [[-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 3.9]];
    Frame {
        camera: Camera::new(&rows, 39.3077, [size; 2], [0.0; 3]).unwrap(),
        size: [size; 2],
        filter: Filter::Box,
        seed: 0,
        max_depth: 8,
        rr_depth: 5,
        split: 1,
        hide_emitters: false,
        aovs: Aovs::NONE,
    }
}

#[test]
fn mean_is_mitsubas() {
    let (scene, frame) = (scene(), frame(64));
    let world = scene.world();
    let lights = Lights::new(&world);
    let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
    let mut film = FilmPart::new(frame.size);
    let samples = 64;
    let counters = reference::render(&context, &scene, 0..samples, &mut film);
    let picture = film.resolve(samples);
    let mean: [f64; 3] =
        std::array::from_fn(|c| picture.iter().map(|p| f64::from(p[c])).sum::<f64>() / picture.len() as f64);
    println!("{counters:?}, rel_mse {:?}", film.rel_mse(samples));
    for c in 0..3 {
        println!("channel {c}: {} {:+.5}", mean[c], mean[c] / MEAN[c] - 1.0);
    }
    let block = |i: usize, j: usize| {
        let pixels = (0..256).map(|k| picture[(16 * i + k / 16) * 64 + 16 * j + k % 16]);
        pixels.map(|p| f64::from(p[0])).sum::<f64>() / 256.0
    };
    for i in 0..4 {
        let row: Vec<String> = (0..4).map(|j| format!("{:+.4}", block(i, j) / BLOCKS[i][j] - 1.0)).collect();
        println!("{row:?}");
    }
    for c in 0..3 {
        assert!((mean[c] / MEAN[c] - 1.0).abs() < 0.003, "channel {c}: {} instead of {}", mean[c], MEAN[c]);
        for i in 0..4 {
            for j in 0..4 {
                assert!((block(i, j) / BLOCKS[i][j] - 1.0).abs() < 0.02, "block {i} {j}: {}", block(i, j));
            }
        }
    }
}
