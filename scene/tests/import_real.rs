//! Real scenes made by others (`../shared/data`, not part of the repository): how many triangles they have. Where a scene is
//! absent the test says so and passes.

use std::path::PathBuf;

use rayherd_scene::description::Description;
use rayherd_scene::import::isosurface::IsoSurfaceSource;
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import, import_surface};
use rayherd_scene::record::{Record, RecordSource};
use rayherd_tests::shared;

/// Unpacks a set into a folder that vanishes; none if it is not there.
fn unpack(name: &str) -> Option<(tempfile::TempDir, PathBuf)> {
    let dir = tempfile::tempdir().unwrap();
    let folder = shared::unpack(name, dir.path())?;
    Some((dir, folder))
}

/// Triangles and spheres.
fn count(description: &Description) -> (u64, u64) {
    let source = DescriptionSource::new(description, StreamOptions::default());
    let mut stream = source.open().unwrap();
    let (mut records, mut triangles, mut spheres) = (vec![], 0, 0);
    loop {
        records.clear();
        if stream.next(&mut records, 4096).unwrap() == 0 {
            return (triangles, spheres);
        }
        let n = records.iter().filter(|r| matches!(r, Record::Sphere(_))).count() as u64;
        spheres += n;
        triangles += records.len() as u64 - n;
    }
}

fn scene(name: &str, substitute: bool, expected: (u64, u64)) {
    let Some((_dir, folder)) = unpack(name) else { return };
    let options = ImportOptions { substitute, ..ImportOptions::default() };
    let description = import(&folder.join("scene.xml"), &options).unwrap();
    assert!(description.camera.is_some() && description.bounds.is_none());
    assert_eq!(substitute, !description.substitutions.is_empty());
    assert_eq!(count(&description), expected, "{name}");
}

#[test]
fn cornell_box() {
    scene("scene-cornell-box", false, (36, 0));
}

#[test]
fn veach_mis() {
    scene("scene-veach-mis", false, (52, 3));
}

// 262,661 triangles in OBJ files, and a rectangle
#[test]
fn staircase() {
    scene("scene-staircase", false, (262_663, 0));
}

#[test]
fn living_room() {
    scene("scene-living-room", false, (143_163, 0));
}

// 269,536 triangles in OBJ files, and a rectangle; its picture of the sky is missing
#[test]
fn dining_room() {
    scene("scene-dining-room", true, (269_538, 0));
}

#[test]
fn classroom() {
    scene("scene-classroom", false, (103_832, 0));
}

#[test]
fn meshes() {
    let Some((_dir, folder)) = unpack("meshes") else { return };
    for (name, expected) in [("bunny.ply", 69_451), ("lucy.ply", 99_970), ("dragon_vrip.ply.gz", 871_414)] {
        let description = import_surface(&folder.join(name), &ImportOptions::default()).unwrap();
        assert_eq!(count(&description), (expected, 0), "{name}");
    }
}

/// What a surface is, found while it streams by.
#[derive(Default)]
struct Surface {
    triangles: u64,
    flat: u64,
    /// Edges that lie on the volume's border, where the surface ends.
    border: u64,
    /// Sum over the other edges of a hash of the edge, negated where it runs from its greater end to its lesser one. Where each inner
    /// edge belongs to two triangles that run along it in opposite directions this is 0, and else it is not (but for a chance of
    /// 2^-64).
    unmatched: u64,
}

impl Surface {
    fn of(source: &IsoSurfaceSource) -> Surface {
        let border = Border::new(source);
        let mut stream = source.open().unwrap();
        let (mut records, mut out) = (vec![], Surface::default());
        while {
            records.clear();
            stream.next(&mut records, 4096).unwrap() > 0
        } {
            for record in &records {
                let Record::Triangle(t) = record else { panic!("not a triangle") };
                out.triangles += 1;
                out.flat += u64::from(is_flat(&t.p));
                for (a, b) in edges(&t.p) {
                    match border.sides(&a) & border.sides(&b) {
                        0 => out.unmatched = out.unmatched.wrapping_add(signed_hash(a, b)),
                        _ => out.border += 1,
                    }
                }
            }
        }
        out
    }
}

type Point = [f64; 3];

/// Edges that have a length.
fn edges(p: &[Point; 3]) -> impl Iterator<Item = (Point, Point)> + '_ {
    (0..3).map(|i| (p[i], p[(i + 1) % 3])).filter(|(a, b)| a != b)
}

/// As preparing sees it: recentred (for a scan, nearly), in f32.
fn is_flat(p: &[Point; 3]) -> bool {
    let p = p.map(|v| v.map(|x| f64::from(x as f32)));
    let e = |j: usize| -> Point { std::array::from_fn(|a| p[j][a] - p[0][a]) };
    let (a, b) = (e(1), e(2));
    a[1] * b[2] == a[2] * b[1] && a[2] * b[0] == a[0] * b[2] && a[0] * b[1] == a[1] * b[0]
}

/// SplitMix64's finalizer over the six numbers, by the lesser end first.
fn signed_hash(a: Point, b: Point) -> u64 {
    let (a, b) = (a.map(|x| (x + 0.0).to_bits()), b.map(|x| (x + 0.0).to_bits()));
    let (lesser, greater, sign) = if a < b { (a, b, 1u64) } else { (b, a, u64::MAX) };
    let mut h = 0u64;
    for x in lesser.into_iter().chain(greater) {
        h = (h ^ x).wrapping_add(0x9e37_79b9_7f4a_7c15);
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        h ^= h >> 31;
    }
    h.wrapping_mul(sign)
}

/// The box of a volume whose axes are the world's.
struct Border([Point; 2]);

impl Border {
    fn new(source: &IsoSurfaceSource) -> Self {
        Border(source.world_box())
    }
    /// Which of its six sides a point lies on, as bits: rounding of the placement moves it by far less than this.
    fn sides(&self, p: &Point) -> u32 {
        let [lo, hi] = &self.0;
        let near = |a: usize, b: Point| (p[a] - b[a]).abs() <= 1e-9 * (hi[a] - lo[a]);
        (0..3).map(|a| u32::from(near(a, *lo)) << a | u32::from(near(a, *hi)) << (a + 3)).sum()
    }
}

/// Four surfaces of the chest scan: as many triangles as scikit-image makes of them (`shared/data/README.md`), and closed.
#[test]
fn chest() {
    let Some((_dir, folder)) = unpack("ct-lidc-0314") else { return };
    let expected = [(-789.5, 8_134_040, 0), (-790.0, 8_137_968, 53_033), (300.5, 3_626_218, 0), (110.5, 7_995_252, 0)];
    let within = |found: u64, expected: u64| found.abs_diff(expected) <= expected / 1000;
    // two at a time: each reads the whole scan
    for pair in expected.chunks(2) {
        std::thread::scope(|scope| {
            for &(iso, triangles, flat) in pair {
                let folder = folder.join("dicom");
                scope.spawn(move || {
                    let found = Surface::of(&IsoSurfaceSource::new(&folder, iso).unwrap());
                    println!(
                        "{iso}: {} triangles, {} flat, {} edges on the border",
                        found.triangles, found.flat, found.border
                    );
                    assert!(within(found.triangles, triangles), "{iso}: {} triangles", found.triangles);
                    assert!(found.flat.abs_diff(flat) <= triangles / 1000, "{iso}: {} flat triangles", found.flat);
                    assert_eq!(found.unmatched, 0, "{iso}: an inner edge without its twin");
                    assert!(found.border > 0 && found.border < found.triangles / 50, "{iso}: {}", found.border);
                });
            }
        });
    }
}

/// Each inner edge of the head's surface is in exactly two triangles, counted one by one; and the sum that stands for it on larger
/// scans is 0 with all of them and not 0 when any is taken away.
#[test]
fn head_is_closed() {
    let Some((_dir, folder)) = unpack("ct-headsq-quarter") else { return };
    let source = IsoSurfaceSource::new(&folder.join("quarter.nhdr"), 1150.5).unwrap();
    let border = Border::new(&source);
    let mut records = vec![];
    source.open().unwrap().next(&mut records, usize::MAX >> 1).unwrap();
    let mut count = std::collections::HashMap::new();
    let mut sums = vec![];
    for record in &records {
        let Record::Triangle(t) = record else { panic!("not a triangle") };
        let mut sum = 0u64;
        for (a, b) in edges(&t.p) {
            let inner = border.sides(&a) & border.sides(&b) == 0;
            let key = [a, b].map(|p| p.map(|x| (x + 0.0).to_bits()));
            let (forth, key) = if key[0] < key[1] { (1, key) } else { (-1, [key[1], key[0]]) };
            let entry = count.entry(key).or_insert((0u32, 0i32, inner));
            *entry = (entry.0 + 1, entry.1 + forth, inner);
            sum = sum.wrapping_add(if inner { signed_hash(a, b) } else { 0 });
        }
        sums.push(sum);
    }
    let inner = count.values().filter(|e| e.2).count();
    assert!(inner > 100_000 && count.values().all(|&(n, turns, inner)| !inner || (n, turns) == (2, 0)), "{inner}");
    let all = sums.iter().fold(0, |s: u64, x| s.wrapping_add(*x));
    assert_eq!((all, Surface::of(&source).unmatched), (0, 0));
    assert!(sums.iter().step_by(501).all(|one| all.wrapping_sub(*one) != 0));
}
