//! Shading of a batch.

use std::f32::consts::FRAC_1_PI;

use glam::Vec3;

use super::interaction::Interaction;
use super::{Context, Contribution, Outcome, PathRay, ShadowRay, Surface, Surfaces};
use crate::material::{Bsdf, Scatter};
use crate::math::{Basis, UnitDir, concentric_disk, unit};
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
            scatter(context, &sibling, d, surface, &material.bsdf, &at, &stream, out);
        }
    } else {
        scatter(context, ray, d, surface, &material.bsdf, &at, &stream, out);
    }
}

/// A surface point's scattering, in world directions.
trait Scattering {
    /// As [`Bsdf::eval`].
    fn eval(&self, wi: Vec3) -> Scatter;
    /// As [`Bsdf::sample`].
    fn sample(&self, u: [f32; 2]) -> Option<Vec3>;
    /// The weight of the only direction there is, for a mirror.
    fn delta_weight(&self) -> Option<Vec3>;
}

/// Any BSDF.
struct General<'a> {
    bsdf: &'a Bsdf,
    basis: Basis,
    wo: Vec3,
}

impl Scattering for General<'_> {
    fn eval(&self, wi: Vec3) -> Scatter {
        self.bsdf.eval(self.wo, self.basis.to_local(wi))
    }
    fn sample(&self, u: [f32; 2]) -> Option<Vec3> {
        self.bsdf.sample(self.wo, u).map(|wi| self.basis.to_world(wi))
    }
    fn delta_weight(&self) -> Option<Vec3> {
        self.bsdf.is_delta().then(|| self.bsdf.delta_weight(self.wo))
    }
}

/// Diffuse: the same as [`General`], without a frame for what needs none.
struct Diffuse {
    reflectance: Vec3,
    n: Vec3,
}

impl Scattering for Diffuse {
    #[inline(always)]
    fn eval(&self, wi: Vec3) -> Scatter {
        let pdf = (self.n.dot(wi) * FRAC_1_PI).max(0.0);
        Scatter { value: self.reflectance * pdf, pdf }
    }
    #[inline(always)]
    fn sample(&self, u: [f32; 2]) -> Option<Vec3> {
        let [x, y] = concentric_disk(u);
        let z2 = 1.0 - x * x - y * y;
        (z2 > 0.0).then(|| Basis::new(self.n).to_world(Vec3::new(x, y, z2.sqrt())))
    }
    #[inline(always)]
    fn delta_weight(&self) -> Option<Vec3> {
        None
    }
}

#[inline(always)]
fn scatter(
    context: &Context,
    ray: &PathRay,
    d: Vec3,
    surface: &Surface,
    bsdf: &Bsdf,
    at: &Interaction,
    stream: &Stream,
    out: &mut Outcome,
) {
    if let Bsdf::Diffuse { reflectance } = bsdf {
        let diffuse = Diffuse { reflectance: Vec3::from(*reflectance), n: at.shading };
        scatter_by(context, ray, &diffuse, at, stream, out);
    } else {
        let basis = at.basis(surface, bsdf.is_anisotropic());
        let general = General { bsdf, basis, wo: basis.to_local(-d) };
        scatter_by(context, ray, &general, at, stream, out);
    }
}

/// A shadow ray and a next ray from a point.
#[inline(always)]
fn scatter_by<B: Scattering>(
    context: &Context,
    ray: &PathRay,
    bsdf: &B,
    at: &Interaction,
    stream: &Stream,
    out: &mut Outcome,
) {
    let frame = context.frame;
    let key = PathKey { vertex: ray.key.vertex + 1, ..ray.key };
    let numbers = stream.vertex(u32::from(key.vertex), frame.split, u32::from(key.branch));
    let origin = at.origin();
    let throughput = Vec3::from(ray.throughput);
    let delta = bsdf.delta_weight();

    if delta.is_none() {
        let place = [unit(numbers[LIGHT]), unit(numbers[LIGHT + 1])];
        // by the geometric normal too, or light would leak through the surface; before and after snapping
        if let Some(light) = context.lights.sample(origin, numbers[LIGHT_CHOICE], place)
            && light.d.dot(at.normal) > 0.0
        {
            let dir = UnitDir::encode(light.d.to_array());
            let wi = Vec3::from(dir.decode());
            if wi.dot(at.normal) > 0.0 {
                let scattered = bsdf.eval(wi);
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

    let Some(wi) = bsdf.sample([unit(numbers[BSDF]), unit(numbers[BSDF + 1])]) else {
        out.counters.absorbed += 1;
        return;
    };
    let dir = UnitDir::encode(wi.to_array());
    let wi = Vec3::from(dir.decode());
    // of the direction as it travels
    let (weight, pdf) = match delta {
        Some(weight) => (weight, 0.0),
        None => {
            let scattered = bsdf.eval(wi);
            (scattered.value / scattered.pdf, scattered.pdf)
        }
    };
    let mut throughput = throughput * weight;
    let largest = throughput.max_element();
    // false for NaN: 0 / 0 of a direction that snapping took below the horizon
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
