//! A split's geometry object: the built tree with its triangles and spheres, and their global ids.
//!
//! Little-endian throughout. A header of 128 bytes:
//!
//! | byte | what |
//! |---|---|
//! | 0 | magic, 8 bytes: `RHGEOM\r\n` |
//! | 8 | u32 version, 2; 1 is the same with each triangle in one leaf |
//! | 12 | u32 number of triangles |
//! | 16 | u32 number of spheres |
//! | 20 | u32 root of the triangles' tree, bytes / 32 in the arena, or 2^32 - 1 without triangles (else 0) |
//! | 24 | u32 root of the spheres' tree, bytes / 32 in the arena, or 2^32 - 1 without spheres |
//! | 28 | u32 coding of the ids (see [`super::ids`]) |
//! | 32 | u32 stack entries that the triangles' tree needs |
//! | 36 | u32 stack entries that the spheres' tree needs |
//! | 40 | 3 f32 lower and 3 f32 upper corner of the bounds; +inf and -inf when the block is empty |
//! | 64 | f32 largest magnitude of a coordinate of the bounds |
//! | 68 | u32 zero |
//! | 72 | u64 bytes of the arena, a multiple of 64 |
//! | 80 | u64 bytes of the ids |
//! | 88 | zeros |
//!
//! Then the arena (see [`super::layout`]): the triangles' tree, the spheres' tree. Then the ids (see [`super::ids`]).
//! The local index of a primitive is its place in the given order: triangles by ascending id, then spheres by ascending
//! id. The bytes are a function of the primitives and their ids alone.

use super::collapse::{Content, Plan};
use super::ids::Ids;
use super::layout::*;
use super::parts::Parts;
use super::reinsert::improved;
use super::{Fork, sah};
use crate::memory::zeros;
use crate::ray::PrimId;

pub(super) const MAGIC: [u8; 8] = *b"RHGEOM\r\n";
pub(super) const VERSION: u32 = 2;
/// The oldest that is read.
pub(super) const OLDEST: u32 = 1;
/// Bytes before the arena.
pub(super) const HEADER: usize = 128;
/// In place of a root when there is no tree.
pub(super) const NO_ROOT: u32 = u32::MAX;
/// More primitives than this do not fit an arena, whatever their tree.
pub(super) const MAX_PRIMITIVES: usize = 1 << 27;

/// An exact sphere of a block.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Centre, recentred scene units.
    pub center: [f32; 3],
    /// Radius, above 0.
    pub radius: f32,
    /// Front is inside.
    pub flipped: bool,
}

/// Why a block cannot be built.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BuildError {
    /// Caller's arrays do not fit together.
    #[error("{primitives} primitives have {ids} ids")]
    Counts {
        /// Primitives of one kind.
        primitives: usize,
        /// Ids given for them.
        ids: usize,
    },
    /// Ids must ascend.
    #[error("ids of primitives do not ascend: {after} follows {before}")]
    Order {
        /// An id.
        before: PrimId,
        /// The one after it.
        after: PrimId,
    },
    /// A coordinate is NaN, infinite or above [`MAX_COORDINATE`], or a radius is not above 0.
    #[error(
        "primitive {id} has a coordinate that is not finite or beyond 2^40 units, or a radius not above 0: skip or rescale it"
    )]
    Unsound {
        /// Which.
        id: PrimId,
    },
    /// Too much for one block.
    #[error("{primitives} primitives are too many for one block of at most 8 GiB: make smaller splits")]
    TooLarge {
        /// How many.
        primitives: usize,
    },
}

/// Builds a geometry object.
///
/// Ids ascend within each kind. `fork` is asked to share the work; the bytes do not depend on it. Memory while it runs is
/// some 150 bytes per primitive beside the result's 50.
///
/// # Errors
/// See [`BuildError`].
pub fn build_block(
    triangles: &[[[f32; 3]; 3]],
    triangle_ids: &[PrimId],
    spheres: &[Sphere],
    sphere_ids: &[PrimId],
    fork: &dyn Fork,
) -> Result<Vec<u8>, BuildError> {
    check_ids(triangles.len(), triangle_ids)?;
    check_ids(spheres.len(), sphere_ids)?;
    let primitives = triangles.len() + spheres.len();
    if primitives > MAX_PRIMITIVES {
        return Err(BuildError::TooLarge { primitives });
    }
    let parts = Parts::new(triangles, fork).map_err(|at| BuildError::Unsound { id: triangle_ids[at] })?;
    for (s, &id) in spheres.iter().zip(sphere_ids) {
        if !(s.radius > 0.0 && Aabb::of_sphere(s.center, s.radius).is_sound()) {
            return Err(BuildError::Unsound { id });
        }
    }

    let leaf = WIDTH as u32;
    let triangle_tree = (!triangles.is_empty()).then(|| improved(sah::build(&parts, leaf, fork), leaf));
    let sphere_boxes: Vec<Aabb> = spheres.iter().map(|s| Aabb::of_sphere(s.center, s.radius)).collect();
    let sphere_tree = (!spheres.is_empty()).then(|| improved(sah::build(&sphere_boxes[..], leaf, fork), leaf));
    let triangle_content = Triangles { triangles, parts: &parts };
    let sphere_content = Spheres { spheres, first: triangles.len() as u32 };
    let triangle_plan = triangle_tree.as_ref().map(|tree| Plan::new(tree, &triangle_content, fork));
    let sphere_plan = sphere_tree.as_ref().map(|tree| Plan::new(tree, &sphere_content, fork));
    let triangle_bytes = triangle_plan.as_ref().map_or(0, |p| p.bytes);
    let sphere_bytes = sphere_plan.as_ref().map_or(0, |p| p.bytes);
    let arena = triangle_bytes + sphere_bytes;
    if arena as u64 > MAX_ARENA / 2 {
        // half: a forest needs room beside its blocks, and offsets of a tree's end must fit
        return Err(BuildError::TooLarge { primitives });
    }

    let mut out = zeros(HEADER + arena);
    let mut bounds = Aabb::EMPTY;
    if let Some(plan) = &triangle_plan {
        bounds = plan.write(&mut out[HEADER..][..triangle_bytes], 0);
    }
    if let Some(plan) = &sphere_plan {
        bounds = bounds.union(&plan.write(&mut out[HEADER + triangle_bytes..], triangle_bytes));
    }
    let ids = Ids::new(triangle_ids.iter().chain(sphere_ids).copied());
    let id_bytes = {
        ids.write(&mut out);
        out.len() - HEADER - arena
    };
    out[..8].copy_from_slice(&MAGIC);
    write_u32(&mut out, 8, VERSION);
    write_u32(&mut out, 12, triangles.len() as u32);
    write_u32(&mut out, 16, spheres.len() as u32);
    write_u32(&mut out, 20, if triangle_plan.is_some() { 0 } else { NO_ROOT });
    write_u32(&mut out, 24, if sphere_plan.is_some() { node_ref(triangle_bytes) } else { NO_ROOT });
    write_u32(&mut out, 28, ids.coding());
    write_u32(&mut out, 32, triangle_plan.as_ref().map_or(0, |p| p.stack) as u32);
    write_u32(&mut out, 36, sphere_plan.as_ref().map_or(0, |p| p.stack) as u32);
    for c in 0..3 {
        write_f32(&mut out, 40 + 4 * c, bounds.lo[c]);
        write_f32(&mut out, 52 + 4 * c, bounds.hi[c]);
    }
    write_f32(&mut out, 64, bounds.largest());
    out[72..80].copy_from_slice(&(arena as u64).to_le_bytes());
    out[80..88].copy_from_slice(&(id_bytes as u64).to_le_bytes());
    Ok(out)
}

/// Bytes of an object's arena, at least one unit, and its number of primitives: as the header says, which nobody has checked,
/// but at most what the object has room for.
pub(super) fn sizes(geometry: &[u8]) -> (u64, u32) {
    let unit = NODE_ALIGN as u64;
    if geometry.len() < HEADER {
        return (unit, 0);
    }
    let arena = read_u64(geometry, 72).min(geometry.len() as u64).next_multiple_of(unit).max(unit);
    let most = geometry.len() / PRIMITIVE_BYTES;
    (arena, read_u32(geometry, 12).saturating_add(read_u32(geometry, 16)).min(most as u32))
}

fn check_ids(primitives: usize, ids: &[PrimId]) -> Result<(), BuildError> {
    if primitives != ids.len() {
        return Err(BuildError::Counts { primitives, ids: ids.len() });
    }
    match ids.windows(2).find(|w| w[0] >= w[1]) {
        Some(w) => Err(BuildError::Order { before: w[0], after: w[1] }),
        None => Ok(()),
    }
}

struct Triangles<'a> {
    triangles: &'a [[[f32; 3]; 3]],
    parts: &'a Parts<'a>,
}

impl Triangles<'_> {
    /// The triangles of some boxes, ascending, and how many.
    fn of(&self, boxes: &[u32]) -> ([u32; WIDTH], usize) {
        let mut found = [u32::MAX; WIDTH];
        let mut count = 0;
        for &number in boxes {
            let triangle = self.parts.triangle(number);
            let at = found[..count].iter().take_while(|&&t| t < triangle).count();
            if at == count || found[at] != triangle {
                found.copy_within(at..count, at + 1);
                found[at] = triangle;
                count += 1;
            }
        }
        (found, count)
    }
}

impl Content for Triangles<'_> {
    fn max_leaf(&self) -> u32 {
        WIDTH as u32
    }
    fn leaf_bytes(&self, boxes: &[u32]) -> usize {
        leaf_bytes(if self.parts.has_more() { self.of(boxes).1 } else { boxes.len() })
    }
    fn stack_below(&self, _: &[u32]) -> usize {
        0
    }
    fn write_leaf(&self, boxes: &[u32], out: &mut [u8], at: usize) -> u32 {
        let (found, count) = self.of(boxes);
        write_primitives(&found[..count], 0, out, |i, row| self.triangles[i as usize].as_flattened()[row].to_bits());
        leaf_ref(at, count)
    }
}

struct Spheres<'a> {
    spheres: &'a [Sphere],
    /// Local index of the first.
    first: u32,
}

impl Content for Spheres<'_> {
    fn max_leaf(&self) -> u32 {
        WIDTH as u32
    }
    fn leaf_bytes(&self, boxes: &[u32]) -> usize {
        leaf_bytes(boxes.len())
    }
    fn stack_below(&self, _: &[u32]) -> usize {
        0
    }
    fn write_leaf(&self, boxes: &[u32], out: &mut [u8], at: usize) -> u32 {
        let mut sorted = [u32::MAX; WIDTH];
        let sorted = &mut sorted[..boxes.len()];
        sorted.copy_from_slice(boxes);
        sorted.sort_unstable();
        write_primitives(sorted, self.first, out, |i, row| {
            let s = &self.spheres[i as usize];
            match row {
                0..3 => s.center[row].to_bits(),
                3 => s.radius.to_bits(),
                4 => u32::from(s.flipped),
                _ => 0,
            }
        });
        leaf_ref(at, boxes.len())
    }
}

/// Writes a leaf of primitives by ascending index.
fn write_primitives(sorted: &[u32], first: u32, out: &mut [u8], value: impl Fn(u32, usize) -> u32) {
    let n = sorted.len();
    for (i, &number) in sorted.iter().enumerate() {
        for row in 0..INDEX_ROW {
            write_u32(out, (row * n + i) * 4, value(number, row));
        }
        write_u32(out, (INDEX_ROW * n + i) * 4, first + number);
    }
}

/// The i-th sphere of a leaf of n.
#[inline(always)]
pub(super) fn read_sphere(arena: &[u8], leaf: usize, n: usize, i: usize) -> Sphere {
    let row = |r: usize| read_f32(arena, leaf + (r * n + i) * 4);
    Sphere { center: [row(0), row(1), row(2)], radius: row(3), flipped: row(4).to_bits() != 0 }
}
