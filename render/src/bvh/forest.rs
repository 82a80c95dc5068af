//! The splits that are resident in one task, in one arena under one top tree.

use super::arena::Arena;
use super::block::{HEADER, Sphere, read_sphere, sizes};
use super::check::{BlockError, Record, Tree, check};
#[cfg(all(target_arch = "x86_64", not(feature = "double")))]
use super::few::Few;
use super::ids::Ids;
use super::layout::*;
use super::regions::Regions;
use super::top::Top;
use super::trace::read_triangle;
use crate::ray::{Hit, MISS, PrimId};
use crate::real::real;
use crate::world::Primitive;

/// Blocks in memory, ready to be traced.
///
/// After blocks were inserted or removed, [`Forest::finish`] makes them traceable. Slots (and hits) are valid until
/// the block they belong to is removed.
pub struct Forest {
    arena: Arena,
    /// Free bytes of the arena.
    room: Regions,
    /// Free slots.
    slots: Regions,
    /// By ascending first slot.
    blocks: Vec<Block>,
    /// Number of the next block: never used twice, so that a handle names one block for ever.
    next: u64,
    /// Tree over the triangles, and over the spheres; `None` before `finish`.
    roots: Option<[Tree; 2]>,
    /// What is there as lists, when it is little; `None` before `finish`.
    #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
    few: Option<Few>,
    /// Parts of the arena that the top trees take.
    tops: Vec<(u64, u64)>,
    largest: f32,
    used: u64,
}

/// Names a block of one forest, also after it was removed: no later block gets the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct BlockHandle(u64);

/// Why a forest cannot do something.
#[derive(Debug, thiserror::Error)]
pub enum ForestError {
    /// References reach no further.
    #[error(
        "a forest holds at most {} bytes of blocks, {capacity} were asked for: use more tasks, or smaller ones",
        MAX_ARENA
    )]
    Capacity {
        /// What was asked for.
        capacity: u64,
    },
    /// The system has no addresses for it.
    #[error("cannot reserve {capacity} bytes of memory: {source}")]
    Memory {
        /// What was asked for.
        capacity: u64,
        /// What the system said.
        source: std::io::Error,
    },
    /// The block is wrong.
    #[error(transparent)]
    Block(#[from] BlockError),
    /// Slots are numbers of 32 bits.
    #[error("no room for {primitives} more primitives: a forest has 2^32 - 1 slots")]
    Slots {
        /// Of the block.
        primitives: u32,
    },
    /// Remove blocks first, or make a larger forest.
    #[error("no room for {bytes} bytes: {free} are free, {largest} of them in one piece")]
    Full {
        /// What is needed.
        bytes: u64,
        /// What is free.
        free: u64,
        /// Largest free part.
        largest: u64,
    },
}

/// A resident block.
struct Block {
    number: u64,
    /// Its bytes in the arena.
    at: u64,
    bytes: u64,
    first_slot: u32,
    triangles: u32,
    spheres: u32,
    triangle_tree: Option<Tree>,
    sphere_tree: Option<Tree>,
    ids: Ids,
}

impl Block {
    fn primitives(&self) -> u32 {
        self.triangles + self.spheres
    }
    fn bounds(&self) -> Aabb {
        [self.triangle_tree, self.sphere_tree].iter().flatten().fold(Aabb::EMPTY, |b, t| b.union(&t.aabb))
    }
}

/// Bytes before the first block: a node without children, where rays go that have nothing to hit.
const EMPTY_NODE_BYTES: u64 = 256;
/// Readable bytes after the last record: leaves are read eight lanes at a time.
const TAIL: u64 = 512;
const EMPTY_TREE: Tree = Tree { root: 0, aabb: Aabb::EMPTY, stack: 0 };

impl Forest {
    /// An empty forest with room for geometry of `capacity` bytes, top tree included. Memory is taken as it fills.
    ///
    /// # Errors
    /// When `capacity` is above 8 GiB or the system refuses.
    pub fn new(capacity: u64) -> Result<Forest, ForestError> {
        if capacity > MAX_ARENA {
            return Err(ForestError::Capacity { capacity });
        }
        let end = (EMPTY_NODE_BYTES + capacity.next_multiple_of(NODE_ALIGN as u64)).min(MAX_ARENA);
        let memory = |source| ForestError::Memory { capacity, source };
        let len = usize::try_from(end + TAIL).map_err(|e| memory(std::io::Error::other(e)))?;
        let mut arena = Arena::reserve(len).map_err(memory)?;
        for slot in 0..WIDTH {
            write_slot(arena.bytes_mut(), 0, slot, &Aabb::EMPTY, 0);
        }
        Ok(Forest {
            arena,
            room: Regions::new(EMPTY_NODE_BYTES, end),
            slots: Regions::new(0, u64::from(MISS)),
            blocks: Vec::new(),
            next: 0,
            roots: Some([EMPTY_TREE; 2]),
            #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
            few: None,
            tops: Vec::new(),
            largest: 0.0,
            used: 0,
        })
    }

    /// Takes in a geometry object, checking all of it.
    ///
    /// # Errors
    /// When it is wrong or there is no room; the forest is as before, but for [`Forest::finish`].
    pub fn insert(&mut self, geometry: &[u8]) -> Result<BlockHandle, ForestError> {
        self.unfinish();
        // an object that is cut or lies about its counts is found out by the check
        let (bytes, primitives) = sizes(geometry);
        let full = |free: (u64, u64)| ForestError::Full { bytes, free: free.0, largest: free.1 };
        let slots = u64::from(primitives.max(1));
        let at = self.room.take(bytes).ok_or_else(|| full(self.room.free()))?;
        let Some(first_slot) = self.slots.take(slots) else {
            self.give(at, bytes);
            return Err(ForestError::Slots { primitives });
        };
        match self.copy(geometry, at, first_slot as u32) {
            Ok(block) => {
                let i = self.blocks.partition_point(|b| b.first_slot < block.first_slot);
                self.used += block.bytes + block.ids.memory() as u64;
                let handle = BlockHandle(block.number);
                self.blocks.insert(i, block);
                self.next += 1;
                Ok(handle)
            }
            Err(e) => {
                self.give(at, bytes);
                self.slots.give(first_slot, slots);
                Err(e.into())
            }
        }
    }

    /// Removes a block and gives its memory back to the system; whether it was there.
    pub fn remove(&mut self, handle: BlockHandle) -> bool {
        let Some(i) = self.blocks.iter().position(|b| b.number == handle.0) else { return false };
        self.unfinish();
        let block = self.blocks.remove(i);
        self.used -= block.bytes + block.ids.memory() as u64;
        self.slots.give(u64::from(block.first_slot), u64::from(block.primitives().max(1)));
        self.give(block.at, block.bytes);
        true
    }

    /// Builds the top tree over the blocks that are there. Does nothing when nothing changed.
    ///
    /// # Errors
    /// When there is no room for it: it takes some 20 KiB a block.
    pub fn finish(&mut self) -> Result<(), ForestError> {
        if self.roots.is_some() {
            return Ok(());
        }
        let triangles = self.top(|b| b.triangle_tree)?;
        let spheres = self.top(|b| b.sphere_tree)?;
        self.largest = triangles.aabb.largest().max(spheres.aabb.largest());
        self.roots = Some([triangles, spheres]);
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        {
            self.few = Few::of(self, self.root(), self.sphere_root());
        }
        Ok(())
    }

    /// Whether the forest can be traced.
    pub fn is_finished(&self) -> bool {
        self.roots.is_some()
    }

    /// Blocks that are there, in no particular order.
    pub fn handles(&self) -> impl ExactSizeIterator<Item = BlockHandle> + '_ {
        self.blocks.iter().map(|b| BlockHandle(b.number))
    }
    /// Number of primitives of all blocks.
    pub fn primitives(&self) -> u64 {
        self.blocks.iter().map(|b| u64::from(b.primitives())).sum()
    }
    /// Bytes that blocks and top trees take.
    pub fn bytes_used(&self) -> u64 {
        self.used
    }
    /// Bytes in the arena that are free.
    pub fn bytes_free(&self) -> u64 {
        self.room.free().0
    }
    /// Lower and upper corner around all blocks; `None` when there is nothing.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let all = self.blocks.iter().fold(Aabb::EMPTY, |b, block| b.union(&block.bounds()));
        (all.lo[0] <= all.hi[0]).then_some((all.lo, all.hi))
    }
    /// Slots of a block's primitives; `None` when it is not there.
    pub fn slots(&self, handle: BlockHandle) -> Option<std::ops::Range<u32>> {
        let block = self.blocks.iter().find(|b| b.number == handle.0)?;
        Some(block.first_slot..block.first_slot + block.primitives())
    }

    /// Block and local index of a slot.
    ///
    /// # Panics
    /// When the slot is of no block that is there.
    pub fn slot(&self, slot: u32) -> (BlockHandle, u32) {
        let block = self.block_of(slot);
        (BlockHandle(block.number), slot - block.first_slot)
    }
    /// Global id of the primitive in a slot.
    ///
    /// # Panics
    /// When the slot is of no block that is there.
    pub fn prim_id(&self, slot: u32) -> PrimId {
        let block = self.block_of(slot);
        block.ids.get(slot - block.first_slot)
    }
    /// The primitive that was hit.
    ///
    /// # Panics
    /// When the hit is none of this forest as it is.
    #[inline(always)]
    pub fn primitive(&self, hit: &Hit) -> Primitive {
        let (at, n, i) = (offset(hit.leaf), leaf_len(hit.leaf), hit.lane as usize);
        let leaf = &self.arena.bytes()[at..at + n * PRIMITIVE_BYTES];
        assert!(i < n && read_u32(leaf, (INDEX_ROW * n + i) * 4) == hit.prim, "a hit of another forest");
        if self.sphere_root().is_some() && !self.is_triangle(hit.prim) {
            let Sphere { center, radius, flipped } = read_sphere(leaf, 0, n, i);
            let [x, y, z] = center;
            return Primitive::Sphere { center: [real(x), real(y), real(z)], radius: real(radius), flipped };
        }
        Primitive::Triangle(read_triangle(leaf, 0, n, i))
    }
    fn is_triangle(&self, slot: u32) -> bool {
        let block = self.block_of(slot);
        slot - block.first_slot < block.triangles
    }

    /// Whether the primitive in slot `a` goes before the one in `b` at the same distance: by global id, and copies of one
    /// primitive by slot.
    #[cold]
    pub(super) fn precedes(&self, a: u32, b: u32) -> bool {
        (self.prim_id(a), a) < (self.prim_id(b), b)
    }
    /// The arena, 512 bytes longer than its records.
    pub(super) fn arena(&self) -> &[u8] {
        self.arena.bytes()
    }
    /// Bytes of the arena that blocks and top trees take.
    pub(super) fn arena_in_use(&self) -> u64 {
        self.blocks.iter().map(|b| b.bytes).chain(self.tops.iter().map(|t| t.1)).sum()
    }
    /// The triangles' root, always a node.
    pub(super) fn root(&self) -> u32 {
        node_ref(self.tree(0).root)
    }
    /// The primitives as lists, if they are few.
    #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
    pub(super) fn few(&self) -> Option<&Few> {
        self.few.as_ref()
    }
    /// Stack entries that a traversal of the triangles can hold.
    pub(super) fn stack(&self) -> usize {
        self.tree(0).stack
    }
    /// Largest magnitude of a coordinate.
    pub(super) fn largest(&self) -> f32 {
        self.largest
    }
    /// The spheres' root, a node, if there are any.
    #[inline(always)]
    pub(super) fn sphere_root(&self) -> Option<u32> {
        Some(node_ref(self.tree(1).root)).filter(|&root| root != node_ref(EMPTY_TREE.root))
    }

    #[inline(always)]
    fn tree(&self, i: usize) -> Tree {
        self.roots.expect("a forest is traced after finish()")[i]
    }
    fn block_of(&self, slot: u32) -> &Block {
        let i = self.blocks.partition_point(|b| b.first_slot <= slot);
        let block = i.checked_sub(1).map(|i| &self.blocks[i]).filter(|b| slot - b.first_slot < b.primitives());
        block.expect("a slot of no block that is resident")
    }

    /// Copies a geometry object's arena to `at`, checking it, moving its references and numbering its primitives.
    fn copy(&mut self, geometry: &[u8], at: u64, first_slot: u32) -> Result<Block, BlockError> {
        let base = at as usize;
        let out = &mut self.arena.bytes_mut()[base..];
        let source = geometry.get(HEADER..).unwrap_or(&[]);
        let checked = check(geometry, &mut |record| match record {
            Record::Node(n) => {
                out[n..n + NODE_BYTES].copy_from_slice(&source[n..n + NODE_BYTES]);
                for slot in 0..WIDTH {
                    let place = n + NODE_REFS + slot * 4;
                    let reference = read_u32(source, place);
                    if reference != 0 {
                        // the sum of offsets is below 2^28, as the room is below MAX_ARENA, so leaf bits stay as they are;
                        // wrapping, since a reference is checked only when the pass comes to what it leads to
                        write_u32(out, place, reference.wrapping_add(node_ref(base)));
                    }
                }
            }
            Record::Leaf(l, n) => {
                out[l..l + leaf_bytes(n)].copy_from_slice(&source[l..l + leaf_bytes(n)]);
                for i in 0..n {
                    let place = l + (INDEX_ROW * n + i) * 4;
                    write_u32(out, place, read_u32(source, place) + first_slot);
                }
            }
        })?;
        let moved = |tree: Tree| Tree { root: tree.root + base, ..tree };
        Ok(Block {
            number: self.next,
            at,
            bytes: (checked.arena.len() as u64).max(NODE_ALIGN as u64),
            first_slot,
            triangles: checked.triangles,
            spheres: checked.spheres,
            triangle_tree: checked.triangle_tree.map(moved),
            sphere_tree: checked.sphere_tree.map(moved),
            ids: checked.ids,
        })
    }

    /// Makes the tree over one kind of the blocks' trees.
    fn top(&mut self, tree_of: impl Fn(&Block) -> Option<Tree>) -> Result<Tree, ForestError> {
        let trees: Vec<Tree> = self.blocks.iter().filter_map(tree_of).collect();
        match trees[..] {
            [] => return Ok(EMPTY_TREE),
            [only] => return Ok(only),
            _ => {}
        }
        let top = Top::open(self.arena.bytes(), &trees);
        let mut needed = 0;
        let (room, arena, tops) = (&mut self.room, &mut self.arena, &mut self.tops);
        let tree = top.build(|bytes| {
            needed = bytes as u64;
            let at = room.take(needed)?;
            tops.push((at, needed));
            Some((&mut arena.bytes_mut()[at as usize..][..bytes], at as usize))
        });
        match tree {
            Some(tree) => {
                self.used += needed;
                Ok(tree)
            }
            None => {
                let (free, largest) = self.room.free();
                Err(ForestError::Full { bytes: needed, free, largest })
            }
        }
    }

    /// Drops the top trees.
    fn unfinish(&mut self) {
        self.roots = None;
        #[cfg(all(target_arch = "x86_64", not(feature = "double")))]
        {
            self.few = None;
        }
        for (at, bytes) in std::mem::take(&mut self.tops) {
            self.used -= bytes;
            self.give(at, bytes);
        }
    }

    /// Frees a part of the arena.
    fn give(&mut self, at: u64, bytes: u64) {
        if bytes > 0 {
            self.arena.discard(at as usize, bytes as usize);
            self.room.give(at, bytes);
        }
    }
}
