//! STL, ascii and binary. The front of a triangle is by the order of its vertices; the file's own normals are not used.

use std::path::Path;

use super::mesh::{Corners, TriangleReader, budget};
use super::number::number;
use super::source::{Source, show};
use super::spill::Budget;
use super::stream::StreamOptions;
use crate::ImportError;

/// Bytes of a binary file's head (80 of text, 4 of count) and of one triangle.
const HEAD: u64 = 84;
const TRIANGLE: usize = 50;

/// An STL file being read.
pub(super) struct StlReader {
    source: Source,
    budget: Budget,
    format: Format,
    done: u64,
}

enum Format {
    Ascii {
        /// First and last vertex of a loop being fanned.
        fan: Option<[[f64; 3]; 2]>,
        recognized: bool,
    },
    Binary {
        count: u64,
    },
}

impl StlReader {
    /// Opens a file. It is text if it begins with `solid` and its first bytes are text, and is not exactly as long as its binary
    /// count says (binary files that begin with `solid` exist).
    pub fn open(path: &Path, options: &StreamOptions) -> Result<Self, ImportError> {
        StlReader::of(Source::open(path)?, options)
    }

    fn of(mut source: Source, options: &StreamOptions) -> Result<Self, ImportError> {
        let length = source.length();
        let head = source.peek(1024)?;
        let count = head.get(80..84).map(|b| u64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])));
        let exact = count.is_some_and(|n| length == Some(HEAD + n * TRIANGLE as u64));
        let text = head.trim_ascii_start().get(..5).is_some_and(|w| w.eq_ignore_ascii_case(b"solid"))
            && head.iter().all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace() || *b >= 0x80);
        if text && !exact {
            source.begin_tokens();
            let format = Format::Ascii { fan: None, recognized: false };
            return Ok(StlReader { source, budget: budget(options), format, done: 0 });
        }
        let Some(count) = count else {
            return source
                .fail_byte("this is no STL file: too short for a binary one, and no text that begins with solid");
        };
        if let Some(length) = length
            && !exact
        {
            let held = length.saturating_sub(HEAD) / TRIANGLE as u64;
            let message = format!(
                "the head says {count} triangles, the {length} bytes of the file hold {held}: it is truncated or no STL file, \
                 export it again"
            );
            return source.fail_limit(message);
        }
        source.skip(HEAD)?;
        Ok(StlReader { source, budget: budget(options), format: Format::Binary { count }, done: 0 })
    }

    /// Whether a file has colours, as far as its head and its first triangle tell, and the bytes read for it. Two programs have put them into
    /// the 16 bits that the format leaves free, one of them with `COLOR=` in the head.
    pub fn has_colors(path: &Path) -> Result<(bool, u64), ImportError> {
        let mut source = Source::open_head(path)?;
        let head = source.peek(HEAD as usize + TRIANGLE)?.to_vec();
        let reader = StlReader::of(source, &StreamOptions::default())?;
        let said = head.get(..80).is_some_and(|text| text.windows(6).any(|w| w == b"COLOR="));
        let word = head.get(HEAD as usize + TRIANGLE - 2..).unwrap_or_default();
        let colored = match reader.format {
            Format::Binary { count } => count > 0 && (said || word.iter().any(|b| *b != 0)),
            Format::Ascii { .. } => false,
        };
        Ok((colored, reader.source.bytes_read()))
    }

    fn next_binary(&mut self) -> Result<[[f64; 3]; 3], ImportError> {
        let bytes = self.source.exact(TRIANGLE)?;
        let float = |i: usize| {
            let at = 12 + 4 * i;
            f64::from(f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]))
        };
        Ok([0, 3, 6].map(|i| [float(i), float(i + 1), float(i + 2)]))
    }

    /// The next triangle of a text; a loop of more than three vertices is fanned.
    fn next_ascii(&mut self) -> Result<Option<[[f64; 3]; 3]>, ImportError> {
        let mut corners = [[0.0; 3]; 2];
        let mut count = 0;
        let mut fan = match self.format {
            Format::Ascii { fan, .. } => fan,
            Format::Binary { .. } => None,
        };
        loop {
            let Some(word) = self.source.token()? else {
                if let Format::Ascii { recognized: false, .. } = self.format {
                    return self.source.fail_in(1, 0, "no facet in this file: it is no STL file, or it is empty");
                }
                if count > 0 || fan.is_some() {
                    return self
                        .source
                        .fail_word("the file ends in the middle of a facet: it is truncated, get it again");
                }
                return Ok(None);
            };
            match word {
                b"vertex" => {
                    let vertex = [self.float()?, self.float()?, self.float()?];
                    if let Some([first, previous]) = fan {
                        self.format = Format::Ascii { fan: Some([first, vertex]), recognized: true };
                        return Ok(Some([first, previous, vertex]));
                    }
                    if count == 2 {
                        let [a, b] = corners;
                        self.format = Format::Ascii { fan: Some([a, vertex]), recognized: true };
                        return Ok(Some([a, b, vertex]));
                    }
                    corners[count] = vertex;
                    count += 1;
                }
                b"endloop" => {
                    if count > 0 {
                        let message = format!("a loop of {count} vertices, which has no area: export the file again");
                        return self.source.fail_word(message);
                    }
                    fan = None;
                    self.format = Format::Ascii { fan: None, recognized: true };
                }
                // the name of a solid is anything
                b"solid" | b"endsolid" => {
                    self.source.rest_of_line()?;
                    if let Format::Ascii { recognized, .. } = &mut self.format {
                        *recognized |= self.done > 0;
                    }
                }
                b"facet" | b"endfacet" | b"outer" | b"loop" => {
                    if let Format::Ascii { recognized, .. } = &mut self.format {
                        *recognized = true;
                    }
                }
                // the facet's normal
                b"normal" => {
                    for _ in 0..3 {
                        self.float()?;
                    }
                }
                other => {
                    let word = show(other);
                    return self.source.fail_word(format!(
                        "\"{word}\" is no word of STL: export the file again, in binary if you can"
                    ));
                }
            }
        }
    }

    fn float(&mut self) -> Result<f64, ImportError> {
        match self.source.token()? {
            Some(word) => match number::<f32>(word) {
                Some(value) => Ok(value.into()),
                None => {
                    let word = show(word);
                    self.source.fail_word(format!("\"{word}\" where a number should be"))
                }
            },
            None => self.source.fail_word("the file ends in the middle of a facet: it is truncated, get it again"),
        }
    }
}

impl TriangleReader for StlReader {
    type Triangle = [[f64; 3]; 3];

    fn next(&mut self) -> Result<Option<[[f64; 3]; 3]>, ImportError> {
        let p = match self.format {
            Format::Ascii { .. } => self.next_ascii()?,
            Format::Binary { count } if self.done == count => None,
            Format::Binary { .. } => Some(self.next_binary()?),
        };
        self.done += u64::from(p.is_some());
        Ok(p)
    }

    fn corners(&self, p: &[[f64; 3]; 3]) -> Corners {
        Corners { p: *p, n: None, uv: None, attribute: None }
    }

    fn has_normals(&self, _: &[[f64; 3]; 3]) -> bool {
        false
    }

    /// No vertex is shared, and nothing is smoothed: none has a number.
    fn vertices(_: &[[f64; 3]; 3]) -> [usize; 3] {
        [0; 3]
    }

    fn vertex_count(&self) -> usize {
        1
    }

    fn source(&self) -> &Source {
        &self.source
    }

    fn budget(&mut self) -> &mut Budget {
        &mut self.budget
    }
}

#[cfg(test)]
mod tests;
