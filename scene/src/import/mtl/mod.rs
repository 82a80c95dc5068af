//! Materials of OBJ files: MTL libraries (Ramey, Rose, Tyerman: "Object file format", Alias|Wavefront 1995, section 5) with the
//! extensions for physically based materials of exporters (`Pr Pm Ps Pc Pcr aniso norm` and their maps).
//!
//! A library is text: [`entries`] splits it into materials and statements, [`look`] makes ours of them. What is read as
//! what stands in docs/formats.md.

mod look;
mod statement;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use super::obj::LibraryNames;
use super::source::Source;
use super::{ImportOptions, inside};
use crate::ImportError;
use crate::description::{Description, Material, Note, Parts, Place};
use statement::Statement;

/// Most materials of one library.
const MAX_MATERIALS: usize = 1 << 16;
/// Most statements of one material.
const MAX_STATEMENTS: usize = 1 << 10;

/// A material as its library has it.
struct Entry {
    name: String,
    place: Place,
    statements: Vec<Statement>,
}

/// What a part of an OBJ file is made of.
pub(super) struct Part {
    pub name: String,
    pub place: Place,
    pub material: Material,
    /// Radiance from the front, and what it is multiplied by.
    pub emission: Option<[f32; 3]>,
    pub emission_texture: Option<u32>,
}

/// Reads libraries, with the state that they share.
pub(super) struct Libraries<'a> {
    pub options: &'a ImportOptions,
    pub out: &'a mut Description,
    /// What is not supported, while stand-ins are not allowed.
    pub unsupported: Vec<(Place, String)>,
    /// The canonical folder of the OBJ file ([`inside::folder_of`]): no file outside is read.
    pub folder: PathBuf,
}

impl Libraries<'_> {
    /// The parts of an OBJ file that names these libraries; without any there are no parts.
    pub fn read(&mut self, obj: &Path, names: &LibraryNames) -> Result<(Parts, Vec<Part>), ImportError> {
        let folder = obj.parent().unwrap_or(Path::new(""));
        let mut parts = Parts { lenient: self.options.substitute, ..Parts::default() };
        let mut made: Vec<Part> = vec![];
        let mut seen = std::collections::HashSet::new();
        for (name, line, at) in names {
            parts.libraries.push(name.clone());
            let place = Place::line(obj, *line).at(*at);
            for path in self.paths(folder, name, &place)? {
                for entry in entries(&path, &mut self.out.bytes_read)? {
                    if !seen.insert(entry.name.clone()) {
                        self.note(&entry.place, format!("a second material \"{}\": the first one is used", entry.name));
                        continue;
                    }
                    parts.names.push(entry.name.clone());
                    made.push(self.part(entry)?);
                }
            }
        }
        Ok((parts, made))
    }

    /// The files that a `mtllib` statement names: one, or several with blanks in between.
    fn paths(&mut self, folder: &Path, name: &str, place: &Place) -> Result<Vec<PathBuf>, ImportError> {
        let whole = self.file_in(folder, name, place)?;
        if whole.is_file() {
            return Ok(vec![whole]);
        }
        let mut out = vec![];
        for word in name.split_ascii_whitespace() {
            let path = self.file_in(folder, word, place)?;
            if path.is_file() {
                out.push(path);
            } else {
                let what = format!("material library \"{word}\" (there is no such file)");
                self.unsupported(place, what, "one grey material");
            }
        }
        Ok(out)
    }

    /// A file that a statement names, from the folder of the one that it stands in. Backslashes are how some systems separate folders.
    ///
    /// # Errors
    /// It lies outside the scene's folder.
    fn file_in(&self, folder: &Path, name: &str, place: &Place) -> Result<PathBuf, ImportError> {
        let path = folder.join(name);
        let path = if path.exists() { path } else { folder.join(name.replace('\\', "/")) };
        inside::check(&path, &self.folder, name, place)?;
        Ok(path)
    }

    /// Notes something unsupported, or its stand-in when stand-ins are allowed.
    fn unsupported(&mut self, place: &Place, what: impl Into<String>, stand_in: &str) {
        let found = (place.clone(), what.into());
        self.options.note_unsupported(found, stand_in, &mut self.out.substitutions, &mut self.unsupported);
    }

    /// Once for each file: most materials of a library say the same.
    fn note(&mut self, place: &Place, text: String) {
        if self.out.notes.iter().any(|n| n.text == text && n.place.file == place.file) {
            return;
        }
        self.out.notes.push(Note { place: place.clone(), text });
    }
}

/// The materials of a library, in its order.
fn entries(path: &Path, bytes_read: &mut u64) -> Result<Vec<Entry>, ImportError> {
    let mut source = Source::open(path)?;
    let mut out: Vec<Entry> = vec![];
    while let Some(line) = source.line_bytes()? {
        let line = String::from_utf8_lossy(line).into_owned();
        let text = line.trim();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        let (file, number) = source.place();
        let (keyword, rest) = text.split_once(|c: char| c.is_ascii_whitespace()).unwrap_or((text, ""));
        let rest = rest.trim();
        // what is left when what stands at the end is taken away
        let at = |part: &str| line.trim_end().len() - part.len();
        let (place, rest_at) = (Place::line(file, number).at(at(text)), at(rest));
        if keyword.eq_ignore_ascii_case("newmtl") {
            if rest.is_empty() {
                return source.fail_at(at(text), "newmtl needs a name");
            }
            if out.len() == MAX_MATERIALS {
                return source.fail_limit(format!("more than {MAX_MATERIALS} materials in one library"));
            }
            out.push(Entry { name: rest.into(), place, statements: vec![] });
            continue;
        }
        let Some(entry) = out.last_mut() else {
            let keyword = super::source::show(keyword.as_bytes());
            let message = format!("\"{keyword}\" before the first newmtl: this is no material library");
            return source.fail_at(at(text), message);
        };
        if entry.statements.len() == MAX_STATEMENTS {
            return source.fail_limit(format!("more than {MAX_STATEMENTS} statements in one material"));
        }
        entry.statements.push(Statement { keyword: keyword.to_ascii_lowercase(), rest: rest.into(), place, rest_at });
    }
    *bytes_read += source.bytes_read();
    Ok(out)
}
