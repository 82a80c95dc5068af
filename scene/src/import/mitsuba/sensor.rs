//! Sensor, film, sampler and pixel filter.

use super::Converter;
use super::xml::{ObjectId, malformed};
use crate::ImportError;
use crate::description::{Camera, Filter, Place};

/// Largest width or height of a film.
const MAX_SIDE: i64 = 1 << 16;

impl Converter<'_> {
    pub(super) fn sensor(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        // Mitsuba's film where none is given
        self.out.size = Some([768, 576]);
        self.out.filter = Some(Filter::Gaussian { stddev: 0.5 });
        for (_, film) in self.nested(id, "film")? {
            self.film(film)?;
        }
        for (_, sampler) in self.nested(id, "sampler")? {
            if let Some(n) = self.integer(sampler, "sample_count")? {
                match u32::try_from(n) {
                    Ok(n) if n > 0 => self.out.spp = Some(n),
                    _ => return malformed(&self.document.objects[sampler].place, "sample_count should be at least 1"),
                }
            }
            self.ignore(sampler, &["seed", "jitter", "scramble", "dimension"]);
            self.leave(sampler);
        }
        if self.options.size.is_some() {
            self.out.size = self.options.size;
        }
        match object.plugin.as_str() {
            "perspective" => {}
            "thinlens" => {
                self.ignore(id, &["aperture_radius", "focus_distance"]);
                self.unsupported(place, "sensor \"thinlens\"", "the pinhole camera of the same view");
            }
            plugin => {
                self.unsupported(place, format!("sensor \"{plugin}\""), "a perspective camera of the same place");
                object.properties.iter().for_each(|p| p.used.set(true));
            }
        }
        let size = self.out.size.unwrap_or([1, 1]);
        let fov_x = self.fov_x(id, f64::from(size[0]) / f64::from(size[1]), place)?;
        let to_world = self.transform(id, "to_world")?;
        if to_world.determinant() == 0.0 || !to_world.determinant().is_finite() {
            return malformed(place, "the sensor's to_world is singular");
        }
        self.out.camera = Some(Camera { to_world, fov_x });
        self.ignore(id, &["near_clip", "far_clip", "focus_distance", "shutter_open", "shutter_close"]);
        for name in ["principal_point_offset_x", "principal_point_offset_y"] {
            if self.float(id, name)?.is_some_and(|v| v != 0.0) {
                self.unsupported(place, name, "0");
            }
        }
        self.leave(id);
        Ok(())
    }

    /// Mitsuba's `parse_fov` (src/render/sensor.cpp): the full angle along x in degrees.
    fn fov_x(&mut self, id: ObjectId, aspect: f64, place: &Place) -> Result<f64, ImportError> {
        let fov = self.float(id, "fov")?;
        let focal = self.property(id, "focal_length");
        let axis = self.string(id, "fov_axis")?;
        let (fov, axis) = match (fov, focal) {
            (Some(_), Some(p)) => return malformed(&p.place, "both fov and focal_length: give one of them"),
            (Some(fov), None) => (fov, axis.map_or("x", |(a, _)| a).to_ascii_lowercase()),
            (None, _) => {
                let text = self.string(id, "focal_length")?.map_or("50mm", |(t, _)| t);
                let mm = super::value::float(text.trim().trim_end_matches("mm"), place)?;
                if mm <= 0.0 {
                    return malformed(place, "the focal length should be above 0");
                }
                let half_diagonal = f64::from(36 * 36 + 24 * 24).sqrt() / 2.0;
                (2.0 * libm::atan(half_diagonal / mm).to_degrees(), "diagonal".into())
            }
        };
        if !(fov > 0.0 && fov < 180.0) {
            return malformed(place, format!("fov {fov} should lie between 0 and 180 degrees"));
        }
        let half_tan = libm::tan(fov.to_radians() / 2.0);
        let along_x = match axis.as_str() {
            "x" => return Ok(fov),
            "smaller" if aspect <= 1.0 => return Ok(fov),
            "larger" if aspect > 1.0 => return Ok(fov),
            "y" | "smaller" | "larger" => half_tan * aspect,
            "diagonal" => half_tan / (1.0 + 1.0 / (aspect * aspect)).sqrt(),
            _ => return malformed(place, format!("fov_axis \"{axis}\" should be x, y, diagonal, smaller or larger")),
        };
        Ok(2.0 * libm::atan(along_x).to_degrees())
    }

    fn film(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        let mut size = [768, 576];
        for (slot, name) in size.iter_mut().zip(["width", "height"]) {
            if let Some(n) = self.integer(id, name)? {
                if !(1..=MAX_SIDE).contains(&n) {
                    return malformed(place, format!("{name} {n} should lie between 1 and {MAX_SIDE}"));
                }
                *slot = n as u32;
            }
        }
        self.out.size = Some(size);
        let crop = |name: &str, whole: i64| Ok::<bool, ImportError>(self.integer(id, name)?.is_none_or(|n| n == whole));
        let whole = crop("crop_width", size[0].into())?
            & crop("crop_height", size[1].into())?
            & crop("crop_offset_x", 0)?
            & crop("crop_offset_y", 0)?;
        if !whole {
            self.unsupported(place, "crop window of the film", "the whole film");
        }
        for (_, filter) in self.nested(id, "rfilter")? {
            self.out.filter = Some(self.filter(filter)?);
        }
        // how Mitsuba stores its picture is nothing to us
        self.ignore(
            id,
            &[
                "file_format",
                "pixel_format",
                "component_format",
                "banner",
                "high_quality_edges",
                "attach_log",
                "gamma",
                "exposure",
                "tonemap_method",
                "compensate",
                "sample_border",
                "variance",
                "precision",
                "key",
                "burn",
                "has_variance",
            ],
        );
        self.leave(id);
        Ok(())
    }

    fn filter(&mut self, id: ObjectId) -> Result<Filter, ImportError> {
        let object = &self.document.objects[id];
        let positive = |v: f64, name: &str| {
            if v > 0.0 && v <= 64.0 {
                Ok(v)
            } else {
                malformed(&object.place, format!("{name} {v} should lie between 0 and 64 pixels"))
            }
        };
        let filter = match object.plugin.as_str() {
            "box" => {
                self.ignore(id, &["radius"]);
                Filter::Box
            }
            "tent" => Filter::Tent { radius: positive(self.float(id, "radius")?.unwrap_or(1.0), "radius")? },
            "gaussian" => Filter::Gaussian { stddev: positive(self.float(id, "stddev")?.unwrap_or(0.5), "stddev")? },
            plugin => {
                self.unsupported(&object.place, format!("rfilter \"{plugin}\""), "gaussian of stddev 0.5");
                object.properties.iter().for_each(|p| p.used.set(true));
                Filter::Gaussian { stddev: 0.5 }
            }
        };
        self.leave(id);
        Ok(filter)
    }
}
