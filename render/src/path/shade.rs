//! Shading of a batch.

use glam::Vec3;

use super::interaction::Interaction;
use super::{Context, Contribution, Outcome, PathRay, ShadowRay, Surface, Surfaces};
use crate::material::Material;
use crate::math::{UnitDir, unit};
use crate::ray::{Hit, PathKey};
use crate::sampler::{BSDF, LIGHT, LIGHT_CHOICE, ROULETTE, Stream};

/// Shades each ray with its hit and appends what comes of it to `out`.
///
/// `rays` and `hits` are of one length. A ray that missed brings the sky. A hit brings what the surface emits, and unless the path ends there (depth,
/// roulette, nothing reflected), a shadow ray to a light and a next ray; at the first hit `frame.split` of each.
///
/// Depth and roulette are Mitsuba's, so that equal settings mean equal work: a path has at most `max_depth` rays; after ray number `rr_depth`
/// and later ones it goes on with probability min(largest channel of the throughput, 0.95).
pub fn shade<S: Surfaces>(context: &Context, surfaces: &S, rays: &[PathRay], hits: &[Hit], out: &mut Outcome) {
    for (index, (ray, hit)) in rays.iter().zip(hits).enumerate() {
        out.counters.shaded += 1;
        if hit.is_hit() {
            shade_hit(context, ray, hit, &surfaces.surface(index, hit), out);
        } else {
            out.counters.missed += 1;
            shade_miss(context, ray, out);
        }
    }
}

/// Weight of the power heuristic (Veach 1997) for a sample of density `a` that the other technique gives with density `b`.
#[inline(always)]
fn power_heuristic(a: f32, b: f32) -> f32 {
    // as a ratio, so that no square overflows
    if a >= b {
        let r = b / a;
        1.0 / (1.0 + r * r)
    } else {
        let r = a / b;
        r * r / (1.0 + r * r)
    }
}

#[inline]
fn emit(ray: &PathRay, radiance: Vec3, light_pdf: f32, out: &mut Outcome) {
    let weight = if ray.pdf > 0.0 { power_heuristic(ray.pdf, light_pdf) } else { 1.0 };
    let value = Vec3::from(ray.throughput) * radiance * weight;
    if value != Vec3::ZERO {
        out.light.push(Contribution { pixel: ray.key.pixel, sample: ray.key.sample, value: value.to_array() });
    }
}

fn shade_miss(context: &Context, ray: &PathRay, out: &mut Outcome) {
    emit(ray, context.lights.sky(), context.lights.sky_pdf(), out);
}

#[inline]
fn shade_hit(context: &Context, ray: &PathRay, hit: &Hit, surface: &Surface, out: &mut Outcome) {
    let frame = context.frame;
    let (o, d) = (Vec3::from(ray.o), Vec3::from(ray.dir.decode()));
    let Some(at) = Interaction::new(o, d, hit, surface) else {
        out.counters.absorbed += 1;
        return;
    };
    let shape = &context.world.shapes[surface.shape as usize];
    if let Some(emission) = shape.emission
        && at.from_front
    {
        let light_pdf = if ray.pdf > 0.0 { context.lights.pdf(surface.prim, o, hit.t, -at.normal.dot(d)) } else { 0.0 };
        emit(ray, emission.into(), light_pdf, out);
    }
    let vertex = u32::from(ray.key.vertex) + 1;
    if vertex >= frame.max_depth {
        out.counters.depth += 1;
        return;
    }
    let material = &context.world.materials[shape.material as usize];
    if !(at.from_front || material.two_sided) {
        out.counters.absorbed += 1;
        return;
    }
    let stream = Stream::new(frame.seed, ray.key.pixel, ray.key.sample);
    // a mirror would send every sibling the same way
    if vertex == 1 && frame.split > 1 && !material.bsdf.is_delta() {
        let share = (Vec3::from(ray.throughput) / frame.split as f32).to_array();
        for child in 0..frame.split {
            let key = PathKey { branch: child as u16, ..ray.key };
            let sibling = PathRay { key, throughput: share, ..*ray };
            scatter(context, &sibling, d, surface, material, &at, &stream, out);
        }
    } else {
        scatter(context, ray, d, surface, material, &at, &stream, out);
    }
}

/// A shadow ray and a next ray from a point.
#[inline(always)]
fn scatter(
    context: &Context,
    ray: &PathRay,
    d: Vec3,
    surface: &Surface,
    material: &Material,
    at: &Interaction,
    stream: &Stream,
    out: &mut Outcome,
) {
    let frame = context.frame;
    let bsdf = &material.bsdf;
    let key = PathKey { vertex: ray.key.vertex + 1, ..ray.key };
    let numbers = stream.vertex(u32::from(key.vertex), frame.split, u32::from(key.branch));
    let origin = at.origin();
    let basis = at.basis(surface, bsdf.is_anisotropic());
    let wo = basis.to_local(-d);
    let throughput = Vec3::from(ray.throughput);

    if !bsdf.is_delta() {
        let place = [unit(numbers[LIGHT]), unit(numbers[LIGHT + 1])];
        if let Some(light) = context.lights.sample(origin, numbers[LIGHT_CHOICE], place) {
            let dir = UnitDir::encode(light.d.to_array());
            let wi = Vec3::from(dir.decode());
            // by the geometric normal too, or light would leak through the surface
            if wi.dot(at.normal) > 0.0 {
                let scattered = bsdf.eval(wo, basis.to_local(wi));
                let weight = power_heuristic(light.pdf, scattered.pdf) / light.pdf;
                let contribution = throughput * scattered.value * light.radiance * weight;
                if contribution != Vec3::ZERO {
                    out.shadow.push(ShadowRay {
                        o: origin.to_array(),
                        dir,
                        tmax: light.tmax,
                        contribution: contribution.to_array(),
                        key: ray.key,
                    });
                }
            }
        }
    }

    let Some(wi) = bsdf.sample(wo, [unit(numbers[BSDF]), unit(numbers[BSDF + 1])]) else {
        out.counters.absorbed += 1;
        return;
    };
    let dir = UnitDir::encode(basis.to_world(wi).to_array());
    let wi = Vec3::from(dir.decode());
    // of the direction as it travels
    let (weight, pdf) = if bsdf.is_delta() {
        (bsdf.delta_weight(wo), 0.0)
    } else {
        let scattered = bsdf.eval(wo, basis.to_local(wi));
        (scattered.value / scattered.pdf, scattered.pdf)
    };
    let mut throughput = throughput * weight;
    let largest = throughput.max_element();
    if !(wi.dot(at.normal) > 0.0 && largest > 0.0) {
        out.counters.absorbed += 1;
        return;
    }
    if u32::from(key.vertex) >= frame.rr_depth {
        // siblings are as likely to go on as an only child
        let go_on = (largest * frame.split as f32).min(0.95);
        if unit(numbers[ROULETTE]) >= go_on {
            out.counters.roulette += 1;
            return;
        }
        throughput /= go_on;
    }
    out.next.push(PathRay { o: origin.to_array(), dir, key, throughput: throughput.to_array(), pdf });
}
