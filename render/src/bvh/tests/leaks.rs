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

/// 10^5 rays at each mesh of 12, 48 and 120,000 triangles; with RAYHERD_LEAK_RAYS=10000000 as many at meshes of 12, 48 and 1,080,000.
#[test]
fn closed_meshes_do_not_leak() {
    let (total, side) = match std::env::var("RAYHERD_LEAK_RAYS") {
        Ok(n) => (n.parse().expect("RAYHERD_LEAK_RAYS is a number of rays"), 300),
        Err(_) => (100_000, 100),
    };
    // the first two without a tree
    let meshes = [1, 2, side].into_iter().flat_map(|side| [(side, true), (side, false)]);
    for (side, is_sphere) in meshes {
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
                for (ray, hit) in rays.iter().zip(together(tracer.kernel(), &forest, &rays)) {
                    assert!(hit.is_hit(), "{:?} together {ray:?}", tracer.kernel());
                }
                for (ray, is_hit) in rays.iter().zip(any(&mut tracer, &forest, &rays)) {
                    assert!(is_hit, "{:?} any {ray:?}", tracer.kernel());
                }
            }
            println!("{:?}: {total} rays, no leak", tracer.kernel());
        }
    }
}

/// A slanted room of twelve triangles around many small ones: its walls stand in many leaves, each with a box around a part. Rays at
/// walls' vertices and edges, and within a wall at the planes between parts, must hit, and as without parts: as the plain search says.
#[test]
fn walls_in_parts_do_not_leak() {
    let mut random = Random::new(31);
    let slanted = |p: [f32; 3]| {
        let [x, y, z] = p.map(f64::from);
        // no side along an axis, no corner that is a round number
        [0.8 * x - 0.36 * y + 0.48 * z + 0.1, 0.6 * x + 0.48 * y - 0.64 * z, 0.8 * y + 0.6 * z - 0.3].map(|x| x as f32)
    };
    let mut triangles: Vec<Triangle> = mesh(1, false).iter().map(|t| t.map(slanted)).collect();
    let walls = triangles.len();
    triangles.extend((0..4000).map(|_| {
        let at = random.point(0.02);
        [0; 3].map(|_| {
            let p = random.point(0.004);
            slanted(std::array::from_fn(|c| at[c] + p[c] + 0.7))
        })
    }));
    let object = block(&triangles, &[]);
    let without: usize = block(&triangles[walls..], &[]).len();
    assert!(object.len() > without + 100 * 40, "the walls are not in parts: {} and {without} bytes", object.len());
    let forest = forest(&[object]);
    let middle = slanted([0.0; 3]);
    let mut rays = Vec::new();
    for k in 0..60_000 {
        let t = triangles[random.below(walls)];
        let (u, v) = (random.unit(), random.unit());
        let (u, v) = match k % 3 {
            0 => (0.0, v),
            1 => (u, 0.0),
            _ => (u * (1.0 - v), v),
        };
        let mut p: [f32; 3] = std::array::from_fn(|c| t[0][c] + (t[1][c] - t[0][c]) * u + (t[2][c] - t[0][c]) * v);
        if k % 5 == 0 {
            // a plane halfway down a wall's box, some times
            let axis = random.below(3);
            let (lo, hi) = t.iter().fold((f32::MAX, f32::MIN), |(lo, hi), q| (lo.min(q[axis]), hi.max(q[axis])));
            p[axis] = lo + (hi - lo) * (random.below(16) as f32 / 16.0);
        }
        let d: [f32; 3] = std::array::from_fn(|c| p[c] - middle[c]);
        rays.push(Ray { o: middle, tmin: 0.0, d, tmax: f32::INFINITY });
    }
    for mut tracer in kernels() {
        let mut hits = vec![crate::ray::Hit::miss(0.0); rays.len()];
        tracer.closest(&forest, &rays, &mut hits);
        let lost = hits.iter().filter(|h| !h.is_hit()).count();
        assert_eq!(lost, 0, "{:?}: {lost} of {} rays left the room", tracer.kernel(), rays.len());
    }
    super::check_all(&[forest], &triangles, &[], &rays[..600]);
}
