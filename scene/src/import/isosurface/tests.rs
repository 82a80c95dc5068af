use std::collections::HashMap;

use super::*;
use tables::{EDGE_CORNERS, FACE_CORNERS, TABLES};

/// A generator for tests (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }
    /// In [-1, 1).
    fn signed(&mut self) -> f64 {
        (self.next() >> 11) as f64 * 2f64.powi(-52) - 1.0
    }
}

type Triangle = [[f64; 3]; 3];

/// Marches over samples in memory.
fn march(dims: [usize; 3], samples: &[f64], iso: f64, to_world: Affine) -> Vec<Triangle> {
    let mirrored = to_world.determinant() < 0.0;
    let grid = Grid { width: dims[0], height: dims[1], iso, to_world, mirrored, thorough: false };
    let slices: Vec<Slice> = samples
        .chunks_exact(dims[0] * dims[1])
        .map(|s| {
            let mut slice = Slice::default();
            slice.samples.extend(s);
            slice.mark(dims[0], iso);
            slice
        })
        .collect();
    let mut out = Vec::new();
    for z in 0..dims[2] - 1 {
        let slab = Slab { z, low: &slices[z], high: &slices[z + 1] };
        let mut at = Cursor::default();
        while grid.next_cell(&slab, &mut at, |t| out.push(t)) {}
    }
    out
}

fn fill(dims: [usize; 3], mut f: impl FnMut([f64; 3]) -> f64) -> Vec<f64> {
    let mut samples = Vec::new();
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            for x in 0..dims[0] {
                samples.push(f([x as f64, y as f64, z as f64]));
            }
        }
    }
    samples
}

type Key = [u64; 3];

fn key(p: [f64; 3]) -> Key {
    // -0 and 0 are one place
    p.map(|v| (v + 0.0).to_bits())
}

/// Asserts that each edge is in exactly two triangles, once in each direction, but for edges in the border planes of a
/// grid of `dims` samples (identity placement); gives V - E + F.
fn check_closed(dims: [usize; 3], triangles: &[Triangle]) -> i64 {
    let mut edges: HashMap<[Key; 2], [u32; 2]> = HashMap::new();
    let mut vertices: HashMap<Key, ()> = HashMap::new();
    for t in triangles {
        for k in 0..3 {
            let (a, b) = (key(t[k]), key(t[(k + 1) % 3]));
            assert_ne!(a, b, "a triangle of no area");
            vertices.insert(a, ());
            let (pair, way) = if a < b { ([a, b], 0) } else { ([b, a], 1) };
            edges.entry(pair).or_default()[way] += 1;
        }
    }
    for (pair, count) in &edges {
        let on_border =
            (0..3).any(|k| [0.0, (dims[k] - 1) as f64].iter().any(|&b| pair.iter().all(|p| f64::from_bits(p[k]) == b)));
        let expected = if on_border { count[0] + count[1] == 1 } else { *count == [1, 1] };
        assert!(expected, "edge {:?} in {count:?} triangles", pair.map(|p| p.map(f64::from_bits)));
    }
    vertices.len() as i64 - edges.len() as i64 + triangles.len() as i64
}

fn volume_inside(triangles: &[Triangle]) -> f64 {
    triangles
        .iter()
        .map(|[a, b, c]| {
            let n = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
            (a[0] * n[0] + a[1] * n[1] + a[2] * n[2]) / 6.0
        })
        .sum()
}

/// Every filling of every configuration: inner edges in two triangles and in no face of the cell, outer edges in one.
#[test]
fn fillings_are_patches() {
    let faces_of = |v: u8| -> u8 {
        if v >= 12 {
            return 0;
        }
        let [a, b] = EDGE_CORNERS[v as usize];
        (0..6).filter(|&f| FACE_CORNERS[f].contains(&a) && FACE_CORNERS[f].contains(&b)).fold(0, |m, f| m | 1 << f)
    };
    let boundary = |triangles: &[[u8; 3]]| {
        let mut count: HashMap<[u8; 2], [u32; 2]> = HashMap::new();
        for t in triangles {
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                count.entry([a.min(b), a.max(b)]).or_default()[usize::from(a > b)] += 1;
            }
        }
        let mut outer = Vec::new();
        for (pair, n) in count {
            if faces_of(pair[0]) & faces_of(pair[1]) != 0 {
                assert_eq!(n[0] + n[1], 1, "{pair:?}");
                outer.push((pair, n));
            } else {
                assert_eq!(n, [1, 1], "{pair:?}");
            }
        }
        outer.sort();
        outer
    };
    for (config, case) in TABLES.cases.iter().enumerate() {
        for n in 0..1usize << case.ambiguous.count_ones() {
            let entry = &TABLES.entries[case.first as usize + n];
            let outer = boundary(&entry.triangles);
            assert_eq!(outer.len() as u32, case.edges.count_ones(), "configuration {config}");
            let used = |t: &[[u8; 3]]| t.as_flattened().iter().filter(|&&v| v < 12).fold(0u16, |m, v| m | 1 << v);
            assert_eq!(used(&entry.triangles), case.edges);
            for tube in &entry.tubes {
                assert_eq!(boundary(&tube.triangles), outer, "configuration {config}");
                assert_eq!(used(&tube.triangles), case.edges);
            }
        }
    }
}

/// The numbers of triangles of MC33's cases, as in Lewiner's tables; of those with a tube only 4.2 has to be the same (his
/// lie in the cell's faces).
#[test]
fn counts_are_those_of_mc33() {
    let triangles = |corners: &[u8], decisions: usize| {
        let config = corners.iter().fold(0, |m, c| m | 1usize << c);
        let entry = &TABLES.entries[TABLES.cases[config].first as usize + decisions];
        (entry.triangles.len(), entry.tubes.first().map(|t| t.triangles.len()))
    };
    assert_eq!(triangles(&[0], 0).0, 1); // case 1
    assert_eq!(triangles(&[0, 1], 0).0, 2); // 2
    assert_eq!(triangles(&[0, 3], 0).0, 2); // 3.1
    assert_eq!(triangles(&[0, 3], 1).0, 4); // 3.2
    assert_eq!(triangles(&[0, 7], 0), (2, Some(6))); // 4.1, 4.2
    assert_eq!(triangles(&[0, 1, 2], 0).0, 3); // 5
    assert_eq!(triangles(&[0, 1, 7], 0), (3, Some(7))); // 6.1
    assert_eq!(triangles(&[0, 1, 7], 1).0, 5); // 6.2
    assert_eq!(triangles(&[0, 3, 5], 0).0, 3); // 7.1
    assert_eq!([1, 2, 4].map(|n| triangles(&[0, 3, 5], n).0), [5; 3]); // 7.2
    assert_eq!([3, 5, 6].map(|n| triangles(&[0, 3, 5], n).0), [9; 3]); // 7.3
    assert_eq!(triangles(&[0, 3, 5], 7).0, 5); // 7.4.1
    assert_eq!(triangles(&[0, 1, 2, 3], 0).0, 2); // 8
    assert_eq!(triangles(&[0, 1, 2, 4], 0).0, 4); // 9
    assert_eq!([0, 3].map(|n| triangles(&[0, 1, 6, 7], n).0), [4; 2]); // 10.1.1
    assert_eq!([1, 2].map(|n| triangles(&[0, 1, 6, 7], n).0), [8; 2]); // 10.2
    assert_eq!(triangles(&[0, 1, 2, 5], 0).0, 4); // 11, 14
    assert_eq!([0, 3].map(|n| triangles(&[0, 1, 2, 7], n).0), [4; 2]); // 12.1.1
    assert_eq!([1, 2].map(|n| triangles(&[0, 1, 2, 7], n).0), [8; 2]); // 12.2
    let thirteen: Vec<usize> = (0..64).map(|n| triangles(&[0, 3, 5, 6], n).0).collect();
    // 13.1, 13.2, 13.3, 13.4 and 13.5.1, each both ways; the other decisions no cell makes, but they have a filling
    assert_eq!([0, 63].map(|n| thirteen[n]), [4; 2]);
    assert_eq!([1, 2, 4, 8, 16, 32].map(|n| [thirteen[n], thirteen[63 - n]]), [[6; 2]; 6]);
    for n in [4, 6, 8, 10, 12] {
        assert!(thirteen.contains(&n));
    }
    assert!(thirteen.iter().all(|n| [4, 6, 8, 10, 12].contains(n)));
}

#[test]
fn noise_is_closed() {
    let dims = [18, 17, 16];
    for seed in 0..20 {
        let mut random = Random(seed);
        let samples = fill(dims, |_| random.signed());
        let triangles = march(dims, &samples, 0.03, Affine::IDENTITY);
        check_closed(dims, &triangles);
    }
}

#[test]
fn sphere() {
    let dims = [24, 22, 23];
    let samples = fill(dims, |p| 8.3 - ((p[0] - 11.2).powi(2) + (p[1] - 10.4).powi(2) + (p[2] - 11.1).powi(2)).sqrt());
    let triangles = march(dims, &samples, 0.0, Affine::IDENTITY);
    assert_eq!(check_closed(dims, &triangles), 2);
    // outward: the volume is positive, and that of the ball
    let ball = 4.0 / 3.0 * std::f64::consts::PI * 8.3f64.powi(3);
    assert!((volume_inside(&triangles) / ball - 1.0).abs() < 0.02);
}

/// Every configuration with random values, alone among outsides, and its inverse among insides.
#[test]
fn every_configuration_is_closed() {
    let dims = [4; 3];
    let mut random = Random(5);
    for config in 0..256 {
        for sign in [1.0, -1.0] {
            for _ in 0..20 {
                let samples = fill(dims, |[x, y, z]| {
                    let inner = [x, y, z].iter().all(|&v| v == 1.0 || v == 2.0);
                    let corner = (x - 1.0) as u32 + 2 * (y - 1.0) as u32 + 4 * (z - 1.0) as u32;
                    let inside = inner && config >> corner & 1 == 1;
                    let v = 0.01 + random.signed().abs();
                    if inside { sign * v } else { -sign * v }
                });
                let triangles = march(dims, &samples, 0.0, Affine::IDENTITY);
                assert_eq!(triangles.is_empty(), config == 0);
                // all edges are inner edges, as the border is of one side
                check_closed(dims, &triangles);
                if config != 0 {
                    assert_eq!(volume_inside(&triangles) > 0.0, sign > 0.0);
                }
            }
        }
    }
}

#[test]
fn gyroid() {
    let dims = [30, 28, 26];
    let samples = fill(dims, |p| {
        let [x, y, z] = p.map(|v| 0.45 * v + 0.1);
        libm::sin(x) * libm::cos(y) + libm::sin(y) * libm::cos(z) + libm::sin(z) * libm::cos(x)
    });
    let triangles = march(dims, &samples, 0.1, Affine::IDENTITY);
    assert!(triangles.len() > 10_000);
    check_closed(dims, &triangles);
}

/// Whatever the placement does, the front is outside.
#[test]
fn mirrored_placements_keep_the_front() {
    let dims = [9, 10, 11];
    let samples = fill(dims, |p| 3.2 - p.iter().map(|v| (v - 4.4).powi(2)).sum::<f64>().sqrt());
    let plain = volume_inside(&march(dims, &samples, 0.0, Affine::IDENTITY));
    for map in [
        [[-2.0, 0.0, 0.0, 7.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        [[0.0, 2.0, 0.0, 7.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        [[0.0, 2.0, 0.0, 7.0], [-1.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, -3.0]],
    ] {
        let volume = volume_inside(&march(dims, &samples, 0.0, Affine(map)));
        assert!((volume - 2.0 * plain).abs() < 1e-9 * plain, "{volume} {plain}");
    }
}

/// Samples that equal the value are outside; triangles that shrink to nothing there are in the stream.
#[test]
fn samples_on_the_surface() {
    let dims = [5; 3];
    let samples = fill(dims, |[x, y, z]| if x == 2.0 && y == 2.0 { z - 2.0 } else { -1.0 });
    let triangles = march(dims, &samples, 0.0, Affine::IDENTITY);
    let flat = |t: &Triangle| (0..3).any(|k| key(t[k]) == key(t[(k + 1) % 3]));
    // the tip at (2, 2, 2) is a pyramid of four triangles without a degenerate one, with two insides above it
    assert_eq!(triangles.iter().filter(|t| flat(t)).count(), 0);
    assert_eq!(triangles.iter().filter(|t| t.contains(&[2.0; 3])).count(), 4);
    // one outside that equals the value, among insides: eight triangles of no size
    let samples = fill(dims, |p| if p == [2.0; 3] { 0.0 } else { 1.0 });
    let triangles = march(dims, &samples, 0.0, Affine::IDENTITY);
    assert_eq!(triangles, vec![[[2.0; 3]; 3]; 8]);
}

#[test]
fn samples_that_are_not_finite() {
    let dims = [4; 3];
    for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN] {
        let samples = fill(dims, |p| if p == [1.0; 3] { odd } else { p[0] - 1.5 });
        let triangles = march(dims, &samples, 0.0, Affine::IDENTITY);
        assert!(triangles.len() >= 18);
        let sound = |t: &Triangle| t.as_flattened().iter().all(|v| (0.0..=3.0).contains(v) || v.is_nan());
        assert!(triangles.iter().all(sound));
    }
}

#[test]
fn what_has_no_surface() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    let write = |sizes: &str, data: &[u8]| {
        let text = format!("NRRD0004\ndimension: 3\nsizes: {sizes}\ntype: uchar\nencoding: raw\n\n");
        std::fs::write(&path, [text.as_bytes(), data].concat()).unwrap();
    };
    write("2 4 1", &[0; 8]);
    let message = IsoSurfaceSource::new(&path, 1.0).unwrap_err().to_string();
    assert!(message.contains("2 x 4 x 1 samples hold no surface"), "{message}");
    write("2 2 2", &[0, 0, 0, 0, 9, 9, 9, 9]);
    for iso in [f64::NAN, f64::INFINITY] {
        assert!(IsoSurfaceSource::new(&path, iso).unwrap_err().to_string().contains("is not a number"));
    }
    for (iso, count) in [(4.0, 2), (9.0, 0), (-1.0, 0)] {
        let source = IsoSurfaceSource::new(&path, iso).unwrap();
        let mut records = Vec::new();
        assert_eq!(source.open().unwrap().next(&mut records, 100).unwrap(), count);
    }
}

/// Whenever the inside of a cell joins what its surface leaves apart, it joins two regions, and there is one filling with a
/// tube for them; and following planes along another axis finds the same.
#[test]
fn tubes_are_there() {
    let regions = |region: &[u8; 8]| region.iter().enumerate().filter(|(c, r)| *c == **r as usize).count();
    let mut random = Random(7);
    let mut found = 0;
    for _ in 0..1_000_000 {
        let d: [f64; 8] = std::array::from_fn(|_| random.signed());
        let (entry, _) = march::classify(&d);
        let mut region = entry.region;
        interior::connect(&d, &mut region);
        // x, y, z -> y, z, x
        let turn = |c: usize| c >> 1 | (c & 1) << 2;
        let turned: [f64; 8] = std::array::from_fn(|c| d[turn(c)]);
        let mut turned_region = march::classify(&turned).0.region;
        interior::connect(&turned, &mut turned_region);
        assert_eq!(regions(&region), regions(&turned_region), "{d:?}");
        let taken = entry.tubes.iter().filter(|t| region[t.joins[0] as usize] == region[t.joins[1] as usize]).count();
        assert_eq!(regions(&entry.region) - regions(&region), taken, "{d:?}");
        assert!(taken <= 1);
        found += taken;
    }
    assert!(found > 1000);
}

/// The plain twin of decider and interior test: samples of the interpolant on a fine grid. Two neighbouring samples of one sign
/// are connected, as the interpolant is linear between them; so what is connected there must be connected here. The
/// other way round thin connections are missed by the grid: few.
#[test]
fn connections_are_those_of_the_interpolant() {
    const N: usize = 24;
    let mut random = Random(11);
    let (mut both, mut only_here) = (0, 0);
    let mut cells = 0;
    while cells < 800 {
        let d: [f64; 8] = std::array::from_fn(|_| random.signed());
        let entry = march::classify(&d).0;
        if entry.tubes.is_empty() {
            continue;
        }
        cells += 1;
        let mut region = entry.region;
        interior::connect(&d, &mut region);
        let at = |p: [usize; 3]| (p[2] * (N + 1) + p[1]) * (N + 1) + p[0];
        let inside = fill([N + 1; 3], |p| {
            let t = p.map(|v| v / N as f64);
            let weight = |c: usize| (0..3).map(|k| if c >> k & 1 == 1 { t[k] } else { 1.0 - t[k] }).product::<f64>();
            (0..8).map(|c| d[c] * weight(c)).sum()
        });
        let mut group = vec![usize::MAX; inside.len()];
        for corner in 0..8usize {
            let start = [0, 1, 2].map(|k| (corner >> k & 1) * N);
            if group[at(start)] != usize::MAX {
                continue;
            }
            let mut todo = vec![start];
            group[at(start)] = corner;
            while let Some(p) = todo.pop() {
                for k in 0..3 {
                    for next in [p[k].wrapping_sub(1), p[k] + 1] {
                        let mut q = p;
                        q[k] = next;
                        if next <= N && group[at(q)] == usize::MAX && (inside[at(q)] > 0.0) == (inside[at(p)] > 0.0) {
                            group[at(q)] = corner;
                            todo.push(q);
                        }
                    }
                }
            }
        }
        for a in 0..8usize {
            for b in a + 1..8 {
                if (d[a] > 0.0) != (d[b] > 0.0) {
                    continue;
                }
                let grid = [a, b].map(|c| group[at([0, 1, 2].map(|k| (c >> k & 1) * N))]);
                match (grid[0] == grid[1], region[a] == region[b]) {
                    (true, here) => {
                        assert!(here, "{a} {b} {d:?}");
                        both += 1;
                    }
                    (false, true) => only_here += 1,
                    (false, false) => {}
                }
            }
        }
    }
    assert!(only_here * 50 < both, "{only_here} {both}");
}

/// The head of shared/data: the count of scikit-image 0.26 (78,736).
#[test]
fn head() {
    let data =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/ct-headsq-quarter/ct-headsq-quarter.tar.xz");
    if !data.exists() {
        eprintln!("absent, not tested: ../shared/data/ct-headsq-quarter");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let tar = std::process::Command::new("tar").arg("xf").arg(&data).arg("-C").arg(folder.path()).status();
    if !tar.is_ok_and(|s| s.success()) {
        eprintln!("tar with xz is absent, not tested: ../shared/data/ct-headsq-quarter");
        return;
    }
    let source = IsoSurfaceSource::new(&folder.path().join("ct-headsq-quarter/quarter.nhdr"), 1150.5).unwrap();
    let mut stream = source.open().unwrap();
    let mut records = Vec::new();
    // any size of portions
    let mut max = 1;
    while stream.next(&mut records, max).unwrap() > 0 {
        max = max % 40 + 1;
    }
    assert!((records.len() as f64 / 78_736.0 - 1.0).abs() < 0.001, "{}", records.len());
    assert_eq!(stream.bytes_read(), 93 * 8192);
    let bounds = source.world_box();
    for r in &records {
        let Record::Triangle(t) = r else { panic!("not a triangle") };
        assert!(t.p.iter().all(|p| (0..3).all(|k| bounds[0][k] <= p[k] && p[k] <= bounds[1][k])));
    }
    let mut again = Vec::new();
    source.open().unwrap().next(&mut again, usize::MAX >> 1).unwrap();
    assert_eq!(records, again);
}
