//! What a hit looks like from the side it was hit from.

use glam::Vec3;

use super::Surface;
use crate::math::{Basis, Position, gamma, offset_origin};
use crate::ray::Hit;
use crate::world::Primitive;

/// A point on a triangle, without branches.
pub(super) struct Flat {
    pub position: Position,
    front: Vec3,
    /// Unit geometric normal on the side the ray came from.
    pub normal: Vec3,
    /// Whether the ray came from the front.
    pub from_front: bool,
    /// Whether the rest means anything: not for an area whose square underflows or overflows, nor for one seen exactly edge on.
    pub sound: bool,
}

impl Flat {
    #[inline(always)]
    pub(super) fn new(p0: Vec3, p1: Vec3, p2: Vec3, u: f32, v: f32, d: Vec3) -> Flat {
        let (e1, e2) = (p1 - p0, p2 - p0);
        let n = e1.cross(e2);
        let length2 = n.length_squared();
        let front = n * (1.0 / length2.sqrt());
        let cos = front.dot(d);
        let from_front = cos < 0.0;
        let side = if from_front { 1.0 } else { -1.0 };
        Flat {
            position: Position::on_triangle(p0, e1, e2, u, v),
            front,
            normal: front * side,
            from_front,
            sound: (length2 > f32::MIN_POSITIVE) & (length2 < f32::INFINITY) & (cos.abs() > 0.0),
        }
    }
}

/// A point on a surface, seen along a ray.
pub(super) struct Interaction {
    position: Position,
    /// Unit geometric normal of the front.
    front: Vec3,
    /// Unit geometric normal on the side the ray came from.
    pub normal: Vec3,
    /// Unit shading normal: on the side of `normal` and of the ray.
    pub shading: Vec3,
    /// Whether the ray came from the front.
    pub from_front: bool,
}

impl Interaction {
    /// From a hit along the unit direction `d` of a ray from `o`; `None` when the surface is seen exactly edge on or has no area.
    #[inline(always)]
    pub(super) fn new(o: Vec3, d: Vec3, hit: &Hit, surface: &Surface) -> Option<Interaction> {
        let (position, front) = match surface.geometry {
            Primitive::Triangle(vertices) => {
                let [p0, p1, p2] = vertices.map(Vec3::from);
                let flat = Flat::new(p0, p1, p2, hit.u, hit.v, d);
                if !flat.sound {
                    return Self::tiny(d, hit, surface);
                }
                (flat.position, flat.front)
            }
            Primitive::Sphere { center, radius, flipped } => {
                let center = Vec3::from(center);
                let out = (o + d * hit.t) - center;
                let n = out / out.length();
                (Position::on_sphere(center, radius, n), if flipped { -n } else { n })
            }
        };
        Self::facing(d, position, front, hit, surface)
    }

    /// A triangle whose area's square underflows or overflows: the normal by way of f64.
    #[cold]
    fn tiny(d: Vec3, hit: &Hit, surface: &Surface) -> Option<Interaction> {
        let Primitive::Triangle([a, b, c]) = surface.geometry else { return None };
        let p0 = Vec3::from(a);
        let (e1, e2) = (Vec3::from(b) - p0, Vec3::from(c) - p0);
        let n = e1.as_dvec3().cross(e2.as_dvec3());
        let length = n.length();
        if !(length > 0.0 && length.is_finite()) {
            return None;
        }
        let front = (n / length).as_vec3();
        Self::facing(d, Position::on_triangle(p0, e1, e2, hit.u, hit.v), front, hit, surface)
    }

    #[inline(always)]
    fn facing(d: Vec3, position: Position, front: Vec3, hit: &Hit, surface: &Surface) -> Option<Interaction> {
        let cos = front.dot(d);
        if cos == 0.0 || cos.is_nan() {
            return None;
        }
        let from_front = cos < 0.0;
        let normal = if from_front { front } else { -front };
        let shading = match &surface.normals {
            None => normal,
            Some(normals) => interpolated(normals, hit, normal, d),
        };
        Some(Interaction { position, front, normal, shading, from_front })
    }

    /// Whether shading and geometric normal are one.
    #[inline(always)]
    pub(super) fn is_flat(&self) -> bool {
        self.shading == self.normal
    }

    /// Origin of every ray that leaves on the side the ray came from.
    #[inline(always)]
    pub(super) fn origin(&self) -> Vec3 {
        offset_origin(&self.position, self.normal)
    }

    /// Origin of every ray that leaves on the other side.
    #[inline(always)]
    pub(super) fn origin_beyond(&self) -> Vec3 {
        offset_origin(&self.position, -self.normal)
    }

    /// The shading frame; its tangents follow the surface's parametrisation when `tangents` asks for it.
    #[inline(always)]
    pub(super) fn basis(&self, surface: &Surface, tangents: bool) -> Basis {
        if tangents { self.tangent_basis(surface) } else { Basis::new(self.shading) }
    }

    /// Along increasing u: of the texture coordinates; of a sphere along its circles of latitude around z.
    #[cold]
    fn tangent_basis(&self, surface: &Surface) -> Basis {
        match (surface.geometry, surface.uv) {
            (Primitive::Triangle([a, b, c]), Some([ta, tb, tc])) => {
                let (e1, e2) = (Vec3::from(b) - Vec3::from(a), Vec3::from(c) - Vec3::from(a));
                let (du1, dv1) = (tb[0] - ta[0], tb[1] - ta[1]);
                let (du2, dv2) = (tc[0] - ta[0], tc[1] - ta[1]);
                // of the sign of the determinant only: its size does not turn the tangent
                let sign = f32::copysign(1.0, du1 * dv2 - dv1 * du2);
                Basis::with_tangent(self.shading, (e1 * dv2 - e2 * dv1) * sign)
            }
            (Primitive::Triangle(_), None) => Basis::new(self.shading),
            (Primitive::Sphere { .. }, _) => {
                Basis::with_tangent(self.shading, Vec3::new(-self.front.y, self.front.x, 0.0))
            }
        }
    }
}

/// The interpolated shading normal, turned to the side of the geometric normal; the geometric normal itself where there is none,
/// or where the ray sees the back of the interpolated one (which would be black, or let light through).
fn interpolated(normals: &[[f32; 3]; 3], hit: &Hit, normal: Vec3, d: Vec3) -> Vec3 {
    let [a, b, c] = normals.map(Vec3::from);
    let n = a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v;
    let length = n.length();
    if !(length > gamma(8)) || !length.is_finite() {
        return normal;
    }
    let n = n / length;
    let n = if n.dot(normal) < 0.0 { -n } else { n };
    if n.dot(d) < 0.0 { n } else { normal }
}
