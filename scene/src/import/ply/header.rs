//! The header of a PLY file, and its types.

use crate::ImportError;
use crate::import::source::{Source, show};

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
}

/// What a file says of itself.
#[derive(Debug)]
pub struct Header {
    pub format: Format,
    pub elements: Vec<Element>,
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
        if source.peek(3)? != b"ply" || source.line_bytes()?.is_none_or(|line| line.trim_ascii_end() != b"ply") {
            return source.fail_line("this is no PLY file: its first line is not \"ply\"");
        }
        loop {
            if source.offset() > MAX_BYTES {
                return source.fail_line(format!("the header is longer than {MAX_BYTES} bytes"));
            }
            let Some(line) = source.line_bytes()? else {
                return source.fail_line("the file ends in its header: no line end_header");
            };
            let text = show_all(line);
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                [] | ["comment" | "obj_info", ..] => {}
                ["format", name, _version] => {
                    format = match name {
                        "ascii" => Some(Format::Ascii),
                        "binary_little_endian" => Some(Format::LittleEndian),
                        "binary_big_endian" => Some(Format::BigEndian),
                        _ => return source.fail_line(format!("unknown format \"{name}\"")),
                    }
                }
                ["element", name, count] => {
                    let Ok(count) = count.parse() else {
                        return source.fail_line(format!("\"{count}\" is no number of elements"));
                    };
                    if elements.len() == MAX_ELEMENTS {
                        return source.fail_line(format!("more than {MAX_ELEMENTS} elements"));
                    }
                    elements.push(Element { name: name.into(), count, properties: vec![] });
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
                        return source.fail_line(format!("no property that PLY knows: {}", show(text.as_bytes())));
                    };
                    match elements.last_mut() {
                        Some(element) if element.properties.len() < MAX_PROPERTIES => element.properties.push(property),
                        Some(_) => return source.fail_line(format!("more than {MAX_PROPERTIES} properties")),
                        None => return source.fail_line("a property before the first element"),
                    }
                }
                _ => return source.fail_line(format!("no header line that PLY knows: {}", show(text.as_bytes()))),
            }
        }
        match format {
            Some(format) => {
                source.begin_tokens();
                Ok(Header { format, elements })
            }
            None => source.fail_line("the header has no line format"),
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
