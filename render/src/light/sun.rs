//! A disk that shines evenly from infinitely far away.

use crate::math::{Basis, UnitDir, luminance, sincos_turn};
use crate::real::consts::PI;
use crate::real::{Vec3, f32};
use crate::world;

/// The sun, sampled evenly by solid angle.
#[derive(Clone, Debug)]
pub(super) struct Sun {
    basis: Basis,
    up: Vec3,
    /// 1 - cos of half the angle that it fills.
    cap: f32,
    radiance: Vec3,
    density: f32,
}

impl Sun {
    /// `None` if it gives no light, or its numbers are no disk's.
    pub(super) fn new(sun: &world::Sun) -> Option<Sun> {
        let (direction, up, radiance) = (Vec3::from(sun.direction), Vec3::from(sun.up), Vec3::from(sun.radiance));
        let density = 1.0 / (2.0 * PI * sun.cap);
        let sound = direction.is_normalized()
            && up.is_finite()
            && sun.cap > 0.0
            && sun.cap < 1.0
            && density.is_finite()
            && radiance.is_finite()
            && radiance.min_element() >= 0.0
            && luminance(radiance) > 0.0;
        sound.then(|| Sun { basis: Basis::new(direction), up, cap: sun.cap, radiance, density })
    }

    /// Its part of the radiance averaged over all directions, the horizon aside.
    pub(super) fn mean(&self) -> Vec3 {
        self.radiance * (0.5 * self.cap)
    }

    /// Radiance from a unit direction, and with which density [`Sun::sample`] gives it.
    #[inline]
    pub(super) fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        // half the square of the chord is 1 - cos, and keeps the digits of small angles
        if 0.5 * (d - self.basis.n).length_squared() > self.cap {
            return (Vec3::ZERO, 0.0);
        }
        (if self.up.dot(d) < 0.0 { Vec3::ZERO } else { self.radiance }, self.density)
    }

    /// A direction by two numbers in [0, 1), as it travels: the snapped one of some at the edge lies outside.
    #[inline(always)]
    pub(super) fn sample(&self, u: [f32; 2]) -> Vec3 {
        let below = self.cap * u[0];
        let sin = (below * (2.0 - below)).sqrt();
        let (s, c) = sincos_turn(u[1]);
        let d = self.basis.to_world(Vec3::new(sin * c, sin * s, 1.0 - below));
        Vec3::from(UnitDir::encode(d.to_array()).decode())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::light::{Lights, SkyMap};
    use crate::testing::{Rng, chi_square};
    use crate::world::{Environment, World};

    fn sun(half_angle: f32, direction: Vec3, up: Vec3) -> world::Sun {
        let cap = 2.0 * (0.5 * half_angle).sin().powi(2);
        world::Sun {
            direction: direction.normalize().to_array(),
            up: up.to_array(),
            cap,
            radiance: [1.0e3, 2.0e3, 0.5e3],
        }
    }

    /// Snapped samples are even over the disk, and the density is one over its solid angle.
    #[test]
    fn samples_are_even_over_the_disk() {
        let mut rng = Rng(5);
        for (half_angle, direction) in
            [(0.004_676, Vec3::new(0.3, 0.8, -0.2)), (0.09, Vec3::NEG_Z), (0.5, Vec3::new(-1.0, 0.1, 0.1))]
        {
            let described = sun(half_angle, direction, Vec3::ZERO);
            let sun = Sun::new(&described).unwrap();
            let (n, rings, sectors) = (200_000, 16, 16);
            let mut counts = vec![0.0; rings * sectors];
            let mut outside = 0;
            for _ in 0..n {
                let d = sun.sample([rng.f32(), rng.f32()]);
                let local = sun.basis.to_local(d).as_dvec3();
                let below = 0.5 * (d - sun.basis.n).as_dvec3().length_squared() / f64::from(sun.cap);
                let (radiance, pdf) = sun.look_up(d);
                outside += u32::from(pdf == 0.0);
                assert!(pdf == 0.0 || (radiance == sun.radiance && pdf == sun.density));
                assert!(below < 1.0 + 1e-4, "{below}");
                let ring = ((below * rings as f64) as usize).min(rings - 1);
                let turn = local.y.atan2(local.x) / std::f64::consts::TAU + 0.5;
                counts[ring * sectors + ((turn * sectors as f64) as usize).min(sectors - 1)] += 1.0;
            }
            assert!(outside < n / 10_000, "{outside} lost at the edge");
            chi_square(&counts, &vec![f64::from(n) / counts.len() as f64; counts.len()]);
            let solid = 4.0 * std::f64::consts::PI * (0.5 * f64::from(half_angle)).sin().powi(2);
            assert!((f64::from(sun.density) * solid - 1.0).abs() < 1e-5);
        }
    }

    /// Half a disk on the horizon gives half its light, by sampling, under a dome or without one; look-ups say the density of both.
    #[test]
    fn sun_and_dome_add_up() {
        let direction = Vec3::X;
        let half_angle = 0.1f32;
        let map = || Arc::new(SkyMap::new(16, 9, vec![[3.0, 2.0, 1.0]; 16 * 9]).unwrap());
        let turned =
            Environment::Map { scale: 2.0, to_map: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], upper: true };
        for (environment, dome) in [
            (None, Vec3::ZERO),
            (Some(Environment::Constant([5.0, 1.0, 2.0])), Vec3::new(5.0, 1.0, 2.0) * 4.0 * PI),
            (Some(turned), Vec3::new(6.0, 4.0, 2.0) * 2.0 * PI),
        ] {
            let described = sun(half_angle, direction, Vec3::Y);
            let world = World { environment, sun: Some(described), ..World::default() };
            let lights = Lights::with_sky_map(&world, Some(map()));
            let mut rng = Rng(6);
            let (mut sum, mut solid, n) = (Vec3::ZERO.as_dvec3(), 0.0, 400_000);
            let mut of_sun = 0;
            for _ in 0..n {
                let Some(s) = lights.sample(Vec3::ZERO, rng.u32(), [rng.u32(), rng.u32()]) else { continue };
                let (radiance, pdf) = lights.sky(s.d);
                assert!(radiance == s.radiance && pdf == s.pdf && pdf > 0.0);
                sum += radiance.as_dvec3() / f64::from(pdf);
                solid += 1.0 / f64::from(pdf);
                of_sun += u32::from(s.d.angle_between(direction) < half_angle);
            }
            let cap = 4.0 * std::f64::consts::PI * (0.5 * f64::from(half_angle)).sin().powi(2);
            let expected = Vec3::from(described.radiance).as_dvec3() * 0.5 * cap + dome.as_dvec3();
            let found = sum / f64::from(n);
            assert!(((found - expected) / expected).abs().max_element() < 0.02, "{found} {expected}");
            // the density is one over the solid angle that it covers
            let covered = if world.environment.is_some() { 4.0 * std::f64::consts::PI } else { cap };
            assert!((solid / f64::from(n) / covered - 1.0).abs() < 0.02, "{solid} {covered}");
            assert!(of_sun >= n / 8, "{of_sun}");
            let above = Vec3::new(1.0, 0.01, 0.0).normalize();
            let below = Vec3::new(1.0, -0.01, 0.0).normalize();
            assert!(lights.sky(above).0.y > 1.9e3 && lights.sky(below).0.y < 10.0 && lights.sky(Vec3::Y).0.y < 10.0);
        }
    }

    #[test]
    fn broken_suns_give_no_light() {
        let good = sun(0.1, Vec3::X, Vec3::Y);
        assert!(Sun::new(&good).is_some());
        for bad in [
            world::Sun { cap: 0.0, ..good },
            world::Sun { cap: 1e-45, ..good },
            world::Sun { cap: 1.5, ..good },
            world::Sun { cap: f32::NAN, ..good },
            world::Sun { direction: [0.0; 3], ..good },
            world::Sun { radiance: [f32::NAN, 1.0, 1.0], ..good },
            world::Sun { radiance: [-1.0, 9.0, 1.0], ..good },
            world::Sun { radiance: [0.0; 3], ..good },
        ] {
            assert!(Sun::new(&bad).is_none(), "{bad:?}");
            let world = World { sun: Some(bad), ..World::default() };
            assert!(Lights::new(&world).is_empty());
        }
    }
}
