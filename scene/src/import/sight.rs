//! What a camera meets first: whether it stands inside of something that takes all light, which is a black picture and no error.
//!
//! A few rays against every primitive, one after the other: no tree is needed for a look at a source that is read anyway.

use rayherd_render::camera::Camera;

use super::stream::{DescriptionSource, StreamOptions};
use super::vector::{cross, dot, sub};
use crate::ImportError;
use crate::description::{Amount, Description};
use crate::record::{Record, RecordSource};

/// Rays along an edge of the picture; through the middles of as many rows and columns.
const ROWS: u32 = 4;
/// Records read at a time.
const BATCH: usize = 4096;

/// Rays of a camera, and the first thing that each has met so far.
pub struct Sight {
    rays: Vec<Ray>,
    /// Of the camera's coordinates, in the world.
    offset: [f64; 3],
}

struct Ray {
    origin: [f64; 3],
    direction: [f64; 3],
    /// Distance, the shape, and whether its back was met.
    first: Option<(f64, u32, bool)>,
}

impl Sight {
    /// Nothing is met yet. `size` is the picture's in pixels, `offset` the point of the world that is the origin of the camera's coordinates.
    pub fn new(camera: &Camera, size: [u32; 2], offset: [f64; 3]) -> Sight {
        let middle = |i: u32, length: u32| (f64::from(i) + 0.5) * f64::from(length) / f64::from(ROWS);
        let ray = |i: u32| {
            // through the middle of a lens
            let half = || [1 << 31; 2];
            let (o, d) = camera.ray(middle(i % ROWS, size[0]), middle(i / ROWS, size[1]), half);
            Ray { origin: o.map(f64::from), direction: d.map(f64::from), first: None }
        };
        Sight { rays: (0..ROWS * ROWS).map(ray).collect(), offset }
    }

    /// Reads a scene once. A scene that cannot be read to its end has its own error.
    ///
    /// # Errors
    /// The source cannot be read.
    pub fn look(mut self, description: &Description) -> Result<Sight, ImportError> {
        let source = DescriptionSource::new(description, StreamOptions::default());
        let (mut stream, mut batch) = (source.open_places()?, vec![]);
        loop {
            batch.clear();
            if stream.next(&mut batch, BATCH)? == 0 {
                return Ok(self);
            }
            batch.iter().for_each(|record| self.see(record));
        }
    }

    /// Looks at one more primitive.
    pub fn see(&mut self, record: &Record) {
        match record {
            Record::Triangle(t) => {
                let p = t.p.map(|p| sub(p, self.offset));
                let (a, b) = (sub(p[1], p[0]), sub(p[2], p[0]));
                for ray in &mut self.rays {
                    // Moeller and Trumbore, in f64
                    let across = cross(ray.direction, b);
                    let determinant = dot(a, across);
                    let from = sub(ray.origin, p[0]);
                    let u = dot(from, across) / determinant;
                    let along = cross(from, a);
                    let v = dot(ray.direction, along) / determinant;
                    if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
                        ray.meet(dot(b, along) / determinant, t.shape, determinant < 0.0);
                    }
                }
            }
            Record::Sphere(s) => {
                let center = sub(s.center, self.offset);
                for ray in &mut self.rays {
                    let from = sub(ray.origin, center);
                    let half = dot(from, ray.direction);
                    let root = (half * half - dot(from, from) + s.radius * s.radius).sqrt();
                    // NaN where it passes by
                    for (t, leaves) in [(-half - root, false), (-half + root, true)] {
                        ray.meet(t, s.shape, leaves != s.flipped);
                    }
                }
            }
        }
    }

    /// If all rays meet backs that take all light: which, and what to do.
    pub fn walled_in(&self, description: &Description) -> Option<String> {
        let mut counts = std::collections::BTreeMap::new();
        for ray in &self.rays {
            match ray.first {
                Some((_, shape, true)) if takes_all(description, description.shapes[shape as usize].material) => {
                    *counts.entry(shape).or_insert(0) += 1;
                }
                _ => return None,
            }
        }
        let (&shape, _) = counts.iter().max_by_key(|(shape, count)| (**count, std::cmp::Reverse(**shape)))?;
        let others = match counts.len() {
            1 => String::new(),
            n => format!(" and {} more", n - 1),
        };
        let found = &description.shapes[shape as usize];
        Some(format!(
            "{}: every one of {} rays of the camera ends at once on the back of a one-sided surface, shape \"{}\"{others}: the camera stands \
             inside of it or behind it, and the picture is black; move the camera (--camera), or put the shape's bsdf into a twosided one",
            found.place,
            self.rays.len(),
            found.name
        ))
    }
}

impl Ray {
    fn meet(&mut self, t: f64, shape: u32, back: bool) {
        if t > 0.0 && t.is_finite() && self.first.is_none_or(|(first, ..)| t < first) {
            self.first = Some((t, shape, back));
        }
    }
}

/// Whether light that comes to the back of a material ends there.
fn takes_all(description: &Description, material: u32) -> bool {
    let material = &description.materials[material as usize];
    let Some(detail) = &material.detail else { return !material.two_sided && !material.bsdf.transmits() };
    if detail.opacity != Amount::Constant(1.0) || detail.back.is_some() {
        return false;
    }
    match &detail.blend {
        Some(blend) => blend.parts.iter().all(|part| takes_all(description, *part)),
        None => !material.two_sided && !material.bsdf.transmits(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::tests::{folder, write};
    use crate::import::{ImportOptions, import};
    use rayherd_render::camera::View;

    fn walled(inside: &str, lens: &str) -> Option<String> {
        let text = format!(
            "<scene version='3.0.0'><emitter type='constant'/><sensor type='{lens}'><float name='aperture_radius' value='0.1'/><transform \
             name='to_world'><lookat origin='0.1, 0.2, 0.3' target='0.5, 0.6, 2' up='0, 1, 0'/></transform></sensor>\n{inside}</scene>"
        );
        let text =
            if lens == "perspective" { text.replace("<float name='aperture_radius' value='0.1'/>", "") } else { text };
        let out = import(&write(&folder(), "s.xml", text), &ImportOptions::default()).unwrap();
        let camera = out.camera.clone().unwrap();
        let view = View { to_world: camera.to_world.0, projection: camera.projection, crop: camera.crop };
        let (size, offset) = (out.size.unwrap(), [3.0, -2.0, 1.0]);
        let sight = Sight::new(&Camera::of(&view, size, offset).unwrap(), size, offset);
        sight.look(&out).unwrap().walled_in(&out)
    }

    #[test]
    fn a_camera_in_a_wall_is_seen() {
        let shape = |kind: &str, inside: &str| format!("<shape type='{kind}' id='wall'>{inside}</shape>");
        let blend = |one: &str, two: &str| {
            format!(
                "<bsdf type='blendbsdf'><float name='weight' value='0.5'/><bsdf type='{one}'/><bsdf type='{two}'/></bsdf>"
            )
        };
        for lens in ["perspective", "thinlens"] {
            for inside in [
                shape("cube", ""),
                shape("sphere", "<bsdf type='plastic'/>"),
                shape("cube", "<emitter type='area'/>"),
                shape("cube", &blend("diffuse", "conductor")),
                // the nearest counts
                format!(
                    "{}<shape type='sphere'><float name='radius' value='9'/><bsdf type='dielectric'/></shape>",
                    shape("cube", "")
                ),
            ] {
                let told = walled(&inside, lens).unwrap_or_else(|| panic!("{inside}"));
                assert!(told.contains("s.xml:2:1: ") && told.contains("shape \"wall\":"), "{told}");
            }
        }
        for inside in [
            shape("cube", "<bsdf type='twosided'><bsdf type='diffuse'/></bsdf>"),
            shape("cube", "<boolean name='flip_normals' value='true'/>"),
            shape("sphere", "<boolean name='flip_normals' value='true'/>"),
            shape("cube", "<bsdf type='dielectric'/>"),
            shape("cube", "<bsdf type='mask'><float name='opacity' value='0.5'/><bsdf type='diffuse'/></bsdf>"),
            shape("cube", "<bsdf type='null'/>"),
            shape("cube", &blend("diffuse", "dielectric")),
            // a part of the view is free
            shape(
                "rectangle",
                "<transform name='to_world'><rotate y='1' angle='180'/><translate x='1.5' z='2'/></transform>",
            ),
            shape("cube", "<transform name='to_world'><translate z='7'/></transform>"),
        ] {
            assert_eq!(walled(&inside, "perspective"), None, "{inside}");
        }
    }
}
