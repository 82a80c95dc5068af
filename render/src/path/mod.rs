//! One step of a batch of paths: hits in; contributions, shadow rays and next rays out.
//!
//! Unidirectional path tracing with next-event estimation and multiple importance sampling (power heuristic), Russian roulette by
//! throughput, and splitting at the first hit. What a ray becomes is a function of (frame, world, ray, hit) alone: neither the batch it is
//! in nor its neighbours matter.

#[cfg(not(feature = "double"))]
mod aov;
#[cfg(not(feature = "double"))]
mod block;
mod interaction;
#[cfg(not(feature = "double"))]
mod primary;
#[cfg(not(feature = "double"))]
pub mod reference;
mod shade;
#[cfg(test)]
mod tests;
mod vertex;
#[cfg(not(feature = "double"))]
mod wide;

use bytemuck::{Pod, Zeroable};

use crate::frame::Frame;
use crate::light::{LightSample, Lights};
use crate::math::UnitDir;
use crate::ray::{Hit, PathKey, PrimId, Ray};
use crate::real::{Vec3, f32};
use crate::sampler::Stream;
use crate::skip::{Skip, SkipCounts, Skips};
use crate::texture::{NoTextures, Textures};
use crate::world::{Primitive, World};

#[cfg(not(feature = "double"))]
pub use aov::take_aovs;
#[cfg(not(feature = "double"))]
pub use primary::camera_rays;
#[cfg(feature = "double")]
pub use shade::shade_plain as shade;
#[cfg(not(feature = "double"))]
pub use shade::{shade, shade_traced};

/// A ray looking for the nearest hit, with what its path needs to go on. 48 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(not(feature = "double"), derive(Pod, Zeroable))]
pub struct PathRay {
    /// Origin, in recentred coordinates, already off the surface it left.
    pub o: [f32; 3],
    /// Direction.
    pub dir: UnitDir,
    /// Which path, which vertex.
    pub key: PathKey,
    /// What radiance found along this ray counts for in the picture.
    pub throughput: [f32; 3],
    /// Density in solid angle with which the BSDF gave this direction; 0 for a camera ray or a mirror, which nothing else samples.
    pub pdf: f32,
}

/// A ray that only asks whether something is in the way. 48 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(not(feature = "double"), derive(Pod, Zeroable))]
pub struct ShadowRay {
    /// Origin, in recentred coordinates, already off the surface it left.
    pub o: [f32; 3],
    /// Direction, of unit length.
    pub dir: UnitDir,
    /// Hits beyond do not count.
    pub tmax: f32,
    /// What to add to the picture when nothing is in the way.
    pub contribution: [f32; 3],
    /// Which path; `vertex` is that of the ray that hit the surface this one leaves.
    pub key: PathKey,
}

impl PathRay {
    /// For the kernel.
    #[inline(always)]
    pub fn ray(&self) -> Ray {
        Ray { o: self.o, tmin: 0.0, d: self.dir.decode(), tmax: f32::INFINITY }
    }
}

impl ShadowRay {
    /// For the kernel.
    #[inline(always)]
    pub fn ray(&self) -> Ray {
        Ray { o: self.o, tmin: 0.0, d: self.dir.decode(), tmax: self.tmax }
    }

    /// What to add to the film when nothing is in the way.
    #[inline(always)]
    pub fn light(&self) -> Contribution {
        Contribution { pixel: self.key.pixel, sample: self.key.sample, value: self.contribution }
    }
}

/// Light for the film.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Contribution {
    /// y * width + x.
    pub pixel: u32,
    /// Index of the sample.
    pub sample: u32,
    /// Radiance times throughput.
    pub value: [f32; 3],
}

/// The primitive that was hit, with its attributes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Where it is.
    pub geometry: Primitive,
    /// Shading normals of a triangle's vertices; all zero for none.
    pub normals: Option<[[f32; 3]; 3]>,
    /// Texture coordinates of a triangle's vertices.
    pub uv: Option<[[f32; 2]; 3]>,
    /// The mesh's attribute at a triangle's vertices.
    pub attribute: Option<[[f32; 3]; 3]>,
}

/// Where hits get their surfaces from: the splits in memory.
pub trait Surfaces {
    /// The shape of the hit (never a miss) of ray `index` of the batch.
    fn shape(&self, index: usize, hit: &Hit) -> u32;
    /// Its surface. To be inlined: callers use parts of it.
    fn surface(&self, index: usize, hit: &Hit) -> Surface;
    /// Whether surfaces lie in memory that is far: then [`Surfaces::foresee`] pays.
    fn is_far(&self) -> bool {
        false
    }
    /// Asks for what [`Surfaces::surface`] of a hit will read.
    fn foresee(&self, _: &Hit) {}
    /// The global id of what ray `index` hit: asked for where light is met only.
    fn prim(&self, index: usize, hit: &Hit) -> PrimId;
}

/// What every path shares.
#[derive(Clone, Copy, Debug)]
pub struct Context<'a> {
    /// Materials, shapes, sky.
    pub world: &'a World,
    /// The world's sources.
    pub lights: &'a Lights,
    /// The picture.
    pub frame: &'a Frame,
    /// Tiles of the world's textures.
    pub textures: &'a dyn Textures,
    /// What is left out.
    pub skips: Skips,
}

impl<'a> Context<'a> {
    /// Of a world without bitmaps, every skip made.
    pub fn new(world: &'a World, lights: &'a Lights, frame: &'a Frame) -> Self {
        Context { world, lights, frame, textures: &NoTextures, skips: Skips::ALL }
    }

    /// Radiance of a light sample.
    #[inline(always)]
    fn radiance(&self, light: &LightSample) -> Vec3 {
        match light.look {
            None => light.radiance,
            Some((texture, at)) => light.radiance * self.world.textures[texture as usize].light(self.textures, at),
        }
    }

    /// With tiles.
    pub fn with(self, textures: &'a dyn Textures) -> Self {
        Context { textures, ..self }
    }

    /// With these skips; the lights must have been made for them.
    pub fn skipping(self, skips: Skips) -> Self {
        Context { skips, ..self }
    }
}

/// What a batch became. Vectors are appended to, in an order that depends on nothing but the batch: vertices of one kind together, as far as they are
/// shaded together. Clear and use again.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// For the film.
    pub light: Vec<Contribution>,
    /// To be traced until anything is hit.
    pub shadow: Vec<ShadowRay>,
    /// The same for the kernel: `shadow[i].ray()`, which shading has at hand.
    pub shadow_rays: Vec<Ray>,
    /// To be traced to the nearest hit.
    pub next: Vec<PathRay>,
    /// The same for the kernel: `next[i].ray()`.
    pub next_rays: Vec<Ray>,
    /// What happened.
    pub counters: Counters,
    /// Memory that `shade` keeps between calls.
    #[cfg(not(feature = "double"))]
    blocks: Option<Box<block::Blocks>>,
    #[cfg(not(feature = "double"))]
    rays: Vec<Ray>,
}

impl Outcome {
    /// Empties the vectors and keeps their memory and the counters.
    pub fn clear(&mut self) {
        self.light.clear();
        self.shadow.clear();
        self.shadow_rays.clear();
        self.next.clear();
        self.next_rays.clear();
    }
}

/// Counts of what happened to rays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Rays shaded.
    pub shaded: u64,
    /// Of them, those that left the scene.
    pub missed: u64,
    /// Paths ended by Russian roulette.
    pub roulette: u64,
    /// Paths ended at the largest depth.
    pub depth: u64,
    /// Paths ended because nothing is reflected: black, the back of a one-sided surface, a direction below the surface.
    pub absorbed: u64,
    /// Vertices that cast no shadow ray, as it would have brought nothing.
    pub unlit: u64,
    /// Choices of a light of which some were left out, as they cannot shine there.
    pub chosen_of_fewer: u64,
    /// Vertices that scatter to single directions only, for which no light was chosen.
    pub lightless: u64,
    /// Hits of materials that have nothing beside their model.
    pub bare: u64,
    /// Rays that left the scene where no sky was looked up.
    pub skyless: u64,
}

impl Counters {
    /// Adds another's counts.
    pub fn add(&mut self, other: &Counters) {
        self.shaded += other.shaded;
        self.missed += other.missed;
        self.roulette += other.roulette;
        self.depth += other.depth;
        self.absorbed += other.absorbed;
        self.unlit += other.unlit;
        self.chosen_of_fewer += other.chosen_of_fewer;
        self.lightless += other.lightless;
        self.bare += other.bare;
        self.skyless += other.skyless;
    }

    /// Of them, what was left out.
    pub fn skips(&self) -> SkipCounts {
        let mut out = SkipCounts::default();
        for (skip, times) in [
            (Skip::Roulette, self.roulette),
            (Skip::Shadows, self.unlit),
            (Skip::Lights, self.chosen_of_fewer),
            (Skip::Lobes, self.lightless),
            (Skip::Details, self.bare),
            (Skip::Sky, self.skyless),
        ] {
            out.add(skip, times);
        }
        out
    }
}

/// The camera ray of a sample (below 2^24) of pixel `y * width + x`.
#[inline]
pub fn camera_ray(frame: &Frame, pixel: u32, sample: u32) -> PathRay {
    let [width, _] = frame.size;
    let stream = Stream::new(frame.seed, pixel, sample);
    let [u, v] = stream.film();
    let x = f64::from(pixel % width) + 0.5 + frame.filter.offset(u);
    let y = f64::from(pixel / width) + 0.5 + frame.filter.offset(v);
    let (o, d) = frame.camera.ray(x, y, || stream.lens());
    PathRay {
        o,
        dir: UnitDir::encode(d),
        key: PathKey { pixel, sample, branch: 0, vertex: 0 },
        throughput: Vec3::ONE.to_array(),
        pdf: 0.0,
    }
}

/// Weight of the power heuristic (Veach 1997) for a sample of density `a` that the other technique gives with density `b`.
#[inline(always)]
fn power_heuristic(a: f32, b: f32) -> f32 {
    // as a ratio of at most 1, so that no square overflows
    let (small, large) = if a < b { (a, b) } else { (b, a) };
    let r = small / large;
    let r2 = r * r;
    (if a < b { r2 } else { 1.0 }) / (1.0 + r2)
}
