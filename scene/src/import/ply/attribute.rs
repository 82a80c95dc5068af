//! Colours and other properties of a PLY file's vertices or faces, as a mesh's attribute.
//!
//! Names are Mitsuba 3's, without their prefix: `color` is `r g b` or `red green blue`, `color_NAME` is `NAME_r NAME_g NAME_b`, and
//! NAME is `NAME_x NAME_y NAME_z`. A name of which only the first property is there has one number, which stands for three.

use std::path::Path;

use rayherd_render::texture::decode_srgb;

use super::header::{Element, Format, Header, Kind, Property};
use super::{scalar, skip};
use crate::ImportError;
use crate::description::{MeshAttribute, Place};
use crate::import::source::Source;

/// Where an attribute stands among an element's properties, and its value at the element that was read last.
#[derive(Debug)]
pub(super) struct Fields {
    /// By slot: the property's number and its largest value, if it is a whole number of sRGB.
    slots: Vec<(usize, Option<f64>)>,
    values: [f64; 3],
}

/// Spellings of an attribute's three properties.
fn spellings(name: &str) -> Vec<[String; 3]> {
    let three = |stem: &str, ends: [&str; 3]| ends.map(|end| format!("{stem}{end}"));
    match name.strip_prefix("color_") {
        _ if name == "color" => vec![three("", ["r", "g", "b"]), three("", ["red", "green", "blue"])],
        Some(stem) => vec![three(stem, ["_r", "_g", "_b"])],
        None => vec![three(name, ["_x", "_y", "_z"])],
    }
}

/// How a file's surface looks, as far as its header says.
pub(in crate::import) struct Looks {
    /// Colours of its vertices, else of its faces.
    pub colors: Option<MeshAttribute>,
    /// Where it names a texture.
    pub texture: Option<Place>,
    /// Bytes read to know.
    pub bytes_read: u64,
}

/// Reads a header for what it says of looks.
pub(in crate::import) fn looks(path: &Path) -> Result<Looks, ImportError> {
    let mut source = Source::open_head(path)?;
    let header = Header::read(&mut source)?;
    let colors = [("vertex", false), ("face", true)].into_iter().find_map(|(name, of_faces)| {
        let wanted = MeshAttribute { of_faces, name: "color".into(), srgb: true };
        let element = header.elements.iter().find(|e| e.name == name)?;
        (places(&wanted, element)?.len() == 3).then_some(wanted)
    });
    let texture = header.texture.map(|(line, at)| Place::line(path, line).at(at));
    Ok(Looks { colors, texture, bytes_read: source.bytes_read() })
}

/// Numbers of an attribute's properties: three, or the first; `None` if that is not there.
fn places(wanted: &MeshAttribute, element: &Element) -> Option<Vec<usize>> {
    spellings(&wanted.name).iter().find_map(|names| {
        let place = |name: &String| {
            element.properties.iter().position(|p| matches!(p, Property::Scalar { name: n, .. } if n == name))
        };
        let all: Option<Vec<usize>> = names.iter().map(place).collect();
        all.or_else(|| Some(vec![place(&names[0])?]))
    })
}

impl Fields {
    /// Of an element.
    pub(super) fn of(wanted: &MeshAttribute, element: &Element, source: &Source) -> Result<Fields, ImportError> {
        let Some(places) = places(wanted, element) else {
            let names: Vec<String> = spellings(&wanted.name).iter().map(|names| names.join(" ")).collect();
            let message = format!(
                "element {} has no properties {}, which the mesh attribute \"{}\" is read from: add them, or name another",
                element.name,
                names.join(" or "),
                wanted.name
            );
            return element.fail(source, message);
        };
        let largest = |i: usize| match &element.properties[i] {
            Property::Scalar { kind: Kind::U8, .. } if wanted.srgb => Some(255.0),
            Property::Scalar { kind: Kind::U16, .. } if wanted.srgb => Some(65_535.0),
            _ => None,
        };
        Ok(Fields { slots: places.into_iter().map(|i| (i, largest(i))).collect(), values: [0.0; 3] })
    }

    /// The slot, from 0, of the property of a number.
    pub(super) fn slot(&self, property: usize) -> Option<usize> {
        self.slots.iter().position(|(place, _)| *place == property)
    }

    /// Reads properties of an element, the first of which has this number.
    pub(super) fn read(
        &mut self,
        source: &mut Source,
        format: Format,
        properties: &[Property],
        first: usize,
    ) -> Result<(), ImportError> {
        for (i, property) in (first..).zip(properties) {
            match (property, self.slot(i)) {
                (Property::Scalar { kind, .. }, Some(slot)) => self.values[slot] = scalar(source, format, *kind)?,
                _ => skip(source, format, property)?,
            }
        }
        Ok(())
    }

    /// What was read last.
    pub(super) fn value(&self) -> [f32; 3] {
        self.convert(self.values)
    }

    /// Values by slot as they are kept.
    pub(super) fn convert(&self, values: [f64; 3]) -> [f32; 3] {
        let value = |k: usize| match self.slots[k].1 {
            Some(largest) => decode_srgb(values[k] / largest) as f32,
            None => values[k] as f32,
        };
        if self.slots.len() == 3 { std::array::from_fn(value) } else { [value(0); 3] }
    }
}
