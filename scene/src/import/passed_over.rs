//! What a mesh file holds that nothing here uses, as far as its first bytes tell: no pass over the file is spent on a note.

use std::path::Path;

use super::serialized::SerializedReader;
use super::stl::StlReader;
use super::{obj, ply};
use crate::description::MeshFormat;

/// What the head of a mesh says.
#[derive(Default)]
pub(super) struct PassedOver {
    /// Colours (or weights) that are not read, as a note has it.
    pub colors: Option<&'static str>,
    /// Whether an OBJ file names material libraries.
    pub libraries: bool,
    /// Bytes read to know.
    pub bytes_read: u64,
}

/// Looks into the head of a mesh. Of a file that cannot be read nothing is said: reading its triangles says what is wrong.
pub(super) fn passed_over(path: &Path, format: MeshFormat) -> PassedOver {
    let only_if =
        |(has, bytes_read): (bool, u64), text| PassedOver { colors: has.then_some(text), libraries: false, bytes_read };
    let found = match format {
        MeshFormat::Obj => obj::head(path).map(|head| PassedOver {
            colors: head.passed_over(),
            libraries: !head.libraries.is_empty(),
            bytes_read: head.bytes_read,
        }),
        MeshFormat::Ply => ply::colors(path).map(|(colors, bytes)| {
            only_if(
                (colors.is_some(), bytes),
                "colours of the ply are passed over: name them by a mesh_attribute in a bsdf",
            )
        }),
        MeshFormat::Stl => StlReader::has_colors(path)
            .map(|found| only_if(found, "colours of the stl are passed over: a ply with colours is read with them")),
        MeshFormat::Serialized(index) => SerializedReader::has_colors(path, index).map(|found| {
            only_if(found, "colours of the serialized mesh are passed over: a ply with colours is read with them")
        }),
    };
    found.unwrap_or_default()
}
