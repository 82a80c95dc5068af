use glam::Vec3;

use super::*;
use crate::math::UnitDir;
use crate::testing::{Rng, chi_square, integrate_bins, sphere_bin};

const GOLD: ([f32; 3], [f32; 3]) = ([0.143, 0.375, 1.442], [3.983, 2.386, 1.603]);

pub(super) fn rough(distribution: Distribution, alpha: [f32; 2]) -> Bsdf {
    // perfectly reflecting: what is lost is lost by the microfacets
    Bsdf::RoughConductor { distribution, alpha, eta: [0.0; 3], k: [1.0; 3], specular: [1.0; 3] }
}

pub(super) fn glass(distribution: Distribution, alpha: [f32; 2], eta: f32) -> Bsdf {
    Bsdf::RoughDielectric { distribution, alpha, eta, reflect: [1.0; 3], transmit: [1.0; 3] }
}

pub(super) fn rough_plastic(distribution: Distribution, alpha: f32, eta: f32, diffuse: f32, nonlinear: bool) -> Bsdf {
    let coat = Transmittance::new(distribution, alpha, eta);
    let (diffuse, specular) = ([diffuse; 3], [1.0; 3]);
    Bsdf::RoughPlastic { distribution, alpha, eta, diffuse, specular, nonlinear, coat }
}

pub(super) fn clear_plastic(eta: f32, diffuse: f32, nonlinear: bool) -> Bsdf {
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
    for (diffuse, specular, exponent) in [(0.5, 0.2, 30.0), (0.0, 1.0, 4.0), (0.9, 0.6, 0.0), (0.3, 0.7, 100.0)] {
        out.push((Bsdf::Phong { diffuse: [diffuse; 3], specular: [specular; 3], exponent }, true));
    }
    let metal = Principled { metallic: 1.0, roughness: 0.6, anisotropic: 0.5, base_color: [1.0; 3], ..PLAIN };
    out.push((Bsdf::Principled(metal), true));
    let glass = Principled { spec_trans: 1.0, roughness: 0.8, base_color: [1.0; 3], ..PLAIN };
    out.push((Bsdf::Principled(glass), true));
    out.push((Bsdf::Principled(glass), false));
    out
}

const PLAIN: Principled = Principled {
    base_color: [0.5; 3],
    eta: 1.5,
    roughness: 0.7,
    anisotropic: 0.0,
    metallic: 0.0,
    spec_trans: 0.0,
    spec_tint: 0.0,
    sheen: 0.0,
    sheen_tint: 0.0,
    clearcoat: 0.0,
    clearcoat_gloss: 0.0,
    flatness: 0.0,
};

/// Some of everything; lobes wide enough for the quadrature.
pub(super) fn any_principled(rng: &mut Rng) -> Principled {
    let mut some = || if rng.u32() & 1 == 0 { 0.0 } else { rng.f32() };
    let [metallic, spec_trans, spec_tint, sheen, sheen_tint, clearcoat, flatness, anisotropic] = [0; 8].map(|_| some());
    Principled {
        base_color: [rng.f32(), rng.f32(), rng.f32()],
        eta: [1.5, 1.3, 2.0, 0.8][(rng.u32() % 4) as usize],
        roughness: rng.range(0.6, 1.0),
        anisotropic: 0.8 * anisotropic,
        metallic,
        spec_trans,
        spec_tint,
        sheen,
        sheen_tint,
        clearcoat,
        clearcoat_gloss: 0.0,
        flatness,
    }
}

/// Compares n sampled directions, after snapping, with the density integrated over bins; what was not sampled is what the integral lacks. Whether
/// they were compared bin by bin too: narrow peaks are beyond the quadrature.
pub(super) fn follows_density(bsdf: &Bsdf, front: bool, wo: Vec3, n: u32, midpoints: usize, rng: &mut Rng) -> bool {
    let bins = 20;
    let (mut counts, mut elsewhere) = (vec![0.0; 2 * bins * bins], 0.0);
    for _ in 0..n {
        match bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()) {
            Some(Sampled { wi, delta: None }) => {
                let wi = Vec3::from(UnitDir::encode(wi.to_array()).decode());
                counts[sphere_bin(wi, bins)] += 1.0;
            }
            _ => elsewhere += 1.0,
        }
    }
    let mut expected = integrate_bins(bins, midpoints, |wi| f64::from(bsdf.eval(wo, wi, front).pdf));
    let sum: f64 = expected.iter().sum();
    let missing = 1.0 - elsewhere / f64::from(n) - sum;
    assert!(missing.abs() < 0.01, "{bsdf:?} {front} {wo}: density integrates to {sum}, {elsewhere} elsewhere");
    // what halving the steps changes, as chi-square would see it: of hundreds of degrees of freedom 5 are nothing
    let coarse = integrate_bins(bins, midpoints / 2, |wi| f64::from(bsdf.eval(wo, wi, front).pdf));
    let changes = expected.iter().zip(&coarse).filter(|(e, _)| **e * f64::from(n) >= 5.0);
    let change: f64 = changes.map(|(e, c)| f64::from(n) * (e - c).powi(2) / e).sum();
    let is_smooth = change < 5.0 && sum > 0.1;
    if is_smooth {
        expected.iter_mut().for_each(|e| *e *= f64::from(n));
        chi_square(&counts, &expected);
    }
    is_smooth
}

/// Principled with random parameters: samples follow the density, whose integral is what is not lost; directions may be exchanged.
#[test]
fn principled_in_any_mixture() {
    let mut rng = Rng(17);
    let (mut compared, mut exchanged) = (0, 0);
    for i in 0..24 {
        let p = any_principled(&mut rng);
        let (bsdf, front) = (Bsdf::Principled(p), i % 4 != 0);
        for wo in [local(0.4, 0.3), local(1.2, 2.0)] {
            // the coat's peak is as narrow as a degree
            let midpoints = if p.clearcoat > 0.0 { 60 } else { 30 };
            compared += u32::from(follows_density(&bsdf, front, wo, 60_000, midpoints, &mut rng));
        }
        for _ in 0..500 {
            let mut up = || {
                let d = rng.direction();
                Vec3::new(d.x, d.y, d.z.abs().max(0.02)).normalize()
            };
            let (a, b) = (up(), up());
            let (ab, ba) = (bsdf.eval(a, b, front).value.x / b.z, bsdf.eval(b, a, front).value.x / a.z);
            assert!((ab - ba).abs() <= 1e-3 * ab.max(ba) + 1e-6, "{p:?} {a} {b}: {ab} {ba}");
            exchanged += u32::from(ab > 0.0);
        }
    }
    assert!(compared > 10 && exchanged > 6000, "{compared} {exchanged}");
}

/// Values that Mitsuba 3.9.1's `principled` (scalar_rgb) returned; the parameters are in the order of the fields.
#[test]
fn principled_is_mitsubas() {
    for (params, wo, wi, expected) in MITSUBA {
        let [r, g, b, eta, roughness, anisotropic, metallic, spec_trans, spec_tint, sheen, sheen_tint, ..] = *params;
        let [.., clearcoat, clearcoat_gloss, flatness] = *params;
        let p = Principled {
            base_color: [r, g, b],
            eta,
            roughness,
            anisotropic,
            metallic,
            spec_trans,
            spec_tint,
            sheen,
            sheen_tint,
            clearcoat,
            clearcoat_gloss,
            flatness,
        };
        let (wo, wi) = (Vec3::from(*wo).normalize(), Vec3::from(*wi).normalize());
        // ours has z on the side of wo
        let front = wo.z > 0.0;
        let turn = |v: Vec3| if front { v } else { -v };
        let s = Bsdf::Principled(p).eval(turn(wo), turn(wi), front);
        let [x, y, z, pdf] = *expected;
        let close = |found: f32, expected: f32| (found - expected).abs() <= 2e-3 * expected.abs() + 1e-6;
        let all = close(s.value.x, x) && close(s.value.y, y) && close(s.value.z, z) && close(s.pdf, pdf);
        assert!(all, "{p:?} {wo} {wi}: {s:?} instead of {expected:?}");
    }
}

/// Parameters, view, direction, value and density.
type PrincipledCase = ([f32; 14], [f32; 3], [f32; 3], [f32; 4]);
#[rustfmt::skip]
const MITSUBA: &[PrincipledCase] = &[
    ([0.81, 0.81, 0.52, 1.8, 0.78, 0.0, 0.39, 0.0, 0.0, 0.06, 0.56, 0.0, 0.44, 0.06], [0.83, -1.64, 0.26], [-0.83, 1.64, 0.2], [0.127277, 0.127277, 0.113703, 0.364819]),
    ([0.74, 0.5, 0.69, 0.8, 0.91, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.34, 0.41, 0.0], [0.03, -1.81, 0.42], [-0.51, 1.59, 0.79], [0.227061, 0.19733, 0.220867, 0.165391]),
    ([0.04, 0.53, 0.48, 1.8, 0.33, 0.0, 0.67, 0.19, 0.99, 0.75, 0.96, 0.29, 0.22, 0.26], [-0.06, 1.85, 2.16], [-0.52, -0.93, 2.69], [0.0158946, 0.172682, 0.156683, 0.312482]),
    ([0.19, 0.68, 0.5, 1.5, 0.47, 0.0, 0.18, 0.0, 0.0, 0.21, 0.0, 0.0, 0.0, 0.0], [1.72, 0.86, 0.33], [1.14, -0.14, 0.1], [0.00669677, 0.0231446, 0.0171025, 0.0223667]),
    ([0.32, 0.63, 0.51, 1.8, 0.39, 0.06, 0.28, 0.23, 0.0, 0.54, 0.0, 0.03, 0.08, 0.0], [1.33, 0.35, 0.64], [-1.19, -0.33, 0.46], [1.61366, 2.15336, 1.94445, 3.86225]),
    ([0.93, 0.23, 0.26, 1.8, 0.48, 0.67, 0.0, 0.65, 0.26, 0.0, 0.52, 0.07, 0.3, 0.0], [-0.33, 0.87, 1.33], [-0.17, 1.86, 0.04], [0.00276333, 0.000699879, 0.000788313, 0.00229385]),
    ([0.33, 0.58, 0.58, 1.8, 0.61, 0.31, 0.56, 0.04, 0.29, 0.0, 0.0, 0.79, 0.0, 0.0], [-0.62, 0.43, -0.2], [-0.04, -2.49, -2.7], [0.00364383, 0.00364383, 0.00364383, 0.211343]),
    ([0.09, 0.31, 0.49, 0.8, 0.7, 0.0, 0.79, 0.39, 0.0, 0.0, 0.04, 0.0, 0.1, 0.96], [-1.31, -0.37, 0.51], [0.21, -1.68, 1.27], [0.00806425, 0.0267033, 0.0419534, 0.0829047]),
    ([0.15, 0.28, 0.74, 1.3, 0.76, 0.0, 0.99, 0.73, 0.0, 0.44, 0.87, 0.01, 0.1, 0.96], [-1.15, 0.34, 0.49], [0.94, -0.46, 0.7], [0.0640528, 0.107315, 0.260396, 0.402855]),
    ([0.05, 0.1, 0.68, 1.3, 0.47, 0.0, 0.94, 0.0, 0.82, 0.08, 0.0, 0.15, 0.2, 0.0], [0.46, 0.36, 1.32], [-1.47, -1.6, 0.62], [0.00424658, 0.00799482, 0.0514745, 0.0851098]),
    ([0.42, 0.46, 0.17, 1.3, 0.64, 0.0, 0.46, 0.0, 0.0, 0.0, 0.81, 0.45, 0.0, 0.35], [-1.65, 1.98, 0.25], [-0.06, -0.79, 0.94], [0.0992115, 0.108026, 0.0441237, 0.210486]),
    ([0.5, 0.68, 0.02, 0.8, 0.35, 0.82, 0.76, 0.0, 0.0, 0.49, 0.81, 0.0, 0.0, 0.0], [0.37, 1.03, 1.64], [0.05, -0.2, 1.1], [0.0624687, 0.084885, 0.00269198, 0.113027]),
    ([0.34, 0.49, 0.06, 0.8, 0.4, 0.0, 0.81, 0.26, 0.34, 0.04, 0.0, 0.0, 0.3, 0.0], [-0.62, -1.14, -2.37], [0.72, 0.92, -2.36], [0.00189832, 0.00189832, 0.00189832, 0.0384878]),
    ([0.25, 0.46, 0.72, 0.8, 0.99, 0.1, 0.51, 0.08, 0.0, 0.34, 0.18, 0.0, 0.47, 0.22], [-1.54, 0.82, 0.18], [0.23, 2.45, 1.19], [0.0370634, 0.0675725, 0.105346, 0.12716]),
    ([0.15, 0.89, 0.12, 0.8, 0.38, 0.0, 0.0, 0.33, 0.0, 0.24, 0.0, 0.0, 0.37, 0.77], [-0.61, 2.0, 0.66], [0.75, 1.22, 0.68], [0.0197308, 0.116608, 0.0158033, 0.0577353]),
    ([0.55, 0.61, 0.34, 1.8, 0.32, 0.59, 0.0, 0.18, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04], [-0.11, -0.11, -0.35], [-0.77, 0.64, 1.54], [0.00180157, 0.00189729, 0.00141647, 0.00417204]),
    ([0.7, 0.47, 0.48, 1.8, 0.95, 0.0, 0.0, 0.23, 0.16, 0.58, 0.01, 0.0, 0.0, 0.59], [1.8, 0.51, 0.45], [-1.98, -0.72, 0.49], [0.110761, 0.0927332, 0.0935171, 0.112183]),
    ([0.79, 0.38, 0.68, 1.5, 0.34, 0.84, 0.96, 0.0, 0.0, 0.94, 0.0, 0.34, 0.0, 0.45], [-1.07, -0.25, 0.43], [0.25, 1.1, 2.05], [0.060474, 0.029511, 0.0521669, 0.0742229]),
    ([0.91, 0.14, 0.78, 1.5, 1.0, 0.0, 0.16, 0.0, 0.0, 0.47, 0.12, 0.46, 0.27, 0.0], [1.87, 1.0, 0.37], [0.02, -1.01, 0.24], [0.072909, 0.0153785, 0.0631961, 0.101767]),
    ([0.9, 0.4, 0.2, 1.5, 0.69, 0.07, 0.0, 0.01, 0.05, 0.39, 0.18, 0.66, 0.0, 0.24], [0.4, 1.63, 0.93], [-1.04, -0.33, 0.18], [0.0539433, 0.0256359, 0.014313, 0.0535564]),
    ([0.75, 0.4, 0.05, 1.8, 0.69, 0.0, 0.0, 0.28, 0.78, 0.0, 0.53, 0.0, 0.46, 0.0], [-0.31, -1.63, 1.57], [0.79, 1.71, 1.37], [0.150535, 0.0849135, 0.0192918, 0.256348]),
    ([0.48, 0.83, 0.62, 1.8, 0.5, 0.65, 0.45, 0.0, 0.19, 0.0, 0.0, 0.91, 0.48, 0.78], [0.24, 0.62, 1.92], [1.18, -1.61, 1.18], [0.0602675, 0.101101, 0.0766009, 0.107165]),
    ([0.17, 0.55, 0.86, 1.5, 0.78, 0.0, 0.54, 0.32, 0.9, 0.28, 0.46, 0.59, 0.0, 0.0], [-0.9, 1.7, 0.69], [-1.34, 1.85, 1.34], [0.0163008, 0.0520057, 0.0811334, 0.0793688]),
    ([0.3, 0.1, 0.07, 0.8, 0.6, 0.8, 0.02, 0.17, 0.0, 0.71, 0.0, 0.0, 0.24, 0.01], [0.88, -0.79, 0.15], [0.96, 1.03, 0.23], [0.0239178, 0.0137366, 0.0122094, 0.208707]),
    ([0.31, 0.19, 0.98, 0.8, 0.34, 0.0, 0.0, 0.51, 0.0, 0.0, 0.55, 0.0, 0.0, 0.79], [0.23, 0.16, -0.89], [-0.19, -0.3, -0.95], [0.0204994, 0.0204994, 0.0204994, 0.0402136]),
    ([0.19, 0.26, 0.07, 1.5, 0.48, 0.47, 0.9, 0.0, 0.0, 0.0, 0.37, 0.7, 0.46, 0.0], [-0.14, 1.06, 0.3], [1.63, -1.03, 0.47], [0.00674721, 0.00876518, 0.00328784, 0.0338931]),
    ([0.54, 0.92, 0.19, 1.8, 0.68, 0.0, 0.6, 0.0, 0.0, 0.0, 0.63, 0.87, 0.0, 0.14], [0.87, -1.44, 0.57], [0.99, 1.5, 0.15], [0.0115673, 0.0190847, 0.00464332, 0.0385564]),
    ([0.09, 0.85, 0.44, 1.3, 0.91, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.76, 0.14, 0.89], [-0.45, -0.82, 0.14], [0.72, -0.94, 0.85], [0.0273449, 0.240761, 0.125629, 0.143135]),
];

/// The lobe of Phong's model holds what Lafortune and Willems say: seen straight from above, with the factor alone, all of it.
#[test]
fn phong_keeps_its_lobe() {
    for exponent in [0.0, 1.0, 30.0, 100.0] {
        let phong = Bsdf::Phong { diffuse: [0.0; 3], specular: [0.7; 3], exponent };
        let albedo = |wo| integrate_bins(40, 30, |wi| f64::from(phong.eval(wo, wi, true).value.x)).iter().sum::<f64>();
        let straight = albedo(Vec3::Z);
        assert!((straight - 0.7).abs() < 0.003, "{exponent}: {straight}");
        assert!(albedo(local(1.3, 0.4)) < straight + 0.003);
    }
    // both factors together beyond 1 are scaled down
    let phong = Bsdf::Phong { diffuse: [0.9; 3], specular: [0.9; 3], exponent: 20.0 };
    let albedo: f64 = integrate_bins(40, 30, |wi| f64::from(phong.eval(Vec3::Z, wi, true).value.x)).iter().sum();
    assert!((albedo - 1.0).abs() < 0.003, "{albedo}");
}

/// What radiance is multiplied by when it leaves for `wi`, so that energy counts.
pub(super) fn crossing(bsdf: &Bsdf, front: bool, wi: Vec3) -> f32 {
    match bsdf {
        Bsdf::Dielectric { eta, .. } | Bsdf::RoughDielectric { eta, .. } if wi.z < 0.0 => relative(*eta, front).powi(2),
        Bsdf::Principled(Principled { eta, .. }) if wi.z < 0.0 => relative(*eta, front).powi(2),
        _ => 1.0,
    }
}

pub(super) fn local(theta: f32, phi: f32) -> Vec3 {
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
    let (mut compared, mut cases) = (0, 0);
    for (bsdf, front) in all() {
        // an interface of single directions has no density
        let has_density = !bsdf.is_delta();
        for wo in views() {
            // refraction narrows a lobe
            let midpoints = if bsdf.transmits() { 45 } else { 30 };
            let bins = follows_density(&bsdf, front, wo, 100_000, midpoints, &mut rng);
            compared += u32::from(bins);
            cases += u32::from(has_density);
        }
    }
    println!("{compared} of {cases} compared bin by bin");
    assert!(4 * compared >= 3 * cases, "{compared} of {cases} compared bin by bin");
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

/// f(wo, wi) = f(wi, wo); across an interface f(wo, wi) over the square of the index at `wo` (radiance shrinks as it enters). How many of some random
/// pairs on one side, and across, scatter anything.
pub(super) fn exchanged(bsdf: &Bsdf, front: bool, pairs: u32, rng: &mut Rng) -> [u32; 2] {
    let mut seen = [0; 2];
    for _ in 0..pairs {
        let mut up = || {
            let d = rng.direction();
            Vec3::new(d.x, d.y, d.z.abs().max(1e-3)).normalize()
        };
        let (a, b) = (up(), up());
        let (ab, ba) = (bsdf.eval(a, b, front).value / b.z, bsdf.eval(b, a, front).value / a.z);
        let close = (ab - ba).abs().cmple(1e-3 * ab.max(ba) + 1e-12).all();
        assert!(close, "{bsdf:?} {front} {a} {b}: {ab} {ba}");
        seen[0] += u32::from(ab.max_element() > 0.0);
        if let Bsdf::RoughDielectric { eta, .. } = *bsdf {
            let flip = |v: Vec3| Vec3::new(v.x, v.y, -v.z);
            let there = bsdf.eval(a, flip(b), front).value / b.z * relative(eta, front).powi(2);
            let back = bsdf.eval(b, flip(a), !front).value / a.z;
            // near the critical angle cosines, and with them small values, are mostly rounding
            let close = (there - back).abs().cmple(1e-2 * there.max(back) + 1e-4).all();
            assert!(close, "{bsdf:?} {front} {a} {b}: {there} {back}");
            seen[1] += u32::from(there.max_element() > 0.0);
        }
    }
    seen
}

#[test]
fn directions_may_be_exchanged() {
    let mut rng = Rng(3);
    let crossed: u32 = all().iter().map(|(bsdf, front)| exchanged(bsdf, *front, 2000, &mut rng)[1]).sum();
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
    let coat = |d, alpha, eta, nonlinear| rough_plastic(d, alpha, eta, 1.0, nonlinear);
    let coats = [(Distribution::Beckmann, false), (Distribution::Ggx, true)]
        .map(|(d, nonlinear)| [(1e-4, 1.5), (0.03, 1.000277), (1.0, 10.0)].map(|(a, eta)| coat(d, a, eta, nonlinear)))
        .concat();
    for i in 0..100_000 {
        let alpha = |rng: &mut Rng| [1e-5, 1e-4, 1e-3, 0.03, 0.5, 1.0][(rng.u32() % 6) as usize];
        let eta_glass = [1.5, 1.0, 0.5, 1.000277, 10.0][(rng.u32() % 5) as usize];
        let white = [1.0; 3];
        let distribution = if i & 1 == 0 { Distribution::Beckmann } else { Distribution::Ggx };
        let bsdf = match i % 11 {
            10 => coats[(rng.u32() % 6) as usize].clone(),
            8 => Bsdf::Phong {
                diffuse: white,
                specular: white,
                exponent: [0.0, 1.0, 1e3, 1e6][(rng.u32() % 4) as usize],
            },
            9 => {
                let mut end = || [0.0, 1.0, 0.5][(rng.u32() % 3) as usize];
                Bsdf::Principled(Principled {
                    base_color: [end(), end(), end()],
                    eta: eta_glass,
                    roughness: end(),
                    anisotropic: end(),
                    metallic: end(),
                    spec_trans: end(),
                    spec_tint: end(),
                    sheen: end(),
                    sheen_tint: end(),
                    clearcoat: end(),
                    clearcoat_gloss: end(),
                    flatness: end(),
                })
            }
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
