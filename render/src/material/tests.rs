use glam::Vec3;

use super::*;
use crate::math::UnitDir;
use crate::testing::{Rng, chi_square, integrate_bins, sphere_bin};

const GOLD: ([f32; 3], [f32; 3]) = ([0.143, 0.375, 1.442], [3.983, 2.386, 1.603]);

fn rough(distribution: Distribution, alpha: [f32; 2]) -> Bsdf {
    // perfectly reflecting: what is lost is lost by the microfacets
    Bsdf::RoughConductor { distribution, alpha, eta: [0.0; 3], k: [1.0; 3], specular: [1.0; 3] }
}

fn glass(distribution: Distribution, alpha: [f32; 2], eta: f32) -> Bsdf {
    Bsdf::RoughDielectric { distribution, alpha, eta, reflect: [1.0; 3], transmit: [1.0; 3] }
}

fn rough_plastic(distribution: Distribution, alpha: f32, eta: f32, diffuse: f32, nonlinear: bool) -> Bsdf {
    let coat = Transmittance::new(distribution, alpha, eta);
    let (diffuse, specular) = ([diffuse; 3], [1.0; 3]);
    Bsdf::RoughPlastic { distribution, alpha, eta, diffuse, specular, nonlinear, coat }
}

fn clear_plastic(eta: f32, diffuse: f32, nonlinear: bool) -> Bsdf {
    Bsdf::Plastic { eta, diffuse: [diffuse; 3], specular: [1.0; 3], nonlinear }
}

/// Each with the side that it is seen from.
fn all() -> Vec<(Bsdf, bool)> {
    let mut out = vec![
        (Bsdf::Diffuse { reflectance: [0.8, 0.5, 0.2] }, true),
        (clear_plastic(1.5, 0.6, false), true),
        (clear_plastic(1.8, 0.9, true), true),
        (Bsdf::Dielectric { eta: 1.5, reflect: [1.0; 3], transmit: [1.0; 3] }, false),
    ];
    for d in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [[0.2, 0.2], [0.5, 0.5], [1.0, 1.0], [0.2, 0.6]] {
            out.push((rough(d, alpha), true));
        }
        for alpha in [[0.6, 0.6], [1.0, 1.0], [0.5, 0.8]] {
            for eta in [1.5, 2.2] {
                out.push((glass(d, alpha, eta), true));
                out.push((glass(d, alpha, eta), false));
            }
        }
        for (alpha, eta, diffuse, nonlinear) in [(0.1, 1.5, 0.5, false), (0.4, 1.3, 1.0, true), (1.0, 1.9, 0.2, false)]
        {
            out.push((rough_plastic(d, alpha, eta, diffuse, nonlinear), true));
        }
    }
    out
}

/// What radiance is multiplied by when it leaves for `wi`, so that energy counts.
fn crossing(bsdf: &Bsdf, front: bool, wi: Vec3) -> f32 {
    match bsdf {
        Bsdf::Dielectric { eta, .. } | Bsdf::RoughDielectric { eta, .. } if wi.z < 0.0 => relative(*eta, front).powi(2),
        _ => 1.0,
    }
}

fn local(theta: f32, phi: f32) -> Vec3 {
    Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
}

fn views() -> [Vec3; 5] {
    [local(0.0, 0.0), local(0.5, 0.3), local(1.1, 2.0), local(1.45, -2.5), local(1.55, 1.0)]
}

/// Sampled directions, after snapping, follow the density, for every model and view; with single directions, and those on the wrong side, it integrates
/// to 1.
#[test]
fn samples_follow_the_density() {
    let mut rng = Rng(1);
    for (bsdf, front) in all() {
        for wo in views() {
            let bins = 20;
            let n = 100_000;
            let mut counts = vec![0.0; 2 * bins * bins];
            let mut elsewhere = 0.0;
            for _ in 0..n {
                match bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()) {
                    Some(Sampled { wi, delta: None }) => {
                        let wi = Vec3::from(UnitDir::encode(wi.to_array()).decode());
                        counts[sphere_bin(wi, bins)] += 1.0;
                    }
                    _ => elsewhere += 1.0,
                }
            }
            // refraction narrows a lobe
            let midpoints = if bsdf.transmits() { 45 } else { 30 };
            let mut expected = integrate_bins(bins, midpoints, |wi| f64::from(bsdf.eval(wo, wi, front).pdf));
            let sum: f64 = expected.iter().sum();
            let missing = 1.0 - elsewhere / f64::from(n) - sum;
            assert!(missing.abs() < 0.01, "{bsdf:?} {front} {wo}: density integrates to {sum}, {elsewhere} elsewhere");
            // narrow peaks are beyond the quadrature
            if missing.abs() < 5e-4 && sum > 0.1 {
                expected.iter_mut().for_each(|e| *e *= f64::from(n));
                chi_square(&counts, &expected);
            }
        }
    }
}

/// No more comes out than goes in, whatever the view; diffuse gives back its albedo.
#[test]
fn energy_is_not_made() {
    for (bsdf, front) in all() {
        for wo in views() {
            let albedo = |wi| f64::from(bsdf.eval(wo, wi, front).value.x * crossing(&bsdf, front, wi));
            let albedo: f64 = integrate_bins(20, 20, albedo).iter().sum();
            match bsdf {
                Bsdf::Diffuse { reflectance } => assert!((albedo - f64::from(reflectance[0])).abs() < 1e-3),
                _ => assert!(albedo < 1.006, "{bsdf:?} {front} {wo}: {albedo}"),
            }
        }
    }
    // by sampling, where quadrature does not reach: value / density is the weight
    let mut rng = Rng(2);
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [1e-4, 0.001, 0.01, 0.5, 1.0] {
            for (bsdf, front) in [
                (rough(distribution, [alpha; 2]), true),
                (glass(distribution, [alpha; 2], 1.5), true),
                (glass(distribution, [alpha; 2], 1.5), false),
            ] {
                for wo in views() {
                    let mut sum = 0.0;
                    let n = 4000;
                    for _ in 0..n {
                        let u = [rng.f32(), rng.f32()];
                        if let Some(Sampled { wi, .. }) = bsdf.sample(wo, front, u, rng.f32()) {
                            let s = bsdf.eval(wo, wi, front);
                            if s.pdf > 0.0 {
                                let weight = f64::from(s.value.x / s.pdf * crossing(&bsdf, front, wi));
                                assert!((0.0..=1.0 + 1e-5).contains(&weight), "{weight}");
                                sum += weight;
                            }
                        }
                    }
                    let albedo = sum / f64::from(n);
                    assert!(albedo <= 1.0 + 1e-6 && albedo > 0.3, "{bsdf:?} {front} {wo}: {albedo}");
                    // almost smooth: all comes back
                    if alpha <= 0.001 && wo.z > 0.1 {
                        assert!(albedo > 0.99, "{bsdf:?} {front} {wo}: {albedo}");
                    }
                }
            }
        }
    }
}

/// Single directions carry energy too: a smooth interface and a pane give back all, a plastic of albedo 1 not more.
#[test]
fn smooth_interfaces_keep_energy() {
    let mut rng = Rng(5);
    let white = [1.0; 3];
    for eta in [1.5, 1.1, 2.4, 0.8, 1.0] {
        for (bsdf, exact) in [
            (Bsdf::Dielectric { eta, reflect: white, transmit: white }, true),
            (Bsdf::ThinDielectric { eta, reflect: white, transmit: white }, true),
            (clear_plastic(eta, 1.0, true), false),
        ] {
            for front in [true, false] {
                for wo in views() {
                    let n = 2000;
                    let mut sum = 0.0;
                    for _ in 0..n {
                        let Some(s) = bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()) else { continue };
                        sum += f64::from(match s.delta {
                            Some(w) => w.x * crossing(&bsdf, front, s.wi),
                            None => {
                                let e = bsdf.eval(wo, s.wi, front);
                                e.value.x / e.pdf
                            }
                        });
                    }
                    let albedo = sum / f64::from(n);
                    if exact {
                        assert!((albedo - 1.0).abs() < 1e-5, "{bsdf:?} {front} {wo}: {albedo}");
                    } else {
                        assert!(albedo < 1.03 && albedo > 0.5, "{bsdf:?} {wo}: {albedo}");
                    }
                }
            }
        }
    }
}

/// Snell's law, and Fresnel's equations against the form with both angles (Born and Wolf, 1.5.2, equations 32 to 34), in f64.
#[test]
fn refraction_is_the_definition() {
    for eta in [1.5f32, 1.333, 2.419, 1.0 / 1.5, 0.9] {
        for i in 1..100 {
            let angle = f64::from(i) / 100.0 * std::f64::consts::FRAC_PI_2;
            let (r, cos_t) = dielectric::fresnel(angle.cos() as f32, eta);
            let sin_t = angle.sin() / f64::from(eta);
            if sin_t >= 1.0 {
                assert_eq!((r, cos_t), (1.0, 0.0));
                continue;
            }
            let t = sin_t.asin();
            let s = (angle - t).sin() / (angle + t).sin();
            let p = (angle - t).tan() / (angle + t).tan();
            let expected = 0.5 * (s * s + p * p);
            assert!((f64::from(r) - expected).abs() < 3e-6, "{eta} {angle}: {r} {expected}");
            let glass = Bsdf::Dielectric { eta, reflect: [1.0; 3], transmit: [1.0; 3] };
            let wo = local(angle as f32, 0.7);
            let wi = glass.sample(wo, true, [0.5; 2], 1.0 - f32::EPSILON).unwrap().wi;
            let sin = f64::from(wi.x).hypot(f64::from(wi.y));
            assert!((sin - sin_t).abs() < 1e-6 && wi.z < 0.0, "{eta} {angle}: {wi}");
            assert!((wi.x * wo.y - wi.y * wo.x).abs() < 1e-6, "in the plane of incidence");
        }
    }
}

/// f(wo, wi) = f(wi, wo); across an interface f(wo, wi) over the square of the index at `wo` (radiance shrinks as it enters).
#[test]
fn directions_may_be_exchanged() {
    let mut rng = Rng(3);
    let mut crossed = 0;
    for (bsdf, front) in all() {
        for _ in 0..2000 {
            let mut up = || {
                let d = rng.direction();
                Vec3::new(d.x, d.y, d.z.abs().max(1e-3)).normalize()
            };
            let (a, b) = (up(), up());
            let (ab, ba) = (bsdf.eval(a, b, front).value.x / b.z, bsdf.eval(b, a, front).value.x / a.z);
            assert!((ab - ba).abs() <= 1e-3 * ab.max(ba) + 1e-12, "{bsdf:?} {a} {b}: {ab} {ba}");
            if let Bsdf::RoughDielectric { eta, .. } = bsdf {
                let flip = |v: Vec3| Vec3::new(v.x, v.y, -v.z);
                let there = bsdf.eval(a, flip(b), front).value.x / b.z * relative(eta, front).powi(2);
                let back = bsdf.eval(b, flip(a), !front).value.x / a.z;
                // near the critical angle cosines, and with them small values, are mostly rounding
                assert!((there - back).abs() <= 1e-2 * there.max(back) + 1e-4, "{bsdf:?} {a} {b}: {there} {back}");
                crossed += u32::from(there > 0.0);
            }
        }
    }
    assert!(crossed > 10_000, "{crossed}");
}

/// The tables of a rough coat: as smooth as the coat is, they are Fresnel's; what is lost is little.
#[test]
fn coats_let_light_in() {
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        let smooth = rough_plastic(distribution, 0.01, 1.5, 0.5, false);
        let clear = clear_plastic(1.5, 0.5, false);
        for (wo, wi) in [(local(0.3, 0.0), local(0.5, 2.0)), (local(1.0, 1.0), local(0.8, -1.0))] {
            let (a, b) = (smooth.eval(wo, wi, true).value.x, clear.eval(wo, wi, true).value.x);
            // the coat's internal share is 1.5 % less, by definition: see `Transmittance::new`
            assert!((a / b - 1.0).abs() < 0.04, "{a} {b}");
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
        let eta_glass = [1.5, 1.0, 0.5, 1.000277, 10.0][(rng.u32() % 5) as usize];
        let white = [1.0; 3];
        let distribution = if i & 1 == 0 { Distribution::Beckmann } else { Distribution::Ggx };
        let bsdf = match i % 8 {
            0 => Bsdf::Diffuse { reflectance: [1.0; 3] },
            1 => Bsdf::Conductor { eta, k, specular: [1.0; 3] },
            2 => Bsdf::Dielectric { eta: eta_glass, reflect: white, transmit: white },
            3 => Bsdf::ThinDielectric { eta: eta_glass, reflect: white, transmit: white },
            4 | 5 => glass(distribution, [alpha(&mut rng), alpha(&mut rng)], eta_glass),
            6 => clear_plastic(eta_glass, 1.0, i & 8 == 0),
            _ => Bsdf::RoughConductor {
                distribution: if i & 8 == 0 { Distribution::Beckmann } else { Distribution::Ggx },
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
        let lobe = number();
        let front = rng.u32() & 1 == 0;
        if let Some(Sampled { wi, delta }) = bsdf.sample(wo, front, u, lobe) {
            assert!((wi.length() - 1.0).abs() < 1e-4 && wi.z != 0.0, "{bsdf:?} {wo} {u:?}: {wi}");
            assert!(wi.z > 0.0 || bsdf.transmits(), "{bsdf:?} {wo} {u:?}: {wi}");
            let s = bsdf.eval(wo, wi, front);
            assert!(good(s.pdf) && good(s.value.x) && good(s.value.y), "{bsdf:?} {wo} {wi}: {s:?}");
            assert!(delta.is_none_or(|w| good(w.x)), "{bsdf:?} {wo} {u:?}: {delta:?}");
        }
        let other = rng.direction();
        let s = bsdf.eval(wo, other, front);
        assert!(good(s.pdf) && good(s.value.x), "{bsdf:?} {wo} {other}: {s:?}");
        if other.z <= 0.0 && !bsdf.transmits() {
            assert_eq!(s, Scatter::NONE);
        }
    }
}

#[test]
fn a_mirror_reflects() {
    let (eta, k) = GOLD;
    let mirror = Bsdf::Conductor { eta, k, specular: [1.0; 3] };
    let wo = local(0.6, 0.4);
    let back = Vec3::new(-wo.x, -wo.y, wo.z);
    let weight = conductor::fresnel(wo.z, &eta, &k, &[1.0; 3]);
    assert_eq!(mirror.sample(wo, true, [0.3, 0.7], 0.5), Some(Sampled { wi: back, delta: Some(weight) }));
    assert!(mirror.is_delta() && mirror.is_mirror() && mirror.eval(wo, back, true) == Scatter::NONE);
}

/// A stored table of another length, or out of range, is refused.
#[test]
fn coats_are_checked() {
    let coat = Transmittance::new(Distribution::Ggx, 0.3, 1.5);
    let text = serde_json::to_string(&coat).unwrap();
    assert_eq!(serde_json::from_str::<Transmittance>(&text).unwrap(), coat);
    for bad in [text.replace("\"internal\":0.", "\"internal\":2."), text.replacen(",0.", ",1.5,0.", 1)] {
        assert_ne!(bad, text);
        assert!(serde_json::from_str::<Transmittance>(&bad).is_err());
    }
}

/// The fits for diffuse light inside a coat stay within what they promise of the integral.
#[test]
fn diffuse_light_inside_a_coat() {
    for (low, high, bound) in [(0.3, 1.0, 0.006), (1.001, 1.5, 0.003), (1.5, 2.0, 0.007), (2.0, 10.0, 0.003)] {
        for i in 0..=20 {
            let eta = low + (high - low) * i as f32 / 20.0;
            let n = 20_000;
            let cosine = |k: i32| (f64::from(k) + 0.5) / f64::from(n);
            let sum: f64 =
                (0..n).map(|k| f64::from(dielectric::fresnel(cosine(k) as f32, 1.0 / eta).0) * cosine(k)).sum();
            let (exact, fit) = (2.0 * sum / f64::from(n), f64::from(plastic::diffuse_reflectance_inside(eta)));
            assert!((fit - exact).abs() < bound, "{eta}: {fit} {exact}");
        }
    }
}
