//! Mitsuba's built-in shapes as triangles; rectangle and cube in its own order of vertices and triangles.
//!
//! Disk and cylinder are exact in Mitsuba and have [`SIDES`] sides here. The polygon has the area (of the cylinder: the circumference) of its circle, so
//! what it emits or receives in all is right; its edge lies within 1.3e-5 of the radius (of the cylinder: 1.9e-5) on either side of the circle:
//! 0.02 pixels where the radius is 1000 of them.

use std::f64::consts::PI;

use super::vector::{cross, normalize, sub};
use crate::description::{Affine, Geometry};

/// Sides of what is round.
const SIDES: u32 = 512;

/// The circle's points of a polygon of this radius, the first again at the end.
fn circle(radius: f64) -> impl Iterator<Item = [f64; 2]> {
    (0..=SIDES).map(move |i| {
        let (s, c) = libm::sincos(2.0 * PI * f64::from(i % SIDES) / f64::from(SIDES));
        [radius * c, radius * s]
    })
}

/// The unit disk at z = 0, front towards +z; u is the distance from the centre, v the angle from x in turns (src/shapes/disk.cpp).
pub(super) fn disk() -> Geometry {
    // of the area pi
    let n = f64::from(SIDES);
    let radius = (2.0 * PI / (n * libm::sin(2.0 * PI / n))).sqrt();
    let turn = |i: u32| (f64::from(i) / n) as f32;
    let mut positions: Vec<[f64; 3]> = circle(radius).map(|[x, y]| [x, y, 0.0]).collect();
    let mut uv: Vec<[f32; 2]> = (0..=SIDES).map(|i| [1.0, turn(i)]).collect();
    // a centre for each side, so that the angle is that of the side there too
    positions.extend((0..SIDES).map(|_| [0.0; 3]));
    uv.extend((0..SIDES).map(|i| [0.0, 0.5 * (turn(i) + turn(i + 1))]));
    let triangles = (0..SIDES).map(|i| [SIDES + 1 + i, i, i + 1]).collect();
    Geometry::Inline { positions, normals: vec![], uv, triangles }
}

/// The open cylinder of radius 1 from z = 0 to z = 1, front outside; u is the angle from x in turns, v is z (src/shapes/cylinder.cpp).
pub(super) fn cylinder() -> Geometry {
    // of the circumference 2 pi
    let n = f64::from(SIDES);
    let radius = PI / n / libm::sin(PI / n);
    let (mut positions, mut normals, mut uv) = (vec![], vec![], vec![]);
    for (i, ([x, y], [nx, ny])) in circle(radius).zip(circle(1.0)).enumerate() {
        for z in [0.0, 1.0] {
            positions.push([x, y, z]);
            normals.push([nx as f32, ny as f32, 0.0]);
            uv.push([(i as f64 / n) as f32, z as f32]);
        }
    }
    let triangles =
        (0..SIDES).flat_map(|i| [[2 * i, 2 * i + 2, 2 * i + 1], [2 * i + 1, 2 * i + 2, 2 * i + 3]]).collect();
    Geometry::Inline { positions, normals, uv, triangles }
}

/// The map that puts [`cylinder`] between two points; `None` if they are one, or the radius is not above 0.
pub(super) fn between(p0: [f64; 3], p1: [f64; 3], radius: f64) -> Option<Affine> {
    let way = sub(p1, p0);
    let axis = normalize(way)?;
    // any frame; Mitsuba's own turns by the angle from which u counts (Duff et al., "Building an Orthonormal Basis, Revisited", 2017)
    let sign = f64::copysign(1.0, axis[2]);
    let a = -1.0 / (sign + axis[2]);
    let s = [1.0 + sign * axis[0] * axis[0] * a, sign * axis[0] * axis[1] * a, -sign * axis[0]];
    let t = cross(axis, s);
    (radius > 0.0).then(|| Affine(std::array::from_fn(|r| [s[r] * radius, t[r] * radius, way[r], p0[r]])))
}

/// `[-1, 1]^2` at z = 0, front towards +z (src/shapes/rectangle.cpp).
pub(super) fn rectangle() -> Geometry {
    Geometry::Inline {
        positions: vec![[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]],
        uv: vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
        normals: vec![],
        triangles: vec![[1, 2, 0], [1, 3, 2]],
    }
}

/// `[-1, 1]^3`, front outside, each face with its own uv square (src/shapes/cube.cpp).
pub(super) fn cube() -> Geometry {
    // bit k of a corner's number is the sign of axis k
    const CORNERS: [u8; 24] = [1, 5, 4, 0, 3, 2, 6, 7, 1, 3, 7, 5, 5, 7, 6, 4, 4, 6, 2, 0, 3, 1, 0, 2];
    const UV: [[f32; 2]; 4] = [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let sign = |c: u8, axis: u8| if c >> axis & 1 == 1 { 1.0 } else { -1.0 };
    Geometry::Inline {
        positions: CORNERS.iter().map(|&c| [sign(c, 0), sign(c, 1), sign(c, 2)]).collect(),
        normals: vec![],
        uv: (0..24).map(|i| UV[i % 4]).collect(),
        triangles: (0..6).flat_map(|s| [[4 * s, 4 * s + 1, 4 * s + 2], [4 * s + 3, 4 * s, 4 * s + 2]]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Positions, normals, texture coordinates, triangles.
    type Parts = (Vec<[f64; 3]>, Vec<[f32; 3]>, Vec<[f32; 2]>, Vec<[u32; 3]>);

    fn parts(geometry: Geometry) -> Parts {
        let Geometry::Inline { positions, normals, uv, triangles } = geometry else { panic!("no triangles") };
        (positions, normals, uv, triangles)
    }

    /// Twice the area vector of a triangle.
    fn area(p: &[[f64; 3]], t: [u32; 3]) -> [f64; 3] {
        let [a, b, c] = t.map(|i| p[i as usize]);
        cross(sub(b, a), sub(c, a))
    }

    #[test]
    fn a_disk_has_the_area_of_one() {
        let (p, normals, uv, triangles) = parts(disk());
        assert!(normals.is_empty() && uv.len() == p.len() && triangles.len() == SIDES as usize);
        let sum: f64 = triangles.iter().map(|&t| 0.5 * area(&p, t)[2]).sum();
        assert!((sum - PI).abs() < 1e-12 && triangles.iter().all(|&t| area(&p, t)[2] > 0.0));
        for &[centre, a, b] in &triangles {
            let [a, b] = [p[a as usize], p[b as usize]];
            let middle = (0.5 * (a[0] + b[0])).hypot(0.5 * (a[1] + b[1]));
            assert!(p[centre as usize] == [0.0; 3] && (a[0].hypot(a[1]) - 1.0) < 1.3e-5 && (1.0 - middle) < 1.3e-5);
        }
    }

    #[test]
    fn a_cylinder_is_round_and_looks_outside() {
        let (p, normals, uv, triangles) = parts(cylinder());
        assert!(normals.len() == p.len() && uv.len() == p.len() && triangles.len() == 2 * SIDES as usize);
        let mut sum = 0.0;
        for &t in &triangles {
            let (n, middle) = (area(&p, t), t.map(|i| p[i as usize]));
            let out = [middle[0][0] + middle[1][0], middle[0][1] + middle[1][1]];
            assert!(n[0] * out[0] + n[1] * out[1] > 0.0 && n[2] == 0.0);
            sum += 0.5 * n[0].hypot(n[1]);
        }
        assert!((sum - 2.0 * PI).abs() < 1e-12);
        assert!(p.iter().all(|p| (p[0].hypot(p[1]) - 1.0).abs() < 1.9e-5));
    }

    /// Middles of the triangles of a shape, and their texture coordinates.
    fn middles(geometry: Geometry) -> Vec<([f64; 3], [f64; 2])> {
        let (p, _, uv, triangles) = parts(geometry);
        let mean = |of: [f64; 3]| of.iter().sum::<f64>() / 3.0;
        let of = |t: &[u32; 3]| {
            let t = t.map(|i| i as usize);
            let middle = std::array::from_fn(|axis| mean(t.map(|i| p[i][axis])));
            (middle, std::array::from_fn(|k| mean(t.map(|i| f64::from(uv[i][k])))))
        };
        triangles.iter().map(of).collect()
    }

    /// How far an angle in turns is from that of a point; f32 has seven digits of it.
    fn off(turns: f64, [x, y]: [f64; 2]) -> f64 {
        let difference = (turns - libm::atan2(y, x) / (2.0 * PI)).rem_euclid(1.0);
        difference.min(1.0 - difference)
    }

    /// As of Mitsuba 3.9.1's `vertex_texcoords`: of each face u and v by the two axes along it.
    #[test]
    fn each_face_of_a_cube_has_the_whole_square() {
        let found = middles(cube());
        for (at, [u, v]) in &found {
            let axis = (0..3).find(|&a| at[a].abs() == 1.0).unwrap();
            // from 0 to 1 along each axis, and against it
            let along = at.map(|x| 0.5 + 0.5 * x);
            let against = at.map(|x| 0.5 - 0.5 * x);
            let expected = match (axis, at[axis] > 0.0) {
                (0, true) => [along[1], against[2]],
                (0, false) => [along[1], along[2]],
                (1, true) => [against[0], against[2]],
                (1, false) => [along[2], along[0]],
                (_, true) => [along[1], along[0]],
                (_, false) => [against[1], along[0]],
            };
            assert!((u - expected[0]).abs() < 1e-12 && (v - expected[1]).abs() < 1e-12, "{at:?}: {u} {v}");
        }
        assert_eq!(found.len(), 12);
        let (_, _, uv, _) = parts(cube());
        for face in uv.chunks(4) {
            assert!([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]].iter().all(|corner| face.contains(corner)));
        }
    }

    /// u is the distance from the centre, v the angle from x in turns; Mitsuba 3.9.1 says (0.5, 0.25) of (0, 0.5) and (0.42426, 0.625) of (-0.3, -0.3).
    #[test]
    fn coordinates_of_a_disk_are_polar() {
        let (p, _, uv, triangles) = parts(disk());
        for &[_, a, b] in &triangles {
            for i in [a, b].map(|i| i as usize) {
                assert!(uv[i][0] == 1.0 && off(uv[i][1].into(), [p[i][0], p[i][1]]) < 1e-7);
            }
        }
        for ([x, y, _], [u, v]) in middles(disk()) {
            // a side is straight: as much nearer as its middle is
            assert!((u - x.hypot(y)).abs() < 2.0 * 1.3e-5 && off(v, [x, y]) < 1e-7, "({x}, {y}): {u} {v}");
        }
        let at = |x: f64, y: f64| {
            // of which triangle a point is, and where in it
            let inside = |&[c, a, b]: &[u32; 3]| {
                let [a2, b2] = [p[a as usize], p[b as usize]];
                let all = a2[0] * b2[1] - a2[1] * b2[0];
                let (s, t) = ((x * b2[1] - y * b2[0]) / all, (a2[0] * y - a2[1] * x) / all);
                let mix = |k: usize| {
                    let [c, a, b] = [c, a, b].map(|i| f64::from(uv[i as usize][k]));
                    (1.0 - s - t) * c + s * a + t * b
                };
                (s >= 0.0 && t >= 0.0 && s + t <= 1.0).then(|| [mix(0), mix(1)])
            };
            triangles.iter().find_map(inside).unwrap()
        };
        let half_a_side = 0.5 / f64::from(SIDES);
        for (x, y, [u, v]) in [(0.001, 0.5, [0.500001, 0.249682]), (-0.3, -0.3001, [0.424335, 0.625027])] {
            let found = at(x, y);
            assert!((found[0] - u).abs() < 2e-5 && (found[1] - v).abs() < half_a_side, "({x}, {y}): {found:?}");
        }
    }

    /// u is the angle from x in turns, v the height; Mitsuba 3.9.1 says (0.25, 0.75) of (0, 1, 0.75) and (0.75, 0.1) of (0, -1, 0.1).
    #[test]
    fn coordinates_of_a_cylinder_are_angle_and_height() {
        let (p, _, uv, _) = parts(cylinder());
        for (p, &[u, v]) in p.iter().zip(&uv) {
            assert!(off(u.into(), [p[0], p[1]]) < 1e-7 && f64::from(v) == p[2], "{p:?}: {u} {v}");
        }
        let quarter = 2 * SIDES as usize / 4;
        assert!(p[quarter][0].abs() < 1e-12 && p[quarter][1] > 0.99 && uv[quarter] == [0.25, 0.0]);
        // places on others, and u and v there, by Mitsuba 3.9.1
        type Ends = [[f64; 3]; 2];
        let slanted: Ends = [[1.0, 2.0, 3.0], [4.0, -1.0, 5.0]];
        let down: Ends = [[0.0; 3], [0.0, 0.0, -2.0]];
        let along_y: Ends = [[1.0, 0.0, 0.0], [1.0, 3.0, 0.0]];
        for ([p0, p1], place, [u, v]) in [
            (slanted, [2.2583053, 1.4484214, 3.5851737], [0.11978167, 0.3]),
            (slanted, [2.2452223, 1.2170753, 3.2577798], [0.98841059, 0.3]),
            (down, [0.47891313, 0.14367394, -0.6], [0.95361322, 0.3]),
            (down, [-0.10846519, 0.48809358, -0.6], [0.71519774, 0.3]),
            (along_y, [1.4902904, 0.9, 0.0980581], [0.96858346, 0.3]),
            (along_y, [0.9019419, 0.9, -0.49029034], [0.28141651, 0.3]),
        ] {
            let (sin, cos) = libm::sincos(2.0 * PI * u);
            let found = between(p0, p1, 0.5).unwrap().point([cos, sin, v]);
            // digits of f32
            assert!((0..3).all(|k| (found[k] - place[k]).abs() < 1e-6), "{p0:?} {p1:?}: {found:?} {place:?}");
        }
    }

    #[test]
    fn a_cylinder_goes_between_two_points() {
        for (p0, p1) in [([1.0, 2.0, 3.0], [4.0, -1.0, 5.0]), ([0.0; 3], [0.0, 0.0, -2.0]), ([0.0; 3], [0.0, 0.0, 1.0])]
        {
            let map = between(p0, p1, 0.5).unwrap();
            let close = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-12);
            assert!(close(map.point([0.0; 3]), p0) && close(map.point([0.0, 0.0, 1.0]), p1));
            let (s, t) = (map.vector([1.0, 0.0, 0.0]), map.vector([0.0, 1.0, 0.0]));
            let dot = super::super::vector::dot;
            assert!((dot(s, s) - 0.25).abs() < 1e-12 && (dot(t, t) - 0.25).abs() < 1e-12 && dot(s, t).abs() < 1e-12);
            assert!(dot(s, sub(p1, p0)).abs() < 1e-12 && map.determinant() > 0.0);
        }
        assert!(between([1.0; 3], [1.0; 3], 1.0).is_none() && between([0.0; 3], [1.0; 3], 0.0).is_none());
    }
}
