//! Rough coats and rough metals among the vertices: computed for all where there is one of its kind, taken where it is one.

use glam::Vec3;

use super::{Block, Lanes, N};
use crate::material::{Coat, Distribution, Look, Metal, Scatter};
use crate::math::Basis;
use crate::path::Context;
use crate::path::vertex::{scattered_light, scattered_onwards, select};

/// Calls a method for GGX and for Beckmann's distribution where the block has vertices of that kind.
macro_rules! each {
    ($block:ident . $kind:ident : $method:ident ( $($with:expr),* )) => {
        if $block.kinds.$kind[0] {
            $block.$method::<false>($($with),*);
        }
        if $block.kinds.$kind[1] {
            $block.$method::<true>($($with),*);
        }
    };
}

impl Block {
    /// Notes the model of a vertex.
    #[inline(always)]
    pub(super) fn note_look(&mut self, i: usize, look: &Look) {
        match look {
            Look::Diffuse(reflectance) => self.reflectance.set(i, (*reflectance).into()),
            Look::Coat(coat) => {
                let beckmann = coat.distribution == Distribution::Beckmann;
                (self.is_coat[i], self.is_beckmann[i]) = (true, beckmann);
                self.kinds.coat[usize::from(beckmann)] = true;
                self.alpha[i] = coat.alpha;
                self.eta.0[0][i] = coat.eta;
                self.reflectance.set(i, coat.diffuse.into());
                self.specular.set(i, coat.specular.into());
                self.nonlinear[i] = coat.nonlinear;
                self.internal[i] = coat.internal;
            }
            Look::Metal(metal) => {
                let beckmann = metal.distribution == Distribution::Beckmann;
                (self.is_metal[i], self.is_beckmann[i]) = (true, beckmann);
                self.kinds.metal[usize::from(beckmann)] = true;
                self.alpha[i] = metal.alpha;
                self.eta.set(i, metal.eta.into());
                self.k.set(i, metal.k.into());
                self.specular.set(i, metal.specular.into());
            }
        }
    }

    /// What enters the coats towards where the path came from.
    #[inline(always)]
    pub(super) fn lobes_enter(&mut self, context: &Context) {
        if self.kinds.coat == [false; 2] {
            return;
        }
        let mut cosines = [0.0; N];
        for i in 0..N {
            cosines[i] = self.shading.get(i).dot(-self.d.get(i));
        }
        self.entering = self.shares_of_coats(context, &cosines);
    }

    /// Contributions of the shadow rays.
    #[inline(always)]
    pub(super) fn lobes_towards_lights(&mut self, context: &Context) {
        if self.kinds.coat != [false; 2] {
            for i in 0..N {
                self.leaving[i] = self.shading.get(i).dot(self.shadow_d.get(i));
            }
            self.leaving = self.shares_of_coats(context, &self.leaving);
        }
        each!(self.coat: coats_towards_lights());
        each!(self.metal: metals_towards_lights());
    }

    /// Next directions, before snapping.
    #[inline(always)]
    pub(super) fn lobes_directions(&mut self) {
        each!(self.coat: coats_directions());
        each!(self.metal: metals_directions());
    }

    /// What becomes of paths in their next directions.
    #[inline(always)]
    pub(super) fn lobes_onwards(&mut self, context: &Context) {
        if self.kinds.coat != [false; 2] {
            for i in 0..N {
                self.leaving[i] = self.shading.get(i).dot(self.next_d.get(i));
            }
            self.leaving = self.shares_of_coats(context, &self.leaving);
        }
        each!(self.coat: coats_onwards());
        each!(self.metal: metals_onwards());
    }

    #[inline(always)]
    fn coats_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.coat_scatters::<BECKMANN>(i, self.shadow_d.get(i));
            let yes = self.is_coat[i] & (self.is_beckmann[i] == BECKMANN);
            self.contribution.set(i, select(yes, self.lobe_light(i, scatter), self.contribution.get(i)));
        }
    }

    #[inline(always)]
    fn metals_towards_lights<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.shadow_d.get(i));
            let yes = self.is_metal[i] & (self.is_beckmann[i] == BECKMANN);
            self.contribution.set(i, select(yes, self.lobe_light(i, scatter), self.contribution.get(i)));
        }
    }

    #[inline(always)]
    fn coats_directions<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.coat::<BECKMANN>(i).sample(self.entering[i], wo, u, self.lobe[i]);
            let yes = self.is_coat[i] & (self.is_beckmann[i] == BECKMANN);
            self.take_direction(i, basis.to_world(wi), counts, yes);
        }
    }

    #[inline(always)]
    fn metals_directions<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let basis = Basis::new(self.shading.get(i));
            let (wo, u) = (basis.to_local(-self.d.get(i)), [self.direction[0][i], self.direction[1][i]]);
            let (wi, counts) = self.metal::<BECKMANN>(i).sample(wo, u);
            let yes = self.is_metal[i] & (self.is_beckmann[i] == BECKMANN);
            self.take_direction(i, basis.to_world(wi), counts, yes);
        }
    }

    #[inline(always)]
    fn coats_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.coat_scatters::<BECKMANN>(i, self.next_d.get(i));
            self.take_onwards(i, scatter, self.is_coat[i] & (self.is_beckmann[i] == BECKMANN));
        }
    }

    #[inline(always)]
    fn metals_onwards<const BECKMANN: bool>(&mut self) {
        for i in 0..N {
            let scatter = self.metal_scatters::<BECKMANN>(i, self.next_d.get(i));
            self.take_onwards(i, scatter, self.is_metal[i] & (self.is_beckmann[i] == BECKMANN));
        }
    }

    /// What passes the coats at these cosines; of a table a material, which no vector reads.
    #[inline(always)]
    fn shares_of_coats(&self, context: &Context, cosines: &Lanes) -> Lanes {
        let world = context.world;
        let mut out = [0.0; N];
        for i in 0..self.len {
            if self.is_coat[i] {
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
    fn take_direction(&mut self, i: usize, d: Vec3, counts: bool, yes: bool) {
        self.next_d.set(i, select(yes, d, self.next_d.get(i)));
        self.above[i] = (yes & counts & self.seen[i]) | (!yes & self.above[i]);
    }

    #[inline(always)]
    fn take_onwards(&mut self, i: usize, scatter: Scatter, yes: bool) {
        let (throughput, pdf, fate) = scattered_onwards(
            self.throughput.get(i),
            scatter,
            self.normal.get(i),
            self.next_d.get(i),
            self.above[i],
            self.go_on[i],
            self.roulette[i],
        );
        self.next_throughput.set(i, select(yes, throughput, self.next_throughput.get(i)));
        self.next_pdf[i] = if yes { pdf } else { self.next_pdf[i] };
        self.fate[i] = if yes { fate } else { self.fate[i] };
    }
}

#[inline(always)]
fn distribution(beckmann: bool) -> Distribution {
    if beckmann { Distribution::Beckmann } else { Distribution::Ggx }
}
