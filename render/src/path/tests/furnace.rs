//! Closed forms: enclosures whose radiance is a geometric series.

use super::brute::{Scene, frame};
use super::mean_of;

/// Inside a sphere that emits 1 and reflects a, paths of n rays see 1 + a + .. + a^(n-1), whatever is sampled.
#[test]
fn sphere_from_inside() {
    for depth in [1, 2, 5, 9] {
        let mut scene = Scene::default();
        let material = scene.diffuse(0.7);
        let shape = scene.shape(material, Some([1.0; 3]));
        scene.sphere(shape, [0.1, -0.2, 0.3], 2.0, true);
        let expected: f64 = (0..depth).map(|k| 0.7f64.powi(k as i32)).sum();
        let found = mean_of(&scene, &frame([0.5, 0.25, -0.3], 70.0, [8, 8], depth), 256);
        println!("depth {depth}: {found} {expected}");
        assert!((found / expected - 1.0).abs() < 0.01, "depth {depth}: {found} instead of {expected}");
    }
}

/// The six walls of the cube [-1, 1]^3, fronts inside.
pub fn box_inside(scene: &mut Scene, shape: u32) {
    let (l, h) = (-1.0, 1.0);
    let e = 2.0;
    scene.quad(shape, [l, l, l], [e, 0.0, 0.0], [0.0, e, 0.0]);
    scene.quad(shape, [l, l, h], [0.0, e, 0.0], [e, 0.0, 0.0]);
    scene.quad(shape, [l, l, l], [0.0, e, 0.0], [0.0, 0.0, e]);
    scene.quad(shape, [h, l, l], [0.0, 0.0, e], [0.0, e, 0.0]);
    scene.quad(shape, [l, l, l], [0.0, 0.0, e], [e, 0.0, 0.0]);
    scene.quad(shape, [l, h, l], [e, 0.0, 0.0], [0.0, 0.0, e]);
}

/// The same in a box of triangles.
#[test]
fn box_from_inside() {
    for depth in [1, 3, 6] {
        let mut scene = Scene::default();
        let material = scene.diffuse(0.6);
        let shape = scene.shape(material, Some([1.0; 3]));
        box_inside(&mut scene, shape);
        let expected: f64 = (0..depth).map(|k| 0.6f64.powi(k as i32)).sum();
        let found = mean_of(&scene, &frame([0.3, 0.25, -0.3], 70.0, [8, 8], depth), 256);
        println!("depth {depth}: {found} {expected}");
        assert!((found / expected - 1.0).abs() < 0.01, "depth {depth}: {found} instead of {expected}");
    }
}
