use glam::DVec3;

use super::*;
use crate::math::UnitDir;
use crate::testing::{Rng, chi_square};

/// A map with bright spots, dark patches, and columns of no light; on the left it is nearly even, so that there are cells of both kinds.
fn map(width: u32, height: u32, seed: u64) -> SkyMap {
    let mut rng = Rng(seed);
    let even = |x: u32| width > 16 && x < width / 2;
    let mut texel =
        |x: u32| std::array::from_fn(|_| if even(x) { 0.5 + rng.f32() * 0.2 } else { rng.f32().powi(4) * 3.0 });
    let mut texels: Vec<[f32; 3]> = (0..width * height).map(|i| texel(i % width)).collect();
    let at = rng.u32() as usize % texels.len();
    texels[at] = [90.0, 80.0, 70.0];
    if width > 4 {
        for row in texels.chunks_exact_mut(width as usize) {
            row[width as usize / 2..][..2].fill([0.0; 3]);
        }
    }
    SkyMap::new(width, height, texels).unwrap()
}

/// The plain twin in f64: where a direction lies, by acos and atan2 (column, row, fractions).
fn locate(map: &SkyMap, d: DVec3) -> (usize, usize, f64, f64) {
    let [w, h] = map.size().map(|n| n as usize);
    let u = d.x.atan2(-d.z) / (2.0 * std::f64::consts::PI);
    let v = d.y.clamp(-1.0, 1.0).acos() / std::f64::consts::PI;
    let x = (u * w as f64 - 0.5).rem_euclid(w as f64);
    let y = v * (h - 1) as f64;
    let (i, j) = ((x as usize).min(w - 1), (y as usize).min(h - 2));
    (i, j, x - i as f64, y - j as f64)
}

fn texel(map: &SkyMap, x: usize, y: usize) -> DVec3 {
    let w = map.size()[0] as usize;
    map.texels.get(y * w + x % w).as_dvec3()
}

/// The plain twin of the look-up.
fn radiance(map: &SkyMap, d: DVec3) -> DVec3 {
    let (x, y, fx, fy) = locate(map, d);
    let row = |y| texel(map, x, y).lerp(texel(map, x + 1, y), fx);
    row(y).lerp(row(y + 1), fy)
}

/// The plain twin of the choice: each patch's light, and the part of samples that it gets, by column in rows. Light goes by corners
/// and solid angle; in a cell of 8 x 8 where it hardly differs, samples go by solid angle.
fn shares(map: &SkyMap) -> (Vec<f64>, Vec<f64>) {
    let [w, h] = map.size().map(|n| n as usize);
    let theta = |y: usize| std::f64::consts::PI * y as f64 / (h - 1) as f64;
    let solid = |y: usize| theta(y).cos() - theta(y + 1).cos();
    let light = |c: DVec3| 0.2126 * c.x + 0.7152 * c.y + 0.0722 * c.z;
    let patch = |x: usize, y: usize| {
        let corners = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
        corners.iter().map(|&(x, y)| light(texel(map, x, y))).sum::<f64>()
    };
    let patches =
        |x0: usize, y0: usize| (y0..(y0 + 8).min(h - 1)).flat_map(move |y| (x0..(x0 + 8).min(w)).map(move |x| (x, y)));
    let mut weights = vec![0.0; w * (h - 1)];
    let mut chosen = weights.clone();
    for (x0, y0) in (0..h - 1).step_by(8).flat_map(|y| (0..w).step_by(8).map(move |x| (x, y))) {
        let area: f64 = patches(x0, y0).map(|(_, y)| solid(y)).sum();
        let [sum, squares] = [1, 2].map(|n| patches(x0, y0).map(|(x, y)| patch(x, y).powi(n) * solid(y)).sum::<f64>());
        let even = squares * area <= (1.0 + 1.0 / 16.0) * sum * sum;
        for (x, y) in patches(x0, y0) {
            weights[y * w + x] = patch(x, y) * solid(y);
            chosen[y * w + x] = if even { sum * solid(y) / area } else { weights[y * w + x] };
        }
    }
    let total: f64 = weights.iter().sum();
    let parts = |v: Vec<f64>| v.iter().map(|s| s / total).collect();
    (parts(weights), parts(chosen))
}

/// Mitsuba 3.9.1's `envmap` on an 8 x 4 map whose texel in column x of row y is (1 + x, 1 + y, (3x + 5y) mod 7): what its `eval` returned.
#[test]
fn radiance_is_mitsubas() {
    let texels = (0..32).map(|i| (i % 8, i / 8)).map(|(x, y)| [1 + x, 1 + y, (3 * x + 5 * y) % 7]);
    let map = SkyMap::new(8, 4, texels.map(|t| t.map(|v| v as f32)).collect()).unwrap();
    for (d, expected) in MITSUBA {
        let found = map.radiance(Vec3::from(*d).normalize());
        assert!(found.abs_diff_eq(Vec3::from(*expected), 2e-5), "{d:?}: {found:?} {expected:?}");
    }
}

/// Direction (to be brought to unit length) and radiance.
const MITSUBA: &[([f32; 3], [f32; 3])] = &[
    ([1.0, 2.0, 3.0], [4.090335, 1.961474, 0.348056]),
    ([-1.0, 0.5, 0.25], [6.188084, 2.068722, 5.110222]),
    ([0.1, -1.0, 0.2], [3.909666, 3.789927, 3.149143]),
    ([0.01, 1.0, -0.02], [1.090334, 1.02135, 0.364253]),
    ([1.0, 0.0, 0.0], [2.5, 2.5, 3.25]),
    ([0.0, 0.0, 1.0], [4.5, 2.5, 2.25]),
    ([0.0, 0.0, -1.0], [4.5, 2.5, 4.0]),
    ([-3.0, -2.0, 1.0], [6.090335, 3.038525, 3.585971]),
    ([0.2, 0.1, -1.0], [2.740676, 2.40666, 4.18668]),
    ([-0.2, 0.1, -1.0], [6.259319, 2.40666, 4.18668]),
    ([2.0, -5.0, -1.0], [1.909666, 3.598419, 4.532158]),
];

#[test]
fn look_up_is_its_twin() {
    let mut rng = Rng(2);
    for (w, h) in [(1, 2), (2, 3), (7, 5), (64, 33), (1000, 501)] {
        let map = map(w, h, u64::from(w));
        let mut bright = f64::from(map.texels.iter().flatten().fold(0.0f32, f32::max));
        bright *= f64::from(w) * 1e-6 + 1e-5; // an error of f32 in the place, times the steepest slope
        for _ in 0..20_000 {
            let d = rng.direction();
            let expected = radiance(&map, d.as_dvec3().normalize());
            let found = map.radiance(d).as_dvec3();
            assert!((found - expected).abs().max_element() <= bright, "{w} x {h}: {found} {expected}");
        }
    }
}

/// Chi-square of what is sampled, snapped, over the patches, with shares from the twin.
#[test]
fn samples_follow_the_shares() {
    let mut rng = Rng(3);
    for (w, h) in [(1, 2), (4, 3), (16, 9), (33, 20), (41, 18)] {
        let map = map(w, h, 7 + u64::from(w));
        let n = 400_000;
        let mut counts = vec![0.0; (w * (h - 1)) as usize];
        for _ in 0..n {
            let d = map.sample([rng.u32(), rng.u32()]);
            assert!((d.length() - 1.0).abs() < 1e-6);
            let d = Vec3::from(UnitDir::encode(d.to_array()).decode());
            let (x, y, ..) = locate(&map, d.as_dvec3());
            counts[y * w as usize + x] += 1.0;
        }
        let expected: Vec<f64> = shares(&map).1.iter().map(|s| s * f64::from(n)).collect();
        if counts.len() > 2 {
            chi_square(&counts, &expected);
        }
        for (count, expected) in counts.iter().zip(&expected) {
            assert!(*expected > 0.0 || *count <= 2.0, "{count} samples where there is no light");
        }
    }
}

/// Within a patch samples are even by solid angle: chi-square over 8 x 8 parts of one bright patch.
#[test]
fn samples_are_even_in_a_patch() {
    let mut texels = vec![[0.0; 3]; 6 * 5];
    for at in [7, 8, 13, 14] {
        texels[at] = [1.0; 3];
    }
    let map = SkyMap::new(6, 5, texels).unwrap();
    let mut rng = Rng(5);
    let (mut counts, mut inside) = (vec![0.0; 64], 0.0);
    for _ in 0..400_000 {
        let d = map.sample([rng.u32(), rng.u32()]).as_dvec3();
        let (x, y, fx, _) = locate(&map, d);
        if (x, y) != (1, 1) {
            continue;
        }
        let cos = |y: f64| (std::f64::consts::PI * y / 4.0).cos();
        let down = (cos(1.0) - d.y) / (cos(1.0) - cos(2.0));
        let part = |f: f64| ((f * 8.0) as usize).min(7);
        counts[part(down) * 8 + part(fx)] += 1.0;
        inside += 1.0;
    }
    assert!(inside > 50_000.0, "{inside}");
    chi_square(&counts, &[inside / 64.0; 64]);
}

/// The density integrates to 1, and is the share over the solid angle of the patch, whichever way it is asked.
#[test]
fn density_is_exact() {
    for (w, h) in [(1, 2), (4, 3), (16, 9), (200, 101)] {
        let map = map(w, h, u64::from(h));
        let theta = |y: f64| std::f64::consts::PI * y / f64::from(h - 1);
        let (mut sum, mut alike, (light, shares)) = (0.0, 0, shares(&map));
        for y in 0..h - 1 {
            for x in 0..w {
                let turn = 2.0 * std::f64::consts::PI * (f64::from(x) + 1.0) / f64::from(w);
                let middle = theta(f64::from(y) + 0.5);
                let d = DVec3::new(middle.sin() * turn.sin(), middle.cos(), -middle.sin() * turn.cos());
                let pdf = f64::from(map.pdf(d.as_vec3()));
                let solid = 2.0 * std::f64::consts::PI / f64::from(w)
                    * (theta(f64::from(y)).cos() - theta(f64::from(y) + 1.0).cos());
                sum += pdf * solid;
                let share = shares[(y * w + x) as usize];
                assert!((pdf * solid - share).abs() < 1e-6 * share + 2e-9, "{x} {y}: {} {share}", pdf * solid);
                assert_eq!(pdf == 0.0, share == 0.0);
                assert!(light[(y * w + x) as usize] == 0.0 || pdf > 0.0);
                alike += u32::from(light[(y * w + x) as usize] != share);
            }
        }
        assert!(w <= 16 || alike > w * h / 4 && alike < w * h * 3 / 4, "{alike} patches of even cells");
        assert!((sum - 1.0).abs() < 1e-6, "{sum}");
    }
}

/// The mean radiance is the integral over the sphere: by sampling with the density, over 4 pi.
#[test]
fn the_mean_is_the_integral() {
    let map = map(64, 33, 9);
    let (mut rng, mut sum) = (Rng(8), DVec3::ZERO);
    let n = 400_000;
    for _ in 0..n {
        let (radiance, pdf) = map.look_up(map.sample([rng.u32(), rng.u32()]));
        if pdf > 0.0 {
            sum += radiance.as_dvec3() / f64::from(pdf);
        }
    }
    let found = sum / f64::from(n) / (4.0 * std::f64::consts::PI);
    let mean = map.mean().as_dvec3();
    assert!(((found - mean) / mean).abs().max_element() < 0.01, "{found} {mean}");
}

/// A map of one colour is a constant sky: its density is even to rounding, which is no special case.
#[test]
fn one_colour_is_even() {
    let map = SkyMap::new(32, 17, vec![[0.5, 0.25, 1.0]; 32 * 17]).unwrap();
    let mut rng = Rng(4);
    for _ in 0..10_000 {
        let (radiance, pdf) = map.look_up(rng.direction());
        assert!((radiance - Vec3::new(0.5, 0.25, 1.0)).abs().max_element() < 1e-6);
        assert!((pdf * 4.0 * PI - 1.0).abs() < 1e-5, "{pdf}");
    }
}

#[test]
fn poles_and_seams_have_a_place() {
    let map = map(16, 9, 11);
    let mut directions = vec![];
    for x in [-1.0f32, -0.0, 0.0, 1.0] {
        for y in [-1.0f32, -0.0, 0.0, 1.0] {
            for z in [-1.0f32, -0.0, 0.0, 1.0, 1e-30, -1e-30] {
                directions.push(Vec3::new(x, y, z).normalize_or(Vec3::Y));
            }
        }
    }
    for d in directions {
        let (radiance, pdf) = map.look_up(d);
        assert!(radiance.is_finite() && radiance.min_element() >= 0.0 && pdf >= 0.0 && pdf.is_finite(), "{d}");
    }
    for u in [0, 1, u32::MAX - 1, u32::MAX] {
        for v in [0, 1, u32::MAX - 1, u32::MAX] {
            let d = map.sample([u, v]);
            assert!((d.length() - 1.0).abs() < 1e-5 && map.look_up(d).1 >= 0.0);
        }
    }
}

#[test]
fn bytes_come_back_and_bad_ones_do_not() {
    let map = map(9, 5, 1);
    let bytes = map.encode();
    assert_eq!(SkyMap::decode(&bytes), Ok(map));
    for length in [0, 7, 15, 16, bytes.len() - 1] {
        assert_eq!(SkyMap::decode(&bytes[..length]), Err(SkyMapError::Format));
    }
    let mut other = bytes.clone();
    other[7] = 9;
    assert_eq!(SkyMap::decode(&other), Err(SkyMapError::Format));
    let mut huge = bytes.clone();
    huge[8..16].fill(0xff);
    assert_eq!(SkyMap::decode(&huge), Err(SkyMapError::Format));
    for (value, what) in [(f32::NAN, "NaN or infinity"), (f32::INFINITY, "NaN or infinity"), (-1.0, "a negative value")]
    {
        let mut bad = bytes.clone();
        bad[HEAD + 12 * 11 + 4..][..4].copy_from_slice(&value.to_le_bytes());
        assert_eq!(SkyMap::decode(&bad), Err(SkyMapError::Value { what, x: 2, y: 1 }));
    }
    assert!(matches!(SkyMap::new(3, 1, vec![[0.0; 3]; 3]), Err(SkyMapError::Size(3, 1))));
    assert!(!SkyMap::new(3, 2, vec![[0.0; 3]; 6]).unwrap().shines());
}
