//! Light where its numbers are worst: lamps of every size and radiance, radiances that f32 hardly holds, filters, very many lamps.

use std::f64::consts::PI;
use std::time::Instant;

use glam::Vec3;
use rayherd_herd::job::{JobSettings, PreparedScene, Sampling, Silent};
use rayherd_herd::local::render_local;
use rayherd_render::aov::Aovs;
use rayherd_render::camera::Camera;
use rayherd_render::film::FilmPart;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;
use rayherd_render::light::Lights;
use rayherd_render::world::{EmissivePrimitive, Primitive, ShapeInfo, World};
use rayherd_scene::description::{Bsdf, Description, Distribution, Geometry, Material};
use rayherd_scene::prepare::PrepareSettings;
use rayherd_tests::mutation::{Random, peak_memory};

use super::numbers::{signed, unit};
use super::scenes::{self, Wide, diffuse, shape};

/// How a picture is taken.
struct Shot {
    /// Camera to world: it looks along +z.
    to_world: [[f64; 4]; 3],
    fov: f64,
    size: [u32; 2],
    filter: Filter,
    max_depth: u32,
    spp: u32,
}

/// From straight above (x, y, z), downwards, through a keyhole.
fn down(x: f64, y: f64, z: f64) -> Shot {
    let to_world = [[1.0, 0.0, 0.0, x], [0.0, 0.0, -1.0, y], [0.0, 1.0, 0.0, z]];
    Shot { to_world, fov: 0.01, size: [4, 4], filter: Filter::Box, max_depth: 2, spp: 256 }
}

fn taken(description: &Description, shot: &Shot) -> FilmPart {
    let (manifest, objects) = scenes::prepared(description, &PrepareSettings::default());
    let scene = PreparedScene::open(manifest, objects).expect("a sound scene");
    let camera = Camera::new(&shot.to_world, shot.fov, shot.size, scene.manifest.offset).expect("a camera");
    let Shot { size, filter, max_depth, spp, .. } = *shot;
    let frame = Frame {
        camera,
        size,
        filter,
        seed: 3,
        max_depth,
        rr_depth: 1000,
        split: 1,
        hide_emitters: false,
        aovs: Aovs::NONE,
    };
    let sampling = Sampling { spp, target_error: None, time_limit: None };
    render_local(&scene, &frame, &sampling, &JobSettings::default(), &Silent).expect("a picture").film
}

/// Mean of the first channel, and four standard errors of it relative to the mean.
fn mean(film: &FilmPart, spp: u32) -> (f64, f64) {
    let pixels = film.resolve(spp);
    let mean = pixels.iter().map(|p| f64::from(p[0])).sum::<f64>() / pixels.len() as f64;
    let error = film.rel_mse(spp).expect("two halves") * (mean * mean + 0.01) / (mean * mean);
    assert_eq!(film.rejected().count, 0);
    (mean, 4.0 * (error / pixels.len() as f64).sqrt())
}

/// A square of half side `s` around (x, y, z), parallel to the floor; its front is above or below.
fn square([x, y, z]: [f64; 3], s: f64, up: bool) -> Vec<Wide> {
    let [a, b, c, d] = [[-s, -s], [-s, s], [s, s], [s, -s]].map(|[u, v]| [x + u, y, z + v]);
    if up { vec![[a, b, c], [a, c, d]] } else { vec![[a, c, b], [a, d, c]] }
}

/// Share of the half space above a point that a parallel square of half side `s` at height 1 fills, cosines counted (Howell's catalogue, C-11, four times).
fn filled(s: f64) -> f64 {
    let x = s / (1.0 + s * s).sqrt();
    4.0 / PI * x * libm::atan(x)
}

#[test]
fn square_lamps_of_every_size_give_what_they_should() {
    for s in [1e-6, 1e-5, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6] {
        // a hundredth beside the middle the difference is below the tolerance
        let radiance = 1.0 / filled(s);
        let lamp = shape(&square([0.0, 1.0, 0.0], s, false), 1, Some([radiance as f32; 3]));
        let floor = shape(&square([0.0, 0.0, 0.0], 1.0, true), 0, None);
        let description =
            Description { materials: vec![diffuse(0.5), diffuse(0.0)], ..scenes::under_a_sky(vec![floor, lamp], None) };
        let shot = down(1e-4, 0.5, 0.0);
        let (found, error) = mean(&taken(&description, &shot), shot.spp);
        println!("half side {s}: {found}, four standard errors {error}");
        assert!((found / 0.5 - 1.0).abs() < error.max(2e-3), "half side {s}: {found} +- {error}");
    }
}

/// A sphere fills (r / d)^2 of what a point sees of its half space, cosines counted, whatever its size: here one unit away, or a thousandth of its radius
/// where f32 has no smaller step that a picture could stand on.
#[test]
fn sphere_lamps_of_every_size_give_what_they_should() {
    for r in [1e-6, 1e-4, 1e-2, 1.0, 10.0, 1e3, 1e4, 1e6] {
        let gap = f64::max(1.0, 1e-3 * r);
        let radiance = ((r + gap) / r).powi(2);
        let mut lamp = shape(&[], 1, Some([radiance as f32; 3]));
        lamp.geometry = Geometry::Sphere { center: [0.0, r + gap, 0.0], radius: r };
        let floor = shape(&square([0.0, 0.0, 0.0], gap, true), 0, None);
        let description =
            Description { materials: vec![diffuse(0.5), diffuse(0.0)], ..scenes::under_a_sky(vec![floor, lamp], None) };
        let shot = down(1e-4 * gap, 0.5 * gap, 0.0);
        let (found, error) = mean(&taken(&description, &shot), shot.spp);
        println!("radius {r}: {found}, four standard errors {error}");
        assert!((found / 0.5 - 1.0).abs() < error.max(2e-3), "radius {r}: {found} +- {error}");
    }
}

/// Samples of one pixel: the environment says how many, else as many as take a moment.
fn samples() -> u32 {
    match std::env::var("RAYHERD_STRESS_SAMPLES") {
        Ok(text) => {
            text.parse().unwrap_or_else(|_| panic!("RAYHERD_STRESS_SAMPLES is {text:?}: give a number of samples"))
        }
        Err(_) => 1 << 18,
    }
}

/// A third is no binary fraction: sums in f32 of it stall long before the most samples that a pixel may have (2^24). The picture's are exact.
#[test]
fn one_pixel_of_very_many_samples_is_exact() {
    let behind = shape(&square([0.0, 9.0, 0.0], 1e-3, true), 0, None);
    let description = scenes::under_a_sky(vec![behind], Some([1.0 / 3.0; 3]));
    let spp = samples();
    let film = taken(&description, &Shot { size: [1, 1], fov: 60.0, spp, ..down(0.0, 0.0, 0.0) });
    assert_eq!((film.resolve(spp), film.rejected().count), (vec![[1.0f32 / 3.0; 3]], 0));
    println!("{spp} samples of a third: exactly a third");
}

/// Two rooms with one wall between: in one a lamp a billion times as bright as in the other. Each room has what its lamp gives.
#[test]
fn a_billion_to_one() {
    let wall: Vec<Wide> = vec![
        [[0.0, -50.0, -50.0], [0.0, 50.0, -50.0], [0.0, 50.0, 50.0]],
        [[0.0, -50.0, -50.0], [0.0, 50.0, 50.0], [0.0, -50.0, 50.0]],
    ];
    let s = 0.25;
    let shapes = vec![
        shape(&wall, 1, None),
        shape(&square([-2.0, 0.0, 0.0], 1.0, true), 0, None),
        shape(&square([2.0, 0.0, 0.0], 1.0, true), 0, None),
        shape(&square([-2.0, 1.0, 0.0], s, false), 1, Some([1e9; 3])),
        shape(&square([2.0, 1.0, 0.0], s, false), 1, Some([1.0; 3])),
    ];
    let description = Description { materials: vec![diffuse(0.5), diffuse(0.0)], ..scenes::under_a_sky(shapes, None) };
    for (x, radiance) in [(-2.0, 1e9), (2.0, 1.0)] {
        let shot = Shot { spp: 1024, ..down(x, 0.5, 0.0) };
        let (found, error) = mean(&taken(&description, &shot), shot.spp);
        let expected = 0.5 * radiance * filled(s);
        println!("radiance {radiance}: {found} of {expected}, four standard errors {error}");
        assert!((found / expected - 1.0).abs() < error.max(1e-3), "{found} of {expected}, +- {error}");
        assert!(error < 0.1, "{error}: the faint lamp drowns");
    }
}

/// Nothing is seen but a sky of 1: whatever the filter, every pixel is 1, on the rim too.
#[test]
fn filters_lose_nothing() {
    let behind = shape(&square([0.0, 9.0, 0.0], 1e-3, true), 0, None);
    let description = scenes::under_a_sky(vec![behind], Some([1.0; 3]));
    let tents = [1e-6, 0.5, 1.0, 2.5, 64.0].map(|radius| Filter::Tent { radius });
    let gaussians = [1e-6, 0.3, 0.5, 4.0, 64.0].map(|stddev| Filter::Gaussian { stddev });
    for filter in [Filter::Box].into_iter().chain(tents).chain(gaussians) {
        for (size, fov) in [([5, 3], 179.9), ([1, 1], 1e-6), ([64, 1], 90.0)] {
            let film = taken(&description, &Shot { filter, size, fov, spp: 16, ..down(0.0, 0.0, 0.0) });
            assert!(film.resolve(16).iter().all(|p| *p == [1.0; 3]), "{filter:?} {size:?}: {:?}", film.resolve(16));
            assert_eq!(film.rejected().count, 0);
        }
    }
}

/// Radiances that are subnormal, or far below what the film keeps; reflectances whose products are; coordinates that are.
#[test]
fn subnormals_are_numbers_like_others() {
    let floor = || shape(&square([0.0, 0.0, 0.0], 1.0, true), 0, None);
    for radiance in [1e-45f32, 1e-40, f32::MIN_POSITIVE, 1e-30, 1e-15, 1e-10] {
        let lamp = shape(&square([0.0, 1.0, 0.0], 1.0, false), 0, Some([radiance; 3]));
        for sky in [None, Some([radiance; 3])] {
            let film = taken(
                &scenes::under_a_sky(vec![floor(), lamp.clone()], sky),
                &Shot { max_depth: 6, ..down(0.1, 0.5, 0.0) },
            );
            assert_eq!(film.rejected().count, 0, "radiance {radiance}");
            // between the floor, of which comes back half, and a lamp that gives back as much
            let most = 2.0 * radiance;
            for value in film.resolve(256).as_flattened() {
                assert!(*value >= 0.0 && *value <= most, "radiance {radiance}: {value}");
                // cut off below 2^-64
                assert!(radiance < 1e-15 || *value > 0.2 * radiance, "radiance {radiance}: {value}");
            }
        }
    }
    for reflectance in [1e-45f32, 1e-40, 1e-20, 1e-12] {
        let lamp = shape(&square([0.0, 1.0, 0.0], 1.0, false), 0, Some([1.0; 3]));
        let dim = Description {
            materials: vec![diffuse(reflectance)],
            ..scenes::under_a_sky(vec![floor(), lamp], Some([1.0; 3]))
        };
        let film = taken(&dim, &Shot { max_depth: 30, ..down(0.1, 0.5, 0.0) });
        assert_eq!(film.rejected().count, 0, "reflectance {reflectance}");
        assert!(
            film.resolve(256).as_flattened().iter().all(|v| (0.0..=1.5 * reflectance).contains(v)),
            "{reflectance}"
        );
    }
    for size in [1e-45f64, 1e-42, 1e-40, 1e-38, 1e-30, 1e-20, 1e-12] {
        let at = |t: &Wide| t.map(|p| p.map(|x| x * size));
        let [floor, lamp] = [(0.0, true), (1.0, false)]
            .map(|(y, up)| square([0.0, y, 0.0], 1.0, up).iter().map(at).collect::<Vec<_>>());
        let tiny = scenes::under_a_sky(vec![shape(&floor, 0, None), shape(&lamp, 0, Some([1.0; 3]))], Some([1.0; 3]));
        let shot = down(0.1 * size, 0.5 * size, 0.0);
        let film = taken(&tiny, &Shot { max_depth: 6, fov: 40.0, ..shot });
        assert_eq!(film.rejected().count, 0, "size {size}");
        let (found, _) = mean(&film, 256);
        println!("size {size:e}: {found}");
        assert!((0.0..=2.0).contains(&found), "size {size}: {found}");
    }
}

/// Roughness from 1e-4 to 1 before a sky of 1: no more comes back than goes in, what is nearly smooth gives back all, and nothing is no number.
#[test]
fn roughness_keeps_energy() {
    let white = [1.0; 3];
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [1e-4f32, 1e-3, 1e-2, 0.1, 0.3, 1.0] {
            let metal =
                Bsdf::RoughConductor { distribution, alpha: [alpha; 2], eta: [0.0; 3], k: [1e4; 3], specular: white };
            let glass =
                Bsdf::RoughDielectric { distribution, alpha: [alpha; 2], eta: 1.5, reflect: white, transmit: white };
            for (name, bsdf) in [("metal", metal), ("glass", glass)] {
                let mut ball = shape(&[], 0, None);
                ball.geometry = Geometry::Sphere { center: [0.0; 3], radius: 1.0 };
                let description = Description {
                    materials: vec![Material::new(name, bsdf, false)],
                    ..scenes::under_a_sky(vec![ball], Some(white))
                };
                let shot = Shot { fov: 30.0, size: [8, 8], max_depth: 100, spp: 64, ..down(0.0, 3.0, 0.0) };
                let (found, error) = mean(&taken(&description, &shot), shot.spp);
                println!("{name} {distribution:?} {alpha}: {found} +- {error}");
                assert!(found < 1.0 + error.max(1e-3), "{name} {distribution:?} {alpha}: {found}");
                assert!(found > if alpha <= 0.01 { 0.97 } else { 0.3 }, "{name} {distribution:?} {alpha}: {found}");
            }
        }
    }
}

/// Lamps of one test: the environment says how many, else a tenth of the million.
fn lamps() -> u32 {
    match std::env::var("RAYHERD_STRESS_LIGHTS") {
        Ok(text) => {
            text.parse().unwrap_or_else(|_| panic!("RAYHERD_STRESS_LIGHTS is {text:?}: give a number of lamps"))
        }
        Err(_) => 100_000,
    }
}

/// Very many small lamps: what choosing among them adds up to is the sum over all of them.
#[test]
fn a_million_lamps() {
    let n = lamps();
    let mut random = Random::new(46);
    let before = peak_memory();
    let mut world = World { lo: [-2.0; 3], hi: [2.0; 3], ..World::default() };
    let kinds = 64;
    for k in 0..kinds {
        let emission = Some([libm::expf(8.0 * signed(&mut random)); 3]);
        world.shapes.push(ShapeInfo { name: k.to_string(), material: 0, emission, emission_texture: None });
    }
    // all above the points that are lit, with their fronts down
    let side = 0.2 / f64::from(n).sqrt();
    for i in 0..n {
        let at = [2.0 * signed(&mut random), 1.0 + unit(&mut random), 2.0 * signed(&mut random)];
        let far = |u: f64, v: f64| [at[0] + (u * side) as f32, at[1], at[2] + (v * side) as f32];
        let geometry = Primitive::Triangle([far(0.0, 0.0), far(1.0, 0.0), far(0.0, 1.0)]);
        world.emissive.push(EmissivePrimitive { prim: u64::from(i), shape: i % kinds, geometry });
    }
    let start = Instant::now();
    let lights = Lights::new(&world);
    let built = start.elapsed();
    for o in [Vec3::ZERO, Vec3::new(1.5, 0.9, -1.0), Vec3::new(-30.0, 0.0, 5.0)] {
        // irradiance of a floor at o, each lamp a point of its area
        let mut expected = 0.0;
        for e in &world.emissive {
            let Primitive::Triangle(p) = e.geometry else { continue };
            let [a, b, c] = p.map(|p| Vec3::from(p).as_dvec3());
            let area = (b - a).cross(c - a) * 0.5;
            let d = (a + b + c) / 3.0 - o.as_dvec3();
            let radiance = f64::from(world.shapes[e.shape as usize].emission.expect("a lamp")[0]);
            expected += radiance * (d.y * area.dot(d).abs()).max(0.0) / d.length_squared().powi(2);
        }
        let samples = 1 << 17;
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..samples {
            let bits = [random.bits(), random.bits()];
            let place = [bits[1] as u32, (bits[1] >> 32) as u32];
            let value = lights
                .sample(o, bits[0] as u32, place)
                .map_or(0.0, |s| f64::from(s.radiance.x * s.d.y.max(0.0) / s.pdf));
            sum += value;
            squares += value * value;
        }
        let found = sum / f64::from(samples);
        let error = 4.0 * ((squares / f64::from(samples) - found * found) / f64::from(samples)).sqrt();
        println!("at {o}: {found} of {expected}, four standard errors {error}");
        assert!((found - expected).abs() < error + 1e-3 * expected, "{o}: {found} of {expected} +- {error}");
        assert!(error < 0.05 * expected, "{o}: the choice is worth nothing: {error} of {expected}");
    }
    let more = peak_memory().zip(before).map(|(after, before)| after - before);
    println!("{n} lamps: tree in {built:?}, with the world {:?} KiB more", more);
}
