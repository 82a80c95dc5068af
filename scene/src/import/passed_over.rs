//! What a mesh file holds that nothing here uses, as far as its first bytes tell: no pass over the file is spent on a note.

use std::path::Path;

use super::serialized::SerializedReader;
use super::stl::StlReader;
use super::{obj, ply};
use crate::description::MeshFormat;

/// What the head of a mesh says.
#[derive(Default)]
pub(super) struct PassedOver {
    /// Colours, weights or textures that are not read, as notes have it.
    pub looks: Vec<&'static str>,
    /// Whether an OBJ file names material libraries.
    pub libraries: bool,
    /// Bytes read to know.
    pub bytes_read: u64,
}

/// Looks into the head of a mesh. Of a file that cannot be read nothing is said: reading its triangles says what is wrong.
pub(super) fn passed_over(path: &Path, format: MeshFormat) -> PassedOver {
    let only_if = |(has, bytes_read): (bool, u64), text| PassedOver {
        looks: has.then_some(text).into_iter().collect(),
        libraries: false,
        bytes_read,
    };
    let found = match format {
        MeshFormat::Obj => obj::head(path).map(|head| PassedOver {
            looks: head.passed_over().into_iter().collect(),
            libraries: !head.libraries.is_empty(),
            bytes_read: head.bytes_read,
        }),
        MeshFormat::Ply => ply::looks(path).map(|found| {
            let colors = "colours of the ply are passed over: name them by a mesh_attribute in a bsdf";
            let texture = "the texture that the ply names is passed over: put a bsdf that has it into the shape";
            let looks = [found.colors.map(|_| colors), found.texture.map(|_| texture)].into_iter().flatten().collect();
            PassedOver { looks, libraries: false, bytes_read: found.bytes_read }
        }),
        MeshFormat::Stl => StlReader::has_colors(path)
            .map(|found| only_if(found, "colours of the stl are passed over: a ply with colours is read with them")),
        MeshFormat::Serialized(index) => SerializedReader::has_colors(path, index).map(|found| {
            only_if(found, "colours of the serialized mesh are passed over: a ply with colours is read with them")
        }),
    };
    found.unwrap_or_default()
}
