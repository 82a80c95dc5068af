//! One statement of a material: its numbers, its colour, its map.

use super::super::source::{Words, show};
use crate::ImportError;
use crate::description::{Place, UvMap, Wrap};

/// A line of a material.
pub(super) struct Statement {
    /// In small letters: exporters do not agree on them.
    pub keyword: String,
    pub rest: String,
    /// Of the keyword; and how many bytes after the start of its line the rest begins.
    pub place: Place,
    pub rest_at: usize,
}

/// What a map statement says.
pub(super) struct Map {
    pub file: String,
    pub to_uv: UvMap,
    pub wrap: Wrap,
    /// `-bm`.
    pub bump: f32,
    /// Options that change what a texture gives, and are not read.
    pub unread: Vec<String>,
}

impl Statement {
    pub fn fail<T>(&self, message: impl std::fmt::Display) -> Result<T, ImportError> {
        Err(ImportError::Malformed { place: self.place.clone(), message: format!("{}: {message}", self.keyword) })
    }

    /// An error so many bytes after the start of the rest.
    fn fail_at<T>(&self, at: usize, message: impl std::fmt::Display) -> Result<T, ImportError> {
        let place = self.place.clone().at(self.rest_at + at);
        Err(ImportError::Malformed { place, message: format!("{}: {message}", self.keyword) })
    }

    /// The words of the rest, and how many bytes stand before each.
    fn words(&self) -> Vec<(usize, &str)> {
        let mut words = Words::new(self.rest.as_bytes());
        let mut out = Vec::new();
        while let Some(word) = words.next() {
            out.push((words.at(), &self.rest[words.at()..words.at() + word.len()]));
        }
        out
    }

    fn parse(&self, (at, word): (usize, &str)) -> Result<f64, ImportError> {
        match word.parse::<f64>() {
            Ok(x) if x.is_finite() => Ok(x),
            _ => self.fail_at(at, format_args!("\"{}\" is no finite number", show(word.as_bytes()))),
        }
    }

    fn parse_positive(&self, word: (usize, &str)) -> Result<f64, ImportError> {
        let x = self.parse(word)?;
        if x < 0.0 { self.fail_at(word.0, format_args!("{x} should not be negative")) } else { Ok(x) }
    }

    /// Its only number, of at least 0.
    pub fn positive(&self) -> Result<f64, ImportError> {
        self.parse_positive((0, &self.rest))
    }

    /// One number (grey) or three of at least 0, linear; `None` of a spectrum or of CIE XYZ, which are not read.
    pub fn color(&self) -> Result<Option<[f64; 3]>, ImportError> {
        let words = self.words();
        match words[..] {
            [(_, "spectral" | "xyz"), ..] => Ok(None),
            [v] => Ok(Some([self.parse_positive(v)?; 3])),
            [r, g, b] => Ok(Some([self.parse_positive(r)?, self.parse_positive(g)?, self.parse_positive(b)?])),
            _ => self.fail_at(0, format_args!("{} numbers instead of one or three", words.len())),
        }
    }

    /// A file with options before it.
    pub fn map(&self) -> Result<Map, ImportError> {
        let words = self.words();
        let (mut scale, mut offset, mut turbulence) = ([1.0; 3], [0.0; 3], [0.0; 3]);
        let mut map =
            Map { file: String::new(), to_uv: UvMap::IDENTITY, wrap: Wrap::Repeat, bump: 1.0, unread: Vec::new() };
        let mut at = 0;
        while let Some(option) = words.get(at).filter(|(_, w)| w.starts_with('-') && at + 1 < words.len()) {
            at += 1;
            match option.1 {
                "-s" => at += self.up_to_three(&words[at..], &mut scale)?,
                "-o" => at += self.up_to_three(&words[at..], &mut offset)?,
                "-t" => at += self.up_to_three(&words[at..], &mut turbulence)?,
                "-bm" => {
                    map.bump = self.parse(words[at])? as f32;
                    at += 1;
                }
                "-clamp" => {
                    map.wrap = if words[at].1.eq_ignore_ascii_case("on") { Wrap::Clamp } else { Wrap::Repeat };
                    at += 1;
                }
                "-mm" => {
                    let mut range = [0.0, 1.0, 0.0];
                    at += self.up_to_three(&words[at..(at + 2).min(words.len())], &mut range)?;
                    if range[..2] != [0.0, 1.0] {
                        map.unread.push(format!("-mm {} {}", range[0], range[1]));
                    }
                }
                "-imfchan" => {
                    // luminance is what a number of a colour is anyway
                    if words[at].1 != "l" {
                        map.unread.push(format!("-imfchan {}", words[at].1));
                    }
                    at += 1;
                }
                // how a texture is filtered or kept, or colour correction of other programs
                "-blendu" | "-blendv" | "-boost" | "-cc" | "-texres" | "-colorspace" | "-type" => at += 1,
                other => {
                    return self.fail_at(option.0, format_args!("no option {other} is known; see docs/formats.md"));
                }
            }
        }
        map.file = words[at..].iter().map(|(_, word)| *word).collect::<Vec<_>>().join(" ");
        if map.file.is_empty() {
            return self.fail("it names no file");
        }
        if turbulence != [0.0; 3] {
            map.unread.push("-t".into());
        }
        // coordinates of OBJ have v upwards, ours are turned round when the mesh is read: v' = 1 - v
        let [u, v] = [0, 1].map(|k| [scale[k] as f32, offset[k] as f32]);
        map.to_uv = UvMap([[u[0], 0.0, u[1]], [0.0, v[0], 1.0 - v[0] - v[1]]]);
        Ok(map)
    }

    /// Reads one to three numbers into the first of `out`; how many there were.
    fn up_to_three(&self, words: &[(usize, &str)], out: &mut [f64; 3]) -> Result<usize, ImportError> {
        let mut n = 0;
        for (slot, word) in out.iter_mut().zip(words) {
            match word.1.parse::<f64>() {
                Ok(_) => *slot = self.parse(*word)?,
                Err(_) => break,
            }
            n += 1;
        }
        let at = words.first().map_or(0, |(at, _)| *at);
        if n == 0 { self.fail_at(at, "an option lacks its numbers") } else { Ok(n) }
    }
}
