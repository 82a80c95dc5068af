//! What is seen where nothing is met.

use std::sync::Arc;

use glam::Vec3;

use super::{SkyMap, sphere};
use crate::math::luminance;
use crate::world::Environment;

/// The light that comes from infinitely far away, all around.
#[derive(Clone, Debug)]
pub(super) enum Sky {
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
    },
}

impl Sky {
    pub(super) fn new(environment: Option<&Environment>, map: Option<Arc<SkyMap>>) -> Sky {
        match (environment, map) {
            (Some(Environment::Constant(radiance)), _) if luminance(Vec3::from(*radiance)) > 0.0 => {
                Sky::Constant(Vec3::from(*radiance))
            }
            (Some(&Environment::Map { scale, to_map }), Some(map)) if map.shines() && scale > 0.0 => {
                Sky::Map { map, scale, to_map: to_map.map(Vec3::from) }
            }
            _ => Sky::None,
        }
    }

    /// Radiance averaged over all directions, if there is a sky.
    pub(super) fn mean(&self) -> Option<Vec3> {
        match self {
            Sky::None => None,
            Sky::Constant(radiance) => Some(*radiance),
            Sky::Map { map, scale, .. } => Some(map.mean() * *scale),
        }
    }

    /// Radiance from a unit direction, and with which density in solid angle [`Sky::sample`] gives it.
    #[inline]
    pub(super) fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        match self {
            Sky::None => (Vec3::ZERO, 0.0),
            Sky::Constant(radiance) => (*radiance, sphere::UNIFORM_PDF),
            Sky::Map { map, scale, to_map: [x, y, z] } => {
                let (radiance, pdf) = map.look_up(Vec3::new(x.dot(d), y.dot(d), z.dot(d)));
                (radiance * *scale, pdf)
            }
        }
    }

    /// A direction, the radiance from it, its density; `None` where what was chosen is not what the direction, snapped, lies in.
    #[inline]
    pub(super) fn sample(&self, u: [u32; 2]) -> Option<(Vec3, Vec3, f32)> {
        let d = match self {
            Sky::None => return None,
            Sky::Constant(radiance) => {
                let d = sphere::uniform(u.map(crate::math::unit));
                return Some((d, *radiance, sphere::UNIFORM_PDF));
            }
            // of just the direction that travels, so that whoever comes upon it finds the same
            Sky::Map { map, to_map: [x, y, z], .. } => map.sample_snapped(u, |d| *x * d.x + *y * d.y + *z * d.z),
        };
        let (radiance, pdf) = self.look_up(d);
        (pdf > 0.0).then_some((d, radiance, pdf))
    }
}
