use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU32, Ordering};

use rayherd_render::bvh::Forest;

use super::*;
use crate::description::{Affine, Bsdf, Geometry, Material, Place, Shape};
use crate::grid::touch::{sphere_cells, triangle_cells};
use crate::objects::MemoryObjects;
use crate::record::{Record, RecordStream, SphereRecord, TriangleRecord};

/// Records in memory, and how often they were read.
struct List {
    records: Vec<Record>,
    reads: AtomicU32,
}

impl List {
    fn new(records: Vec<Record>) -> Self {
        List { records, reads: AtomicU32::new(0) }
    }
}

struct ListStream<'a>(std::slice::Iter<'a, Record>, u64);

impl RecordStream for ListStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let before = out.len();
        out.extend(self.0.by_ref().take(max));
        self.1 += (out.len() - before) as u64 * 100;
        Ok(out.len() - before)
    }
    fn bytes_read(&self) -> u64 {
        self.1
    }
}

impl RecordSource for List {
    fn open(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        Ok(Box::new(ListStream(self.records.iter(), 0)))
    }
}

fn description(name: &str) -> Description {
    let shape = |name: String, emission| Shape {
        name,
        place: Place::default(),
        geometry: Geometry::Sphere { center: [0.0; 3], radius: 1.0 },
        to_world: Affine::IDENTITY,
        material: 0,
        emission,
        flip_normals: false,
        face_normals: false,
    };
    Description {
        shapes: vec![shape(format!("{name} dark"), None), shape(format!("{name} light"), Some([1.0, 2.0, 3.0]))],
        materials: vec![Material {
            name: "grey".to_owned(),
            bsdf: Bsdf::Diffuse { reflectance: [0.5; 3] },
            two_sided: true,
        }],
        ..Default::default()
    }
}

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Small triangles along a winding path, with walls, spheres, normals, and things to skip in between.
fn scene(seed: u64, count: usize) -> Vec<Record> {
    let mut random = Random(seed);
    let mut at = [0.0f64; 3];
    let mut out = Vec::new();
    for i in 0..count {
        for x in &mut at {
            *x = (*x + 0.6 * (random.next() - 0.5)).clamp(-3.0, 3.0);
        }
        let mut corner = |size: f64| at.map(|x| 1000.0 + x + size * (random.next() - 0.5));
        let size = if i % 97 == 13 { 6.0 } else { 0.2 };
        let mut t = TriangleRecord {
            p: [corner(size), corner(size), corner(size)],
            n: (i % 3 == 0).then_some([[0.0, 0.0, 1.0]; 3]),
            uv: (i % 4 == 0).then_some([[0.25, i as f32]; 3]),
            shape: u32::from(i % 50 == 7),
        };
        out.push(match i % 40 {
            5 => {
                t.p[2] = t.p[1];
                Record::Triangle(t)
            }
            6 => {
                t.p[1][1] = [f64::NAN, f64::INFINITY, 1e13][i / 40 % 3];
                Record::Triangle(t)
            }
            7 | 8 => Record::Sphere(SphereRecord {
                center: t.p[0],
                radius: if i % 80 == 7 { 0.0 } else { 0.1 + random.next() },
                flipped: i % 80 == 8,
                shape: 0,
            }),
            _ => Record::Triangle(t),
        });
    }
    out
}

fn settings(splits: u32, overlap_reduction: bool) -> PrepareSettings {
    PrepareSettings { cut: Cut::Splits(splits), overlap_reduction, ..Default::default() }
}

fn run(records: &[Record], settings: &PrepareSettings, store: &dyn ObjectStore) -> Result<Prepared, PrepareError> {
    let source = List::new(records.to_vec());
    prepare(&description("list"), &source, settings, &SpoolSettings::default(), store, &NoProgress)
}

/// Ids in each split, by reading the blocks back.
fn ids_of(manifest: &Manifest, store: &dyn ObjectStore) -> Vec<BTreeSet<u64>> {
    let load = |s: &SplitEntry| {
        let bytes = store.get(&s.geometry).unwrap();
        let mut forest = Forest::new(64 << 20).unwrap();
        let block = forest.insert(&bytes).unwrap();
        let ids: BTreeSet<u64> = forest.slots(block).unwrap().map(|slot| forest.prim_id(slot)).collect();
        assert_eq!(ids.len() as u64, s.triangles + s.spheres, "an id twice in a split");
        assert_eq!(ids.first(), Some(&s.first_id));
        assert_eq!(ids.last(), Some(&s.last_id));
        ids
    };
    manifest.splits.iter().map(load).collect()
}

/// What must be usable: id, and cells of the primitive, by the manifest's grid.
fn usable(records: &[Record], manifest: &Manifest) -> BTreeMap<u64, Vec<u32>> {
    let lattice = Lattice::new(manifest.grid.subdiv, manifest.lo, manifest.hi).unwrap();
    let recentred = |p: [f64; 3]| -> [f32; 3] { std::array::from_fn(|a| (p[a] - manifest.offset[a]) as f32) };
    let mut out = BTreeMap::new();
    for (id, record) in (0..).zip(records) {
        let mut cells = Vec::new();
        match record {
            Record::Triangle(t) => {
                if t.p[1] == t.p[2] || t.p.as_flattened().iter().any(|x| !x.is_finite() || x.abs() > 1e12) {
                    continue;
                }
                let p = t.p.map(|p| recentred(p).map(f64::from));
                triangle_cells(&lattice, &p, &mut |at| cells.push(lattice.index(at)));
            }
            Record::Sphere(s) if s.radius == 0.0 => continue,
            Record::Sphere(s) => {
                let r = f64::from(s.radius as f32);
                sphere_cells(&lattice, recentred(s.center).map(f64::from), r, &mut |at| cells.push(lattice.index(at)));
            }
        }
        out.insert(id, cells);
    }
    out
}

#[test]
fn every_primitive_is_where_the_grid_says() {
    for (seed, splits, reduce) in [(1, 1, true), (2, 7, false), (2, 7, true), (3, 23, true), (4, 60, true)] {
        let records = scene(seed, 1500);
        let store = MemoryObjects::new();
        let Prepared { manifest, reference, reused, .. } = run(&records, &settings(splits, reduce), &store).unwrap();
        assert!(!reused);
        assert_eq!(Manifest::load(&store, &reference).unwrap(), manifest);
        let ids = ids_of(&manifest, &store);
        let usable = usable(&records, &manifest);
        let of_source = || manifest.splits.iter().zip(&ids).filter(|(s, _)| !s.copied);
        assert_eq!(of_source().count(), splits as usize);
        // cut in order, nothing lost, nothing twice
        let joined: Vec<u64> = of_source().flat_map(|(_, ids)| ids.iter().copied()).collect();
        assert_eq!(joined, usable.keys().copied().collect::<Vec<_>>());
        let counts = &manifest.counts;
        assert_eq!(counts.triangles + counts.spheres, joined.len() as u64);
        assert_eq!(counts.records, 1500);
        assert_eq!((counts.degenerate, counts.non_finite, counts.out_of_range), (38 + 19, 26, 12));
        assert_eq!((counts.source_reads, counts.source_bytes), (2, 300_000));

        let owners: BTreeMap<u32, &CellData> = manifest.grid.cells.iter().map(|c| (c.index, c)).collect();
        let mut contested = BTreeSet::new();
        for (id, cells) in &usable {
            for cell in cells {
                let Some(cell) = owners.get(cell) else { continue };
                if reduce {
                    let [owner] = cell.owners[..] else { panic!("cell {} has owners {:?}", cell.index, cell.owners) };
                    assert!(ids[owner as usize].contains(id), "primitive {id} is not with its cell");
                } else {
                    let holds = cell.owners.iter().any(|&o| ids[o as usize].contains(id));
                    // a cell's box may be empty for a primitive that only the conservative test put there
                    assert!(holds, "primitive {id} is not with its cell");
                    if cell.owners.len() > 1 {
                        contested.insert(*id);
                    }
                }
            }
        }
        let choice = &manifest.choice;
        if !reduce {
            assert_eq!(choice.contested_primitives, contested.len() as u64);
            assert_eq!(choice.copies, 0);
        } else if splits > 1 {
            assert!(choice.copies >= choice.contested_primitives && choice.contested_primitives > 0);
            // filled near capacity, unless a cell alone is larger
            let fullest = manifest.grid.cells.iter().map(|c| c.primitives).max().unwrap();
            let most = choice.capacity.max(fullest);
            let copied: Vec<u64> =
                manifest.splits.iter().filter(|s| s.copied).map(|s| s.triangles + s.spheres).collect();
            assert!(copied.iter().all(|&n| n <= most), "{copied:?} of {}", choice.capacity);
            let copies: BTreeSet<u64> = manifest
                .splits
                .iter()
                .zip(&ids)
                .filter(|(s, _)| s.copied)
                .flat_map(|(_, i)| i.iter().copied())
                .collect();
            assert_eq!(copies.len() as u64, choice.contested_primitives);
        } else {
            assert_eq!((choice.copies, manifest.grid.subdiv), (0, 1));
        }
    }
}
