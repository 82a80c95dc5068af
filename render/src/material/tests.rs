use glam::Vec3;

use super::*;
use crate::math::UnitDir;
use crate::testing::{Rng, chi_square, integrate_bins, sphere_bin};

const GOLD: ([f32; 3], [f32; 3]) = ([0.143, 0.375, 1.442], [3.983, 2.386, 1.603]);

fn rough(distribution: Distribution, alpha: [f32; 2]) -> Bsdf {
    // perfectly reflecting: what is lost is lost by the microfacets
    Bsdf::RoughConductor { distribution, alpha, eta: [0.0; 3], k: [1.0; 3], specular: [1.0; 3] }
}

fn all() -> Vec<Bsdf> {
    let mut out = vec![Bsdf::Diffuse { reflectance: [0.8, 0.5, 0.2] }];
    for d in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [[0.2, 0.2], [0.5, 0.5], [1.0, 1.0], [0.2, 0.6]] {
            out.push(rough(d, alpha));
        }
    }
    out
}

fn local(theta: f32, phi: f32) -> Vec3 {
    Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
}

fn views() -> [Vec3; 5] {
    [local(0.0, 0.0), local(0.5, 0.3), local(1.1, 2.0), local(1.45, -2.5), local(1.55, 1.0)]
}

/// Sampled directions, after snapping, follow the density, for every model and view; with those below the horizon it integrates to 1.
#[test]
fn samples_follow_the_density() {
    let mut rng = Rng(1);
    for bsdf in all() {
        for wo in views() {
            let bins = 20;
            let n = 100_000;
            let mut counts = vec![0.0; 2 * bins * bins];
            let mut below = 0.0;
            for _ in 0..n {
                match bsdf.sample(wo, [rng.f32(), rng.f32()]) {
                    Some(wi) => {
                        let wi = Vec3::from(UnitDir::encode(wi.to_array()).decode());
                        counts[sphere_bin(wi, bins)] += 1.0;
                    }
                    None => below += 1.0,
                }
            }
            let mut expected = integrate_bins(bins, 30, |wi| f64::from(bsdf.eval(wo, wi).pdf));
            let sum: f64 = expected.iter().sum();
            let missing = 1.0 - below / f64::from(n) - sum;
            assert!(missing.abs() < 0.006, "{bsdf:?} {wo}: density integrates to {sum}, {below} below");
            // narrow peaks are beyond the quadrature
            if sum + below / f64::from(n) > 0.9995 {
                expected.iter_mut().for_each(|e| *e *= f64::from(n));
                chi_square(&counts, &expected);
            }
        }
    }
}

/// No more comes out than goes in, whatever the view; diffuse gives back its albedo.
#[test]
fn energy_is_not_made() {
    for bsdf in all() {
        for wo in views() {
            let albedo: f64 = integrate_bins(20, 20, |wi| f64::from(bsdf.eval(wo, wi).value.x)).iter().sum();
            match bsdf {
                Bsdf::Diffuse { reflectance } => assert!((albedo - f64::from(reflectance[0])).abs() < 1e-3),
                _ => assert!(albedo < 1.003, "{bsdf:?} {wo}: {albedo}"),
            }
        }
    }
    // by sampling, where quadrature does not reach: value / density is the weight
    let mut rng = Rng(2);
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [1e-4, 0.001, 0.01, 0.5, 1.0] {
            for wo in views() {
                let bsdf = rough(distribution, [alpha; 2]);
                let mut sum = 0.0;
                let n = 4000;
                for _ in 0..n {
                    if let Some(wi) = bsdf.sample(wo, [rng.f32(), rng.f32()]) {
                        let s = bsdf.eval(wo, wi);
                        if s.pdf > 0.0 {
                            let weight = f64::from(s.value.x / s.pdf);
                            assert!((0.0..=1.0 + 1e-5).contains(&weight), "{weight}");
                            sum += weight;
                        }
                    }
                }
                let albedo = sum / f64::from(n);
                assert!(albedo <= 1.0 + 1e-6 && albedo > 0.3, "{distribution:?} {alpha} {wo}: {albedo}");
                // almost a mirror: all comes back
                if alpha <= 0.001 && wo.z > 0.1 {
                    assert!(albedo > 0.99, "{distribution:?} {alpha} {wo}: {albedo}");
                }
            }
        }
    }
}

/// f(wo, wi) = f(wi, wo).
#[test]
fn directions_may_be_exchanged() {
    let mut rng = Rng(3);
    for bsdf in all() {
        for _ in 0..2000 {
            let mut up = || {
                let d = rng.direction();
                Vec3::new(d.x, d.y, d.z.abs().max(1e-3)).normalize()
            };
            let (a, b) = (up(), up());
            let (ab, ba) = (bsdf.eval(a, b).value.x / b.z, bsdf.eval(b, a).value.x / a.z);
            assert!((ab - ba).abs() <= 1e-3 * ab.max(ba) + 1e-12, "{bsdf:?} {a} {b}: {ab} {ba}");
        }
    }
}

/// Against values computed with complex numbers (the definition), and the ends: perpendicular, grazing.
#[test]
fn fresnel_is_the_definition() {
    let (eta, k) = GOLD;
    for i in 0..=50 {
        let cos = i as f32 / 50.0;
        let found = conductor::fresnel(cos, &eta, &k, &[1.0; 3]);
        for c in 0..3 {
            let expected = complex_fresnel(f64::from(cos), f64::from(eta[c]), f64::from(k[c]));
            assert!((f64::from(found[c]) - expected).abs() < 2e-6, "{cos} {c}: {} {expected}", found[c]);
        }
    }
    let n0 = conductor::fresnel(1.0, &eta, &k, &[1.0, 0.5, 0.0]);
    let straight = |e: f32, k: f32| ((e - 1.0).powi(2) + k * k) / ((e + 1.0).powi(2) + k * k);
    assert!((n0.x - straight(eta[0], k[0])).abs() < 1e-6);
    assert!((n0.y - 0.5 * straight(eta[1], k[1])).abs() < 1e-6);
    assert_eq!(n0.z, 0.0);
    assert_eq!(conductor::fresnel(0.0, &eta, &k, &[1.0; 3]), Vec3::ONE);
    // Mitsuba's "none": reflects all
    assert_eq!(conductor::fresnel(0.7, &[0.0; 3], &[1.0; 3], &[1.0; 3]), Vec3::ONE);
}

/// |r_s|^2 and |r_p|^2 by complex arithmetic.
fn complex_fresnel(cos: f64, eta: f64, k: f64) -> f64 {
    let mul = |a: (f64, f64), b: (f64, f64)| (a.0 * b.0 - a.1 * b.1, a.0 * b.1 + a.1 * b.0);
    let sqrt = |a: (f64, f64)| {
        let r = (a.0 * a.0 + a.1 * a.1).sqrt();
        (((r + a.0) / 2.0).max(0.0).sqrt(), ((r - a.0) / 2.0).max(0.0).sqrt().copysign(a.1))
    };
    let norm = |a: (f64, f64)| a.0 * a.0 + a.1 * a.1;
    let n = (eta, k);
    let n2 = mul(n, n);
    // n cos(t) = sqrt(n^2 - sin^2)
    let root = sqrt((n2.0 - (1.0 - cos * cos), n2.1));
    let s = norm((cos - root.0, -root.1)) / norm((cos + root.0, root.1));
    let c = (n2.0 * cos, n2.1 * cos);
    let p = norm((c.0 - root.0, c.1 - root.1)) / norm((c.0 + root.0, c.1 + root.1));
    0.5 * (s + p)
}

/// Extremes of roughness, angle and numbers: no NaN, nothing negative, nothing infinite.
#[test]
fn extremes_are_finite() {
    let mut rng = Rng(4);
    let (eta, k) = GOLD;
    let ends = [0.0, 5.96e-8, 0.5, 1.0 - 5.97e-8];
    for i in 0..100_000 {
        let alpha = |rng: &mut Rng| [1e-5, 1e-4, 1e-3, 0.03, 0.5, 1.0][(rng.u32() % 6) as usize];
        let bsdf = match i % 4 {
            0 => Bsdf::Diffuse { reflectance: [1.0; 3] },
            1 => Bsdf::Conductor { eta, k, specular: [1.0; 3] },
            j => Bsdf::RoughConductor {
                distribution: if j == 2 { Distribution::Beckmann } else { Distribution::Ggx },
                alpha: [alpha(&mut rng), alpha(&mut rng)],
                eta,
                k,
                specular: [1.0; 3],
            },
        };
        let d = rng.direction();
        let flat = [1.0, 1e-2, 1e-6, 1e-20, 0.0][(rng.u32() % 5) as usize];
        let wo = Vec3::new(d.x, d.y, d.z.abs() * flat).normalize();
        let mut number = || if rng.u32() & 1 == 0 { rng.f32() } else { ends[(rng.u32() % 4) as usize] };
        let u = [number(), number()];
        let good = |x: f32| x >= 0.0 && x.is_finite();
        if let Some(wi) = bsdf.sample(wo, u) {
            assert!((wi.length() - 1.0).abs() < 1e-4 && wi.z > 0.0, "{bsdf:?} {wo} {u:?}: {wi}");
            let s = bsdf.eval(wo, wi);
            assert!(good(s.pdf) && good(s.value.x) && good(s.value.y), "{bsdf:?} {wo} {wi}: {s:?}");
        }
        let w = bsdf.delta_weight(wo);
        assert!(good(w.x) && w.x <= 1.0);
        let other = rng.direction();
        let s = bsdf.eval(wo, other);
        assert!(good(s.pdf) && good(s.value.x), "{bsdf:?} {wo} {other}: {s:?}");
        if other.z <= 0.0 {
            assert_eq!(s, Scatter::NONE);
        }
    }
}

#[test]
fn a_mirror_reflects() {
    let (eta, k) = GOLD;
    let mirror = Bsdf::Conductor { eta, k, specular: [1.0; 3] };
    let wo = local(0.6, 0.4);
    assert_eq!(mirror.sample(wo, [0.3, 0.7]), Some(Vec3::new(-wo.x, -wo.y, wo.z)));
    assert!(mirror.is_delta() && mirror.eval(wo, Vec3::new(-wo.x, -wo.y, wo.z)) == Scatter::NONE);
    assert_eq!(mirror.delta_weight(wo), conductor::fresnel(wo.z, &eta, &k, &[1.0; 3]));
    assert_eq!(Bsdf::Diffuse { reflectance: [1.0; 3] }.delta_weight(wo), Vec3::ZERO);
}
