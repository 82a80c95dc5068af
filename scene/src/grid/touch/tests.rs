use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

/// Integer coordinates in units of 1/8 cell; the lattice has `CELLS` cells of width 1 along each axis.
const CELLS: i64 = 6;
const PER_CELL: i64 = 8;
/// Boxes of the exact test are in units of 1 / (8 FINE) cell, so that they can be shrunk by a little.
const FINE: i64 = 1024;

fn lattice() -> Lattice {
    Lattice::new(CELLS as u32, [0.0; 3], [CELLS as f32; 3]).unwrap()
}

/// Triangle against box, closed, in exact integers.
fn exact_overlap(p: &[[i64; 3]; 3], lo: [i64; 3], hi: [i64; 3]) -> bool {
    let p = p.map(|v| v.map(i128::from));
    // twice the centre and twice the half width, and twice the vertices
    let c: [i128; 3] = std::array::from_fn(|a| i128::from(lo[a] + hi[a]));
    let h: [i128; 3] = std::array::from_fn(|a| i128::from(hi[a] - lo[a]));
    let v = p.map(|p| -> [i128; 3] { std::array::from_fn(|a| 2 * p[a] - c[a]) });
    let edge = |i: usize, j: usize| -> [i128; 3] { std::array::from_fn(|a| p[j][a] - p[i][a]) };
    let cross =
        |a: [i128; 3], b: [i128; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let edges = [edge(0, 1), edge(1, 2), edge(2, 0)];
    let units = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    let mut axes = vec![cross(edges[0], edges[1])];
    axes.extend(units);
    for e in edges {
        axes.extend(units.map(|u| cross(u, e)));
    }
    axes.iter().all(|n| {
        let dots = v.map(|v| n[0] * v[0] + n[1] * v[1] + n[2] * v[2]);
        let reach = n[0].abs() * h[0] + n[1].abs() * h[1] + n[2].abs() * h[2];
        dots.iter().min().unwrap() <= &reach && dots.iter().max().unwrap() >= &-reach
    })
}

fn vertex() -> impl Strategy<Value = [i64; 3]> {
    let part = || {
        prop_oneof![
            3 => 0..=CELLS * PER_CELL,
            // on planes
            1 => (0..=CELLS).prop_map(|k| k * PER_CELL),
        ]
    };
    (part(), part(), part()).prop_map(|(x, y, z)| [x, y, z])
}

/// Large, small, flat and thin triangles.
fn triangle() -> impl Strategy<Value = [[i64; 3]; 3]> {
    let any = (vertex(), vertex(), vertex()).prop_map(|(a, b, c)| [a, b, c]);
    let small = (vertex(), vertex(), vertex()).prop_map(|(a, b, c)| {
        let near = |v: [i64; 3]| std::array::from_fn(|i| (a[i] + v[i] % 9 - 4).clamp(0, CELLS * PER_CELL));
        [a, near(b), near(c)]
    });
    let flat = (vertex(), vertex(), vertex(), 0usize..3).prop_map(|(a, mut b, mut c, axis)| {
        (b[axis], c[axis]) = (a[axis], a[axis]);
        [a, b, c]
    });
    prop_oneof![any, small, flat]
}

fn real(p: &[[i64; 3]; 3]) -> [[f64; 3]; 3] {
    p.map(|v| v.map(|x| x as f64 / PER_CELL as f64))
}

fn found(p: &[[f64; 3]; 3]) -> BTreeSet<[u32; 3]> {
    let mut cells = BTreeSet::new();
    triangle_cells(&lattice(), p, &mut |at| assert!(cells.insert(at), "{at:?} twice"));
    cells
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Against the exact test on every cell: none of the cells that it cuts is left out, none that it misses is named.
    #[test]
    fn cells_are_those_of_exact_arithmetic(p in triangle()) {
        let cells = found(&real(&p));
        let fine = p.map(|v| v.map(|x| x * FINE));
        for z in 0..CELLS {
            for y in 0..CELLS {
                for x in 0..CELLS {
                    let at = [x, y, z];
                    let named = cells.contains(&at.map(|k| k as u32));
                    let lo = at.map(|k| k * PER_CELL * FINE);
                    let hi = lo.map(|k| k + PER_CELL * FINE);
                    if named {
                        prop_assert!(exact_overlap(&fine, lo, hi), "{:?} is missed by far", at);
                    } else {
                        // a cell that is only touched from outside may be left to its neighbour
                        let inside = exact_overlap(&fine, lo.map(|k| k + 1), hi.map(|k| k - 1));
                        prop_assert!(!inside, "{:?} is left out", at);
                    }
                }
            }
        }
    }

    /// Every point lies in a named cell, in the box of what is inside it; and that box is tight.
    #[test]
    fn points_are_in_the_boxes_of_their_cells(p in triangle()) {
        let lattice = lattice();
        let q = real(&p);
        let cells = found(&q);
        let whole = bounds_of(&q);
        let mut boxes = std::collections::BTreeMap::new();
        for &at in &cells {
            let cell = lattice.cell_box(at);
            if let Some((lo, hi)) = triangle_in_cell(&q, &cell, lattice.magnitude()) {
                for a in 0..3 {
                    prop_assert!(lo[a] >= cell.0[a].max(whole.0[a]) && hi[a] <= cell.1[a].min(whole.1[a]));
                }
                boxes.insert(at, (lo, hi));
            }
        }
        // barycentric coordinates k / 64 of eighths are exact
        for i in 0..=64u32 {
            for j in 0..=64 - i {
                let (u, v) = (f64::from(i) / 64.0, f64::from(j) / 64.0);
                let x: [f64; 3] = std::array::from_fn(|a| q[0][a] * (1.0 - u - v) + q[1][a] * u + q[2][a] * v);
                let at = std::array::from_fn(|a| lattice.number(a, x[a]));
                prop_assert!(cells.contains(&at));
                let Some((lo, hi)) = boxes.get(&at) else { panic!("no box at {at:?}") };
                for a in 0..3 {
                    prop_assert!(lo[a] <= x[a] && x[a] <= hi[a]);
                }
            }
        }
        // tight: exact arithmetic finds the triangle at every face of a box, to 1 / 8192 of a cell
        let fine = p.map(|v| v.map(|x| x * FINE));
        let scale = (PER_CELL * FINE) as f64;
        for (at, (lo, hi)) in boxes {
            let (a, b) = (lo.map(|x| (x * scale).floor() as i64), hi.map(|x| (x * scale).ceil() as i64));
            for axis in 0..3 {
                let (mut bottom, mut top) = (b, a);
                bottom[axis] = a[axis] + 1;
                top[axis] = b[axis] - 1;
                prop_assert!(exact_overlap(&fine, a, bottom) && exact_overlap(&fine, top, b), "{:?}", at);
            }
        }
    }

    /// Vertices anywhere in f32: points of the triangle lie in named cells and their boxes but for rounding of the points.
    #[test]
    fn points_of_any_triangle_are_covered(
        p in prop::array::uniform3(prop::array::uniform3(0.0f32..6.0)), thin in 0.0f32..1.0, power in 0i32..40,
    ) {
        let lattice = lattice();
        let mut q = p.map(|v| v.map(f64::from));
        // drawn towards a line: slivers
        let squeeze = f64::from(thin) * 2f64.powi(-power);
        for a in 0..3 {
            let on_edge = 0.5 * (q[0][a] + q[1][a]);
            q[2][a] = f64::from((on_edge + squeeze * (q[2][a] - on_edge)) as f32);
        }
        let cells = found(&q);
        for i in 0..=40u32 {
            for j in 0..=40 - i {
                let (u, v) = (f64::from(i) / 40.0, f64::from(j) / 40.0);
                let x: [f64; 3] = std::array::from_fn(|a| q[0][a] + (q[1][a] - q[0][a]) * u + (q[2][a] - q[0][a]) * v);
                let near = |t: f64| (t * 1e12).abs() < 1e12 * 1e-13 * 6.0;
                let covered = cells.iter().any(|&at| {
                    let cell = lattice.cell_box(at);
                    triangle_in_cell(&q, &cell, lattice.magnitude()).is_some_and(|(lo, hi)| {
                        (0..3).all(|a| (x[a] >= lo[a] || near(lo[a] - x[a])) && (x[a] <= hi[a] || near(x[a] - hi[a])))
                    })
                });
                prop_assert!(covered);
            }
        }
    }

    #[test]
    fn spheres_are_in_the_cells_of_their_surface(
        c in prop::array::uniform3(2.0f64..4.0), r in 0.01f64..2.0, points in prop::collection::vec(prop::array::uniform3(-1.0f64..1.0), 200),
    ) {
        let lattice = lattice();
        let (c, r) = (c.map(|x| f64::from(x as f32)), f64::from(r as f32));
        let mut cells = BTreeSet::new();
        sphere_cells(&lattice, c, r, &mut |at| assert!(cells.insert(at)));
        for d in points {
            let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
            if length < 1e-3 {
                continue;
            }
            let x: [f64; 3] = std::array::from_fn(|a| c[a] + r * d[a] / length);
            let covered = cells.iter().any(|&at| {
                let (lo, hi) = sphere_in_cell(c, r, &lattice.cell_box(at)).unwrap();
                (0..3).all(|a| x[a] >= lo[a] - 1e-12 && x[a] <= hi[a] + 1e-12)
            });
            prop_assert!(covered);
        }
        // none that the surface does not reach
        for at in cells {
            let (lo, hi) = lattice.cell_box(at);
            let (mut near, mut far) = (0.0, 0.0);
            for a in 0..3 {
                near += (c[a] - c[a].clamp(lo[a], hi[a])).powi(2);
                far += (c[a] - lo[a]).abs().max((c[a] - hi[a]).abs()).powi(2);
            }
            prop_assert!(near.sqrt() <= r + 1e-6 && far.sqrt() >= r - 1e-6);
        }
    }
}

#[test]
fn a_slanted_wall_is_clipped() {
    // the wall x + y = 3 in the cell [1,2] x [1,2]: all of it; in [0,1] x [2,3]: all; in [1,2] x [2,3]: its corner only
    let p = [[0.0, 3.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 6.0]];
    let part = |at| triangle_in_cell(&p, &lattice().cell_box(at), 6.0);
    let (lo, hi) = part([1, 1, 0]).unwrap();
    assert!((lo[0] - 1.0).abs() < 1e-9 && (hi[0] - 2.0).abs() < 1e-9 && (lo[1] - 1.0).abs() < 1e-9);
    let (lo, hi) = part([0, 2, 0]).unwrap();
    assert!((lo[1] - 2.0).abs() < 1e-9 && (hi[1] - 3.0).abs() < 1e-9 && (hi[0] - 1.0).abs() < 1e-9);
    assert!(part([2, 2, 0]).is_none() && part([0, 0, 0]).is_none());
    let cells = found(&p);
    assert!(cells.contains(&[1, 1, 0]) && !cells.contains(&[2, 2, 0]) && !cells.contains(&[0, 0, 0]));
}
