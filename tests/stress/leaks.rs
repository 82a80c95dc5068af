//! Closed meshes of every size, near the origin and far from it: no ray gets out of one.

use rayherd_render::ray::Ray;
use rayherd_tests::mutation::Random;

use super::numbers::*;

/// Faces of a cube's sides are divided so often.
const SIDE: usize = 24;

/// Shapes of unit size around 0 that see all of themselves from anywhere within 0.3 of it.
#[derive(Clone, Copy, Debug)]
enum Form {
    /// Flat sides, along the axes.
    Cube,
    /// A sphere with bumps.
    Bumpy,
    /// Flattened to a thousandth: needles of triangles along its rim.
    Disk,
}

/// A mesh of `size` around `center`: each vertex is rounded once, so neighbours share it to the bit.
fn mesh(form: Form, size: f64, center: [f64; 3]) -> Vec<Triangle> {
    let at = |face: usize, i: usize, j: usize| -> [f32; 3] {
        let (a, b) = (i as f64 / SIDE as f64 * 2.0 - 1.0, j as f64 / SIDE as f64 * 2.0 - 1.0);
        let s = if face & 1 == 0 { 1.0 } else { -1.0 };
        let v: [f64; 3] = match face >> 1 {
            0 => [s, a, b],
            1 => [a, s, b],
            _ => [a, b, s],
        };
        let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        let n = v.map(|x| x / length);
        let p = match form {
            Form::Cube => v,
            Form::Bumpy => n.map(|x| x * (1.0 + 0.05 * libm::sin(9.0 * n[0]) * libm::cos(7.0 * n[1]))),
            Form::Disk => [n[0], n[1], n[2] * FLAT],
        };
        std::array::from_fn(|c| (center[c] + size * p[c]) as f32)
    };
    let mut out = Vec::with_capacity(12 * SIDE * SIDE);
    for face in 0..6 {
        for i in 0..SIDE {
            for j in 0..SIDE {
                let [a, b, c, d] = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(i, j)| at(face, i, j));
                out.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    out
}

/// Height of a disk over its width.
const FLAT: f64 = 1e-3;

/// From inside at a vertex, at an edge, or within the plane of a face; `None` where rounding took the origin out of the mesh.
fn from_inside(random: &mut Random, triangles: &[Triangle], form: Form, size: f64, center: [f64; 3]) -> Option<Ray> {
    let t = triangles[random.below(triangles.len())];
    let e = random.below(3);
    let (a, b) = (t[e], t[(e + 1) % 3]);
    let inside = point(random).map(|x| 0.3 * f64::from(x));
    let flat = if matches!(form, Form::Disk) { FLAT } else { 1.0 };
    let o: [f32; 3] = std::array::from_fn(|c| (center[c] + size * inside[c] * if c == 2 { flat } else { 1.0 }) as f32);
    let s = match random.below(4) {
        0 => 0.0,
        1 => 0.5,
        _ => unit(random),
    };
    let d: [f32; 3] = match random.below(4) {
        // along an axis
        0 => {
            let axis = random.below(3);
            std::array::from_fn(|c| if c == axis { signed(random).signum() } else { 0.0 })
        }
        // parallel to an edge, so within planes of faces
        1 => std::array::from_fn(|c| b[c] - a[c]),
        _ => std::array::from_fn(|c| a[c] + (b[c] - a[c]) * s - o[c]),
    };
    // the kernel takes directions from 2^-30 on; a path's are of unit length
    let largest = d.iter().fold(0f32, |m, x| m.max(x.abs()));
    (largest > 0.0).then(|| ray(o, d.map(|x| x / largest)))
}

/// Sizes of 1e-6 to 1e6, centres up to a thousand sizes from the origin: f32 vertices, as every source has after recentring.
#[test]
fn nothing_gets_out_of_a_closed_mesh() {
    let sizes = [1e-6, 1e-3, 1.0, 1e3, 1e6];
    let distances = [0.0, 1.0, 30.0, 1000.0];
    let forms = [Form::Cube, Form::Bumpy, Form::Disk];
    let cases = (sizes.len() * distances.len() * forms.len()) as u64;
    let each = rays(240_000).div_ceil(cases);
    let mut random = Random::new(41);
    let mut traced = 0;
    for form in forms {
        for size in sizes {
            for distance in distances {
                if matches!(form, Form::Disk) && distance > 1.0 {
                    // a thousandth of a size is then below what f32 can tell: no inside is left
                    continue;
                }
                let direction = [0.48, -0.6, 0.64];
                let center = direction.map(|x| x * distance * size);
                let triangles = mesh(form, size, center);
                // cut in three at random: a mesh is closed however it lies in blocks
                let mut parts = vec![Vec::new(); 3];
                for t in numbered(&triangles) {
                    parts[random.below(3)].push(t);
                }
                let whole = [numbered(&triangles)];
                for forest in [forest(whole.iter().map(Vec::as_slice)), forest(parts.iter().map(Vec::as_slice))] {
                    let mut left = each / 2;
                    while left > 0 {
                        let n = left.min(1 << 16);
                        left -= n;
                        let rays: Vec<Ray> =
                            (0..n).filter_map(|_| from_inside(&mut random, &triangles, form, size, center)).collect();
                        traced += rays.len() as u64;
                        for tracer in &mut kernels() {
                            let hits = closest(tracer, &forest, &rays);
                            let occluded = any(tracer, &forest, &rays);
                            for ((ray, hit), is_any) in rays.iter().zip(&hits).zip(occluded) {
                                let kernel = tracer.kernel();
                                assert!(hit.is_hit() && is_any, "{kernel:?} {form:?} {size} x{distance}: {ray:?}");
                            }
                        }
                    }
                }
            }
        }
    }
    println!("{traced} rays, none got out");
    assert!(traced > each * cases / 2, "{traced}");
}

/// Within the plane of a flat face there is no inside to be in: such rays run inside a larger mesh around it, whose walls they must meet,
/// whatever they do to the face that they graze.
#[test]
fn rays_within_a_face_still_meet_what_is_beyond() {
    let mut random = Random::new(42);
    let mut triangles = mesh(Form::Cube, 0.5, [0.0; 3]);
    triangles.extend(mesh(Form::Bumpy, 4.0, [0.0; 3]));
    let whole = [numbered(&triangles)];
    let forest = forest(whole.iter().map(Vec::as_slice));
    let n = rays(20_000);
    let rays: Vec<Ray> = (0..n)
        .map(|_| {
            let (axis, side) = (random.below(3), signed(&mut random).signum());
            let mut o = point(&mut random);
            let mut d = point(&mut random);
            // exactly in the plane of a side: inside it, on its rim, or beside it
            o[axis] = 0.5 * side;
            d[axis] = 0.0;
            ray(o, d)
        })
        .filter(|r| r.d.iter().any(|x| x.abs() > 1e-3))
        .collect();
    for tracer in &mut kernels() {
        for (ray, hit) in rays.iter().zip(closest(tracer, &forest, &rays)) {
            assert!(hit.is_hit(), "{:?} {ray:?}", tracer.kernel());
        }
    }
}
