//! A diffuse base under a transparent coat, smooth or rough.
//!
//! The model is Mitsuba's `plastic` and `roughplastic`, constants included, so that a scene looks as its owner knows it: light enters through the
//! coat by Fresnel's transmittance, is scattered by the base, and what the coat throws back inside is summed as a geometric series. What is
//! lost by the rough coat's single scattering is lost.

use serde::{Deserialize, Serialize};

use super::dielectric::fresnel;
use super::rough::Rough;
use super::{Distribution, Sampled, Scatter, diffuse};
use crate::real::consts::FRAC_1_PI;
use crate::real::{Vec3, f32};

/// Entries of [`Transmittance`], at cosines evenly from 0 to 1.
const ENTRIES: usize = 64;

/// What a rough coat lets in, and throws back inside; made by [`Transmittance::new`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct Transmittance {
    /// Share that enters, by cosine.
    entering: [f32; ENTRIES],
    /// Share of diffuse light from inside that is thrown back.
    pub(super) internal: f32,
}

#[derive(Serialize, Deserialize)]
struct Stored {
    entering: Vec<f32>,
    internal: f32,
}

impl TryFrom<Stored> for Transmittance {
    type Error = String;
    fn try_from(s: Stored) -> Result<Transmittance, String> {
        let share = |v: &f32| (0.0..=1.0).contains(v);
        match <[f32; ENTRIES]>::try_from(s.entering) {
            Ok(entering) if entering.iter().all(share) && share(&s.internal) => {
                Ok(Transmittance { entering, internal: s.internal })
            }
            _ => Err(format!("a coat's transmittance needs {ENTRIES} values in [0, 1] and one more")),
        }
    }
}

impl From<Transmittance> for Stored {
    fn from(t: Transmittance) -> Stored {
        Stored { entering: t.entering.to_vec(), internal: t.internal }
    }
}

impl Transmittance {
    /// Of a coat of roughness `alpha` and index `eta` over the outside, by quadrature over the visible normals.
    ///
    /// The share thrown back is, as in Mitsuba, twice the mean over the table's cosines of reflectance times cosine, ends included; that is some
    /// 1.5 % less than the integral.
    pub fn new(distribution: Distribution, alpha: f32, eta: f32) -> Transmittance {
        let rough = Rough::new(distribution, [alpha; 2]);
        // at a cosine of 0 nothing is visible: its limit
        let cosine = |i: usize| (i as f32 / (ENTRIES - 1) as f32).max(1e-6);
        let entering = std::array::from_fn(|i| share(&rough, cosine(i), eta, 32, false));
        let sum: f64 =
            (0..ENTRIES).map(|i| f64::from(share(&rough, cosine(i), 1.0 / eta, 64, true)) * f64::from(cosine(i))).sum();
        Transmittance { entering, internal: (2.0 * sum / ENTRIES as f64) as f32 }
    }

    /// Share that enters at a cosine; at the ends beyond 0 and 1.
    #[inline(always)]
    pub(crate) fn at(&self, cos: f32) -> f32 {
        let x = cos * (ENTRIES - 1) as f32;
        let i = (x as usize).min(ENTRIES - 2);
        let t = (x - i as f32).min(1.0);
        self.entering[i] * (1.0 - t) + self.entering[i + 1] * t
    }
}

/// Share of light from cosine `cos` that a rough interface reflects, or transmits, into the right half space: `n` x `n` midpoints.
fn share(rough: &Rough, cos: f32, eta: f32, n: usize, reflected: bool) -> f32 {
    let wo = Vec3::new((1.0 - cos * cos).max(0.0).sqrt(), 0.0, cos);
    let mut sum = 0.0f64;
    for i in 0..n * n {
        let u = [((i % n) as f32 + 0.5) / n as f32, ((i / n) as f32 + 0.5) / n as f32];
        let Some(m) = rough.visible_normal(wo, u) else { continue };
        let c = wo.dot(m);
        let (r, cos_t) = fresnel(c, eta);
        let (wi, weight) = if reflected {
            (m * (2.0 * c) - wo, r)
        } else {
            let inv = 1.0 / eta;
            (m * (c * inv - cos_t) - wo * inv, 1.0 - r)
        };
        if weight > 0.0 && (wi.z > 0.0) == reflected {
            sum += f64::from(weight * rough.masking(wi));
        }
    }
    (sum / (n * n) as f64).clamp(0.0, 1.0) as f32
}

/// What the two models share.
pub(super) struct Coated {
    pub eta: f32,
    pub diffuse: Vec3,
    pub specular: Vec3,
    /// Light thrown back inside is coloured each time.
    pub nonlinear: bool,
}

impl Coated {
    /// Probability of the coat's lobe, where it reflects the share `r`.
    #[inline(always)]
    pub(super) fn coat_probability(&self, r: f32) -> f32 {
        let (d, s) = (mean(self.diffuse), mean(self.specular));
        let weight = s / (d + s);
        let (coat, base) = (r * weight, (1.0 - r) * (1.0 - weight));
        // neither for NaN, where both factors are 0
        if coat + base > 0.0 { coat / (coat + base) } else { 0.0 }
    }

    /// Base and cosine, for what enters and leaves by these shares and is thrown back by `internal`.
    #[inline(always)]
    fn base(&self, entering: f32, leaving: f32, internal: f32, cos: f32) -> Vec3 {
        let colour = if self.nonlinear { self.diffuse } else { Vec3::ONE };
        let series = Vec3::ONE - colour * internal;
        self.diffuse / series * (FRAC_1_PI * cos * entering * leaving / (self.eta * self.eta))
    }

    /// The diffuse part under a smooth coat; the coat itself is a mirror.
    pub(super) fn eval_smooth(&self, wo: Vec3, wi: Vec3) -> Scatter {
        if !(wo.z > 0.0 && wi.z > 0.0) {
            return Scatter::NONE;
        }
        let (r_o, r_i) = (fresnel(wo.z, self.eta).0, fresnel(wi.z, self.eta).0);
        let value = self.base(1.0 - r_o, 1.0 - r_i, diffuse_reflectance_inside(self.eta), wi.z);
        Scatter { value, pdf: (1.0 - self.coat_probability(r_o)) * wi.z * FRAC_1_PI }
    }

    pub(super) fn sample_smooth(&self, wo: Vec3, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        if !(wo.z > 0.0) {
            return None;
        }
        let r = fresnel(wo.z, self.eta).0;
        let probability = self.coat_probability(r);
        if lobe < probability {
            return Some(Sampled::delta(Vec3::new(-wo.x, -wo.y, wo.z), self.specular * (r / probability)));
        }
        diffuse::sample(wo, u).map(Sampled::smooth)
    }

    pub(super) fn eval_rough(&self, rough: &Rough, coat: &Transmittance, wo: Vec3, wi: Vec3) -> Scatter {
        self.eval_between(rough, coat.at(wo.z), coat.at(wi.z), coat.internal, wo, wi)
    }

    /// Where the shares `entering` and `leaving` pass a rough coat at the cosines of `wo` and `wi`: without branches.
    #[inline(always)]
    pub(super) fn eval_between(
        &self,
        rough: &Rough,
        entering: f32,
        leaving: f32,
        internal: f32,
        wo: Vec3,
        wi: Vec3,
    ) -> Scatter {
        let probability = self.coat_probability(1.0 - entering);
        let base = self.base(entering, leaving, internal, wi.z);
        let lobe = rough.lobe(wo, wi);
        let lobe = lobe.reflecting(Vec3::splat(fresnel(lobe.cos, self.eta).0));
        Scatter {
            value: self.specular * lobe.value + base,
            pdf: probability * lobe.pdf + (1.0 - probability) * wi.z * FRAC_1_PI,
        }
        .only((wo.z > 0.0) & (wi.z > 0.0))
    }

    pub(super) fn sample_rough(
        &self,
        rough: &Rough,
        coat: &Transmittance,
        wo: Vec3,
        u: [f32; 2],
        lobe: f32,
    ) -> Option<Sampled> {
        if !(wo.z > 0.0) {
            return None;
        }
        let wi = if lobe < self.coat_probability(1.0 - coat.at(wo.z)) {
            rough.sample(wo, u)
        } else {
            diffuse::sample(wo, u)
        };
        wi.map(Sampled::smooth)
    }
}

#[inline(always)]
fn mean(v: Vec3) -> f32 {
    (v.x + v.y + v.z) * (1.0 / 3.0)
}

/// Share of diffuse light from inside that a smooth coat of index `eta` throws back. Up to 2 the fits that Mitsuba uses (above 1: Egan and Hilgeman
/// 1973, within 0.1 % to 1.5 and 0.6 % to 2; below 1: d'Eon and Irving 2011, within 0.2 %); above 2, where the first fails, from the share
/// thrown back outside (d'Eon and Irving, to 10) by the exact 1 - (1 - outside) / eta^2.
pub(super) fn diffuse_reflectance_inside(eta: f32) -> f32 {
    // of light in the thinner medium, for the index of the denser over the thinner
    let outside =
        |x: f32| [-1.36881, 4.98554, -7.80989, 6.75335, -3.4793, 0.919317].iter().fold(0.0, |sum, c| sum * x + c);
    if eta <= 1.0 {
        outside(eta)
    } else if eta <= 2.0 {
        let x = 1.0 / eta;
        (-1.4399 * x + 0.7099) * x + 0.6681 + 0.0636 * eta
    } else {
        1.0 - (1.0 - outside(1.0 / eta)) / (eta * eta)
    }
}
