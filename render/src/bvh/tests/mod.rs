//! The kernels against brute force, against each other, and over forests of several blocks.

mod corrupt;
mod leaks;

use super::testing::*;
use super::trace::brute_force;
use super::*;
use crate::ray::{Hit, MISS, PrimId, Ray};
use crate::world::Primitive;

/// Triangles of about a size in a cube.
fn soup(random: &mut Random, n: usize, size: f32, edge: f32) -> Vec<Triangle> {
    let near = |p: [f32; 3], q: [f32; 3]| std::array::from_fn(|c| p[c] + q[c]);
    (0..n)
        .map(|_| {
            let p = random.point(size);
            std::array::from_fn(|_| near(p, random.point(edge)))
        })
        .collect()
}

/// A regular grid in the plane z = 0 and another across it: shared edges and vertices on round numbers, equal costs.
fn grids(n: usize) -> Vec<Triangle> {
    let at = |i: usize| i as f32 / n as f32 * 2.0 - 1.0;
    let mut out = Vec::new();
    for i in 0..n {
        for j in 0..n {
            let [a, b, c, d] = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(x, y)| [at(x), at(y)]);
            for t in [[a, b, c], [a, c, d]] {
                out.push(t.map(|[x, y]| [x, y, 0.0]));
                out.push(t.map(|[x, y]| [0.25, x, y]));
            }
        }
    }
    out
}

/// Needles and near-degenerate triangles: long, thin by many powers of two, some with two equal vertices or none apart.
fn slivers(random: &mut Random, n: usize) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let (a, b) = (random.point(1.0), random.point(1.0));
            let thin = 2f32.powi(-(random.below(40) as i32));
            let s = random.unit();
            let off = random.point(thin);
            let c = std::array::from_fn(|k| a[k] + (b[k] - a[k]) * s + off[k]);
            match i % 20 {
                0 => [a, b, b],
                1 => [a, a, a],
                _ => [a, b, c],
            }
        })
        .collect()
}

/// Rays from about the scene to its vertices, edges, inner points and elsewhere; some along axes, some with limits.
fn rays_for(random: &mut Random, triangles: &[Triangle], n: usize, size: f32) -> Vec<Ray> {
    (0..n)
        .map(|_| {
            let t = if triangles.is_empty() { [[0.0; 3]; 3] } else { triangles[random.below(triangles.len())] };
            let (s, r) = (random.unit(), random.unit());
            let target: [f32; 3] = match random.below(4) {
                0 => t[random.below(3)],
                1 => std::array::from_fn(|c| t[0][c] + (t[1][c] - t[0][c]) * s),
                2 => std::array::from_fn(|c| t[0][c] + ((t[1][c] - t[0][c]) * s + (t[2][c] - t[0][c]) * (1.0 - s)) * r),
                _ => random.point(size),
            };
            let (mut o, mut d);
            if random.below(4) == 0 {
                let (axis, sign) = (random.below(3), if random.below(2) == 0 { 1.0 } else { -1.0 });
                d = [if random.below(2) == 0 { 0.0 } else { -0.0 }; 3];
                d[axis] = sign;
                if random.below(4) == 0 {
                    d[(axis + 1) % 3] = 2f32.powi(-(random.below(100) as i32));
                }
                o = target;
                o[axis] -= sign * size * 2.0 * random.unit();
            } else {
                o = random.point(size * 1.5);
                if random.below(8) == 0 {
                    o = o.map(|x| x * 1000.0);
                }
                d = std::array::from_fn(|c| target[c] - o[c]);
                let length = d.iter().fold(0f32, |m, x| m.max(x.abs()));
                if random.below(2) == 0 && length > 0.0 {
                    d = d.map(|x| x / length);
                }
            }
            let (tmin, tmax) = match random.below(6) {
                0 => (random.signed() * 0.5, random.unit() * 2.0),
                1 => (0.0, 1.0),
                _ => (0.0, f32::INFINITY),
            };
            Ray { o, tmin, d, tmax }
        })
        .collect()
}

/// Spheres of many sizes, some within each other.
fn balls(random: &mut Random, n: usize, size: f32) -> Vec<Sphere> {
    (0..n)
        .map(|i| Sphere {
            center: random.point(size),
            radius: size * 2f32.powi(-(random.below(12) as i32)),
            flipped: i % 3 == 0,
        })
        .collect()
}

/// Every kernel, sorted or not, on every forest gives the brute-force answer.
fn check_all(forests: &[Forest], triangles: &[Triangle], spheres: &[Sphere], rays: &[Ray]) {
    for forest in forests {
        let expected: Vec<_> = rays.iter().map(|r| brute_force(triangles, spheres, r, forest.largest())).collect();
        for mut tracer in kernels() {
            for is_sorted in [false, true] {
                tracer.set_sorting(is_sorted);
                let hits = closest(&mut tracer, forest, rays);
                let occluded = any(&mut tracer, forest, rays);
                let together = together(tracer.kernel(), forest, rays);
                for (i, ray) in rays.iter().enumerate() {
                    assert_eq!(identity(forest, &hits[i]), expected[i], "{:?} {ray:?}", tracer.kernel());
                    assert_eq!(identity(forest, &together[i]), expected[i], "{:?} {ray:?}", tracer.kernel());
                    assert_eq!(occluded[i], hits[i].prim != MISS, "{:?} {ray:?}", tracer.kernel());
                    if together[i].prim != MISS {
                        let id = forest.prim_id(together[i].prim) as usize;
                        check_primitive(forest, &together[i], triangles.get(id), spheres, id, triangles.len());
                    }
                    if hits[i].prim != MISS {
                        let id = forest.prim_id(hits[i].prim) as usize;
                        check_primitive(forest, &hits[i], triangles.get(id), spheres, id, triangles.len());
                    }
                }
            }
        }
    }
}

fn check_primitive(forest: &Forest, hit: &Hit, t: Option<&Triangle>, spheres: &[Sphere], id: usize, first: usize) {
    match (forest.primitive(hit), t) {
        (Primitive::Triangle(a), Some(b)) => assert_eq!(a, *b),
        (Primitive::Sphere { center, radius, flipped }, None) => {
            assert_eq!(Sphere { center, radius, flipped }, spheres[id - first]);
        }
        (a, b) => panic!("{a:?} {b:?}"),
    }
}

#[test]
fn every_kernel_gives_the_brute_force_answer() {
    let mut random = Random::new(1);
    for (n, size, edge) in
        [(0, 1.0, 0.1), (1, 1.0, 1.0), (7, 1.0, 1.0), (9, 1.0, 1.0), (1500, 1.0, 0.1), (300, 1e6, 1e6)]
    {
        let triangles = soup(&mut random, n, size, edge);
        let rays = rays_for(&mut random, &triangles, 500, size);
        check_all(&[forest(&[block(&triangles, &[])])], &triangles, &[], &rays);
    }
}

#[test]
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
fn few_primitives_give_the_brute_force_answer() {
    let mut random = Random::new(41);
    for round in 0..40 {
        // needles stand in several leaves, grids have equal distances and shared edges
        let mut triangles = match round % 4 {
            0 => soup(&mut random, round, 1.0, 0.5),
            1 => slivers(&mut random, 1 + round / 3),
            2 => grids(1 + round / 16),
            _ => soup(&mut random, 3, 1.0, 2.0),
        };
        if let Some(&first) = triangles.first() {
            triangles.extend([first; 3]);
        }
        let scale = [1.0, 1.0, 1e-9, 1e-30, 1e6][round % 5];
        let triangles: Vec<Triangle> = triangles.iter().map(|t| t.map(|p| p.map(|x| x * scale))).collect();
        let mut spheres = balls(&mut random, if round % 3 == 0 { 0 } else { round % 14 }, scale);
        if let Some(&first) = spheres.first() {
            spheres.push(first);
        }
        let n = triangles.len() + spheres.len();
        let ids: Vec<PrimId> = (0..n as PrimId).collect();
        // one block, and two with copies in both
        let (even, odd): (Vec<PrimId>, Vec<PrimId>) = ids.iter().partition(|&id| id % 2 == 0);
        let doubled = [&odd[..], &even[..even.len().min(4)]].concat();
        let sorted = |mut ids: Vec<PrimId>| {
            ids.sort_unstable();
            ids
        };
        let two = [part(&triangles, &spheres, &even), part(&triangles, &spheres, &sorted(doubled))];
        let forests = [forest(&[block(&triangles, &spheres)]), forest(&two)];
        assert!(forests.iter().all(|f| f.few().is_some()), "{n} are few");
        let rays = rays_for(&mut random, &triangles, 403, scale);
        check_all(&forests, &triangles, &spheres, &rays);
    }
    let many = forest(&[block(&soup(&mut random, 200, 1.0, 0.1), &[])]);
    assert!(many.few().is_none(), "a tree serves many");
}

#[test]
fn coherent_rays_read_a_node_once_for_all() {
    let mut random = Random::new(42);
    let triangles = soup(&mut random, 20_000, 1.0, 0.05);
    let forest = forest(&[block(&triangles, &[])]);
    let mut camera = |from: [f32; 3], spread: f32| -> Vec<Ray> {
        let across = 64;
        let at = |i: usize| (i as f32 + 0.5) / across as f32 * 2.0 - 1.0;
        let pixels = (0..across * across).flat_map(|p| [[at(p % across), at(p / across)]; 4]);
        pixels
            .map(|[x, y]| {
                let (x, y) = (x + random.signed() * spread, y + random.signed() * spread);
                Ray { o: from, tmin: 0.0, d: [x * 0.5, y * 0.5, 1.0], tmax: f32::INFINITY }
            })
            .collect()
    };
    for mut tracer in kernels() {
        // from outside and from within; then rays that part, which are traced one by one soon
        for (from, spread) in [([0.0, 0.0, -3.0], 0.01), ([0.1, 0.2, -0.5], 0.01), ([0.1, 0.2, 0.3], 20.0)] {
            let rays = camera(from, spread);
            let expected = closest(&mut tracer, &forest, &rays);
            for _ in 0..3 {
                let mut hits = vec![Hit::miss(0.0); rays.len()];
                tracer.closest_coherent(&forest, &rays, &mut hits);
                for (a, b) in hits.iter().zip(&expected) {
                    assert_eq!(identity(&forest, a), identity(&forest, b), "{:?}", tracer.kernel());
                }
            }
        }
    }
}

#[test]
fn adversarial_soups_give_the_brute_force_answer() {
    let mut random = Random::new(2);
    let scale = |triangles: &[Triangle], s: f32| -> Vec<Triangle> {
        triangles.iter().map(|t| t.map(|p| p.map(|x| x * s))).collect()
    };
    let sharp = slivers(&mut random, 600);
    let mut mixed = sharp.clone();
    mixed.extend(grids(8));
    mixed.extend(soup(&mut random, 100, 1.0, 1e-4));
    mixed.extend(soup(&mut random, 20, 100.0, 100.0));
    // the same triangle many times: equal distances
    mixed.extend(vec![mixed[700]; 20]);
    for (triangles, size) in [
        (grids(20), 1.0),
        (sharp.clone(), 1.0),
        (mixed, 2.0),
        (scale(&sharp, 1e-9), 1e-9),
        (scale(&sharp, 1e-30), 1e-30),
        (scale(&sharp, 1e11), 1e11),
        (scale(&grids(10), 1e-38), 1e-38),
    ] {
        let rays = rays_for(&mut random, &triangles, 600, size);
        check_all(&[forest(&[block(&triangles, &[])])], &triangles, &[], &rays);
    }
}

/// Oblique planes of long triangles, and rays within them: all are seen from their edges, sheared vertices are noise, and t
/// from careless barycentrics would be anywhere in a triangle, before the ray enters its box.
#[test]
fn triangles_seen_from_their_edges_are_not_lost() {
    let mut random = Random::new(14);
    let mut triangles = Vec::new();
    let mut rays = Vec::new();
    for _ in 0..12 {
        let (center, a, b) = (random.point(0.3), random.point(1.0), random.point(1.0));
        let at = |s: f32, t: f32| -> [f32; 3] { std::array::from_fn(|c| center[c] + a[c] * s + b[c] * t) };
        for _ in 0..100 {
            let (s, t) = (random.signed(), random.signed());
            triangles.push(std::array::from_fn(|_| at(s + random.signed() * 0.5, t + random.signed() * 0.1)));
        }
        for _ in 0..250 {
            let (o, p) = (at(random.signed() * 3.0, random.signed() * 3.0), at(random.signed(), random.signed()));
            rays.push(Ray { o, tmin: 0.0, d: std::array::from_fn(|c| p[c] - o[c]), tmax: f32::INFINITY });
        }
    }
    check_all(&[forest(&[block(&triangles, &[])])], &triangles, &[], &rays);
}

#[test]
fn spheres_beside_triangles() {
    let mut random = Random::new(3);
    for (nt, ns) in [(0, 1), (0, 100), (300, 5), (300, 100)] {
        let triangles = soup(&mut random, nt, 1.0, 0.3);
        let spheres = balls(&mut random, ns, 1.0);
        let rays = rays_for(&mut random, &triangles, 500, 1.0);
        check_all(&[forest(&[block(&triangles, &spheres)])], &triangles, &spheres, &rays);
    }
}

#[test]
fn a_sphere_is_hit_where_it_is() {
    let sphere = Sphere { center: [1.0, 2.0, 3.0], radius: 0.5, flipped: true };
    let forest = forest(&[block(&[], &[sphere])]);
    let mut random = Random::new(4);
    let rays: Vec<Ray> = (0..2000)
        .map(|_| {
            let o = std::array::from_fn(|c| sphere.center[c] + random.signed() * 3.0);
            let p = random.point(0.7);
            Ray { o, tmin: 0.0, d: std::array::from_fn(|c| sphere.center[c] + p[c] - o[c]), tmax: f32::INFINITY }
        })
        .collect();
    let mut tracer = Tracer::new(Kernel::Auto).unwrap();
    let hits = closest(&mut tracer, &forest, &rays);
    for (ray, hit) in rays.iter().zip(&hits) {
        let from = |t: f64| -> f64 {
            (0..3)
                .map(|c| {
                    let x = f64::from(ray.o[c]) + t * f64::from(ray.d[c]) - f64::from(sphere.center[c]);
                    x * x
                })
                .sum::<f64>()
                .sqrt()
        };
        if hit.is_hit() {
            // (1.8 + 6) u M, M = 6.5, of the bound
            assert!((from(f64::from(hit.t)) - 0.5).abs() < 8.0 * 6.5 / f64::from(1 << 24), "{ray:?} {hit:?}");
            let before = from(f64::from(hit.t) * 0.999);
            assert!((before > 0.5) == (from(0.0) > 0.5) || hit.t < 1e-3, "not the nearest: {ray:?} {hit:?}");
        } else {
            let least = (0..4000).map(|i| from(f64::from(i) * 1e-3)).fold(f64::INFINITY, f64::min);
            assert!(least > 0.5 - 1e-6, "missed: {ray:?}");
        }
    }
    assert!(hits.iter().filter(|h| h.is_hit()).count() > 500);
    assert!(hits.iter().filter(|h| !h.is_hit()).count() > 100);
}

/// The primitives with these ids as a block.
fn part(triangles: &[Triangle], spheres: &[Sphere], ids: &[PrimId]) -> Vec<u8> {
    let (t, s): (Vec<PrimId>, Vec<PrimId>) = ids.iter().partition(|&&id| (id as usize) < triangles.len());
    let of_t: Vec<Triangle> = t.iter().map(|&id| triangles[id as usize]).collect();
    let of_s: Vec<Sphere> = s.iter().map(|&id| spheres[id as usize - triangles.len()]).collect();
    build_block(&of_t, &t, &of_s, &s, &Serial).unwrap()
}

#[test]
fn several_blocks_answer_as_one() {
    let mut random = Random::new(5);
    let mut triangles = soup(&mut random, 700, 1.0, 0.2);
    triangles.extend(grids(8));
    let spheres = balls(&mut random, 12, 0.7);
    let n = triangles.len() + spheres.len();
    let rays = rays_for(&mut random, &triangles, 400, 1.0);
    let slab = |parts: usize| -> Vec<Vec<PrimId>> {
        (0..parts).map(|p| (p * n / parts..(p + 1) * n / parts).map(|i| i as PrimId).collect()).collect()
    };
    let mut scattered: Vec<Vec<PrimId>> = vec![Vec::new(); 5];
    for id in 0..n {
        // copies in other blocks, and every id in one at least
        scattered[id % 5].push(id as PrimId);
        let other = random.below(10);
        if other < 5 && other != id % 5 {
            scattered[other].push(id as PrimId);
        }
    }
    let doubled = [slab(3), slab(2), vec![Vec::new()]].concat();
    for parts in [slab(2), slab(40), scattered, doubled] {
        let objects: Vec<Vec<u8>> = parts.iter().map(|ids| part(&triangles, &spheres, ids)).collect();
        check_all(&[forest(&objects)], &triangles, &spheres, &rays);
    }
}

#[test]
fn blocks_come_and_go() {
    let mut random = Random::new(6);
    let triangles = soup(&mut random, 600, 1.0, 0.2);
    let spheres = balls(&mut random, 8, 0.5);
    let n = triangles.len() + spheres.len();
    let mut forest = Forest::new(1 << 20).unwrap();
    let empty = forest.bytes_free();
    let mut there: Vec<(BlockHandle, Vec<PrimId>)> = Vec::new();
    let mut gone: Vec<BlockHandle> = Vec::new();
    let mut tracers = kernels();
    for step in 0..60 {
        if there.len() < 8 && random.below(3) != 0 {
            let (from, len) = (random.below(n), random.below(200));
            let ids: Vec<PrimId> = (from..(from + len).min(n)).map(|i| i as PrimId).collect();
            let handle = forest.insert(&part(&triangles, &spheres, &ids)).unwrap();
            assert!(!gone.contains(&handle), "a handle was used twice");
            there.push((handle, ids));
        } else if !there.is_empty() {
            let (handle, _) = there.swap_remove(random.below(there.len()));
            assert!(forest.remove(handle));
            assert!(!forest.remove(handle), "removed twice");
            gone.push(handle);
        }
        assert!(!forest.is_finished() || step == 0);
        forest.finish().unwrap();
        assert_eq!(forest.handles().len(), there.len());
        let mut taken: Vec<std::ops::Range<u32>> = Vec::new();
        for (handle, ids) in &there {
            let slots = forest.slots(*handle).unwrap();
            assert_eq!(slots.len(), ids.len());
            for (local, (slot, id)) in slots.clone().zip(ids).enumerate() {
                assert_eq!(forest.slot(slot), (*handle, local as u32));
                assert_eq!(forest.prim_id(slot), *id);
            }
            assert!(taken.iter().all(|t| t.end <= slots.start || slots.end <= t.start));
            taken.push(slots);
        }
        assert!(gone.iter().all(|h| forest.slots(*h).is_none()));
        let rays = rays_for(&mut random, &triangles, 40, 1.0);
        let mut all: Vec<PrimId> = there.iter().flat_map(|t| t.1.clone()).collect();
        all.sort_unstable();
        all.dedup();
        let (t, s): (Vec<PrimId>, Vec<PrimId>) = all.iter().partition(|&&id| (id as usize) < triangles.len());
        let of_t: Vec<Triangle> = t.iter().map(|&id| triangles[id as usize]).collect();
        let of_s: Vec<Sphere> = s.iter().map(|&id| spheres[id as usize - triangles.len()]).collect();
        for tracer in &mut tracers {
            for (ray, hit) in rays.iter().zip(closest(tracer, &forest, &rays)) {
                let (bits, place) = brute_force(&of_t, &of_s, ray, forest.largest());
                assert_eq!(identity(&forest, &hit), (bits, place.map(|p| all[p as usize])));
            }
        }
    }
    for (handle, _) in there {
        forest.remove(handle);
    }
    forest.finish().unwrap();
    assert_eq!(forest.bytes_free(), empty);
    assert_eq!((forest.bytes_used(), forest.primitives(), forest.bounds()), (0, 0, None));
}

#[test]
fn what_does_not_fit_is_an_error_and_changes_nothing() {
    assert!(matches!(Forest::new((8 << 30) + 1), Err(ForestError::Capacity { .. })));
    let mut random = Random::new(7);
    let triangles = soup(&mut random, 100, 1.0, 0.2);
    let object = block(&triangles, &[]);
    let mut forest = Forest::new(object.len() as u64 + 1000).unwrap();
    let handle = forest.insert(&object).unwrap();
    assert!(matches!(forest.insert(&object), Err(ForestError::Full { .. })));
    assert!(matches!(
        forest.insert(&object[..object.len() - 1]),
        Err(ForestError::Full { .. } | ForestError::Block(_))
    ));
    forest.finish().unwrap();
    let rays = rays_for(&mut random, &triangles, 100, 1.0);
    check_all(std::slice::from_ref(&forest), &triangles, &[], &rays);
    assert!(forest.remove(handle));
    assert!(matches!(forest.insert(&object[1..]), Err(ForestError::Block(BlockError::Format(_)))));
    forest.insert(&object).unwrap();
    forest.finish().unwrap();
    check_all(&[forest], &triangles, &[], &rays);
}

#[test]
fn what_cannot_be_built_is_an_error() {
    let t = [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]; 2];
    assert_eq!(build_block(&t, &[3], &[], &[], &Serial), Err(BuildError::Counts { primitives: 2, ids: 1 }));
    assert_eq!(build_block(&t, &[3, 3], &[], &[], &Serial), Err(BuildError::Order { before: 3, after: 3 }));
    for wrong in [f32::NAN, f32::INFINITY, -2e12] {
        let mut bad = t;
        bad[1][2][1] = wrong;
        assert_eq!(build_block(&bad, &[3, 5], &[], &[], &Serial), Err(BuildError::Unsound { id: 5 }));
    }
    for radius in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let bad = Sphere { center: [0.0; 3], radius, flipped: false };
        assert_eq!(build_block(&[], &[], &[bad], &[9], &Serial), Err(BuildError::Unsound { id: 9 }));
    }
}

#[test]
fn strange_rays_have_defined_answers() {
    let mut random = Random::new(8);
    let triangles = soup(&mut random, 500, 1.0, 0.3);
    let spheres = balls(&mut random, 5, 0.5);
    let forest = forest(&[block(&triangles, &spheres)]);
    let odd = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::MAX,
        -f32::MAX,
        f32::MIN_POSITIVE,
        1e-45,
        0.0,
        -0.0,
        1e13,
        1.0,
    ];
    let plain = Ray { o: [0.0, 0.0, -3.0], tmin: 0.0, d: [0.0, 0.0, 1.0], tmax: f32::INFINITY };
    let mut rays = Vec::new();
    for a in odd {
        for k in 0..3 {
            let mut r = plain;
            r.o[k] = a;
            rays.push(r);
            let mut r = plain;
            r.d[k] = a;
            rays.push(r);
            rays.push(Ray { d: std::array::from_fn(|c| if c == k { 1e-3 } else { a }), ..plain });
            rays.push(Ray { d: [a; 3], ..plain });
        }
        for b in odd {
            rays.push(Ray { tmin: a, tmax: b, ..plain });
        }
    }
    for _ in 0..2000 {
        // any bits at all
        let mut bits = || f32::from_bits(random.bits());
        rays.push(Ray { o: [bits(), bits(), bits()], tmin: bits(), d: [bits(), bits(), bits()], tmax: bits() });
    }
    check_all(std::slice::from_ref(&forest), &triangles, &spheres, &rays);
    let mut tracer = Tracer::new(Kernel::Auto).unwrap();
    for (ray, hit) in rays.iter().zip(closest(&mut tracer, &forest, &rays)) {
        let numbers = [ray.o, ray.d].concat();
        let is_nothing = numbers.iter().any(|x| !x.is_finite())
            || ray.d == [0.0; 3]
            || ray.tmin.is_nan()
            || ray.tmax.is_nan()
            || ray.tmax <= ray.tmin.max(0.0);
        assert!(!(is_nothing && hit.is_hit()), "{ray:?} {hit:?}");
        assert!(hit.is_hit() || hit.t.to_bits() == ray.tmax.to_bits());
    }
}

#[test]
fn batches_of_every_length() {
    let mut random = Random::new(9);
    let triangles = soup(&mut random, 2000, 1.0, 0.1);
    let forest = forest(&[block(&triangles, &[])]);
    let rays = rays_for(&mut random, &triangles, 200, 1.0);
    let expected = closest(&mut Tracer::new(Kernel::Scalar).unwrap(), &forest, &rays);
    for mut tracer in kernels() {
        for n in 0..rays.len() {
            assert_eq!(closest(&mut tracer, &forest, &rays[..n]), expected[..n], "{:?}", tracer.kernel());
        }
        assert_eq!(tracer.counters().rays, (0..rays.len() as u64).sum::<u64>());
    }
}

/// Two threads for each call.
struct Threads;

impl Fork for Threads {
    fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
        std::thread::scope(|scope| {
            scope.spawn(a);
            b();
        });
    }
}

#[test]
fn building_in_parallel_changes_no_byte() {
    let mut random = Random::new(10);
    let mut triangles = soup(&mut random, 60_000, 1.0, 0.01);
    triangles.extend(grids(80));
    let ids: Vec<PrimId> = (0..triangles.len() as u64).map(|i| i * 3).collect();
    let serial = build_block(&triangles, &ids, &[], &[], &Serial).unwrap();
    let parallel = build_block(&triangles, &ids, &[], &[], &Threads).unwrap();
    assert!(serial == parallel);
    // and the bytes are those of any other machine
    let hash = blake3::hash(&serial).to_hex();
    assert_eq!(&hash[..16], "0a2dfae35ce6d73f");
}

#[test]
fn regular_grids_make_good_trees() {
    // PLOC builders need hundreds of visits here
    let n = 100;
    let triangles = grids(n);
    let forest = forest(&[block(&triangles, &[])]);
    let mut random = Random::new(11);
    let rays = rays_for(&mut random, &triangles, 5000, 1.0);
    let mut tracer = Tracer::new(Kernel::Auto).unwrap();
    closest(&mut tracer, &forest, &rays);
    let visits = tracer.counters().nodes as f64 / rays.len() as f64;
    assert!(visits < 20.0, "{visits} nodes a ray");
}

#[test]
fn slabs_in_source_order_trace_nearly_as_one_tree() {
    let mut random = Random::new(12);
    let mut triangles = soup(&mut random, 40_000, 1.0, 0.02);
    triangles.sort_by(|a, b| a[0][2].total_cmp(&b[0][2]));
    let rays = rays_for(&mut random, &triangles, 5000, 1.0);
    let visits = |parts: usize| {
        let n = triangles.len();
        let objects: Vec<Vec<u8>> = (0..parts)
            .map(|p| {
                let ids: Vec<PrimId> = (p * n / parts..(p + 1) * n / parts).map(|i| i as PrimId).collect();
                part(&triangles, &[], &ids)
            })
            .collect();
        let mut tracer = Tracer::new(Kernel::Auto).unwrap();
        closest(&mut tracer, &forest(&objects), &rays);
        tracer.counters().nodes as f64
    };
    let (one, eight) = (visits(1), visits(8));
    assert!(eight < 1.3 * one, "{eight} nodes against {one}");
}
