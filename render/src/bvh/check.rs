//! Reading geometry objects that nobody vouches for.
//!
//! The arena has to be exactly what [`super::layout`] says, record after record, so one pass in the order of the bytes
//! shows all of it: no record overlaps another, references go forward and form a tree, every primitive of the block
//! stands in a leaf, every box is finite, contains the boxes below it and meets the triangles and contains the spheres there.

use super::block::{HEADER, MAGIC, MAX_PRIMITIVES, NO_ROOT, OLDEST, Sphere, VERSION, read_sphere};
use super::ids::Ids;
use super::layout::*;

/// What is wrong with a geometry object.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BlockError {
    /// Not a geometry object, or one that was cut.
    #[error("not a geometry object: {0}")]
    Format(&'static str),
    /// Of another version: prepare the scene again.
    #[error("geometry object of version {0}, this program reads 1 and 2: prepare the scene again")]
    Version(u32),
    /// The header does not fit the content.
    #[error("geometry object has a wrong header: {0}")]
    Header(&'static str),
    /// A record of the tree is wrong.
    #[error("geometry object is corrupt at byte {at} of its arena: {what}")]
    Tree {
        /// Where, bytes from the arena's start.
        at: usize,
        /// What.
        what: &'static str,
    },
    /// The ids are wrong.
    #[error("geometry object has wrong ids: {0}")]
    Ids(&'static str),
}

/// Traversal stacks above this are refused: built trees stay below (96 levels of at most 7 entries).
const MAX_STACK: usize = 1024;

/// One of a block's two trees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tree {
    /// Offset of the root's node, bytes.
    pub root: usize,
    /// Bounds of what it holds.
    pub aabb: Aabb,
    /// Entries that a traversal's stack can hold at most.
    pub stack: usize,
}

/// A checked block.
#[derive(Debug)]
pub(super) struct Checked<'a> {
    /// Its records.
    pub arena: &'a [u8],
    /// Number of triangles.
    pub triangles: u32,
    /// Number of spheres.
    pub spheres: u32,
    /// The triangles' tree, if there are any.
    pub triangle_tree: Option<Tree>,
    /// The spheres' tree, if there are any.
    pub sphere_tree: Option<Tree>,
    /// Global ids.
    pub ids: Ids,
}

/// A record met in the pass.
#[derive(Clone, Copy, Debug)]
pub(super) enum Record {
    /// A node at an offset.
    Node(usize),
    /// A leaf at an offset with a number of primitives.
    Leaf(usize, usize),
}

/// Checks all of a geometry object. `visit` is called for each record in the order of the bytes, once it was found to lie
/// within the arena; what it does is void when an error is returned in the end.
///
/// Takes memory of a small multiple of `bytes.len()` at most.
pub(super) fn check<'a>(bytes: &'a [u8], visit: &mut dyn FnMut(Record)) -> Result<Checked<'a>, BlockError> {
    if bytes.len() < HEADER {
        return Err(BlockError::Format("shorter than its header"));
    }
    if bytes[..8] != MAGIC {
        return Err(BlockError::Format("it does not begin as one"));
    }
    if !(OLDEST..=VERSION).contains(&read_u32(bytes, 8)) {
        return Err(BlockError::Version(read_u32(bytes, 8)));
    }
    let (triangles, spheres) = (read_u32(bytes, 12), read_u32(bytes, 16));
    let (arena_bytes, id_bytes) = (read_u64(bytes, 72), read_u64(bytes, 80));
    if arena_bytes.checked_add(id_bytes).and_then(|n| n.checked_add(HEADER as u64)) != Some(bytes.len() as u64) {
        return Err(BlockError::Format("its length is not what its header says"));
    }
    if read_u32(bytes, 68) != 0 || bytes[88..HEADER].iter().any(|&b| b != 0) {
        return Err(BlockError::Header("a reserved field is set"));
    }
    if arena_bytes > MAX_ARENA / 2 || !arena_bytes.is_multiple_of(NODE_ALIGN as u64) {
        return Err(BlockError::Header("the arena's size is impossible"));
    }
    let primitives = triangles as usize + spheres as usize;
    if primitives > MAX_PRIMITIVES || (primitives * PRIMITIVE_BYTES) as u64 > arena_bytes {
        return Err(BlockError::Header("there are more primitives than room for them"));
    }
    let (arena, id_part) = bytes[HEADER..].split_at(arena_bytes as usize);
    let ids = Ids::read(read_u32(bytes, 28), id_part, triangles, spheres).map_err(BlockError::Ids)?;

    let mut pass = Pass { arena, next: 0, seen: vec![0; primitives.div_ceil(64)], visit };
    let mut tree = |root_at: usize, stack_at: usize, kind: Kind| -> Result<Option<Tree>, BlockError> {
        let root = read_u32(bytes, root_at);
        let is_empty = kind.first == kind.end;
        let expected = if is_empty { NO_ROOT } else { node_ref(pass.next) };
        if root != expected {
            return Err(BlockError::Header("a tree's root is not where it should be"));
        }
        let tree = if is_empty { None } else { Some(pass.tree(kind)?) };
        if read_u32(bytes, stack_at) as usize != tree.map_or(0, |t| t.stack) {
            return Err(BlockError::Header("a tree needs another stack than it says"));
        }
        Ok(tree)
    };
    let triangle_tree = tree(20, 32, Kind { is_triangle: true, first: 0, end: triangles })?;
    let sphere_tree = tree(24, 36, Kind { is_triangle: false, first: triangles, end: primitives as u32 })?;
    if pass.next != arena.len() {
        return Err(BlockError::Header("the arena is longer than its trees"));
    }
    let aabb = [triangle_tree, sphere_tree].iter().flatten().fold(Aabb::EMPTY, |b, t| b.union(&t.aabb));
    let corner = |at: usize| std::array::from_fn(|c| read_f32(bytes, at + 4 * c));
    if (Aabb { lo: corner(40), hi: corner(52) }) != aabb || read_f32(bytes, 64) != aabb.largest() {
        return Err(BlockError::Header("the bounds are not those of the content"));
    }
    Ok(Checked { arena, triangles, spheres, triangle_tree, sphere_tree, ids })
}

/// What a tree may hold.
#[derive(Clone, Copy)]
struct Kind {
    is_triangle: bool,
    /// First local index.
    first: u32,
    /// Local index after the last.
    end: u32,
}

/// The pass over the arena.
struct Pass<'a, 'v> {
    arena: &'a [u8],
    /// Where the next record has to be.
    next: usize,
    /// Bit by local index.
    seen: Vec<u64>,
    visit: &'v mut dyn FnMut(Record),
}

/// A node that is to come.
struct Pending {
    reference: u32,
    /// Where it is referred to.
    from: usize,
    /// Box that it has to stay in.
    within: Option<Aabb>,
    /// Stack entries below it.
    below: usize,
}

impl Pass<'_, '_> {
    fn tree(&mut self, kind: Kind) -> Result<Tree, BlockError> {
        let root = self.next;
        let mut found = 0;
        let mut tree = Tree { root, aabb: Aabb::EMPTY, stack: 0 };
        let mut pending = vec![Pending { reference: node_ref(root), from: root, within: None, below: 0 }];
        while let Some(p) = pending.pop() {
            let fail = |what| Err(BlockError::Tree { at: p.from, what });
            let at = self.next;
            if p.reference != node_ref(at) {
                return fail("a reference does not lead to the next record");
            }
            if self.arena.len() - at < NODE_BYTES {
                return fail("a node passes the end");
            }
            (self.visit)(Record::Node(at));
            self.next += NODE_BYTES;
            let slots: [(Aabb, u32); WIDTH] = std::array::from_fn(|slot| read_slot(self.arena, at, slot));
            let used = slots.iter().filter(|s| s.1 != 0).count();
            if used == 0 {
                return fail("a node has no children");
            }
            tree.stack = tree.stack.max(p.below + used);
            if tree.stack > MAX_STACK {
                return fail("the tree is too deep");
            }
            let mut union = Aabb::EMPTY;
            for (aabb, reference) in &slots {
                if *reference != 0 {
                    union = union.union(aabb);
                }
            }
            if p.within.is_none() {
                tree.aabb = union;
            }
            for (aabb, reference) in &slots {
                if *reference == 0 {
                    if *aabb != Aabb::EMPTY {
                        return fail("an empty slot has a box");
                    }
                    continue;
                }
                if !aabb.is_sound() {
                    return fail("a box is not finite, too large or inverted");
                }
                if reference & LEAF != 0 {
                    found += self.leaf(at, *reference, aabb, &tree.aabb, kind)?;
                }
            }
            if p.within.is_some_and(|b| !b.contains(&union)) {
                return fail("a box does not contain the boxes below it");
            }
            for (aabb, reference) in slots.iter().rev() {
                if *reference != 0 && reference & LEAF == 0 {
                    let below = p.below + used - 1;
                    pending.push(Pending { reference: *reference, from: at, within: Some(*aabb), below });
                }
            }
            self.next = self.next.next_multiple_of(NODE_ALIGN);
        }
        if found != (kind.end - kind.first) as usize {
            return Err(BlockError::Tree { at: root, what: "primitives are missing" });
        }
        Ok(tree)
    }

    /// Checks a leaf: how many of its primitives were in none before.
    fn leaf(
        &mut self,
        from: usize,
        reference: u32,
        aabb: &Aabb,
        bounds: &Aabb,
        kind: Kind,
    ) -> Result<usize, BlockError> {
        let (at, n) = (self.next, leaf_len(reference));
        let fail = |what| Err(BlockError::Tree { at: from, what });
        if reference != leaf_ref(at, n) {
            return fail("a reference does not lead to the next record");
        }
        if at > self.arena.len() || self.arena.len() - at < leaf_bytes(n) {
            return fail("a leaf passes the end");
        }
        let row = |r: usize| self.arena[at + r * n * 4..][..n * 4].chunks_exact(4).map(|x| read_u32(x, 0));
        if kind.is_triangle {
            // a large triangle stands in several leaves, each of whose boxes holds a part of it
            for axis in 0..3 {
                let corners = |i: usize| {
                    let x = |vertex: usize| read_f32(self.arena, at + ((3 * vertex + axis) * n + i) * 4);
                    [x(0), x(1), x(2)]
                };
                for corners in (0..n).map(corners) {
                    // false for NaN as well
                    if !corners.iter().all(|&x| bounds.lo[axis] <= x && x <= bounds.hi[axis]) {
                        return fail("a triangle passes the bounds of its tree");
                    }
                    if !corners.iter().any(|&x| x >= aabb.lo[axis]) || !corners.iter().any(|&x| x <= aabb.hi[axis]) {
                        return fail("a box does not meet its triangles");
                    }
                }
            }
        } else {
            if row(3).any(|x| !(f32::from_bits(x) > 0.0 && f32::from_bits(x) <= MAX_COORDINATE))
                || row(4).any(|x| x > 1)
            {
                return fail("a sphere has a wrong radius or flag");
            }
            if (5..INDEX_ROW).any(|r| row(r).any(|x| x != 0)) {
                return fail("a reserved field is set");
            }
            for i in 0..n {
                let Sphere { center, radius, .. } = read_sphere(self.arena, at, n, i);
                // false for NaN as well: of_sphere passes it on
                if !aabb.contains(&Aabb::of_sphere(center, radius)) {
                    return fail("a box does not contain its primitives");
                }
            }
        }
        let (mut previous, mut new) = (None, 0);
        for index in row(INDEX_ROW) {
            if index < kind.first || index >= kind.end || previous.is_some_and(|p| p >= index) {
                return fail("the index of a primitive is out of range or order");
            }
            previous = Some(index);
            let (word, bit) = (index as usize / 64, 1 << (index % 64));
            let is_new = self.seen[word] & bit == 0;
            if !is_new && !kind.is_triangle {
                return fail("a sphere stands in two leaves");
            }
            new += usize::from(is_new);
            self.seen[word] |= bit;
        }
        (self.visit)(Record::Leaf(at, n));
        self.next += leaf_bytes(n);
        Ok(new)
    }
}
