//! XML as text: its lines and head, what the parser would take too long over, and names.

use std::path::Path;

use crate::description::Place;

/// Where the lines of a text begin: places by binary search, as roxmltree's own look-up is linear in the offset.
pub(super) struct Lines(Vec<usize>);

impl Lines {
    pub(super) fn of(text: &str) -> Self {
        let ends = text.bytes().enumerate().filter(|(_, b)| *b == b'\n').map(|(i, _)| i + 1);
        Lines(std::iter::once(0).chain(ends).collect())
    }
    /// Of a byte. What is read of a scene is far less than 4 GiB: both numbers fit.
    pub(super) fn place(&self, path: &Path, offset: usize) -> Place {
        let line = self.0.partition_point(|&start| start <= offset);
        let column = offset - self.0[line - 1] + 1;
        Place { file: path.into(), line: line as u32, column: column as u32 }
    }
}

/// Offset of what follows the declaration, comments and instructions at the start.
pub(super) fn after_prolog(text: &str) -> usize {
    let mut rest = text.trim_start();
    while let Some(end) = [("<!--", "-->"), ("<?", "?>")].iter().find_map(|(start, end)| {
        let at = rest.strip_prefix(start)?.find(end)?;
        Some(start.len() + at + end.len())
    }) {
        rest = rest[end..].trim_start();
    }
    text.len() - rest.len()
}

/// Offset of a stretch without `<` that has too many `=`; an element's attributes lie in such a stretch.
pub(super) fn crowded_element(text: &str, most: usize) -> Option<usize> {
    let mut offset = 0;
    for part in text.split('<') {
        if part.bytes().filter(|b| *b == b'=').count() > most {
            return Some(offset);
        }
        offset += part.len() + 1;
    }
    None
}

/// `toWorld` to `to_world`, as Mitsuba 3 upgrades older files.
pub(super) fn snake_case(name: &str) -> String {
    let mut out = String::with_capacity(name.len() + 4);
    let mut previous_lower = false;
    let mut in_capitals = false;
    for c in name.chars() {
        if c.is_ascii_uppercase() && (previous_lower || in_capitals) {
            if previous_lower {
                out.push('_');
            }
            out.push(c.to_ascii_lowercase());
            in_capitals = true;
        } else {
            out.push(c);
            in_capitals = false;
        }
        previous_lower = c.is_ascii_lowercase();
    }
    out
}
