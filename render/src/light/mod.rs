//! Light sources: choosing one, a point on it, and the density with which that happens.
//!
//! A source is a primitive that emits, a [beam](crate::world::Beam), or the sky. Sky and parallel light have shares that do not depend on
//! where they are seen from; so has what is local where it is one shape of at most [`FEW`] primitives. Of more, a [tree]
//! chooses by the point that is lit. Nine tenths of the shares of shapes and beams go by power (luminance x area x pi), one tenth is dealt
//! evenly; a primitive of a shape has its share of the area. Within the tree nothing is dealt evenly: these shares only say how often it is asked,
//! and whoever may shine at the point has one number at least. The probabilities are multiples of 2^-32, intervals of integers, so one 32-bit
//! number chooses exactly by them. Where a surface is lit on one side, a tree, and the place on a triangle, take that into account; both sides of MIS see
//! numbers that do not ([`Facing`] says why that is right).
//! Without a tree, a primitive whose share is below 2^-32 is never chosen; its density is 0, and MIS leaves it to the BSDF.

mod beam;
mod bounds;
mod facing;
mod map;
mod picture;
mod sky;
mod sphere;
mod sun;
#[cfg(test)]
mod tests;
mod tree;
#[cfg(test)]
mod tree_tests;
mod triangle;
mod wide;

use std::sync::Arc;

use crate::math::{luminance, unit};
use crate::ray::PrimId;
use crate::real::{Vec3, f32};
use crate::texture::At;
use crate::world::{Beam, Glow, Primitive, World, sphere_uv};
use bounds::Bounds;
pub(crate) use facing::Facing;
pub use map::{SkyMap, SkyMapError};
use sky::Sky;
pub use sphere::SphereLight;
use tree::Tree;
pub(crate) use tree::{Node, at_least, end};
pub use triangle::TriangleLight;

/// Share of the choice that is dealt evenly over the sources.
const EVEN: f64 = 0.1;
/// Most that the sky is chosen when there are other sources.
const SKY_LIMIT: f64 = 0.5;

/// Tables of every source of a world.
#[derive(Clone, Debug)]
pub struct Lights {
    /// Those of the tree first, if there is one.
    sources: Vec<Source>,
    /// Chooses by the point among the first sources, by the numbers below its share.
    tree: Option<Tree>,
    /// Upper ends of the intervals of 32-bit numbers of the sources that are not in the tree; the last is 2^32.
    ends: Vec<u64>,
    /// Number of sources in the tree.
    in_tree: usize,
    /// By ascending id: the primitive's number in `sources`.
    by_prim: Vec<(PrimId, u32)>,
    sky: Sky,
    sky_probability: f32,
    only_triangles: bool,
    /// The sources once more, if they are primitives that shine evenly and at most [`FEW`]: in the order of the tree's only node, if there
    /// is a tree.
    few: Vec<FewLight>,
    pictures: Vec<Picture>,
}

/// All sources, where they are primitives that shine evenly, and few.
pub(crate) enum Few<'l> {
    /// Chosen by numbers that are the same everywhere.
    ByPower(&'l [FewLight]),
    /// Each is a child of the node, in this order.
    ByPlace(&'l Node, &'l [FewLight]),
}

/// So many sources are chosen from by comparing with each.
const FEW: usize = 8;

/// One of those that are all the sources there are.
#[derive(Clone, Debug)]
pub(crate) struct FewLight {
    /// Where its interval begins, by power; the next one's begins where it ends.
    pub start: u32,
    pub shape: FewShape,
    pub radiance: Vec3,
    /// With which it is chosen, by power.
    pub probability: f32,
}

/// What shines evenly.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FewShape {
    Triangle(TriangleLight),
    /// To the outside.
    Sphere(SphereLight),
}

/// One primitive, or the sky.
#[derive(Clone, Debug)]
struct Source {
    geometry: Geometry,
    /// Of the sky, and where a texture gives it, about its mean.
    emission: Vec3,
    /// With which it is chosen; what the integers in `Lights::ends` say. Of the tree's sources 0: it depends on the point.
    probability: f32,
    /// Number in `Lights::pictures`, if a texture gives the emission.
    picture: Option<u32>,
}

/// The emission of a source that a texture gives.
#[derive(Clone, Debug)]
struct Picture {
    texture: u32,
    /// What the texture is multiplied by.
    factor: Vec3,
    glow: Glow,
}

/// What a number chose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Choice {
    source: usize,
    /// With which it is chosen at this point, as MIS sees it.
    pub probability: f32,
    /// That over the true one.
    pub worth: f32,
}

#[derive(Clone, Debug)]
enum Geometry {
    Triangle(TriangleLight),
    Sphere(SphereLight),
    Beam(Beam),
    Sky,
}

/// A direction towards a source.
#[derive(Clone, Copy, Debug)]
pub struct LightSample {
    /// Unit direction from the point lit.
    pub d: Vec3,
    /// Nothing nearer than this may be met; smaller than the distance of the source by the error of both.
    pub tmax: f32,
    /// Radiance arriving from there if nothing is in between, times the density `pdf` over the true one. Of a single direction: irradiance times 2^64.
    pub radiance: Vec3,
    /// A texture that this is multiplied by, and where it is looked up.
    pub look: Option<(u32, At)>,
    /// Density in solid angle, the choice included, as both sides of MIS see it; the true one where the surface is lit from all around, but for roundings
    /// of the choice. Of a single direction: 2^64 times the choice's probability, so that `radiance / pdf` is
    /// right and no other technique's density counts beside it.
    pub pdf: f32,
}

impl Lights {
    /// Tables for a world whose sky is no picture. Primitives without area and emission of zero are left out.
    pub fn new(world: &World) -> Lights {
        Lights::with_sky_map(world, None)
    }

    /// Tables for a world and the picture of its sky, which is dark where the world wants one and there is none.
    pub fn with_sky_map(world: &World, map: Option<Arc<SkyMap>>) -> Lights {
        Lights::build(world, map, |sources, parts| sources > 1 && (parts > 1 || sources > FEW))
    }

    /// The plain twin: a choice by power alone.
    #[cfg(test)]
    pub(crate) fn by_power(world: &World, map: Option<Arc<SkyMap>>) -> Lights {
        Lights::build(world, map, |_, _| false)
    }

    /// With a tree whatever the sources.
    #[cfg(test)]
    pub(crate) fn by_tree(world: &World) -> Lights {
        Lights::build(world, None, |sources, _| sources > 0)
    }

    /// `wants_tree` is told the number of local sources, and of how many shapes and beams they are.
    fn build(world: &World, map: Option<Arc<SkyMap>>, wants_tree: impl Fn(usize, usize) -> bool) -> Lights {
        let mut sources = Vec::new();
        let mut by_prim = Vec::new();
        let mut areas = vec![0.0f64; world.shapes.len()];
        let mut chosen = Vec::new();
        let mut pictures = Vec::new();
        for e in &world.emissive {
            let Some(shape) = world.shapes.get(e.shape as usize) else { continue };
            let Some(factor) = shape.emission.map(Vec3::from) else { continue };
            let glow = shape.emission_texture.map(|texture| {
                let found = world.glows.binary_search_by_key(&e.prim, |g| g.prim);
                // a world without it was not made by preparing: the hit's own coordinates
                let none = Glow { prim: e.prim, uv: None, attribute: None, weight: 1.0 };
                Picture { texture, factor, glow: found.map_or(none, |i| world.glows[i]) }
            });
            let weight = glow.as_ref().map_or(1.0, |p| p.glow.weight);
            let emission = factor * weight;
            let geometry = match e.geometry {
                Primitive::Triangle(v) => Geometry::Triangle(TriangleLight::new(v)),
                Primitive::Sphere { center, radius, flipped } => {
                    Geometry::Sphere(SphereLight::new(center, radius, flipped))
                }
            };
            let area = f64::from(geometry.area());
            if !(area > 0.0 && area.is_finite() && luminance(emission) > 0.0) {
                continue;
            }
            // a primitive's share of its shape is by area, and by what the texture has on it
            let area = area * f64::from(weight);
            areas[e.shape as usize] += area;
            by_prim.push((e.prim, sources.len() as u32));
            chosen.push((e.shape as usize, area));
            let picture = glow.map(|picture| {
                pictures.push(picture);
                pictures.len() as u32 - 1
            });
            sources.push(Source { geometry, emission, probability: 0.0, picture });
        }
        by_prim.sort_unstable();
        let sky = Sky::new(world, map);
        let power =
            |shape: usize| world.shapes[shape].emission.map_or(0.0, |e| f64::from(luminance(e.into()))) * areas[shape];
        let shapes: Vec<usize> = (0..areas.len()).filter(|&s| areas[s] > 0.0).collect();
        let radius2 = (0..3).map(|i| f64::from(world.hi[i] - world.lo[i]).powi(2)).sum::<f64>() / 4.0;
        let beams: Vec<(Beam, f64)> =
            world.beams.iter().filter(|b| beam::shines(b)).map(|b| (*b, beam::power(b, radius2))).collect();
        let total = shapes.iter().map(|&s| power(s)).sum::<f64>() + beams.iter().map(|b| b.1).sum::<f64>();
        let others = shapes.len() + beams.len();
        let sky_share = sky.mean().map_or(0.0, |mean| sky_share(mean, radius2, total, others));
        let share = |power: f64| (1.0 - sky_share) * ((1.0 - EVEN) * power / total + EVEN / others as f64);
        let mut weights: Vec<f64> = chosen.iter().map(|&(s, area)| share(power(s)) * area / areas[s]).collect();
        // what is local before what is infinitely far away
        let (local, far): (Vec<_>, Vec<_>) = beams.into_iter().partition(|b| !matches!(b.0, Beam::Directional { .. }));
        let parts = shapes.len() + local.len();
        for (beam, power) in local.into_iter().chain(far) {
            weights.push(share(power));
            sources.push(Source {
                geometry: Geometry::Beam(beam),
                emission: Vec3::ZERO,
                probability: 0.0,
                picture: None,
            });
        }
        if let Some(mean) = sky.mean() {
            weights.push(sky_share);
            sources.push(Source { geometry: Geometry::Sky, emission: mean, probability: 0.0, picture: None });
        }
        let bounds: Vec<Bounds> = sources.iter().map_while(Bounds::new).collect();
        let (mut tree, mut in_tree) = (None, 0);
        let mut ends = Vec::new();
        let only_triangles = !sources.is_empty() && sources.iter().all(Source::is_even_triangle);
        let is_few = sources.len() <= FEW && sources.iter().all(|s| s.even().is_some());
        if wants_tree(bounds.len(), parts) {
            in_tree = bounds.len();
            // the tree as one weight, before those that are not in it
            let local: f64 = weights[..in_tree].iter().sum();
            weights.splice(..in_tree, [local]);
            ends = integer_ends(&weights);
            tree = Some(Tree::new(&bounds, ends.remove(0)));
        } else {
            ends.append(&mut integer_ends(&weights));
        }
        let mut start = tree.as_ref().map_or(0, Tree::share);
        for (source, &end) in sources[in_tree..].iter_mut().zip(&ends) {
            source.probability = probability(end - start);
            start = end;
        }
        let sky_probability = sky.mean().map_or(0.0, |_| sources.last().map_or(0.0, |s| s.probability));
        let few = match &tree {
            _ if !is_few => Vec::new(),
            None => few_by_power(&sources, &ends),
            Some(tree) => children(&sources, tree.root()),
        };
        Lights { sources, tree, ends, in_tree, by_prim, sky, sky_probability, only_triangles, few, pictures }
    }

    /// The same, but that no source is left out where it cannot shine: to see what leaving them out saves.
    pub fn leaving_out_none(mut self) -> Lights {
        if let Some(tree) = &mut self.tree {
            tree.leave_out_none();
        }
        self
    }

    /// Whether there is nothing to sample.
    pub fn is_empty(&self) -> bool {
        self.sources.is_empty()
    }

    /// Whether anything comes from where nothing is met.
    #[inline]
    pub(crate) fn has_sky(&self) -> bool {
        !self.sky.is_dark()
    }

    /// Radiance from the sky along the unit direction `d`, and the density of [`Lights::sample`] in that direction; both 0 without a sky.
    #[inline]
    pub fn sky(&self, d: Vec3) -> (Vec3, f32) {
        let (radiance, pdf) = self.sky.look_up(d);
        (radiance, pdf * self.sky_probability)
    }

    /// [`Lights::sky`] of many directions, given with their index.
    pub(crate) fn skies(&self, directions: &[Vec3], mut give: impl FnMut(usize, (Vec3, f32))) {
        self.sky.look_up_many(directions, |i, (radiance, pdf)| give(i, (radiance, pdf * self.sky_probability)));
    }

    /// Whether the sky is a picture, so that [`Lights::skies`] and [`Lights::sample_skies`] are worth collecting for.
    #[inline]
    pub(crate) fn has_far_sky(&self) -> bool {
        self.sky.is_far()
    }

    /// Whether the sky was chosen.
    #[inline]
    pub(crate) fn is_sky(&self, choice: Choice) -> bool {
        matches!(self.sources[choice.source].geometry, Geometry::Sky)
    }

    /// [`Lights::sample_chosen`] of the sky, with the probability of the choice and the numbers of the place, for many, given with their index.
    pub(crate) fn sample_skies(
        &self,
        probability: f32,
        places: &[[u32; 2]],
        mut give: impl FnMut(usize, Option<LightSample>),
    ) {
        self.sky.sample_many(places, |i, sample| {
            give(i, sample.map(|(d, radiance, pdf)| sky_sample(d, radiance, pdf * probability)));
        });
    }

    /// A direction from `o`, which is lit from all around, to a source, by random bits: one number for the choice and two for the place. `None` when what
    /// was chosen shows `o` its back: that sample is worth 0.
    #[inline(always)]
    pub fn sample(&self, o: Vec3, choice: u32, place: [u32; 2]) -> Option<LightSample> {
        self.sample_chosen(self.choose(o, Facing::ANY, choice).0?, o, Facing::ANY, place)
    }

    /// The same of what was chosen, for callers that choose for many at once.
    #[inline]
    pub(crate) fn sample_chosen(
        &self,
        choice: Choice,
        o: Vec3,
        facing: Facing,
        place: [u32; 2],
    ) -> Option<LightSample> {
        let Choice { source, probability, worth } = choice;
        let source = &self.sources[source];
        let mut u = place.map(unit);
        let mut worth = worth;
        let (d, tmax, pdf) = match &source.geometry {
            Geometry::Triangle(t) => {
                if !facing.is_any() {
                    let warp;
                    (u, warp) = t.warp(o, facing, u);
                    worth *= warp;
                }
                t.sample(o, u)?
            }
            Geometry::Sphere(s) => s.sample(o, u)?,
            Geometry::Beam(beam) => {
                let (d, tmax, irradiance) = beam::sample(beam, o)?;
                let radiance = irradiance * beam::SINGLE * worth;
                let look = match beam {
                    Beam::Spot { slide: Some(slide), .. } => Some((slide.texture, At::uv(slide.uv(-d)))),
                    _ => None,
                };
                return Some(LightSample { d, tmax, radiance, look, pdf: beam::SINGLE * probability });
            }
            Geometry::Sky => {
                let (d, radiance, pdf) = self.sky.sample(place)?;
                return Some(sky_sample(d, radiance, pdf * probability));
            }
        };
        let pdf = pdf * probability;
        let Some(picture) = source.picture else {
            return Some(LightSample { d, tmax, radiance: source.emission * worth, look: None, pdf });
        };
        let picture = &self.pictures[picture as usize];
        let at = match &source.geometry {
            Geometry::Sphere(s) => At::uv(sphere_uv(s.normal(o, d))),
            _ => {
                let [s, t] = triangle::barycentric(u);
                picture.glow.on_triangle(s, t)
            }
        };
        Some(LightSample { d, tmax, radiance: picture.factor * worth, look: Some((picture.texture, at)), pdf })
    }

    /// A source that was chosen, if it is an even triangle, and its radiance.
    #[inline(always)]
    pub(crate) fn triangle(&self, choice: Choice) -> Option<(&TriangleLight, Vec3)> {
        let source = &self.sources[choice.source];
        match &source.geometry {
            Geometry::Triangle(t) if source.picture.is_none() => Some((t, source.emission)),
            _ => None,
        }
    }

    /// A source that was chosen, if it is a sphere that shines evenly at a point outside it, and its radiance.
    #[inline(always)]
    pub(crate) fn sphere(&self, choice: Choice, o: Vec3) -> Option<(&SphereLight, Vec3)> {
        let source = &self.sources[choice.source];
        match &source.geometry {
            Geometry::Sphere(s) if source.picture.is_none() && s.is_lit_outside(o) => Some((s, source.emission)),
            _ => None,
        }
    }

    /// Whether every source is a triangle that emits evenly.
    #[inline(always)]
    pub(crate) fn only_triangles(&self) -> bool {
        self.only_triangles
    }

    /// All sources, if they are primitives that shine evenly, and few.
    #[inline(always)]
    pub(crate) fn few(&self) -> Option<Few<'_>> {
        match &self.tree {
            _ if self.few.is_empty() => None,
            None => Some(Few::ByPower(&self.few)),
            Some(tree) => Some(Few::ByPlace(tree.root(), &self.few)),
        }
    }

    /// Density of light samples as MIS sees it, from `o`, in the direction `d` that met the front of primitive `prim` at distance `t`, where the cosine
    /// between the source's normal and the way back is `cos`. 0 for what is never sampled.
    #[inline(always)]
    pub fn pdf(&self, prim: PrimId, o: Vec3, t: f32, cos: f32) -> f32 {
        let Ok(i) = self.by_prim.binary_search_by_key(&prim, |e| e.0) else { return 0.0 };
        let number = self.by_prim[i].1 as usize;
        let source = &self.sources[number];
        let pdf = match &source.geometry {
            Geometry::Triangle(s) => s.pdf(t, cos),
            Geometry::Sphere(s) => s.pdf(o, t, cos),
            Geometry::Beam(_) | Geometry::Sky => 0.0,
        };
        match &self.tree {
            Some(tree) => pdf * (tree.weight(o, number) * probability(tree.share())),
            None => pdf * source.probability,
        }
    }

    /// The source in whose interval the number lies at the point of a surface, `None` where nothing shines there; and whether sources were left out
    /// on the way to it, as they cannot shine there.
    #[inline(always)]
    pub(crate) fn choose(&self, o: Vec3, facing: Facing, number: u32) -> (Option<Choice>, bool) {
        let number = u64::from(number);
        if let Some(tree) = &self.tree
            && number < tree.share()
        {
            let (chosen, fewer) = tree.choose(o, facing, number);
            let choice = |(source, numbers, weight)| {
                let seen = weight * probability(tree.share());
                Choice { source, probability: seen, worth: seen / probability(numbers) }
            };
            return (chosen.map(choice), fewer);
        }
        let i = match self.ends.len() {
            0 => return (None, false),
            // few: count the ends passed, without branches to mispredict
            n if n <= FEW => self.ends.iter().filter(|&&end| end <= number).count(),
            _ => self.ends.partition_point(|&end| end <= number),
        };
        let source = self.in_tree + i;
        let choice = || Choice { source, probability: self.sources[source].probability, worth: 1.0 };
        ((i < self.ends.len()).then(choice), false)
    }
}

impl Source {
    fn is_even_triangle(&self) -> bool {
        matches!(self.even(), Some(FewShape::Triangle(_)))
    }
    /// Of a primitive that shines evenly, a sphere only if it does to the outside.
    fn even(&self) -> Option<FewShape> {
        match self.geometry {
            _ if self.picture.is_some() => None,
            Geometry::Triangle(light) => Some(FewShape::Triangle(light)),
            Geometry::Sphere(light) if !light.is_flipped() => Some(FewShape::Sphere(light)),
            _ => None,
        }
    }
}

impl Geometry {
    fn area(&self) -> f32 {
        match self {
            Geometry::Triangle(t) => t.area(),
            Geometry::Sphere(s) => s.area(),
            Geometry::Beam(_) | Geometry::Sky => 0.0,
        }
    }
}

/// Of so many of the 2^32 numbers.
#[inline(always)]
pub(crate) fn probability(numbers: u64) -> f32 {
    (numbers as f64 / 4_294_967_296.0) as f32
}

/// Sources with the beginnings of their intervals; without those that begin, and end, at 2^32.
fn few_by_power(sources: &[Source], ends: &[u64]) -> Vec<FewLight> {
    let starts = std::iter::once(0).chain(ends.iter().copied());
    let few = sources.iter().zip(starts).filter_map(|(source, start)| {
        let (start, shape) = (u32::try_from(start).ok()?, source.even()?);
        Some(FewLight { start, shape, radiance: source.emission, probability: source.probability })
    });
    few.collect()
}

/// Sources as the children of a node are; nothing if a child is none.
fn children(sources: &[Source], node: &Node) -> Vec<FewLight> {
    let few = (0..node.children()).map(|k| {
        let source = &sources[node.source(k)? as usize];
        Some(FewLight { start: 0, shape: source.even()?, radiance: source.emission, probability: 0.0 })
    });
    few.collect::<Option<_>>().unwrap_or_default()
}

/// Of no end.
#[inline(always)]
fn sky_sample(d: Vec3, radiance: Vec3, pdf: f32) -> LightSample {
    LightSample { d, tmax: f32::INFINITY, radiance, look: None, pdf }
}

/// The sky's share of the choice: all when it is alone, else by the power that enters the scene's bounding sphere, but at most
/// [`SKY_LIMIT`] (a sky outside a closed room would take every sample).
fn sky_share(sky: Vec3, radius2: f64, others: f64, count: usize) -> f64 {
    if count == 0 {
        return 1.0;
    }
    // pi L x pi R^2 against pi L x area
    let power = f64::from(luminance(sky)) * std::f64::consts::PI * radius2;
    let share = (1.0 - EVEN) * power / (power + others) + EVEN / (count + 1) as f64;
    if share < SKY_LIMIT { share } else { SKY_LIMIT }
}

/// Upper ends of consecutive intervals of [0, 2^32) in proportion to the weights; the last nonzero one ends at 2^32.
fn integer_ends(weights: &[f64]) -> Vec<u64> {
    let total: f64 = weights.iter().sum();
    let mut sum = 0.0;
    let mut ends: Vec<u64> = weights
        .iter()
        .map(|w| {
            sum += w;
            ((sum / total * 4_294_967_296.0) as u64).min(1 << 32)
        })
        .collect();
    if let Some(last) = ends.last_mut() {
        *last = 1 << 32;
    }
    ends
}
