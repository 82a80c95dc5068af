//! Stanford PLY: ascii, little and big endian, any properties in any order; polygons are fanned from their first corner.
//!
//! Read are `x y z`, `nx ny nz`, `u v` (or `s t`, `texture_u texture_v`, `texture_s texture_t`) of `vertex`, `vertex_indices`
//! (or `vertex_index`) of `face`, and the attribute that is asked for ([`attribute`]); everything else is passed over.

mod attribute;
mod header;

use std::path::Path;

use self::attribute::Fields;
pub(super) use self::attribute::looks;
use self::header::{Element, Format, Header, Kind, Property};
use super::mesh::{Corners, Positions, TriangleReader, budget};
use super::number::number;
use super::source::{Source, show};
use super::spill::{Budget, Column};
use super::stream::StreamOptions;
use crate::ImportError;
use crate::description::MeshAttribute;

/// A PLY file whose vertices are read, at its faces.
pub(super) struct PlyReader {
    source: Source,
    format: Format,
    budget: Budget,
    positions: Positions,
    normals: Option<Column<[f32; 3]>>,
    uv: Option<Column<[f32; 2]>>,
    attribute: Option<Column<[f32; 3]>>,
    /// The attribute of faces, if it is asked for: then `attribute` is by face.
    of_faces: Option<Fields>,
    faces: Element,
    /// Which property of a face lists its vertices.
    list: usize,
    /// Faces that have not begun.
    left: u64,
    fan: Fan,
    /// Corners of the face that are not yet used: of a file with an attribute of faces, whose properties may stand behind them.
    polygon: std::vec::IntoIter<u32>,
}

/// What is left of a polygon.
#[derive(Default)]
struct Fan {
    first: u32,
    previous: u32,
    left: u64,
}

impl PlyReader {
    /// Reads header and vertices.
    pub fn open(path: &Path, options: &StreamOptions, wanted: Option<&MeshAttribute>) -> Result<Self, ImportError> {
        let mut source = Source::open(path)?;
        let header = Header::read(&mut source)?;
        header.check_counts(&source)?;
        let mut vertices = None;
        for element in header.elements {
            match element.name.as_str() {
                "vertex" if vertices.is_none() => {
                    let mut budget = budget(options);
                    let columns = read_vertices(&mut source, header.format, &element, &mut budget, wanted)?;
                    vertices = Some((columns, budget));
                }
                "face" => {
                    let Some(((positions, normals, uv, attribute), budget)) = vertices else {
                        let message = "the faces stand before the vertices: write element vertex first";
                        return element.fail(&source, message);
                    };
                    let list = element.properties.iter().position(|p| match p {
                        Property::List { name, .. } => name == "vertex_indices" || name == "vertex_index",
                        Property::Scalar { .. } => false,
                    });
                    let Some(list) = list else {
                        let message =
                            "element face has no list property vertex_indices: name the list of a face's vertices so";
                        return element.fail(&source, message);
                    };
                    if let Property::List { kind, .. } = element.properties[list]
                        && kind.is_float()
                    {
                        return element.fail(&source, "vertex_indices are floating point numbers: use int or uint");
                    }
                    let of_faces = match wanted.filter(|a| a.of_faces) {
                        Some(wanted) => Some(Fields::of(wanted, &element, &source)?),
                        None => None,
                    };
                    return Ok(PlyReader {
                        source,
                        format: header.format,
                        budget,
                        positions,
                        normals,
                        uv,
                        attribute: if of_faces.is_some() { Some(Column::new()) } else { attribute },
                        of_faces,
                        left: element.count,
                        faces: element,
                        list,
                        fan: Fan::default(),
                        polygon: vec![].into_iter(),
                    });
                }
                _ => {
                    for _ in 0..if element.properties.is_empty() { 0 } else { element.count } {
                        for property in &element.properties {
                            skip(&mut source, header.format, property)?;
                        }
                    }
                }
            }
        }
        source.fail_in(1, 0, "no element face: a point cloud or strips cannot be rendered, write triangles or polygons")
    }

    /// PLY has no wider whole numbers than 32 bits.
    fn index(&mut self, kind: Kind) -> Result<u32, ImportError> {
        let value = integer(&mut self.source, self.format, kind)?;
        match u32::try_from(value) {
            Ok(i) if (i as usize) < self.positions.len() => Ok(i),
            _ => {
                let count = self.positions.len();
                self.fail(format!(
                    "vertex index {value}, but the file has {count} vertices, numbered from 0: export the file again"
                ))
            }
        }
    }

    fn fail<T>(&self, message: String) -> Result<T, ImportError> {
        let face = self.faces.count - self.left - 1;
        let message = format!("face {face}: {message}");
        match self.format {
            Format::Ascii => self.source.fail_word(message),
            _ => self.source.fail_byte(message),
        }
    }

    /// Begins the next face with at least three corners, or says that there is none.
    fn begin(&mut self, count: Kind, kind: Kind) -> Result<bool, ImportError> {
        while self.left > 0 {
            self.left -= 1;
            if let Some(fields) = &mut self.of_faces {
                fields.read(&mut self.source, self.format, &self.faces.properties[..self.list], 0)?;
            } else {
                for property in &self.faces.properties[..self.list] {
                    skip(&mut self.source, self.format, property)?;
                }
            }
            let n = integer(&mut self.source, self.format, count)?;
            let Ok(n) = u64::try_from(n) else { return self.fail(format!("{n} corners: export the file again")) };
            if n > self.source.most_left() {
                return self.fail(format!(
                    "{n} corners, which is more than the rest of the file holds: it is truncated, get it again"
                ));
            }
            self.read_whole(n, kind)?;
            if n >= 3 {
                let (first, previous) = (self.corner(kind)?, self.corner(kind)?);
                self.fan = Fan { first, previous, left: n - 2 };
                return Ok(true);
            }
            // no area
            for _ in 0..n {
                self.corner(kind)?;
            }
            self.end()?;
        }
        Ok(false)
    }

    /// Reads a face to its end, where its attribute is asked for.
    fn read_whole(&mut self, n: u64, kind: Kind) -> Result<(), ImportError> {
        if self.of_faces.is_none() {
            return Ok(());
        }
        let mut corners = vec![];
        for _ in 0..n {
            corners.push(self.index(kind)?);
        }
        self.polygon = corners.into_iter();
        let (Some(fields), Some(column)) = (&mut self.of_faces, &mut self.attribute) else { return Ok(()) };
        let after = self.list + 1;
        fields.read(&mut self.source, self.format, &self.faces.properties[after..], after)?;
        column.push(fields.value(), &mut self.budget).map_err(|e| self.source.io(e))
    }

    /// The next corner of the face.
    #[inline]
    fn corner(&mut self, kind: Kind) -> Result<u32, ImportError> {
        match self.polygon.next() {
            Some(vertex) => Ok(vertex),
            None => self.index(kind),
        }
    }

    /// Passes what a face has after its list.
    fn end(&mut self) -> Result<(), ImportError> {
        if self.of_faces.is_some() {
            return Ok(());
        }
        for property in &self.faces.properties[self.list + 1..] {
            skip(&mut self.source, self.format, property)?;
        }
        Ok(())
    }
}

impl TriangleReader for PlyReader {
    /// Three vertices and the number of the face.
    type Triangle = [u32; 4];

    fn next(&mut self) -> Result<Option<[u32; 4]>, ImportError> {
        let Property::List { count, kind, .. } = self.faces.properties[self.list] else {
            unreachable!("chosen as a list when the file was opened")
        };
        if self.fan.left == 0 && !self.begin(count, kind)? {
            return Ok(None);
        }
        let last = self.corner(kind)?;
        let face = self.faces.count - self.left - 1;
        let triangle = [self.fan.first, self.fan.previous, last, face as u32];
        self.fan.previous = last;
        self.fan.left -= 1;
        if self.fan.left == 0 {
            self.end()?;
        }
        Ok(Some(triangle))
    }

    fn corners(&self, triangle: &[u32; 4]) -> Corners {
        // every index was compared with the number of vertices
        let vertices = Self::vertices(triangle);
        let corner = |i| self.positions.get(i).unwrap_or([f64::NAN; 3]);
        let gather3 = |c: &Column<[f32; 3]>| vertices.map(|i| c.get(i).unwrap_or_default());
        let gather2 = |c: &Column<[f32; 2]>| vertices.map(|i| c.get(i).unwrap_or_default());
        let attribute = self.attribute.as_ref().map(|column| match self.of_faces {
            Some(_) => [column.get(triangle[3] as usize).unwrap_or_default(); 3],
            None => gather3(column),
        });
        let (n, uv) = (self.normals.as_ref().map(gather3), self.uv.as_ref().map(gather2));
        Corners { p: vertices.map(corner), n, uv, attribute }
    }

    fn has_normals(&self, _: &[u32; 4]) -> bool {
        self.normals.is_some()
    }

    fn vertices([a, b, c, _]: &[u32; 4]) -> [usize; 3] {
        [a, b, c].map(|i| *i as usize)
    }

    fn vertex_count(&self) -> usize {
        self.positions.len()
    }

    fn source(&self) -> &Source {
        &self.source
    }

    fn budget(&mut self) -> &mut Budget {
        &mut self.budget
    }
}

type Columns = (Positions, Option<Column<[f32; 3]>>, Option<Column<[f32; 2]>>, Option<Column<[f32; 3]>>);

/// Slots of what is wanted of a vertex: position, normal, uv; after them the attribute.
const SLOTS: [&[&str]; 8] = [
    &["x"],
    &["y"],
    &["z"],
    &["nx"],
    &["ny"],
    &["nz"],
    &["u", "s", "texture_u", "texture_s"],
    &["v", "t", "texture_v", "texture_t"],
];

fn read_vertices(
    source: &mut Source,
    format: Format,
    element: &Element,
    budget: &mut Budget,
    wanted: Option<&MeshAttribute>,
) -> Result<Columns, ImportError> {
    let named = match wanted.filter(|a| !a.of_faces) {
        Some(wanted) => Some(Fields::of(wanted, element, source)?),
        None => None,
    };
    let slot_of = |(i, property): (usize, &Property)| match property {
        Property::Scalar { name, .. } => match named.as_ref().and_then(|f| f.slot(i)) {
            Some(slot) => Some(SLOTS.len() + slot),
            None => SLOTS.iter().position(|names| names.contains(&name.as_str())),
        },
        Property::List { .. } => None,
    };
    let slots: Vec<Option<usize>> = element.properties.iter().enumerate().map(slot_of).collect();
    let has = |wanted: std::ops::Range<usize>| wanted.clone().all(|s| slots.contains(&Some(s)));
    if !has(0..3) {
        return element.fail(source, "element vertex lacks one of the properties x, y and z: a mesh needs all three");
    }
    let double = element.properties.iter().zip(&slots).any(|(property, slot)| match property {
        Property::Scalar { kind, .. } => slot.is_some_and(|s| s < 3) && !kind.fits_f32(),
        Property::List { .. } => false,
    });
    let mut positions = if double { Positions::Double(Column::new()) } else { Positions::Single(Column::new()) };
    let mut normals = has(3..6).then(Column::new);
    let mut uv = has(6..8).then(Column::new);
    let mut attribute = named.as_ref().map(|_| Column::new());

    // in a binary file a vertex without lists is so many bytes, with each property at its place
    let mut stride = Some(0);
    let mut fields = vec![];
    for (property, slot) in element.properties.iter().zip(&slots) {
        match (property, stride) {
            (Property::Scalar { kind, .. }, Some(at)) => {
                fields.extend(slot.map(|slot| (slot, at, *kind)));
                stride = Some(at + kind.size());
            }
            _ => stride = None,
        }
    }

    for _ in 0..element.count {
        let mut values = [0.0f64; SLOTS.len() + 3];
        match (format, stride) {
            (Format::LittleEndian | Format::BigEndian, Some(stride)) => {
                let bytes = source.exact(stride)?;
                for &(slot, at, kind) in &fields {
                    values[slot] = kind.decode(format, &bytes[at..at + kind.size()]);
                }
            }
            _ => {
                for (property, slot) in element.properties.iter().zip(&slots) {
                    match (property, slot) {
                        (Property::Scalar { kind, .. }, Some(slot)) => values[*slot] = scalar(source, format, *kind)?,
                        _ => skip(source, format, property)?,
                    }
                }
            }
        }
        let [x, y, z, nx, ny, nz, u, v, r, g, b] = values;
        let pushed = match &mut positions {
            Positions::Single(column) => column.push([x as f32, y as f32, z as f32], budget),
            Positions::Double(column) => column.push([x, y, z], budget),
        }
        .and_then(|()| normals.as_mut().map_or(Ok(()), |c| c.push([nx as f32, ny as f32, nz as f32], budget)))
        .and_then(|()| uv.as_mut().map_or(Ok(()), |c| c.push([u as f32, v as f32], budget)))
        .and_then(|()| match (&mut attribute, &named) {
            (Some(column), Some(named)) => column.push(named.convert([r, g, b]), budget),
            _ => Ok(()),
        });
        pushed.map_err(|e| source.io(e))?;
    }
    Ok((positions, normals, uv, attribute))
}

/// One number.
fn scalar(source: &mut Source, format: Format, kind: Kind) -> Result<f64, ImportError> {
    if format != Format::Ascii {
        return Ok(kind.decode(format, source.exact(kind.size())?));
    }
    let Some(token) = source.token()? else { return truncated(source) };
    // a float is rounded once, as its binary form was
    let value = if kind == Kind::F32 { number::<f32>(token).map(f64::from) } else { number::<f64>(token) };
    match value {
        Some(value) => Ok(value),
        None => {
            let word = show(token);
            source.fail_word(format!("\"{word}\" where a number should be"))
        }
    }
}

/// One whole number.
fn integer(source: &mut Source, format: Format, kind: Kind) -> Result<i64, ImportError> {
    if format != Format::Ascii {
        return Ok(kind.decode(format, source.exact(kind.size())?) as i64);
    }
    let Some(token) = source.token()? else { return truncated(source) };
    match number::<i64>(token) {
        Some(value) => Ok(value),
        None => {
            let word = show(token);
            source.fail_word(format!("\"{word}\" where a whole number should be"))
        }
    }
}

fn truncated<T>(source: &Source) -> Result<T, ImportError> {
    source.fail_word("the file ends in the middle of its data: it is truncated, get it again")
}

/// Passes a property that nobody asked for.
fn skip(source: &mut Source, format: Format, property: &Property) -> Result<(), ImportError> {
    match property {
        Property::Scalar { kind, .. } => skip_values(source, format, *kind, 1),
        Property::List { count, kind, .. } => match u64::try_from(integer(source, format, *count)?) {
            Ok(n) => skip_values(source, format, *kind, n),
            Err(_) if format == Format::Ascii => source.fail_word("a list of negative length: export the file again"),
            Err(_) => source.fail_byte("a list of negative length: export the file again"),
        },
    }
}

fn skip_values(source: &mut Source, format: Format, kind: Kind, n: u64) -> Result<(), ImportError> {
    if format != Format::Ascii {
        return source.skip(n * kind.size() as u64);
    }
    for _ in 0..n {
        if source.token()?.is_none() {
            return truncated(source);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
