use glam::Vec3;

use super::*;
use crate::material::{Bsdf, Material};
use crate::math::UnitDir;
use crate::sampler::Stream;
use crate::testing::{Rng, chi_square, integrate_bins, sphere_bin};
use crate::world::{EmissivePrimitive, Environment, ShapeInfo};

/// A world of emissive primitives, each of the shape and the radiance given.
pub(super) fn world(primitives: &[(Primitive, u32)], radiances: &[f32], environment: Option<[f32; 3]>) -> World {
    World {
        materials: vec![Material::new("", Bsdf::Diffuse { reflectance: [0.5; 3] }, true)],
        shapes: radiances
            .iter()
            .map(|&r| ShapeInfo { name: String::new(), material: 0, emission: Some([r; 3]), emission_texture: None })
            .collect(),
        emissive: primitives
            .iter()
            .enumerate()
            .map(|(i, &(geometry, shape))| EmissivePrimitive { prim: 10 + 3 * i as u64, shape, geometry })
            .collect(),
        beams: vec![],
        environment: environment.map(Environment::Constant),
        lo: [-2.0; 3],
        hi: [2.0; 3],
        ..World::default()
    }
}

fn mixed() -> Vec<(Primitive, u32)> {
    vec![
        (Primitive::Triangle([[-1.0, 2.0, -1.0], [1.0, 2.0, -1.0], [0.0, 2.0, 1.5]]), 0),
        (Primitive::Triangle([[2.0, 0.0, 0.0], [2.0, 0.0, 1.0], [2.0, 1.0, 0.0]]), 1),
        (Primitive::Sphere { center: [-1.5, 0.5, 0.5], radius: 0.4, flipped: false }, 2),
        (Primitive::Sphere { center: [0.0, 0.0, 0.0], radius: 5.0, flipped: true }, 3),
    ]
}

/// In f64: where the ray meets the fronts, the density that `Lights` says, summed over all of them.
fn density(lights: &Lights, primitives: &[(Primitive, u32)], o: Vec3, d: Vec3) -> f64 {
    let mut sum = 0.0;
    let (o, d) = (o.as_dvec3(), d.as_dvec3());
    for (i, (geometry, _)) in primitives.iter().enumerate() {
        let mut meet = |t: f64, cos: f64| {
            if t > 0.0 && cos > 0.0 {
                sum += f64::from(lights.pdf(10 + 3 * i as u64, o.as_vec3(), t as f32, cos as f32));
            }
        };
        match geometry {
            Primitive::Triangle(v) => {
                let [a, b, c] = v.map(|p| Vec3::from(p).as_dvec3());
                let n = (b - a).cross(c - a);
                let t = (a - o).dot(n) / d.dot(n);
                let p = o + d * t;
                let inside = [(a, b), (b, c), (c, a)].iter().all(|(p0, p1)| (*p1 - *p0).cross(p - *p0).dot(n) >= 0.0);
                if inside {
                    meet(t, -d.dot(n) / n.length());
                }
            }
            Primitive::Sphere { center, radius, flipped } => {
                let f = o - Vec3::from(*center).as_dvec3();
                let r = f64::from(*radius);
                let (b, c) = (f.dot(d), f.length_squared() - r * r);
                let disc = b * b - c;
                if disc > 0.0 {
                    for t in [-b - disc.sqrt(), -b + disc.sqrt()] {
                        let n = (f + d * t) / r * if *flipped { -1.0 } else { 1.0 };
                        meet(t, -d.dot(n));
                    }
                }
            }
        }
    }
    sum + f64::from(lights.sky(d.as_vec3()).1)
}

/// Directions, after snapping, are distributed as the density, which the other side of MIS uses.
#[test]
fn samples_follow_the_density() {
    for (sky, seed) in [(None, 1), (Some([0.1; 3]), 2)] {
        let primitives = mixed();
        let lights = Lights::new(&world(&primitives, &[3.0, 10.0, 5.0, 0.05], sky));
        for o in [Vec3::new(0.1, -0.3, 0.2), Vec3::new(1.0, 1.0, -1.0)] {
            let bins = 20;
            let mut counts = vec![0.0; 2 * bins * bins];
            let n = 400_000;
            let mut outside = 0.0;
            let mut rng = Rng(seed);
            for _ in 0..n {
                match lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]) {
                    Some(s) => {
                        let d = Vec3::from(UnitDir::encode(s.d.to_array()).decode());
                        counts[sphere_bin(d, bins)] += 1.0;
                    }
                    None => outside += 1.0,
                }
            }
            let mut expected = integrate_bins(bins, 40, |d| density(&lights, &primitives, o, d));
            println!("{outside} from behind; sum {}", expected.iter().sum::<f64>());
            expected.iter_mut().for_each(|e| *e *= f64::from(n));
            // quadrature at the edges of sources is good to a few parts in a thousand of a bin: pooled to larger ones
            let pool = |x: &[f64]| x.chunks(bins / 2).map(|c| c.iter().sum()).collect::<Vec<f64>>();
            let unseen = f64::from(n) - expected.iter().sum::<f64>();
            assert!((outside - unseen).abs() < 0.002 * f64::from(n), "{outside} {unseen}");
            for (o, e) in pool(&counts).iter().zip(&pool(&expected)) {
                assert!((o - e).abs() < 5.0 * e.max(1.0).sqrt() + 0.004 * e, "{o} {e}");
            }
        }
    }
}

/// What a sample says of its density is what a hit there is told.
#[test]
fn both_sides_agree() {
    let primitives = mixed();
    let lights = Lights::new(&world(&primitives, &[3.0, 10.0, 5.0, 0.05], Some([0.2; 3])));
    let mut rng = Rng(4);
    let mut found = 0;
    for _ in 0..100_000 {
        let o = rng.vec3(1.9);
        let choice = rng.u32();
        let Some(s) = lights.sample(o, choice, [rng.u32(), rng.u32()]) else { continue };
        assert!((s.d.length() - 1.0).abs() < 1e-6 && s.pdf > 0.0 && s.pdf.is_finite() && s.tmax >= 0.0);
        let i = lights.choose(o, Facing::ANY, choice).0.unwrap().source;
        if i >= primitives.len() {
            assert!((s.pdf / lights.sky(s.d).1 - 1.0).abs() < 1e-6 && s.tmax == f32::INFINITY);
            continue;
        }
        let alone = density(&lights, &primitives, o, s.d) - f64::from(lights.sky(s.d).1);
        // other sources may lie in the same direction, and at a rim rounding decides
        if alone < f64::from(s.pdf) * 0.99 {
            continue;
        }
        found += 1;
    }
    assert!(found > 60_000, "{found}");
}

/// What a sample looks up is what the surface has where the sample's direction meets it; weights share the choice within a shape.
#[test]
fn textured_samples_look_where_they_point() {
    let v = [[-1.0, 2.0, -1.0], [1.0, 2.0, -1.0], [0.0, 2.0, 1.5]];
    let (center, radius) = ([0.5, -1.0, 0.25], 0.4);
    let inside = Primitive::Sphere { center: [0.0; 3], radius: 6.0, flipped: true };
    let ball = Primitive::Sphere { center, radius, flipped: false };
    let mut world = world(&[(Primitive::Triangle(v), 0), (ball, 0), (inside, 0)], &[2.0], None);
    world.shapes[0].emission_texture = Some(0);
    let (uv, attribute) = ([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    world.glows = vec![Glow { prim: 10, uv: Some(uv), attribute: Some(attribute), weight: 3.0 }];
    let lights = Lights::by_power(&world, None);
    let mut rng = Rng(9);
    let mut seen = [0; 3];
    for _ in 0..20_000 {
        let o = Vec3::new(rng.range(-3.0, 3.0), rng.range(-3.0, 1.9), rng.range(-3.0, 3.0));
        let choice = rng.u32();
        let Some(s) = lights.sample(o, choice, [rng.u32(), rng.u32()]) else { continue };
        let Some((0, at)) = s.look else { panic!("{s:?}") };
        assert_eq!(s.radiance, Vec3::splat(2.0));
        let source = lights.choose(o, Facing::ANY, choice).0.unwrap().source;
        seen[source] += 1;
        let (o, d) = (o.as_dvec3(), s.d.as_dvec3());
        if source == 0 {
            let p = o + d * ((2.0 - o.y) / d.y);
            // p = p0 + u e1 + v e2, and e2 alone goes along z
            let w = (p.z + 1.0) / 2.5;
            let u = (p.x + 1.0 - w) / 2.0;
            assert!(
                (f64::from(at.uv[0]) - 2.0 * u).abs() < 1e-4 && (f64::from(at.uv[1]) - 3.0 * w).abs() < 1e-4,
                "{at:?} {u} {w}"
            );
            assert!((at.attribute.as_dvec3() - glam::DVec3::new(1.0 - u - w, u, w)).length() < 1e-4);
            continue;
        }
        let (c, r) =
            if source == 1 { (Vec3::from(center).as_dvec3(), f64::from(radius)) } else { (glam::DVec3::ZERO, 6.0) };
        let f = o - c;
        let (b, q) = (f.dot(d), f.length_squared() - r * r);
        let root = (b * b - q).max(0.0).sqrt();
        let t = if source == 1 { -b - root } else { -b + root };
        let n = (f + d * t) / r;
        let expected = sphere_uv(n.as_vec3());
        // at the rim of the sphere, and at its poles, an error of the direction is a larger one on it
        let slope = root / r;
        if slope < 0.1 || n.x.hypot(n.y) < 0.1 {
            continue;
        }
        let around = (at.uv[0] - expected[0]).abs();
        assert!(around.min(1.0 - around) < 1e-4 && (at.uv[1] - expected[1]).abs() < 1e-4, "{at:?} {expected:?}");
    }
    assert!(seen.iter().all(|n| *n > 50), "{seen:?}");
    // by area times weight: the triangle counts three times
    let area = |s: usize| f64::from(lights.sources[s].geometry.area());
    let share = |s: usize| f64::from(lights.sources[s].probability) / (area(s) * if s == 0 { 3.0 } else { 1.0 });
    assert!((share(0) / share(1) - 1.0).abs() < 1e-5 && (share(0) / share(2) - 1.0).abs() < 1e-5);
}

/// The density, found by the geometry of the ray that goes to the sample, equals the sample's to rounding.
#[test]
fn triangle_density_is_exact() {
    let v = [[-1.0, 2.0, -1.0], [1.0, 2.0, -1.0], [0.0, 2.0, 1.5]];
    let primitives = [(Primitive::Triangle(v), 0)];
    let lights = Lights::new(&world(&primitives, &[1.0], None));
    let mut rng = Rng(5);
    for _ in 0..10_000 {
        let o = Vec3::new(rng.range(-3.0, 3.0), rng.range(-3.0, 1.9), rng.range(-3.0, 3.0));
        let Some(s) = lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]) else { continue };
        let t = (2.0 - o.y) / s.d.y;
        let pdf = lights.pdf(10, o, t, s.d.y);
        assert!((s.pdf / pdf - 1.0).abs() < 1e-5, "{} {pdf}", s.pdf);
        // the limit is short of the light, by little
        assert!(s.tmax < t && s.tmax > t * (1.0 - 1e-3 / s.d.y), "{} {t}", s.tmax);
    }
}

/// The same of a sphere, from outside and from inside; outside it is one over the solid angle of its cone.
#[test]
fn sphere_density_is_exact() {
    let (center, mut rng) = (Vec3::new(0.5, 1.0, -0.5), Rng(6));
    for (radius, flipped) in [(0.7f32, false), (3.0, true)] {
        let primitives = [(Primitive::Sphere { center: center.to_array(), radius, flipped }, 0)];
        let lights = Lights::new(&world(&primitives, &[1.0], None));
        let (mut compared, all) = (0, 10_000);
        for _ in 0..all {
            let away = if flipped { rng.range(0.0, 0.95) } else { rng.range(1.05, 6.0) };
            let o = center + rng.direction() * (away * radius);
            let s =
                lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]).expect("its front is seen from everywhere here");
            let to = (center - o).as_dvec3();
            let sin2 = f64::from(radius).powi(2) / to.length_squared();
            if !flipped {
                let cone = sin2 / (1.0 + (1.0 - sin2).sqrt());
                let even = 1.0 / (std::f64::consts::TAU * cone);
                assert!((f64::from(s.pdf) / even - 1.0).abs() < 1e-5, "{o}: {} {even}", s.pdf);
                // at the rim rounding decides whether it is met
                let below = 0.5 * (s.d.as_dvec3().normalize() - to.normalize()).length_squared();
                if below > cone * (1.0 - 1e-4) {
                    continue;
                }
            }
            let met = density(&lights, &primitives, o, s.d);
            assert!((f64::from(s.pdf) / met - 1.0).abs() < 2e-5, "{flipped} {o} {}: {} {met}", s.d, s.pdf);
            compared += 1;
        }
        assert!(compared > all - 100, "{compared}");
    }
}

/// Shares: nine tenths by power, a tenth evenly; within a shape by area; behind the light nothing.
#[test]
fn choice_is_by_power() {
    let right = |x: f32, s: f32| Primitive::Triangle([[x, 2.0, 0.0], [x + s, 2.0, 0.0], [x, 2.0, s]]);
    // shape 0: areas 0.5 and 2; shape 1: area 0.5 and twice the radiance
    let primitives = [(right(0.0, 1.0), 0), (right(2.0, 2.0), 0), (right(5.0, 1.0), 1)];
    let lights = Lights::by_power(&world(&primitives, &[1.0, 2.0], None), None);
    let power = [2.5, 1.0];
    let share = |s: usize| 0.9 * power[s] / 3.5 + 0.1 / 2.0;
    let expected = [share(0) * 0.2, share(0) * 0.8, share(1)];
    let n = 100_000u32;
    let mut counts = [0.0; 3];
    for i in 0..n {
        let number = (u64::from(i) * (1 << 32) / u64::from(n)) as u32;
        counts[lights.choose(Vec3::ZERO, Facing::ANY, number).0.unwrap().source] += 1.0;
    }
    for i in 0..3 {
        assert!((counts[i] / f64::from(n) - expected[i]).abs() < 2e-5, "{counts:?} {expected:?}");
        assert!((f64::from(lights.sources[i].probability) - expected[i]).abs() < 1e-7);
    }
    assert!(lights.sample(Vec3::new(0.0, 3.0, 0.0), 0, [1 << 31; 2]).is_none());
    assert_eq!(lights.choose(Vec3::ZERO, Facing::ANY, u32::MAX).0.map(|c| c.source), Some(2));
    assert_eq!(lights.pdf(11, Vec3::ZERO, 1.0, 1.0), 0.0);
}

/// Worlds without light, with dark, empty or broken sources.
#[test]
fn odd_worlds() {
    assert!(Lights::new(&world(&[], &[], None)).is_empty());
    assert!(Lights::new(&world(&[], &[], None)).sample(Vec3::ZERO, 7, [1 << 31; 2]).is_none());
    let sky = Lights::new(&world(&[], &[], Some([1.0; 3])));
    assert!((sky.sky(Vec3::X).1 - 1.0 / (4.0 * std::f32::consts::PI)).abs() < 1e-7);
    let flat = Primitive::Triangle([[0.0; 3]; 3]);
    assert!(Lights::new(&world(&[(flat, 0)], &[1.0], None)).is_empty());
    assert!(Lights::new(&world(&mixed(), &[0.0; 4], None)).is_empty());
}

/// The sum of many equal sources is one source: means of estimates of the same integral agree (10,000 triangles against one).
#[test]
fn many_sources() {
    let n = 100;
    let mut primitives = Vec::new();
    for i in 0..n {
        for j in 0..n {
            let (x, z) = (i as f32 / n as f32, j as f32 / n as f32);
            let s = 1.0 / n as f32;
            primitives.push((Primitive::Triangle([[x, 1.0, z], [x + s, 1.0, z], [x, 1.0, z + s]]), 0));
        }
    }
    let lights = Lights::new(&world(&primitives, &[1.0], None));
    let mut sum = 0.0;
    let samples = 1 << 14;
    for i in 0..samples {
        let v = Stream::new(1, 2, 2 * i).vertex(1, 1, 0);
        let s = lights.sample(Vec3::ZERO, v[6], [v[4], v[5]]).unwrap();
        sum += f64::from(s.d.y / s.pdf);
    }
    // half of the square's irradiance: the triangles fill half of it, evenly. The square [0, 1]^2 at height 1 (Siegel and Howell, corner factor):
    let h = 1.0 / 2.0f64.sqrt();
    let square = std::f64::consts::PI * (h * libm::atan(h) * 2.0 / (2.0 * std::f64::consts::PI));
    let found = sum / f64::from(samples);
    assert!((found / (0.5 * square) - 1.0).abs() < 0.01, "{found} {}", 0.5 * square);
}

#[test]
fn uniform_sphere_is_uniform() {
    let mut rng = Rng(6);
    let bins = 8;
    let mut counts = vec![0.0; 2 * bins * bins];
    let n = 200_000;
    for _ in 0..n {
        counts[sphere_bin(sphere::uniform([rng.f32(), rng.f32()]), bins)] += 1.0;
    }
    chi_square(&counts, &vec![f64::from(n) / counts.len() as f64; counts.len()]);
}

/// A direction as it travels.
fn snapped(d: Vec3) -> glam::DVec3 {
    Vec3::from(UnitDir::encode(d.to_array()).decode()).as_dvec3()
}

/// What is met on a triangle is even over its area: chi-square over sub-triangles of one size, after snapping.
#[test]
fn triangle_samples_are_even_by_area() {
    let v = [[-1.0, 2.0, -1.0], [1.0, 2.5, -1.0], [0.0, 2.0, 1.5]];
    let lights = Lights::new(&world(&[(Primitive::Triangle(v), 0)], &[1.0], None));
    let [a, b, c] = v.map(|p| Vec3::from(p).as_dvec3());
    let (e1, e2) = (b - a, c - a);
    let n = e1.cross(e2);
    let mut rng = Rng(21);
    for o in [Vec3::new(0.2, -1.0, 0.1), Vec3::new(3.0, 1.5, 2.0), Vec3::new(0.0, 1.9, 0.0)] {
        const SIDE: usize = 16;
        let mut counts = vec![0.0; SIDE * SIDE];
        let samples = 200_000;
        for _ in 0..samples {
            let s = lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]).expect("in front of it");
            let (o, d) = (o.as_dvec3(), snapped(s.d));
            let p = o + d * ((a - o).dot(n) / d.dot(n)) - a;
            let (u, v) = (p.cross(e2).dot(n) / n.length_squared(), e1.cross(p).dot(n) / n.length_squared());
            // sub-triangle of a grid of SIDE by SIDE: two in a cell, of which those beyond the long side are folded in
            let cell = |x: f64| ((x * SIDE as f64) as usize).min(SIDE - 1);
            let (i, j) = (cell(u), cell(v));
            let upper = u * SIDE as f64 - i as f64 + (v * SIDE as f64 - j as f64) > 1.0;
            let (i, j) = if upper { (SIDE - 1 - i, SIDE - 1 - j) } else { (i, j) };
            counts[i * SIDE + j] += 1.0;
        }
        chi_square(&counts, &vec![f64::from(samples) / counts.len() as f64; counts.len()]);
    }
}

/// From outside directions are even over the cone that the sphere fills; from inside what is met is even over its surface.
#[test]
fn sphere_samples_are_even() {
    let mut rng = Rng(22);
    let samples = 200_000;
    let center = Vec3::new(0.5, 1.0, -0.5);
    for (o, radius) in [(Vec3::new(-3.0, 0.0, 2.0), 0.7f32), (Vec3::new(0.5, 1.0, 0.6), 1.0)] {
        let sphere = Primitive::Sphere { center: center.to_array(), radius, flipped: false };
        let lights = Lights::new(&world(&[(sphere, 0)], &[1.0], None));
        let to = (center - o).as_dvec3();
        let sin2 = f64::from(radius).powi(2) / to.length_squared();
        let cone = sin2 / (1.0 + (1.0 - sin2).sqrt()); // 1 - cos
        let axis = to.normalize();
        let side = axis.any_orthonormal_vector();
        let (rings, sectors) = (16, 16);
        let mut counts = vec![0.0; rings * sectors];
        for _ in 0..samples {
            let s = lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]).expect("seen from outside");
            let d = snapped(s.d);
            // 1 - cos of the angle to the axis, without cancelling
            let below = 0.5 * (d - axis).length_squared();
            assert!(below < cone * (1.0 + 1e-4), "{below} {cone}");
            let ring = ((below / cone * rings as f64) as usize).min(rings - 1);
            let turn = d.dot(axis.cross(side)).atan2(d.dot(side)) / (2.0 * std::f64::consts::PI) + 0.5;
            counts[ring * sectors + ((turn * sectors as f64) as usize).min(sectors - 1)] += 1.0;
        }
        chi_square(&counts, &vec![f64::from(samples) / counts.len() as f64; counts.len()]);
    }
    let inside = Primitive::Sphere { center: center.to_array(), radius: 2.0, flipped: true };
    let lights = Lights::new(&world(&[(inside, 0)], &[1.0], None));
    let o = Vec3::new(1.2, 0.4, 0.3);
    let bins = 12;
    let mut counts = vec![0.0; 2 * bins * bins];
    for _ in 0..samples {
        let s = lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]).expect("seen from inside");
        let (d, f) = (snapped(s.d), (o - center).as_dvec3());
        let (b, c) = (f.dot(d), f.length_squared() - 4.0);
        let n = (f + d * (-b + (b * b - c).sqrt())) / 2.0;
        counts[sphere_bin(n.as_vec3(), bins)] += 1.0;
    }
    chi_square(&counts, &vec![f64::from(samples) / counts.len() as f64; counts.len()]);
}
