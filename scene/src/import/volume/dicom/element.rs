//! DICOM files, as far as a slice needs: file meta information, uncompressed data sets (explicit little and big endian, implicit
//! little endian), nested sequences skipped. PS3.5 section 7, PS3.10 section 7.
//!
//! Own code, because the crates at hand rest on an unmaintained one for text that is not needed here, and read pixel data of any
//! claimed length into memory; here only values of wanted elements are read, and pixel data is left where it is.

use std::io::{self, Read, Seek};

/// Longest value of an element that is wanted.
const MAX_VALUE: u32 = 4096;
/// Deepest nesting of sequences.
const MAX_DEPTH: u32 = 32;
/// Length of what ends with a delimiter.
const UNDEFINED: u32 = u32::MAX;

/// Why a file could not be read.
pub enum Failure {
    Io(io::Error),
    Content(String),
}

impl From<io::Error> for Failure {
    fn from(e: io::Error) -> Self {
        match e.kind() {
            io::ErrorKind::UnexpectedEof => Failure::Content("the file ends within an element".into()),
            _ => Failure::Io(e),
        }
    }
}

/// Group and element.
pub type Tag = (u16, u16);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Syntax {
    explicit: bool,
    big_endian: bool,
}

const EXPLICIT: Syntax = Syntax { explicit: true, big_endian: false };
const IMPLICIT: Syntax = Syntax { explicit: false, big_endian: false };

/// What a file's data set says.
pub struct DataSet {
    /// Values of wanted elements at the top level, in the file's order.
    pub values: Vec<(Tag, Vec<u8>)>,
    /// Numbers and samples are big endian.
    pub big_endian: bool,
    /// Where the pixel data begins and how many bytes it has, if there is any.
    pub pixels: Option<(u64, u32)>,
    /// Why the pixel data cannot be used, if so.
    pub problem: Option<String>,
}

/// Reads a file's data set up to the pixel data; none if it is no DICOM file.
pub fn read<R: Read + Seek>(file: R, wanted: &[Tag]) -> Result<Option<DataSet>, Failure> {
    let mut reader = Reader { length: 0, at: 0, inner: file };
    reader.length = reader.inner.seek(io::SeekFrom::End(0))?;
    reader.inner.rewind()?;
    if reader.length < 132 {
        return Ok(None);
    }
    let preamble: [u8; 132] = reader.bytes()?;
    if &preamble[128..] != b"DICM" {
        return Ok(None);
    }
    let mut syntax = None;
    // file meta information is explicit little endian, whatever follows
    let mut header = loop {
        if reader.at == reader.length {
            break None;
        }
        let tag = reader.tag(EXPLICIT)?;
        if tag.0 != 2 {
            break Some(tag);
        }
        let (_, length) = reader.length_of(EXPLICIT)?;
        if tag == (2, 0x10) {
            syntax = Some(transfer_syntax(&reader.value(tag, length)?)?);
        } else {
            reader.skip(length)?;
        }
    };
    let Some((syntax, problem)) = syntax else {
        return Err(Failure::Content("the file has no transfer syntax (0002,0010)".into()));
    };
    if syntax.big_endian {
        header = header.map(|(g, e)| (g.swap_bytes(), e.swap_bytes()));
    }
    let mut set = DataSet { values: Vec::new(), big_endian: syntax.big_endian, pixels: None, problem };
    while let Some(tag) = header {
        let (vr, length) = reader.length_of(syntax)?;
        if tag == (0x7fe0, 0x10) {
            if length == UNDEFINED && set.problem.is_none() {
                set.problem = Some("the pixel data is in fragments, which uncompressed data never is".into());
            }
            set.pixels = Some((reader.at, length));
            break;
        }
        // each tag counts once, so that memory is bounded
        let keep = wanted.contains(&tag) && set.values.iter().all(|v| v.0 != tag);
        if keep && length != UNDEFINED && &vr != b"SQ" {
            let value = reader.value(tag, length)?;
            set.values.push((tag, value));
        } else {
            if keep {
                set.values.push((tag, Vec::new())); // a sequence: that it is there is all that can be known
            }
            reader.skip_element(syntax, vr, length, 0)?;
        }
        header = if reader.at == reader.length { None } else { Some(reader.tag(syntax)?) };
    }
    Ok(Some(set))
}

/// How the data set is written, and why its pixels cannot be used.
fn transfer_syntax(value: &[u8]) -> Result<(Syntax, Option<String>), Failure> {
    let uid = text(value);
    let name = match uid.as_str() {
        "1.2.840.10008.1.2" => return Ok((IMPLICIT, None)),
        "1.2.840.10008.1.2.1" => return Ok((EXPLICIT, None)),
        "1.2.840.10008.1.2.2" => return Ok((Syntax { explicit: true, big_endian: true }, None)),
        "1.2.840.10008.1.2.5" => "run lengths",
        "1.2.840.10008.1.2.4.80" | "1.2.840.10008.1.2.4.81" => "JPEG-LS",
        "1.2.840.10008.1.2.4.90" | "1.2.840.10008.1.2.4.91" => "JPEG 2000",
        u if u.starts_with("1.2.840.10008.1.2.4.20") => "HTJ2K",
        u if u.starts_with("1.2.840.10008.1.2.4.") => "JPEG or video",
        _ => "",
    };
    let message = format!(
        "transfer syntax {uid} {name} is not supported, as it is compressed: decompress first, for example with \
         `gdcmconv --raw IN OUT` or `dcmconv +te IN OUT`"
    );
    // the data set around compressed pixels is explicit little endian; others (deflated, private) cannot be read at all
    if name.is_empty() { Err(Failure::Content(message)) } else { Ok((EXPLICIT, Some(message))) }
}

/// A string value without its padding.
pub fn text(value: &[u8]) -> String {
    String::from_utf8_lossy(value).trim_matches(['\0', ' ']).to_owned()
}

struct Reader<R> {
    inner: R,
    at: u64,
    length: u64,
}

impl<R: Read + Seek> Reader<R> {
    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], Failure> {
        let mut b = [0; N];
        self.inner.read_exact(&mut b)?;
        self.at += N as u64;
        Ok(b)
    }

    fn u16(&mut self, s: Syntax) -> Result<u16, Failure> {
        let b = self.bytes()?;
        Ok(if s.big_endian { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) })
    }

    fn u32(&mut self, s: Syntax) -> Result<u32, Failure> {
        let b = self.bytes()?;
        Ok(if s.big_endian { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    }

    fn tag(&mut self, s: Syntax) -> Result<Tag, Failure> {
        Ok((self.u16(s)?, self.u16(s)?))
    }

    /// Value representation (`??` where it is implicit) and length of the element whose tag was read.
    fn length_of(&mut self, s: Syntax) -> Result<([u8; 2], u32), Failure> {
        if !s.explicit {
            return Ok((*b"??", self.u32(s)?));
        }
        let vr: [u8; 2] = self.bytes()?;
        match &vr {
            b"OB" | b"OD" | b"OF" | b"OL" | b"OV" | b"OW" | b"SQ" | b"SV" | b"UC" | b"UN" | b"UR" | b"UT" | b"UV" => {
                self.u16(s)?;
                Ok((vr, self.u32(s)?))
            }
            _ if vr.iter().all(u8::is_ascii_uppercase) => Ok((vr, self.u16(s)?.into())),
            _ => Err(Failure::Content(format!("byte {} is no value representation", self.at - 2))),
        }
    }

    fn value(&mut self, tag: Tag, length: u32) -> Result<Vec<u8>, Failure> {
        if length > MAX_VALUE {
            return Err(Failure::Content(format!(
                "element ({:04x},{:04x}) has {length} bytes where at most {MAX_VALUE} make sense",
                tag.0, tag.1
            )));
        }
        let mut value = vec![0; length as usize];
        self.inner.read_exact(&mut value)?;
        self.at += u64::from(length);
        Ok(value)
    }

    fn skip(&mut self, length: u32) -> Result<(), Failure> {
        if u64::from(length) > self.length - self.at {
            return Err(Failure::Content(format!(
                "an element of {length} bytes at byte {} goes beyond the end",
                self.at
            )));
        }
        self.inner.seek_relative(length.into())?;
        self.at += u64::from(length);
        Ok(())
    }

    /// Skips an element whose header was read.
    fn skip_element(&mut self, s: Syntax, vr: [u8; 2], length: u32, depth: u32) -> Result<(), Failure> {
        if length != UNDEFINED {
            return self.skip(length);
        }
        if depth == MAX_DEPTH {
            return Err(Failure::Content(format!("sequences are nested more than {MAX_DEPTH} deep")));
        }
        // what is unknown and has no length is a sequence in implicit little endian (PS3.5 6.2.2)
        let s = if &vr == b"UN" { IMPLICIT } else { s };
        loop {
            let tag = self.tag(s)?;
            let length = self.u32(s)?;
            match tag {
                (0xfffe, 0xe0dd) => return Ok(()),
                (0xfffe, 0xe000) if length != UNDEFINED => self.skip(length)?,
                (0xfffe, 0xe000) => self.skip_item(s, depth)?,
                _ => {
                    return Err(Failure::Content(format!(
                        "({:04x},{:04x}) at byte {} is no item of a sequence",
                        tag.0,
                        tag.1,
                        self.at - 8
                    )));
                }
            }
        }
    }

    /// Skips the elements of an item up to its delimiter.
    fn skip_item(&mut self, s: Syntax, depth: u32) -> Result<(), Failure> {
        loop {
            let tag = self.tag(s)?;
            if tag == (0xfffe, 0xe00d) {
                self.u32(s)?;
                return Ok(());
            }
            let (vr, length) = self.length_of(s)?;
            self.skip_element(s, vr, length, depth + 1)?;
        }
    }
}
