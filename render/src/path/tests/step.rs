//! Properties of the step itself.

use std::sync::Arc;

use glam::Vec3;

use super::brute::{Scene, frame};
use super::furnace::box_inside;
use super::{cornell, mean_of, textured};
use crate::film::FilmPart;
use crate::filter::Filter;
use crate::frame::Frame;
use crate::light::{Lights, SkyMap};
use crate::material::{Bsdf, Detail, Distribution, Principled, Slot, Textured, Transmittance};
use crate::math::UnitDir;
use crate::path::reference::{self, Tracer};
use crate::path::shade::shade_plain;
use crate::path::{Context, Outcome, PathRay, ShadowRay, camera_ray, camera_rays, shade};
use crate::ray::{Hit, PathKey};
use crate::skip::Skips;
use crate::testing::Rng;
use crate::texture::{Checkerboard, Texture, UvMap};
use crate::world::{Beam, Sun};

fn channel_means(scene: &Scene, lights: Option<&Lights>, frame: &Frame, samples: u32) -> ([f64; 3], f64) {
    let world = scene.world();
    let own = Lights::new(&world);
    let context = Context::new(&world, lights.unwrap_or(&own), frame).with(&scene.tiles);
    let mut film = FilmPart::new(frame.size);
    reference::render(&context, scene, 0..samples, &mut film);
    let picture = film.resolve(samples);
    let mean = std::array::from_fn(|c| picture.iter().map(|p| f64::from(p[c])).sum::<f64>() / picture.len() as f64);
    (mean, film.rel_mse(samples).unwrap())
}

#[track_caller]
fn close(a: [f64; 3], b: [f64; 3], tolerance: f64) {
    for c in 0..3 {
        assert!((a[c] / b[c] - 1.0).abs() < tolerance, "{a:?} {b:?}");
    }
}

/// The same mean and less variance, at equal camera rays (whose own noise both share).
#[test]
fn splitting_keeps_the_mean_and_lowers_variance() {
    let scene = cornell::scene();
    let frame = cornell::frame(16);
    let (one, error_one) = channel_means(&scene, None, &frame, 64);
    let (many, error_many) = channel_means(&scene, None, &Frame { split: 16, ..frame }, 64);
    println!("{one:?} {error_one}; {many:?} {error_many}");
    close(one, many, 0.006);
    assert!(error_many < 0.7 * error_one, "{error_many} {error_one}");
}

/// Without light sampling (no table: density 0, BSDF rays weigh all), with roulette from the start, and without: one mean.
#[test]
fn estimators_agree() {
    let mut scene = cornell::scene();
    let (shape, k) = (scene.primitives.last().unwrap().1, [3.0, 2.4, 1.6]);
    let gold = Bsdf::RoughConductor {
        distribution: Distribution::Ggx,
        alpha: [0.3, 0.3],
        eta: [0.2, 0.4, 1.4],
        k,
        specular: [1.0; 3],
    };
    // one face of the large box of metal
    scene.shapes[shape as usize].material = scene.material(gold, true);
    // and a large light, which BSDF sampling finds
    for shape in &mut scene.shapes {
        if shape.emission.is_some() {
            shape.emission = Some([1.0, 0.8, 0.5]);
        }
    }
    scene.quad(0, [-0.9, 0.97, -0.9], [1.8, 0.0, 0.0], [0.0, 0.0, 1.8]);
    let frame = Frame { max_depth: 5, ..cornell::frame(16) };
    let (mean, _) = channel_means(&scene, None, &frame, 512);
    let none = Lights::new(&Scene { shapes: scene.shapes.clone(), ..Scene::default() }.world());
    let (bsdf_only, _) = channel_means(&scene, Some(&none), &frame, 512);
    let (roulette, _) = channel_means(&scene, None, &Frame { rr_depth: 1, ..frame.clone() }, 512);
    println!("{mean:?} {bsdf_only:?} {roulette:?}");
    close(mean, bsdf_only, 0.006);
    close(mean, roulette, 0.006);
}

/// The same of lamps whose emission textures give: triangles with texture coordinates, and a sphere.
#[test]
fn estimators_agree_on_textured_lamps() {
    let mut scene = cornell::scene();
    let image = scene.image([2, 2], vec![255, 10, 30, 0, 90, 255, 128, 0, 128, 255, 255, 0]);
    let squares = Checkerboard { to_uv: UvMap([[3.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), colors: [[2.0; 3], [0.1; 3]] };
    scene.textures.push(Texture::Checkerboard(squares));
    for shape in &mut scene.shapes {
        shape.emission = None;
    }
    let black = scene.diffuse(0.0);
    let [sheet, ball] = [(image, [3.0, 2.0, 1.0]), (image + 1, [1.0, 2.0, 3.0])].map(|(texture, emission)| {
        let shape = scene.shape(black, Some(emission));
        scene.shapes[shape as usize].emission_texture = Some(texture);
        shape
    });
    let first = scene.primitives.len() as u32;
    scene.quad(sheet, [-0.9, 0.97, -0.9], [1.8, 0.0, 0.0], [0.0, 0.0, 1.8]);
    scene.extras.insert(first, (Some([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), None));
    scene.extras.insert(first + 1, (Some([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), None));
    scene.sphere(ball, [0.2, 0.3, 0.1], 0.3, false);
    let frame = Frame { max_depth: 4, ..cornell::frame(16) };
    let (mean, _) = channel_means(&scene, None, &frame, 512);
    let none = Lights::new(&Scene { shapes: scene.shapes.clone(), ..Scene::default() }.world());
    let (bsdf_only, _) = channel_means(&scene, Some(&none), &frame, 1024);
    println!("{mean:?} {bsdf_only:?}");
    close(mean, bsdf_only, 0.01);
}

/// The Cornell box with metal, a sphere that emits, a sky, and shading normals: everything that may be in one batch.
fn motley() -> Scene {
    let mut scene = cornell::scene();
    let bsdf = Bsdf::RoughConductor {
        distribution: Distribution::Ggx,
        alpha: [0.3, 0.1],
        eta: [0.2, 0.4, 1.4],
        k: [3.0, 2.4, 1.6],
        specular: [1.0; 3],
    };
    let count = scene.shapes.len();
    scene.shapes[count - 2].material = scene.material(bsdf, true);
    let mirror = Bsdf::Conductor { eta: [0.2; 3], k: [3.0; 3], specular: [1.0; 3] };
    scene.shapes[count - 3].material = scene.material(mirror, true);
    textured::furnish(&mut scene);
    let white = scene.diffuse(0.8);
    let lamp = scene.shape(white, Some([2.0; 3]));
    scene.sphere(lamp, [0.5, 0.2, 0.3], 0.1, false);
    let glow = scene.shape(white, Some([2.0, 1.0, 3.0]));
    scene.shapes[glow as usize].emission_texture = Some(0);
    scene.quad(glow, [-0.6, 0.1, 0.2], [0.2, 0.0, 0.0], [0.0, 0.1, 0.2]);
    scene.sphere(glow, [-0.5, -0.2, 0.3], 0.1, false);
    scene.environment = Some([0.3; 3]);
    let n = scene.normals.len();
    scene.normals[n / 2] = Some([[0.1, 0.2, 1.0]; 3]);
    scene
}

/// The Cornell box, open in front, of coats and metals or of glass, some of them textured, with smooth normals here and there and a sky that is a
/// picture with a sun: all that blocks know.
fn glossy(of_glass: bool) -> Scene {
    let mut scene = cornell::scene();
    let image = scene.image([2, 2], vec![200, 10, 30, 0, 90, 255, 128, 128, 128, 255, 255, 0]);
    // of another size: what a look-up of one reads is not what that of the other reads
    let other = scene.image([3, 1], vec![10, 250, 60, 90, 20, 200, 255, 130, 40]);
    let coat = |alpha: f32, eta: f32, nonlinear, distribution| Bsdf::RoughPlastic {
        distribution,
        alpha,
        eta,
        diffuse: [0.5, 0.3, 0.8],
        specular: [1.0, 0.9, 0.8],
        nonlinear,
        coat: Transmittance::new(distribution, alpha, eta),
    };
    let metal = |alpha: f32, distribution| Bsdf::RoughConductor {
        distribution,
        alpha: [alpha; 2],
        eta: [0.2, 0.4, 1.4],
        k: [3.0, 2.4, 1.6],
        specular: [0.9, 1.0, 0.8],
    };
    let paint = |slots: &[Slot]| Detail {
        textured: slots.iter().zip([image, other]).map(|(&slot, image)| Textured::new(slot, image)).collect(),
        ..Detail::default()
    };
    let glass = |alpha: f32, eta: f32, distribution| Bsdf::RoughDielectric {
        distribution,
        alpha: [alpha; 2],
        eta,
        reflect: [0.9, 1.0, 0.8],
        transmit: [1.0, 0.7, 0.9],
    };
    let mut materials = vec![
        scene.material(coat(0.1, 1.5, false, Distribution::Ggx), true),
        scene.material(coat(0.4, 1.9, true, Distribution::Beckmann), false),
        scene.material(metal(0.05, Distribution::Ggx), true),
        scene.material(metal(0.3, Distribution::Beckmann), true),
        scene.detailed(coat(0.2, 1.3, true, Distribution::Ggx), paint(&[Slot::Diffuse, Slot::Specular])),
        scene.detailed(metal(0.2, Distribution::Ggx), paint(&[Slot::Alpha, Slot::Specular])),
        scene.detailed(metal(0.2, Distribution::Ggx), paint(&[Slot::AlphaU])),
        scene.diffuse(0.7),
    ];
    if of_glass {
        let turned = [0.3, 0.1];
        let principled = Principled {
            base_color: [0.8, 0.5, 0.2],
            eta: 1.5,
            roughness: 0.4,
            anisotropic: 0.0,
            metallic: 0.3,
            spec_trans: 0.0,
            spec_tint: 0.3,
            sheen: 0.4,
            sheen_tint: 0.6,
            clearcoat: 0.7,
            clearcoat_gloss: 0.5,
            flatness: 0.2,
        };
        let Bsdf::RoughDielectric { distribution, eta, reflect, transmit, .. } = glass(0.3, 1.5, Distribution::Ggx)
        else {
            unreachable!()
        };
        materials = vec![
            scene.material(glass(0.1, 1.5, Distribution::Ggx), false),
            scene.material(glass(0.4, 0.8, Distribution::Beckmann), true),
            scene.material(Bsdf::Principled(Principled { spec_trans: 0.8, ..principled }), false),
            scene.detailed(Bsdf::Principled(principled), paint(&[Slot::Diffuse, Slot::Roughness])),
            scene.material(Bsdf::Principled(Principled { anisotropic: 0.5, ..principled }), false),
            scene.detailed(
                Bsdf::Principled(Principled { spec_trans: 0.5, ..principled }),
                paint(&[Slot::Flatness, Slot::SpecTrans]),
            ),
            scene.detailed(glass(0.2, 1.3, Distribution::Ggx), paint(&[Slot::Specular, Slot::Transmit])),
            scene.detailed(glass(0.2, 1.8, Distribution::Beckmann), paint(&[Slot::Alpha, Slot::Transmit])),
            scene.material(Bsdf::RoughDielectric { distribution, alpha: turned, eta, reflect, transmit }, false),
            scene.diffuse(0.7),
        ];
    }
    assert!(scene.shapes.iter().filter(|s| s.emission.is_none()).count() >= materials.len(), "all of them are met");
    for (k, shape) in scene.shapes.iter_mut().filter(|s| s.emission.is_none()).enumerate() {
        shape.material = materials[k % materials.len()];
    }
    let mut rng = Rng(21);
    for normals in scene.normals.iter_mut().skip(2).step_by(3) {
        *normals = Some(std::array::from_fn(|_| rng.direction().to_array()));
    }
    let texels = (0..16 * 9).map(|_| std::array::from_fn(|_| rng.f32())).collect();
    let turned = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]];
    scene.sky_map = Some((Arc::new(SkyMap::new(16, 9, texels).unwrap()), turned));
    scene.sun = Some(Sun { direction: [0.6, 0.0, 0.8], up: [0.0; 3], cap: 0.01, radiance: [30.0, 20.0, 10.0] });
    scene
}

/// The Cornell box with more lamps, that face this way and that.
fn lamps(more: u32) -> Scene {
    let mut scene = cornell::scene();
    let white = scene.diffuse(0.8);
    for i in 0..more {
        let lamp = scene.shape(white, Some([1.0 + i as f32; 3]));
        let at = [0.15 * i as f32 - 0.6, 0.1 * i as f32 - 0.5, 0.3];
        scene.quad(lamp, at, [0.1, 0.0, 0.0], [[0.0, 0.0, 0.1], [0.0, 0.1, 0.0], [0.0, 0.0, -0.1]][i as usize % 3]);
    }
    scene
}

/// The Cornell box with spheres as lamps, a large one about the camera and the ends of the walls, and with its own lamp or without.
fn balls(count: usize, with_lamp: bool) -> Scene {
    let mut scene = cornell::scene();
    for shape in scene.shapes.iter_mut().filter(|_| !with_lamp) {
        shape.emission = None;
    }
    let white = scene.diffuse(0.8);
    let places = [([0.0, 0.0, 3.0], 2.6), ([-0.5, 0.3, 0.2], 0.2), ([0.1, 0.6, -0.4], 0.1), ([0.7, 0.7, 0.7], 0.05)];
    for (k, &(center, radius)) in places.iter().take(count).enumerate() {
        let lamp = scene.shape(white, Some([1.0 + k as f32, 2.0, 0.5]));
        scene.sphere(lamp, center, radius, false);
    }
    scene
}

/// Every ray alone, and the plain way, gives what the batch gives; also in another order.
#[test]
fn batches_do_not_matter() {
    let balls = [(balls(1, false), 1), (balls(3, false), 2), (balls(4, true), 1)];
    let others =
        [(cornell::scene(), 1), (lamps(3), 2), (lamps(9), 1), (motley(), 3), (glossy(false), 2), (glossy(true), 1)];
    // lamps of every kind behind glass and before it
    let mut shone_through = lamps(9);
    let glass = shone_through.material(
        Bsdf::RoughDielectric {
            distribution: Distribution::Ggx,
            alpha: [0.3; 2],
            eta: 1.5,
            reflect: [1.0; 3],
            transmit: [1.0; 3],
        },
        false,
    );
    shone_through.shapes.iter_mut().step_by(2).for_each(|shape| shape.material = glass);
    assert!(balls.iter().all(|(scene, _)| scene.lights().few().is_some()));
    for (scene, split) in balls.into_iter().chain(others).chain([(shone_through, 1)]) {
        for skips in [Skips::ALL, Skips::NONE] {
            check_batches(&scene, split, skips);
        }
    }
}

/// In any order: a film adds up exactly, and which rays are traced together changes none.
#[track_caller]
fn same(a: &Outcome, b: &Outcome) {
    #[track_caller]
    fn lists<T: bytemuck::Pod + PartialEq + std::fmt::Debug>(a: &[T], b: &[T]) {
        let sorted = |list: &[T]| {
            let mut list = list.to_vec();
            list.sort_by(|x, y| bytemuck::bytes_of(x).cmp(bytemuck::bytes_of(y)));
            list
        };
        let (a, b) = (sorted(a), sorted(b));
        let first = a.iter().zip(&b).find(|(x, y)| bytemuck::bytes_of(*x) != bytemuck::bytes_of(*y));
        assert!(first.is_none() && a.len() == b.len(), "{} and {}, of them first {first:?}", a.len(), b.len());
    }
    lists(&a.shadow, &b.shadow);
    lists(&a.next, &b.next);
    lists(&a.light, &b.light);
}

fn check_batches(scene: &Scene, split: u32, skips: Skips) {
    let frame = Frame { split, rr_depth: 2, ..cornell::frame(16) };
    let (world, lights) = (scene.world(), scene.lights());
    let context = Context::new(&world, &lights, &frame).with(&scene.tiles).skipping(skips);
    let mut rays: Vec<PathRay> = (0..256).map(|p| camera_ray(&frame, p, 3)).collect();
    for _ in 0..4 {
        let hits: Vec<Hit> = rays.iter().map(|r| scene.closest(&r.ray())).collect();
        let mut whole = Outcome::default();
        shade(&context, scene, &rays, &hits, &mut whole);
        let mut parts = Outcome::default();
        shade_plain(&context, scene, &rays, &hits, &mut parts);
        same(&parts, &whole);
        assert_eq!(parts.counters, whole.counters);
        for out in [&whole, &parts] {
            assert!(out.next.iter().map(PathRay::ray).eq(out.next_rays.iter().copied()));
            assert!(out.shadow.iter().map(ShadowRay::ray).eq(out.shadow_rays.iter().copied()));
        }
        for size in [1, 2, 3, 7, 16, 100] {
            parts.clear();
            for (r, h) in rays.chunks(size).zip(hits.chunks(size)) {
                shade(&context, scene, r, h, &mut parts);
            }
            same(&parts, &whole);
        }
        let (mut r, mut h) = (rays.clone(), hits.clone());
        r.reverse();
        h.reverse();
        parts.clear();
        shade(&context, scene, &r, &h, &mut parts);
        same(&parts, &whole);
        rays = whole.next;
    }
}

/// Blocks of camera rays, full, part full or of a few, are those made one by one, for every filter.
#[test]
fn camera_rays_in_blocks_are_those_one_by_one() {
    for filter in [Filter::Box, Filter::Tent { radius: 1.5 }, Filter::Gaussian { stddev: 0.5 }] {
        let frame = Frame { filter, seed: 77, ..cornell::frame(50) };
        for (runs, len) in [(100, 1), (40, 3), (5, 32), (3, 70), (1, 2), (0, 0)] {
            let samples: Vec<[u32; 2]> =
                (0..runs).flat_map(|i| (0..len).map(move |s| [i * 997 % 2500, s + i * 1000])).collect();
            let (mut paths, mut rays) = (Vec::new(), Vec::new());
            camera_rays(&frame, &samples, &mut paths, &mut rays);
            let one_by_one: Vec<PathRay> = samples.iter().map(|s| camera_ray(&frame, s[0], s[1])).collect();
            assert_eq!(paths, one_by_one);
            assert!(rays.iter().copied().eq(one_by_one.iter().map(PathRay::ray)));
        }
    }
}

/// Depth counts as Mitsuba's: 1 sees emitters only, 2 direct light.
#[test]
fn depth_is_the_number_of_rays() {
    let scene = cornell::scene();
    let world = scene.world();
    let lights = Lights::new(&world);
    for max_depth in 1..5 {
        let frame = Frame { max_depth, ..cornell::frame(16) };
        let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
        let mut rays: Vec<PathRay> = (0..256).map(|p| camera_ray(&frame, p, 0)).collect();
        for depth in 1..=max_depth {
            let hits: Vec<Hit> = rays.iter().map(|r| scene.closest(&r.ray())).collect();
            let mut out = Outcome::default();
            shade(&context, &scene, &rays, &hits, &mut out);
            assert_eq!(out.next.is_empty(), depth == max_depth, "{depth} of {max_depth}");
            assert_eq!(out.shadow.is_empty(), depth == max_depth);
            assert!(out.next.iter().all(|r| u32::from(r.key.vertex) == depth));
            rays = out.next;
        }
    }
}

/// A closed box with wild shading normals, lit from outside only: no light comes in, though the normals would let it.
#[test]
fn shading_normals_leak_nothing() {
    let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
    let material = scene.diffuse(0.9);
    let shape = scene.shape(material, None);
    box_inside(&mut scene, shape);
    let mut rng = Rng(1);
    for normals in &mut scene.normals {
        *normals = Some(std::array::from_fn(|_| rng.direction().to_array()));
    }
    let light = scene.shape(material, Some([10.0; 3]));
    scene.sphere(light, [0.0, 5.0, 0.0], 2.0, false);
    assert_eq!(mean_of(&scene, &frame([0.1, 0.2, -0.3], 80.0, [16, 16], 6), 64), 0.0);
}

/// No ray that leaves a surface meets it again: one large triangle or sphere under the sky, near and far from the origin, grazing
/// views included.
#[test]
fn surfaces_do_not_shade_themselves() {
    let mut rng = Rng(2);
    let mut left = 0;
    for i in 0..40_000 {
        let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
        let material = scene.diffuse(0.9);
        let shape = scene.shape(material, None);
        let at = rng.vec3([0.0, 1.0, 1000.0][i % 3]);
        let size = [0.01, 1.0, 30.0][i / 3 % 3];
        let target = if i % 2 == 0 {
            scene.sphere(shape, at.to_array(), size, false);
            at + rng.direction() * size * 0.99
        } else {
            let (a, b) = (rng.vec3(size), rng.vec3(size));
            scene.quad(shape, at.to_array(), a.to_array(), b.to_array());
            at + a * rng.f32() + b * rng.f32()
        };
        let world = scene.world();
        let lights = Lights::new(&world);
        let frame = frame([0.0; 3], 45.0, [1, 1], 3);
        let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
        let mut ray = camera_ray(&frame, 0, i as u32);
        let mut o = target + rng.direction() * size * [0.1, 3.0, 50.0][i / 9 % 3];
        if i % 2 == 0 {
            o = at + (o - at).normalize() * (o - at).length().max(1.01 * size);
        }
        ray.o = o.to_array();
        ray.dir = UnitDir::encode((target - o).normalize().to_array());
        let hit = scene.closest(&ray.ray());
        if !hit.is_hit() {
            continue;
        }
        let mut out = Outcome::default();
        shade(&context, &scene, &[ray], &[hit], &mut out);
        for r in out.next.iter().map(|r| r.ray()).chain(out.shadow.iter().map(|s| s.ray())) {
            left += 1;
            assert!(!scene.occluded(&r), "case {i}: {r:?} {:?}", scene.closest(&r));
        }
    }
    assert!(left > 30_000, "{left}");
}

/// A shadow ray ends before its light: with nothing else there, each of them arrives, also at grazing angles.
#[test]
fn lights_do_not_shadow_themselves() {
    let mut rng = Rng(3);
    let mut rays = 0;
    for i in 0..20_000 {
        let mut scene = Scene::default();
        let material = scene.diffuse(0.9);
        let light = scene.shape(material, Some([1.0; 3]));
        let far = [1.0, 100.0][i % 2];
        let at = rng.vec3(far);
        if i / 2 % 2 == 0 {
            scene.sphere(light, at.to_array(), [0.001, 0.1, 1.0][i % 3], i % 5 == 0);
        } else {
            scene.quad(light, at.to_array(), rng.vec3(1.0).to_array(), rng.vec3(1.0).to_array());
        }
        let lights = Lights::new(&scene.world());
        let o = at + rng.vec3([0.02, 2.0, 50.0][i % 3]);
        let Some(s) = lights.sample(o, rng.u32(), [rng.u32(), rng.u32()]) else { continue };
        let d = UnitDir::encode(s.d.to_array()).decode();
        let ray = crate::ray::Ray { o: o.to_array(), tmin: 0.0, d, tmax: s.tmax };
        rays += 1;
        assert!(!scene.occluded(&ray), "case {i}: {ray:?} {:?}", scene.closest(&ray));
    }
    assert!(rays > 5000, "{rays}");
}

/// 100,000 random surfaces, rays and hits, degenerate ones among them: whatever comes out is finite and not negative.
#[test]
fn nothing_is_nan() {
    let mut rng = Rng(4);
    let sizes = [0.0, 1e-30, 1e-6, 1.0, 1e6];
    for i in 0..5_000 {
        let mut scene = Scene { environment: (i % 3 == 0).then_some([1.0; 3]), ..Scene::default() };
        let glass = [[1e-4, 0.1, 1.0][i % 3], [1e-4, 0.1, 1.0][i / 3 % 3]];
        let (eta, white) = ([1.5, 1.0, 0.7][i / 9 % 3], [1.0; 3]);
        let bsdf = match i % 8 {
            0 => Bsdf::Diffuse { reflectance: [rng.f32(), 0.0, 1.0] },
            4 => Bsdf::Dielectric { eta, reflect: white, transmit: white },
            5 => Bsdf::ThinDielectric { eta, reflect: white, transmit: white },
            6 => Bsdf::RoughDielectric {
                distribution: Distribution::Ggx,
                alpha: glass,
                eta,
                reflect: white,
                transmit: white,
            },
            7 => Bsdf::Plastic { eta, diffuse: white, specular: white, nonlinear: true },
            1 => Bsdf::Conductor { eta: [0.2; 3], k: [3.0; 3], specular: [1.0; 3] },
            j => Bsdf::RoughConductor {
                distribution: if j == 2 { Distribution::Beckmann } else { Distribution::Ggx },
                alpha: [[1e-4, 0.1, 1.0][i % 3], [1e-4, 0.1, 1.0][i / 3 % 3]],
                eta: [0.2; 3],
                k: [3.0; 3],
                specular: [1.0; 3],
            },
        };
        let material = scene.material(bsdf, rng.u32() & 1 == 0);
        let shapes = [scene.shape(material, None), scene.shape(material, Some([rng.f32(), 1.0, 1e6]))];
        for _ in 0..4 {
            let size = sizes[(rng.u32() % 5) as usize];
            let place = sizes[(rng.u32() % 5) as usize];
            let corner = rng.vec3(place);
            let shape = shapes[(rng.u32() % 2) as usize];
            if rng.u32().is_multiple_of(3) {
                scene.sphere(shape, corner.to_array(), size.max(1e-6), rng.u32() & 1 == 0);
            } else {
                scene.quad(shape, corner.to_array(), rng.vec3(size).to_array(), rng.vec3(size).to_array());
                if rng.u32() & 1 == 0 {
                    let n = scene.normals.len();
                    scene.normals[n - 1] = Some([rng.vec3(1.0).to_array(), rng.vec3(1e-20).to_array(), [0.0; 3]]);
                }
            }
        }
        if i % 4 == 1 {
            let (place, intensity) = (sizes[(rng.u32() % 5) as usize], [rng.f32(), 0.0, 1e6]);
            let (position, axis) = (rng.vec3(place).to_array(), rng.direction().to_array());
            scene.beams.push(Beam::Point { position, intensity });
            scene.beams.push(Beam::Spot { position, axis, intensity, beam: 0.5, cutoff: 1.5, slide: None });
            scene.beams.push(Beam::Directional { direction: axis, irradiance: intensity });
        }
        let world = scene.world();
        let lights = Lights::new(&world);
        let frame = Frame { rr_depth: 2, split: 1 + rng.u32() % 2, ..frame([0.0; 3], 45.0, [8, 8], 10) };
        let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
        let mut out = Outcome::default();
        for _ in 0..20 {
            let (vertex, place) = ((rng.u32() % 9) as u16, sizes[(rng.u32() % 5) as usize]);
            let ray = PathRay {
                o: rng.vec3(place).to_array(),
                dir: UnitDir::encode(rng.direction().to_array()),
                key: PathKey { pixel: rng.u32() % 64, sample: rng.u32() % 100, branch: 0, vertex },
                throughput: [rng.f32(), 1.0, 1e-10],
                pdf: [0.0, 1e-3, 1.0, 1e10][(rng.u32() % 4) as usize],
            };
            let prim = rng.u32() % scene.primitives.len() as u32;
            let u = rng.f32();
            let traced = scene.closest(&ray.ray());
            let hit = if traced.is_hit() {
                traced
            } else {
                Hit { t: rng.f32() * 10.0, u, v: (1.0 - u) * rng.f32(), prim, leaf: 0, lane: 0 }
            };
            shade(&context, &scene, &[ray], &[hit], &mut out);
        }
        let good = |v: &[f32]| v.iter().all(|&x| x >= 0.0 && x.is_finite());
        for l in &out.light {
            assert!(good(&l.value), "{l:?}");
        }
        for s in &out.shadow {
            assert!(good(&s.contribution) && s.tmax >= 0.0 && Vec3::from(s.o).is_finite(), "{s:?}");
        }
        for r in &out.next {
            assert!(good(&r.throughput) && good(&[r.pdf]) && Vec3::from(r.o).is_finite(), "{r:?}");
            assert!((Vec3::from(r.dir.decode()).length() - 1.0).abs() < 1e-6);
        }
    }
}
