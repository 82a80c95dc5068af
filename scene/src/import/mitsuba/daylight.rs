//! `sunsky`, and the `sky` and `sun` of 0.5 and 0.6.

use std::f64::consts::PI;

use super::Converter;
use super::shape::is_similarity;
use super::xml::{ObjectId, malformed};
use crate::ImportError;
use crate::description::{Affine, Beam, Environment, Skylight, Sun};
use crate::import::sky::inverse_rotation;
use crate::import::skylight::{Moment, sun_irradiance, zenith_and_azimuth};
use crate::import::vector::normalize;

/// Degrees that the sun fills.
const APERTURE: f64 = 0.5358;
/// What says when and where the sun is seen.
const MOMENT: [&str; 9] = ["year", "month", "day", "hour", "minute", "second", "timezone", "latitude", "longitude"];

/// What a daylight emitter adds to the scene.
#[derive(Default)]
pub(super) struct Daylight {
    pub sky: Option<Environment>,
    pub sun: Option<Sun>,
    /// A sun without extent.
    pub beam: Option<Beam>,
}

impl Converter<'_> {
    /// `sky`, `sun` or both. All share the model of Mitsuba 3; old files have y up, new ones z.
    pub(super) fn daylight(&mut self, id: ObjectId, plugin: &str) -> Result<Daylight, ImportError> {
        let place = self.document.objects[id].place.clone();
        let turbidity = self.float(id, "turbidity")?.unwrap_or(3.0);
        if !(1.0..=10.0).contains(&turbidity) {
            return malformed(&place, format!("turbidity {turbidity} should lie between 1 and 10"));
        }
        let old = self.document.old;
        let albedo = self.albedo(id, "albedo")?.map_or([if old { 0.15 } else { 0.3 }; 3], |c| c.map(f64::from));
        let scale = self.factor(id, "scale")?;
        let (sky_scale, sun_scale) = (scale * self.factor(id, "sky_scale")?, scale * self.factor(id, "sun_scale")?);
        let half_angle = self.half_angle(id)?;
        if self.boolean(id, "complex_sun")? == Some(true) {
            self.unsupported(
                &place,
                "complex_sun (a sun that is darker at its edge)",
                "an even disk of the same power",
            );
        }
        self.stretched(id)?;
        // how finely 0.5 and 0.6 sampled it
        self.ignore(id, &["resolution", "sampling_weight"]);

        let mut to_world = self.transform(id, "to_world")?;
        if !is_similarity(&to_world) {
            return malformed(&place, format!("the to_world of a {plugin} should be a rotation"));
        }
        if old {
            to_world = to_world.after(&Y_UP);
        }
        let to_sky = inverse_rotation(&to_world);
        let turned = |rows: &[[f64; 3]; 3], v: [f64; 3]| rows.map(|r| r[0] * v[0] + r[1] * v[1] + r[2] * v[2]);
        let sun = match self.point(id, "sun_direction")? {
            Some(direction) => {
                if let Some(name) = MOMENT.into_iter().find(|name| self.property(id, name).is_some()) {
                    return malformed(&place, format!("both sun_direction and {name}: give one of them"));
                }
                match normalize(direction) {
                    Some(unit) => turned(&to_sky, unit),
                    None => return malformed(&place, "the sun_direction has no length"),
                }
            }
            None => self.sun_at(id)?,
        };
        let axes = [0, 1, 2].map(|r| [0, 1, 2].map(|c| to_sky[c][r]));
        let (direction, up) = (turned(&axes, sun), turned(&axes, [0.0, 0.0, 1.0]));
        let mut out = Daylight::default();
        if sun[2] < 0.0 {
            tracing::warn!("{place}: the sun is below the horizon: neither it nor the sky gives any light");
            return Ok(out);
        }
        if plugin != "sun" && sky_scale > 0.0 {
            out.sky = Some(Environment::Sky(Skylight { turbidity, albedo, sun, scale: sky_scale as f32, to_world }));
        }
        if plugin != "sky" && sun_scale > 0.0 {
            let irradiance = sun_irradiance(turbidity, sun[2]).map(|v| v * sun_scale);
            if half_angle > 0.0 {
                let half = libm::sin(0.5 * half_angle);
                let radiance = irradiance.map(|v| (v / (4.0 * PI * half * half)) as f32);
                if radiance.iter().any(|v| !v.is_finite()) {
                    return malformed(
                        &place,
                        "the sun is too bright for floating point: make it larger, or sun_scale less",
                    );
                }
                out.sun = Some(Sun { direction, up, half_angle, radiance });
            } else {
                let direction = direction.map(|v| -v);
                out.beam = Some(Beam::Directional { direction, irradiance: irradiance.map(|v| v as f32) });
            }
        }
        Ok(out)
    }

    /// A factor on radiance, 1 if it is not given.
    fn factor(&self, id: ObjectId, name: &str) -> Result<f64, ImportError> {
        let factor = self.float(id, name)?.unwrap_or(1.0);
        // two of them multiplied fit a float
        if !(0.0..=1e18).contains(&factor) {
            return malformed(
                &self.document.objects[id].place,
                format!("{name} {factor} should lie between 0 and 1e18"),
            );
        }
        Ok(factor)
    }

    /// Half of the angle that the sun fills, radians; 0 for a `sun_radius_scale` of 0.
    fn half_angle(&self, id: ObjectId) -> Result<f64, ImportError> {
        let place = &self.document.objects[id].place;
        let degrees = match (self.float(id, "sun_aperture")?, self.float(id, "sun_radius_scale")?) {
            (Some(_), Some(_)) => {
                return malformed(place, "both sun_aperture and sun_radius_scale: give one of them");
            }
            (Some(aperture), None) if aperture > 0.0 && aperture < 180.0 => aperture,
            (Some(aperture), None) => {
                return malformed(place, format!("sun_aperture {aperture} should lie between 0 and 180 degrees"));
            }
            (None, Some(scale)) if scale >= 0.0 && scale * APERTURE < 180.0 => scale * APERTURE,
            (None, Some(scale)) => {
                return malformed(
                    place,
                    format!("sun_radius_scale {scale} should lie between 0 and {}", 180.0 / APERTURE),
                );
            }
            (None, None) => APERTURE,
        };
        let half = (0.5 * degrees).to_radians();
        // a sun smaller than this is none that f32 directions can meet
        Ok(if half < 1e-6 { 0.0 } else { half })
    }

    /// 0.5 and 0.6 could draw the sky out below the horizon.
    fn stretched(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let place = &self.document.objects[id].place;
        if self.float(id, "stretch")?.is_some_and(|s| s != 1.0) {
            self.unsupported(place, "stretch of a sky", "a sky that ends at the horizon");
        }
        if self.boolean(id, "extend")? == Some(true) {
            self.unsupported(place, "extend of a sky", "a sky that ends at the horizon");
        }
        Ok(())
    }

    /// Unit vector towards the sun, in the sky's directions, at a time and place; Mitsuba's by default.
    fn sun_at(&self, id: ObjectId) -> Result<[f64; 3], ImportError> {
        let place = &self.document.objects[id].place;
        let number = |name: &str, default: f64, low: f64, high: f64| -> Result<f64, ImportError> {
            let value = self.float(id, name)?.unwrap_or(default);
            if !(low..=high).contains(&value) {
                return malformed(place, format!("{name} {value} should lie between {low} and {high}"));
            }
            Ok(value)
        };
        let at = Moment {
            year: number("year", 2010.0, -4000.0, 10_000.0)? as i64,
            month: number("month", 7.0, 1.0, 12.0)? as i64,
            day: number("day", 10.0, 1.0, 31.0)? as i64,
            hour: number("hour", 15.0, -48.0, 48.0)?,
            minute: number("minute", 0.0, -60.0, 60.0)?,
            second: number("second", 0.0, -60.0, 60.0)?,
            timezone: number("timezone", 9.0, -24.0, 24.0)?,
            latitude: number("latitude", 35.6894, -90.0, 90.0)?,
            longitude: number("longitude", 139.6917, -360.0, 360.0)?,
        };
        let (zenith, azimuth) = zenith_and_azimuth(&at);
        let (sin, cos) = (libm::sin(zenith), libm::cos(zenith));
        let (east, north) = (sin * libm::sin(azimuth), sin * libm::cos(azimuth));
        // in 3 south lies along x and west along y; in 0.5 and 0.6 east along x and south along z, which is -y here
        Ok(if self.document.old { [east, north, cos] } else { [-north, -east, cos] })
    }
}

/// Turns the directions of a sky, where z is up, to those of 0.5 and 0.6, where y is.
const Y_UP: Affine = Affine([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]);
