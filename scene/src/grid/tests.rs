use proptest::prelude::*;
use rayherd_render::ray::Ray;

use super::lattice::{round_down, round_up};
use super::*;

/// A grid from a seed: random occupancy, tight boxes and owners.
fn random_grid(seed: u64, subdiv: u32, splits: u32, fill: f64, (inner, lo, hi): Boxes) -> Option<Grid> {
    let mut state = seed;
    let mut next = move || {
        // SplitMix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    let lattice = Lattice::around(subdiv, inner, lo, hi).unwrap();
    let mut cells = Vec::new();
    for index in 0..lattice.len() as u32 {
        let Some(at) = lattice.coordinates(index) else { continue };
        if next() >= fill {
            continue;
        }
        let (a, b) = lattice.cell_box_f32(at);
        let mut cell = CellData { index, lo: a, hi: b, primitives: 1, owners: vec![] };
        for axis in 0..3 {
            let (mut s, mut t) = (next(), next());
            if s > t {
                std::mem::swap(&mut s, &mut t);
            }
            // a third of the boxes fill their cell
            if next() > 0.33 {
                let w = f64::from(b[axis]) - f64::from(a[axis]);
                cell.lo[axis] = round_down(f64::from(a[axis]) + s * w).clamp(a[axis], b[axis]);
                cell.hi[axis] = round_up(f64::from(a[axis]) + t * w).clamp(cell.lo[axis], b[axis]);
            }
        }
        let count = 1 + (next() * 2.5) as u32;
        let mut owners: Vec<u32> = (0..count).map(|_| (next() * f64::from(splits)) as u32).collect();
        owners.sort_unstable();
        owners.dedup();
        cell.owners = owners;
        cells.push(cell);
    }
    let [inner_lo, inner_hi] = inner;
    (!cells.is_empty()).then(|| Grid::new(&GridData { subdiv, inner_lo, inner_hi, lo, hi, cells }, splits).unwrap())
}

/// How the next cell is found.
#[derive(Clone, Copy, PartialEq)]
enum Way {
    /// By a tree of the boxes.
    Boxes,
    /// From plane to plane of the lattice.
    Planes,
    /// By asking each cell.
    Naive,
}

fn sequence(grid: &Grid, ray: &Ray, resident: &SplitSet, way: Way) -> Vec<(u32, f64)> {
    let mut outside = grid.outside(resident);
    outside.boxes = outside.boxes.filter(|_| way == Way::Boxes);
    let mut out = Vec::new();
    let mut from = Progress::START;
    loop {
        let next = if way == Way::Naive {
            grid.next_foreign_naive(ray, from, resident)
        } else {
            grid.next_foreign(ray, from, &outside)
        };
        let Some(next) = next else { return out };
        assert_eq!(next.owners, grid.owners(next.cell));
        out.push((next.cell, next.t));
        from = next.progress;
        assert!(out.len() <= grid.occupied() as usize, "the walk goes in circles");
    }
}

/// Exact (unpadded, f64) interval of the ray in a box.
fn exact_interval(ray: &Ray, lo: [f32; 3], hi: [f32; 3], widen: f64) -> Option<(f64, f64)> {
    let (mut near, mut far) = (f64::from(ray.tmin).max(0.0), f64::from(ray.tmax));
    for a in 0..3 {
        let (o, d) = (f64::from(ray.o[a]), f64::from(ray.d[a]));
        let (l, h) = (f64::from(lo[a]) - widen, f64::from(hi[a]) + widen);
        if d == 0.0 {
            if o < l || o > h {
                return None;
            }
            continue;
        }
        let (p, q) = ((l - o) / d, (h - o) / d);
        near = near.max(p.min(q));
        far = far.min(p.max(q));
    }
    (near <= far).then_some((near, far))
}

/// Coordinates that hit planes, zeros, and far away places often.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![
        4 => -3.0f32..3.0,
        2 => (-12i32..12).prop_map(|k| k as f32 / 4.0),
        1 => Just(0.0f32),
        1 => -1000.0f32..1000.0,
    ]
}

fn direction() -> impl Strategy<Value = [f32; 3]> {
    let part = || prop_oneof![3 => -1.0f32..1.0, 2 => Just(0.0f32), 1 => Just(-0.0f32), 1 => Just(1.0f32), 1 => -1e-20f32..1e-20];
    (part(), part(), part()).prop_map(|(x, y, z)| [x, y, z])
}

fn ray() -> impl Strategy<Value = Ray> {
    let tmax = prop_oneof![2 => Just(f32::INFINITY), 1 => 0.0f32..5.0, 1 => Just(0.0f32)];
    let tmin = prop_oneof![3 => Just(0.0f32), 1 => -1.0f32..2.0];
    ((coordinate(), coordinate(), coordinate()), direction(), tmin, tmax).prop_map(|(o, d, tmin, tmax)| Ray {
        o: [o.0, o.1, o.2],
        d,
        tmin,
        tmax,
    })
}

/// Inner box, lower and upper corner.
type Boxes = ([[f32; 3]; 2], [f32; 3], [f32; 3]);

fn boxes() -> impl Strategy<Value = Boxes> {
    let plain = |lo: [f32; 3], hi: [f32; 3]| Just(([lo, hi], lo, hi));
    prop_oneof![
        2 => plain([-2.0f32; 3], [2.0f32; 3]),
        1 => plain([-2.0, -1.0, 0.5], [2.0, -1.0, 0.75]),
        1 => plain([-1.0, -1e-6, -2.0], [1.0, 1e-6, 2.0]),
        1 => plain([0.1; 3], [0.1; 3]),
        // layers around, on one side, around a flat box, around a point
        2 => Just(([[-1.0, -0.5, 0.25], [1.0, 0.5, 1.5]], [-3.0; 3], [3.0; 3])),
        1 => Just(([[-2.0, -2.0, -2.0], [2.0, 0.5, 2.0]], [-2.0; 3], [2.0, 2.75, 2.0])),
        1 => Just(([[-1.0, 0.0, -1.0], [1.0, 0.0f32.next_up(), 1.0]], [-1.0, -0.5, -1.0], [1.0, 2.0, 1.0])),
        1 => Just(([[0.5; 3], [0.5; 3]], [-1.0, -1.0, 0.5], [1.0, 0.5, 2.0])),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(3000))]

    #[test]
    fn the_walk_is_its_naive_twin_and_holds_every_exact_cell(
        seed: u64, subdiv in 1u32..12, boxes in boxes(), fill in 0.05f64..1.0, ray in ray(), inside: u32,
    ) {
        let splits = 5;
        let Some(grid) = random_grid(seed, subdiv, splits, fill, boxes) else { return Ok(()) };
        let resident: SplitSet = (0..splits).filter(|s| inside >> s & 1 == 1).collect();
        let walk = sequence(&grid, &ray, &resident, Way::Boxes);
        prop_assert_eq!(&walk, &sequence(&grid, &ray, &resident, Way::Naive));
        prop_assert_eq!(&walk, &sequence(&grid, &ray, &resident, Way::Planes));
        prop_assert!(walk.windows(2).all(|w| (w[0].1, w[0].0) < (w[1].1, w[1].0)));
        let reach = ray.o.iter().fold(3.0f64, |m, x| m.max(f64::from(x.abs())));
        for cell in 0..grid.occupied() {
            let (lo, hi) = grid.bounds(cell).unwrap();
            let foreign = grid.owners(cell).iter().any(|&s| !resident.contains(s));
            let visited = walk.iter().find(|w| w.0 == cell);
            if ray.d == [0.0; 3] {
                prop_assert!(visited.is_none());
                continue;
            }
            if let Some((enter, _)) = exact_interval(&ray, lo, hi, 0.0).filter(|_| foreign) {
                prop_assert!(visited.is_some_and(|w| w.1 <= enter), "cell {} at {} is missed", cell, enter);
            }
            if visited.is_some() {
                prop_assert!(foreign && exact_interval(&ray, lo, hi, reach * 4e-6).is_some(), "cell {} is far", cell);
            }
        }
        if grid.covered_by(&resident) {
            prop_assert!(walk.is_empty());
        }
    }

    #[test]
    fn numbers_and_planes_agree(subdiv in 1u32..=256, x in -4.0f64..4.0, at_plane in 0u32..600, (inner, lo, hi) in boxes(), axis in 0usize..3) {
        let lattice = Lattice::around(subdiv, inner, lo, hi).unwrap();
        // half of the time a plane itself
        let x = if at_plane < 300 { lattice.plane(axis, at_plane % (lattice.count(axis) + 1)) } else { x };
        let k = lattice.number(axis, x);
        prop_assert!(k < lattice.count(axis));
        let (l, h) = lattice.bounds();
        if x >= l[axis] && x < h[axis] {
            prop_assert!(lattice.plane(axis, k) <= x && x < lattice.plane(axis, k + 1));
        }
        prop_assert!(lattice.nearby(axis, x).abs_diff(k) <= 1);
        let planes: Vec<f64> = (0..=lattice.count(axis)).map(|k| lattice.plane(axis, k)).collect();
        prop_assert!(planes.windows(2).all(|w| w[0] <= w[1]) && planes[0] == l[axis] && planes.last() == Some(&h[axis]));
        let y = x as f32;
        let mut at = inner[0];
        at[axis] = y;
        if f64::from(y) >= l[axis] && f64::from(y) < h[axis] && (0..3).all(|a| inner[0][a] < inner[1][a]) {
            let k = lattice.number(axis, f64::from(y));
            let outside = lattice.plane(axis, k + 1) <= lattice.inner().0[axis] || lattice.plane(axis, k) >= lattice.inner().1[axis];
            prop_assert_eq!(lattice.reaches_out(&at, &at), outside);
        }
    }

    #[test]
    fn a_split_set_is_a_set(splits in prop::collection::btree_set(0u32..300, 0..40)) {
        let set: SplitSet = splits.iter().copied().collect();
        prop_assert_eq!(set.iter().collect::<Vec<_>>(), splits.iter().copied().collect::<Vec<_>>());
        prop_assert_eq!(set.len() as usize, splits.len());
        prop_assert!((0..400).all(|s| set.contains(s) == splits.contains(&s)));
    }
}

#[test]
fn rays_that_are_none_end_quietly() {
    let cell = CellData { index: 0, lo: [-2.0; 3], hi: [2.0; 3], primitives: 1, owners: vec![0] };
    let grid = Grid::new(
        &GridData {
            subdiv: 1,
            inner_lo: [-2.0; 3],
            inner_hi: [2.0; 3],
            lo: [-2.0; 3],
            hi: [2.0; 3],
            cells: vec![cell],
        },
        1,
    )
    .unwrap();
    let all = grid.everywhere();
    let good = Ray { o: [0.0; 3], tmin: 0.0, d: [1.0, 0.0, 0.0], tmax: f32::INFINITY };
    assert!(grid.first_cell(&good).is_some());
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for ray in [
            Ray { o: [bad, 0.0, 0.0], ..good },
            Ray { d: [bad, 0.0, 0.0], ..good },
            Ray { d: [0.0; 3], ..good },
            Ray { tmax: f32::NAN, ..good },
            Ray { tmin: f32::INFINITY, ..good },
        ] {
            assert_eq!(grid.next_foreign(&ray, Progress::START, all), None, "{ray:?}");
        }
    }
    // a progress that was made up starts at the beginning
    assert_eq!(grid.next_foreign(&good, Progress(u32::MAX), all), grid.first_cell(&good));
}

#[test]
fn bad_grids_are_refused() {
    let good = GridData {
        subdiv: 2,
        inner_lo: [0.0; 3],
        inner_hi: [2.0; 3],
        lo: [0.0; 3],
        hi: [2.0; 3],
        cells: vec![
            CellData { index: 0, lo: [0.0; 3], hi: [1.0; 3], primitives: 1, owners: vec![0, 1] },
            CellData { index: 7, lo: [1.5; 3], hi: [2.0; 3], primitives: 1, owners: vec![1] },
        ],
    };
    assert_eq!(Grid::new(&good, 2).unwrap().sharing(0), [0, 1]);
    let changes: Vec<fn(&mut GridData)> = vec![
        |g| g.subdiv = 0,
        |g| g.subdiv = 257,
        |g| g.subdiv = 1,
        |g| g.lo[0] = f32::NAN,
        |g| g.hi[0] = f32::INFINITY,
        |g| g.hi[0] = -1.0,
        |g| g.inner_lo[0] = -1.0,
        |g| g.inner_hi[0] = 2.5,
        |g| g.inner_hi[0] = -1.0,
        |g| g.inner_lo[0] = f32::NAN,
        |g| g.cells.clear(),
        |g| g.cells.swap(0, 1),
        |g| g.cells[1].index = 8,
        |g| g.cells[1].index = 0,
        |g| g.cells[1].lo[0] = 0.5,
        |g| g.cells[1].hi[0] = 1.4,
        |g| g.cells[1].hi[0] = f32::NAN,
        |g| g.cells[1].owners.clear(),
        |g| g.cells[1].owners[0] = 2,
        |g| g.cells[0].owners.reverse(),
        |g| g.cells[0].owners[1] = 0,
    ];
    for (i, change) in changes.iter().enumerate() {
        let mut bad = good.clone();
        change(&mut bad);
        assert!(Grid::new(&bad, 2).is_err(), "change {i}");
    }
}
