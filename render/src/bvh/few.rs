//! The primitives of a small forest as plain lists, for a kernel that goes through all of them without a tree.

use super::forest::Forest;
use super::layout::*;
use super::trace::read_triangle;
use super::{Sphere, block::read_sphere};
use crate::ray::PrimId;

/// Triangles for each ray that a packet holds from which on the tree is faster; a triangle counts as often as a leaf has it. Measured on
/// 20 to 380 triangles of boxes in a room (docs/benchmarks/tried.md).
const TRIANGLES_A_LANE: usize = 8;
/// So many at most, for the packets of the widest vectors.
const MOST_TRIANGLES: usize = TRIANGLES_A_LANE * 16;
/// Spheres from which on the tree is taken.
const MOST_SPHERES: usize = 16;

/// A small forest's primitives.
///
/// A primitive's *rank* is its place in the order of [`Forest::precedes`]: at the same distance, the lesser one is hit. Ranks are
/// few, so that an f32 holds them.
#[derive(Debug, Default)]
pub(super) struct Few {
    /// Boxes, each around some triangles.
    pub groups: Vec<Group>,
    /// The triangles three times, group after group: for rays whose largest component is along x, y and z.
    pub along: [Vec<Along>; 3],
    /// The spheres.
    pub balls: Vec<Ball>,
    /// By rank.
    pub places: Vec<Place>,
}

/// Some triangles that lie near to each other: those of a leaf.
#[derive(Clone, Copy, Debug)]
pub(super) struct Group {
    /// Around the parts of the triangles that count here.
    pub bounds: Aabb,
    /// Number of the last triangle and one.
    pub end: usize,
}

/// A triangle for rays along one axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Along {
    /// Its vertices' coordinates: the two other axes in cyclic order, then the axis of the ray.
    pub vertices: [[f32; 3]; 3],
    /// See [`Few`].
    pub rank: f32,
}

/// A sphere.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ball {
    /// Around it.
    pub bounds: Aabb,
    /// It.
    pub sphere: Sphere,
    /// See [`Few`].
    pub rank: f32,
}

/// Where a primitive lies, as a hit says it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Slot in the forest.
    pub slot: u32,
    /// Reference to a leaf that has it.
    pub leaf: u32,
    /// Which of that leaf's primitives it is.
    pub lane: u32,
}

impl Few {
    /// The primitives in the trees at these roots (nodes) of the forest, if they are few.
    pub fn of(forest: &Forest, triangles: u32, spheres: Option<u32>) -> Option<Few> {
        if forest.primitives() > (MOST_TRIANGLES + MOST_SPHERES) as u64 {
            return None;
        }
        let arena = forest.arena();
        let triangle_leaves = leaves(arena, triangles, MOST_TRIANGLES)?;
        let sphere_leaves = spheres.map_or(Some(Vec::new()), |root| leaves(arena, root, MOST_SPHERES))?;

        let all = triangle_leaves.iter().chain(&sphere_leaves).flat_map(|&(_, leaf)| {
            (0..leaf_len(leaf)).map(move |i| Place { slot: read_index(arena, leaf, i), leaf, lane: i as u32 })
        });
        let mut places: Vec<(PrimId, Place)> = all.map(|place| (forest.prim_id(place.slot), place)).collect();
        places.sort_by_key(|(id, place)| (*id, place.slot));
        // a triangle may stand in several leaves: any of them will do
        places.dedup_by_key(|(_, place)| place.slot);
        let rank = |leaf: u32, i: usize| {
            let slot = read_index(arena, leaf, i);
            places.iter().position(|(_, place)| place.slot == slot).expect("every slot has its place") as f32
        };

        let mut few = Few::default();
        for (bounds, leaf) in triangle_leaves {
            for i in 0..leaf_len(leaf) {
                let vertices = read_triangle(arena, offset(leaf), leaf_len(leaf), i);
                for (z, along) in few.along.iter_mut().enumerate() {
                    let vertices = vertices.map(|p| [p[(z + 1) % 3], p[(z + 2) % 3], p[z]]);
                    along.push(Along { vertices, rank: rank(leaf, i) });
                }
            }
            few.groups.push(Group { bounds, end: few.along[0].len() });
        }
        for (_, leaf) in sphere_leaves {
            few.balls.extend((0..leaf_len(leaf)).map(|i| {
                let sphere = read_sphere(arena, offset(leaf), leaf_len(leaf), i);
                Ball { bounds: Aabb::of_sphere(sphere.center, sphere.radius), sphere, rank: rank(leaf, i) }
            }));
        }
        few.places = places.into_iter().map(|(_, place)| place).collect();
        Some(few)
    }

    /// Whether packets of so many rays are faster than the tree.
    pub fn suits(&self, lanes: usize) -> bool {
        self.along[0].len() <= TRIANGLES_A_LANE * lanes
    }
}

/// The leaves below a node with their boxes, if they have no more primitives than `most`.
fn leaves(arena: &[u8], root: u32, most: usize) -> Option<Vec<(Aabb, u32)>> {
    let (mut out, mut primitives) = (Vec::new(), 0);
    let mut nodes = vec![root];
    while let Some(node) = nodes.pop() {
        for slot in 0..WIDTH {
            match read_slot(arena, offset(node), slot) {
                (_, 0) => {}
                (bounds, reference) if reference & LEAF != 0 => {
                    primitives += leaf_len(reference);
                    out.push((bounds, reference));
                }
                (_, reference) => nodes.push(reference),
            }
        }
        if primitives > most {
            return None;
        }
    }
    Some(out)
}
