//! However a soup of triangles is cut into blocks, in whatever order they come, with copies or without: a ray's answer is the same to the bit, and
//! it is the least (t, id) over triangles that are tested alone.

use rayherd_render::bvh::Tracer;
use rayherd_render::ray::{Hit, PrimId, Ray};
use rayherd_tests::mutation::{Random, rounds};

use super::numbers::*;

/// Triangles of a soup.
const SOUP: usize = 96;
/// Rays through it.
const RAYS: usize = 256;

pub fn power(random: &mut Random, least: i32, most: i32) -> f32 {
    2f32.powi(least + random.below((most - least + 1) as usize) as i32)
}

/// Any triangle, needles down to 1e-8, flat ones along an axis, points and lines, copies of others under ids of their own, neighbours.
pub fn soup(random: &mut Random, scale: f32) -> Vec<Triangle> {
    let mut out: Vec<Triangle> = Vec::with_capacity(SOUP);
    while out.len() < SOUP {
        let at = point(random);
        let size = power(random, -12, 0);
        let near = |random: &mut Random, size: f32| -> [f32; 3] {
            let p = point(random);
            std::array::from_fn(|c| (at[c] + p[c] * size) * scale)
        };
        let (a, b, mut c) = (near(random, size), near(random, size), near(random, size));
        let earlier = (!out.is_empty()).then(|| out[random.below(out.len())]);
        let triangle = match (random.below(7), earlier) {
            (0, _) => [a, b, c],
            (1, _) => {
                // a needle: the third corner beside the middle of the other two
                let thin = power(random, -27, -1);
                let p = point(random);
                c = std::array::from_fn(|i| (a[i] + b[i]) * 0.5 + p[i] * size * thin * scale);
                [a, b, c]
            }
            (2, _) => {
                let axis = random.below(3);
                let mut flat = [a, b, c];
                flat.iter_mut().for_each(|p| p[axis] = a[axis]);
                flat
            }
            (3, _) => [a, b, if random.below(2) == 0 { a } else { b }],
            (4, Some(other)) => other,
            // shares an edge, or a corner
            (5, Some(other)) => [other[1], other[0], c],
            (6, Some(other)) => [other[2], b, c],
            (_, None) | (7.., _) => [a, b, c],
        };
        out.push(triangle);
    }
    out
}

fn shots(random: &mut Random, triangles: &[Triangle], scale: f32) -> Vec<Ray> {
    (0..RAYS)
        .map(|_| {
            let o = point(random).map(|x| x * 1.5 * scale);
            let t = triangles[random.below(triangles.len())];
            let (u, v) = (unit(random), unit(random));
            let to: [f32; 3] = match random.below(4) {
                0 => t[0],
                1 => std::array::from_fn(|c| t[0][c] + (t[1][c] - t[0][c]) * u),
                2 => std::array::from_fn(|c| t[0][c] + (t[1][c] - t[0][c]) * u * (1.0 - v) + (t[2][c] - t[0][c]) * v),
                _ => return axis(random, t[0], scale),
            };
            let d: [f32; 3] = std::array::from_fn(|c| (to[c] - o[c]) / scale);
            ray(o, d)
        })
        .collect()
}

/// Along an axis, through a vertex in the two others.
fn axis(random: &mut Random, through: [f32; 3], scale: f32) -> Ray {
    let axis = random.below(3);
    let sign = signed(random).signum();
    let mut o = through;
    o[axis] -= 2.0 * sign * scale;
    ray(o, std::array::from_fn(|c| if c == axis { sign } else { 0.0 }))
}

/// Each triangle in a forest of its own.
fn one_by_one(tracer: &mut Tracer, triangles: &[(PrimId, Triangle)], rays: &[Ray]) -> Vec<([u32; 3], Option<PrimId>)> {
    let mut best: Vec<(Hit, Option<PrimId>)> = rays.iter().map(|r| (Hit::miss(r.tmax), None)).collect();
    for one in triangles {
        let forest = forest([std::slice::from_ref(one)]);
        for (best, hit) in best.iter_mut().zip(closest(tracer, &forest, rays)) {
            // ids ascend, so the first of several at one distance stays
            if hit.is_hit() && (best.1.is_none() || hit.t < best.0.t) {
                *best = (hit, Some(one.0));
            }
        }
    }
    best.into_iter().map(|(hit, id)| ([hit.t, hit.u, hit.v].map(f32::to_bits), id)).collect()
}

#[test]
fn answers_do_not_depend_on_how_the_scene_is_cut() {
    let least = rays(16 * RAYS as u64).div_ceil(RAYS as u64);
    let mut hit_any = 0;
    rounds("cuts of a soup", least, |random| {
        let scale = power(random, -20, 20);
        let triangles = numbered(&soup(random, scale));
        let only: Vec<Triangle> = triangles.iter().map(|t| t.1).collect();
        let rays = shots(random, &only, scale);
        let mut kernels = kernels();
        let expected = one_by_one(&mut kernels[0], &triangles, &rays);
        hit_any += expected.iter().filter(|e| e.1.is_some()).count();
        for _ in 0..4 {
            let n = 1 + random.below(9);
            let mut parts: Vec<Vec<(PrimId, Triangle)>> = vec![Vec::new(); n];
            for &t in &triangles {
                parts[random.below(n)].push(t);
                // a copy, as overlap reduction makes them
                if random.below(4) == 0 {
                    let part = &mut parts[random.below(n)];
                    if part.last() != Some(&t) {
                        part.push(t);
                    }
                }
            }
            parts.retain(|p| !p.is_empty());
            let forest = forest(parts.iter().map(Vec::as_slice));
            for tracer in &mut kernels {
                let hits = closest(tracer, &forest, &rays);
                let occluded = any(tracer, &forest, &rays);
                let packets = together(tracer.kernel(), &forest, &rays);
                assert!(hits.iter().zip(&packets).all(|(a, b)| answer(&forest, a) == answer(&forest, b)), "packets");
                for (((ray, hit), is_any), expected) in rays.iter().zip(&hits).zip(occluded).zip(&expected) {
                    let kernel = tracer.kernel();
                    assert_eq!(answer(&forest, hit), *expected, "{kernel:?}, {n} blocks, scale {scale}: {ray:?}");
                    assert_eq!(is_any, expected.1.is_some(), "{kernel:?} any: {ray:?}");
                }
            }
        }
    });
    // three of four rays are aimed at something
    println!("{hit_any} rays hit something");
    assert!(hit_any > 0);
}
