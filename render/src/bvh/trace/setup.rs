//! What a ray brings to every box and triangle, the same in each kernel; and why no box hides a hit.
//!
//! # The ray that is traced
//!
//! A ray counts if its numbers are finite (`tmax` may be infinite), its origin is within [`MAX_COORDINATE`] = 2^40 on
//! every axis and the largest component of its direction is in 2^-30 ..= 2^30. Others hit nothing. A component of the
//! direction below 2^-50 of the largest counts as 0: over the length of any scene that moves the ray by far less than a
//! coordinate's rounding, and it keeps products from underflow and reciprocals from overflow: |1/d| <= 2^80, so
//! |o / d| <= 2^120.
//!
//! # Error bounds
//!
//! u = 2^-24 is the unit roundoff of f32, terms of order u^2 are left out (they are covered by the slack at the end),
//! S is the largest magnitude of a coordinate in the forest, M = max(|o|_inf, S), z the axis of the direction's largest
//! component, r_a = 1 / |d_a|; so r_z is the least of them.
//!
//! *Triangle* (see [`super::triangle`]; Woop, Benthin, Wald 2013). The test shears the vertices to where the ray is the z
//! axis: z' = fl(v_z - o_z), x' = fma(-s_x, z', fl(v_x - o_x)), s_x = fl(d_x * fl(1 / d_z)). With |s_x| <= 1 the error of
//! x' against the exact sheared vertex is at most
//!   2uM (v_x - o_x) + 4uM (s_x is off by 2u, |z| <= 2M) + 2uM (z') + 4uM (the last rounding, |x'| <= 4M) = 12 u M,
//! and so for y'. The edge functions of the *rounded* x', y' have the exact sign or are 0, so the test accepts only if
//! there are exact barycentrics a_i >= 0 with sum(a_i x'_i) = sum(a_i y'_i) = 0. Let P = sum(a_i v_i), a point of the
//! triangle, and T = (P_z - o_z) / d_z. Then
//!   (1)  |P_x - (o_x + T d_x)| <= 12 u M, likewise y, and z is exact.
//! The edge functions are computed with a relative error of 2u (Jeannerod, Louvet, Muller 2013: a difference of products
//! with fma), all of one sign; their sum, its reciprocal and the product with it add 2u + 2u + 1u + 1u:
//!   (2)  each computed barycentric is a_i (1 + e), |e| <= 8u.
//! t = fl(sum * s_z), where sum = fma(b_0, z'_0, fma(b_1, z'_1, b_2 z'_2)): each term is off by 8u (2) + 1u (z') + 3u (the
//! roundings of the sum), of at most 2M; s_z and the product by 2u:
//!   (3)  |t - T| <= (12 + 2) u 2M r_z = 28 u M r_z.
//!
//! *Box* (the slab test with padded constants; compare Ize, "Robust BVH Ray Traversal", 2013, and pbrt-v4 section 6.8).
//! A node's planes are the exact bounds of the vertices below, so P lies between them. For an axis with d_a not 0 the exact
//! parameters of the planes, N and F, enclose T up to (1): N <= T + 12uM r_a and F >= T - 12uM r_a. Computed is
//!   near = fma(plane, rd, -fl(fl(o rd) + pad)),  rd = fl(1 / d_a),
//! whose error against N - pad is at most u (2M for rd's error on plane - o, M for o rd, 1 for adding the pad, 2M for the
//! fma's rounding) r_a < 6 u M r_a + u pad. For near <= t it is therefore enough that
//!   pad >= (12 + 6) u M r_a + 28 u M r_z, that is, 46 u M r_a,
//! and far >= t follows the same way. The pad is 64 u M r_a = 2^-18 M |rd|, which leaves more than a third for what was
//! left out: the pad's own rounding and terms of order u^2. So near <= t <= far on every axis, tmin < t <= best so far: a
//! box is never culled while a hit below it would be accepted, *equal distances included*.
//! (With edge functions of plain products, as in the paper, (2) fails for slivers, t may be off by the triangle's extent,
//! and pruning against the best hit would make the answer depend on the tree.)
//!
//! For d_a = 0, rd = 2^50 r_z with the sign of d_a. P_a is within 12uM of o_a, so near <= (12 + 6 - 64) u M rd < 0 <= tmin,
//! and far >= (64 - 12 - 6) u M rd = 46 2^26 M r_z, more than any t, which is at most 2M r_z (1 + 28u).
//!
//! Spheres are tested in f64 ([`super::sphere`]); what (1) and (3) are for them is derived there, and is smaller.

use super::super::layout::MAX_COORDINATE;
use crate::ray::{Hit, MISS, Ray};
use crate::real::{Vec4, f32, real};

/// Smallest and largest magnitude of a direction's largest component: 2^-30 and 2^30.
pub(super) const DIRECTION_RANGE: (f32, f32) = (1.0 / (1 << 30) as f32, (1 << 30) as f32);
/// Components below this part of the largest count as 0: 2^-50.
pub(super) const NO_DIRECTION: f32 = 1.0 / (1u64 << 50) as f32;
/// Padding of the box test: 64 u.
pub(super) const PAD: f32 = 1.0 / (1 << 18) as f32;

/// State of one ray in flight. The first cache line serves the boxes, the second the triangles.
#[repr(C, align(64))]
#[derive(Clone, Copy)]
pub(super) struct State {
    /// 1 / direction.
    pub inverse: Vec4,
    /// origin / direction + pad.
    pub near: Vec4,
    /// origin / direction - pad.
    pub far: Vec4,
    /// Byte of each axis' near planes in a node; those of the far planes are this ^ 32.
    pub near_row: [u32; 3],
    /// Index of the top of the ray's stack.
    pub top: u32,

    /// Origin, the axes in the order of `axes`.
    pub origin: [f32; 4],
    /// d_x / d_z, d_y / d_z, 1 / d_z, the axes in the order of `axes`.
    pub shear: [f32; 4],
    /// The two other axes, in cyclic order, and the axis of the largest component.
    pub axes: [u32; 3],
    /// Hits at or before this are none.
    pub tmin: f32,
    /// Hits after this are none: the ray's limit, then its best hit.
    pub tmax: f32,
    /// Reference to what is visited next.
    pub current: u32,
    /// Number of the ray in its batch.
    pub ray: u32,
    /// Slot of the best hit, or [`MISS`].
    pub prim: u32,

    /// Barycentrics of the best hit.
    pub uv: [f32; 2],
    /// Leaf of the best hit.
    pub leaf: u32,
    /// Place of the best hit in its leaf.
    pub lane: u32,
}

impl State {
    /// A ray that hits nothing.
    pub const NOTHING: State = State {
        inverse: Vec4::ONE,
        near: Vec4::ZERO,
        far: Vec4::ZERO,
        near_row: [0, 64, 128],
        top: 0,
        origin: [0.0; 4],
        shear: [0.0, 0.0, 1.0, 0.0],
        axes: [0, 1, 2],
        tmin: 0.0,
        tmax: -1.0,
        current: 0,
        ray: 0,
        prim: MISS,
        uv: [0.0; 2],
        leaf: 0,
        lane: 0,
    };

    /// State at the start of a ray in a forest whose largest coordinate is `largest`.
    #[inline(always)]
    pub fn new(ray: &Ray, largest: f32) -> State {
        let mut state = State::NOTHING;
        state.start(ray, largest);
        state
    }

    /// What the ray hit so far.
    #[inline(always)]
    pub fn hit(&self, ray: &Ray) -> Hit {
        if self.prim == MISS {
            return Hit::miss(ray.tmax);
        }
        let [u, v] = self.uv;
        Hit { t: self.tmax, u, v, prim: self.prim, leaf: self.leaf, lane: self.lane }
    }

    /// Sets all but `top`, `current` and `ray` to the start of a ray.
    pub fn start(&mut self, ray: &Ray, largest: f32) {
        let o = Vec4::new(ray.o[0], ray.o[1], ray.o[2], 0.0);
        let d = Vec4::new(ray.d[0], ray.d[1], ray.d[2], 0.0);
        let (far, size) = (o.abs(), d.abs());
        let (reach, steepest) = (far.max_element(), size.max_element());
        // NaN makes every comparison false
        let is_sane = far.cmple(Vec4::splat(real(MAX_COORDINATE))).all()
            && size.cmple(Vec4::splat(DIRECTION_RANGE.1)).all()
            && steepest >= DIRECTION_RANGE.0
            && !(ray.tmin.is_nan() || ray.tmax.is_nan());
        if !is_sane {
            *self = State { top: self.top, current: self.current, ray: self.ray, ..State::NOTHING };
            return;
        }

        // a flat axis divides by the least component that is not flat, with the sign it has
        let least = Vec4::splat(steepest * NO_DIRECTION);
        let is_flat = size.cmplt(least);
        let inverse = Vec4::ONE / Vec4::select(is_flat, least.copysign(d), d);
        let d = Vec4::select(is_flat, Vec4::ZERO, d);
        let pad = inverse.abs() * (if reach > largest { reach } else { largest } * PAD);
        let center = o * inverse;
        let negative = inverse.is_negative_bitmask();
        self.inverse = inverse;
        self.near = center + pad;
        self.far = center - pad;
        self.near_row = std::array::from_fn(|a| a as u32 * 64 + (negative >> a & 1) * 32);

        // axis of the largest component, the last of equal ones
        let s = size.to_array();
        let kz = if s[0] > s[1] && s[0] > s[2] {
            0
        } else if s[1] > s[2] {
            1
        } else {
            2
        };
        let (kx, ky) = (NEXT[kz], NEXT[NEXT[kz]]);
        let (d, inverse_z) = (d.to_array(), inverse.to_array()[kz]);
        self.origin = [ray.o[kx], ray.o[ky], ray.o[kz], 0.0];
        self.shear = [d[kx] * inverse_z, d[ky] * inverse_z, inverse_z, 0.0];
        self.axes = [kx as u32, ky as u32, kz as u32];
        // also turns -0 into 0: distances are compared by their bits
        self.tmin = if ray.tmin > 0.0 { ray.tmin } else { 0.0 };
        self.tmax = ray.tmax;
        self.prim = MISS;
        self.uv = [0.0; 2];
        self.leaf = 0;
    }
}

/// The next axis in cyclic order.
const NEXT: [usize; 3] = [1, 2, 0];
