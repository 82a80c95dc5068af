//! Every model with random parameters: samples follow the density, where lobes are narrow too; single directions have Fresnel's share; no energy is made.

use glam::{DVec3, Vec3};

use super::tests::{any_principled, crossing, exchanged, follows_density, glass, local, rough, rough_plastic};
use super::*;
use crate::testing::{Rng, chi_square};

/// Models that have a density.
const KINDS: [&str; 6] = ["diffuse", "rough metal", "rough glass", "plastic", "rough plastic", "phong"];

/// One of [`KINDS`], with lobes wide enough for a quadrature over directions. Principled has a test of its own.
fn any(kind: usize, rng: &mut Rng) -> Bsdf {
    let distribution = if rng.u32() & 1 == 0 { Distribution::Beckmann } else { Distribution::Ggx };
    let eta = rng.range(1.1, 2.4);
    let mut color = || [rng.f32(), rng.f32(), rng.f32()];
    let (diffuse, specular) = (color(), color());
    match kind {
        0 => Bsdf::Diffuse { reflectance: diffuse },
        1 => {
            let alpha = [rng.range(0.25, 1.0), rng.range(0.25, 1.0)];
            let (eta, k) = ([eta; 3], [rng.range(0.0, 5.0); 3]);
            Bsdf::RoughConductor { distribution, alpha, eta, k, specular }
        }
        2 => {
            let alpha = [rng.range(0.5, 1.0), rng.range(0.5, 1.0)];
            let eta = if rng.u32() & 1 == 0 { eta } else { 1.0 / eta };
            Bsdf::RoughDielectric { distribution, alpha, eta, reflect: diffuse, transmit: specular }
        }
        3 => Bsdf::Plastic { eta, diffuse, specular, nonlinear: rng.u32() & 1 == 0 },
        4 => rough_plastic(distribution, rng.range(0.2, 1.0), eta, diffuse[0], rng.u32() & 1 == 0),
        _ => Bsdf::Phong { diffuse, specular, exponent: rng.range(0.0, 60.0) },
    }
}

/// A view from straight above to half a degree over the surface.
fn any_view(rng: &mut Rng) -> Vec3 {
    local(rng.range(0.0, 1.0).sqrt() * 1.56, rng.range(-3.1, 3.1))
}

#[test]
fn samples_follow_the_density_of_any_model() {
    let mut rng = Rng(21);
    for (kind, name) in KINDS.iter().enumerate() {
        let (mut compared, all) = (0, 14);
        for _ in 0..all {
            let (bsdf, wo) = (any(kind, &mut rng), any_view(&mut rng));
            let front = rng.u32() & 3 != 0 || !bsdf.transmits();
            let midpoints = if bsdf.transmits() { 45 } else { 30 };
            compared += u32::from(follows_density(&bsdf, front, wo, 50_000, midpoints, &mut rng));
        }
        println!("{name}: {compared} of {all} compared bin by bin");
        assert!(4 * compared >= 3 * all, "{name}: {compared} of {all}");
    }
}

/// Bins of slopes by distance from the normal and by angle.
const BINS: [usize; 2] = [6, 8];

/// Slopes of microfacets in units of a roughness: rings up to `most` units. Their edges are even in ln(1 + r^2), so that the core and the tail of a lobe
/// have rings of their own however far they reach.
struct Slopes {
    scale: [f64; 2],
    most: f64,
}

impl Slopes {
    fn of(alpha: [f32; 2], most: f64) -> Slopes {
        Slopes { scale: alpha.map(f64::from), most }
    }

    /// Slopes in these units up to where a view's microfacets begin to reflect below the surface, or to cross the angle of total reflection: there a
    /// density ends, or bends, along a curve that no quadrature over bins follows. An eighth is kept as a distance.
    fn smooth(alpha: [f32; 2], wo: Vec3, eta: f64) -> Slopes {
        let view = f64::from(wo.z).acos();
        let above = 0.5 * (0.5 * std::f64::consts::PI - view);
        let total = if eta < 1.0 { (eta.asin() - view).abs() } else { above };
        let widest = f64::from(alpha[0].max(alpha[1]));
        Slopes::of(alpha, (0.875 * above.min(total)).tan() / widest)
    }

    /// The bin of a microfacet; none beyond them.
    fn bin(&self, m: DVec3) -> Option<usize> {
        let (x, y) = (m.x / m.z / self.scale[0], m.y / m.z / self.scale[1]);
        let ring = ((x * x + y * y).ln_1p() / self.most.powi(2).ln_1p() * BINS[0] as f64) as usize;
        let turn = (y.atan2(x) / std::f64::consts::TAU + 0.5) * BINS[1] as f64;
        (m.z > 0.0 && ring < BINS[0]).then(|| ring * BINS[1] + (turn as usize).min(BINS[1] - 1))
    }

    /// Share of each bin, and of what lies beyond them all: the integral of a density of microfacets by `k` x `k` points a bin, an even number each way,
    /// in pairs as Gauss places them.
    fn integrate(&self, k: usize, density: impl Fn(DVec3) -> f64) -> Vec<f64> {
        let mut out = vec![0.0; BINS[0] * BINS[1]];
        let whole = self.most.powi(2).ln_1p();
        let point = |i: usize, n: usize| {
            let side = if i.is_multiple_of(2) { -1.0 } else { 1.0 };
            ((i / 2) as f64 + 0.5 + side * 0.5 / 3f64.sqrt()) / (n / 2) as f64
        };
        for i in 0..BINS[0] * k {
            let log = point(i, BINS[0] * k) * whole;
            let r = log.exp_m1().sqrt();
            // r dr = (1 + r^2) / 2 d ln(1 + r^2)
            let ring = 0.5 * log.exp() * whole / (BINS[0] * k) as f64;
            for j in 0..BINS[1] * k {
                let turn = (point(j, BINS[1] * k) - 0.5) * std::f64::consts::TAU;
                let (x, y) = (r * turn.cos() * self.scale[0], r * turn.sin() * self.scale[1]);
                let m = DVec3::new(x, y, 1.0).normalize();
                let area = ring * std::f64::consts::TAU / (BINS[1] * k) as f64 * self.scale[0] * self.scale[1];
                out[i / k * BINS[1] + j / k] += density(m) * area * m.z.powi(3);
            }
        }
        out.push(1.0 - out.iter().sum::<f64>());
        out
    }
}

fn reflected(wo: DVec3, m: DVec3) -> DVec3 {
    2.0 * wo.dot(m) * m - wo
}

/// Samples as microfacets, whose slopes are as wide as the roughness is, whatever that is: they follow the density, changed to slopes by the Jacobians of
/// reflection and refraction (Walter et al. 2007, equations 14 and 17). `eta` is the index below over that above. The share within the bins.
fn slopes_follow_the_density(
    bsdf: &Bsdf,
    front: bool,
    wo: Vec3,
    slopes: &Slopes,
    eta: f64,
    n: u32,
    rng: &mut Rng,
) -> f64 {
    let (o, cells) = (wo.as_dvec3().normalize(), BINS[0] * BINS[1]);
    let mut counts = vec![0.0; cells + 1];
    for _ in 0..n {
        let bin = bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()).and_then(|s| {
            let i = s.wi.as_dvec3();
            let m = if i.z > 0.0 { o + i } else { o + i * eta };
            slopes.bin((m * m.z.signum()).normalize())
        });
        counts[bin.unwrap_or(cells)] += 1.0;
    }
    let density = |m: DVec3| {
        let cos = o.dot(m);
        if cos <= 0.0 {
            return 0.0;
        }
        let pdf = |wi: DVec3| f64::from(bsdf.eval(wo, wi.as_vec3().normalize(), front).pdf);
        let up = reflected(o, m);
        let mut sum = if up.z > 0.0 { pdf(up) * 4.0 * cos } else { 0.0 };
        let cos2_t = 1.0 - (1.0 - cos * cos) / (eta * eta);
        if bsdf.transmits() && cos2_t > 0.0 {
            let cos_t = cos2_t.sqrt();
            let down = m * (cos / eta - cos_t) - o / eta;
            let both = cos - eta * cos_t;
            sum += if down.z < 0.0 { pdf(down) * both * both / (eta * eta * cos_t) } else { 0.0 };
        }
        sum
    };
    // until what halving the steps changes is nothing to chi-square, which pools bins of fewer than five
    let (mut coarse, mut k) = (slopes.integrate(6, density), 12);
    let mut expected = loop {
        let fine = slopes.integrate(k, density);
        let change = |(f, c): (&f64, &f64)| f64::from(n) * (f - c).powi(2) / f.max(5.0 / f64::from(n));
        let change: f64 = fine.iter().zip(&coarse).map(change).sum();
        if change < 2.0 {
            break fine;
        }
        assert!(k < 96, "{bsdf:?} {front} {wo}: {change} with {k} steps a bin");
        (coarse, k) = (fine, 2 * k);
    };
    let sum = 1.0 - expected[cells];
    assert!(sum < 1.0005, "{bsdf:?} {front} {wo}: {sum} within the bins");
    expected[cells] = expected[cells].max(0.0);
    expected.iter_mut().for_each(|e| *e *= f64::from(n));
    println!("{bsdf:?} {front} {wo}: {sum:.4} within the bins, {k} steps");
    chi_square(&counts, &expected);
    sum
}

#[test]
fn narrow_lobes_follow_their_density() {
    let mut rng = Rng(22);
    let mut compared = 0;
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [[0.001; 2], [0.01; 2], [0.05; 2], [0.15; 2], [0.02, 0.1], [0.1, 0.003]] {
            for wo in [local(0.0, 0.0), local(0.6, 0.7), local(1.1, -2.0), local(1.4, 0.3), local(1.53, 2.5)] {
                let eta = rng.range(1.2, 2.0);
                let mut check = |bsdf: Bsdf, front: bool, eta: f32| {
                    slopes_follow_the_density(
                        &bsdf,
                        front,
                        wo,
                        &Slopes::of(alpha, 3.0),
                        f64::from(eta),
                        40_000,
                        &mut rng,
                    );
                    compared += 1;
                };
                check(rough(distribution, alpha), true, 1.0);
                check(glass(distribution, alpha, eta), true, eta);
                check(glass(distribution, alpha, eta), false, 1.0 / eta);
                if alpha[0] == alpha[1] {
                    check(rough_plastic(distribution, alpha[0], eta, 0.4, false), true, 1.0);
                }
            }
        }
    }
    assert_eq!(compared, 2 * 5 * (6 * 3 + 4));
}

/// Wide lobes where a view grazes the surface, bin by bin: most of those that [`samples_follow_the_density_of_any_model`] leaves to the integral are there.
#[test]
fn wide_lobes_follow_their_density_at_grazing_angles() {
    let mut rng = Rng(27);
    for (kind, name) in KINDS.iter().enumerate() {
        let (mut compared, all) = (0, 9);
        for i in 0..all {
            let (bsdf, front) = (any(kind, &mut rng), i % 3 != 0);
            let front = front || !bsdf.transmits();
            let wo = local([1.48, 1.53, 1.56][i as usize % 3], rng.range(-3.1, 3.1));
            compared += u32::from(follows_density(&bsdf, front, wo, 20_000, 44, &mut rng));
        }
        println!("{name}: {compared} of {all} compared bin by bin");
        assert!(3 * compared >= 2 * all, "{name}: {compared} of {all}");
    }
}

/// Phong's lobe up to the largest exponent that is read: (n + 1) / 2 pi cos^n about the mirror's direction. Rings of equal shares.
#[test]
fn sharp_phong_follows_its_density() {
    let mut rng = Rng(28);
    let (rings, sectors, n) = (12, 8, 100_000);
    for exponent in [1e3, 1e4, 1e5, 1e6] {
        for wo in [local(0.0, 0.0), local(0.7, 0.4), local(1.3, -2.0)] {
            let bsdf = Bsdf::Phong { diffuse: [0.0; 3], specular: [0.8; 3], exponent };
            let mirror = DVec3::new(-f64::from(wo.x), -f64::from(wo.y), f64::from(wo.z)).normalize();
            let side = mirror.any_orthonormal_vector();
            let mut counts = vec![0.0; rings * sectors];
            for _ in 0..n {
                let s = bsdf.sample(wo, true, [rng.f32(), rng.f32()], rng.f32()).expect("all of the lobe is above");
                let d = s.wi.as_dvec3().normalize();
                // cos without cancellation: what is within it has a share of 1 - cos^(n + 1)
                let cos_less_1 = -0.5 * (d - mirror).length_squared();
                let within = -((f64::from(exponent) + 1.0) * cos_less_1.ln_1p()).exp_m1();
                let turn = d.dot(mirror.cross(side)).atan2(d.dot(side)) / std::f64::consts::TAU + 0.5;
                let ring = ((within * rings as f64) as usize).min(rings - 1);
                counts[ring * sectors + ((turn * sectors as f64) as usize).min(sectors - 1)] += 1.0;
                // value and density are those of a cosine in f32, which is off by some 2^-24: by so many times the exponent in the power
                let power = (f64::from(exponent) * cos_less_1.ln_1p()).exp();
                let expected = (f64::from(exponent) + 1.0) / std::f64::consts::TAU * power;
                let e = bsdf.eval(wo, s.wi, true);
                let off = (f64::from(e.pdf) / expected).ln().abs();
                assert!(off < 2f64.powi(-21) * f64::from(exponent) + 1e-4, "{exponent} {wo} {d}: {} {expected}", e.pdf);
                let weight =
                    f64::from(e.value.x / e.pdf) / (0.8 * f64::from(exponent + 2.0) / f64::from(exponent + 1.0) * d.z);
                assert!((weight - 1.0).abs() < 1e-5, "{exponent} {wo} {d}: {weight}");
            }
            chi_square(&counts, &vec![f64::from(n) / counts.len() as f64; counts.len()]);
        }
    }
}

#[test]
fn directions_may_be_exchanged_in_any_model() {
    let mut rng = Rng(29);
    for (kind, name) in KINDS.iter().enumerate() {
        let mut seen = [0; 2];
        for _ in 0..24 {
            let bsdf = any(kind, &mut rng);
            let front = rng.u32() & 1 == 0 || !bsdf.transmits();
            let of_this = exchanged(&bsdf, front, 400, &mut rng);
            seen.iter_mut().zip(of_this).for_each(|(sum, n)| *sum += n);
        }
        assert!(seen[0] > 4000 && (seen[1] > 1000) == (*name == "rough glass"), "{name}: {seen:?}");
    }
}

/// Glass between what is narrow and what a quadrature over directions takes ([`any`]).
#[test]
fn rough_glass_between_follows_its_density() {
    let mut rng = Rng(25);
    let mut least = 1.0f64;
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [[0.2; 2], [0.3; 2], [0.45; 2], [0.2, 0.4]] {
            for wo in [local(0.0, 0.0), local(0.5, 0.7), local(1.1, -2.0), local(1.4, 0.3), local(1.48, 2.5)] {
                let eta = rng.range(1.2, 2.0);
                for (front, relative) in [(true, f64::from(eta)), (false, 1.0 / f64::from(eta))] {
                    let (glass, slopes) = (glass(distribution, alpha, eta), Slopes::of(alpha, 3.0));
                    least =
                        least.min(slopes_follow_the_density(&glass, front, wo, &slopes, relative, 40_000, &mut rng));
                }
            }
        }
    }
    assert!(least > 0.3, "{least} within the bins");
}

/// `principled` from a mirror's roughness to where a quadrature over directions takes it, with a coat of any gloss: main lobe, coat and base are one density.
/// Bins are as narrow as the narrower of the lobes.
#[test]
fn narrow_principled_follows_its_density() {
    let mut rng = Rng(26);
    let mut shares = vec![];
    for i in 0..48 {
        let mut p = any_principled(&mut rng);
        p.roughness = [0.0, rng.range(0.03, 0.6), rng.range(0.3, 0.6)][i % 3];
        // a coat is a fifth of all samples at most, and seldom that
        let n = if i % 2 == 0 { 400_000 } else { 40_000 };
        if i % 2 == 0 {
            p.metallic = [1.0, p.metallic][i / 2 % 2];
            (p.clearcoat, p.clearcoat_gloss) = (rng.range(0.6, 1.0), [1.0, rng.f32(), rng.f32()][i / 6 % 3]);
        }
        let front = i % 4 != 3 || p.spec_trans == 0.0;
        let wo = [local(0.0, 0.0), local(0.5, 0.4), local(1.1, -2.0), local(1.45, 1.3)][i / 12];
        let coat = 0.1 + (0.001 - 0.1) * p.clearcoat_gloss;
        let alpha = p.alpha();
        let narrower = if p.clearcoat > 0.0 && coat < alpha[1] && front { [coat; 2] } else { alpha };
        let eta = f64::from(relative(p.eta, front));
        let slopes = Slopes::smooth(narrower, wo, eta);
        let bsdf = Bsdf::Principled(p);
        shares.push(slopes_follow_the_density(&bsdf, front, wo, &slopes, eta, n, &mut rng));
    }
    // what lies beyond the bins is mostly base, whose density the wide lobes' test knows
    let seen = shares.iter().filter(|s| **s > 0.3).count();
    assert!(3 * seen > 2 * shares.len(), "{shares:?}");
}

/// Interfaces that reflect and let pass single directions: each as often, times its weight, as Fresnel's equations say.
#[test]
fn single_directions_have_their_share() {
    let mut rng = Rng(23);
    for i in 0..120 {
        let (eta, front) = (rng.range(0.5, 2.5), rng.u32() & 1 == 0);
        let (reflect, transmit) = ([rng.f32(); 3], [rng.f32(); 3]);
        let wo = any_view(&mut rng);
        let (bsdf, share) = match i % 3 {
            0 => {
                let (r, _) = dielectric::fresnel(wo.z, relative(eta, front));
                (Bsdf::Dielectric { eta, reflect, transmit }, [r * reflect[0], (1.0 - r) * transmit[0]])
            }
            1 => {
                // there and back within the pane, without end
                let (r, _) = dielectric::fresnel(wo.z, relative(eta.max(1.0), true));
                let r = 2.0 * r / (1.0 + r);
                (
                    Bsdf::ThinDielectric { eta: eta.max(1.0), reflect, transmit },
                    [r * reflect[0], (1.0 - r) * transmit[0]],
                )
            }
            _ => {
                let eta = eta.max(1.05);
                let (r, _) = dielectric::fresnel(wo.z, eta);
                (Bsdf::Plastic { eta, diffuse: transmit, specular: reflect, nonlinear: false }, [r * reflect[0], 0.0])
            }
        };
        let n = 20_000;
        let (mut sums, mut squares) = ([0.0f64; 2], [0.0f64; 2]);
        for _ in 0..n {
            if let Some(Sampled { wi, delta: Some(w) }) = bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()) {
                let below = usize::from(wi.z < 0.0);
                let w = f64::from(w.x * crossing(&bsdf, front, wi));
                sums[below] += w;
                squares[below] += w * w;
            }
        }
        for side in 0..2 {
            let mean = sums[side] / f64::from(n);
            let error = ((squares[side] / f64::from(n) - mean * mean).max(0.0) / f64::from(n)).sqrt();
            let expected = f64::from(share[side]);
            assert!((mean - expected).abs() < 5.0 * error + 1e-4, "{bsdf:?} {front} {wo} {side}: {mean} {expected}");
        }
    }
}

/// What a white sky is reflected and let through to, by sampling, and its standard error.
fn albedo(bsdf: &Bsdf, front: bool, wo: Vec3, n: u32, rng: &mut Rng) -> (f64, f64) {
    let (mut sum, mut squares) = (0.0, 0.0);
    for _ in 0..n {
        let Some(s) = bsdf.sample(wo, front, [rng.f32(), rng.f32()], rng.f32()) else { continue };
        let weight = match s.delta {
            Some(w) => f64::from(w.x * crossing(bsdf, front, s.wi)),
            None => {
                let e = bsdf.eval(wo, s.wi, front);
                if e.pdf > 0.0 { f64::from(e.value.x / e.pdf * crossing(bsdf, front, s.wi)) } else { 0.0 }
            }
        };
        (sum, squares) = (sum + weight, squares + weight * weight);
    }
    let mean = sum / f64::from(n);
    (mean, ((squares / f64::from(n) - mean * mean).max(0.0) / f64::from(n)).sqrt())
}

/// White surfaces of random parameters under a white sky give back no more than comes. `principled` does where it is no metal and no glass: it is Mitsuba's,
/// which adds a diffuse lobe to the coat's reflection that does not know of it, and at a grazing angle both are nearly 1; sheen and clearcoat come on top.
#[test]
fn no_model_makes_energy() {
    let mut rng = Rng(24);
    let mut most = [0.0f64; 3];
    for i in 0..400 {
        let wo = any_view(&mut rng);
        let mut p = any_principled(&mut rng);
        (p.base_color, p.roughness) = ([1.0; 3], rng.range(0.05, 1.0));
        let kind = i % 3;
        if kind < 2 {
            (p.sheen, p.clearcoat) = (0.0, 0.0);
        }
        if kind < 1 {
            (p.metallic, p.spec_trans) = if rng.u32() & 1 == 0 { (1.0, 0.0) } else { (0.0, 1.0) };
        }
        let front = p.spec_trans == 0.0 || rng.u32() & 1 == 0;
        let (found, error) = albedo(&Bsdf::Principled(p), front, wo, 20_000, &mut rng);
        most[kind] = most[kind].max(found - 4.0 * error);
    }
    println!(
        "principled: metal or glass {:.4}, without sheen and coat {:.4}, with all {:.4}",
        most[0], most[1], most[2]
    );
    for (kind, name) in KINDS.iter().enumerate() {
        let mut most = 0.0f64;
        for i in 0..60 {
            let mut bsdf = any(kind, &mut rng);
            if let (Bsdf::RoughPlastic { distribution, eta, nonlinear, .. }, true) = (&bsdf, i < 24) {
                bsdf = rough_plastic(*distribution, [1e-3, 0.01, 0.03, 0.1][i % 4], *eta, 1.0, *nonlinear);
            }
            for slot in [Slot::Diffuse, Slot::Specular, Slot::Transmit] {
                bsdf.color_mut(slot).into_iter().for_each(|color| *color = [1.0; 3]);
            }
            let front = rng.u32() & 1 == 0 || !bsdf.transmits();
            let (found, error) = albedo(&bsdf, front, any_view(&mut rng), 20_000, &mut rng);
            most = most.max(found - 4.0 * error);
        }
        println!("{name}: {most:.4}");
        assert!(most < 1.0 + 1e-6, "{name}: {most} less four standard errors");
    }
    assert!(most[0] < 1.0 + 1e-6 && most[1] < 2.5 && most[2] < 2.5, "{most:?} less four standard errors");
}
