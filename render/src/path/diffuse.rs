//! One vertex on a flat diffuse surface, without branches: the same lines serve one vertex and, in loops, many.

use super::power_heuristic;
use crate::math::{Basis, UnitDir, concentric_disk};
use crate::real::consts::FRAC_1_PI;
use crate::real::{Vec3, f32};

/// What becomes of a path at a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Fate {
    /// It goes on.
    On,
    /// Nothing is reflected.
    Absorbed,
    /// Russian roulette ended it.
    Roulette,
}

/// `a` where `yes`, else `b`.
#[inline(always)]
fn select(yes: bool, a: Vec3, b: Vec3) -> Vec3 {
    let pick = |a: f32, b: f32| if yes { a } else { b };
    Vec3::new(pick(a.x, b.x), pick(a.y, b.y), pick(a.z, b.z))
}

/// A direction as it travels: its code, and what that stands for.
#[inline(always)]
pub(super) fn snap(d: Vec3) -> (UnitDir, Vec3) {
    let dir = UnitDir::encode(d.to_array());
    (dir, Vec3::from(dir.decode()))
}

/// The contribution of a shadow ray to a light sample: 0 when there is none.
///
/// `n` is the normal on the side of the path, `d`, `pdf` and `radiance` the light sample, which counts when `ok`, and `wi` its direction,
/// snapped.
#[inline(always)]
pub(super) fn towards_light(
    throughput: Vec3,
    reflectance: Vec3,
    n: Vec3,
    d: Vec3,
    wi: Vec3,
    pdf: f32,
    radiance: Vec3,
    ok: bool,
) -> Vec3 {
    let cos = wi.dot(n);
    let bsdf = cos * FRAC_1_PI;
    let weight = bsdf * (power_heuristic(pdf, bsdf) / pdf);
    let contribution = throughput * reflectance * radiance * weight;
    // before snapping too
    select(ok & (d.dot(n) > 0.0) & (cos > 0.0), contribution, Vec3::ZERO)
}

/// A cosine-weighted direction about `n` by two numbers in [0, 1) (Malley's method), to be snapped, and whether it is one.
#[inline(always)]
pub(super) fn cosine_direction(n: Vec3, u: [f32; 2]) -> (Vec3, bool) {
    let [x, y] = concentric_disk(u);
    let z2 = 1.0 - x * x - y * y;
    (Basis::new(n).to_world(Vec3::new(x, y, z2.max(0.0).sqrt())), z2 > 0.0)
}

/// Throughput and density of the next direction `wi`, which is [`cosine_direction`], snapped; the weight of such a sample is the albedo.
/// `go_on` in [0, 1) decides roulette, when `roulette` says that it takes place, with `siblings` times the throughput.
#[inline(always)]
pub(super) fn onwards(
    throughput: Vec3,
    reflectance: Vec3,
    n: Vec3,
    wi: Vec3,
    above: bool,
    go_on: f32,
    roulette: bool,
    siblings: f32,
) -> (Vec3, f32, Fate) {
    let cos = wi.dot(n);
    let throughput = throughput * reflectance;
    let largest = throughput.x.max(throughput.y).max(throughput.z);
    let chance = if roulette { (largest * siblings).min(0.95) } else { 1.0 };
    let fate = if !(above & (cos > 0.0) & (largest > 0.0)) {
        Fate::Absorbed
    } else if go_on >= chance {
        Fate::Roulette
    } else {
        Fate::On
    };
    (throughput / chance, cos * FRAC_1_PI, fate)
}
