//! Rays from inside a closed mesh at its vertices and edges: each must hit.

use super::super::testing::*;
use crate::ray::Ray;

/// Six n x n faces of a cube around the origin: flat, or pushed onto a bumpy sphere around (0.1, 0.1, 0.1).
fn mesh(n: usize, is_sphere: bool) -> Vec<Triangle> {
    let at = |face: usize, i: usize, j: usize| -> [f32; 3] {
        let (a, b) = (i as f64 / n as f64 * 2.0 - 1.0, j as f64 / n as f64 * 2.0 - 1.0);
        let s = if face & 1 == 0 { 1.0 } else { -1.0 };
        let v: [f64; 3] = match face >> 1 {
            0 => [s, a, b],
            1 => [a, s, b],
            _ => [a, b, s],
        };
        if !is_sphere {
            return v.map(|x| x as f32);
        }
        let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        let [x, y, z] = v.map(|x| x / length);
        let r = 1.0 + 0.05 * libm::sin(9.0 * x) * libm::cos(7.0 * y) + 0.02 * libm::sin(31.0 * z);
        [x, y, z].map(|x| (x * r + 0.1) as f32)
    };
    let mut out = Vec::with_capacity(12 * n * n);
    for face in 0..6 {
        for i in 0..n {
            for j in 0..n {
                let [a, b, c, d] = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(i, j)| at(face, i, j));
                out.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    out
}

/// A ray from inside at a vertex, an edge's middle or another point of an edge; in the cube every third along an axis.
fn ray(random: &mut Random, triangles: &[Triangle], is_sphere: bool) -> Ray {
    let t = triangles[random.below(triangles.len())];
    let e = random.below(3);
    let (a, b) = (t[e], t[(e + 1) % 3]);
    let s = match random.below(4) {
        0 => 0.0,
        1 => 0.5,
        _ => random.unit(),
    };
    let p: [f32; 3] = std::array::from_fn(|c| a[c] + (b[c] - a[c]) * s);
    let kind = random.below(3);
    let (o, d) = if kind == 2 && !is_sphere {
        let axis = (0..3).max_by(|&i, &j| p[i].abs().total_cmp(&p[j].abs())).unwrap();
        let only = |x: f32| std::array::from_fn(|c| if c == axis { x } else { 0.0 });
        let mut o = p;
        o[axis] = 0.0;
        (o, only(p[axis].signum()))
    } else {
        let o = match kind {
            0 => [if is_sphere { 0.1 } else { 0.0 }; 3],
            _ => random.point(0.3),
        };
        (o, std::array::from_fn(|c| p[c] - o[c]))
    };
    Ray { o, tmin: 0.0, d, tmax: f32::INFINITY }
}

/// 10^5 rays at each mesh of 120,000 triangles; with RAYHERD_LEAK_RAYS=10000000 as many at meshes of 1,080,000.
#[test]
fn closed_meshes_do_not_leak() {
    let (total, side) = match std::env::var("RAYHERD_LEAK_RAYS") {
        Ok(n) => (n.parse().expect("RAYHERD_LEAK_RAYS is a number of rays"), 300),
        Err(_) => (100_000, 100),
    };
    for is_sphere in [true, false] {
        let triangles = mesh(side, is_sphere);
        let forest = forest(&[block(&triangles, &[])]);
        for mut tracer in kernels() {
            // the plain kernel is slow, and gives the same bits elsewhere
            let total = if tracer.kernel() == super::super::Kernel::Scalar { total.min(100_000) } else { total };
            let mut random = Random::new(13);
            let mut left = total;
            while left > 0 {
                let n = left.min(1 << 18);
                left -= n;
                let rays: Vec<Ray> = (0..n).map(|_| ray(&mut random, &triangles, is_sphere)).collect();
                for (ray, hit) in rays.iter().zip(closest(&mut tracer, &forest, &rays)) {
                    assert!(hit.is_hit(), "{:?} {ray:?}", tracer.kernel());
                }
                for (ray, is_hit) in rays.iter().zip(any(&mut tracer, &forest, &rays)) {
                    assert!(is_hit, "{:?} any {ray:?}", tracer.kernel());
                }
            }
            println!("{:?}: {total} rays, no leak", tracer.kernel());
        }
    }
}
