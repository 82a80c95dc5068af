//! Usable records in recentred f32, as arrays: what waits in the spool and what a split is made of.

use std::collections::BTreeMap;

use bytemuck::{Pod, Zeroable};
use rayherd_render::bvh::Sphere;
use rayherd_render::ray::PrimId;

/// Some primitives by ascending id within each kind.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Records {
    pub triangle_ids: Vec<PrimId>,
    pub triangles: Vec<[[f32; 3]; 3]>,
    pub extras: Vec<Extra>,
    /// Of the triangles that have normals, in their order.
    pub normals: Vec<[[f32; 3]; 3]>,
    /// Of the triangles that have texture coordinates, in their order.
    pub uvs: Vec<[[f32; 2]; 3]>,
    /// Of the triangles whose mesh has an attribute, in their order.
    pub attributes: Vec<[[f32; 3]; 3]>,
    pub sphere_ids: Vec<PrimId>,
    pub spheres: Vec<SphereBits>,
}

/// What a triangle has beside its vertices.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct Extra {
    pub shape: u32,
    /// [`NORMALS`], [`UVS`] and [`ATTRIBUTES`].
    pub has: u32,
}

pub(crate) const NORMALS: u32 = 1;
pub(crate) const UVS: u32 = 2;
pub(crate) const ATTRIBUTES: u32 = 4;

/// A sphere in plain bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct SphereBits {
    pub center: [f32; 3],
    pub radius: f32,
    pub shape: u32,
    /// 0 or 1.
    pub flipped: u32,
}

impl SphereBits {
    pub(crate) fn sphere(&self) -> Sphere {
        Sphere { center: self.center, radius: self.radius, flipped: self.flipped != 0 }
    }
}

/// Where in some [`Records`] a range begins.
#[derive(Clone, Copy, Debug, Default)]
struct At {
    triangle: usize,
    normals: usize,
    uvs: usize,
    attributes: usize,
    sphere: usize,
}

impl At {
    /// Passes a triangle.
    fn pass(&mut self, extra: Extra) {
        self.triangle += 1;
        self.normals += usize::from(extra.has & NORMALS != 0);
        self.uvs += usize::from(extra.has & UVS != 0);
        self.attributes += usize::from(extra.has & ATTRIBUTES != 0);
    }
}

impl Records {
    pub(crate) fn len(&self) -> usize {
        self.triangle_ids.len() + self.sphere_ids.len()
    }

    /// Bytes that it takes in the spool.
    pub(crate) fn bytes(&self) -> u64 {
        (Self::COUNTS * 8
            + self.triangles.len() * (8 + 36 + 8)
            + self.normals.len() * 36
            + self.uvs.len() * 24
            + self.attributes.len() * 36
            + self.spheres.len() * (8 + 24)) as u64
    }

    /// Least and largest id, if there is any.
    pub(crate) fn id_range(&self) -> Option<(PrimId, PrimId)> {
        let first = self.triangle_ids.first().into_iter().chain(self.sphere_ids.first()).min()?;
        let last = self.triangle_ids.last().into_iter().chain(self.sphere_ids.last()).max()?;
        Some((*first, *last))
    }

    /// Appends the triangle at a place of `from`.
    fn push_triangle(&mut self, from: &Records, at: At) {
        let (i, has) = (at.triangle, from.extras[at.triangle].has);
        self.triangle_ids.push(from.triangle_ids[i]);
        self.triangles.push(from.triangles[i]);
        self.extras.push(from.extras[i]);
        if has & NORMALS != 0 {
            self.normals.push(from.normals[at.normals]);
        }
        if has & UVS != 0 {
            self.uvs.push(from.uvs[at.uvs]);
        }
        if has & ATTRIBUTES != 0 {
            self.attributes.push(from.attributes[at.attributes]);
        }
    }

    fn push_sphere(&mut self, from: &Records, i: usize) {
        self.sphere_ids.push(from.sphere_ids[i]);
        self.spheres.push(from.spheres[i]);
    }

    /// Appends everything of `other`, whose ids are all larger.
    pub(crate) fn append(&mut self, other: &Records) {
        self.triangle_ids.extend_from_slice(&other.triangle_ids);
        self.triangles.extend_from_slice(&other.triangles);
        self.extras.extend_from_slice(&other.extras);
        self.normals.extend_from_slice(&other.normals);
        self.uvs.extend_from_slice(&other.uvs);
        self.attributes.extend_from_slice(&other.attributes);
        self.sphere_ids.extend_from_slice(&other.sphere_ids);
        self.spheres.extend_from_slice(&other.spheres);
    }

    /// Appends the primitives `skip..skip + take` of `other`, counted in the order of ids.
    pub(crate) fn append_range(&mut self, other: &Records, skip: usize, take: usize) {
        if skip == 0 && take >= other.len() {
            return self.append(other);
        }
        let begin = other.position(At::default(), skip);
        let end = other.position(begin, take);
        let t = begin.triangle..end.triangle;
        self.triangle_ids.extend_from_slice(&other.triangle_ids[t.clone()]);
        self.triangles.extend_from_slice(&other.triangles[t.clone()]);
        self.extras.extend_from_slice(&other.extras[t]);
        self.normals.extend_from_slice(&other.normals[begin.normals..end.normals]);
        self.uvs.extend_from_slice(&other.uvs[begin.uvs..end.uvs]);
        self.attributes.extend_from_slice(&other.attributes[begin.attributes..end.attributes]);
        self.sphere_ids.extend_from_slice(&other.sphere_ids[begin.sphere..end.sphere]);
        self.spheres.extend_from_slice(&other.spheres[begin.sphere..end.sphere]);
    }

    /// The place `count` primitives after `at`.
    fn position(&self, at: At, count: usize) -> At {
        let mut at = at;
        for _ in 0..count {
            let triangle = self.triangle_ids.get(at.triangle);
            match (triangle, self.sphere_ids.get(at.sphere)) {
                (None, None) => break,
                (Some(t), s) if s.is_none_or(|s| t < s) => at.pass(self.extras[at.triangle]),
                _ => at.sphere += 1,
            }
        }
        at
    }

    /// Copies primitives out: `triangles` and `spheres` are (number, target) pairs by ascending number, each once.
    pub(crate) fn deal(&self, triangles: &[(u32, u32)], spheres: &[(u32, u32)]) -> BTreeMap<u32, Records> {
        let mut out: BTreeMap<u32, Records> = BTreeMap::new();
        let mut at = At::default();
        for &(i, target) in triangles {
            while at.triangle < i as usize {
                at.pass(self.extras[at.triangle]);
            }
            out.entry(target).or_default().push_triangle(self, at);
        }
        for &(i, target) in spheres {
            out.entry(target).or_default().push_sphere(self, i as usize);
        }
        out
    }

    /// Both together, by ascending id, those in both once.
    pub(crate) fn union(&self, other: &Records) -> Records {
        let mut out = Records::default();
        let (mut a, mut b) = (At::default(), At::default());
        loop {
            match (self.triangle_ids.get(a.triangle), other.triangle_ids.get(b.triangle)) {
                (None, None) => break,
                (x, Some(y)) if x.is_none_or(|x| y < x) => {
                    out.push_triangle(other, b);
                    b.pass(other.extras[b.triangle]);
                }
                (x, y) => {
                    out.push_triangle(self, a);
                    a.pass(self.extras[a.triangle]);
                    if x == y {
                        b.pass(other.extras[b.triangle]);
                    }
                }
            }
        }
        loop {
            match (self.sphere_ids.get(a.sphere), other.sphere_ids.get(b.sphere)) {
                (None, None) => break,
                (x, Some(y)) if x.is_none_or(|x| y < x) => {
                    out.push_sphere(other, b.sphere);
                    b.sphere += 1;
                }
                (x, y) => {
                    out.push_sphere(self, a.sphere);
                    a.sphere += 1;
                    b.sphere += usize::from(x == y);
                }
            }
        }
        out
    }

    /// Number of primitives in the union.
    pub(crate) fn union_len(&self, other: &Records) -> usize {
        let shared = |x: &[PrimId], y: &[PrimId]| {
            let (mut i, mut j, mut both) = (0, 0, 0);
            while i < x.len() && j < y.len() {
                both += usize::from(x[i] == y[j]);
                let (left, right) = (x[i] <= y[j], y[j] <= x[i]);
                i += usize::from(left);
                j += usize::from(right);
            }
            both
        };
        self.len() + other.len()
            - shared(&self.triangle_ids, &other.triangle_ids)
            - shared(&self.sphere_ids, &other.sphere_ids)
    }

    const COUNTS: usize = 5;

    /// The arrays, one after the other, in this machine's byte order (a spool does not outlive its process).
    pub(crate) fn write(&self, out: &mut Vec<u8>) {
        let [t, n, uv] = [self.triangles.len(), self.normals.len(), self.uvs.len()];
        for count in [t, n, uv, self.attributes.len(), self.spheres.len()] {
            out.extend_from_slice(&(count as u64).to_ne_bytes());
        }
        out.extend_from_slice(bytemuck::cast_slice(&self.triangle_ids));
        out.extend_from_slice(bytemuck::cast_slice(&self.triangles));
        out.extend_from_slice(bytemuck::cast_slice(&self.extras));
        out.extend_from_slice(bytemuck::cast_slice(&self.normals));
        out.extend_from_slice(bytemuck::cast_slice(&self.uvs));
        out.extend_from_slice(bytemuck::cast_slice(&self.attributes));
        out.extend_from_slice(bytemuck::cast_slice(&self.sphere_ids));
        out.extend_from_slice(bytemuck::cast_slice(&self.spheres));
    }

    /// What a block is built of: ids and shapes of the primitives, without what is only shading. Bytes as in [`Records::write`].
    pub(crate) fn pack(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(packed_bytes(self.triangles.len() as u64, self.spheres.len() as u64) as usize);
        for count in [self.triangles.len(), self.spheres.len()] {
            out.extend_from_slice(&(count as u64).to_ne_bytes());
        }
        out.extend_from_slice(bytemuck::cast_slice(&self.triangle_ids));
        out.extend_from_slice(bytemuck::cast_slice(&self.triangles));
        out.extend_from_slice(bytemuck::cast_slice(&self.sphere_ids));
        out.extend_from_slice(bytemuck::cast_slice(&self.spheres));
        out
    }

    /// What [`Records::pack`] packed, on a machine of the same byte order; `None` when the bytes are something else.
    pub(crate) fn unpack(bytes: &[u8]) -> Option<Records> {
        let (triangles, rest) = bytes.split_first_chunk::<8>()?;
        let (spheres, mut rest) = rest.split_first_chunk::<8>()?;
        let triangles = usize::try_from(u64::from_ne_bytes(*triangles)).ok()?;
        let spheres = usize::try_from(u64::from_ne_bytes(*spheres)).ok()?;
        let records = Records {
            triangle_ids: take(&mut rest, triangles)?,
            triangles: take(&mut rest, triangles)?,
            sphere_ids: take(&mut rest, spheres)?,
            spheres: take(&mut rest, spheres)?,
            ..Records::default()
        };
        rest.is_empty().then_some(records)
    }

    /// What [`Records::write`] wrote; `None` when the bytes are something else.
    pub(crate) fn read(bytes: &[u8]) -> Option<Records> {
        let mut rest = bytes;
        let mut counts = [0usize; Self::COUNTS];
        for count in &mut counts {
            let (head, tail) = rest.split_first_chunk::<8>()?;
            *count = usize::try_from(u64::from_ne_bytes(*head)).ok()?;
            rest = tail;
        }
        let [triangles, normals, uvs, attributes, spheres] = counts;
        let records = Records {
            triangle_ids: take(&mut rest, triangles)?,
            triangles: take(&mut rest, triangles)?,
            extras: take(&mut rest, triangles)?,
            normals: take(&mut rest, normals)?,
            uvs: take(&mut rest, uvs)?,
            attributes: take(&mut rest, attributes)?,
            sphere_ids: take(&mut rest, spheres)?,
            spheres: take(&mut rest, spheres)?,
        };
        rest.is_empty().then_some(records)
    }
}

/// Bytes of so many primitives, packed.
pub(crate) fn packed_bytes(triangles: u64, spheres: u64) -> u64 {
    16 + triangles * (8 + 36) + spheres * (8 + 24)
}

fn take<T: Pod>(rest: &mut &[u8], count: usize) -> Option<Vec<T>> {
    let bytes = count.checked_mul(size_of::<T>())?;
    let (head, tail) = rest.split_at_checked(bytes)?;
    *rest = tail;
    Some(bytemuck::allocation::pod_collect_to_vec(head))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Records with these ids; what a primitive has follows from its id.
    fn records(ids: impl IntoIterator<Item = PrimId>) -> Records {
        let mut out = Records::default();
        for id in ids {
            let x = id as f32;
            if id % 5 == 4 {
                out.sphere_ids.push(id);
                out.spheres.push(SphereBits { center: [x; 3], radius: 1.0, shape: id as u32, flipped: 0 });
                continue;
            }
            out.triangle_ids.push(id);
            out.triangles.push([[x; 3]; 3]);
            out.extras.push(Extra { shape: id as u32, has: (id % 8) as u32 });
            if id & 1 != 0 {
                out.normals.push([[x; 3]; 3]);
            }
            if id & 2 != 0 {
                out.uvs.push([[x; 2]; 3]);
            }
            if id & 4 != 0 {
                out.attributes.push([[x; 3]; 3]);
            }
        }
        out
    }

    fn ids() -> impl Strategy<Value = std::collections::BTreeSet<PrimId>> {
        prop::collection::btree_set(0u64..60, 0..40)
    }

    proptest! {
        #[test]
        fn union_range_deal_and_bytes(a in ids(), b in ids(), skip in 0usize..50, take in 0usize..50) {
            let (x, y) = (records(a.clone()), records(b.clone()));
            let both = x.union(&y);
            prop_assert_eq!(&both, &records(a.union(&b).copied()));
            prop_assert_eq!(both.len(), x.union_len(&y));
            let mut range = Records::default();
            range.append_range(&x, skip, take);
            prop_assert_eq!(range, records(a.iter().copied().skip(skip).take(take)));
            let mut bytes = Vec::new();
            x.write(&mut bytes);
            prop_assert_eq!(bytes.len() as u64, x.bytes());
            prop_assert_eq!(Records::read(&bytes), Some(x.clone()));
            prop_assert_eq!(Records::read(&bytes[..bytes.len() - 1]), None);
            let packed = x.pack();
            prop_assert_eq!(packed.len() as u64, packed_bytes(x.triangles.len() as u64, x.spheres.len() as u64));
            let bare = Records { extras: vec![], normals: vec![], uvs: vec![], attributes: vec![], ..x.clone() };
            prop_assert_eq!(Records::unpack(&packed), Some(bare));
            prop_assert_eq!(Records::unpack(&packed[..packed.len() - 1]), None);
            prop_assert_eq!(x.id_range(), a.first().copied().zip(a.last().copied()));
            // triangles with even ids to 0, all to 1; spheres to 1
            let pairs: Vec<(u32, u32)> = (0u32..).zip(&x.triangle_ids)
                .flat_map(|(i, id)| (0..=1).filter(move |t| *t == 1 || id % 2 == 0).map(move |t| (i, t))).collect();
            let spheres: Vec<(u32, u32)> = (0..x.spheres.len() as u32).map(|i| (i, 1)).collect();
            let mut dealt = x.deal(&pairs, &spheres);
            let even = dealt.remove(&0).unwrap_or_default();
            prop_assert_eq!(even, records(a.iter().copied().filter(|id| id % 2 == 0 && id % 5 != 4)));
            prop_assert_eq!(dealt.remove(&1).unwrap_or_default(), x);
        }
    }
}
