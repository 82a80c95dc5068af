//! The light tree against its plain twin: every source walked.

use glam::DVec3;

use super::tests::world;
use super::tree::whole;
use super::*;
use crate::testing::{Rng, chi_square};
use crate::world::Environment;

const ALL: u64 = 1 << 32;

/// Small sources of every kind, all over [-2, 2]^3: triangles, spheres, points, spots.
fn motley(n: usize, rng: &mut Rng) -> World {
    let mut primitives = Vec::new();
    let mut radiances = Vec::new();
    let mut beams = Vec::new();
    for i in 0..n {
        let at = rng.vec3(2.0);
        let strength = libm::expf(rng.range(-4.0, 3.0));
        match i % 4 {
            0 | 1 => {
                let (a, b) = (at + rng.vec3(0.1), at + rng.vec3(0.1));
                primitives.push((Primitive::Triangle([at.into(), a.into(), b.into()]), radiances.len() as u32));
                radiances.push(100.0 * strength);
            }
            2 => {
                let sphere = Primitive::Sphere { center: at.into(), radius: rng.range(0.01, 0.1), flipped: i % 8 == 2 };
                primitives.push((sphere, radiances.len() as u32));
                radiances.push(50.0 * strength);
            }
            _ if i % 8 == 3 => beams.push(Beam::Point { position: at.into(), intensity: [strength; 3] }),
            _ => {
                let beam = rng.range(0.01, 1.0);
                let cutoff = beam + rng.range(0.01, 1.5);
                let axis = rng.direction().into();
                beams.push(Beam::Spot {
                    position: at.into(),
                    axis,
                    intensity: [strength; 3],
                    beam,
                    cutoff,
                    slide: None,
                });
            }
        }
    }
    World { beams, ..world(&primitives, &radiances, None) }
}

/// How many numbers choose each source at a point.
fn numbers(lights: &Lights, o: Vec3, facing: Facing) -> Vec<u64> {
    let tree = lights.tree.as_ref().expect("there are several");
    (0..lights.in_tree).map(|i| tree.numbers(o, facing, i)).collect()
}

/// All around, and two sides.
fn facings(rng: &mut Rng) -> [Facing; 3] {
    let normal = rng.direction();
    [Facing::ANY, Facing::front(normal), Facing::front(-normal)]
}

/// A source that sends nothing to `o`, whatever place on it is taken: by its definition, in f64.
fn is_dark(source: &Source, o: Vec3) -> bool {
    let o = o.as_dvec3();
    match &source.geometry {
        Geometry::Triangle(t) => {
            let (e1, e2) = (t.e1.as_dvec3(), t.e2.as_dvec3());
            e1.cross(e2).dot(o - t.p0.as_dvec3()) <= 0.0
        }
        Geometry::Sphere(_) | Geometry::Beam(Beam::Point { .. }) => false,
        Geometry::Beam(Beam::Spot { position, axis, cutoff, .. }) => {
            let d = o - Vec3::from(*position).as_dvec3();
            let axis: DVec3 = Vec3::from(*axis).as_dvec3();
            d.normalize().dot(axis.normalize()) <= f64::from(*cutoff).cos()
        }
        _ => unreachable!("not in a tree"),
    }
}

/// The intervals fill the tree's share exactly, but for what is dark; whoever is not dark has one, however weak it is and wherever it faces; and what a
/// number chooses is the source in whose interval it lies, with the weight that a hit there is told; that over the interval is its worth.
#[test]
fn intervals_are_exact_and_leave_out_only_the_dark() {
    let mut rng = Rng(31);
    let (mut left_out, mut all) = (0, 0);
    for n in [2, 3, 10, 100, 1000] {
        let world =
            World { environment: [None, Some(Environment::Constant([0.5; 3]))][n % 2].clone(), ..motley(n, &mut rng) };
        let lights = Lights::by_tree(&world);
        let share = lights.tree.as_ref().map_or(0, Tree::share);
        assert_eq!(share == ALL, n % 2 == 0, "the sky has the rest");
        let most = 200_000 / n.max(100);
        for k in 0..most {
            // far away, among them, and just at one
            let o = match (k % 3, &lights.sources[k % lights.in_tree].geometry) {
                (0, _) => rng.vec3(1000.0),
                (1, Geometry::Triangle(t)) => t.p0 + (t.e1 + t.e2) * 0.3 + t.normal * rng.range(-1e-3, 1e-3),
                _ => rng.vec3(2.0),
            };
            let facing = facings(&mut rng)[k % 3];
            let numbers = numbers(&lights, o, facing);
            let dark: Vec<bool> = lights.sources[..lights.in_tree].iter().map(|s| is_dark(s, o)).collect();
            for (i, (&count, &dark)) in numbers.iter().zip(&dark).enumerate() {
                assert!(dark || count > 0, "{o}: source {i} of {n} shines there and is never chosen");
                left_out += u64::from(count == 0);
                all += 1;
            }
            let sum: u64 = numbers.iter().sum();
            assert!(sum <= share);
            for _ in 0..20 {
                let number = rng.u32();
                match lights.choose(o, facing, number).0 {
                    Some(Choice { source, probability: said, worth }) if source < lights.in_tree => {
                        assert!(u64::from(number) < share);
                        let tree = lights.tree.as_ref().unwrap();
                        assert_eq!(said.to_bits(), (tree.weight(o, source) * probability(share)).to_bits());
                        assert_eq!(worth.to_bits(), (said / probability(numbers[source])).to_bits());
                        // the choice is by the weight where all sides are lit, but for what is dealt evenly and roundings
                        let even = f64::from(said) * 1e-4 + 2.0 * n as f64 / ALL as f64;
                        let apart = (f64::from(said) - numbers[source] as f64 / ALL as f64).abs();
                        assert!(!facing.is_any() || apart < even, "{said} {}", numbers[source]);
                    }
                    Some(_) => assert!(u64::from(number) >= share),
                    None => assert!(sum < share),
                }
            }
        }
    }
    println!("{left_out} of {all} left out");
    assert!(left_out * 10 > all, "{left_out} of {all}");
}

/// Counts of what random numbers choose, against the intervals' lengths.
#[test]
fn choices_follow_their_probabilities() {
    let mut rng = Rng(32);
    let lights = Lights::new(&motley(200, &mut rng));
    for i in 0..10 {
        let o = rng.vec3(3.0);
        let facing = facings(&mut rng)[i % 3];
        let numbers = numbers(&lights, o, facing);
        let samples = 200_000;
        let mut counts = vec![0.0; numbers.len() + 1];
        for _ in 0..samples {
            counts[lights.choose(o, facing, rng.u32()).0.map_or(numbers.len(), |c| c.source)] += 1.0;
        }
        let rest = ALL - numbers.iter().sum::<u64>();
        let share = |n: u64| n as f64 / ALL as f64 * f64::from(samples);
        let expected: Vec<f64> = numbers.iter().copied().chain([rest]).map(share).collect();
        assert!(counts.iter().zip(&expected).all(|(c, e)| *e > 0.0 || *c == 0.0));
        chi_square(&counts, &expected);
    }
}

/// What arrives at a point, on a surface of a normal or, without one, on one that faces each light alike, estimated by one sample: mean and variance.
fn estimate(lights: &Lights, o: Vec3, facing: Facing, normal: Option<Vec3>, rng: &mut Rng, samples: u32) -> (f64, f64) {
    let (mut sum, mut squares) = (0.0, 0.0);
    for _ in 0..samples {
        let place = [rng.u32(), rng.u32()];
        let sample = lights.choose(o, facing, rng.u32()).0.and_then(|c| lights.sample_chosen(c, o, facing, place));
        let value = sample.map_or(0.0, |s| {
            let cos = normal.map_or(1.0, |n| s.d.dot(n).max(0.0));
            f64::from(cos) * f64::from(s.radiance.x) / f64::from(s.pdf)
        });
        sum += value;
        squares += value * value;
    }
    let (mean, n) = (sum / f64::from(samples), f64::from(samples));
    (mean, (squares / n - mean * mean) / n)
}

/// Compares two estimates in many places: the same mean within 3 standard errors in nearly all (4.5 in each); how many times less the first's variance is.
fn compare(places: u32, mut estimates: impl FnMut() -> [(f64, f64); 2]) -> f64 {
    let (mut beyond, mut gain) = (0, 0.0);
    for place in 0..places {
        let [(a, va), (b, vb)] = estimates();
        let z = (a - b).abs() / (va + vb).sqrt();
        assert!(!(z >= 4.5), "{place}: {a} {b}, {z} standard errors");
        beyond += u32::from(z > 3.0);
        if va > 0.0 && vb > 0.0 {
            gain += (vb / va).ln() / f64::from(places);
        }
    }
    println!("{beyond} of {places} beyond 3 standard errors; variance {} times less", gain.exp());
    assert!(beyond <= 2, "{beyond}");
    gain.exp()
}

/// The same mean as by power, with half the variance.
#[test]
fn the_mean_is_that_by_power_and_the_variance_less() {
    let mut rng = Rng(33);
    let world = motley(1000, &mut rng);
    let (tree, power) = (Lights::new(&world), Lights::by_power(&world, None));
    let gain = compare(60, || {
        let o = rng.vec3(2.0);
        [&tree, &power].map(|lights| estimate(lights, o, Facing::ANY, None, &mut rng, 40_000))
    });
    assert!(gain > 1.8, "{gain}");
}

/// On a surface that faces one side: the same mean as by power, lit from all around, and less variance than by the tree, lit from all around. Also near a few large
/// lights, where the place on them counts most, down to a surface that touches one.
#[test]
fn the_mean_on_a_side_is_that_of_all_around_and_the_variance_less() {
    let mut rng = Rng(36);
    let many = motley(1000, &mut rng);
    let large = (0..6).map(|i| {
        let at = rng.vec3(1.5);
        (Primitive::Triangle([at.into(), (at + rng.vec3(1.5)).into(), (at + rng.vec3(1.5)).into()]), i)
    });
    let large = world(&large.collect::<Vec<_>>(), &[1.0, 2.0, 0.5, 1.0, 3.0, 0.2], None);
    let one = world(&[(Primitive::Triangle([[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), 0)], &[1.0], None);
    for (world, least) in [(&many, 1.1), (&large, 1.2), (&one, 1.1)] {
        let (lights, power) = (Lights::new(world), Lights::by_power(world, None));
        let mut place = 0;
        let mut places = |rng: &mut Rng| {
            place += 1;
            let near = Vec3::new(rng.range(-0.5, 0.5), -libm::exp2f(-(place % 12) as f32), rng.range(-0.9, 0.5));
            (if std::ptr::eq(world, &one) { near } else { rng.vec3(2.0) }, rng.direction())
        };
        compare(60, || {
            let (o, n) = places(&mut rng);
            let side = estimate(&lights, o, Facing::front(n), Some(n), &mut rng, 40_000);
            [side, estimate(&power, o, Facing::ANY, Some(n), &mut rng, 40_000)]
        });
        let gain = compare(60, || {
            let (o, n) = places(&mut rng);
            [Facing::front(n), Facing::ANY].map(|facing| estimate(&lights, o, facing, Some(n), &mut rng, 40_000))
        });
        assert!(gain > least, "{gain}");
    }
}

/// One lamp of at most eight primitives is chosen from by power; more make a tree, whose only node serves a few.
#[test]
fn one_lamp_needs_no_tree() {
    let quad = [
        (Primitive::Triangle([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), 0),
        (Primitive::Triangle([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]]), 0),
    ];
    let one = Lights::new(&world(&quad, &[1.0], None));
    assert!(one.tree.is_none() && matches!(one.few(), Some(Few::ByPower(few)) if few.len() == 2));
    let ball = (Primitive::Sphere { center: [0.0; 3], radius: 1.0, flipped: false }, 0);
    assert!(Lights::new(&world(&[ball], &[1.0], Some([1.0; 3]))).tree.is_none());
    let two = Lights::new(&world(&[quad[0], quad[1], (ball.0, 1)], &[1.0, 1.0], None));
    let Some(Few::ByPlace(_, few)) = two.few() else { panic!("not few") };
    assert_eq!(few.iter().filter(|l| matches!(l.shape, FewShape::Sphere(_))).count(), 1);
    let inward = (Primitive::Sphere { center: [0.0; 3], radius: 1.0, flipped: true }, 1);
    assert!(Lights::new(&world(&[quad[0], inward], &[1.0, 1.0], None)).few().is_none());
    let pair = |n: u32| [(quad[0].0, n), (quad[1].0, n)];
    let four: Vec<_> = (0..4).flat_map(pair).collect();
    let lights = Lights::new(&world(&four, &[1.0, 2.0, 3.0, 4.0], None));
    let Some(Few::ByPlace(node, few)) = lights.few() else { panic!("not few") };
    assert_eq!((node.children(), few.len()), (8, 8));
    for (k, light) in few.iter().enumerate() {
        let source = &lights.sources[node.source(k).unwrap() as usize];
        let Geometry::Triangle(t) = source.geometry else { panic!("no triangle") };
        assert!(matches!(light.shape, FewShape::Triangle(l) if l.p0 == t.p0) && source.emission == light.radiance);
    }
    let five = Lights::new(&world(&[four, pair(4).to_vec()].concat(), &[1.0; 5], None));
    assert!(five.tree.is_some() && five.few().is_none());
}

/// Lights in one place, on a line, of powers from 1e-30 to 1e30, and points that are none: every choice is a source with a probability.
#[test]
fn odd_trees() {
    let mut rng = Rng(34);
    let point = |x: f32, i: f32| Beam::Point { position: [x, 0.0, 0.0], intensity: [i; 3] };
    let cases: [Vec<Beam>; 4] = [
        (0..300).map(|_| point(1.0, 1.0)).collect(),
        (0..300).map(|i| point(i as f32, 1.0)).collect(),
        (0..60).map(|i| point(libm::exp2f(i as f32), 1.0)).collect(),
        (0..60).map(|i| point(i as f32, libm::exp10f(i as f32 - 30.0))).collect(),
    ];
    for beams in cases {
        let lights = Lights::new(&World { beams, ..world(&[], &[], None) });
        for o in [Vec3::ZERO, Vec3::X, Vec3::splat(f32::MAX), Vec3::splat(1e30), Vec3::NAN, rng.vec3(50.0)] {
            let facing = facings(&mut rng)[rng.u32() as usize % 3];
            let numbers = numbers(&lights, o, facing);
            assert_eq!(numbers.iter().sum::<u64>(), ALL, "{o}");
            assert!(numbers.iter().all(|&n| n > 0), "{o}: {numbers:?}");
            let choice = lights.choose(o, facing, rng.u32()).0.expect("something shines");
            assert!(choice.probability > 0.0 && choice.worth > 0.0 && choice.worth < f32::INFINITY);
        }
    }
}

/// What vectors do is what the cast does, over all that occurs.
#[test]
fn whole_numbers_are_those_of_the_cast() {
    let mut rng = Rng(35);
    let ends =
        [0.0, 1e-30, 0.5, 0.999_999_94, 1.0, 1.5, 2.5, 8_388_607.5, 16_777_215.0, 2_147_483_648.0, 4_294_967_040.0];
    for x in ends {
        assert_eq!(whole(x), x as u32, "{x}");
    }
    for _ in 0..1_000_000 {
        let x = rng.f32() * libm::exp2f((rng.u32() % 33) as f32);
        assert_eq!(whole(x), x as u32, "{x}");
    }
}
