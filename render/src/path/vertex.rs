//! One vertex of a path, without branches: the same lines serve one vertex and, in loops, many.

use super::power_heuristic;
use crate::material::Scatter;
use crate::math::{Basis, UnitDir, concentric_disk, select};
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

/// A direction as it travels: its code, and what that stands for.
#[inline(always)]
pub(super) fn snap(d: Vec3) -> (UnitDir, Vec3) {
    let dir = UnitDir::encode(d.to_array());
    (dir, Vec3::from(dir.decode()))
}

/// The contribution of a shadow ray to a light sample: 0 when there is none.
///
/// `normal` is the geometric normal on the side of the path and `n` the shading normal, `d`, `pdf` and `radiance` the light sample, which counts
/// when `ok`, and `wi` its direction, snapped.
#[inline(always)]
pub(super) fn towards_light(
    throughput: Vec3,
    reflectance: Vec3,
    normal: Vec3,
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
    // before snapping too; and by the geometric normal, or light would leak through the surface
    select(ok & (d.dot(n) > 0.0) & (cos > 0.0) & (wi.dot(normal) > 0.0), contribution, Vec3::ZERO)
}

/// The same by what the surface makes of it.
#[inline(always)]
pub(super) fn scattered_light(
    throughput: Vec3,
    scatter: Scatter,
    normal: Vec3,
    wi: Vec3,
    pdf: f32,
    radiance: Vec3,
    ok: bool,
) -> Vec3 {
    let weight = power_heuristic(pdf, scatter.pdf) / pdf;
    let contribution = throughput * scatter.value * radiance * weight;
    select(ok & (wi.dot(normal) > 0.0), contribution, Vec3::ZERO)
}

/// A cosine-weighted direction about `n` by two numbers in [0, 1) (Malley's method), to be snapped, and whether it is one.
#[inline(always)]
pub(super) fn cosine_direction(n: Vec3, u: [f32; 2]) -> (Vec3, bool) {
    let [x, y] = concentric_disk(u);
    let z2 = 1.0 - x * x - y * y;
    (Basis::new(n).to_world(Vec3::new(x, y, z2.max(0.0).sqrt())), z2 > 0.0)
}

/// Throughput and density of the next direction `wi`, which is [`cosine_direction`] about the shading normal `n`, snapped; the weight of such a
/// sample is the albedo. `go_on` in [0, 1) decides roulette, when `roulette` says that it takes place.
#[inline(always)]
pub(super) fn onwards(
    throughput: Vec3,
    reflectance: Vec3,
    normal: Vec3,
    n: Vec3,
    wi: Vec3,
    above: bool,
    go_on: f32,
    roulette: bool,
) -> (Vec3, f32, Fate) {
    let cos = wi.dot(n);
    let leaves = above & (cos > 0.0) & (wi.dot(normal) > 0.0);
    let (throughput, fate) = survive(throughput, throughput * reflectance, leaves, go_on, roulette);
    (throughput, cos * FRAC_1_PI, fate)
}

/// The same for a direction that the surface's model gave, of weight value over density.
#[inline(always)]
pub(super) fn scattered_onwards(
    throughput: Vec3,
    scatter: Scatter,
    normal: Vec3,
    wi: Vec3,
    above: bool,
    go_on: f32,
    roulette: bool,
) -> (Vec3, f32, Fate) {
    // 0 / 0 of a direction that snapping took below the horizon is absorbed
    let after = throughput * (scatter.value / scatter.pdf);
    let (throughput, fate) = survive(throughput, after, above & (wi.dot(normal) > 0.0), go_on, roulette);
    (throughput, scatter.pdf, fate)
}

/// What becomes of a path that `leaves` a vertex where its throughput went from `before` to `after`, and its throughput then.
///
/// It goes on with the probability that the vertex leaves it of its worth, so that its worth stays what the first vertices made it (absorption as in
/// nature: Arvo and Kirk, "Particle Transport and Image Synthesis", SIGGRAPH 1990). By the throughput itself, as Mitsuba has it, a path that has met
/// something dark first is ended at once, though its pixel needs it as much as a bright one does: relative error is what counts.
#[inline(always)]
pub(super) fn survive(before: Vec3, after: Vec3, leaves: bool, go_on: f32, roulette: bool) -> (Vec3, Fate) {
    let largest = |v: Vec3| v.x.max(v.y).max(v.z);
    let left = largest(after);
    let chance = if roulette { (left / largest(before)).min(0.95) } else { 1.0 };
    // false for NaN
    let fate = if !(leaves & (left > 0.0)) {
        Fate::Absorbed
    } else if go_on >= chance {
        Fate::Roulette
    } else {
        Fate::On
    };
    (after / chance, fate)
}
