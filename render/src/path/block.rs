//! Many vertices at once: flat diffuse triangles, which most vertices are, in arrays that the compiler turns into vector code.
//!
//! Vertices are collected in the order of their rays, up to [`N`]; then each phase runs over all of them. What a phase does to one vertex is
//! the same inlined code that the plain way runs (`shade::scatter_plain`), so the bits are the same, and a test compares them. Other
//! surfaces pass through and are shaded the plain way in their turn, so that the order of what comes out is that of the rays.

use glam::Vec3;

use super::diffuse::{Fate, onwards, towards_light};
use super::interaction::Flat;
use super::{Context, Outcome, PathRay, ShadowRay, wide};
use crate::light::TriangleLight;
use crate::math::{UnitDir, offset_origin, unit};
use crate::ray::{PathKey, Ray};
use crate::sampler::{BSDF, LIGHT, LIGHT_CHOICE, ROULETTE, Streams};

/// Vertices of a block.
pub(super) const N: usize = 32;

type Lanes = [f32; N];

/// `N` vectors, by component.
#[derive(Clone, Copy, Debug)]
struct Lanes3([Lanes; 3]);

impl Lanes3 {
    const ZERO: Lanes3 = Lanes3([[0.0; N]; 3]);

    #[inline(always)]
    fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.0[0][i], self.0[1][i], self.0[2][i])
    }
    #[inline(always)]
    fn set(&mut self, i: usize, v: Vec3) {
        self.0[0][i] = v.x;
        self.0[1][i] = v.y;
        self.0[2][i] = v.z;
    }
}

/// One vertex of a path, before scattering.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vertex {
    /// The ray's place in the batch.
    pub index: u32,
    /// Key of the ray, with the number of the sibling.
    pub key: PathKey,
    /// Throughput, a sibling's share.
    pub throughput: Vec3,
    /// The surface, when it is a flat diffuse triangle.
    pub flat: Option<FlatDiffuse>,
}

/// A hit of a diffuse triangle without shading normals.
#[derive(Clone, Copy, Debug)]
pub(super) struct FlatDiffuse {
    pub vertices: [[f32; 3]; 3],
    pub u: f32,
    pub v: f32,
    pub d: Vec3,
    pub reflectance: Vec3,
    pub two_sided: bool,
}

/// Vertices by component. Lanes beyond `len`, and of vertices that pass through, hold what was there before: computed with, never read.
#[derive(Clone, Debug)]
pub(super) struct Block {
    len: usize,
    index: [u32; N],
    key: [PathKey; N],
    passes: [bool; N],
    two_sided: [bool; N],
    throughput: Lanes3,
    p0: Lanes3,
    p1: Lanes3,
    p2: Lanes3,
    u: Lanes,
    v: Lanes,
    d: Lanes3,
    reflectance: Lanes3,
    // of the geometry
    normal: Lanes3,
    origin: Lanes3,
    from_front: [bool; N],
    sound: [bool; N],
    // numbers
    direction: [Lanes; 2],
    go_on: Lanes,
    place: [Lanes; 2],
    choice: [u32; N],
    roulette: [bool; N],
    // of the light chosen
    light_p0: Lanes3,
    light_e1: Lanes3,
    light_e2: Lanes3,
    light_normal: Lanes3,
    light_area: Lanes,
    light_error: Lanes,
    probability: Lanes,
    radiance: Lanes3,
    light_d: Lanes3,
    light_tmax: Lanes,
    light_pdf: Lanes,
    lit: [bool; N],
    // results
    shadow_dir: [UnitDir; N],
    shadow_d: Lanes3,
    contribution: Lanes3,
    next_dir: [UnitDir; N],
    next_d: Lanes3,
    next_throughput: Lanes3,
    next_pdf: Lanes,
    fate: [Fate; N],
}

impl Default for Block {
    fn default() -> Block {
        let lanes = [0.0; N];
        Block {
            len: 0,
            index: [0; N],
            key: [PathKey { pixel: 0, sample: 0, branch: 0, vertex: 0 }; N],
            passes: [false; N],
            two_sided: [false; N],
            throughput: Lanes3::ZERO,
            p0: Lanes3::ZERO,
            p1: Lanes3::ZERO,
            p2: Lanes3::ZERO,
            u: lanes,
            v: lanes,
            d: Lanes3::ZERO,
            reflectance: Lanes3::ZERO,
            normal: Lanes3::ZERO,
            origin: Lanes3::ZERO,
            from_front: [false; N],
            sound: [false; N],
            direction: [lanes; 2],
            go_on: lanes,
            place: [lanes; 2],
            choice: [0; N],
            roulette: [false; N],
            light_p0: Lanes3::ZERO,
            light_e1: Lanes3::ZERO,
            light_e2: Lanes3::ZERO,
            light_normal: Lanes3::ZERO,
            light_area: lanes,
            light_error: lanes,
            probability: lanes,
            radiance: Lanes3::ZERO,
            light_d: Lanes3::ZERO,
            light_tmax: lanes,
            light_pdf: lanes,
            lit: [false; N],
            shadow_dir: [UnitDir::default(); N],
            shadow_d: Lanes3::ZERO,
            contribution: Lanes3::ZERO,
            next_dir: [UnitDir::default(); N],
            next_d: Lanes3::ZERO,
            next_throughput: Lanes3::ZERO,
            next_pdf: lanes,
            fate: [Fate::Absorbed; N],
        }
    }
}

impl Block {
    /// Adds a vertex; true when the block is full and must be flushed.
    #[inline(always)]
    pub(super) fn push(&mut self, vertex: Vertex) -> bool {
        let i = self.len;
        self.index[i] = vertex.index;
        self.key[i] = vertex.key;
        self.throughput.set(i, vertex.throughput);
        self.passes[i] = vertex.flat.is_none();
        if let Some(flat) = &vertex.flat {
            self.p0.set(i, flat.vertices[0].into());
            self.p1.set(i, flat.vertices[1].into());
            self.p2.set(i, flat.vertices[2].into());
            self.u[i] = flat.u;
            self.v[i] = flat.v;
            self.d.set(i, flat.d);
            self.reflectance.set(i, flat.reflectance);
            self.two_sided[i] = flat.two_sided;
        }
        self.len += 1;
        self.len == N
    }

    /// Scatters all vertices and appends what comes of them to `out` in order; `plain` does those that pass through.
    pub(super) fn flush(&mut self, context: &Context, out: &mut Outcome, plain: impl FnMut(Vertex, &mut Outcome)) {
        // a few vertices are done sooner one by one
        let few = self.len < 4;
        if !few {
            wide::compute(self, context);
        }
        self.emit(few, out, plain);
        self.len = 0;
    }

    /// All phases but the last; inlined into each of their compilations.
    #[inline(always)]
    pub(super) fn phases(&mut self, context: &Context) {
        self.geometry();
        self.numbers(context);
        self.choose_lights(context);
        self.sample_lights();
        self.other_lights(context);
        self.shadow_rays();
        self.next_rays(context.frame.split as f32);
    }

    #[inline(always)]
    fn geometry(&mut self) {
        for i in 0..N {
            let flat = Flat::new(self.p0.get(i), self.p1.get(i), self.p2.get(i), self.u[i], self.v[i], self.d.get(i));
            self.normal.set(i, flat.normal);
            self.origin.set(i, offset_origin(&flat.position, flat.normal));
            self.from_front[i] = flat.from_front;
            self.sound[i] = flat.sound;
        }
    }

    #[inline(always)]
    fn numbers(&mut self, context: &Context) {
        let frame = context.frame;
        let mut streams = Streams::new(frame.seed);
        for i in 0..self.len {
            let key = self.key[i];
            let vertex = u32::from(key.vertex) + 1;
            let stream = streams.get(key.pixel, key.sample);
            let numbers = stream.vertex(vertex, frame.split, u32::from(key.branch));
            self.direction[0][i] = unit(numbers[BSDF]);
            self.direction[1][i] = unit(numbers[BSDF + 1]);
            self.place[0][i] = unit(numbers[LIGHT]);
            self.place[1][i] = unit(numbers[LIGHT + 1]);
            self.choice[i] = numbers[LIGHT_CHOICE];
            self.go_on[i] = unit(numbers[ROULETTE]);
            self.roulette[i] = vertex >= frame.rr_depth;
        }
    }

    #[inline(always)]
    fn choose_lights(&mut self, context: &Context) {
        for i in 0..self.len {
            let Some((Some(triangle), radiance, probability)) = context.lights.chosen(self.choice[i]) else {
                continue;
            };
            self.light_p0.set(i, triangle.p0);
            self.light_e1.set(i, triangle.e1);
            self.light_e2.set(i, triangle.e2);
            self.light_normal.set(i, triangle.normal);
            self.light_area[i] = triangle.area;
            self.light_error[i] = triangle.error;
            self.radiance.set(i, radiance);
            self.probability[i] = probability;
        }
    }

    #[inline(always)]
    fn sample_lights(&mut self) {
        for i in 0..N {
            let light = TriangleLight {
                p0: self.light_p0.get(i),
                e1: self.light_e1.get(i),
                e2: self.light_e2.get(i),
                normal: self.light_normal.get(i),
                area: self.light_area[i],
                error: self.light_error[i],
            };
            let (d, tmax, pdf, ok) = light.sample_or_not(self.origin.get(i), [self.place[0][i], self.place[1][i]]);
            self.light_d.set(i, d);
            self.light_tmax[i] = tmax;
            self.light_pdf[i] = pdf * self.probability[i];
            self.lit[i] = ok;
        }
    }

    /// Sources that are no triangles, one by one.
    #[inline(always)]
    fn other_lights(&mut self, context: &Context) {
        if context.lights.only_triangles() {
            return;
        }
        for i in 0..self.len {
            if matches!(context.lights.chosen(self.choice[i]), Some((Some(_), ..))) {
                continue;
            }
            let place = [self.place[0][i], self.place[1][i]];
            let light = context.lights.sample(self.origin.get(i), self.choice[i], place);
            self.lit[i] = light.is_some();
            if let Some(light) = light {
                self.light_d.set(i, light.d);
                self.light_tmax[i] = light.tmax;
                self.light_pdf[i] = light.pdf;
                self.radiance.set(i, light.radiance);
            }
        }
    }

    #[inline(always)]
    fn shadow_rays(&mut self) {
        for i in 0..N {
            let (dir, d, contribution) = towards_light(
                self.throughput.get(i),
                self.reflectance.get(i),
                self.normal.get(i),
                self.light_d.get(i),
                self.light_pdf[i],
                self.radiance.get(i),
                self.lit[i],
            );
            self.shadow_dir[i] = dir;
            self.shadow_d.set(i, d);
            self.contribution.set(i, contribution);
        }
    }

    #[inline(always)]
    fn next_rays(&mut self, siblings: f32) {
        for i in 0..N {
            let (dir, d, throughput, pdf, fate) = onwards(
                self.throughput.get(i),
                self.reflectance.get(i),
                self.normal.get(i),
                [self.direction[0][i], self.direction[1][i]],
                self.go_on[i],
                self.roulette[i],
                siblings,
            );
            self.next_dir[i] = dir;
            self.next_d.set(i, d);
            self.next_throughput.set(i, throughput);
            self.next_pdf[i] = pdf;
            self.fate[i] = fate;
        }
    }

    #[inline(always)]
    fn emit(&mut self, few: bool, out: &mut Outcome, mut plain: impl FnMut(Vertex, &mut Outcome)) {
        for i in 0..self.len {
            let key = self.key[i];
            if few || self.passes[i] || !self.sound[i] {
                let throughput = self.throughput.get(i);
                plain(Vertex { index: self.index[i], key, throughput, flat: None }, out);
                continue;
            }
            if !(self.from_front[i] || self.two_sided[i]) {
                out.counters.absorbed += 1;
                continue;
            }
            let o = self.origin.get(i).to_array();
            let contribution = self.contribution.get(i);
            if contribution != Vec3::ZERO {
                let (dir, tmax) = (self.shadow_dir[i], self.light_tmax[i]);
                out.shadow.push(ShadowRay { o, dir, tmax, contribution: contribution.to_array(), key });
                out.shadow_rays.push(Ray { o, tmin: 0.0, d: self.shadow_d.get(i).to_array(), tmax });
            }
            match self.fate[i] {
                Fate::On => {
                    out.next.push(PathRay {
                        o,
                        dir: self.next_dir[i],
                        key: PathKey { vertex: key.vertex + 1, ..key },
                        throughput: self.next_throughput.get(i).to_array(),
                        pdf: self.next_pdf[i],
                    });
                    out.next_rays.push(Ray { o, tmin: 0.0, d: self.next_d.get(i).to_array(), tmax: f32::INFINITY });
                }
                Fate::Absorbed => out.counters.absorbed += 1,
                Fate::Roulette => out.counters.roulette += 1,
            }
        }
    }
}
