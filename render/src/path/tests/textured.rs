//! Textures in transport: the same as constants where they are constant, and closed forms of opacity.

use super::brute::{Scene, frame, frame_back};
use super::furnace::box_inside;
use super::mean_of;
use crate::film::FilmPart;
use crate::frame::Frame;
use crate::light::Lights;
use crate::material::{Amount, Blend, Bsdf, Detail, Relief, ReliefKind};
use crate::path::{Context, reference};
use crate::texture::{Checkerboard, Texture, UvMap};

/// Gives shapes of a scene everything that detail may be.
pub fn furnish(scene: &mut Scene) {
    let image = scene.image([2, 2], vec![200, 10, 30, 0, 90, 255, 128, 128, 128, 255, 255, 0]);
    let colors = [[0.8, 0.1, 0.2], [0.1, 0.3, 0.9]];
    let to_uv = UvMap([[3.0, 0.5, 0.1], [-0.5, 2.0, 0.0]]);
    scene.textures.push(Texture::Checkerboard(Checkerboard { to_uv, colors }));
    let squares = scene.textures.len() as u32 - 1;
    let grey = Bsdf::Diffuse { reflectance: [0.5; 3] };
    let relief = |kind| Some(Relief { kind, texture: image, mirrored: false });
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
