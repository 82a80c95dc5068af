//! Closed forms: enclosures whose radiance is a geometric series.

use super::brute::{Scene, frame};
use super::mean_of;
use crate::frame::Frame;
use crate::material::{Bsdf, Distribution};
use crate::world::Primitive;

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

/// Clear glass, smooth and rough, and a pane, before a sky of 1: nothing is seen of them but what a rough one loses.
#[test]
fn glass_before_a_white_sky() {
    let white = [1.0; 3];
    let smooth = Bsdf::Dielectric { eta: 1.5, reflect: white, transmit: white };
    let pane = Bsdf::ThinDielectric { eta: 1.5, reflect: white, transmit: white };
    let rough = |distribution, alpha| Bsdf::RoughDielectric {
        distribution,
        alpha: [alpha; 2],
        eta: 1.5,
        reflect: white,
        transmit: white,
    };
    for (bsdf, lost) in [
        (smooth, 0.002),
        (pane, 0.002),
        (rough(Distribution::Beckmann, 0.05), 0.01),
        (rough(Distribution::Ggx, 0.05), 0.03),
        (rough(Distribution::Ggx, 0.6), 0.4),
    ] {
        for cube in [false, true] {
            let mut scene = Scene { environment: Some(white), ..Scene::default() };
            let material = scene.material(bsdf.clone(), false);
            let shape = scene.shape(material, None);
            if cube {
                box_outside(&mut scene, shape);
            } else {
                scene.sphere(shape, [0.1, -0.2, 0.3], 1.0, false);
            }
            // the camera outside, and inside; paths are long enough to come out
            for (origin, inside) in [([0.3, 0.2, -6.0], false), ([0.2, -0.1, 0.1], true)] {
                let frame = Frame { rr_depth: 1000, ..frame(origin, 20.0, [8, 8], 200) };
                let found = mean_of(&scene, &frame, 128);
                // inside, what comes in is brighter by the square of the index, and where it is trapped it is dark
                let refracts = inside && !matches!(bsdf, Bsdf::ThinDielectric { .. });
                let expected = if refracts { 2.25 } else { 1.0 };
                println!("{bsdf:?} cube {cube} inside {inside}: {found} of {expected}");
                if refracts && cube {
                    // total reflection between parallel faces keeps some of it for ever
                    assert!(found < 2.26 && found > 1.0, "{bsdf:?}: {found}");
                } else {
                    let ratio = found / expected;
                    assert!(ratio < 1.005 && ratio > 1.0 - lost - 0.005, "{bsdf:?} cube {cube} {inside}: {found}");
                }
            }
        }
    }
}

/// A box [-1, 1]^3 with fronts outside.
fn box_outside(scene: &mut Scene, shape: u32) {
    let first = scene.primitives.len();
    box_inside(scene, shape);
    for (p, _) in &mut scene.primitives[first..] {
        if let Primitive::Triangle([_, b, c]) = p {
            std::mem::swap(b, c);
        }
    }
}

/// A light seen through rough glass: with the light sampled (and weighted) and by the BSDF alone the picture has one mean.
#[test]
fn light_through_rough_glass() {
    let white = [1.0; 3];
    for split in [1, 4] {
        let mut found = Vec::new();
        for emits in [true, false] {
            let mut scene = Scene::default();
            let glass = scene.material(
                Bsdf::RoughDielectric {
                    distribution: Distribution::Ggx,
                    alpha: [0.4; 2],
                    eta: 1.5,
                    reflect: white,
                    transmit: white,
                },
                false,
            );
            let black = scene.diffuse(0.0);
            let pane = scene.shape(glass, None);
            scene.quad(pane, [-2.0, -2.0, 0.0], [0.0, 4.0, 0.0], [4.0, 0.0, 0.0]);
            // once as a light, once as a sky seen through a hole in a black wall of the same shape and distance
            if emits {
                let light = scene.shape(black, Some(white));
                scene.quad(light, [-0.5, -0.5, 2.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]);
            } else {
                scene.environment = Some(white);
                let wall = scene.shape(black, None);
                let (l, s) = (20.0, 19.5);
                scene.quad(wall, [-l, -l, 2.0], [0.0, 2.0 * l, 0.0], [s, 0.0, 0.0]);
                scene.quad(wall, [0.5, -l, 2.0], [0.0, 2.0 * l, 0.0], [s, 0.0, 0.0]);
                scene.quad(wall, [-0.5, -l, 2.0], [0.0, s, 0.0], [1.0, 0.0, 0.0]);
                scene.quad(wall, [-0.5, 0.5, 2.0], [0.0, s, 0.0], [1.0, 0.0, 0.0]);
                // and no sky from anywhere else
                scene.quad(wall, [-l, -l, -20.0], [2.0 * l, 0.0, 0.0], [0.0, 2.0 * l, 0.0]);
                scene.quad(wall, [-l, -l, -20.0], [0.0, 0.0, 22.0], [2.0 * l, 0.0, 0.0]);
                scene.quad(wall, [-l, l, -20.0], [0.0, 0.0, 22.0], [2.0 * l, 0.0, 0.0]);
                scene.quad(wall, [-l, -l, -20.0], [0.0, 2.0 * l, 0.0], [0.0, 0.0, 22.0]);
                scene.quad(wall, [l, -l, -20.0], [0.0, 2.0 * l, 0.0], [0.0, 0.0, 22.0]);
            }
            let frame = Frame { split, ..frame([0.1, 0.2, -3.0], 25.0, [8, 8], 2) };
            found.push(mean_of(&scene, &frame, if emits { 1024 } else { 8192 }));
        }
        println!("{found:?}");
        assert!((found[0] / found[1] - 1.0).abs() < 0.03, "split {split}: {found:?}");
    }
}
