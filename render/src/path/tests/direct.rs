//! Direct light in closed form, seen from a point through a narrow camera.

use std::sync::Arc;

use glam::{DVec3, Vec3};

use super::brute::{Scene, frame};
use super::mean_of;
use crate::light::SkyMap;
use crate::material::{Bsdf, Distribution};
use crate::texture::{Checkerboard, Texture, UvMap};
use crate::world::{Beam, Slide};

const PI: f64 = std::f64::consts::PI;

/// A floor at y = 0 (front up) of albedo 0.5, and a frame of 4 x 4 pixels that sees the point (0, 0, 3) under 45 degrees, 0.001 wide.
fn floor() -> (Scene, crate::frame::Frame) {
    let mut scene = Scene::default();
    let material = scene.diffuse(0.5);
    let shape = scene.shape(material, None);
    scene.quad(shape, [-50.0, 0.0, -50.0], [0.0, 0.0, 100.0], [100.0, 0.0, 0.0]);
    let s = 0.5f64.sqrt();
    let mut frame = frame([0.0; 3], 0.02, [4, 4], 2);
    // z of the camera: (0, -s, s); y: (0, s, s); x: to the left
    let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, s, -s, 3.0], [0.0, s, s, 0.0]];
    frame.camera = crate::camera::Camera::new(&rows, 0.02, [4, 4], [0.0; 3]).unwrap();
    (scene, frame)
}

/// Irradiance at `p` of a polygon of radiance 1 that lies above the plane of normal `n` (Lambert 1760).
fn polygon(p: DVec3, n: DVec3, vertices: &[DVec3]) -> f64 {
    let sides = vertices.iter().zip(vertices.iter().cycle().skip(1));
    0.5 * sides
        .map(|(a, b)| {
            let (a, b) = ((*a - p).normalize(), (*b - p).normalize());
            a.cross(b).normalize().dot(n) * a.dot(b).acos()
        })
        .sum::<f64>()
        .abs()
}

#[test]
fn rectangle_over_a_plane() {
    let (mut scene, frame) = floor();
    let black = scene.diffuse(0.0);
    let light = scene.shape(black, Some([2.0; 3]));
    scene.quad(light, [0.3, 1.0, 2.0], [1.5, 0.0, 0.0], [0.0, 0.3, 1.0]);
    let corner = DVec3::new(0.3, 1.0, 2.0);
    let (a, b) = (DVec3::new(1.5, 0.0, 0.0), DVec3::new(0.0, 0.3, 1.0));
    let e = 2.0 * polygon(DVec3::new(0.0, 0.0, 3.0), DVec3::Y, &[corner, corner + a, corner + a + b, corner + b]);
    let expected = 0.5 / PI * e;
    let found = mean_of(&scene, &frame, 4096);
    println!("{found} {expected}");
    assert!((found / expected - 1.0).abs() < 0.002, "{found} {expected}");
}

/// The same of which a texture lights two of four quarters; the mesh's attribute; and nothing, by a texture that is dark or negative.
#[test]
fn textured_rectangle_over_a_plane() {
    let corner = DVec3::new(0.3, 1.0, 2.0);
    let (a, b) = (DVec3::new(1.5, 0.0, 0.0), DVec3::new(0.0, 0.3, 1.0));
    let part = |s: f64, t: f64, size: f64| {
        let o = corner + a * s + b * t;
        let (a, b) = (a * size, b * size);
        polygon(DVec3::new(0.0, 0.0, 3.0), DVec3::Y, &[o, o + a, o + a + b, o + b])
    };
    let squares = Texture::Checkerboard(Checkerboard { to_uv: UvMap::IDENTITY, colors: [[4.0; 3], [0.0; 3]] });
    let dark = Texture::Checkerboard(Checkerboard { to_uv: UvMap::IDENTITY, colors: [[0.0; 3], [-3.0; 3]] });
    let quarters = 2.0 * 4.0 * (part(0.0, 0.0, 0.5) + part(0.5, 0.5, 0.5));
    for (texture, e, tolerance) in [
        (squares, quarters, 0.004),
        (Texture::Attribute { scale: 0.5 }, 2.0 * 0.5 * 3.0 * part(0.0, 0.0, 1.0), 0.002),
        (dark, 0.0, 0.0),
    ] {
        let (mut scene, frame) = floor();
        let black = scene.diffuse(0.0);
        let light = scene.shape(black, Some([2.0; 3]));
        scene.textures.push(texture.clone());
        scene.shapes[light as usize].emission_texture = Some(0);
        let first = scene.primitives.len() as u32;
        scene.quad(light, [0.3, 1.0, 2.0], [1.5, 0.0, 0.0], [0.0, 0.3, 1.0]);
        for (k, uv) in
            [[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]].into_iter().enumerate()
        {
            scene.extras.insert(first + k as u32, (Some(uv), Some([[3.0; 3]; 3])));
        }
        let expected = 0.5 / PI * e;
        let found = mean_of(&scene, &frame, 8192);
        println!("{texture:?}: {found} {expected}");
        assert!((found - expected).abs() <= tolerance * expected, "{texture:?}: {found} {expected}");
    }
}

/// A spot's picture: x and y of the light go to u and v.
#[test]
fn a_spot_throws_a_picture() {
    let position = [0.0, 2.0, 3.0f32];
    for (uv, color) in [([-0.3, -0.3], 0.25), ([0.3, -0.3], 0.5), ([-0.3, 0.3], 0.125), ([0.3, 0.3], 1.0)] {
        let (mut scene, frame) = floor();
        // four texels, by rows; the light's x and y are the world's x and z
        let bytes: Vec<u8> =
            [0.25, 0.5, 0.125, 1.0].iter().flat_map(|v: &f64| [(v * 255.0).round() as u8; 3]).collect();
        scene.image([2, 2], bytes);
        if let Texture::Bitmap(b) = &mut scene.textures[0] {
            b.filter = crate::texture::Filter::Nearest;
        }
        let tan = 0.5f32;
        // looks beside the point, so that it is seen there
        let target = Vec3::new(-2.0 * uv[0] * tan, 0.0, 3.0 - 2.0 * uv[1] * tan);
        let axis = (target - Vec3::from(position)).normalize();
        let s = Vec3::new(-axis.y, axis.x, 0.0).normalize();
        let t = s.cross(axis);
        let t = if t.z < 0.0 { -t } else { t };
        let to_local = [s.to_array(), t.to_array(), axis.to_array()];
        let slide = Some(Slide { texture: 0, to_local, tan });
        let cutoff = libm::atanf(tan);
        scene.beams.push(Beam::Spot {
            position,
            axis: axis.to_array(),
            intensity: [5.0; 3],
            beam: cutoff * 0.999,
            cutoff,
            slide,
        });
        let found = mean_of(&scene, &frame, 4);
        let color = f64::from((color * 255.0f64).round() as u8) / 255.0;
        // straight below the light, but for the lift of a ray's origin off a floor 100 wide
        let expected = 0.5 / PI * 5.0 / 4.0 * color;
        assert!((found - expected).abs() <= 5e-4 * expected, "{uv:?}: {found} {expected}");
    }
}

/// E = pi L (r / d)^2 cos, for a sphere wholly above the horizon: near, small and far ones.
#[test]
fn sphere_over_a_plane() {
    for (center, r) in [([0.0, 2.0, 3.0], 0.7), ([1.0, 1.5, 4.0], 1.0), ([3.0, 40.0, 10.0], 0.01)] {
        let (mut scene, frame) = floor();
        let black = scene.diffuse(0.0);
        let light = scene.shape(black, Some([3.0; 3]));
        scene.sphere(light, center, r, false);
        let way = DVec3::from(center.map(f64::from)) - DVec3::new(0.0, 0.0, 3.0);
        let d = way.length();
        let expected = 0.5 * 3.0 * (f64::from(r) / d).powi(2) * way.y / d;
        let found = mean_of(&scene, &frame, 2048);
        println!("{found} {expected}");
        assert!((found / expected - 1.0).abs() < 0.002, "{found} {expected}");
    }
}

/// An open sky on a floor: albedo times radiance, also when another light makes the sky a choice among others.
#[test]
fn open_sky() {
    for other in [false, true] {
        let (mut scene, frame) = floor();
        scene.environment = Some([4.0; 3]);
        if other {
            let black = scene.diffuse(0.0);
            let light = scene.shape(black, Some([1.0; 3]));
            // shines away from the floor's point and covers nothing of its sky: below the floor
            scene.quad(light, [-1.0, -3.0, -1.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]);
        }
        let found = mean_of(&scene, &frame, 2048);
        println!("{found}");
        assert!((found / 2.0 - 1.0).abs() < 0.002, "{found}");
    }
}

/// Points, spots and parallel light: intensity over squared distance times cosine, exactly, for one light; in the mean for all at once.
#[test]
fn beams_over_a_plane() {
    let p = DVec3::new(0.0, 0.0, 3.0);
    let position = [1.0, 2.0, 2.5f32];
    let way = DVec3::from(position.map(f64::from)) - p;
    let (distance, cos) = (way.length(), way.y / way.length());
    let towards = (-way / distance).as_vec3();
    // turned from the middle of the cone by 0.3
    let axis = (glam::Quat::from_axis_angle(towards.any_orthonormal_vector(), 0.3) * towards).to_array();
    let intensity = [5.0; 3];
    let spot = |beam, cutoff| Beam::Spot { position, axis, intensity, beam, cutoff, slide: None };
    let direction = Vec3::new(0.6, -0.48, 0.64);
    let straight = 5.0 * cos / distance.powi(2);
    let cases = [
        (Beam::Point { position, intensity }, straight),
        (spot(0.31, 0.4), straight),
        (spot(0.1, 0.5), 0.5 * straight),
        (spot(0.1, 0.29), 0.0),
        (Beam::Directional { direction: direction.to_array(), irradiance: [3.0; 3] }, 3.0 * 0.48),
        // from below
        (Beam::Directional { direction: [0.0, 1.0, 0.0], irradiance: [3.0; 3] }, 0.0),
    ];
    let mut all = floor();
    for (beam, irradiance) in cases {
        let (mut scene, frame) = floor();
        scene.beams.push(beam);
        all.0.beams.push(beam);
        let found = mean_of(&scene, &frame, 4);
        let expected = 0.5 / PI * irradiance;
        assert!((found - expected).abs() <= 2e-4 * expected, "{beam:?}: {found} {expected}");
    }
    let (found, expected) = (mean_of(&all.0, &all.1, 4096), 0.5 / PI * cases.iter().map(|c| c.1).sum::<f64>());
    assert!((found / expected - 1.0).abs() < 0.005, "{found} {expected}");
    // something in the way, short of the point and beyond it
    for (height, expected) in [(1.0, 0.0), (2.5, 0.5 / PI * straight)] {
        let (mut scene, frame) = floor();
        scene.beams.push(Beam::Point { position, intensity });
        let black = scene.diffuse(0.0);
        let lid = scene.shape(black, None);
        scene.quad(lid, [-0.5, height, 1.5], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]);
        let found = mean_of(&scene, &frame, 4);
        assert!((found - expected).abs() <= 2e-4 * expected, "{height}: {found} {expected}");
    }
}

/// A turned picture of the sky over a floor: the irradiance by quadrature of the look-up's plain sum; alone and beside a lamp that lights nothing.
#[test]
fn sky_map_over_a_plane() {
    let (w, h) = (24, 13);
    let texels: Vec<[f32; 3]> =
        (0..w * h).map(|i| [if i % 37 == 5 { 40.0 } else { (i % 5) as f32 * 0.25 }; 3]).collect();
    let map = Arc::new(SkyMap::new(w, h, texels).unwrap());
    // the picture's axes in the world: x, y, z are z, x, y
    let to_map = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let (mut irradiance, n) = (0.0, 800);
    for i in 0..n {
        // even in the square of the sine: the cosine is in the measure
        let s = ((f64::from(i) + 0.5) / f64::from(n)).sqrt();
        for j in 0..4 * n {
            let phi = 2.0 * PI * (f64::from(j) + 0.5) / f64::from(4 * n);
            let d = DVec3::new(s * phi.cos(), (1.0 - s * s).sqrt(), s * phi.sin());
            irradiance += f64::from(map.radiance(Vec3::new(d.z as f32, d.x as f32, d.y as f32)).x);
        }
    }
    let expected = 0.5 * irradiance / f64::from(4 * n * n);
    for other in [false, true] {
        let (mut scene, frame) = floor();
        scene.sky_map = Some((map.clone(), to_map));
        if other {
            let black = scene.diffuse(0.0);
            let light = scene.shape(black, Some([1.0; 3]));
            scene.quad(light, [-1.0, -3.0, -1.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]);
        }
        let found = mean_of(&scene, &frame, 4096);
        println!("{found} {expected}");
        assert!((found / expected - 1.0).abs() < 0.004, "{found} {expected}");
    }
}

/// Emitters that are hidden: the camera sees the floor behind a lamp and no sky, and the lamp still lights the floor; a mirror shows it.
#[test]
fn hidden_emitters() {
    let (mut scene, mut frame) = floor();
    let black = scene.diffuse(0.0);
    let light = scene.shape(black, Some([3.0; 3]));
    let (center, r) = ([0.0, 2.0, 3.0f32], 0.7f32);
    scene.sphere(light, center, r, false);
    // in the way, darker than the floor and lighting nothing: it faces the camera
    let dim = scene.shape(black, Some([1e-3; 3]));
    scene.quad(dim, [-0.1, 1.4, 1.5], [0.0, 0.1, 0.1], [0.2, 0.0, 0.0]);
    let irradiance = PI * 3.0 * (f64::from(r) / 2.0).powi(2);
    assert!((mean_of(&scene, &frame, 16) / 1e-3 - 1.0).abs() < 1e-5, "seen when it is not hidden");
    frame.hide_emitters = true;
    let found = mean_of(&scene, &frame, 2048);
    assert!((found / (0.5 / PI * irradiance) - 1.0).abs() < 0.004, "{found}");
    // the sky: hidden from the camera, not from a mirror
    let up = super::brute::frame([0.0; 3], 20.0, [4, 4], 3);
    let hidden = crate::frame::Frame { hide_emitters: true, ..up.clone() };
    let mut scene = Scene { environment: Some([2.0; 3]), ..Scene::default() };
    assert_eq!((mean_of(&scene, &up, 4), mean_of(&scene, &hidden, 4)), (2.0, 0.0));
    let mirror = scene.material(Bsdf::Conductor { eta: [0.0; 3], k: [1.0; 3], specular: [1.0; 3] }, true);
    let shape = scene.shape(mirror, None);
    scene.quad(shape, [-9.0, -9.0, 4.0], [0.0, 18.0, 0.0], [18.0, 0.0, 0.0]);
    let found = mean_of(&scene, &hidden, 4);
    assert!((found - 2.0).abs() < 1e-5, "{found}");
}

/// A convex metal body under an even sky: a mirror shows the sky times its reflectance, a rough one less by its microfacets' shadows.
#[test]
fn metal_under_the_sky() {
    for distribution in [None, Some(Distribution::Beckmann), Some(Distribution::Ggx)] {
        let mut scene = Scene { environment: Some([1.0; 3]), ..Scene::default() };
        let (eta, k, specular) = ([0.0; 3], [1.0; 3], [0.8; 3]);
        let bsdf = match distribution {
            None => Bsdf::Conductor { eta, k, specular },
            Some(distribution) => Bsdf::RoughConductor { distribution, alpha: [0.05, 0.1], eta, k, specular },
        };
        let material = scene.material(bsdf, false);
        let shape = scene.shape(material, None);
        scene.sphere(shape, [0.0, 0.0, 5.0], 1.0, false);
        let found = mean_of(&scene, &frame([0.0; 3], 5.0, [4, 4], 3), 256);
        println!("{distribution:?}: {found}");
        // GGX keeps 0.99275 of perpendicular light at this roughness (4 million normals, a separate program); Beckmann all but 1e-4
        let expected = if distribution == Some(Distribution::Ggx) { 0.8 * 0.99275 } else { 0.8 };
        assert!((found / expected - 1.0).abs() < 0.002, "{distribution:?}: {found} {expected}");
    }
}

/// Where camera rays, as they travel, pass the film: about the pixel's centre, distributed as the filter.
#[test]
fn camera_rays_follow_the_filter() {
    use crate::filter::Filter;
    use crate::path::camera_ray;
    for filter in [Filter::Box, Filter::Tent { radius: 1.0 }, Filter::Gaussian { stddev: 0.5 }] {
        let size = [250, 250];
        let mut frame = frame([1.0, 2.0, 3.0], 60.0, size, 1);
        frame.filter = filter;
        // x of the film from the direction: corner + x right + y down, z of which is 1
        let half = libm::tan(30.0f64.to_radians());
        let (bins, reach) = (12, 1.5);
        let mut counts = vec![0.0; bins * bins];
        let n = size[0] * size[1];
        for pixel in 0..n {
            let d = camera_ray(&frame, pixel, 3).dir.decode().map(f64::from);
            let film = |c: f64| 125.0 * (1.0 - c / d[2] / half);
            let offset = [film(d[0]) - f64::from(pixel % 250) - 0.5, film(d[1]) - f64::from(pixel / 250) - 0.5];
            let bin = offset.map(|o| ((o + reach) / (2.0 * reach) * bins as f64).floor());
            if bin.iter().all(|b| (0.0..bins as f64).contains(b)) {
                counts[bin[1] as usize * bins + bin[0] as usize] += 1.0;
            }
        }
        let width = 2.0 * reach / bins as f64;
        let share = |b: usize| {
            let midpoint = |k: usize| -reach + width * (b as f64 + (k as f64 + 0.5) / 64.0);
            (0..64).map(|k| filter.density(midpoint(k))).sum::<f64>() * width / 64.0
        };
        let expected: Vec<f64> = (0..bins * bins).map(|i| f64::from(n) * share(i / bins) * share(i % bins)).collect();
        crate::testing::chi_square(&counts, &expected);
    }
}
