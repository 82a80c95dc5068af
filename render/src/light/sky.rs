//! What is seen where nothing is met: a dome of light, and a sun in it.
//!
//! Both are one source: a sample is one of the sun's with a fixed probability, a multiple of 2^-32, else one of the dome's, and a direction's density is
//! that of both together.

use std::sync::Arc;

use super::sun::Sun;
use super::{SkyMap, sphere};
use crate::math::{UnitDir, luminance};
use crate::real::{Vec3, f32};
use crate::world::{Environment, World};

/// All numbers that choose between sun and dome.
const WHOLE: u64 = 1 << 32;
/// Neither sun nor dome is chosen less often than this where there are both: whichever is the brighter may be out of sight.
const LEAST: f64 = 0.125;

/// The light that comes from infinitely far away, all around.
#[derive(Clone, Debug)]
pub(super) struct Sky {
    dome: Dome,
    sun: Option<Sun>,
    /// Numbers below this choose the sun.
    sun_end: u64,
}

/// The sky without the sun.
#[derive(Clone, Debug)]
enum Dome {
    /// None.
    None,
    /// The same from everywhere, sampled evenly.
    Constant(Vec3),
    /// A picture, turned.
    Map {
        map: Arc<SkyMap>,
        scale: f32,
        /// Rows of the rotation from the world's directions to the map's.
        to_map: [Vec3; 3],
        /// Its lower half is dark.
        upper: bool,
    },
}

impl Sky {
    pub(super) fn new(world: &World, map: Option<Arc<SkyMap>>) -> Sky {
        let dome = Dome::new(world.environment.as_ref(), map);
        let sun = world.sun.as_ref().and_then(Sun::new);
        let light = |mean: Option<Vec3>| mean.map_or(0.0, |m| f64::from(luminance(m)));
        let (of_sun, of_dome) = (light(sun.as_ref().map(Sun::mean)), light(dome.mean()));
        let share = match (of_sun > 0.0, of_dome > 0.0) {
            (false, _) => 0.0,
            (true, false) => 1.0,
            (true, true) => (of_sun / (of_sun + of_dome)).clamp(LEAST, 1.0 - LEAST),
        };
        Sky { dome, sun, sun_end: (share * WHOLE as f64) as u64 }
    }

    /// Whether there is none.
    pub(super) fn is_dark(&self) -> bool {
        matches!(self.dome, Dome::None) && self.sun.is_none()
    }

    /// Radiance averaged over all directions, if there is a sky.
    pub(super) fn mean(&self) -> Option<Vec3> {
        match (self.dome.mean(), &self.sun) {
            (dome, Some(sun)) => Some(dome.unwrap_or(Vec3::ZERO) + sun.mean()),
            (dome, None) => dome,
        }
    }

    /// Radiance from a unit direction, and with which density in solid angle [`Sky::sample`] gives it.
    #[inline]
    pub(super) fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        let Some(sun) = &self.sun else { return self.dome.look_up(d) };
        let (of_dome, of_sun) = (self.dome.look_up(d), sun.look_up(d));
        let share = self.sun_end as f32 * (1.0 / WHOLE as f32);
        (of_dome.0 + of_sun.0, of_dome.1 * (1.0 - share) + of_sun.1 * share)
    }

    /// A direction, the radiance from it, its density; `None` where what was chosen is not what the direction, snapped, lies in.
    #[inline]
    pub(super) fn sample(&self, u: [u32; 2]) -> Option<(Vec3, Vec3, f32)> {
        let number = u64::from(u[0]);
        let d = match &self.sun {
            // what is left of the number is as random
            Some(sun) if number < self.sun_end => sun.sample([((number << 32) / self.sun_end) as u32, u[1]]),
            Some(_) => {
                let rest = ((number - self.sun_end) << 32) / (WHOLE - self.sun_end);
                self.dome.sample([rest as u32, u[1]])?
            }
            None => match &self.dome {
                Dome::Constant(radiance) => {
                    let d = sphere::uniform(u.map(crate::math::unit));
                    return Some((d, *radiance, sphere::UNIFORM_PDF));
                }
                dome => dome.sample(u)?,
            },
        };
        let (radiance, pdf) = self.look_up(d);
        (pdf > 0.0).then_some((d, radiance, pdf))
    }
}

impl Dome {
    fn new(environment: Option<&Environment>, map: Option<Arc<SkyMap>>) -> Dome {
        match (environment, map) {
            (Some(Environment::Constant(radiance)), _) if luminance(Vec3::from(*radiance)) > 0.0 => {
                Dome::Constant(Vec3::from(*radiance))
            }
            (Some(&Environment::Map { scale, to_map, upper }), Some(map)) if map.shines() && scale > 0.0 => {
                Dome::Map { map, scale, to_map: to_map.map(Vec3::from), upper }
            }
            _ => Dome::None,
        }
    }

    fn mean(&self) -> Option<Vec3> {
        match self {
            Dome::None => None,
            Dome::Constant(radiance) => Some(*radiance),
            Dome::Map { map, scale, .. } => Some(map.mean() * *scale),
        }
    }

    #[inline]
    fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        match self {
            Dome::None => (Vec3::ZERO, 0.0),
            Dome::Constant(radiance) => (*radiance, sphere::UNIFORM_PDF),
            Dome::Map { map, scale, to_map: [x, y, z], upper } => {
                let up = y.dot(d);
                let (radiance, pdf) = map.look_up(Vec3::new(x.dot(d), up, z.dot(d)));
                (if *upper && up < 0.0 { Vec3::ZERO } else { radiance * *scale }, pdf)
            }
        }
    }

    /// A direction as it travels, so that whoever comes upon it finds the same.
    #[inline]
    fn sample(&self, u: [u32; 2]) -> Option<Vec3> {
        match self {
            Dome::None => None,
            Dome::Constant(_) => {
                let d = sphere::uniform(u.map(crate::math::unit));
                Some(Vec3::from(UnitDir::encode(d.to_array()).decode()))
            }
            Dome::Map { map, to_map: [x, y, z], .. } => Some(map.sample_snapped(u, |d| *x * d.x + *y * d.y + *z * d.z)),
        }
    }
}
