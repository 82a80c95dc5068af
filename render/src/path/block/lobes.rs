//! What the models make of the vertices: one kind a block.

use glam::Vec3;

use super::lanes::Lanes;
use super::{Block, N};
use crate::material::{Coat, Distribution, Glass, Kind, Look, Metal, Principled, Scatter, relative};
use crate::math::{Basis, select};
use crate::path::Context;
use crate::path::vertex::{cosine_direction, onwards, scattered_light, scattered_onwards, towards_light};

/// Whether the distribution is Beckmann's.
const GGX: bool = false;
const BECKMANN: bool = true;

impl Block {
    /// Notes the parameters of a vertex, which is of the block's kind.
    #[inline(always)]
    pub(super) fn note_look(&mut self, i: usize, look: &Look) {
        match look {
            Look::Diffuse(reflectance) => self.reflectance.set(i, (*reflectance).into()),
            Look::Coat(coat) => {
                self.alpha[i] = coat.alpha;
                self.eta.0[0][i] = coat.eta;
                self.reflectance.set(i, coat.diffuse.into());
                self.specular.set(i, coat.specular.into());
                self.nonlinear[i] = coat.nonlinear;
                self.internal[i] = coat.internal;
            }
            Look::Metal(metal) => {
                self.alpha[i] = metal.alpha;
                self.eta.set(i, metal.eta.into());
                self.k.set(i, metal.k.into());
                self.specular.set(i, metal.specular.into());
            }
            Look::Glass(glass) => {
                self.alpha[i] = glass.alpha;
                self.eta.0[0][i] = glass.eta;
                self.specular.set(i, glass.reflect.into());
                self.reflectance.set(i, glass.transmit.into());
            }
            Look::Principled(p) => {
                self.reflectance.set(i, p.base_color.into());
                self.eta.0[0][i] = p.eta;
                self.alpha[i] = p.roughness;
                let of = [
                    p.metallic,
                    p.spec_trans,
                    p.spec_tint,
                    p.sheen,
                    p.sheen_tint,
                    p.clearcoat,
                    p.clearcoat_gloss,
                    p.flatness,
                ];
                for (lanes, share) in self.shares.iter_mut().zip(of) {
                    lanes[i] = share;
                }
            }
        }
    }

    /// What enters the coats towards where the path came from.
    #[inline(always)]
    pub(super) fn enter(&mut self, context: &Context) {
        if let Kind::Coat(_) = self.kind {
            let mut cosines = Lanes([0.0; N]);
            for i in 0..N {
                cosines[i] = self.shading.get(i).dot(-self.d.get(i));
            }
            self.entering = self.shares_of_coats(context, &cosines);
        }
    }

    /// Contributions of the shadow rays.
    #[inline(always)]
    pub(super) fn towards_lights(&mut self, context: &Context) {
        if let Kind::Coat(_) = self.kind {
            for i in 0..N {
                self.leaving[i] = self.shading.get(i).dot(self.shadow_d.get(i));
            }
            self.leaving = self.shares_of_coats(context, &self.leaving);
        }
        match self.kind {
            Kind::Diffuse => self.diffuse_towards_lights(),
            Kind::Coat(Distribution::Ggx) => self.coats_towards_lights::<GGX>(),
            Kind::Coat(Distribution::Beckmann) => self.coats_towards_lights::<BECKMANN>(),
            Kind::Metal(Distribution::Ggx) => self.metals_towards_lights::<GGX>(),
            Kind::Metal(Distribution::Beckmann) => self.metals_towards_lights::<BECKMANN>(),
            Kind::Glass(Distribution::Ggx) => self.glass_towards_lights::<GGX>(),
            Kind::Glass(Distribution::Beckmann) => self.glass_towards_lights::<BECKMANN>(),
            Kind::Principled { .. } => self.principled_towards_lights(),
        }
    }

    /// Next directions, before snapping.
    #[inline(always)]
    pub(super) fn directions(&mut self) {
        match self.kind {
            Kind::Diffuse => self.diffuse_directions(),
            Kind::Coat(Distribution::Ggx) => self.coats_directions::<GGX>(),
            Kind::Coat(Distribution::Beckmann) => self.coats_directions::<BECKMANN>(),
            Kind::Metal(Distribution::Ggx) => self.metals_directions::<GGX>(),
            Kind::Metal(Distribution::Beckmann) => self.metals_directions::<BECKMANN>(),
            Kind::Glass(Distribution::Ggx) => self.glass_directions::<GGX>(),
            Kind::Glass(Distribution::Beckmann) => self.glass_directions::<BECKMANN>(),
            Kind::Principled { .. } => self.principled_directions(),
        }
    }

    /// What becomes of paths in their next directions.
    #[inline(always)]
    pub(super) fn onwards(&mut self, context: &Context) {
        if let Kind::Coat(_) = self.kind {
            for i in 0..N {
                self.leaving[i] = self.shading.get(i).dot(self.next_d.get(i));
            }
            self.leaving = self.shares_of_coats(context, &self.leaving);
        }
        match self.kind {
            Kind::Diffuse => self.diffuse_onwards(),
            Kind::Coat(Distribution::Ggx) => self.coats_onwards::<GGX>(),
            Kind::Coat(Distribution::Beckmann) => self.coats_onwards::<BECKMANN>(),
            Kind::Metal(Distribution::Ggx) => self.metals_onwards::<GGX>(),
            Kind::Metal(Distribution::Beckmann) => self.metals_onwards::<BECKMANN>(),
            Kind::Glass(Distribution::Ggx) => self.glass_onwards::<GGX>(),
            Kind::Glass(Distribution::Beckmann) => self.glass_onwards::<BECKMANN>(),
            Kind::Principled { .. } => self.principled_onwards(),
        }
    }

    #[inline(always)]
    fn diffuse_towards_lights(&mut self) {
        for i in 0..N {
            let contribution = towards_light(
                self.throughput.get(i),
                self.reflectance.get(i),
                self.normal.get(i),
                self.shading.get(i),
                self.light_d.get(i),
                self.shadow_d.get(i),
                self.light_pdf[i],
                self.arriving.get(i),
                self.lit[i] & self.seen[i],
            );
            self.contribution.set(i, contribution);
        }
    }

    #[inline(always)]
    fn coats_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.coat_scatters::<BECKMANN>(i, self.shadow_d.get(i));
            self.contribution.set(i, self.lobe_light(i, scatter, self.normal.get(i)));
        }
    }

    #[inline(always)]
    fn metals_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.shadow_d.get(i));
            self.contribution.set(i, self.lobe_light(i, scatter, self.normal.get(i)));
        }
    }

    #[inline(always)]
    fn glass_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(self.shadow_d.get(i)));
            let scatter = self.glass::<BECKMANN>(i).eval(wo, wi);
            let side = self.side(i, wi.z < 0.0);
            self.contribution.set(i, self.lobe_light(i, scatter, side));
        }
    }

    #[inline(always)]
    fn principled_towards_lights(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(self.shadow_d.get(i)));
            let scatter = self.principled(i).eval(wo, wi, self.front[i]);
            let side = self.side(i, wi.z < 0.0);
            self.contribution.set(i, self.lobe_light(i, scatter, side));
        }
    }

    #[inline(always)]
    fn diffuse_directions(&mut self) {
        for i in 0..N {
            let (d, above) = cosine_direction(self.shading.get(i), [self.direction[0][i], self.direction[1][i]]);
            self.next_d.set(i, d);
            self.above[i] = above & self.seen[i];
        }
    }

    #[inline(always)]
    fn coats_directions<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.coat::<BECKMANN>(i).sample(self.entering[i], wo, u, self.lobe[i]);
            self.next_d.set(i, basis.to_world(wi));
            self.above[i] = counts & self.seen[i];
        }
    }

    #[inline(always)]
    fn metals_directions<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.metal::<BECKMANN>(i).sample(wo, u);
            self.next_d.set(i, basis.to_world(wi));
            self.above[i] = counts & self.seen[i];
        }
    }

    #[inline(always)]
    fn glass_directions<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.glass::<BECKMANN>(i).sample(wo, u, self.lobe[i]);
            self.next_d.set(i, basis.to_world(wi));
            (self.above[i], self.next_beyond[i]) = (counts, wi.z < 0.0);
        }
    }

    #[inline(always)]
    fn principled_directions(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.principled(i).sample_or_not(wo, self.front[i], u, self.lobe[i]);
            self.next_d.set(i, basis.to_world(wi));
            (self.above[i], self.next_beyond[i]) = (counts & self.seen[i], wi.z < 0.0);
        }
    }

    #[inline(always)]
    fn diffuse_onwards(&mut self) {
        for i in 0..N {
            let (throughput, pdf, fate) = onwards(
                self.throughput.get(i),
                self.reflectance.get(i),
                self.normal.get(i),
                self.shading.get(i),
                self.next_d.get(i),
                self.above[i],
                self.go_on[i],
                self.roulette[i],
            );
            self.next_throughput.set(i, throughput);
            self.next_pdf[i] = pdf;
            self.fate[i] = fate;
        }
    }

    #[inline(always)]
    fn coats_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.coat_scatters::<BECKMANN>(i, self.next_d.get(i));
            self.take_onwards(i, scatter, self.normal.get(i));
        }
    }

    #[inline(always)]
    fn metals_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.next_d.get(i));
            self.take_onwards(i, scatter, self.normal.get(i));
        }
    }

    #[inline(always)]
    fn glass_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(self.next_d.get(i)));
            let scatter = self.glass::<BECKMANN>(i).eval(wo, wi);
            self.take_onwards(i, scatter, self.side(i, self.next_beyond[i]));
        }
    }

    #[inline(always)]
    fn principled_onwards(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(self.next_d.get(i)));
            let scatter = self.principled(i).eval(wo, wi, self.front[i]);
            self.take_onwards(i, scatter, self.side(i, self.next_beyond[i]));
        }
    }

    /// What passes the coats at these cosines; of a table a material, which no vector reads.
    #[inline(always)]
    fn shares_of_coats(&self, context: &Context, cosines: &Lanes) -> Lanes {
        let world = context.world;
        let mut out = Lanes([0.0; N]);
        for i in 0..self.len {
            if !self.passes[i] {
                let material = &world.materials[world.shapes[self.shape[i] as usize].material as usize];
                out[i] = material.coat().map_or(0.0, |coat| coat.at(cosines[i]));
            }
        }
        out
    }

    /// Of a coat, towards a world direction that its light leaves by.
    #[inline(always)]
    fn coat_scatters<const BECKMANN: bool>(&self, i: usize, d: Vec3) -> Scatter {
        let basis = Basis::new(self.shading.get(i));
        let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(d));
        self.coat::<BECKMANN>(i).eval(self.entering[i], self.leaving[i], wo, wi)
    }

    #[inline(always)]
    fn metal_scatters<const BECKMANN: bool>(&self, i: usize, d: Vec3) -> Scatter {
        let basis = Basis::new(self.shading.get(i));
        let (wo, wi) = (basis.to_local(-self.d.get(i)), basis.to_local(d));
        self.metal::<BECKMANN>(i).eval(wo, wi)
    }

    #[inline(always)]
    fn lobe_light(&self, i: usize, scatter: Scatter, normal: Vec3) -> Vec3 {
        scattered_light(
            self.throughput.get(i),
            scatter,
            normal,
            self.shadow_d.get(i),
            self.light_pdf[i],
            self.arriving.get(i),
            self.lit[i] & self.seen[i],
        )
    }

    #[inline(always)]
    fn coat<const BECKMANN: bool>(&self, i: usize) -> Coat {
        Coat {
            distribution: distribution(BECKMANN),
            alpha: self.alpha[i],
            eta: self.eta.0[0][i],
            diffuse: [self.reflectance.0[0][i], self.reflectance.0[1][i], self.reflectance.0[2][i]],
            specular: [self.specular.0[0][i], self.specular.0[1][i], self.specular.0[2][i]],
            nonlinear: self.nonlinear[i],
            internal: self.internal[i],
        }
    }

    #[inline(always)]
    fn metal<const BECKMANN: bool>(&self, i: usize) -> Metal {
        Metal {
            distribution: distribution(BECKMANN),
            alpha: self.alpha[i],
            eta: [self.eta.0[0][i], self.eta.0[1][i], self.eta.0[2][i]],
            k: [self.k.0[0][i], self.k.0[1][i], self.k.0[2][i]],
            specular: [self.specular.0[0][i], self.specular.0[1][i], self.specular.0[2][i]],
        }
    }

    /// As it is to be seen from where the path is.
    #[inline(always)]
    fn glass<const BECKMANN: bool>(&self, i: usize) -> Glass {
        Glass {
            distribution: distribution(BECKMANN),
            alpha: self.alpha[i],
            eta: relative(self.eta.0[0][i], self.front[i]),
            reflect: [self.specular.0[0][i], self.specular.0[1][i], self.specular.0[2][i]],
            transmit: [self.reflectance.0[0][i], self.reflectance.0[1][i], self.reflectance.0[2][i]],
        }
    }

    #[inline(always)]
    fn principled(&self, i: usize) -> Principled {
        Principled {
            base_color: [self.reflectance.0[0][i], self.reflectance.0[1][i], self.reflectance.0[2][i]],
            eta: self.eta.0[0][i],
            roughness: self.alpha[i],
            anisotropic: 0.0,
            metallic: self.shares[0][i],
            spec_trans: self.shares[1][i],
            spec_tint: self.shares[2][i],
            sheen: self.shares[3][i],
            sheen_tint: self.shares[4][i],
            clearcoat: self.shares[5][i],
            clearcoat_gloss: self.shares[6][i],
            flatness: self.shares[7][i],
        }
    }

    /// The geometric normal on the side of a direction that goes beyond the surface or not.
    #[inline(always)]
    fn side(&self, i: usize, beyond: bool) -> Vec3 {
        let normal = self.normal.get(i);
        select(beyond, -normal, normal)
    }

    #[inline(always)]
    fn take_onwards(&mut self, i: usize, scatter: Scatter, normal: Vec3) {
        let (throughput, pdf, fate) = scattered_onwards(
            self.throughput.get(i),
            scatter,
            normal,
            self.next_d.get(i),
            self.above[i],
            self.go_on[i],
            self.roulette[i],
        );
        self.next_throughput.set(i, throughput);
        self.next_pdf[i] = pdf;
        self.fate[i] = fate;
    }
}

#[inline(always)]
fn distribution(beckmann: bool) -> Distribution {
    if beckmann { Distribution::Beckmann } else { Distribution::Ggx }
}
