//! Closed meshes of every size, near the origin and far from it: no ray gets out of one.

use rayherd_render::bvh::{Forest, Kernel};
use rayherd_render::ray::Ray;
use rayherd_tests::mutation::Random;

use super::numbers::*;
use super::scenes::{self, Wide};
use rayherd_scene::prepare::{Cut, PrepareSettings};

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
    wide(form, size, center).into_iter().map(|t| t.map(|p| p.map(|x| x as f32))).collect()
}

/// The same before it is rounded.
fn wide(form: Form, size: f64, center: [f64; 3]) -> Vec<Wide> {
    let at = |face: usize, i: usize, j: usize| -> [f64; 3] {
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
        std::array::from_fn(|c| center[c] + size * p[c])
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
                        let what = format!("{form:?} {size} x{distance}");
                        traced += must_hit(&what, &forest, &rays, each * cases);
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
    let total = rays(20_000);
    let (mut left, mut traced) = (total, 0);
    while left > 0 {
        let n = left.min(1 << 16);
        left -= n;
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
        traced += must_hit("within a face", &forest, &rays, total);
    }
    println!("{traced} rays, none got out");
}

/// Traces rays, of a test of `total`, in every kernel, closest (in packets too, which say the same) and any; how many were traced. None may get out.
fn must_hit(what: &str, forest: &Forest, all: &[Ray], total: u64) -> u64 {
    for tracer in &mut kernels() {
        let rays = if tracer.kernel() == Kernel::Scalar { &all[..plain_share(total, all.len())] } else { all };
        let hits = closest(tracer, forest, rays);
        let occluded = any(tracer, forest, rays);
        let together = together(tracer.kernel(), forest, rays);
        assert!(hits.iter().zip(&together).all(|(a, b)| answer(forest, a) == answer(forest, b)), "{what}: packets");
        let out = hits.iter().zip(&occluded).filter(|(hit, any)| !hit.is_hit() || !**any).count();
        let first = rays.iter().zip(&hits).find(|(_, hit)| !hit.is_hit());
        assert!(out == 0, "{:?} {what}: {out} of {} rays got out, first {first:?}", tracer.kernel(), rays.len());
    }
    all.len() as u64
}

/// Sources in f64 up to a million sizes from their origin, on the whole way: recentred, rounded, cut, with copies, as blocks.
#[test]
fn nothing_gets_out_of_a_mesh_far_from_its_origin() {
    let sizes = [1e-6, 1e-3, 1.0, 1e3, 1e6];
    let distances = [1e3, 1e6];
    let forms = [Form::Cube, Form::Bumpy, Form::Disk];
    let cases = (sizes.len() * distances.len() * forms.len()) as u64;
    let each = rays(60_000).div_ceil(cases);
    let mut random = Random::new(43);
    let mut traced = 0;
    for form in forms {
        for size in sizes {
            for distance in distances {
                // blocks hold coordinates below 2^40; recentring needs the source's to be below 2^39
                let distance = f64::min(distance, 5e11 / size);
                let center = [0.48, -0.6, 0.64].map(|x| x * distance * size);
                let source = wide(form, size, center);
                let description = scenes::under_a_sky(vec![scenes::shape(&source, 0, None)], Some([1.0; 3]));
                let settings =
                    PrepareSettings { cut: Cut::Splits(1 + random.below(9) as u32), ..PrepareSettings::default() };
                let (manifest, objects) = scenes::prepared(&description, &settings);
                let forest = scenes::whole(&manifest, &objects);
                let triangles = scenes::rounded(&source, manifest.offset);
                let mut left = each;
                while left > 0 {
                    let n = left.min(1 << 16);
                    left -= n;
                    let rays: Vec<Ray> =
                        (0..n).filter_map(|_| from_inside(&mut random, &triangles, form, size, [0.0; 3])).collect();
                    traced += must_hit(&format!("{form:?} {size} x{distance}"), &forest, &rays, each * cases);
                }
            }
        }
    }
    println!("{traced} rays, none got out");
    assert!(traced > each * cases / 2, "{traced}");
}

/// A mesh in a scene that is up to 3e5 times as large: f32 has a hundred numbers for it, and boxes tell little. (Further on rounding leaves triangles no area,
/// which are skipped.)
#[test]
fn nothing_gets_out_of_a_small_mesh_in_a_large_scene() {
    // where boxes tell little, every ray is tested against thousands of triangles: a thousandth of what others trace
    let total = rays(2_000_000) / 1000;
    let each = total.div_ceil(2);
    let mut random = Random::new(44);
    let mut traced = 0;
    for distance in [3e4, 3e5] {
        let source = wide(Form::Bumpy, 1.0, [0.48, -0.6, 0.64].map(|x| x * distance));
        let mut all = source.clone();
        // so that the box's centre is far away
        all.push([[-distance, 0.0, 0.0], [-distance, 1.0, 0.0], [-distance, 0.0, 1.0]]);
        let description = scenes::under_a_sky(vec![scenes::shape(&all, 0, None)], Some([1.0; 3]));
        let settings = PrepareSettings { cut: Cut::Splits(3), ..PrepareSettings::default() };
        let (manifest, objects) = scenes::prepared(&description, &settings);
        let forest = scenes::whole(&manifest, &objects);
        let triangles = scenes::rounded(&source, manifest.offset);
        let center = std::array::from_fn(|a| [0.48, -0.6, 0.64][a] * distance - manifest.offset[a]);
        println!("at {distance}: {:?}", manifest.counts);
        let mut left = each;
        while left > 0 {
            let n = left.min(1 << 16);
            left -= n;
            let rays: Vec<Ray> =
                (0..n).filter_map(|_| from_inside(&mut random, &triangles, Form::Bumpy, 1.0, center)).collect();
            traced += must_hit(&format!("x{distance}"), &forest, &rays, total);
        }
    }
    println!("{traced} rays, none got out");
}
