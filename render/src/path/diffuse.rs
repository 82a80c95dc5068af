//! One vertex on a flat diffuse surface, without branches: the same lines serve one vertex and, in loops, many.

use std::f32::consts::FRAC_1_PI;

use glam::Vec3;

use super::power_heuristic;
use crate::math::{Basis, UnitDir, concentric_disk};

/// What becomes of a path at a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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

/// The direction to a light sample, snapped, as code and as floats, and the contribution of a shadow ray along it: 0 when there is none.
///
/// `n` is the normal on the side of the path, `d`, `pdf` and `radiance` the light sample, which counts when `ok`.
#[inline(always)]
pub(super) fn towards_light(
    throughput: Vec3,
    reflectance: Vec3,
    n: Vec3,
    d: Vec3,
    pdf: f32,
    radiance: Vec3,
    ok: bool,
) -> (UnitDir, Vec3, Vec3) {
    let dir = UnitDir::encode(d.to_array());
    let wi = Vec3::from(dir.decode());
    let cos = wi.dot(n);
    let bsdf = cos * FRAC_1_PI;
    let weight = bsdf * (power_heuristic(pdf, bsdf) / pdf);
    let contribution = throughput * reflectance * radiance * weight;
    // before snapping too, which is cheap to know first
    (dir, wi, select(ok & (d.dot(n) > 0.0) & (cos > 0.0), contribution, Vec3::ZERO))
}

/// The next direction, snapped, as code and as floats, its throughput and density. `go_on` in [0, 1) decides roulette, when `roulette` says that it takes place, with
/// `siblings` times the throughput.
#[inline(always)]
pub(super) fn onwards(
    throughput: Vec3,
    reflectance: Vec3,
    n: Vec3,
    u: [f32; 2],
    go_on: f32,
    roulette: bool,
    siblings: f32,
) -> (UnitDir, Vec3, Vec3, f32, Fate) {
    // cosine-weighted (Malley's method); the weight is the albedo
    let [x, y] = concentric_disk(u);
    let z2 = 1.0 - x * x - y * y;
    let dir = UnitDir::encode(Basis::new(n).to_world(Vec3::new(x, y, z2.max(0.0).sqrt())).to_array());
    let wi = Vec3::from(dir.decode());
    let cos = wi.dot(n);
    let throughput = throughput * reflectance;
    let largest = throughput.x.max(throughput.y).max(throughput.z);
    let chance = if roulette { (largest * siblings).min(0.95) } else { 1.0 };
    let fate = if !((z2 > 0.0) & (cos > 0.0) & (largest > 0.0)) {
        Fate::Absorbed
    } else if go_on >= chance {
        Fate::Roulette
    } else {
        Fate::On
    };
    (dir, wi, throughput / chance, cos * FRAC_1_PI, fate)
}
