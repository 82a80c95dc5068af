//! Marching cubes tables with the topology of the trilinear interpolant, generated at the first use.
//!
//! How: a cell has 8 corners, each inside (above the value) or outside: 256 configurations. On each face of the cell the
//! crossed edges are joined by directed segments, inside on their left seen from outside the cell. A face with two
//! diagonal inside corners is ambiguous; the asymptotic decider (G. M. Nielson, B. Hamann, "The Asymptotic Decider", Vis.
//! 1991) says whether its insides are joined, so a table entry is (configuration, decision per ambiguous face). The segments
//! close to loops, since each crossed edge has one segment in and one out. Each loop becomes a disc; or, when the interior
//! test ([`super::interior`]) finds that two regions which are apart on the cell's surface meet inside it, their
//! loops are the ends of a tube (E. Chernyaev, "Marching Cubes 33", CERN CN 95-17; T. Lewiner et al., "Efficient
//! Implementation of Marching Cubes' Cases with Topological Guarantees", JGT 8(2), 2003). These are MC33's cases,
//! without their symmetries, and the triangle counts of each case are Lewiner's.
//!
//! Discs and tubes are triangulated with the shortest inner edges. No inner edge may lie in a face of the cell: the
//! neighbouring cell could have the same one, and four triangles would meet there. Where that cannot be had, a vertex in the
//! middle of the disc serves (Lewiner's thirteenth vertex).
//!
//! Numbers: corner `x + 2y + 4z`; edges along x are `0 + y + 2z`, along y `4 + x + 2z`, along z `8 + x + 2y`;
//! face `2 axis + side`.

use std::sync::LazyLock;

/// Most triangles that one cell yields (checked when the tables are made).
pub const MAX_TRIANGLES: usize = 16;
/// Most vertices in the middle of a disc that one cell has (checked when the tables are made).
pub const MAX_CENTERS: usize = 2;

/// Corners of each edge, the lower one first.
pub const EDGE_CORNERS: [[u8; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/// Corners of each face, counter-clockwise seen from outside the cell.
pub const FACE_CORNERS: [[u8; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// One way to fill a cell.
#[derive(Clone, Debug, Default)]
pub struct Entry {
    /// Vertices: below 12 the crossed edge, above the number of the centre + 12. Counter-clockwise from outside the
    /// material.
    pub triangles: Vec<[u8; 3]>,
    /// For each centre the edges (bits) whose vertices it is the mean of.
    pub centers: Vec<u16>,
    /// Fillings with a tube: taken when the interior test joins the two corners.
    pub tubes: Vec<Tube>,
    /// Lowest corner of the region of the cell's surface to which each corner belongs.
    pub region: [u8; 8],
    /// Two outsides at opposite corners, all else inside (case 4 turned inside out). Here we do mostly as Lewiner's code does
    /// (and scikit-image and all who took it over), so that counts of triangles can be compared with theirs: it takes the
    /// tube also where the interpolant has none. Both fillings have the same boundary, so the surface stays closed. It is
    /// 42 cells of the head in shared/data, 0.2 % of its triangles, and 756 cells of the chest at 110.5, 0.04 %.
    pub outsides_opposed: bool,
}

/// A filling with a tube.
#[derive(Clone, Debug)]
pub struct Tube {
    /// Corners in two regions that are apart on the surface.
    pub joins: [u8; 2],
    /// See [`Entry::triangles`].
    pub triangles: Vec<[u8; 3]>,
    /// See [`Entry::centers`].
    pub centers: Vec<u16>,
}

/// One configuration.
#[derive(Clone, Copy, Debug, Default)]
pub struct Case {
    /// Crossed edges, as bits.
    pub edges: u16,
    /// Ambiguous faces, as bits.
    pub ambiguous: u8,
    /// First of its `2^ambiguous` entries: bit n of the number added says that the insides of the n-th ambiguous face are
    /// joined.
    pub first: u16,
}

/// All cases.
#[derive(Debug)]
pub struct Tables {
    /// By configuration: bit c says that corner c is inside.
    pub cases: [Case; 256],
    /// See [`Case::first`].
    pub entries: Vec<Entry>,
}

/// The tables.
pub static TABLES: LazyLock<Tables> = LazyLock::new(generate);

fn generate() -> Tables {
    let mut tables = Tables { cases: [Case::default(); 256], entries: Vec::new() };
    for config in 0..256usize {
        let inside = |c: u8| config >> c & 1 == 1;
        let ambiguous: Vec<usize> = (0..6).filter(|&f| is_ambiguous(FACE_CORNERS[f].map(inside))).collect();
        tables.cases[config] = Case {
            edges: (0..12)
                .filter(|&e| inside(EDGE_CORNERS[e][0]) != inside(EDGE_CORNERS[e][1]))
                .fold(0, |m, e| m | 1 << e),
            ambiguous: ambiguous.iter().fold(0, |m, f| m | 1 << f),
            first: tables.entries.len() as u16,
        };
        for decisions in 0..1usize << ambiguous.len() {
            let joined = |f: usize| ambiguous.iter().position(|&a| a == f).is_some_and(|n| decisions >> n & 1 == 1);
            tables.entries.push(entry(&inside, &joined));
        }
    }
    tables
}

fn is_ambiguous(s: [bool; 4]) -> bool {
    s[0] == s[2] && s[1] == s[3] && s[0] != s[1]
}

/// The edge between two corners.
fn edge_between(a: u8, b: u8) -> u8 {
    let want = [a.min(b), a.max(b)];
    EDGE_CORNERS.iter().position(|&e| e == want).expect("corners of one edge") as u8
}

fn entry(inside: &impl Fn(u8) -> bool, joined: &impl Fn(usize) -> bool) -> Entry {
    let region = regions(inside, joined);
    let loops = loops(inside, joined);
    let mut triangles = Vec::new();
    let mut centers = Vec::new();
    for l in &loops {
        disc(l, &mut triangles, &mut centers);
    }
    // a loop has one region on either side
    let sides = |l: &[u8]| {
        let [a, b] = EDGE_CORNERS[l[0] as usize];
        let (i, o) = if inside(a) { (a, b) } else { (b, a) };
        [region[i as usize], region[o as usize]]
    };
    let mut tubes = Vec::new();
    for i in 0..loops.len() {
        for j in i + 1..loops.len() {
            let (s, t) = (sides(&loops[i]), sides(&loops[j]));
            // a tube has one region in it and one around it: one is shared, and the other two become one
            let joins = match (s[0] == t[0], s[1] == t[1]) {
                (true, false) => [s[1], t[1]],
                (false, true) => [s[0], t[0]],
                _ => continue,
            };
            let mut filled = Tube { joins, triangles: Vec::new(), centers: Vec::new() };
            if !tube(&loops[i], &loops[j], &mut filled.triangles, &mut filled.centers) {
                continue;
            }
            for (k, l) in loops.iter().enumerate() {
                if k != i && k != j {
                    disc(l, &mut filled.triangles, &mut filled.centers);
                }
            }
            assert!(filled.triangles.len() <= MAX_TRIANGLES && filled.centers.len() <= MAX_CENTERS);
            tubes.push(filled);
        }
    }
    assert!(triangles.len() <= MAX_TRIANGLES && centers.len() <= MAX_CENTERS);
    let outsides: Vec<u8> = (0..8).filter(|&c| !inside(c)).collect();
    let outsides_opposed = outsides.len() == 2 && outsides[0] + outsides[1] == 7;
    Entry { triangles, centers, tubes, region, outsides_opposed }
}

/// Regions of the cell's surface: corners joined along edges and across faces.
fn regions(inside: &impl Fn(u8) -> bool, joined: &impl Fn(usize) -> bool) -> [u8; 8] {
    let mut region: [u8; 8] = std::array::from_fn(|c| c as u8);
    let mut join = |a: u8, b: u8| {
        let (ra, rb) = (region[a as usize], region[b as usize]);
        for r in &mut region {
            if *r == ra || *r == rb {
                *r = ra.min(rb);
            }
        }
    };
    for [a, b] in EDGE_CORNERS {
        if inside(a) == inside(b) {
            join(a, b);
        }
    }
    for (f, c) in FACE_CORNERS.iter().enumerate() {
        if is_ambiguous(c.map(inside)) {
            // one pair of the face is joined: the insides or the outsides
            let [p, q] = if inside(c[0]) == joined(f) { [c[0], c[2]] } else { [c[1], c[3]] };
            join(p, q);
        }
    }
    region
}

/// The surface's boundary on the cell's faces: loops of crossed edges.
fn loops(inside: &impl Fn(u8) -> bool, joined: &impl Fn(usize) -> bool) -> Vec<Vec<u8>> {
    let mut next = [None; 12];
    for (f, c) in FACE_CORNERS.iter().enumerate() {
        // a segment cuts off the corner c[i], or a run of corners, from where the walk around the face enters the
        // inside to where it leaves it
        let edge = |i: usize| edge_between(c[i % 4], c[(i + 1) % 4]) as usize;
        let enters = (0..4).filter(|&i| !inside(c[i]) && inside(c[(i + 1) % 4]));
        for i in enters {
            let leaves = |k: usize| inside(c[(i + k) % 4]) && !inside(c[(i + k + 1) % 4]);
            // the next place where the walk leaves cuts off this run of insides; the last one joins the runs
            let k = if joined(f) { (1..4).rev().find(|&k| leaves(k)) } else { (1..4).find(|&k| leaves(k)) };
            next[edge(i)] = Some(edge(i + k.expect("what enters leaves")) as u8);
        }
    }
    let mut loops = Vec::new();
    for start in 0..12 {
        let mut l = Vec::new();
        let mut at = start;
        while let Some(n) = next[at].take() {
            l.push(at as u8);
            at = n as usize;
        }
        if !l.is_empty() {
            loops.push(l);
        }
    }
    loops
}

/// Faces (bits) that an edge lies in.
fn faces_of(edge: u8) -> u8 {
    let [a, b] = EDGE_CORNERS[edge as usize];
    (0..6).filter(|&f| FACE_CORNERS[f].contains(&a) && FACE_CORNERS[f].contains(&b)).fold(0, |m, f| m | 1 << f)
}

/// Squared distance of the middles of two edges, in half cells; none where the line between them lies in a face.
fn inner(a: u8, b: u8) -> Option<u32> {
    if faces_of(a) & faces_of(b) != 0 {
        return None;
    }
    let middle = |e: u8| {
        let [p, q] = EDGE_CORNERS[e as usize];
        [0, 1, 2].map(|k| (p >> k & 1) as i32 + (q >> k & 1) as i32)
    };
    let (p, q) = (middle(a), middle(b));
    Some((0..3).map(|k| (p[k] - q[k]).pow(2) as u32).sum())
}

/// Triangulates a polygon of edge vertices without further vertices: least sum of squared inner edges. The sides of the
/// polygon may lie anywhere.
fn polygon(p: &[u8]) -> Option<(u32, Vec<[u8; 3]>)> {
    let n = p.len();
    // best[i][j]: polygon i..=j, its closing side i-j not counted
    let mut best: Vec<Vec<Option<(u32, usize)>>> = vec![vec![None; n]; n];
    for i in 0..n - 1 {
        best[i][i + 1] = Some((0, 0));
    }
    let side = |i: usize, j: usize| if j == i + 1 || (i == 0 && j == n - 1) { Some(0) } else { inner(p[i], p[j]) };
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            for k in i + 1..j {
                if let (Some(a), Some(b), Some(s), Some(t)) = (best[i][k], best[k][j], side(i, k), side(k, j)) {
                    let cost = a.0 + b.0 + s + t;
                    if best[i][j].is_none_or(|old| cost < old.0) {
                        best[i][j] = Some((cost, k));
                    }
                }
            }
        }
    }
    let cost = best[0][n - 1]?.0;
    let mut triangles = Vec::with_capacity(n - 2);
    let mut todo = vec![(0, n - 1)];
    while let Some((i, j)) = todo.pop() {
        if j > i + 1 {
            let k = best[i][j].expect("part of a solution").1;
            triangles.push([p[i], p[k], p[j]]);
            todo.push((k, j));
            todo.push((i, k));
        }
    }
    Some((cost, triangles))
}

/// Triangulates a polygon around a vertex in its middle.
fn fan(p: &[u8], triangles: &mut Vec<[u8; 3]>, centers: &mut Vec<u16>) {
    let c = 12 + centers.len() as u8;
    centers.push(p.iter().fold(0, |m, e| m | 1 << e));
    triangles.extend((0..p.len()).map(|i| [p[i], p[(i + 1) % p.len()], c]));
}

/// Around a vertex in the middle where it must be, and from 8 sides on: such a disc is a saddle, whose middle no inner edge
/// comes near (Lewiner does the same).
fn disc(p: &[u8], triangles: &mut Vec<[u8; 3]>, centers: &mut Vec<u16>) {
    match polygon(p) {
        Some((_, t)) if p.len() < 8 => triangles.extend(t),
        _ => fan(p, triangles, centers),
    }
}

/// Joins two loops by a tube: a ring of triangles; or two discs, one of them or both around a vertex in the middle. False
/// where the loops lie so that no tube can join them without touching a face; no trilinear cell has one there (see the
/// tests).
fn tube(p: &[u8], q: &[u8], triangles: &mut Vec<[u8; 3]>, centers: &mut Vec<u16>) -> bool {
    if let Some(t) = ring(p, q) {
        triangles.extend(t);
        return true;
    }
    let part = |l: &[u8], from: usize, to: usize| -> Vec<u8> {
        let count = (to + l.len() - from) % l.len() + 1;
        (0..count).map(|k| l[(from + k) % l.len()]).collect()
    };
    let mut best = None;
    let mut least = (true, u32::MAX);
    for (i, j) in pairs(p.len(), q.len()) {
        for (k, l) in pairs(p.len(), q.len()) {
            let (Some(a), Some(b)) = (inner(p[i], q[j]), inner(p[k], q[l])) else { continue };
            if i == k || j == l {
                continue;
            }
            let discs = [[part(p, i, k), part(q, l, j)].concat(), [part(p, k, i), part(q, j, l)].concat()];
            let plain = polygon(&discs[0]);
            let cost = (plain.is_none(), a + b + plain.map_or(0, |c| c.0));
            if cost < least {
                least = cost;
                best = Some(discs);
            }
        }
    }
    let Some([one, two]) = best else { return false };
    disc(&one, triangles, centers);
    fan(&two, triangles, centers);
    true
}

fn pairs(a: usize, b: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..a).flat_map(move |i| (0..b).map(move |j| (i, j)))
}

/// A tube without further vertices, of the shortest bridges: from each bridge to the next one end moves on, forwards on `p`
/// or backwards on `q`.
fn ring(p: &[u8], q: &[u8]) -> Option<Vec<[u8; 3]>> {
    let mut best: Option<(u32, Vec<[u8; 3]>)> = None;
    for start in 0..q.len() {
        let turned: Vec<u8> = (0..q.len()).map(|j| q[(start + q.len() - j) % q.len()]).collect();
        if let Some(b) = inner(p[0], turned[0]) {
            walk(p, &turned, &mut vec![(0, 0)], b, &mut best);
        }
    }
    best.map(|b| b.1)
}

/// Tries every way on from the last of `bridges`, (steps on p, steps on q) each, of squared length `cost` together.
fn walk(p: &[u8], q: &[u8], bridges: &mut Vec<(usize, usize)>, cost: u32, best: &mut Option<(u32, Vec<[u8; 3]>)>) {
    let pair = |(i, j): (usize, usize)| (p[i % p.len()], q[j % q.len()]);
    let last = *bridges.last().expect("never empty");
    if last == (p.len(), q.len()) {
        if best.as_ref().is_none_or(|old| cost < old.0) {
            let triangle = |w: &[(usize, usize)]| {
                let (from, to) = (pair(w[0]), pair(w[1]));
                if w[0].1 == w[1].1 { [from.0, to.0, from.1] } else { [to.1, from.1, from.0] }
            };
            *best = Some((cost, bridges.windows(2).map(triangle).collect()));
        }
        return;
    }
    for next in [(last.0 + 1, last.1), (last.0, last.1 + 1)] {
        let closes = next == (p.len(), q.len());
        // a bridge must not come twice, but the first as the last
        if next.0 <= p.len() && next.1 <= q.len() && (closes || bridges.iter().all(|&b| pair(b) != pair(next))) {
            let (a, b) = pair(next);
            if let Some(more) = inner(a, b) {
                bridges.push(next);
                walk(p, q, bridges, cost + more, best);
                bridges.pop();
            }
        }
    }
}
