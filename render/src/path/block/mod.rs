//! Many vertices at once: triangles that are diffuse, or have lobes that are isotropic, in arrays that the compiler turns into vector code.
//!
//! Vertices are collected by their kind, up to [`N`] of each; then each phase runs over all of them. What a phase does to one vertex is
//! the same inlined code that the plain way runs (`shade::scatter_plain`), so the bits are the same, and a test compares them. What a block
//! cannot take after all passes through, and is shaded the plain way in its turn.

mod emit;
mod lanes;
mod lights;
mod lobes;

use glam::Vec3;

use lanes::{Lanes, Lanes3, units};

use super::interaction::{Flat, smooth};
use super::vertex::{Fate, snap};
use super::{Context, Outcome, wide};
use crate::light::{Choice, Facing};
use crate::material::{Kind, Look};
use crate::math::{UnitDir, offset_origin, select};
use crate::ray::{Hit, PathKey};
use crate::sampler::{BSDF, LIGHT, LIGHT_CHOICE, LOBE, ROULETTE, Streams};
use crate::skip::Skip;
use crate::texture::{At, Spot};

/// Vertices of a block.
pub(super) const N: usize = 32;

/// A block for each kind of vertices that was met.
#[derive(Clone, Debug)]
pub(super) struct Blocks {
    /// Of most vertices of most scenes.
    pub(super) diffuse: Block,
    others: [Option<Box<Block>>; Kind::ALL.len()],
}

impl Default for Blocks {
    fn default() -> Blocks {
        Blocks { diffuse: Block::new(Kind::Diffuse), others: Default::default() }
    }
}

impl Blocks {
    /// That of a kind.
    #[inline(always)]
    pub(super) fn of(&mut self, kind: Kind) -> &mut Block {
        match kind {
            Kind::Diffuse => &mut self.diffuse,
            _ => self.others[kind.number()].get_or_insert_with(|| new(kind)),
        }
    }

    /// Those that there are.
    pub(super) fn all(&mut self) -> impl Iterator<Item = &mut Block> {
        std::iter::once(&mut self.diffuse).chain(self.others.iter_mut().flatten().map(Box::as_mut))
    }
}

#[cold]
fn new(kind: Kind) -> Box<Block> {
    Box::new(Block::new(kind))
}

/// Vertices by component. Lanes beyond `len`, and of vertices that pass through, hold what was there before: computed with, never read.
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// Of all its vertices.
    kind: Kind,
    len: usize,
    index: [u32; N],
    key: [PathKey; N],
    /// To be shaded the plain way.
    passes: [bool; N],
    two_sided: [bool; N],
    throughput: Lanes3,
    p0: Lanes3,
    p1: Lanes3,
    p2: Lanes3,
    u: Lanes,
    v: Lanes,
    d: Lanes3,
    /// Albedo, also of a coat's base.
    reflectance: Lanes3,
    // of shading normals, where there are any
    any_smooth: bool,
    is_smooth: [bool; N],
    n0: Lanes3,
    n1: Lanes3,
    n2: Lanes3,
    // of textures
    any_painted: bool,
    is_painted: [bool; N],
    at: [At; N],
    spot: [Spot; N],
    shape: [u32; N],
    // of lobes
    alpha: Lanes,
    specular: Lanes3,
    eta: Lanes3,
    k: Lanes3,
    nonlinear: [bool; N],
    /// Parameters of the principled model: metallic, spec_trans, spec_tint, sheen, sheen_tint, clearcoat, clearcoat_gloss, flatness.
    shares: [Lanes; 8],
    internal: Lanes,
    entering: Lanes,
    leaving: Lanes,
    lobe: Lanes,
    // of the geometry
    normal: Lanes3,
    shading: Lanes3,
    origin: Lanes3,
    seen: [bool; N],
    /// Where light is chosen for: [`crate::light::Facing`].
    faced: Lanes3,
    least: f32,
    // of what light passes through
    front: [bool; N],
    /// Origin of rays that leave on the other side, and those of the shadow ray and of the next one.
    beyond: Lanes3,
    shadow_o: Lanes3,
    next_o: Lanes3,
    /// Whether the shadow ray does.
    shadow_beyond: [bool; N],
    /// Whether the next ray does.
    next_beyond: [bool; N],
    // numbers
    direction: [Lanes; 2],
    go_on: Lanes,
    place: [Lanes; 2],
    /// The bits that `place` was made from.
    place_bits: [[u32; N]; 2],
    choice: [u32; N],
    chosen: [Option<Choice>; N],
    /// Choices since the last flush of which some lights were left out.
    fewer: u64,
    /// Vertices without a shadow ray since the last flush.
    unlit: u64,
    roulette: [bool; N],
    // of the light chosen
    /// Whether any is a triangle.
    any_triangle: bool,
    light_p0: Lanes3,
    light_e1: Lanes3,
    light_e2: Lanes3,
    light_normal: Lanes3,
    light_area: Lanes,
    light_error: Lanes,
    /// Where it is a sphere, seen from outside.
    is_ball: [bool; N],
    light_center: Lanes3,
    light_radius: Lanes,
    probability: Lanes,
    /// That over the true one.
    worth: Lanes,
    radiance: Lanes3,
    /// Radiance times the worth of the choice and of the place.
    arriving: Lanes3,
    light_d: Lanes3,
    light_tmax: Lanes,
    light_pdf: Lanes,
    lit: [bool; N],
    // results
    shadow_dir: [UnitDir; N],
    shadow_d: Lanes3,
    contribution: Lanes3,
    /// Whether there is a shadow ray.
    casts: [bool; N],
    next_dir: [UnitDir; N],
    next_d: Lanes3,
    above: [bool; N],
    next_throughput: Lanes3,
    next_pdf: Lanes,
    fate: [Fate; N],
}

impl Block {
    /// An empty one.
    pub(super) fn new(kind: Kind) -> Block {
        let lanes = Lanes([0.0; N]);
        Block {
            kind,
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
            any_smooth: false,
            is_smooth: [false; N],
            n0: Lanes3::ZERO,
            n1: Lanes3::ZERO,
            n2: Lanes3::ZERO,
            any_painted: false,
            is_painted: [false; N],
            at: [At::uv([0.0; 2]); N],
            spot: [Spot::default(); N],
            shape: [0; N],
            alpha: lanes,
            specular: Lanes3::ZERO,
            eta: Lanes3::ZERO,
            k: Lanes3::ZERO,
            nonlinear: [false; N],
            shares: [lanes; 8],
            internal: lanes,
            entering: lanes,
            leaving: lanes,
            lobe: lanes,
            normal: Lanes3::ZERO,
            shading: Lanes3::ZERO,
            origin: Lanes3::ZERO,
            seen: [false; N],
            faced: Lanes3::ZERO,
            least: 0.0,
            front: [false; N],
            beyond: Lanes3::ZERO,
            shadow_o: Lanes3::ZERO,
            next_o: Lanes3::ZERO,
            shadow_beyond: [false; N],
            next_beyond: [false; N],
            direction: [lanes; 2],
            go_on: lanes,
            place: [lanes; 2],
            place_bits: [[0; N]; 2],
            choice: [0; N],
            chosen: [None; N],
            fewer: 0,
            unlit: 0,
            roulette: [false; N],
            any_triangle: false,
            light_p0: Lanes3::ZERO,
            light_e1: Lanes3::ZERO,
            light_e2: Lanes3::ZERO,
            light_normal: Lanes3::ZERO,
            light_area: lanes,
            light_error: lanes,
            is_ball: [false; N],
            light_center: Lanes3::ZERO,
            light_radius: lanes,
            probability: lanes,
            worth: lanes,
            radiance: Lanes3::ZERO,
            arriving: Lanes3::ZERO,
            light_d: Lanes3::ZERO,
            light_tmax: lanes,
            light_pdf: lanes,
            lit: [false; N],
            shadow_dir: [UnitDir::default(); N],
            shadow_d: Lanes3::ZERO,
            contribution: Lanes3::ZERO,
            casts: [false; N],
            next_dir: [UnitDir::default(); N],
            next_d: Lanes3::ZERO,
            above: [false; N],
            next_throughput: Lanes3::ZERO,
            next_pdf: lanes,
            fate: [Fate::Absorbed; N],
        }
    }
}

impl Block {
    /// Adds a vertex of the ray at `index` of the batch, with a sibling's key and throughput. It passes through unless it is given a triangle.
    #[inline(always)]
    pub(super) fn push(&mut self, index: u32, key: PathKey, throughput: Vec3) {
        debug_assert!(self.len < N, "a full block is flushed first");
        let i = self.len & (N - 1);
        self.index[i] = index;
        self.key[i] = key;
        self.throughput.set(i, throughput);
        self.passes[i] = true;
        (self.is_smooth[i], self.is_painted[i]) = (false, false);
        self.len += 1;
    }

    /// Whether it must be flushed before the next.
    #[inline(always)]
    pub(super) fn is_full(&self) -> bool {
        self.len == N
    }

    /// The last vertex. The mask changes nothing, and tells the compiler that there is a place.
    #[inline(always)]
    fn last(&self) -> usize {
        debug_assert!(self.len > 0, "a vertex is pushed first");
        self.len.wrapping_sub(1) & (N - 1)
    }

    /// The last vertex lies on a triangle, hit along `d`.
    #[inline(always)]
    pub(super) fn set_triangle(&mut self, vertices: &[[f32; 3]; 3], hit: &Hit, d: [f32; 3], two_sided: bool) {
        let i = self.last();
        self.passes[i] = false;
        self.p0.set(i, vertices[0].into());
        self.p1.set(i, vertices[1].into());
        self.p2.set(i, vertices[2].into());
        (self.u[i], self.v[i]) = (hit.u, hit.v);
        self.d.set(i, d.into());
        self.two_sided[i] = two_sided;
    }

    /// With shading normals.
    #[inline(always)]
    pub(super) fn set_normals(&mut self, [n0, n1, n2]: &[[f32; 3]; 3]) {
        let i = self.last();
        (self.is_smooth[i], self.any_smooth) = (true, true);
        self.n0.set(i, Vec3::from(*n0));
        self.n1.set(i, Vec3::from(*n1));
        self.n2.set(i, Vec3::from(*n2));
    }

    /// It is diffuse, the same everywhere.
    #[inline(always)]
    pub(super) fn set_albedo(&mut self, albedo: [f32; 3]) {
        self.reflectance.set(self.last(), albedo.into());
    }

    /// It looks the same everywhere on its shape.
    #[inline(always)]
    pub(super) fn set_look(&mut self, shape: u32, look: &Look) {
        let i = self.last();
        self.shape[i] = shape;
        self.note_look(i, look);
    }

    /// It looks as textures say at a place, whose texels were asked for: they are read when the block is full. `first`: those of its first texture.
    #[inline(always)]
    pub(super) fn set_place(&mut self, shape: u32, at: At, first: Spot) {
        let i = self.last();
        (self.is_painted[i], self.any_painted) = (true, true);
        (self.shape[i], self.at[i], self.spot[i]) = (shape, at, first);
    }

    /// Scatters all vertices and appends what comes of them to `out` in order; `plain` does those that pass through, by index, key and
    /// throughput.
    pub(super) fn flush(
        &mut self,
        context: &Context,
        out: &mut Outcome,
        plain: impl FnMut(usize, PathKey, Vec3, &mut Outcome),
    ) {
        // a few vertices are done sooner one by one
        let few = self.len < 4;
        if few {
            self.passes = [true; N];
        } else {
            if self.any_painted {
                self.paint(context);
            }
            wide::compute(self, context);
        }
        out.counters.chosen_of_fewer += std::mem::take(&mut self.fewer);
        out.counters.unlit += std::mem::take(&mut self.unlit);
        if self.passes[..self.len].contains(&true) {
            self.emit_mixed(out, plain);
        } else {
            self.emit(out);
        }
        (self.len, self.any_smooth, self.any_painted) = (0, false, false);
    }

    /// Reads the textures.
    fn paint(&mut self, context: &Context) {
        let world = context.world;
        for i in 0..self.len {
            if self.is_painted[i] && !self.passes[i] {
                let material = &world.materials[world.shapes[self.shape[i] as usize].material as usize];
                match material.look(&world.textures, context.textures, self.at[i], &self.spot[i]) {
                    Some(look) => self.note_look(i, &look),
                    None => self.passes[i] = true,
                }
            }
        }
    }

    /// All phases but the last; inlined into each of their compilations.
    #[inline(always)]
    pub(super) fn phases(&mut self, context: &Context) {
        self.geometry();
        self.enter(context);
        self.numbers(context);
        self.lights(context);
        if self.kind.transmits() {
            self.lights_beyond(context);
        }
        let skips_unlit = context.skips.makes(Skip::Shadows);
        self.shadow_rays(context, !skips_unlit);
        if skips_unlit {
            self.count_unlit();
        }
        self.next_rays(context);
        self.origins();
    }

    /// Where rays begin.
    #[inline(always)]
    fn origins(&mut self) {
        (self.shadow_o, self.next_o) = (self.origin, self.origin);
        if self.kind.transmits() {
            for i in 0..N {
                let (origin, beyond) = (self.origin.get(i), self.beyond.get(i));
                self.shadow_o.set(i, select(self.shadow_beyond[i], beyond, origin));
                self.next_o.set(i, select(self.next_beyond[i], beyond, origin));
            }
        }
    }

    #[inline(always)]
    fn geometry(&mut self) {
        for i in 0..N {
            let flat = Flat::new(self.p0.get(i), self.p1.get(i), self.p2.get(i), self.u[i], self.v[i], self.d.get(i));
            self.normal.set(i, flat.normal);
            self.origin.set(i, offset_origin(&flat.position, flat.normal));
            self.seen[i] = flat.from_front | self.two_sided[i];
            self.passes[i] |= !flat.sound;
        }
        if self.kind.has_sides() {
            self.both_sides();
        }
        self.shading = self.normal;
        if self.any_smooth {
            for i in 0..N {
                let (normal, d) = (self.normal.get(i), self.d.get(i));
                let normals = [self.n0.get(i), self.n1.get(i), self.n2.get(i)];
                let shading = smooth(normals, self.u[i], self.v[i], normal, d);
                self.shading.set(i, select(self.is_smooth[i], shading, normal));
            }
        }
        let lit_from = if self.kind.transmits() { Facing::ANY } else { Facing::front(Vec3::ZERO) };
        self.least = lit_from.least;
        self.faced = if self.kind.transmits() { Lanes3::ZERO } else { self.shading };
    }

    /// Of surfaces whose sides differ.
    #[inline(always)]
    fn both_sides(&mut self) {
        let through = self.kind.transmits();
        for i in 0..N {
            let flat = Flat::new(self.p0.get(i), self.p1.get(i), self.p2.get(i), self.u[i], self.v[i], self.d.get(i));
            self.beyond.set(i, offset_origin(&flat.position, -flat.normal));
            self.front[i] = flat.from_front;
            self.seen[i] |= through;
        }
    }

    /// What light is chosen for.
    #[inline(always)]
    fn facing(&self, i: usize) -> Facing {
        Facing { normal: self.faced.get(i), least: self.least }
    }

    #[inline(always)]
    fn numbers(&mut self, context: &Context) {
        let frame = context.frame;
        let mut streams = Streams::new(frame.seed);
        const DIMENSIONS: [usize; 6] = [BSDF, BSDF + 1, LIGHT, LIGHT + 1, ROULETTE, LOBE];
        let mut raw = [[0; N]; 6];
        for i in 0..self.len {
            let key = self.key[i];
            let vertex = u32::from(key.vertex) + 1;
            let stream = streams.get(key.pixel, key.sample);
            let numbers = stream.vertex(vertex, frame.split, u32::from(key.branch));
            for (lanes, k) in raw.iter_mut().zip(DIMENSIONS) {
                lanes[i] = numbers[k];
            }
            self.choice[i] = numbers[LIGHT_CHOICE];
            self.roulette[i] = vertex >= frame.rr_depth;
        }
        // written out: a loop over these would be compiled for one number at a time
        units(&mut self.direction[0], &raw[0]);
        units(&mut self.direction[1], &raw[1]);
        units(&mut self.place[0], &raw[2]);
        units(&mut self.place[1], &raw[3]);
        units(&mut self.go_on, &raw[4]);
        units(&mut self.lobe, &raw[5]);
        self.place_bits = [raw[2], raw[3]];
    }

    // one loop for what is done in f64, one for the rest: a loop's vectors are as wide as its widest type allows

    /// `sends`: also where they bring nothing.
    #[inline(always)]
    fn shadow_rays(&mut self, context: &Context, sends: bool) {
        for i in 0..N {
            let (dir, d) = snap(self.light_d.get(i));
            self.shadow_dir[i] = dir;
            self.shadow_d.set(i, d);
        }
        self.towards_lights(context);
        for i in 0..N {
            let contribution = self.contribution.get(i);
            let brings = (contribution.x != 0.0) | (contribution.y != 0.0) | (contribution.z != 0.0);
            self.casts[i] = brings | (sends & self.lit[i] & self.seen[i]);
        }
    }

    #[inline(always)]
    fn next_rays(&mut self, context: &Context) {
        self.directions();
        for i in 0..N {
            let (dir, d) = snap(self.next_d.get(i));
            self.next_dir[i] = dir;
            self.next_d.set(i, d);
        }
        self.onwards(context);
    }

    /// Counts the vertices without a shadow ray; those that pass are counted where they are shaded.
    #[inline(always)]
    fn count_unlit(&mut self) {
        let mut unlit = 0u32;
        for i in 0..N {
            unlit += u32::from((i < self.len) & self.seen[i] & !self.casts[i] & !self.passes[i]);
        }
        self.unlit = u64::from(unlit);
    }
}
