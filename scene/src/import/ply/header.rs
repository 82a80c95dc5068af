//! The header of a PLY file, and its types.

use crate::ImportError;
use crate::import::source::{Source, Words, show};

/// Longest header.
const MAX_BYTES: u64 = 1 << 20;
/// Most elements, and most properties of one.
const MAX_ELEMENTS: usize = 64;
const MAX_PROPERTIES: usize = 256;

/// How numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// One property of an element.
#[derive(Debug)]
pub enum Property {
    Scalar { name: String, kind: Kind },
    List { name: String, count: Kind, kind: Kind },
}

/// A kind of thing and how many there are.
#[derive(Debug)]
pub struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
    /// Line of the header that names it, and bytes before it there.
    line: u32,
    at: usize,
}

impl Element {
    /// An error where the header names it.
    pub fn fail<T>(&self, source: &Source, message: impl Into<String>) -> Result<T, ImportError> {
        source.fail_in(self.line, self.at, message)
    }
}

/// What a file says of itself.
#[derive(Debug)]
pub struct Header {
    pub format: Format,
    pub elements: Vec<Element>,
    /// Line of the comment that names a texture, as MeshLab writes it, and bytes before it there.
    pub texture: Option<(u32, usize)>,
}

impl Kind {
    fn parse(name: &str) -> Option<Kind> {
        Some(match name {
            "char" | "int8" => Kind::I8,
            "uchar" | "uint8" => Kind::U8,
            "short" | "int16" => Kind::I16,
            "ushort" | "uint16" => Kind::U16,
            "int" | "int32" => Kind::I32,
            "uint" | "uint32" => Kind::U32,
            "float" | "float32" => Kind::F32,
            "double" | "float64" => Kind::F64,
            _ => return None,
        })
    }

    /// Bytes of one.
    pub fn size(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::I32 | Kind::U32 | Kind::F32 => 4,
            Kind::F64 => 8,
        }
    }

    pub fn is_float(self) -> bool {
        matches!(self, Kind::F32 | Kind::F64)
    }

    /// Whether every value is exact in an f32.
    pub fn fits_f32(self) -> bool {
        !matches!(self, Kind::I32 | Kind::U32 | Kind::F64)
    }

    /// The number in [`Kind::size`] bytes; exact for every kind.
    #[inline]
    pub fn decode(self, format: Format, bytes: &[u8]) -> f64 {
        fn array<const N: usize>(format: Format, bytes: &[u8]) -> [u8; N] {
            let mut out = [0; N];
            out.copy_from_slice(&bytes[..N]);
            if format == Format::BigEndian {
                out.reverse();
            }
            out
        }
        match self {
            Kind::I8 => f64::from(bytes[0] as i8),
            Kind::U8 => f64::from(bytes[0]),
            Kind::I16 => f64::from(i16::from_le_bytes(array(format, bytes))),
            Kind::U16 => f64::from(u16::from_le_bytes(array(format, bytes))),
            Kind::I32 => f64::from(i32::from_le_bytes(array(format, bytes))),
            Kind::U32 => f64::from(u32::from_le_bytes(array(format, bytes))),
            Kind::F32 => f64::from(f32::from_le_bytes(array(format, bytes))),
            Kind::F64 => f64::from_le_bytes(array(format, bytes)),
        }
    }
}

impl Header {
    /// Reads up to and with the line `end_header`.
    pub fn read(source: &mut Source) -> Result<Header, ImportError> {
        let mut format = None;
        let mut elements: Vec<Element> = vec![];
        let mut texture = None;
        if source.peek(3)? != b"ply" || source.line_bytes()?.is_none_or(|line| line.trim_ascii_end() != b"ply") {
            return source.fail_at(0, "this is no PLY file: its first line is not \"ply\"");
        }
        loop {
            if source.offset() > MAX_BYTES {
                let message = format!("the header is longer than {MAX_BYTES} bytes: take comments out of it");
                return source.fail_at(0, message);
            }
            let Some(line) = source.line_bytes()? else {
                return source.fail_at(0, "the file ends in its header: no line end_header, get it again");
            };
            let text = show_all(line);
            let (mut words, mut places) = (vec![], vec![]);
            let mut split = Words::new(text.as_bytes());
            while let Some(word) = split.next() {
                words.push(&text[split.at()..split.at() + word.len()]);
                places.push(split.at());
            }
            let place = |word: usize| places.get(word).copied().unwrap_or(0);
            match words[..] {
                ["end_header"] => break,
                ["comment", "TextureFile", _, ..] if texture.is_none() => texture = Some((source.place().1, place(1))),
                [] | ["comment" | "obj_info", ..] => {}
                ["format", name, _version] => {
                    format = match name {
                        "ascii" => Some(Format::Ascii),
                        "binary_little_endian" => Some(Format::LittleEndian),
                        "binary_big_endian" => Some(Format::BigEndian),
                        _ => {
                            let message = format!(
                                "unknown format \"{name}\": it should be ascii, binary_little_endian or binary_big_endian"
                            );
                            return source.fail_at(place(1), message);
                        }
                    }
                }
                ["element", name, count] => {
                    let Ok(count) = count.parse() else {
                        let message = format!("\"{count}\" is no number of elements: export the file again");
                        return source.fail_at(place(2), message);
                    };
                    if elements.len() == MAX_ELEMENTS {
                        let message = format!("more than {MAX_ELEMENTS} elements: leave out what is no mesh");
                        return source.fail_at(place(0), message);
                    }
                    let (line, at) = (source.place().1, place(1));
                    elements.push(Element { name: name.into(), count, properties: vec![], line, at });
                }
                ["property", ref rest @ ..] => {
                    let property = match *rest {
                        ["list", count, kind, name] => Kind::parse(count)
                            .filter(|c| !c.is_float())
                            .zip(Kind::parse(kind))
                            .map(|(count, kind)| Property::List { name: name.into(), count, kind }),
                        [kind, name] => Kind::parse(kind).map(|kind| Property::Scalar { name: name.into(), kind }),
                        _ => None,
                    };
                    let Some(property) = property else {
                        let message = format!(
                            "no property that PLY knows: {}; it should be TYPE NAME, or list TYPE TYPE NAME with whole numbers for its length",
                            show(text.as_bytes())
                        );
                        return source.fail_at(place(0), message);
                    };
                    match elements.last_mut() {
                        Some(element) if element.properties.len() < MAX_PROPERTIES => element.properties.push(property),
                        Some(_) => {
                            let message = format!("more than {MAX_PROPERTIES} properties: leave out some");
                            return source.fail_at(place(0), message);
                        }
                        None => {
                            let message = "a property before the first element: put it below the element that has it";
                            return source.fail_at(place(0), message);
                        }
                    }
                }
                _ => {
                    let message = format!(
                        "no header line that PLY knows: {}; a header ends with end_header",
                        show(text.as_bytes())
                    );
                    return source.fail_at(place(0), message);
                }
            }
        }
        match format {
            Some(format) => {
                source.begin_tokens();
                Ok(Header { format, elements, texture })
            }
            None => {
                source.fail_at(0, "the header has no line format: write \"format ascii 1.0\", or that of its numbers")
            }
        }
    }

    /// Compares the counts with what the rest of the file can hold, before anything is allocated or looped over.
    pub fn check_counts(&self, source: &Source) -> Result<(), ImportError> {
        let left = source.most_left();
        let mut needed = 0u64;
        for element in &self.elements {
            let size: u64 = element
                .properties
                .iter()
                .map(|p| match (self.format, p) {
                    // a digit and a separator
                    (Format::Ascii, _) => 2,
                    (_, Property::Scalar { kind, .. }) => kind.size() as u64,
                    (_, Property::List { count, .. }) => count.size() as u64,
                })
                .sum();
            // the last number of a text needs no separator
            needed = needed.saturating_add(element.count.saturating_mul(size));
            if needed > left.saturating_add(1) {
                return source.fail_limit(format!(
                    "the header says {} elements \"{}\", which need {needed} bytes or more, but at most {left} follow: the file is \
                     truncated, get it again",
                    element.count, element.name
                ));
            }
        }
        Ok(())
    }
}

fn show_all(line: &[u8]) -> String {
    String::from_utf8_lossy(line).into_owned()
}
