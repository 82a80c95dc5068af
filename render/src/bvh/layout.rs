//! The arena's records: 8-wide nodes and leaves, as they lie in memory and in a geometry object.
//!
//! All values are little-endian; offsets are bytes from the arena's start.
//!
//! *Reference* (u32): bit 31 leaf, bits 28..31 number of primitives - 1 (leaves; 0 for nodes), bits 0..28 offset / 32.
//! 0 is no reference: nothing refers to the record at offset 0.
//!
//! *Node*, 224 bytes at a multiple of 64: six rows of eight f32 (x lo, x hi, y lo, y hi, z lo, z hi), then eight
//! references. An empty slot has reference 0 and the box +inf .. -inf, which no ray hits.
//!
//! *Leaf* of n <= 8 primitives of one kind, 40 n bytes at a multiple of 32: ten rows of exactly n values. Triangles: the
//! nine coordinates (v0.x, v0.y, v0.z, v1.x, ..) and the index. Spheres: centre (3), radius, flipped (u32, 0 or 1), four
//! rows of zeros, index. The index (u32) ascends within a leaf; it is the local index in a geometry object and the slot
//! in a forest.
//!
//! *Subtree*: its node, the leaves of that node in slot order (each rounded up to 32 bytes), padding with zeros to a
//! multiple of 64, then the subtrees of its inner children in slot order. So references go forward only, and every byte
//! belongs to one record.

use bytemuck::{Pod, Zeroable};

/// Bytes in a unit of a reference's offset.
pub(super) const UNIT: usize = 32;
/// Children of a node, and the largest number of primitives in a leaf.
pub(super) const WIDTH: usize = 8;
/// Bytes of a node's record.
pub(super) const NODE_BYTES: usize = 224;
/// What nodes are aligned to, bytes.
pub(super) const NODE_ALIGN: usize = 64;
/// Where a node's references begin, bytes.
pub(super) const NODE_REFS: usize = 192;
/// Bytes of a primitive in a leaf.
pub(super) const PRIMITIVE_BYTES: usize = 40;
/// Row of the index in a leaf.
pub(super) const INDEX_ROW: usize = 9;
/// Bit of a reference to a leaf.
pub(super) const LEAF: u32 = 1 << 31;
/// Bits of a reference that hold the offset.
pub(super) const OFFSET: u32 = (1 << 28) - 1;
/// Largest arena that references can address, bytes.
pub(super) const MAX_ARENA: u64 = (OFFSET as u64 + 1) * UNIT as u64;

/// Largest magnitude of a coordinate that a block may hold and of a ray's origin: 2^40.
///
/// Within it, nothing in the kernels overflows (see `trace::setup`).
pub const MAX_COORDINATE: f32 = (1u64 << 40) as f32;

/// Offset in bytes of what a reference points to.
pub(super) const fn offset(reference: u32) -> usize {
    (reference & OFFSET) as usize * UNIT
}
/// Number of primitives in the leaf that a reference points to.
pub(super) const fn leaf_len(reference: u32) -> usize {
    (reference >> 28 & 7) as usize + 1
}
/// Bytes that a leaf of n primitives takes.
pub(super) const fn leaf_bytes(n: usize) -> usize {
    (n * PRIMITIVE_BYTES).next_multiple_of(UNIT)
}
/// Reference to the node at an offset in bytes.
pub(super) const fn node_ref(at: usize) -> u32 {
    (at / UNIT) as u32
}
/// Reference to the leaf of n primitives at an offset in bytes.
pub(super) const fn leaf_ref(at: usize, n: usize) -> u32 {
    LEAF | (n as u32 - 1) << 28 | (at / UNIT) as u32
}

/// Reads the u32 at byte `at`.
#[inline(always)]
pub(super) fn read_u32(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}
/// Reads the f32 at byte `at`.
#[inline(always)]
pub(super) fn read_f32(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(read_u32(bytes, at))
}
/// Reads the u64 at byte `at`.
pub(super) fn read_u64(bytes: &[u8], at: usize) -> u64 {
    u64::from(read_u32(bytes, at)) | u64::from(read_u32(bytes, at + 4)) << 32
}
/// Writes the u32 at byte `at`.
pub(super) fn write_u32(bytes: &mut [u8], at: usize, value: u32) {
    bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
}
/// Writes the f32 at byte `at`.
pub(super) fn write_f32(bytes: &mut [u8], at: usize, value: f32) {
    write_u32(bytes, at, value.to_bits());
}

/// An axis-parallel box.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(super) struct Aabb {
    /// Lower corner.
    pub lo: [f32; 3],
    /// Upper corner.
    pub hi: [f32; 3],
}

impl Aabb {
    /// The box of nothing.
    pub const EMPTY: Aabb = Aabb { lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3] };

    /// Box of a triangle.
    #[inline(always)]
    pub fn of_triangle(t: &[[f32; 3]; 3]) -> Aabb {
        t.iter().fold(Aabb::EMPTY, |b, &p| b.union(&Aabb { lo: p, hi: p }))
    }
    /// Box of a sphere, rounded outwards: a neighbouring float is further out than the rounded sum's error.
    pub fn of_sphere(center: [f32; 3], radius: f32) -> Aabb {
        Aabb { lo: center.map(|c| (c - radius).next_down()), hi: center.map(|c| (c + radius).next_up()) }
    }
    /// Smallest box around both.
    #[inline(always)]
    pub fn union(&self, other: &Aabb) -> Aabb {
        Aabb {
            lo: std::array::from_fn(|c| if other.lo[c] < self.lo[c] { other.lo[c] } else { self.lo[c] }),
            hi: std::array::from_fn(|c| if other.hi[c] > self.hi[c] { other.hi[c] } else { self.hi[c] }),
        }
    }
    /// Half the surface area.
    pub fn half_area(&self) -> f32 {
        let d: [f32; 3] = std::array::from_fn(|c| self.hi[c] - self.lo[c]);
        d[0] * d[1] + d[1] * d[2] + d[2] * d[0]
    }
    /// Whether the other box lies inside.
    pub fn contains(&self, other: &Aabb) -> bool {
        (0..3).all(|c| self.lo[c] <= other.lo[c] && other.hi[c] <= self.hi[c])
    }
    /// Largest magnitude of a coordinate; 0 for the box of nothing.
    pub fn largest(&self) -> f32 {
        if self.lo[0] > self.hi[0] { 0.0 } else { self.lo.iter().chain(&self.hi).fold(0.0, |m, x| x.abs().max(m)) }
    }
    /// Whether it is not inverted and its coordinates are finite and at most [`MAX_COORDINATE`] in magnitude.
    pub fn is_sound(&self) -> bool {
        (0..3).all(|c| -MAX_COORDINATE <= self.lo[c] && self.lo[c] <= self.hi[c] && self.hi[c] <= MAX_COORDINATE)
    }
}

/// Index of the i-th primitive of the leaf that a reference points to.
#[inline(always)]
pub(super) fn read_index(bytes: &[u8], leaf: u32, i: usize) -> u32 {
    read_u32(bytes, offset(leaf) + (INDEX_ROW * leaf_len(leaf) + i) * 4)
}
/// Box and reference of a node's slot.
pub(super) fn read_slot(bytes: &[u8], node: usize, slot: usize) -> (Aabb, u32) {
    let row = |r: usize| read_f32(bytes, node + r * 32 + slot * 4);
    (Aabb { lo: [row(0), row(2), row(4)], hi: [row(1), row(3), row(5)] }, read_u32(bytes, node + NODE_REFS + slot * 4))
}
/// Writes a node's slot.
pub(super) fn write_slot(bytes: &mut [u8], node: usize, slot: usize, aabb: &Aabb, reference: u32) {
    for c in 0..3 {
        write_f32(bytes, node + c * 64 + slot * 4, aabb.lo[c]);
        write_f32(bytes, node + c * 64 + 32 + slot * 4, aabb.hi[c]);
    }
    write_u32(bytes, node + NODE_REFS + slot * 4, reference);
}
