//! Arrays of a block, one number a vertex.

use std::ops::{Index, IndexMut};

use glam::Vec3;

use super::N;
use crate::math::unit;

/// `N` numbers. On lines of the cache of their own: vectors of 64 bytes that lie across two are read twice.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(super) struct Lanes(pub [f32; N]);

impl Index<usize> for Lanes {
    type Output = f32;

    #[inline(always)]
    fn index(&self, i: usize) -> &f32 {
        &self.0[i]
    }
}

impl IndexMut<usize> for Lanes {
    #[inline(always)]
    fn index_mut(&mut self, i: usize) -> &mut f32 {
        &mut self.0[i]
    }
}

/// `N` vectors, by component.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lanes3(pub [Lanes; 3]);

impl Lanes3 {
    pub(super) const ZERO: Lanes3 = Lanes3([Lanes([0.0; N]); 3]);

    #[inline(always)]
    pub(super) fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.0[0][i], self.0[1][i], self.0[2][i])
    }
    #[inline(always)]
    pub(super) fn set(&mut self, i: usize, v: Vec3) {
        self.0[0][i] = v.x;
        self.0[1][i] = v.y;
        self.0[2][i] = v.z;
    }
}

/// Sets the lanes where the mask's bits are 1.
#[inline(always)]
pub(super) fn set(lanes: &mut Lanes, x: f32, mask: &[u32; N]) {
    for i in 0..N {
        lanes[i] = f32::from_bits((x.to_bits() & mask[i]) | (lanes[i].to_bits() & !mask[i]));
    }
}

/// The same of vectors.
#[inline(always)]
pub(super) fn set3(lanes: &mut Lanes3, v: Vec3, mask: &[u32; N]) {
    set(&mut lanes.0[0], v.x, mask);
    set(&mut lanes.0[1], v.y, mask);
    set(&mut lanes.0[2], v.z, mask);
}

/// Numbers in [0, 1).
#[inline(always)]
pub(super) fn units(lanes: &mut Lanes, raw: &[u32; N]) {
    for i in 0..N {
        lanes[i] = unit(raw[i]);
    }
}
