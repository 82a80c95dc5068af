//! Light that arrives from one direction: points, spots, parallel light.

use crate::math::{gamma, luminance};
use crate::real::consts::PI;
use crate::real::{Vec3, asin, f32};
use crate::world::Beam;

/// What stands for the density of a single direction, 2^64: large enough that no BSDF's density counts beside it (the power heuristic gives the
/// light's sample all the weight), and a power of two, so that what is multiplied and divided by it is as it was.
pub(super) const SINGLE: f32 = 18_446_744_073_709_551_616.0;

/// Irradiance is at most 2^60 (nearer to a point than any surface should be), so that no product with [`SINGLE`] overflows.
const BRIGHTEST: f32 = 1_152_921_504_606_846_976.0;

/// Luminance of what it gives off over pi: to be compared with the luminance of a surface's radiance times its area. `radius2` is the square of
/// the scene's radius.
pub(super) fn power(beam: &Beam, radius2: f64) -> f64 {
    let light = |c: &[f32; 3]| f64::from(luminance(Vec3::from(*c)));
    match beam {
        Beam::Point { intensity, .. } => 4.0 * light(intensity),
        Beam::Spot { intensity, beam, cutoff, .. } => {
            let cap = |angle: f32| 1.0 - libm::cos(f64::from(angle));
            light(intensity) * (cap(*beam) + cap(*cutoff))
        }
        Beam::Directional { irradiance, .. } => light(irradiance) * radius2,
    }
}

/// Direction from `o`, limit of the shadow ray, irradiance on a surface that faces it; `None` in the dark.
#[inline]
pub(super) fn sample(beam: &Beam, o: Vec3) -> Option<(Vec3, f32, Vec3)> {
    let (d, tmax, irradiance) = unlimited(beam, o)?;
    Some((d, tmax, irradiance.min(Vec3::splat(BRIGHTEST))))
}

#[inline]
fn unlimited(beam: &Beam, o: Vec3) -> Option<(Vec3, f32, Vec3)> {
    match *beam {
        Beam::Point { position, intensity } => {
            let (d, tmax, falloff) = towards(o, position.into())?;
            Some((d, tmax, Vec3::from(intensity) * falloff))
        }
        Beam::Spot { position, axis, intensity, beam, cutoff, .. } => {
            let (d, tmax, falloff) = towards(o, position.into())?;
            // by the chord, which keeps small angles exact
            let sine = 0.5 * (Vec3::from(axis) + d).length();
            let angle = 2.0 * asin(sine.min(1.0));
            let inside = if angle <= beam { 1.0 } else { (cutoff - angle) / (cutoff - beam) };
            (inside > 0.0).then(|| (d, tmax, Vec3::from(intensity) * (falloff * inside)))
        }
        Beam::Directional { direction, irradiance } => {
            Some((-Vec3::from(direction), f32::INFINITY, Vec3::from(irradiance)))
        }
    }
}

/// Direction and limit of a shadow ray to a point, and one over the square of its distance.
#[inline]
fn towards(o: Vec3, p: Vec3) -> Option<(Vec3, f32, f32)> {
    let way = p - o;
    let distance2 = way.length_squared();
    let distance = distance2.sqrt();
    let falloff = 1.0 / distance2;
    // not from the point itself
    (distance > 0.0 && falloff > 0.0 && falloff < f32::INFINITY).then(|| {
        // short of the point by the error of both positions and of the test of a surface that it may lie on
        let error = (o.abs().max_element() + p.abs().max_element()) * gamma(4) + distance * gamma(24);
        (way / distance, (distance - error).max(0.0), falloff)
    })
}

/// Whether it can give light: everything is finite, intensities are not negative, cones are in order.
pub(super) fn shines(beam: &Beam) -> bool {
    let light = |c: &[f32; 3]| c.iter().all(|v| *v >= 0.0 && v.is_finite()) && luminance(Vec3::from(*c)) > 0.0;
    match beam {
        Beam::Point { intensity, .. } => light(intensity),
        Beam::Spot { intensity, beam, cutoff, .. } => {
            light(intensity) && 0.0 <= *beam && beam < cutoff && *cutoff <= PI
        }
        Beam::Directional { irradiance, .. } => light(irradiance),
    }
}
