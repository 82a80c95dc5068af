//! Textures in transport: the same as constants where they are constant, and closed forms of opacity.

use super::brute::{Scene, frame, frame_back};
use super::furnace::box_inside;
use super::mean_of;
use crate::film::FilmPart;
use crate::frame::Frame;
use crate::light::Lights;
use crate::material::{Amount, Blend, Bsdf, Detail, Distribution, Principled, Relief, ReliefKind};
use crate::path::{Context, reference};
use crate::testing::Rng;
use crate::texture::{Checkerboard, Texture, UvMap};

/// Gives shapes of a scene everything that detail may be.
pub fn furnish(scene: &mut Scene) {
    let image = scene.image([2, 2], vec![200, 10, 30, 0, 90, 255, 128, 128, 128, 255, 255, 0]);
    let colors = [[0.8, 0.1, 0.2], [0.1, 0.3, 0.9]];
    let to_uv = UvMap([[3.0, 0.5, 0.1], [-0.5, 2.0, 0.0]]);
    scene.textures.push(Texture::Checkerboard(Checkerboard { to_uv, colors }));
    let squares = scene.textures.len() as u32 - 1;
    let grey = Bsdf::Diffuse { reflectance: [0.5; 3] };
    let relief = |kind| Some(Relief { kind, texture: image, mirrored: false, shadowed: true });
    let back = scene.painted(squares);
    let details = [
        Detail { opacity: Amount::Constant(0.4), ..Detail::default() },
        Detail { opacity: Amount::Texture(image), ..Detail::default() },
        Detail { relief: relief(ReliefKind::Bump(0.1)), ..Detail::default() },
        Detail { relief: relief(ReliefKind::Normals), back: Some(back), ..Detail::default() },
    ];
    let mut materials = vec![scene.painted(image), back];
    materials.extend(details.map(|detail| scene.detailed(grey.clone(), detail)));
    for (k, shape) in scene.shapes.iter_mut().filter(|s| s.emission.is_none()).enumerate() {
        // some stay as they are
        if let Some(&material) = materials.get(k % (materials.len() + 1)) {
            shape.material = material;
        }
    }
}

fn picture(scene: &Scene, frame: &Frame, samples: u32) -> Vec<[f32; 3]> {
    let world = scene.world();
    world.check().unwrap();
    let lights = Lights::new(&world);
    let context = Context::new(&world, &lights, frame).with(&scene.tiles);
    let mut film = FilmPart::new(frame.size);
    reference::render(&context, scene, 0..samples, &mut film);
    film.resolve(samples)
}

/// An image of one colour is that colour, to the bit, on flat and on smooth triangles and on a sphere.
#[test]
fn a_constant_image_is_a_constant() {
    let byte = 153u8;
    let albedo = f32::from(byte) / 255.0;
    let build = |textured: bool| {
        let mut scene = Scene::default();
        let material = if textured {
            let image = scene.image([3, 2], vec![byte; 18]);
            scene.painted(image)
        } else {
            scene.diffuse(albedo)
        };
        let shape = scene.shape(material, None);
        box_inside(&mut scene, shape);
        scene.normals[4] = Some([[0.9, 0.1, 0.1]; 3]);
        scene.sphere(shape, [0.4, -0.4, 0.2], 0.4, false);
        let lamp = scene.shape(material, Some([1.0, 2.0, 3.0]));
        scene.quad(lamp, [-0.5, 0.9, -0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]);
        scene
    };
    let frame = frame([0.3, 0.25, -0.3], 70.0, [16, 16], 5);
    assert_eq!(picture(&build(true), &frame, 8), picture(&build(false), &frame, 8));
}

/// A wall of albedo a and opacity o under a sky of 1 everywhere: o a + 1 - o; the same from both sides, and stacked.
#[test]
fn opacity_lets_a_share_pass() {
    for texture in [false, true] {
        for walls in [1u32, 3] {
            let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
            // 51 / 255 is a fifth
            let opacity =
                if texture { Amount::Texture(scene.image([1, 1], vec![51; 3])) } else { Amount::Constant(0.2) };
            let black = Bsdf::Diffuse { reflectance: [0.0; 3] };
            let half = Bsdf::Diffuse { reflectance: [0.5; 3] };
            let bsdf = if walls == 1 { half } else { black };
            let material = scene.detailed(bsdf, Detail { opacity, ..Detail::default() });
            let shape = scene.shape(material, None);
            for k in 0..walls {
                scene.quad(shape, [-50.0, -50.0, 3.0 + k as f32], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]);
            }
            let expected = if walls == 1 { 0.2 * 0.5 + 0.8 } else { 0.8f64.powi(3) };
            let found = mean_of(&scene, &frame([0.0, 0.0, -2.0], 30.0, [8, 8], 8), 1024);
            println!("{texture} {walls}: {found} {expected}");
            assert!((found - expected).abs() < 0.004, "{texture} {walls}: {found} instead of {expected}");
        }
    }
}

/// From behind a one-sided surface what is opaque is black.
#[test]
fn one_side_with_holes() {
    let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
    let detail = Detail { opacity: Amount::Constant(0.25), ..Detail::default() };
    let material = scene.detailed(Bsdf::Diffuse { reflectance: [0.8; 3] }, detail);
    scene.materials[material as usize].two_sided = false;
    let shape = scene.shape(material, None);
    // front towards +z
    scene.quad(shape, [-50.0, -50.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]);
    let front = mean_of(&scene, &frame_back([0.0, 0.0, 4.0], 20.0, [8, 8], 6), 1024);
    let behind = mean_of(&scene, &frame([0.0, 0.0, -4.0], 20.0, [8, 8], 6), 1024);
    for (found, expected) in [(front, 0.25 * 0.8 + 0.75), (behind, 0.75)] {
        assert!((found - expected).abs() < 0.006, "{found} instead of {expected}");
    }
}

/// Albedos 0.8 and 0.2 blended are their weighted mean, under splitting too; a part may be a blend itself, or nothing at all.
#[test]
fn blends_are_weighted_means() {
    for (case, expected) in
        [(0, 0.3 * 0.2 + 0.7 * 0.8), (1, 0.2 * 0.2 + 0.8 * 0.8), (2, 0.5 * 0.6 + 0.5 * 0.5), (3, 0.3 + 0.7 * 0.8)]
    {
        for split in [1, 3] {
            let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
            let (bright, dark) = (scene.diffuse(0.8), scene.diffuse(0.2));
            let black = Bsdf::Diffuse { reflectance: [0.0; 3] };
            let blend = |scene: &mut Scene, weight, parts| {
                let detail = Detail { blend: Some(Blend { weight, parts }), ..Detail::default() };
                scene.detailed(black.clone(), detail)
            };
            let material = match case {
                0 => blend(&mut scene, Amount::Constant(0.3), [bright, dark]),
                1 => {
                    // 51 / 255 is a fifth
                    let weight = Amount::Texture(scene.image([1, 1], vec![51; 3]));
                    blend(&mut scene, weight, [bright, dark])
                }
                2 => {
                    let half = scene.diffuse(0.5);
                    // 0.6 = 0.8 2/3 + 0.2 1/3
                    let inner = blend(&mut scene, Amount::Constant(1.0 / 3.0), [bright, dark]);
                    blend(&mut scene, Amount::Constant(0.5), [inner, half])
                }
                _ => {
                    let null = Detail { opacity: Amount::Constant(0.0), ..Detail::default() };
                    let null = scene.detailed(black.clone(), null);
                    blend(&mut scene, Amount::Constant(0.3), [bright, null])
                }
            };
            let shape = scene.shape(material, None);
            scene.quad(shape, [-50.0, -50.0, 3.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]);
            let frame = Frame { split, ..frame([0.0, 0.0, -2.0], 30.0, [8, 8], 8) };
            let found = mean_of(&scene, &frame, 1024);
            assert!((found - expected).abs() < 0.004, "{case} {split}: {found} instead of {expected}");
        }
    }
}

/// A material that is part of itself is refused.
#[test]
fn blends_without_end_are_refused() {
    let mut scene = Scene::default();
    let a = scene.diffuse(0.5);
    for parts in [[a, a + 1], [a + 1, a], [a, a + 2]] {
        let mut scene = Scene { materials: scene.materials.clone(), ..Scene::default() };
        let blend = Some(Blend { weight: Amount::Constant(0.5), parts });
        scene.detailed(Bsdf::Diffuse { reflectance: [0.0; 3] }, Detail { blend, ..Detail::default() });
        assert!(scene.world().check().unwrap_err().contains("not above it"));
    }
}

/// A material of its own for each side.
#[test]
fn two_materials() {
    let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
    let back = scene.diffuse(0.3);
    let detail = Detail { back: Some(back), ..Detail::default() };
    let material = scene.detailed(Bsdf::Diffuse { reflectance: [0.8; 3] }, detail);
    let shape = scene.shape(material, None);
    // front towards +z
    scene.quad(shape, [-50.0, -50.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]);
    let front = mean_of(&scene, &frame_back([0.0, 0.0, 4.0], 20.0, [8, 8], 6), 256);
    let behind = mean_of(&scene, &frame([0.0, 0.0, -4.0], 20.0, [8, 8], 6), 256);
    assert!((front - 0.8).abs() < 0.01 && (behind - 0.3).abs() < 0.01, "{front} {behind}");
}

/// Random reliefs: bumps of slopes up to about 1, and normals up to 35 degrees off the surface's.
fn reliefs(scene: &mut Scene, rng: &mut Rng) -> [Relief; 2] {
    let heights = (0..8 * 8 * 3).map(|_| rng.u32() as u8).collect();
    let heights = scene.image([8, 8], heights);
    let normals = (0..8 * 8).flat_map(|_| {
        let [x, y] = [0; 2].map(|_| rng.range(-0.5, 0.5));
        [x, y, 1.0].map(|v| ((v / (x * x + y * y + 1.0).sqrt() * 0.5 + 0.5) * 255.0) as u8)
    });
    let normals = normals.collect();
    let normals = scene.image([8, 8], normals);
    [(ReliefKind::Bump(0.1), heights), (ReliefKind::Normals, normals)].map(|(kind, texture)| Relief {
        kind,
        texture,
        mirrored: true,
        shadowed: true,
    })
}

/// A closed box with wild reliefs, lit from outside only: no light comes in, though the normals would let it.
#[test]
fn reliefs_leak_nothing() {
    let mut rng = Rng(31);
    for strong in [false, true] {
        for kind in 0..2 {
            for inside in [true, false] {
                let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
                let mut relief = reliefs(&mut scene, &mut rng)[kind];
                if strong {
                    let any = (0..4 * 4 * 3).map(|_| rng.u32() as u8).collect();
                    relief.texture = scene.image([4, 4], any);
                    if kind == 0 {
                        relief.kind = ReliefKind::Bump(50.0);
                    }
                }
                let detail = || Detail { relief: Some(relief), ..Detail::default() };
                let metal = Bsdf::RoughConductor {
                    distribution: Distribution::Ggx,
                    alpha: [0.3; 2],
                    eta: [0.0; 3],
                    k: [1.0; 3],
                    specular: [1.0; 3],
                };
                let walls = [Bsdf::Diffuse { reflectance: [0.9; 3] }, metal].map(|bsdf| scene.detailed(bsdf, detail()));
                let half = Some(Blend { weight: Amount::Constant(0.5), parts: walls });
                let blend = scene
                    .detailed(Bsdf::Diffuse { reflectance: [0.0; 3] }, Detail { blend: half, ..Detail::default() });
                let shape = scene.shape(blend, None);
                box_inside(&mut scene, shape);
                if inside {
                    scene.sphere(shape, [0.3, 0.3, 0.4], 0.3, false);
                }
                let light = scene.shape(blend, Some([10.0; 3]));
                scene.sphere(light, [0.0, 5.0, 0.0], 2.0, false);
                let found = mean_of(&scene, &frame([0.1, 0.2, -0.3], 80.0, [16, 16], 6), 64);
                assert_eq!(found, 0.0, "strong {strong}, kind {kind}, something inside {inside}");
            }
        }
    }
}

/// White balls and walls with reliefs before a white sky: no pixel is brighter than the sky, and none is black, grazing ones included: the normal is on the
/// ray's side everywhere. What is missing is what a bent lobe sends into the surface.
#[test]
fn reliefs_before_a_white_sky() {
    /// What bending may cost in the mean.
    const LOST: f32 = 0.08;
    let mut rng = Rng(32);
    let metal = |distribution, alpha| Bsdf::RoughConductor {
        distribution,
        alpha: [alpha; 2],
        eta: [0.0; 3],
        k: [1.0; 3],
        specular: [1.0; 3],
    };
    let plain = Principled {
        base_color: [1.0; 3],
        eta: 1.5,
        roughness: 0.4,
        anisotropic: 0.0,
        metallic: 1.0,
        spec_trans: 0.0,
        spec_tint: 0.0,
        sheen: 0.0,
        sheen_tint: 0.0,
        clearcoat: 0.0,
        clearcoat_gloss: 0.0,
        flatness: 0.0,
    };
    for kind in 0..2 {
        for (name, bsdf) in [
            ("diffuse", Bsdf::Diffuse { reflectance: [1.0; 3] }),
            ("beckmann", metal(Distribution::Beckmann, 0.2)),
            ("ggx", metal(Distribution::Ggx, 0.5)),
            ("principled", Bsdf::Principled(plain)),
            ("plastic", Bsdf::Plastic { eta: 1.5, diffuse: [1.0; 3], specular: [1.0; 3], nonlinear: true }),
            ("blend", Bsdf::Diffuse { reflectance: [0.0; 3] }),
        ] {
            for ball in [true, false] {
                let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
                let relief = Some(reliefs(&mut scene, &mut rng)[kind]);
                let detail = || Detail { relief, ..Detail::default() };
                let material = if name == "blend" {
                    let of = [Bsdf::Diffuse { reflectance: [1.0; 3] }, metal(Distribution::Ggx, 0.3)];
                    let parts = of.map(|bsdf| scene.detailed(bsdf, detail()));
                    let blend = Some(Blend { weight: Amount::Constant(0.5), parts });
                    scene.detailed(bsdf.clone(), Detail { blend, ..Detail::default() })
                } else {
                    scene.detailed(bsdf.clone(), detail())
                };
                let shape = scene.shape(material, None);
                // a ball that fills the picture to its silhouette; a wall seen from 4 degrees above it
                let frame = if ball {
                    scene.sphere(shape, [0.0, 0.0, 0.0], 1.0, false);
                    frame([0.0, 0.0, -6.0], 19.0, [24, 24], 2)
                } else {
                    scene.quad(shape, [-9.0, -0.4, -9.0], [0.0, 0.0, 18.0], [18.0, 0.0, 0.0]);
                    frame([0.0, 0.0, -6.0], 12.0, [24, 24], 2)
                };
                let seen = |scene: &Scene| {
                    let pixels: Vec<f32> = picture(scene, &frame, 256).iter().map(|p| p[0]).collect();
                    let mean = pixels.iter().sum::<f32>() / pixels.len() as f32;
                    let (low, high) = pixels.iter().fold((f32::MAX, 0.0f32), |(l, h), &p| (l.min(p), h.max(p)));
                    [mean, low, high]
                };
                let bent = seen(&scene);
                for detail in scene.materials.iter_mut().filter_map(|m| m.detail.as_mut()) {
                    detail.relief = None;
                }
                let even = seen(&scene);
                println!("{name}, kind {kind}, ball {ball}: mean, least, most {bent:.3?}; without relief {even:.3?}");
                let [mean, low, high] = bent;
                let told = format!("{name}, kind {kind}, ball {ball}: {bent:?}, without relief {even:?}");
                assert!(mean < 1.005 && high < 1.2 && mean > even[0] - LOST && low > 0.15, "{told}");
            }
        }
    }
}

/// A wall whose normal is turned by a constant map, under a white sky: the integral of the turned cosine, times what the shadowing function leaves, over the
/// hemisphere of the wall. Mitsuba 3.9.1 (scalar_rgb) renders 0.95932 and 0.86090 of the two that are shadowed, with a standard error of 0.0005.
#[test]
fn turned_normals_are_shadowed() {
    for (normal, shadowed, mitsuba) in [
        ([0.3, 0.0, 1.0], true, Some(0.95932)),
        ([0.6, 0.2, 1.0], true, Some(0.86090)),
        ([0.3, 0.0, 1.0], false, None),
        ([0.6, 0.2, 1.0], false, None),
    ] {
        let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
        let [x, y, z] = normal;
        let length = f64::sqrt(x * x + y * y + z * z);
        let texel = normal.map(|v| ((v / length * 0.5 + 0.5) * 255.0).round() as u8);
        let texture = scene.image([1, 1], texel.to_vec());
        // as the byte has it
        let m = texel.map(|b| f64::from(b) / 255.0 * 2.0 - 1.0);
        let length = f64::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]);
        let m = m.map(|v| v / length);
        let alpha2 = ((1.0 - m[2] * m[2]) / (m[2] * m[2]) / 8.0).min(1.0) * f64::from(u8::from(shadowed));
        let (steps, mut exact) = (800, 0.0);
        for i in 0..steps {
            let z = (f64::from(i) + 0.5) / f64::from(steps);
            let r = f64::sqrt(1.0 - z * z);
            let left = 2.0 / (1.0 + f64::sqrt(1.0 + alpha2 * (1.0 - z * z) / (z * z)));
            for j in 0..steps {
                let phi = f64::from(j) / f64::from(steps) * std::f64::consts::TAU;
                let (sin, cos) = (libm::sin(phi), libm::cos(phi));
                exact += (m[0] * r * cos + m[1] * r * sin + m[2] * z).max(0.0) * left;
            }
        }
        exact *= 2.0 / f64::from(steps * steps);
        let white = Bsdf::Diffuse { reflectance: [1.0; 3] };
        // the general way of shading, too
        let coated = Bsdf::Phong { diffuse: [1.0; 3], specular: [0.0; 3], exponent: 1.0 };
        for bsdf in [white, coated] {
            let relief = Some(Relief { kind: ReliefKind::Normals, texture, mirrored: true, shadowed });
            let material = scene.detailed(bsdf, Detail { relief, ..Detail::default() });
            scene.primitives.clear();
            scene.normals.clear();
            let shape = scene.shape(material, None);
            scene.quad(shape, [-9.0, -9.0, 0.0], [18.0, 0.0, 0.0], [0.0, 18.0, 0.0]);
            let found = mean_of(&scene, &frame_back([0.3, 0.2, 4.0], 10.0, [8, 8], 2), 4096);
            println!("{normal:?} shadowed {shadowed}: {found:.5}, exact {exact:.5}, Mitsuba {mitsuba:?}");
            assert!((found - exact).abs() < 0.001, "{normal:?} {shadowed}: {found} instead of {exact}");
            // beside the noise of theirs, that of a normal in bytes
            assert!(mitsuba.is_none_or(|theirs: f64| (found - theirs).abs() < 0.004), "{found} {mitsuba:?}");
        }
    }
}
