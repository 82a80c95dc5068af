//! Mitsuba scene files (0.5, 0.6, 2 and 3) to a [`Description`].
//!
//! Parsing ([`xml`]) knows nothing of rendering: it yields objects with typed properties. Converting asks each object for the
//! properties it understands; whatever nobody asked for is unsupported, and all such elements are reported together.
//!
//! Rules where Rayherd reads a file differently from Mitsuba:
//! - An integrator says how an image is computed, not what is in it: every integrator that estimates the full light transport
//!   (`path`, `volpath`, `bdpt`, `path_guiding_integrator`, ...) stands for our path tracer with its `max_depth` and
//!   `rr_depth`; `direct` is a path of depth 2. `aov` adds layers to what the integrator inside of it makes. Others (`ao`, `depth`, ...) are
//!   unsupported.
//! - The sampler's kind is ignored, its `sample_count` is used.
//! - Clip planes and focus distance of a perspective sensor are ignored: nothing is clipped.
//! - A scene without a sensor is framed by the rule for bare meshes ([`super::framing`]).
//! - The axis of a rotation is brought to unit length, as in 0.6; Mitsuba 3 does not, and then shears.
//! - A mirroring `to_world` leaves the front of a mesh where its normals are, as Mitsuba does from 3.10 on; 3.9 turned round the
//!   front of mirrored meshes that have no normals.

mod bsdf;
mod coats;
mod composed;
mod daylight;
mod emitter;
mod scene;
mod sensor;
mod shape;
mod text;
mod texture;
mod transform;
mod value;
mod xml;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use self::coats::Coats;
use self::xml::{Document, ObjectId, Property, Value, malformed};
use super::ImportOptions;
use crate::ImportError;
use crate::description::{Affine, Description, Note, Place};

/// Reads a scene file.
pub(super) fn import(path: &Path, options: &ImportOptions) -> Result<Description, ImportError> {
    let document = Document::read(path, &options.defines)?;
    let mut converter = Converter {
        document: &document,
        options,
        out: Description::default(),
        unsupported: vec![],
        materials: BTreeMap::new(),
        textures: BTreeMap::new(),
        coats: Coats::default(),
        open: BTreeSet::new(),
        entered: 0,
    };
    for (place, what) in &document.unknown {
        converter.unsupported(place, what, "nothing");
    }
    converter.scene()?;
    if !converter.unsupported.is_empty() {
        converter.unsupported.sort_by(|a, b| (&a.0.file, a.0.line).cmp(&(&b.0.file, b.0.line)));
        return Err(ImportError::Unsupported(converter.unsupported));
    }
    let mut out = converter.out;
    // heads of meshes were read on the way
    out.bytes_read += document.bytes_read;
    Ok(out)
}

/// State of a conversion.
/// Deepest nesting of objects by references: the stack is finite, and ten is much already.
const MAX_NESTING: usize = 64;
/// Most objects, each counted as often as something refers to it: four for each of the most shapes.
const MAX_OBJECTS: usize = 1 << 22;
/// Most materials, a blend's parts counted as often as something refers to it; some 100 MiB.
const MAX_MATERIALS: usize = 1 << 18;

struct Converter<'a> {
    document: &'a Document,
    options: &'a ImportOptions,
    out: Description,
    unsupported: Vec<(Place, String)>,
    /// Materials made so far, by object.
    materials: BTreeMap<ObjectId, u32>,
    /// Textures made so far, by object; none for one that cannot be had.
    textures: BTreeMap<ObjectId, Option<u32>>,
    coats: Coats,
    /// Objects being converted, to find cycles of references.
    open: BTreeSet<ObjectId>,
    /// Objects begun so far.
    entered: usize,
}

impl<'a> Converter<'a> {
    /// Notes something unsupported, or its stand-in when stand-ins are allowed.
    fn unsupported(&mut self, place: &Place, what: impl Into<String>, stand_in: &str) {
        let found = (place.clone(), what.into());
        self.options.note_unsupported(found, stand_in, &mut self.out.substitutions, &mut self.unsupported);
    }

    /// Notes what is read and changes nothing.
    fn note(&mut self, place: &Place, text: impl Into<String>) {
        self.out.notes.push(Note { place: place.clone(), text: text.into() });
    }

    /// Notes those of an object's properties that say something of another program's ways, all in one.
    fn pass_over(&mut self, object: ObjectId, names: &[&str], why: &str) {
        let o = &self.document.objects[object];
        let given = o.properties.iter().filter(|p| names.contains(&p.name.as_str()) && !p.used.replace(true));
        let list: Vec<&str> = given.map(|p| p.name.as_str()).collect();
        if !list.is_empty() {
            let text = format!("{} of {} \"{}\": {why}", list.join(", "), o.class, o.plugin);
            self.note(&o.place, text);
        }
    }

    /// The property of a name, marked as used.
    fn property(&self, object: ObjectId, name: &str) -> Option<&'a Property> {
        let found = self.document.objects[object].properties.iter().rev().find(|p| p.name == name)?;
        found.used.set(true);
        Some(found)
    }

    /// Marks properties that do not change what we compute.
    fn ignore(&self, object: ObjectId, names: &[&str]) {
        for property in &self.document.objects[object].properties {
            if names.contains(&property.name.as_str()) {
                property.used.set(true);
            }
        }
    }

    fn float(&self, object: ObjectId, name: &str) -> Result<Option<f64>, ImportError> {
        match self.property(object, name) {
            None => Ok(None),
            Some(p) => match p.value {
                Value::Float(v) => Ok(Some(v)),
                Value::Integer(v) => Ok(Some(v as f64)),
                _ => malformed(&p.place, format!("\"{name}\" should be a <float>")),
            },
        }
    }

    fn integer(&self, object: ObjectId, name: &str) -> Result<Option<i64>, ImportError> {
        match self.property(object, name) {
            None => Ok(None),
            Some(p) => match p.value {
                Value::Integer(v) => Ok(Some(v)),
                _ => malformed(&p.place, format!("\"{name}\" should be an <integer>")),
            },
        }
    }

    fn boolean(&self, object: ObjectId, name: &str) -> Result<Option<bool>, ImportError> {
        match self.property(object, name) {
            None => Ok(None),
            Some(p) => match p.value {
                Value::Boolean(v) => Ok(Some(v)),
                _ => malformed(&p.place, format!("\"{name}\" should be a <boolean>")),
            },
        }
    }

    fn string(&self, object: ObjectId, name: &str) -> Result<Option<(&'a str, &'a Place)>, ImportError> {
        match self.property(object, name) {
            None => Ok(None),
            Some(p) => match &p.value {
                Value::String(v) => Ok(Some((v, &p.place))),
                _ => malformed(&p.place, format!("\"{name}\" should be a <string>")),
            },
        }
    }

    fn point(&self, object: ObjectId, name: &str) -> Result<Option<[f64; 3]>, ImportError> {
        match self.property(object, name) {
            None => Ok(None),
            Some(p) => match p.value {
                Value::Vector(v) => Ok(Some(v)),
                _ => malformed(&p.place, format!("\"{name}\" should be a <point>")),
            },
        }
    }

    fn transform(&self, object: ObjectId, name: &str) -> Result<Affine, ImportError> {
        match self.property(object, name) {
            None => Ok(Affine::IDENTITY),
            Some(p) => match p.value {
                Value::Transform(map) => Ok(map),
                _ => malformed(&p.place, format!("\"{name}\" should be a <transform>")),
            },
        }
    }

    /// A constant colour; a texture or a measured spectrum is unsupported and `stand_in` (a grey) stands for it.
    fn color(&mut self, object: ObjectId, name: &str, stand_in: f64) -> Result<Option<[f64; 3]>, ImportError> {
        let Some(p) = self.property(object, name) else { return Ok(None) };
        let what = match &p.value {
            Value::Color(rgb) => return Ok(Some(*rgb)),
            Value::Float(v) => return Ok(Some([*v; 3])),
            Value::Integer(v) => return Ok(Some([*v as f64; 3])),
            Value::Spectrum(text) => format!("spectrum \"{}\" for \"{name}\"", shorten(text)),
            Value::Object(_) | Value::Reference(_) => {
                let Some(id) = self.document.object(p)? else { return Ok(None) };
                let texture = &self.document.objects[id];
                match (texture.class.as_str(), texture.plugin.as_str()) {
                    ("spectrum" | "texture", "uniform") => {
                        let Some(v) = self.float(id, "value")? else {
                            return malformed(&texture.place, "a uniform texture lacks its value");
                        };
                        self.report_unused(id);
                        return Ok(Some([v; 3]));
                    }
                    (class, plugin) => format!("{class} \"{plugin}\" for \"{name}\""),
                }
            }
            _ => return malformed(&p.place, format!("\"{name}\" should be a colour")),
        };
        self.unsupported(&p.place, what, &format!("the grey {stand_in}"));
        Ok(Some([stand_in; 3]))
    }

    /// Nested objects and references of a class, in source order, marked as used.
    fn nested(&self, object: ObjectId, class: &str) -> Result<Vec<(&'a Property, ObjectId)>, ImportError> {
        let mut found = vec![];
        for property in &self.document.objects[object].properties {
            if let Some(id) = self.document.object(property)?
                && self.document.objects[id].class == class
            {
                property.used.set(true);
                found.push((property, id));
            }
        }
        Ok(found)
    }

    /// Begins an object; refuses one that contains itself by references, and more than anybody has.
    fn enter(&mut self, object: ObjectId, from: &Place) -> Result<(), ImportError> {
        let o = &self.document.objects[object];
        if !self.open.insert(object) {
            let name = o.id.clone().unwrap_or_else(|| o.plugin.clone());
            return malformed(from, format!("references form a cycle through \"{name}\": take this one out of it"));
        }
        if self.open.len() > MAX_NESTING {
            return malformed(from, format!("references nested deeper than {MAX_NESTING}: put less between the ends"));
        }
        self.entered += 1;
        if self.entered > MAX_OBJECTS || self.out.materials.len() > MAX_MATERIALS {
            let message = format!(
                "more than {MAX_OBJECTS} objects or {MAX_MATERIALS} materials, each counted as often as it is referred to: put \
                 fewer instances inside of instances, and fewer blends inside of blends"
            );
            return Err(ImportError::Limit { place: from.clone(), message });
        }
        Ok(())
    }

    /// Ends an object.
    fn leave(&mut self, object: ObjectId) {
        self.open.remove(&object);
        self.report_unused(object);
    }

    /// What nobody asked for of an object is unsupported.
    fn report_unused(&mut self, object: ObjectId) {
        let o = &self.document.objects[object];
        for p in o.properties.iter().filter(|p| !p.used.get()) {
            p.used.set(true);
            let what = match &p.value {
                Value::Object(id) => {
                    let inner = &self.document.objects[*id];
                    format!("{} \"{}\" in {} \"{}\"", inner.class, inner.plugin, o.class, o.plugin)
                }
                Value::Reference(id) => format!("ref to \"{id}\" in {} \"{}\"", o.class, o.plugin),
                _ => format!("property \"{}\" of {} \"{}\"", p.name, o.class, o.plugin),
            };
            self.unsupported(&p.place, what, "nothing");
        }
    }
}

/// The luminance of a colour, which is what a number of it is, as in Mitsuba.
fn luminance([r, g, b]: [f64; 3]) -> f64 {
    if r == g && g == b { r } else { 0.2126 * r + 0.7152 * g + 0.0722 * b }
}

/// The first characters of a long text.
fn shorten(text: &str) -> String {
    if text.chars().count() <= 40 { text.into() } else { text.chars().take(40).chain("...".chars()).collect() }
}

#[cfg(test)]
mod composed_tests;
#[cfg(test)]
mod daylight_tests;
#[cfg(test)]
mod document_tests;
#[cfg(test)]
mod emitter_tests;
#[cfg(test)]
mod named_tests;
#[cfg(test)]
mod passed_over_tests;
#[cfg(test)]
mod sensor_tests;
#[cfg(test)]
mod shape_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod texture_tests;
