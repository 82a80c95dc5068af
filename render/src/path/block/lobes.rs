//! What the models make of the vertices: one kind a block.

use glam::Vec3;

use super::{Block, Lanes, N};
use crate::material::{Coat, Distribution, Kind, Look, Metal, Scatter};
use crate::math::Basis;
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
        }
    }

    /// What enters the coats towards where the path came from.
    #[inline(always)]
    pub(super) fn enter(&mut self, context: &Context) {
        if let Kind::Coat(_) = self.kind {
            let mut cosines = [0.0; N];
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
            self.contribution.set(i, self.lobe_light(i, scatter));
        }
    }

    #[inline(always)]
    fn metals_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.shadow_d.get(i));
            self.contribution.set(i, self.lobe_light(i, scatter));
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
            self.take_onwards(i, scatter);
        }
    }

    #[inline(always)]
    fn metals_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.next_d.get(i));
            self.take_onwards(i, scatter);
        }
    }

    /// What passes the coats at these cosines; of a table a material, which no vector reads.
    #[inline(always)]
    fn shares_of_coats(&self, context: &Context, cosines: &Lanes) -> Lanes {
        let world = context.world;
        let mut out = [0.0; N];
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
    fn lobe_light(&self, i: usize, scatter: Scatter) -> Vec3 {
        scattered_light(
            self.throughput.get(i),
            scatter,
            self.normal.get(i),
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

    #[inline(always)]
    fn take_onwards(&mut self, i: usize, scatter: Scatter) {
        let (throughput, pdf, fate) = scattered_onwards(
            self.throughput.get(i),
            scatter,
            self.normal.get(i),
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
