//! Mitsuba's `principled`: Burley 2012, "Physically Based Shading at Disney", and 2015, "Extending the Disney BRDF to a BSDF", constants and
//! choices of Mitsuba 3 included, so that a scene looks as its owner knows it.
//!
//! A metal or a dielectric by one GGX lobe (visible normals sampled), a diffuse base with retro-reflection or flattened towards subsurface scattering,
//! sheen, and a coat (GTR1). With sheen, coat and base each at their fullest more light may come out than went in: that is the model's.

use serde::{Deserialize, Serialize};

use super::dielectric::fresnel;
use super::rough::Rough;
use super::{Distribution, Sampled, Scatter, diffuse, relative};
use crate::math::{luminance, sincos_turn};
use crate::real::consts::{FRAC_1_PI, PI};
use crate::real::{Vec3, expm1, f32, log};

/// Parameters, in [0, 1] unless said.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Principled {
    /// Colour of base and metal; what is let through is coloured by its root.
    pub base_color: [f32; 3],
    /// Index inside over outside, above 0.
    pub eta: f32,
    /// Root of the roughness of the main lobe.
    pub roughness: f32,
    /// How much longer highlights are along u.
    pub anisotropic: f32,
    /// Share that is metal.
    pub metallic: f32,
    /// Share of the rest that lets light through.
    pub spec_trans: f32,
    /// How much the dielectric's highlight takes the base's hue.
    pub spec_tint: f32,
    /// Strength of the sheen.
    pub sheen: f32,
    /// How much the sheen takes the base's hue.
    pub sheen_tint: f32,
    /// Strength of the coat; at 1 a quarter of Fresnel's.
    pub clearcoat: f32,
    /// Smoothness of the coat.
    pub clearcoat_gloss: f32,
    /// From the diffuse base (0) to one flattened as by subsurface scattering (1).
    pub flatness: f32,
}

/// Roughness of the coat's masking.
const COAT_MASKING: f32 = 0.25;
/// Reflectance of the coat seen straight.
const COAT_STRAIGHT: f32 = 0.04;

/// How probable each lobe is, for normals that reflect the share `r`.
struct Lobes {
    reflect: f32,
    transmit: f32,
    coat: f32,
    base: f32,
}

impl Principled {
    /// Roughness along u and v.
    pub(super) fn alpha(&self) -> [f32; 2] {
        let square = self.roughness * self.roughness;
        let aspect = (1.0 - 0.9 * self.anisotropic).sqrt();
        [(square / aspect).max(0.001), (square * aspect).max(0.001)]
    }

    fn rough(&self) -> Rough {
        Rough::new(Distribution::Ggx, self.alpha())
    }

    /// Share of the base.
    fn base(&self) -> f32 {
        (1.0 - self.metallic) * (1.0 - self.spec_trans)
    }

    /// Share that lets light through.
    fn through(&self) -> f32 {
        (1.0 - self.metallic) * self.spec_trans
    }

    fn lobes(&self, front: bool, r: f32) -> Lobes {
        let through = self.through();
        if !front {
            return Lobes { reflect: r, transmit: 1.0 - r, coat: 0.0, base: 0.0 };
        }
        let (coat, base) = (0.25 * self.clearcoat, self.base());
        let inv = 1.0 / (1.0 + coat + base);
        let transmit = through * (1.0 - r);
        Lobes { reflect: (1.0 - transmit) * inv, transmit: transmit * inv, coat: coat * inv, base: base * inv }
    }

    fn coat(&self) -> Gtr1 {
        Gtr1::new(0.1 + (0.001 - 0.1) * self.clearcoat_gloss)
    }

    /// The base colour over its luminance.
    fn hue(&self) -> Vec3 {
        let color = Vec3::from(self.base_color);
        let light = luminance(color);
        if light > 0.0 { color / light } else { Vec3::ONE }
    }

    /// What the main lobe reflects at a cosine at which a dielectric reflects the share `r`.
    fn reflectance(&self, front: bool, cos: f32, r: f32) -> Vec3 {
        if !front {
            return Vec3::splat(self.through() * r);
        }
        let weight = self.schlick_weight(cos);
        let schlick = |straight: Vec3| straight + (Vec3::ONE - straight) * weight;
        let mut out = Vec3::splat((1.0 - self.metallic) * (1.0 - self.spec_tint) * r);
        if self.metallic > 0.0 {
            out += schlick(self.base_color.into()) * self.metallic;
        }
        if self.spec_tint > 0.0 {
            let root = (self.eta - 1.0) / (self.eta + 1.0);
            out += schlick(self.hue() * (root * root)) * ((1.0 - self.metallic) * self.spec_tint);
        }
        out
    }

    /// Schlick's (1 - cos)^5, by the cosine in the thinner medium.
    fn schlick_weight(&self, cos: f32) -> f32 {
        if self.eta > 1.0 {
            return fifth(cos);
        }
        let inv = 1.0 / self.eta;
        fifth((1.0 - (1.0 - cos * cos) * (inv * inv)).max(0.0).sqrt())
    }

    pub(super) fn eval(&self, wo: Vec3, wi: Vec3, front: bool) -> Scatter {
        let through = self.through();
        if !(wo.z > 0.0 && wi.z != 0.0) || (!front && !(through > 0.0)) {
            return Scatter::NONE;
        }
        let eta = relative(self.eta, front);
        let reflects = wi.z > 0.0;
        if !reflects && !(through > 0.0) {
            return Scatter::NONE;
        }
        let m = if reflects { wo + wi } else { wo + wi * eta };
        let length = m.length();
        let m = m / if m.z < 0.0 { -length } else { length };
        let (cos_o, cos_i) = (wo.dot(m), wi.dot(m));
        // facets are seen from the front; equal indices bend nothing (length 0)
        let facets = length > 0.0 && cos_o > 0.0 && m.z > 0.0 && (cos_i > 0.0) == reflects;
        let (mut value, mut pdf) = (Vec3::ZERO, 0.0);
        let r = if facets { fresnel(cos_o, eta).0 } else { 0.0 };
        let lobes = self.lobes(front, r);
        if facets {
            let rough = self.rough();
            // density of the visible normals over their cosine to `wo`
            let visible = rough.density(m) * rough.masking(wo) / wo.z;
            let shadowing = rough.masking(wi);
            if reflects {
                // as in Mitsuba, a surface without Fresnel reflection has none of a metal either
                if r > 0.0 {
                    value += self.reflectance(front, cos_o, r) * (visible * shadowing / 4.0);
                }
                pdf += lobes.reflect * visible / 4.0;
            } else {
                let sum = cos_o + eta * cos_i;
                let jacobian = visible * cos_o * -cos_i / (sum * sum);
                let color = Vec3::from(self.base_color.map(f32::sqrt));
                value += color * (through * (1.0 - r) * jacobian * shadowing);
                pdf += lobes.transmit * jacobian * (eta * eta);
            }
            if reflects && front && self.clearcoat > 0.0 {
                let coat = self.coat();
                let density = coat.density(m);
                let masking = Rough::new(Distribution::Ggx, [COAT_MASKING; 2]);
                let share = COAT_STRAIGHT + (1.0 - COAT_STRAIGHT) * self.schlick_weight(cos_o);
                let shadowing = masking.masking(wo) * masking.masking(wi);
                value += Vec3::splat(0.25 * self.clearcoat * share * density * shadowing * wi.z);
                pdf += lobes.coat * density * m.z / (4.0 * cos_i);
            }
        }
        if reflects && front {
            value += self.base_value(wo, wi, cos_i);
            pdf += lobes.base * wi.z * FRAC_1_PI;
        }
        if !(pdf > 0.0 && pdf.is_finite() && value.is_finite()) {
            return Scatter::NONE;
        }
        Scatter { value, pdf }
    }

    /// Base and sheen times the cosine; `cos_d` is that between a direction and the normal half way.
    fn base_value(&self, wo: Vec3, wi: Vec3, cos_d: f32) -> Vec3 {
        let mut value = Vec3::ZERO;
        let share = self.base();
        if share > 0.0 {
            let (out, into) = (fifth(wi.z), fifth(wo.z));
            let smooth = (1.0 - 0.5 * into) * (1.0 - 0.5 * out);
            let retro = 2.0 * self.roughness * cos_d * cos_d;
            let back = retro * (out + into + out * into * (retro - 1.0));
            let mut shape = smooth + back;
            if self.flatness > 0.0 {
                let grazing = 0.5 * retro;
                let fade = |w: f32| 1.0 + (grazing - 1.0) * w;
                let flat = 1.25 * (fade(out) * fade(into) * (1.0 / (wi.z + wo.z) - 0.5) + 0.5);
                shape += (flat - shape) * self.flatness;
            }
            value += Vec3::from(self.base_color) * (share * shape * FRAC_1_PI);
        }
        if self.sheen > 0.0 {
            let tint = Vec3::ONE + (self.hue() - Vec3::ONE) * self.sheen_tint;
            value += tint * (self.sheen * (1.0 - self.metallic) * fifth(cos_d));
        }
        value * wi.z
    }

    pub(super) fn sample(&self, wo: Vec3, front: bool, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        if !(wo.z > 0.0) || (!front && !(self.through() > 0.0)) {
            return None;
        }
        // base and coat do not depend on the normal
        let Lobes { base, coat, .. } = self.lobes(front, 0.0);
        if lobe < base {
            return diffuse::sample(wo, u).map(Sampled::smooth);
        }
        if lobe < base + coat {
            let m = self.coat().sample(u);
            return mirrored(wo, m);
        }
        let m = self.rough().visible_normal(wo, u)?;
        let cos = wo.dot(m);
        let eta = relative(self.eta, front);
        let (r, cos_t) = fresnel(cos, eta);
        if lobe < base + coat + self.lobes(front, r).transmit {
            let inv = 1.0 / eta;
            let wi = m * (cos * inv - cos_t) - wo * inv;
            return (wi.z < 0.0 && cos_t > 0.0).then(|| Sampled::smooth(wi / wi.length()));
        }
        mirrored(wo, m)
    }
}

fn mirrored(wo: Vec3, m: Vec3) -> Option<Sampled> {
    let cos = wo.dot(m);
    let wi = m * (2.0 * cos) - wo;
    (cos > 0.0 && wi.z > 0.0).then(|| Sampled::smooth(wi / wi.length()))
}

/// (1 - cos)^5.
fn fifth(cos: f32) -> f32 {
    let m = (1.0 - cos.abs()).clamp(0.0, 1.0);
    let m2 = m * m;
    m2 * m2 * m
}

/// Generalised Trowbridge-Reitz normals of exponent 1 (Burley 2012, appendix B).
struct Gtr1 {
    alpha2: f32,
    log: f32,
}

impl Gtr1 {
    fn new(alpha: f32) -> Gtr1 {
        let alpha2 = alpha * alpha;
        Gtr1 { alpha2, log: log(alpha2) }
    }

    fn density(&self, m: Vec3) -> f32 {
        // 1 + (alpha^2 - 1) cos^2 without cancellation
        let t = m.x * m.x + m.y * m.y + self.alpha2 * (m.z * m.z);
        (self.alpha2 - 1.0) / (PI * self.log * t)
    }

    /// A normal of density `density(m) m.z` in solid angle.
    fn sample(&self, u: [f32; 2]) -> Vec3 {
        // sin^2 = (alpha^2(1 - u) - alpha^2) / (1 - alpha^2)
        let sin2 = (self.alpha2 * expm1(-u[1] * self.log) / (1.0 - self.alpha2)).clamp(0.0, 1.0);
        let (s, c) = sincos_turn(u[0]);
        let sin = sin2.sqrt();
        Vec3::new(sin * c, sin * s, (1.0 - sin2).sqrt())
    }
}
