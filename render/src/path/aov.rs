//! AOVs of a batch of rays, beside their shading and apart from it: without any asked for nothing of this runs.

use glam::Vec3;

use super::interaction::Interaction;
use super::shade::{appearance, hidden, is_first};
use super::{Context, PathRay, ShadowRay, Surfaces, camera_ray};
use crate::aov::{Aov, Aovs};
use crate::ray::Hit;
use crate::sampler::{LOBE, Stream};

/// Hands over what the AOVs of a film want of rays that were shaded, and of the shadow rays that shading them has made: AOV, pixel, sample
/// and values, as a film adds them.
///
/// Like light, what a ray brings is a function of (frame, world, ray, hit) alone. `rays` and `hits` are of one length.
pub fn take_aovs<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    rays: &[PathRay],
    hits: &[Hit],
    shadows: &[ShadowRay],
    aovs: Aovs,
    mut add: impl FnMut(Aov, u32, u32, &[f32]),
) {
    if aovs.is_empty() {
        return;
    }
    if aovs.contains(Aov::Cost) {
        // of siblings that trace one camera ray each, the first stands for all: the figure is the picture's, not that of the way it is made
        for (ray, _) in rays.iter().zip(hits).filter(|(ray, hit)| hit.is_hit() && is_first(context, ray)) {
            add(Aov::Cost, ray.key.pixel, ray.key.sample, &[1.0]);
        }
        for shadow in shadows.iter().filter(|s| s.contribution != [0.0; 3]) {
            add(Aov::Cost, shadow.key.pixel, shadow.key.sample, &[1.0]);
        }
    }
    if aovs.iter().all(|a| matches!(a, Aov::Cost | Aov::Variance)) {
        return;
    }
    for (index, (ray, hit)) in rays.iter().zip(hits).enumerate() {
        if ray.key.vertex == 0 && hit.is_hit() && is_first(context, ray) {
            first_hit(context, surfaces, index, (ray, hit), aovs, |aov, values| {
                add(aov, ray.key.pixel, ray.key.sample, values);
            });
        }
    }
}

/// What a camera ray comes upon.
fn first_hit<S: Surfaces>(
    context: &Context,
    surfaces: &S,
    index: usize,
    (ray, hit): (&PathRay, &Hit),
    aovs: Aovs,
    mut take: impl FnMut(Aov, &[f32]),
) {
    let (world, frame, key) = (context.world, context.frame, ray.key);
    let (number, surface) = (surfaces.shape(index, hit), surfaces.surface(index, hit));
    let shape = &world.shapes[number as usize];
    if shape.emission.is_some() && hidden(context, ray) {
        return;
    }
    let mut add = |aov: Aov, values: &[f32]| {
        if aovs.contains(aov) {
            take(aov, values);
        }
    };
    if key.sample == 0 {
        add(Aov::ObjectId, &[(number + 1) as f32]);
        add(Aov::MaterialId, &[(shape.material + 1) as f32]);
    }
    // what was hidden may have been passed through on the way
    let passed = if frame.hide_emitters && aovs.contains(Aov::Depth) {
        (Vec3::from(ray.o) - Vec3::from(camera_ray(frame, key.pixel, key.sample).o)).length()
    } else {
        0.0
    };
    add(Aov::Depth, &[passed + hit.t]);
    let d = Vec3::from(ray.dir.decode());
    // seen edge on it has no side
    let Some(mut at) = Interaction::new(ray.o.into(), d, hit, &surface) else { return };
    let [x, y, z] = at.point().to_array();
    add(Aov::Position, &[x, y, z, 1.0]);
    add(Aov::Uv, &at.place(&surface, hit).uv);
    if !(aovs.contains(Aov::Albedo) || aovs.contains(Aov::Normal)) {
        return;
    }
    // the number by which the path, or the first of its siblings, chooses among materials
    let mut number = Stream::new(frame.seed, key.pixel, key.sample).vertex(1, frame.split, 0)[LOBE];
    let material = &world.materials[shape.material as usize];
    let (met, model, opacity) = appearance(context, material, &surface, hit, d, &mut at, &mut number);
    let color = model.as_ref().unwrap_or(&met.bsdf).color() * opacity;
    add(Aov::Albedo, &color.to_array());
    let normal = if at.from_front { at.shading } else { -at.shading };
    add(Aov::Normal, &normal.to_array());
}
