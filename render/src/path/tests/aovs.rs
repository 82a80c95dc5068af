//! AOVs against closed forms of what camera rays come upon, sample by sample.

use std::mem::size_of;

use glam::{DVec3, Vec3};

use super::brute::{Scene, frame};
use super::furnace::box_inside;
use super::textured::furnish;
use super::{cornell, mean_of};
use crate::aov::{Aov, Aovs};
use crate::film::{Channel, FilmPart};
use crate::frame::Frame;
use crate::material::{Amount, Blend, Bsdf, Detail, Relief, ReliefKind};
use crate::path::reference::Tracer;
use crate::path::{Context, Outcome, PathRay, ShadowRay, camera_ray, reference, shade, take_aovs};
use crate::skip::{Skip, Skips};
use crate::texture::{Checkerboard, Texture, UvMap};

const SAMPLES: u32 = 6;

fn film(scene: &Scene, frame: &Frame, skips: Skips) -> FilmPart {
    let (world, lights) = (scene.world(), scene.lights());
    let context = Context::new(&world, &lights, frame).with(&scene.tiles).skipping(skips);
    let mut film = FilmPart::new(frame.layout());
    reference::render(&context, scene, 0..SAMPLES, &mut film);
    assert_eq!(film.rejected().count, 0);
    film
}

fn channels(scene: &Scene, frame: &Frame) -> Vec<Channel> {
    film(scene, frame, Skips::ALL).channels(SAMPLES, [0.0; 3])
}

fn values<'c>(channels: &'c [Channel], name: &str) -> &'c [f32] {
    &channels.iter().find(|c| c.name == name).unwrap_or_else(|| panic!("no {name}")).values
}

fn with(frame: Frame, aovs: impl IntoIterator<Item = Aov>) -> Frame {
    Frame { aovs: aovs.into_iter().collect(), ..frame }
}

/// Origin and direction of each of a pixel's camera rays.
fn camera_rays(frame: &Frame, pixel: u32) -> impl Iterator<Item = (DVec3, DVec3)> {
    (0..SAMPLES).map(move |sample| {
        let ray = camera_ray(frame, pixel, sample).ray();
        (Vec3::from(ray.o).as_dvec3(), Vec3::from(ray.d).as_dvec3())
    })
}

/// Compares channels with the mean over the samples of what is expected of each.
#[track_caller]
fn check<const N: usize>(
    frame: &Frame,
    channels: &[Channel],
    names: [&str; N],
    tolerance: f64,
    expected: impl Fn(DVec3, DVec3) -> [f64; N],
) {
    for pixel in 0..frame.size[0] * frame.size[1] {
        let mut sum = [0.0; N];
        for (o, d) in camera_rays(frame, pixel) {
            let one = expected(o, d);
            (0..N).for_each(|c| sum[c] += one[c]);
        }
        for c in 0..N {
            let found = f64::from(values(channels, names[c])[pixel as usize]);
            let mean = sum[c] / f64::from(SAMPLES);
            assert!((found - mean).abs() <= tolerance, "{} of pixel {pixel}: {found} instead of {mean}", names[c]);
        }
    }
}

const XYZ: [&str; 3] = ["position.X", "position.Y", "position.Z"];
const NORMAL: [&str; 3] = ["normal.X", "normal.Y", "normal.Z"];
const ALBEDO: [&str; 3] = ["albedo.R", "albedo.G", "albedo.B"];

/// A square of texture coordinates 0 to 1, two units in front of the camera, from (-1, -1) to (1, 1); its front looks at the camera.
fn board(scene: &mut Scene, material: u32) {
    let shape = scene.shape(material, None);
    scene.quad(shape, [-1.0, -1.0, 2.0], [0.0, 2.0, 0.0], [2.0, 0.0, 0.0]);
    for (n, corners) in
        [[[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0]]].into_iter().enumerate()
    {
        scene.extras.insert(n as u32, (Some(corners), None));
    }
}

#[test]
fn a_plane_has_its_depth_place_and_coordinates() {
    let mut scene = Scene::default();
    let grey = scene.diffuse(0.25);
    board(&mut scene, grey);
    // the field of view is wider than the board: its edges are seen, and beside them nothing
    let frame = with(frame([0.1, 0.05, 0.0], 70.0, [12, 10], 3), Aov::ALL);
    let channels = channels(&scene, &frame);
    let on_board = |o: DVec3, d: DVec3| {
        let p = o + d * ((2.0 - o.z) / d.z);
        (p.x.abs() <= 1.0 && p.y.abs() <= 1.0).then_some(p)
    };
    check(&frame, &channels, ["depth.Z"], 1e-6, |o, d| [on_board(o, d).map_or(0.0, |p| (p - o).length())]);
    check(&frame, &channels, XYZ, 1e-6, |o, d| on_board(o, d).map_or([0.0; 3], |p| p.to_array()));
    check(&frame, &channels, ["uv.U", "uv.V"], 1e-6, |o, d| {
        on_board(o, d).map_or([0.0; 2], |p| [(p.x + 1.0) / 2.0, (p.y + 1.0) / 2.0])
    });
    check(&frame, &channels, NORMAL, 1e-6, |o, d| [0.0, 0.0, -f64::from(u8::from(on_board(o, d).is_some()))]);
    check(&frame, &channels, ALBEDO, 1e-6, |o, d| [0.25 * f64::from(u8::from(on_board(o, d).is_some())); 3]);
    // of the first sample alone
    for pixel in 0..120 {
        let met = camera_rays(&frame, pixel).next().and_then(|(o, d)| on_board(o, d)).is_some();
        let numbers = ["objectId.Y", "materialId.Y"].map(|n| values(&channels, n)[pixel as usize]);
        assert_eq!(numbers, [f32::from(u8::from(met)); 2], "pixel {pixel}");
    }
    let depth = values(&channels, "depth.Z");
    assert!(depth.contains(&0.0) && depth.iter().any(|&z| z > 1.9));
}

/// What was taken away to recentre is given back, times the share of samples that came upon something.
#[test]
fn positions_are_the_scenes() {
    let mut scene = Scene::default();
    let grey = scene.diffuse(0.25);
    board(&mut scene, grey);
    let frame = with(frame([0.0; 3], 70.0, [12, 10], 1), [Aov::Position, Aov::Normal]);
    let film = film(&scene, &frame, Skips::ALL);
    let offset = [1.0e6 + 0.125, -3.0, 0.5];
    let (here, there) = (film.channels(SAMPLES, [0.0; 3]), film.channels(SAMPLES, offset));
    let mut partly = 0;
    for pixel in 0..120 {
        // the normal is that of the board, so it tells the share
        let share = -f64::from(values(&here, "normal.Z")[pixel]);
        partly += u32::from(share > 0.0 && share < 1.0);
        for (c, name) in XYZ.into_iter().enumerate() {
            let (a, b) = (f64::from(values(&here, name)[pixel]), f64::from(values(&there, name)[pixel]));
            assert!((a + offset[c] * share - b).abs() <= b.abs() * 1e-7 + 1e-6, "{name} of {pixel}: {a}, {b}");
        }
    }
    assert!(partly > 5);
}

/// Spheres are exact; seen from inside, or flipped, the normal stays that of the front.
#[test]
fn a_sphere_has_its_normals() {
    for (flipped, inside) in [(false, false), (true, false), (false, true), (true, true)] {
        let mut scene = Scene::default();
        let grey = scene.diffuse(0.5);
        let shape = scene.shape(grey, None);
        let (center, radius) = (DVec3::new(0.2, -0.1, 3.0), if inside { 6.0 } else { 1.0 });
        scene.sphere(shape, center.as_vec3().to_array(), radius as f32, flipped);
        let frame = with(frame([0.0; 3], 50.0, [10, 10], 1), [Aov::Normal, Aov::Depth, Aov::Position]);
        let channels = channels(&scene, &frame);
        let met = |o: DVec3, d: DVec3| {
            let f = o - center;
            let b = -f.dot(d);
            // d is of unit length to a float's precision
            let root = (b * b - d.length_squared() * (f.length_squared() - radius * radius)).sqrt();
            let t = if inside { b + root } else { b - root } / d.length_squared();
            (t > 0.0).then(|| (t, o + d * t))
        };
        let side = if flipped { -1.0 } else { 1.0 };
        // where the ray grazes the sphere an error of a float is a larger one of the place
        check(&frame, &channels, NORMAL, 2e-3, |o, d| {
            met(o, d).map_or([0.0; 3], |(_, p)| ((p - center) * (side / radius)).to_array())
        });
        check(&frame, &channels, ["depth.Z"], 2e-3, |o, d| [met(o, d).map_or(0.0, |(t, _)| t)]);
        check(&frame, &channels, XYZ, 2e-3, |o, d| met(o, d).map_or([0.0; 3], |(_, p)| p.to_array()));
    }
}

/// A checkerboard's squares, a blend's mean, a share of opacity.
#[test]
fn albedos_are_those_of_textures() {
    let colors = [[0.75, 0.25, 0.5], [0.125, 0.5, 0.0]];
    let mut scene = Scene::default();
    let to_uv = UvMap([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]);
    scene.textures.push(Texture::Checkerboard(Checkerboard { to_uv, colors }));
    let painted = scene.painted(0);
    board(&mut scene, painted);
    let frame = with(frame([0.1, 0.05, 0.0], 40.0, [12, 10], 1), [Aov::Albedo]);
    let found = channels(&scene, &frame);
    let square = |x: f64| ((x + 1.0) * 2.0).floor() as i64;
    // samples on the edge between two squares fall to either by rounding
    let near = |x: f64| ((x + 1.0) * 2.0 - ((x + 1.0) * 2.0).round()).abs() < 1e-5;
    let mut compared = 0;
    for pixel in 0..120 {
        let places: Vec<DVec3> = camera_rays(&frame, pixel).map(|(o, d)| o + d * ((2.0 - o.z) / d.z)).collect();
        if places.iter().any(|p| near(p.x) || near(p.y)) {
            continue;
        }
        compared += 1;
        for (c, name) in ALBEDO.into_iter().enumerate() {
            let one = |p: &DVec3| f64::from(colors[((square(p.x) + square(p.y)) & 1) as usize][c]);
            let mean = places.iter().map(one).sum::<f64>() / f64::from(SAMPLES);
            assert!((f64::from(values(&found, name)[pixel as usize]) - mean).abs() < 1e-6, "{name} of {pixel}");
        }
    }
    assert!(compared > 100);

    let mut scene = Scene::default();
    let (dark, bright) = (scene.diffuse(0.25), scene.diffuse(0.75));
    let blend = Some(Blend { weight: Amount::Constant(0.375), parts: [dark, bright] });
    let opacity = Amount::Constant(0.5);
    let blended =
        scene.detailed(Bsdf::Diffuse { reflectance: [0.0; 3] }, Detail { blend, opacity, ..Detail::default() });
    board(&mut scene, blended);
    let frame = with(super::brute::frame([0.0; 3], 40.0, [24, 24], 1), [Aov::Albedo]);
    let all = values(&channels(&scene, &frame), "albedo.G").to_vec();
    let mean = all.iter().map(|&x| f64::from(x)).sum::<f64>() / all.len() as f64;
    let expected = 0.5 * (0.25 * 0.625 + 0.75 * 0.375);
    // of 3456 choices, each 0.125 or 0.375: a standard error of 0.002, less by stratification
    assert!((mean - expected).abs() < 0.006, "{mean} {expected}");
    for (bsdf, color) in [
        (Bsdf::Dielectric { eta: 1.5, reflect: [0.1; 3], transmit: [0.9, 0.8, 0.7] }, [0.9, 0.8, 0.7]),
        // ((1 - 0.5)^2 + 4) / ((1 + 0.5)^2 + 4)
        (Bsdf::Conductor { eta: [0.5; 3], k: [2.0; 3], specular: [1.0, 0.5, 0.0] }, [0.68, 0.34, 0.0]),
        (Bsdf::Phong { diffuse: [0.3, 0.2, 0.1], specular: [0.5; 3], exponent: 9.0 }, [0.3, 0.2, 0.1]),
    ] {
        let found = bsdf.color();
        assert!((found - Vec3::from(color)).abs().max_element() < 1e-6, "{bsdf:?}: {found}");
    }
}

/// A normal map turns the normal as it turns shading's.
#[test]
fn normals_have_their_relief() {
    let mut scene = Scene::default();
    // (0.6, 0, 0.8) in the frame of u, v and the normal: linear bytes of 2 c - 1
    let image = scene.image([1, 1], vec![204, 128, 230]);
    let relief = Some(Relief { kind: ReliefKind::Normals, texture: image, mirrored: false, shadowed: true });
    let bumpy = scene.detailed(Bsdf::Diffuse { reflectance: [0.5; 3] }, Detail { relief, ..Detail::default() });
    board(&mut scene, bumpy);
    let frame = with(frame([0.0; 3], 20.0, [4, 4], 1), [Aov::Normal]);
    let channels = channels(&scene, &frame);
    // u is along x
    check(&frame, &channels, NORMAL, 5e-3, |_, _| [0.6, 0.0, -0.8]);
}

#[test]
fn what_is_hidden_is_not_come_upon() {
    let mut scene = Scene::default();
    let grey = scene.diffuse(0.5);
    board(&mut scene, grey);
    let plain = with(frame([0.1, 0.05, 0.0], 60.0, [8, 8], 2), [Aov::Depth, Aov::Position, Aov::ObjectId]);
    let without = channels(&scene, &plain);
    let lamp = scene.shape(grey, Some([1.0; 3]));
    scene.quad(lamp, [-0.5, -0.5, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]);
    let seen = channels(&scene, &plain);
    let hidden = channels(&scene, &Frame { hide_emitters: true, ..plain.clone() });
    assert!(values(&seen, "objectId.Y").contains(&2.0));
    for (a, b) in without.iter().zip(&hidden) {
        assert!(a.values.iter().zip(&b.values).all(|(a, b)| (a - b).abs() < 2e-6), "{}", a.name);
    }
}

/// Paths of n rays in a closed box have n vertices; and whatever a scene is, the plain count of what its paths do.
#[test]
fn cost_is_what_paths_do() {
    let mut scene = Scene::default();
    let grey = scene.diffuse(0.5);
    let shape = scene.shape(grey, None);
    box_inside(&mut scene, shape);
    let closed = with(frame([0.3, 0.25, -0.3], 70.0, [6, 5], 4), [Aov::Cost]);
    assert!(values(&channels(&scene, &closed), "cost.Y").iter().all(|&n| n == 4.0));

    let mut scene = cornell::scene();
    furnish(&mut scene);
    scene.environment = Some([0.2; 3]);
    for split in [1, 3] {
        let frame = Frame { split, ..with(cornell::frame(8), [Aov::Cost]) };
        let (world, lights) = (scene.world(), scene.lights());
        let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
        let mut counts = vec![0u32; 64];
        let mut out = Outcome::default();
        for pixel in 0..64 {
            let mut stack: Vec<PathRay> = (0..SAMPLES).map(|s| camera_ray(&frame, pixel, s)).collect();
            while let Some(ray) = stack.pop() {
                let hit = scene.closest(&ray.ray());
                shade(&context, &scene, &[ray], &[hit], &mut out);
                counts[pixel as usize] += u32::from(hit.is_hit()) + out.shadow.len() as u32;
                stack.append(&mut out.next);
                out.clear();
            }
        }
        let found = channels(&scene, &frame);
        for (found, count) in values(&found, "cost.Y").iter().zip(counts) {
            assert_eq!(*found, (f64::from(count) / f64::from(SAMPLES)) as f32);
        }
    }
}

/// Taken of a batch they are those of its rays one by one; and neither skips nor the light itself change or are changed.
#[test]
fn batches_skips_and_light_do_not_matter() {
    let mut scene = cornell::scene();
    furnish(&mut scene);
    scene.environment = Some([0.2; 3]);
    for split in [1, 3] {
        let frame = Frame { split, ..with(cornell::frame(12), Aov::ALL) };
        let one_by_one = film(&scene, &frame, Skips::ALL);
        let (world, lights) = (scene.world(), scene.lights());
        let context = Context::new(&world, &lights, &frame).with(&scene.tiles);
        let mut together = FilmPart::new(frame.layout());
        let mut out = Outcome::default();
        let keys = (0..144).flat_map(|pixel| (0..SAMPLES).map(move |sample| (pixel, sample)));
        let mut rays: Vec<PathRay> = keys.map(|(pixel, sample)| camera_ray(&frame, pixel, sample)).collect();
        while !rays.is_empty() {
            let hits: Vec<_> = rays.iter().map(|r| scene.closest(&r.ray())).collect();
            shade(&context, &scene, &rays, &hits, &mut out);
            take_aovs(&context, &scene, &rays, &hits, &out.shadow, frame.aovs, |aov, pixel, sample, values| {
                together.add_aov(aov, pixel, sample, values);
            });
            together.add_all(out.light.iter().map(|l| (l.pixel, l.sample, l.value)));
            let lit = out.shadow.iter().filter(|s| !scene.occluded(&s.ray()));
            together.add_all(lit.map(|s| (s.key.pixel, s.key.sample, s.contribution)));
            rays = std::mem::take(&mut out.next);
            out.clear();
        }
        assert!(together == one_by_one);
        // siblings need a camera that makes them, which is the herd's
        let skips = Skip::ALL.into_iter().filter(|s| s.keeps_bytes() && *s != Skip::Merged);
        let thorough = film(&scene, &frame, skips.fold(Skips::ALL, Skips::without));
        assert!(thorough.channels(SAMPLES, [0.0; 3]) == one_by_one.channels(SAMPLES, [0.0; 3]));
        let plain = film(&scene, &Frame { aovs: Aovs::NONE, ..frame.clone() }, Skips::ALL);
        assert!(plain.resolve(SAMPLES) == one_by_one.resolve(SAMPLES));
        let mut kept = one_by_one;
        kept.keep_aovs(Aovs::NONE);
        assert!(kept == plain);
    }
}

/// Rays carry nothing for them, and neither does a film without any.
#[test]
fn without_any_nothing_is_paid() {
    assert_eq!((size_of::<PathRay>(), size_of::<ShadowRay>()), (48, 48));
    let mut scene = Scene::default();
    let grey = scene.diffuse(0.5);
    board(&mut scene, grey);
    scene.environment = Some([1.0; 3]);
    let plain = frame([0.0; 3], 60.0, [40, 40], 2);
    assert!(mean_of(&scene, &plain, 1) > 0.5);
    let film = film(&scene, &plain, Skips::ALL);
    assert!(film.aovs().is_empty() && film.channels(SAMPLES, [0.0; 3]).is_empty());
    // four tiles of 96 bytes a pixel, and their places
    assert_eq!(film.memory(), 4 * (96 * 1024 + 16));
    assert_eq!(film.encode()[..4], *b"RHF1");
    assert!(!serde_json::to_string(&plain).unwrap().contains("aovs"));
}
