//! Sensor, film, sampler and pixel filter.

use super::Converter;
use super::xml::{ObjectId, Value, malformed};
use crate::ImportError;
use crate::description::{Camera, Filter, Place, Projection};

/// A film's size, and the part of it that is the picture: x, y, width, height.
type Crop = ([u32; 2], [u32; 4]);

/// Films that hold a picture in colours: those of 0.5, 0.6 and 3.
const FILMS: &[&str] = &["hdrfilm", "ldrfilm", "mfilm", "tiledhdrfilm", "exrfilm", "pngfilm"];

/// Largest width or height of a film: what a frame takes.
const MAX_SIDE: i64 = 65535;

impl Converter<'_> {
    pub(super) fn sensor(&mut self, id: ObjectId) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        // Mitsuba's film where none is given
        self.out.size = Some([768, 576]);
        self.out.filter = Some(Filter::Gaussian { stddev: 0.5 });
        let mut crop = None;
        let (films, samplers) = (self.nested(id, "film")?, self.nested(id, "sampler")?);
        for (what, found) in [("film", &films), ("sampler", &samplers)] {
            if let Some((p, _)) = found.get(1) {
                return malformed(&p.place, format!("a second {what} in one sensor: leave one of them"));
            }
        }
        for (_, film) in films {
            crop = self.film(film)?;
        }
        for (_, sampler) in samplers {
            if let Some(n) = self.integer(sampler, "sample_count")? {
                match u32::try_from(n) {
                    Ok(n) if n > 0 => self.out.spp = Some(n),
                    _ => {
                        return malformed(
                            self.place_of(sampler, "sample_count"),
                            format!("sample_count {n} should be at least 1"),
                        );
                    }
                }
            }
            self.ignore(sampler, &["seed", "jitter", "scramble", "dimension"]);
            self.leave(sampler);
        }
        if self.options.size.is_some() {
            self.out.size = self.options.size;
        }
        // a field of view is that of the whole film
        let film = crop.map_or(self.out.size.unwrap_or([1, 1]), |(film, _)| film);
        let aspect = f64::from(film[0]) / f64::from(film[1]);
        let projection = match object.plugin.as_str() {
            "perspective" => Projection::Perspective { fov_x: self.fov_x(id, aspect, place)? },
            "thinlens" => self.thin_lens(id, aspect)?,
            "orthographic" => Projection::Orthographic,
            plugin => {
                let fov_x = self.fov_x(id, aspect, place)?;
                self.unsupported(place, format!("sensor \"{plugin}\""), "a perspective camera of the same place");
                object.properties.iter().for_each(|p| p.used.set(true));
                Projection::Perspective { fov_x }
            }
        };
        let to_world = self.transform(id, "to_world")?;
        if to_world.determinant() == 0.0 || !to_world.determinant().is_finite() {
            return malformed(
                self.place_of(id, "to_world"),
                "the sensor's to_world is singular, so that it looks nowhere: leave out the scale of 0, or give it a lookat",
            );
        }
        self.out.camera = Some(Camera { to_world, projection, crop });
        self.ignore(id, &["focus_distance"]);
        self.pass_over(id, &["near_clip", "far_clip"], "nothing is clipped");
        self.pass_over(id, &["shutter_open", "shutter_close"], "nothing moves while the shutter is open");
        for name in ["principal_point_offset_x", "principal_point_offset_y"] {
            if self.float(id, name)?.is_some_and(|v| v != 0.0) {
                let at = self.place_of(id, name).clone();
                self.unsupported(&at, name, "0");
            }
        }
        self.leave(id);
        Ok(())
    }

    fn thin_lens(&mut self, id: ObjectId, aspect: f64) -> Result<Projection, ImportError> {
        let place = &self.document.objects[id].place;
        let fov_x = self.fov_x(id, aspect, place)?;
        let Some(aperture) = self.float(id, "aperture_radius")? else {
            return malformed(place, "a thinlens without an aperture_radius");
        };
        // where Mitsuba's far clip plane is, when nothing is said
        let focus = match self.float(id, "focus_distance")? {
            Some(focus) => focus,
            None => self.float(id, "far_clip")?.unwrap_or(1e4),
        };
        if !(aperture >= 0.0 && focus > 0.0) {
            return malformed(
                place,
                format!("aperture_radius {aperture} and focus_distance {focus}: they should be at least 0 and above 0"),
            );
        }
        Ok(Projection::ThinLens { fov_x, aperture, focus })
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

    /// Size and filter of the film; what of it is the picture, if that is not all.
    fn film(&mut self, id: ObjectId) -> Result<Option<Crop>, ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        if !FILMS.contains(&object.plugin.as_str()) {
            self.unsupported(place, format!("film \"{}\"", object.plugin), "hdrfilm");
            if self.options.substitute {
                // of what it has beside a size nothing is known
                let known = ["width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"];
                let others = object.properties.iter().filter(|p| !known.contains(&p.name.as_str()));
                others.filter(|p| !matches!(p.value, Value::Object(_))).for_each(|p| p.used.set(true));
            }
        }
        let mut size = [768, 576];
        for (slot, name) in size.iter_mut().zip(["width", "height"]) {
            if let Some(n) = self.integer(id, name)? {
                if !(1..=MAX_SIDE).contains(&n) {
                    return malformed(
                        self.place_of(id, name),
                        format!("{name} {n} should lie between 1 and {MAX_SIDE}"),
                    );
                }
                *slot = n as u32;
            }
        }
        let get = |name: &str, default: u32| self.integer(id, name).map(|n| n.unwrap_or(default.into()));
        let (x, y) = (get("crop_offset_x", 0)?, get("crop_offset_y", 0)?);
        let (width, height) = (get("crop_width", size[0])?, get("crop_height", size[1])?);
        let inside = |at: i64, length: i64, all: u32| {
            (0..i64::from(all)).contains(&at) && (1..=i64::from(all) - at).contains(&length)
        };
        if !(inside(x, width, size[0]) && inside(y, height, size[1])) {
            return malformed(
                place,
                format!(
                    "the crop of {width} x {height} at ({x}, {y}) should lie on the film of {} x {}",
                    size[0], size[1]
                ),
            );
        }
        let part = [x, y, width, height].map(|n| n as u32);
        self.out.size = Some([part[2], part[3]]);
        let crop = (part != [0, 0, size[0], size[1]]).then_some((size, part));
        let filters = self.nested(id, "rfilter")?;
        if let Some((p, _)) = filters.get(1) {
            return malformed(&p.place, "a second rfilter in one film: leave one of them");
        }
        for (_, filter) in filters {
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
        Ok(crop)
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
                // half of what rounding leaves of half a pixel: Mitsuba's default has a margin, and files write it
                if let Some(radius) = self.float(id, "radius")?.filter(|r| (r - 0.5).abs() > 1e-3) {
                    self.unsupported(&object.place, format!("rfilter \"box\" of radius {radius}"), "radius 0.5");
                }
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
