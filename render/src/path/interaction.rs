//! What a hit looks like from the side it was hit from.

use super::Surface;
use crate::material::Relief;
use crate::math::{Basis, Position, gamma, offset_origin, select};
use crate::ray::Hit;
use crate::real::consts::PI;
use crate::real::{Vec3, f32, narrow, wide};
use crate::texture::At;
use crate::world::{Primitive, interpolated as interpolated_at, sphere_uv};

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
    /// The shading normal before relief turned it, and what [`Interaction::terminator`] takes for the square of a roughness; 0 without.
    even: Vec3,
    alpha2: f32,
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
        let n = wide(e1).cross(wide(e2));
        let length = n.length();
        if !(length > 0.0 && length.is_finite()) {
            return None;
        }
        let front = narrow(n / length);
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
            Some(normals) => smooth(normals.map(Vec3::from), hit.u, hit.v, normal, d),
        };
        Some(Interaction { position, front, normal, shading, from_front, even: shading, alpha2: 0.0 })
    }

    /// The point.
    pub(super) fn point(&self) -> Vec3 {
        self.position.p
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

    /// Where textures are looked up. Texture coordinates are those of a triangle's vertices, interpolated, or the hit's own without; of a
    /// sphere its longitude and its colatitude from z, in [0, 1].
    pub(super) fn place(&self, surface: &Surface, hit: &Hit) -> At {
        match surface.geometry {
            Primitive::Triangle(_) => triangle_place(surface, hit),
            Primitive::Sphere { flipped, .. } => At::uv(sphere_uv(if flipped { -self.front } else { self.front })),
        }
    }

    /// Derivatives of the position by u and v; any two at right angles where the texture coordinates have no area.
    fn partials(&self, surface: &Surface) -> [Vec3; 2] {
        match surface.geometry {
            Primitive::Triangle([a, b, c]) => {
                let (e1, e2) = (Vec3::from(b) - Vec3::from(a), Vec3::from(c) - Vec3::from(a));
                let Some([ta, tb, tc]) = surface.uv else { return [e1, e2] };
                let (du1, dv1) = (tb[0] - ta[0], tb[1] - ta[1]);
                let (du2, dv2) = (tc[0] - ta[0], tc[1] - ta[1]);
                let inverse = 1.0 / (du1 * dv2 - dv1 * du2);
                if !inverse.is_finite() {
                    let basis = Basis::new(self.front);
                    return [basis.s, basis.t];
                }
                [(e1 * dv2 - e2 * dv1) * inverse, (e2 * du1 - e1 * du2) * inverse]
            }
            Primitive::Sphere { radius, flipped, .. } => {
                let n = if flipped { -self.front } else { self.front };
                let ring = (n.x * n.x + n.y * n.y).sqrt();
                let (cos, sin) = if ring > 0.0 { (n.x / ring, n.y / ring) } else { (1.0, 0.0) };
                let du = Vec3::new(-n.y, n.x, 0.0) * (2.0 * PI * radius);
                [du, Vec3::new(n.z * cos, n.z * sin, -ring) * (PI * radius)]
            }
        }
    }

    /// Turns the shading normal to that of a height field of this gradient by u and v above the surface (Blinn 1978, without the derivative
    /// of the normal, as Mitsuba has it).
    pub(super) fn bump(&mut self, surface: &Surface, gradient: [f32; 2], relief: &Relief, d: Vec3) {
        let n = if self.from_front { self.shading } else { -self.shading };
        let [du, dv] = self.partials(surface);
        let raise = |tangent: Vec3, slope: f32| tangent + n * (slope - n.dot(tangent));
        let m = raise(du, gradient[0]).cross(raise(dv, gradient[1]));
        self.turn(n, if m.dot(self.front) < 0.0 { -m } else { m }, relief, d);
    }

    /// Turns the shading normal to `local`, in the frame of the derivative by u and the normal of the front.
    pub(super) fn turn_to(&mut self, surface: &Surface, local: Vec3, relief: &Relief, d: Vec3) {
        let n = if self.from_front { self.shading } else { -self.shading };
        let m = Basis::with_tangent(n, self.partials(surface)[0]).to_world(local);
        self.turn(n, m, relief, d);
    }

    /// From the front's normal `n` to `m`, of any length. One that points below the surface leaves the shading normal as it was.
    fn turn(&mut self, n: Vec3, m: Vec3, relief: &Relief, d: Vec3) {
        let length = m.length();
        if !(length > 0.0 && length.is_finite()) {
            return;
        }
        let m = m / length;
        let m = match (self.from_front, relief.mirrored) {
            (true, _) => m,
            (false, false) => -m,
            (false, true) => m - n * (2.0 * n.dot(m)),
        };
        // one that the ray would see from behind leans as far the other way (Mitsuba's `flip_invalid_normals`)
        let m = if m.dot(d) < 0.0 { m } else { n * (2.0 * n.dot(m)) - m };
        if m.dot(d) < 0.0 {
            self.shading = m;
            if relief.shadowed {
                let cos = n.dot(m).abs().min(1.0);
                // the slope's square over 8: the roughness of a surface whose slopes are mostly below it; 1 where the two are at right angles
                self.alpha2 = ((1.0 - cos * cos) / (cos * cos) * 0.125).min(1.0);
            }
        }
    }

    /// What the turning of the shading normal leaves of light from, or to, a unit direction: 1 straight above the surface, and where nothing was turned,
    /// less the flatter it comes (GGX's masking; the paper named at `Relief::shadowed`).
    #[inline(always)]
    pub(super) fn terminator(&self, wi: Vec3) -> f32 {
        if self.alpha2 == 0.0 {
            return 1.0;
        }
        let cos = self.even.dot(wi);
        // Mitsuba's least cosine is 1e-6
        let cos2 = (cos * cos).clamp(1e-12, 1.0);
        2.0 / (1.0 + (1.0 + self.alpha2 * ((1.0 - cos2) / cos2)).sqrt())
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

/// Where textures are looked up at a hit of a triangle.
pub(super) fn triangle_place(surface: &Surface, hit: &Hit) -> At {
    At {
        uv: surface.uv.map_or([hit.u, hit.v], |uv| interpolated_at(&uv, hit.u, hit.v)),
        attribute: surface.attribute.map_or(Vec3::ZERO, |a| interpolated_at(&a, hit.u, hit.v).into()),
    }
}

/// The interpolated shading normal, turned to the side of the geometric normal; the geometric normal itself where there is none,
/// or where the ray sees the back of the interpolated one (which would be black, or let light through).
#[inline(always)]
pub(super) fn smooth([a, b, c]: [Vec3; 3], u: f32, v: f32, normal: Vec3, d: Vec3) -> Vec3 {
    let n = a * (1.0 - u - v) + b * u + c * v;
    let length = n.length();
    let n = n / length;
    let n = select(n.dot(normal) < 0.0, -n, n);
    select((length > gamma(8)) & (length < f32::INFINITY) & (n.dot(d) < 0.0), n, normal)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::testing::Rng;

    fn relief(mirrored: bool) -> Relief {
        Relief { kind: crate::material::ReliefKind::Normals, texture: 0, mirrored, shadowed: false }
    }

    fn hit(u: f32, v: f32) -> Hit {
        Hit { t: 1.0, u, v, prim: 0, leaf: 0, lane: 0 }
    }

    /// Coordinates and attribute at a hit are the corners' by their shares of the triangle: a corner's is that of the part across from it.
    #[test]
    fn places_are_weighted_by_area() {
        let mut rng = Rng(14);
        for _ in 0..2000 {
            let p = [rng.vec3(1.0), rng.vec3(1.0), rng.vec3(1.0)];
            let [a, b, c] = p.map(Vec3::as_dvec3);
            let whole = (b - a).cross(c - a);
            if whole.length() < 0.05 {
                continue;
            }
            let (s, t) = (rng.f32(), rng.f32());
            let [u, v] = if s + t < 1.0 { [s, t] } else { [1.0 - s, 1.0 - t] };
            let uv = [0, 1, 2].map(|_| [rng.range(-3.0, 3.0), rng.range(-3.0, 3.0)]);
            let attribute = [0, 1, 2].map(|_| rng.vec3(5.0).to_array());
            let geometry = Primitive::Triangle(p.map(|v| v.to_array()));
            let surface = Surface { geometry, normals: None, uv: Some(uv), attribute: Some(attribute) };
            let at = triangle_place(&surface, &hit(u, v));
            // the kernel's u and v are the shares of the second and the third corner
            let place = a + f64::from(u) * (b - a) + f64::from(v) * (c - a);
            let share = |from: DVec3, to: DVec3| (from - place).cross(to - place).dot(whole) / whole.length_squared();
            let shares = [share(b, c), share(c, a), share(a, b)];
            for k in 0..2 {
                let expected: f64 = (0..3).map(|i| shares[i] * f64::from(uv[i][k])).sum();
                assert!((f64::from(at.uv[k]) - expected).abs() < 1e-5, "{uv:?} {shares:?}: {:?}", at.uv);
            }
            for k in 0..3 {
                let expected: f64 = (0..3).map(|i| shares[i] * f64::from(attribute[i][k])).sum();
                assert!((f64::from(at.attribute[k]) - expected).abs() < 1e-5, "{attribute:?} {shares:?}: {at:?}");
            }
            // without any
            let bare = triangle_place(&Surface { uv: None, attribute: None, ..surface }, &hit(u, v));
            assert_eq!((bare.uv, bare.attribute), ([u, v], Vec3::ZERO));
        }
    }

    /// A bumped normal is that of the surface raised by the height, which is linear in u and v; seen from behind its other side, or its mirror image.
    #[test]
    fn bumps_are_normals_of_raised_surfaces() {
        let mut rng = Rng(11);
        let mut turned = 0;
        for _ in 0..2000 {
            let p = [rng.vec3(1.0), rng.vec3(1.0), rng.vec3(1.0)];
            let uv = [0, 1, 2].map(|_| [rng.range(-1.0, 1.0), rng.range(-1.0, 1.0)]);
            let surface = Surface {
                geometry: Primitive::Triangle(p.map(|v| v.to_array())),
                normals: None,
                uv: Some(uv),
                attribute: None,
            };
            let [a, b, c] = p.map(Vec3::as_dvec3);
            let [ta, tb, tc] = uv.map(|t| t.map(f64::from));
            let (e1, e2) = (b - a, c - a);
            let n = e1.cross(e2).normalize();
            let det = (tb[0] - ta[0]) * (tc[1] - ta[1]) - (tb[1] - ta[1]) * (tc[0] - ta[0]);
            if det.abs() < 0.05 || e1.cross(e2).length() < 0.05 {
                continue;
            }
            let gradient = [rng.range(-1.0, 1.0), rng.range(-1.0, 1.0)];
            // heights at the vertices raise them along the normal
            let height = |t: [f64; 2]| f64::from(gradient[0]) * t[0] + f64::from(gradient[1]) * t[1];
            let raised = [(a, ta), (b, tb), (c, tc)].map(|(p, t)| p + n * height(t));
            let up = (raised[1] - raised[0]).cross(raised[2] - raised[0]).normalize();
            let up = if up.dot(n) < 0.0 { -up } else { up };
            for (side, mirrored) in [(1.0, false), (-1.0, false), (-1.0, true)] {
                let d = (n * -side).as_vec3();
                let mut at = Interaction::new(Vec3::ZERO, d, &hit(0.2, 0.3), &surface).unwrap();
                at.bump(&surface, gradient, &relief(mirrored), d);
                let expected: DVec3 = match (side > 0.0, mirrored) {
                    (true, _) => up,
                    (false, false) => -up,
                    (false, true) => up - n * (2.0 * up.dot(n)),
                };
                assert!((at.shading.as_dvec3() - expected).length() < 1e-3, "{} {expected}", at.shading);
                turned += u32::from(at.shading != at.normal);
            }
        }
        assert!(turned > 1000, "{turned}");
    }

    #[test]
    fn a_normal_map_is_in_the_frame_of_u() {
        let vertices = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]];
        let uv = Some([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
        let surface = Surface { geometry: Primitive::Triangle(vertices), normals: None, uv, attribute: None };
        let d = Vec3::new(0.1, 0.2, -1.0).normalize();
        let mut at = Interaction::new(Vec3::Z, d, &hit(0.2, 0.3), &surface).unwrap();
        assert_eq!(at.place(&surface, &hit(0.2, 0.3)).uv, [0.2, 0.3]);
        at.turn_to(&surface, Vec3::new(0.6, 0.0, 1.6), &relief(false), d);
        assert!((at.shading - Vec3::new(0.6, 0.0, 1.6).normalize()).length() < 1e-6, "{}", at.shading);
        // seen from behind by the ray it leans the other way; below the surface, or of no length, it stays
        let mut at = Interaction::new(Vec3::Z, d, &hit(0.2, 0.3), &surface).unwrap();
        at.turn_to(&surface, Vec3::new(0.1, 0.9, 0.1), &relief(false), d);
        assert!((at.shading - Vec3::new(-0.1, -0.9, 0.1).normalize()).length() < 1e-6, "{}", at.shading);
        for local in [Vec3::new(0.0, 0.1, -1.0), Vec3::ZERO, Vec3::NAN] {
            let mut at = Interaction::new(Vec3::Z, d, &hit(0.2, 0.3), &surface).unwrap();
            at.turn_to(&surface, local, &relief(false), d);
            assert_eq!(at.shading, Vec3::Z);
        }
    }

    /// Longitude and colatitude by their definition in f64, and derivatives as differences of positions.
    #[test]
    fn spheres_have_coordinates() {
        let mut rng = Rng(12);
        for k in 0..2000 {
            let n = rng.direction();
            let (center, radius, flipped) = ([0.5, -1.0, 2.0], 0.7, k % 2 == 0);
            let surface = Surface {
                geometry: Primitive::Sphere { center, radius, flipped },
                normals: None,
                uv: None,
                attribute: None,
            };
            let o = Vec3::from(center) + n * 3.0;
            let hit = Hit { t: 3.0 - radius, ..hit(0.0, 0.0) };
            let at = Interaction::new(o, -n, &hit, &surface).unwrap();
            let [u, v] = at.place(&surface, &hit).uv.map(f64::from);
            let n = n.as_dvec3();
            let turn = n.y.atan2(n.x).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU;
            let ring = n.x.hypot(n.y);
            let colatitude = ring.atan2(n.z) / std::f64::consts::PI;
            // an error of the normal is a larger one of the longitude near the poles
            let error = (u - turn).abs().min(1.0 - (u - turn).abs());
            assert!(error < 1e-6 / ring && (v - colatitude).abs() < 1e-6, "{n} {u} {v}");
            let place = |u: f64, v: f64| {
                let (phi, theta) = (u * std::f64::consts::TAU, v * std::f64::consts::PI);
                DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()) * f64::from(radius)
            };
            let h = 1e-5;
            let expected =
                [place(u + h, v) - place(u - h, v), place(u, v + h) - place(u, v - h)].map(|d| d / (2.0 * h));
            for (found, expected) in at.partials(&surface).into_iter().zip(expected) {
                assert!((found.as_dvec3() - expected).length() < 1e-3 / ring, "{n}: {found} {expected}");
            }
        }
    }
}
