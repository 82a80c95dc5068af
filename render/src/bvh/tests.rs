//! The kernels against brute force, against each other, and over forests of several blocks.

use super::testing::*;
use super::trace::brute_force;
use crate::ray::{MISS, Ray};

fn soup(random: &mut Random, n: usize, size: f32, edge: f32) -> Vec<Triangle> {
    (0..n)
        .map(|_| {
            let p = random.point(size);
            std::array::from_fn(|_| {
                let q = random.point(edge);
                std::array::from_fn(|c| p[c] + q[c])
            })
        })
        .collect()
}

fn rays_at(random: &mut Random, n: usize, size: f32) -> Vec<Ray> {
    (0..n)
        .map(|_| {
            let (o, p) = (random.point(size * 1.5), random.point(size));
            Ray { o, tmin: 0.0, d: std::array::from_fn(|c| p[c] - o[c]), tmax: f32::INFINITY }
        })
        .collect()
}

#[test]
fn every_kernel_gives_the_brute_force_answer() {
    let mut random = Random::new(1);
    for (n, size, edge) in
        [(0, 1.0, 0.1), (1, 1.0, 1.0), (7, 1.0, 1.0), (9, 1.0, 1.0), (3000, 1.0, 0.1), (500, 1e6, 1e6)]
    {
        let triangles = soup(&mut random, n, size, edge);
        let forest = forest(&[block(&triangles, &[])]);
        let rays = rays_at(&mut random, 700, size);
        let expected: Vec<_> = rays.iter().map(|r| brute_force(&triangles, &[], r, forest.largest())).collect();
        for mut tracer in kernels() {
            let hits = closest(&mut tracer, &forest, &rays);
            let occluded = any(&mut tracer, &forest, &rays);
            for i in 0..rays.len() {
                assert_eq!(identity(&forest, &hits[i]), expected[i], "{:?} {n} {:?}", tracer.kernel(), rays[i]);
                assert_eq!(occluded[i], hits[i].prim != MISS);
            }
        }
    }
}
