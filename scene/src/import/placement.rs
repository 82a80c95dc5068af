//! From a shape's own space to world-space records.

use super::mesh::Corners;
use super::vector::{cofactors, normalize};
use crate::description::{Affine, Shape};
use crate::record::{Record, TriangleRecord};

/// One shape's map, orientation and number.
#[derive(Clone, Copy, Debug)]
pub struct Placement {
    to_world: Affine,
    identity: bool,
    /// Maps normals up to length.
    normals: [[f64; 3]; 3],
    /// Winding is turned round: by a mirroring map or by `flip_normals`, but not by both (Mitsuba's rule).
    reverse: bool,
    keep_normals: bool,
    shape: u32,
}

impl Placement {
    /// The placement of a shape with this number.
    pub fn new(shape: &Shape, number: u32) -> Self {
        let mirrored = shape.to_world.determinant() < 0.0;
        // normals go by the inverse transpose, which is the cofactors over the determinant
        let sign = if mirrored != shape.flip_normals { -1.0 } else { 1.0 };
        Placement {
            to_world: shape.to_world,
            identity: shape.to_world == Affine::IDENTITY,
            normals: cofactors(&shape.to_world).map(|row| row.map(|x| x * sign)),
            reverse: mirrored != shape.flip_normals,
            keep_normals: !shape.face_normals,
            shape: number,
        }
    }

    /// Whether shading normals are wanted.
    pub fn keeps_normals(&self) -> bool {
        self.keep_normals
    }

    /// The record of a triangle that is counter-clockwise from the front in the shape's own space, and of the shape of this part (0: its own).
    ///
    /// A shading normal without direction drops the triangle's shading normals.
    pub(super) fn triangle(&self, corners: Corners, part: u32) -> Record {
        let Corners { p, n, mut uv, mut attribute } = corners;
        let mut p = if self.identity { p } else { p.map(|v| self.to_world.point(v)) };
        let mut n = n.filter(|_| self.keep_normals).and_then(|n| {
            let [a, b, c] = n.map(|v| self.normal(v));
            Some([a?, b?, c?])
        });
        if self.reverse {
            // the first vertex stays, as does the place in the stream
            p.swap(1, 2);
            n.iter_mut().for_each(|n| n.swap(1, 2));
            uv.iter_mut().for_each(|uv| uv.swap(1, 2));
            attribute.iter_mut().for_each(|a| a.swap(1, 2));
        }
        Record::Triangle(TriangleRecord { p, n, uv, attribute, shape: self.shape + part })
    }

    fn normal(&self, n: [f32; 3]) -> Option<[f32; 3]> {
        let n = n.map(f64::from);
        let world = self.normals.map(|row| row[0] * n[0] + row[1] * n[1] + row[2] * n[2]);
        Some(normalize(world)?.map(|x| x as f32))
    }
}
