//! Mitsuba's `principled`: Burley 2012, "Physically Based Shading at Disney", and 2015, "Extending the Disney BRDF to a BSDF", constants and
//! choices of Mitsuba 3 included, so that a scene looks as its owner knows it.
//!
//! A metal or a dielectric by one GGX lobe (visible normals sampled), a diffuse base with retro-reflection or flattened towards subsurface scattering,
//! sheen, and a coat (GTR1). With sheen, coat and base each at their fullest more light may come out than went in: that is the model's.

use serde::{Deserialize, Serialize};

use super::dielectric::fresnel;
use super::rough::Rough;
use super::{Distribution, Sampled, Scatter, Slot, diffuse, relative};
use crate::math::{exp_down, ln, luminance, select, sincos_turn};
use crate::real::consts::{FRAC_1_PI, PI};
use crate::real::{Vec3, f32};

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
    #[inline(always)]
    pub(super) fn alpha(&self) -> [f32; 2] {
        let square = self.roughness * self.roughness;
        let aspect = (1.0 - 0.9 * self.anisotropic).sqrt();
        [(square / aspect).max(0.001), (square * aspect).max(0.001)]
    }

    #[inline(always)]
    fn rough(&self) -> Rough {
        Rough::new(Distribution::Ggx, self.alpha())
    }

    /// Share of the base.
    #[inline(always)]
    fn base(&self) -> f32 {
        (1.0 - self.metallic) * (1.0 - self.spec_trans)
    }

    /// Share that lets light through.
    #[inline(always)]
    pub(super) fn through(&self) -> f32 {
        (1.0 - self.metallic) * self.spec_trans
    }

    #[inline(always)]
    fn lobes(&self, front: bool, r: f32) -> Lobes {
        let through = self.through();
        let (coat, base) = (0.25 * self.clearcoat, self.base());
        let inv = 1.0 / (1.0 + coat + base);
        let transmit = through * (1.0 - r);
        let pick = |a: f32, b: f32| if front { a } else { b };
        Lobes {
            reflect: pick((1.0 - transmit) * inv, r),
            transmit: pick(transmit * inv, 1.0 - r),
            coat: pick(coat * inv, 0.0),
            base: pick(base * inv, 0.0),
        }
    }

    #[inline(always)]
    fn coat(&self) -> Gtr1 {
        Gtr1::new(0.1 + (0.001 - 0.1) * self.clearcoat_gloss)
    }

    /// The base colour over its luminance.
    #[inline(always)]
    fn hue(&self) -> Vec3 {
        let color = self.color();
        let light = luminance(color);
        select(light > 0.0, color / light, Vec3::ONE)
    }

    #[inline(always)]
    fn color(&self) -> Vec3 {
        Vec3::new(self.base_color[0], self.base_color[1], self.base_color[2])
    }

    /// What the main lobe reflects at a cosine at which a dielectric reflects the share `r`.
    #[inline(always)]
    fn reflectance(&self, front: bool, cos: f32, r: f32) -> Vec3 {
        let weight = self.schlick_weight(cos);
        let schlick = |straight: Vec3| straight + (Vec3::ONE - straight) * weight;
        let root = (self.eta - 1.0) / (self.eta + 1.0);
        let clear = Vec3::splat((1.0 - self.metallic) * (1.0 - self.spec_tint) * r);
        let metal = schlick(self.color()) * self.metallic;
        let tinted = schlick(self.hue() * (root * root)) * ((1.0 - self.metallic) * self.spec_tint);
        select(front, clear + metal + tinted, Vec3::splat(self.through() * r))
    }

    /// Schlick's (1 - cos)^5, by the cosine in the thinner medium.
    #[inline(always)]
    fn schlick_weight(&self, cos: f32) -> f32 {
        let inv = 1.0 / self.eta;
        let thinner = (1.0 - (1.0 - cos * cos) * (inv * inv)).max(0.0).sqrt();
        fifth(if self.eta > 1.0 { cos } else { thinner })
    }

    // selects, no branches: blocks of vertices are compiled from these
    #[inline(always)]
    pub(crate) fn eval(&self, wo: Vec3, wi: Vec3, front: bool) -> Scatter {
        let through = self.through();
        let eta = relative(self.eta, front);
        let reflects = wi.z > 0.0;
        let m = wo + wi * if reflects { 1.0 } else { eta };
        let length = m.length();
        let m = m / if m.z < 0.0 { -length } else { length };
        let (cos_o, cos_i) = (wo.dot(m), wi.dot(m));
        // facets are seen from the front; equal indices bend nothing (length 0)
        let facets = (length > 0.0) & (cos_o > 0.0) & (m.z > 0.0) & ((cos_i > 0.0) == reflects);
        let r = if facets { fresnel(cos_o, eta).0 } else { 0.0 };
        let lobes = self.lobes(front, r);
        let rough = self.rough();
        // density of the visible normals over their cosine to `wo`
        let visible = rough.density(m) * rough.masking(wo) / wo.z;
        let shadowing = rough.masking(wi);
        // as in Mitsuba, a surface without Fresnel reflection has none of a metal either
        let reflected = self.reflectance(front, cos_o, r) * (visible * shadowing / 4.0);
        let reflected = select(r > 0.0, reflected, Vec3::ZERO);
        let sum = cos_o + eta * cos_i;
        let jacobian = visible * cos_o * -cos_i / (sum * sum);
        let root = Vec3::new(self.base_color[0].sqrt(), self.base_color[1].sqrt(), self.base_color[2].sqrt());
        let bent = root * (through * (1.0 - r) * jacobian * shadowing);
        let main = select(reflects, reflected, bent);
        let main_pdf = if reflects { lobes.reflect * visible / 4.0 } else { lobes.transmit * jacobian * (eta * eta) };

        let coat = self.coat();
        let density = coat.density(m);
        let masking = Rough::new(Distribution::Ggx, [COAT_MASKING, COAT_MASKING]);
        let share = COAT_STRAIGHT + (1.0 - COAT_STRAIGHT) * self.schlick_weight(cos_o);
        let masked = masking.masking(wo) * masking.masking(wi);
        let coated = 0.25 * self.clearcoat * share * density * masked * wi.z;
        let coat_pdf = lobes.coat * density * m.z / (4.0 * cos_i);

        let above = reflects & front;
        let is_coated = facets & above & (self.clearcoat > 0.0);
        let value = select(facets, main, Vec3::ZERO)
            + Vec3::splat(if is_coated { coated } else { 0.0 })
            + select(above, self.base_value(wo, wi, cos_i), Vec3::ZERO);
        let pdf = if facets { main_pdf } else { 0.0 }
            + if is_coated { coat_pdf } else { 0.0 }
            + if above { lobes.base * wi.z * FRAC_1_PI } else { 0.0 };
        let finite = |x: f32| x.abs() < f32::INFINITY;
        let passes = (front & reflects) | (through > 0.0);
        let counts = (wo.z > 0.0) & (wi.z != 0.0) & passes & (pdf > 0.0) & finite(pdf);
        Scatter { value, pdf }.only(counts & finite(value.x) & finite(value.y) & finite(value.z))
    }

    /// Base and sheen times the cosine; `cos_d` is that between a direction and the normal half way.
    #[inline(always)]
    fn base_value(&self, wo: Vec3, wi: Vec3, cos_d: f32) -> Vec3 {
        let (out, into) = (fifth(wi.z), fifth(wo.z));
        let smooth = (1.0 - 0.5 * into) * (1.0 - 0.5 * out);
        let retro = 2.0 * self.roughness * cos_d * cos_d;
        let back = retro * (out + into + out * into * (retro - 1.0));
        let grazing = 0.5 * retro;
        let fade = |w: f32| 1.0 + (grazing - 1.0) * w;
        let flat = 1.25 * (fade(out) * fade(into) * (1.0 / (wi.z + wo.z) - 0.5) + 0.5);
        let shape = smooth + back;
        let shape = shape + (flat - shape) * self.flatness;
        let base = self.color() * (self.base() * shape * FRAC_1_PI);
        let tint = Vec3::ONE + (self.hue() - Vec3::ONE) * self.sheen_tint;
        (base + tint * (self.sheen * (1.0 - self.metallic) * fifth(cos_d))) * wi.z
    }

    #[inline(always)]
    pub(super) fn sample(&self, wo: Vec3, front: bool, u: [f32; 2], lobe: f32) -> Option<Sampled> {
        let (wi, counts) = self.sample_or_not(wo, front, u, lobe);
        counts.then(|| Sampled::smooth(wi))
    }

    /// A direction, and whether it is one.
    #[inline(always)]
    pub(crate) fn sample_or_not(&self, wo: Vec3, front: bool, u: [f32; 2], lobe: f32) -> (Vec3, bool) {
        // base and coat do not depend on the normal
        let Lobes { base, coat, .. } = self.lobes(front, 0.0);
        let is_base = lobe < base;
        let is_coat = !is_base & (lobe < base + coat);
        let (of_base, is_one) = diffuse::sample_or_not(u);
        let (visible, is_normal) = self.rough().visible_or_not(wo, u);
        let m = select(is_coat, self.coat().sample(u), visible);
        let cos = wo.dot(m);
        let eta = relative(self.eta, front);
        let (r, cos_t) = fresnel(cos, eta);
        let is_bent = !is_base & !is_coat & (lobe < base + coat + self.lobes(front, r).transmit);
        let inv = 1.0 / eta;
        let (mirrored, bent) = (m * (2.0 * cos) - wo, m * (cos * inv - cos_t) - wo * inv);
        let wi = select(is_bent, bent, mirrored);
        let passes = (is_bent & (wi.z < 0.0) & (cos_t > 0.0)) | (!is_bent & (cos > 0.0) & (wi.z > 0.0));
        let of_facet = passes & (is_coat | is_normal);
        let counts = (wo.z > 0.0) & (front | (self.through() > 0.0)) & ((is_base & is_one) | (!is_base & of_facet));
        (select(is_base, of_base, wi / wi.length()), counts)
    }

    /// The number of a slot, where the model has it.
    pub(super) fn number_mut(&mut self, slot: Slot) -> Option<&mut f32> {
        Some(match slot {
            Slot::Roughness => &mut self.roughness,
            Slot::Anisotropic => &mut self.anisotropic,
            Slot::Metallic => &mut self.metallic,
            Slot::SpecTrans => &mut self.spec_trans,
            Slot::SpecTint => &mut self.spec_tint,
            Slot::Sheen => &mut self.sheen,
            Slot::SheenTint => &mut self.sheen_tint,
            Slot::Clearcoat => &mut self.clearcoat,
            Slot::ClearcoatGloss => &mut self.clearcoat_gloss,
            Slot::Flatness => &mut self.flatness,
            _ => return None,
        })
    }
}

/// (1 - cos)^5.
#[inline(always)]
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
    #[inline(always)]
    fn new(alpha: f32) -> Gtr1 {
        let alpha2 = alpha * alpha;
        Gtr1 { alpha2, log: ln(alpha2) }
    }

    #[inline(always)]
    fn density(&self, m: Vec3) -> f32 {
        // 1 + (alpha^2 - 1) cos^2 without cancellation
        let t = m.x * m.x + m.y * m.y + self.alpha2 * (m.z * m.z);
        (self.alpha2 - 1.0) / (PI * self.log * t)
    }

    /// A normal of density `density(m) m.z` in solid angle.
    #[inline(always)]
    fn sample(&self, u: [f32; 2]) -> Vec3 {
        // the square of the sine is (alpha^2(1 - u) - alpha^2) / (1 - alpha^2): its error is a rounding of alpha^2, which is what it is like where it is least
        let sin2 = ((exp_down((1.0 - u[1]) * self.log) - self.alpha2) / (1.0 - self.alpha2)).clamp(0.0, 1.0);
        let (s, c) = sincos_turn(u[0]);
        let sin = sin2.sqrt();
        Vec3::new(sin * c, sin * s, (1.0 - sin2).sqrt())
    }
}
