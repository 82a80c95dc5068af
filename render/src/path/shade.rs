//! Shading of a batch.

#[cfg(not(feature = "double"))]
use super::block::{Block, Blocks};
use super::interaction::{Interaction, triangle_place};
use super::vertex::{Fate, cosine_direction, onwards, snap, survive, towards_light};
use super::{Context, Contribution, Outcome, PathRay, ShadowRay, Surface, Surfaces, power_heuristic};
use crate::light::Facing;
use crate::material::{Blend, Bsdf, Material, ReliefKind};
use crate::math::{UnitDir, unit};
use crate::ray::{Hit, PathKey, Ray};
use crate::real::{Vec3, f32};
use crate::sampler::{BSDF, LIGHT, LIGHT_CHOICE, LOBE, ROULETTE, Stream};
use crate::skip::Skip;
use crate::world::{Primitive, ShapeInfo};

#[cfg(not(feature = "double"))]
/// Shades each ray with its hit and appends what comes of it to `out`.
///
/// `rays` and `hits` are of one length. A ray that missed brings the sky. A hit brings what the surface emits, and unless the path ends there (depth,
/// roulette, nothing reflected), a shadow ray to a light and a next ray; at the first hit `frame.split` of each.
///
/// Depth is Mitsuba's: a path has at most `max_depth` rays. After ray number `rr_depth` and later ones it goes on with probability min(w, 0.95), where w is the
/// largest channel of its throughput over that before the vertex (Mitsuba's is the largest channel itself; see `vertex::survive`).
pub fn shade<S: Surfaces>(context: &Context, surfaces: &S, rays: &[PathRay], hits: &[Hit], out: &mut Outcome) {
    let mut traced = std::mem::take(&mut out.rays);
    traced.clear();
    traced.extend(rays.iter().map(PathRay::ray));
    shade_traced(context, surfaces, rays, &traced, hits, out);
    out.rays = traced;
}

#[cfg(not(feature = "double"))]
/// [`shade`] where the rays are at hand as they were traced: `traced[i]` is `rays[i].ray()` but for its `tmax`.
pub fn shade_traced<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    rays: &[PathRay],
    traced: &[Ray],
    hits: &[Hit],
    out: &mut Outcome,
) {
    let mut blocks = out.blocks.take().unwrap_or_default();
    out.counters.shaded += rays.len() as u64;
    let looks_up = looks_up(context);
    let bares = context.skips.makes(Skip::Details);
    let far_sky = looks_up && context.lights.has_far_sky();
    if far_sky {
        shade_missed(context, rays, traced, hits, out);
    }
    let is_far = surfaces.is_far();
    for (index, ((ray, traced), hit)) in rays.iter().zip(traced).zip(hits).enumerate() {
        if is_far && let Some(hit) = hits.get(index + AHEAD).filter(|hit| hit.is_hit()) {
            surfaces.foresee(hit);
        }
        if !hit.is_hit() {
            out.counters.missed += 1;
            if !looks_up {
                out.counters.skyless += 1;
            } else if !far_sky && is_first(context, ray) && !hidden(context, ray) {
                let (radiance, pdf) = context.lights.sky(traced.d.into());
                emit(ray, radiance, pdf, out);
            }
            continue;
        }
        let Some(Leaving { shape, material, children, throughput }) = arrive(context, surfaces, index, ray, hit, out)
        else {
            continue;
        };
        for child in 0..children {
            let key = PathKey { branch: ray.key.branch + child as u16, ..ray.key };
            let at = (index, hit, traced.d);
            // where nothing is to be skipped by way of `scatter_plain`, which looks for detail
            if bares && let Some(flat) = flat_and_diffuse(surfaces, index, hit, material) {
                let block = &mut blocks.diffuse;
                block.push(index as u32, key, throughput);
                block.set_triangle(&flat.0, hit, traced.d, material.two_sided);
                block.set_albedo(flat.1);
                if block.is_full() {
                    flush(context, surfaces, rays, hits, block, out);
                }
            } else if bares
                && let Some(block) = enter(context, surfaces, at, key, (shape, material, throughput), &mut blocks)
            {
                if block.is_full() {
                    flush(context, surfaces, rays, hits, block, out);
                }
            } else {
                one_by_one(context, surfaces, rays, hits, index, key, throughput, out);
            }
        }
    }
    for block in blocks.all() {
        flush(context, surfaces, rays, hits, block, out);
    }
    out.blocks = Some(blocks);
}

/// What rays that missed bring of a sky that lies in memory far away, some at a time.
#[cfg(not(feature = "double"))]
#[inline(never)]
fn shade_missed(context: &Context, rays: &[PathRay], traced: &[Ray], hits: &[Hit], out: &mut Outcome) {
    const SOME: usize = 32;
    let (mut indices, mut directions, mut count) = ([0; SOME], [Vec3::ZERO; SOME], 0);
    let mut bring = |indices: &[usize], directions: &[Vec3]| {
        context.lights.skies(directions, |k, (radiance, pdf)| emit(&rays[indices[k]], radiance, pdf, out));
    };
    for (index, ((ray, traced), hit)) in rays.iter().zip(traced).zip(hits).enumerate() {
        if !hit.is_hit() && is_first(context, ray) && !hidden(context, ray) {
            (indices[count], directions[count]) = (index, traced.d.into());
            count += 1;
            if count == SOME {
                bring(&indices, &directions);
                count = 0;
            }
        }
    }
    bring(&indices[..count], &directions[..count]);
}

/// The surfaces of hits that lie so far ahead are asked for. A vertex takes some 1000 cycles one by one and 200 in a block, memory some 300: twice as
/// many as are needed leave room for a block that is flushed in between.
const AHEAD: usize = 16;

/// The plain twin of `shade`: one vertex after the other.
#[cfg(any(test, feature = "double"))]
pub fn shade_plain<S: Surfaces>(context: &Context, surfaces: &S, rays: &[PathRay], hits: &[Hit], out: &mut Outcome) {
    for (index, (ray, hit)) in rays.iter().zip(hits).enumerate() {
        out.counters.shaded += 1;
        if !hit.is_hit() {
            out.counters.missed += 1;
            if !looks_up(context) {
                out.counters.skyless += 1;
            } else if is_first(context, ray) && !hidden(context, ray) {
                let (radiance, pdf) = context.lights.sky(ray.dir.decode().into());
                emit(ray, radiance, pdf, out);
            }
            continue;
        }
        let Some(leaving) = arrive(context, surfaces, index, ray, hit, out) else { continue };
        for child in 0..leaving.children {
            let key = PathKey { branch: ray.key.branch + child as u16, ..ray.key };
            let surface = surfaces.surface(index, hit);
            scatter_plain(context, ray, key, leaving.throughput, hit, &surface, leaving.material, out);
        }
    }
}

#[cfg(not(feature = "double"))]
fn flush<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    rays: &[PathRay],
    hits: &[Hit],
    block: &mut Block,
    out: &mut Outcome,
) {
    block.flush(context, out, |index, key, throughput, out| {
        one_by_one(context, surfaces, rays, hits, index, key, throughput, out);
    });
}

#[cfg(not(feature = "double"))]
#[inline(never)]
fn one_by_one<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    rays: &[PathRay],
    hits: &[Hit],
    index: usize,
    key: PathKey,
    throughput: Vec3,
    out: &mut Outcome,
) {
    let (ray, hit) = (&rays[index], &hits[index]);
    let (surface, world) = (surfaces.surface(index, hit), context.world);
    let material = &world.materials[world.shapes[surfaces.shape(index, hit) as usize].material as usize];
    scatter_plain(context, ray, key, throughput, hit, &surface, material, out);
}

/// Whether the sky is looked up where nothing is met.
#[inline(always)]
fn looks_up(context: &Context) -> bool {
    context.lights.has_sky() || !context.skips.makes(Skip::Sky)
}

/// Whether a ray stands for what its sample comes upon first: the camera ray that siblings share, or the first of theirs where they do
/// not; and every other ray.
#[inline(always)]
pub(super) fn is_first(context: &Context, ray: &PathRay) -> bool {
    (ray.key.vertex != 0) | (ray.key.branch == 0) | context.skips.makes(Skip::Merged)
}

#[inline]
fn emit(ray: &PathRay, radiance: Vec3, light_pdf: f32, out: &mut Outcome) {
    let weight = if ray.pdf > 0.0 { power_heuristic(ray.pdf, light_pdf) } else { 1.0 };
    let value = Vec3::from(ray.throughput) * radiance * weight;
    if value != Vec3::ZERO {
        out.light.push(Contribution { pixel: ray.key.pixel, sample: ray.key.sample, value: value.to_array() });
    }
}

/// What leaves from a hit.
struct Leaving<'a> {
    /// Of this shape.
    shape: u32,
    material: &'a Material,
    /// How many paths.
    children: u32,
    /// Of each.
    throughput: Vec3,
}

#[cfg(not(feature = "double"))]
/// The vertices and the albedo of a triangle without anything else: most hits of most scenes.
#[inline(always)]
fn flat_and_diffuse<S: Surfaces>(
    surfaces: &S,
    index: usize,
    hit: &Hit,
    material: &Material,
) -> Option<([[f32; 3]; 3], [f32; 3])> {
    let (Bsdf::Diffuse { reflectance }, None) = (&material.bsdf, &material.detail) else { return None };
    match surfaces.surface(index, hit) {
        Surface { geometry: Primitive::Triangle(vertices), normals: None, .. } => Some((vertices, *reflectance)),
        _ => None,
    }
}

#[cfg(not(feature = "double"))]
/// Puts a vertex into the block of its kind, with shading normals and textures, if there is a block that takes it.
#[inline(never)]
fn enter<'b, S: Surfaces>(
    context: &Context,
    surfaces: &S,
    (index, hit, d): (usize, &Hit, [f32; 3]),
    key: PathKey,
    (shape, material, throughput): (u32, &Material, Vec3),
    blocks: &'b mut Blocks,
) -> Option<&'b mut Block> {
    let block = blocks.of(material.kind()?);
    let surface = surfaces.surface(index, hit);
    let Primitive::Triangle(vertices) = &surface.geometry else { return None };
    match &material.detail {
        Some(detail) if !detail.textured.is_empty() => {
            let place = triangle_place(&surface, hit);
            let mut first = None;
            for textured in &detail.textured {
                let texture = &context.world.textures[textured.texture as usize];
                let spot = texture.spot(place);
                texture.foresee(context.textures, &spot);
                first.get_or_insert(spot);
            }
            block.push(index as u32, key, throughput);
            block.set_place(shape, place, first.unwrap_or_default());
        }
        _ => {
            let look = material.even_look()?;
            block.push(index as u32, key, throughput);
            block.set_look(shape, &look);
        }
    }
    // written where it is to stay: copies of what was just written wait for it
    block.set_triangle(vertices, hit, d, material.two_sided);
    if let Some(normals) = &surface.normals {
        block.set_normals(normals);
    }
    Some(block)
}

/// Emission, depth and splitting; `None` when the path ends here.
#[inline(always)]
fn arrive<'a, S: Surfaces>(
    context: &Context<'a>,
    surfaces: &S,
    index: usize,
    ray: &PathRay,
    hit: &Hit,
    out: &mut Outcome,
) -> Option<Leaving<'a>> {
    let (frame, world) = (context.frame, context.world);
    let number = surfaces.shape(index, hit);
    let (of_shape, shape) = (number, &world.shapes[number as usize]);
    if shape.emission.is_some() {
        if hidden(context, ray) {
            pass_through(surfaces, index, ray, hit, out);
            return None;
        }
        if is_first(context, ray) {
            emit_surface(context, surfaces, index, ray, hit, shape, out);
        }
    }
    let number = u32::from(ray.key.vertex) + 1;
    if number >= frame.max_depth {
        out.counters.depth += 1;
        return None;
    }
    let material = &world.materials[shape.material as usize];
    let throughput = Vec3::from(ray.throughput);
    out.counters.bare += u64::from(material.detail.is_none() & context.skips.makes(Skip::Details));
    if number == 1 && frame.split > 1 {
        let merged = context.skips.makes(Skip::Merged);
        // a mirror would send every sibling the same way
        if !material.is_mirror() {
            let share = throughput / frame.split as f32;
            let children = if merged { frame.split } else { 1 };
            return Some(Leaving { shape: of_shape, material, children, throughput: share });
        }
        if !is_first(context, ray) {
            return None;
        }
    }
    Some(Leaving { shape: of_shape, material, children: 1, throughput })
}

/// Whether a ray is the camera's and must not see what emits light.
#[inline(always)]
pub(super) fn hidden(context: &Context, ray: &PathRay) -> bool {
    context.frame.hide_emitters && ray.key.vertex == 0
}

/// The same ray from beyond what it hit; none if the surface is seen edge on.
#[cold]
fn pass_through<S: Surfaces>(surfaces: &S, index: usize, ray: &PathRay, hit: &Hit, out: &mut Outcome) {
    let (o, d) = (Vec3::from(ray.o), Vec3::from(ray.dir.decode()));
    match Interaction::new(o, d, hit, &surfaces.surface(index, hit)) {
        Some(at) => {
            let beyond = PathRay { o: at.origin_beyond().to_array(), ..*ray };
            out.next.push(beyond);
            out.next_rays.push(beyond.ray());
        }
        None => out.counters.absorbed += 1,
    }
}

#[inline(never)]
fn emit_surface<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    index: usize,
    ray: &PathRay,
    hit: &Hit,
    shape: &ShapeInfo,
    out: &mut Outcome,
) {
    let (o, d) = (Vec3::from(ray.o), Vec3::from(ray.dir.decode()));
    let surface = surfaces.surface(index, hit);
    if let Some(at) = Interaction::new(o, d, hit, &surface)
        && at.from_front
    {
        let emission = Vec3::from(shape.emission.unwrap_or_default());
        let emission = match shape.emission_texture {
            None => emission,
            Some(t) => emission * context.world.textures[t as usize].light(context.textures, at.place(&surface, hit)),
        };
        let density = || context.lights.pdf(surfaces.prim(index, hit), o, hit.t, -at.normal.dot(d));
        let pdf = if ray.pdf > 0.0 { density() } else { 0.0 };
        emit(ray, emission, pdf, out);
    }
}

/// A shadow ray and a next ray from a point.
pub(super) fn scatter_plain(
    context: &Context,
    ray: &PathRay,
    key: PathKey,
    throughput: Vec3,
    hit: &Hit,
    surface: &Surface,
    material: &Material,
    out: &mut Outcome,
) {
    let frame = context.frame;
    let d = Vec3::from(ray.dir.decode());
    let Some(mut at) = Interaction::new(Vec3::from(ray.o), d, hit, surface) else {
        out.counters.absorbed += 1;
        return;
    };
    let next_key = PathKey { vertex: key.vertex + 1, ..key };
    let numbers = Stream::new(frame.seed, key.pixel, key.sample).vertex(
        u32::from(next_key.vertex),
        frame.split,
        u32::from(key.branch),
    );
    let look;
    let mut lobe = numbers[LOBE];
    let skips = context.skips;
    let (material, bsdf, opacity) = match material.detail.as_deref() {
        None if skips.makes(Skip::Details) => (material, &material.bsdf, 1.0),
        _ => {
            let (met, opacity);
            (met, look, opacity) = appearance(context, material, surface, hit, d, &mut at, &mut lobe);
            (met, look.as_ref().unwrap_or(&met.bsdf), opacity)
        }
    };
    // what is behind a surface of one side is black, but for what passes beside it
    let seen = at.from_front || material.two_sided || bsdf.transmits();
    if !seen && opacity >= 1.0 {
        out.counters.absorbed += 1;
        return;
    }
    let origin = at.origin();
    let roulette = u32::from(next_key.vertex) >= frame.rr_depth;
    let direction = [unit(numbers[BSDF]), unit(numbers[BSDF + 1])];
    let go_on = unit(numbers[ROULETTE]);

    let place = [numbers[LIGHT], numbers[LIGHT + 1]];
    let facing = if bsdf.transmits() { Facing::ANY } else { Facing::front(at.shading) };
    let sample_light = |from: Vec3, out: &mut Outcome| {
        let (choice, fewer) = context.lights.choose(from, facing, numbers[LIGHT_CHOICE]);
        out.counters.chosen_of_fewer += u64::from(fewer);
        context.lights.sample_chosen(choice?, from, facing, place)
    };
    let blind = bsdf.is_delta() && skips.makes(Skip::Lobes);
    out.counters.lightless += u64::from(blind && seen);
    let light = if blind || !seen { None } else { sample_light(origin, out) };
    let sends = !skips.makes(Skip::Shadows);
    let shadows = out.shadow.len();
    // at most one shadow ray is cast
    let asks = seen && !blind && !sends;
    let note_unlit = |out: &mut Outcome| out.counters.unlit += u64::from(asks && out.shadow.len() == shadows);
    let shadow = |o: Vec3, dir: UnitDir, tmax: f32, contribution: Vec3, out: &mut Outcome| {
        if contribution != Vec3::ZERO || sends {
            let ray = ShadowRay { o: o.to_array(), dir, tmax, contribution: contribution.to_array(), key };
            out.shadow.push(ray);
            out.shadow_rays.push(ray.ray());
        }
    };

    let (o, dir, throughput, pdf, fate) = if let (Bsdf::Diffuse { reflectance }, true) = (bsdf, opacity >= 1.0) {
        let reflectance = Vec3::from(*reflectance);
        if let Some(light) = light {
            let (dir, wi) = snap(light.d);
            let radiance = context.radiance(&light);
            let left = reflectance * at.terminator(wi);
            let contribution =
                towards_light(throughput, left, at.normal, at.shading, light.d, wi, light.pdf, radiance, true);
            shadow(origin, dir, light.tmax, contribution, out);
        }
        note_unlit(out);
        let (d, above) = cosine_direction(at.shading, direction);
        let (dir, wi) = snap(d);
        let left = reflectance * at.terminator(wi);
        let (throughput, pdf, fate) = onwards(throughput, left, at.normal, at.shading, wi, above, go_on, roulette);
        (origin, dir, throughput, pdf, fate)
    } else {
        let basis = at.basis(surface, bsdf.is_anisotropic());
        let wo = basis.to_local(-d);
        // a light behind a surface that lets light through is sampled from there
        let (from, light) = match light {
            Some(light) if bsdf.transmits() && light.d.dot(at.normal) < 0.0 => {
                let beyond = at.origin_beyond();
                // the choice depends on the point: at an end of an interval it may fall on another source, perhaps in front
                let light = sample_light(beyond, out);
                (beyond, light.filter(|light| light.d.dot(at.normal) < 0.0))
            }
            light => (origin, light),
        };
        if let Some(light) = light {
            let dir = UnitDir::encode(light.d.to_array());
            let wi = Vec3::from(dir.decode());
            let local = basis.to_local(wi);
            // by the geometric normal too, or light would leak through the surface
            let contribution = if same_side(wi.dot(at.normal), local.z, bsdf.transmits()) {
                let scattered = bsdf.eval(wo, local, at.from_front);
                let weight = power_heuristic(light.pdf, scattered.pdf * opacity) / light.pdf;
                let value = scattered.value * (opacity * at.terminator(wi));
                throughput * value * context.radiance(&light) * weight
            } else {
                Vec3::ZERO
            };
            shadow(from, dir, light.tmax, contribution, out);
        }
        note_unlit(out);
        let lobe = unit(lobe);
        // at opacity 1 never, as the number is below 1
        let passes = lobe >= opacity;
        if !(passes || seen) {
            out.counters.absorbed += 1;
            return;
        }
        // what is left of the number when the material was met is as random; below 1 by rounding down
        let lobe = if opacity < 1.0 { (lobe / opacity).min(1.0 - f32::EPSILON / 2.0) } else { lobe };
        let sampled = if passes { None } else { bsdf.sample(wo, at.from_front, direction, lobe) };
        let (dir, weight, pdf, leaves, o) = match sampled {
            _ if passes => (ray.dir, Vec3::ONE, 0.0, true, at.origin_beyond()),
            None => {
                out.counters.absorbed += 1;
                return;
            }
            Some(sampled) => {
                let dir = UnitDir::encode(basis.to_world(sampled.wi).to_array());
                let wi = Vec3::from(dir.decode());
                let (weight, pdf) = match sampled.delta {
                    Some(weight) => (weight, 0.0),
                    // of the direction as it travels
                    None => {
                        let scattered = bsdf.eval(wo, basis.to_local(wi), at.from_front);
                        (scattered.value / scattered.pdf, scattered.pdf * opacity)
                    }
                };
                let leaves = same_side(wi.dot(at.normal), sampled.wi.z, bsdf.transmits());
                (
                    dir,
                    weight * at.terminator(wi),
                    pdf,
                    leaves,
                    if sampled.wi.z < 0.0 { at.origin_beyond() } else { origin },
                )
            }
        };
        let (throughput, fate) = survive(throughput, throughput * weight, leaves, go_on, roulette);
        (o, dir, throughput, pdf, fate)
    };
    match fate {
        Fate::On => {
            let ray = PathRay { o: o.to_array(), dir, key: next_key, throughput: throughput.to_array(), pdf };
            out.next.push(ray);
            out.next_rays.push(ray.ray());
        }
        Fate::Absorbed => out.counters.absorbed += 1,
        Fate::Roulette => out.counters.roulette += 1,
    }
}

/// What a material with detail is at a hit: which material is met, on this side and of those that are blended, its model (`None`: the material's
/// own) and opacity. Turns the shading normal of `at`, and leaves in `number` what is as random after choosing.
#[inline(never)]
pub(super) fn appearance<'a>(
    context: &Context<'a>,
    material: &'a Material,
    surface: &Surface,
    hit: &Hit,
    d: Vec3,
    at: &mut Interaction,
    number: &mut u32,
) -> (&'a Material, Option<Bsdf>, f32) {
    let (world, tiles) = (context.world, context.textures);
    let place = at.place(surface, hit);
    let (mut material, mut opacity) = (material, 1.0);
    // each names materials above itself, so this ends
    let inner = loop {
        let Some(detail) = material.detail.as_deref() else { break None };
        opacity *= detail.opacity.share(&world.textures, tiles, place);
        let next = match (detail.back, detail.blend) {
            (Some(back), _) if !at.from_front => back,
            (_, Some(Blend { weight, parts })) => parts[choose(weight.share(&world.textures, tiles, place), number)],
            _ => break Some(detail),
        };
        material = &world.materials[next as usize];
    };
    let Some(detail) = inner else { return (material, None, opacity) };
    if let Some(relief) = &detail.relief {
        let texture = &world.textures[relief.texture as usize];
        match relief.kind {
            ReliefKind::Bump(scale) => {
                let gradient = texture.gradient(tiles, place.uv).map(|slope| slope * scale);
                at.bump(surface, gradient, relief, d);
            }
            ReliefKind::Normals => {
                at.turn_to(surface, texture.color(tiles, place) * 2.0 - Vec3::ONE, relief, d);
            }
        }
    }
    let textured = !detail.textured.is_empty();
    (material, textured.then(|| material.at(detail, &world.textures, tiles, place)), opacity)
}

/// 1 with probability `weight`, which is in [0, 1], else 0; what is left of the number is as random.
#[inline]
fn choose(weight: f32, number: &mut u32) -> usize {
    const WHOLE: u64 = 1 << 32;
    let (end, n) = ((f64::from(weight) * WHOLE as f64) as u64, u64::from(*number));
    let (start, width, chosen) = if n < end { (0, end, 1) } else { (end, WHOLE - end, 0) };
    *number = (((n - start) << 32) / width) as u32;
    chosen
}

/// Whether a direction of cosine `geometric` to the geometric normal and `shading` to the shading normal leaves on one side by both; on the far side
/// only from a surface that transmits.
#[inline(always)]
fn same_side(geometric: f32, shading: f32, transmits: bool) -> bool {
    (geometric > 0.0 && (shading > 0.0 || !transmits)) || (transmits && geometric < 0.0 && shading < 0.0)
}
