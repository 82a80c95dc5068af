//! A split's objects: built, encoded, stored.

use std::time::Duration;

use rayherd_render::attributes::{AttributeBlock, NO_UV};
use rayherd_render::bvh::{Fork, build_block};

use super::PrepareError;
use super::clock::Clock;
use super::counting::CountingStore;
use super::incidence::CellBox;
use super::records::{ATTRIBUTES, NORMALS, Records, UVS};
use crate::grid::count::box_of;
use crate::grid::lattice::{round_down, round_up};
use crate::manifest::SplitEntry;
use crate::objects::{ObjectError, ObjectKind, ObjectRef, ObjectStore};

/// Takes a split's primitives, packed, in place of its block, which others build of them.
pub type Keep<'a> = dyn Fn(&[u8]) -> Result<ObjectRef, ObjectError> + Sync + 'a;

/// Where the objects of splits go.
pub(super) struct Blocks<'a> {
    pub store: &'a CountingStore<'a>,
    /// Who takes the primitives, if blocks are not built here.
    pub keep: Option<&'a Keep<'a>>,
}

/// Lends rayon's threads to the tree builder.
pub(super) struct Rayon;

impl Fork for Rayon {
    fn join(&self, a: &mut (dyn FnMut() + Send), b: &mut (dyn FnMut() + Send)) {
        rayon::join(a, b);
    }
}

/// A stored split and what its tree took.
#[derive(Debug)]
pub(crate) struct Built {
    pub entry: SplitEntry,
    pub tree: Duration,
}

/// Geometry object of a split. `number` is for messages.
pub(super) fn block(number: u32, records: &Records, fork: &dyn Fork) -> Result<Vec<u8>, PrepareError> {
    let spheres: Vec<_> = records.spheres.iter().map(|s| s.sphere()).collect();
    build_block(&records.triangles, &records.triangle_ids, &spheres, &records.sphere_ids, fork)
        .map_err(|source| PrepareError::Build { split: number, source })
}

/// Builds and stores a split of at least one primitive; or keeps what its block is to be built of, which the entry names then.
pub(super) fn build_split(
    number: u32,
    records: &Records,
    copied: bool,
    blocks: &Blocks,
) -> Result<Built, PrepareError> {
    let started = Clock::start();
    let (geometry, tree) = match blocks.keep {
        Some(keep) => (keep(&records.pack())?, Duration::ZERO),
        None => {
            let block = block(number, records, &Rayon)?;
            let tree = started.elapsed();
            (blocks.store.put(ObjectKind::Geometry, &block)?, tree)
        }
    };
    let attributes = blocks.store.put(ObjectKind::Attributes, &attributes(records).encode())?;

    let mut bounds = CellBox::EMPTY;
    bounds.add(&CellBox::from(box_of(records.triangles.as_flattened())));
    for s in &records.spheres {
        let end = |sign: f64| s.center.map(|c| f64::from(c) + sign * f64::from(s.radius));
        bounds.add(&CellBox { lo: end(-1.0).map(round_down), hi: end(1.0).map(round_up) });
    }
    let (first_id, last_id) = records.id_range().unwrap_or_default();
    let entry = SplitEntry {
        geometry,
        attributes,
        triangles: records.triangles.len() as u64,
        spheres: records.spheres.len() as u64,
        lo: bounds.lo,
        hi: bounds.hi,
        first_id,
        last_id,
        copied,
    };
    Ok(Built { entry, tree })
}

/// Attributes by local index: triangles by ascending id, then spheres.
fn attributes(records: &Records) -> AttributeBlock {
    let shapes: Vec<u32> =
        records.extras.iter().map(|e| e.shape).chain(records.spheres.iter().map(|s| s.shape)).collect();
    let mut block = AttributeBlock { shapes, ..AttributeBlock::default() };
    if !records.normals.is_empty() {
        block.normals = spread(records, &records.normals, NORMALS, Default::default());
    }
    if !records.uvs.is_empty() {
        block.uvs = spread(records, &records.uvs, UVS, NO_UV);
    }
    if !records.attributes.is_empty() {
        block.attributes = spread(records, &records.attributes, ATTRIBUTES, Default::default());
    }
    block
}

/// One value per primitive from those of the triangles that have one; `none` for the others.
fn spread<T: Copy>(records: &Records, values: &[[T; 3]], flag: u32, none: [T; 3]) -> Vec<[T; 3]> {
    let mut values = values.iter();
    let mut out = Vec::with_capacity(records.len());
    for extra in &records.extras {
        let value = if extra.has & flag != 0 { values.next().copied() } else { None };
        out.push(value.unwrap_or(none));
    }
    out.resize(records.len(), none);
    out
}
