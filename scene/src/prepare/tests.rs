use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU32, Ordering};

use rayherd_render::attributes::AttributeBlock;
use rayherd_render::bvh::{Forest, Kernel, Tracer};
use rayherd_render::ray::{Hit, Ray};
use rayherd_render::world::World;
use rayherd_tests::mutation::Random;

use super::*;
use crate::description::{Affine, Bsdf, Environment, Geometry, Material, Place, Shape};
use crate::grid::touch::{sphere_cells, triangle_cells};
use crate::grid::{Progress, SplitSet};
use crate::manifest::{Counts, SplitEntry};
use crate::objects::{DirectoryObjects, MemoryObjects, ObjectHash};
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
        emission_texture: None,
        flip_normals: false,
        face_normals: false,
    };
    Description {
        shapes: vec![shape(format!("{name} dark"), None), shape(format!("{name} light"), Some([1.0, 2.0, 3.0]))],
        materials: vec![Material::new("grey", Bsdf::Diffuse { reflectance: [0.5; 3] }, true)],
        // so that the lamp need not be there
        environment: Some(Environment::Constant([1.0; 3])),
        ..Default::default()
    }
}

/// In 0 to 1.
fn unit(random: &mut Random) -> f64 {
    (random.bits() >> 11) as f64 / (1u64 << 53) as f64
}

/// Small triangles along a winding path, with walls, spheres, normals, and things to skip in between.
fn scene(seed: u64, count: usize) -> Vec<Record> {
    let mut random = Random::new(seed);
    let mut at = [0.0f64; 3];
    let mut out = Vec::new();
    for i in 0..count {
        for x in &mut at {
            *x = (*x + 0.6 * (unit(&mut random) - 0.5)).clamp(-3.0, 3.0);
        }
        let mut corner = |size: f64| at.map(|x| 1000.0 + x + size * (unit(&mut random) - 0.5));
        let size = if i % 97 == 13 { 6.0 } else { 0.2 };
        let mut t = TriangleRecord {
            p: [corner(size), corner(size), corner(size)],
            n: (i % 3 == 0).then_some([[0.0, 0.0, 1.0]; 3]),
            uv: (i % 4 == 0).then_some([[0.25, i as f32]; 3]),
            attribute: (i % 5 == 0).then_some([[0.5, i as f32, 2.0]; 3]),
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
                radius: if i % 80 == 7 { 0.0 } else { 0.1 + unit(&mut random) },
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
    let lattice = manifest.grid.lattice().unwrap();
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

/// Records that are kept where the bounds are found are those that a second pass reads.
#[test]
fn few_records_are_read_once_and_many_twice() {
    // more than one batch
    let records = scene(9, 10_000);
    let size = size_of_val(&records[..]) as u64;
    let ingested = |most: u64, bounds: Option<[[f64; 3]; 2]>| {
        let source = List::new(records.clone());
        let seen = ingest::bounds(&source, most, &NoProgress).unwrap();
        assert_eq!((seen.kept.is_some(), seen.bytes), (most >= size, 1_000_000), "{most}");
        let kept = seen.kept.as_ref().map_or(0, |k| k.iter().map(|b| size_of_val(&b[..])).sum::<usize>());
        assert_eq!(kept as u64, if most >= size { size } else { 0 });
        assert!(bounds.is_none_or(|b| seen.bounds == Some(b)), "{most}");
        let bounds = seen.bounds.unwrap();
        let offset = std::array::from_fn(|a| 0.5 * (bounds[0][a] + bounds[1][a]));
        let settings = SpoolSettings::default();
        let from = (&source as &dyn RecordSource, seen.kept);
        let made = ingest::ingest(&description("list"), from, offset, &settings, &NoProgress).unwrap();
        let read = source.reads.load(Ordering::Relaxed);
        (bounds, made.hash, Counts { source_bytes: 0, ..made.counts }, made.counts.source_bytes, read)
    };
    let (bounds, hash, counts, bytes, reads) = ingested(0, None);
    assert_eq!((bytes, reads), (1_000_000, 2));
    for (most, bytes, reads) in [(1, 1_000_000, 2), (size - 1, 1_000_000, 2), (size, 0, 1), (u64::MAX, 0, 1)] {
        let found = ingested(most, Some(bounds));
        assert_eq!(found, (bounds, hash, counts.clone(), bytes, reads), "{most}");
    }
}

#[test]
fn sources_of_large_files_are_read_twice_without_trying() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = |name: &str, bytes: u64| {
        let path = folder.path().join(name);
        std::fs::File::create(&path).unwrap().set_len(bytes).unwrap();
        let format = crate::description::MeshFormat::Ply;
        Geometry::MeshFile { path, format, flip_v: false, smooth: false, attribute: None, parts: None }
    };
    let of = |geometry: Vec<Geometry>| {
        let mut all = description("files");
        let shape = all.shapes[0].clone();
        all.shapes.extend(geometry.into_iter().map(|geometry| Shape { geometry, ..shape.clone() }));
        ingest::to_keep(&all)
    };
    assert_eq!(of(vec![]), 64 << 20);
    assert_eq!(of(vec![mesh("a.ply", 32 << 20), mesh("b.ply", 32 << 20)]), 64 << 20);
    assert_eq!(of(vec![mesh("a.ply", 32 << 20), mesh("c.ply", (32 << 20) + 1)]), 0);
    assert_eq!(of(vec![Geometry::IsoSurface { path: folder.path().into(), iso: 0.0 }]), 0);
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
        assert_eq!((counts.source_reads, counts.source_bytes), (1, 150_000));

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
            // and what splits would have been left with
            let of_copied: BTreeSet<u64> = usable
                .iter()
                .filter(|(_, cells)| {
                    cells.iter().any(|c| owners.get(c).is_some_and(|c| manifest.splits[c.owners[0] as usize].copied))
                })
                .map(|(id, _)| *id)
                .collect();
            assert_eq!(copies, of_copied);
            assert!(copies.len() as u64 >= choice.contested_primitives);
        } else {
            assert_eq!((choice.copies, manifest.grid.subdiv), (0, 1));
        }
    }
}

#[test]
fn the_bytes_do_not_depend_on_threads_or_the_spool() {
    let records = scene(5, 3000);
    let mut first: Option<(ObjectRef, BTreeMap<ObjectHash, Vec<u8>>)> = None;
    for (threads, memory) in [(1, u64::MAX), (2, 0), (3, 50_000)] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let store = MemoryObjects::new();
        let spool = SpoolSettings { memory, ..SpoolSettings::default() };
        let source = List::new(records.clone());
        let prepared = pool
            .install(|| prepare(&description("list"), &source, &settings(11, true), &spool, &store, &NoProgress))
            .unwrap();
        let spooled = prepared.report.bytes.iter().filter(|r| r.kind == ByteKind::Spool).map(|r| r.bytes).sum::<u64>();
        assert_eq!(spooled > 0, memory < u64::MAX);
        let made = (prepared.reference, store.snapshot());
        assert_eq!(first.get_or_insert_with(|| made.clone()), &made, "{threads} threads");
    }
}

#[test]
fn by_block_size_blocks_are_as_large_as_asked_for() {
    let records = scene(6, 20_000);
    let store = MemoryObjects::new();
    for size in [20_000u64, 100_000] {
        let cut = PrepareSettings { cut: Cut::BlockSize(size), ..Default::default() };
        let manifest = run(&records, &cut, &store).unwrap().manifest;
        let fullest = manifest.grid.cells.iter().map(|c| c.primitives).max().unwrap();
        let of_source: Vec<u64> = manifest.splits.iter().filter(|s| !s.copied).map(|s| s.geometry.bytes).collect();
        let (last, full) = of_source.split_last().unwrap();
        assert!(*last * 10 <= size * 12);
        assert!(full.iter().all(|&b| b * 10 >= size * 8 && b * 10 <= size * 12), "{size}: {of_source:?}");
        if fullest <= manifest.choice.capacity {
            assert!(manifest.splits.iter().all(|s| s.geometry.bytes * 10 <= size * 12));
        }
    }
}

#[test]
fn preparing_again_does_nothing_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let store = DirectoryObjects::open(folder.path()).unwrap();
    let source = List::new(scene(7, 1000));
    let go = |settings: &PrepareSettings| {
        prepare(&description("list"), &source, settings, &SpoolSettings::default(), &store, &NoProgress).unwrap()
    };
    let first = go(&settings(4, true));
    assert!(!first.reused);
    assert_eq!(source.reads.load(Ordering::Relaxed), 1);
    let again = go(&settings(4, true));
    assert!(again.reused);
    assert_eq!((again.reference, &again.manifest), (first.reference, &first.manifest));
    assert_eq!(source.reads.load(Ordering::Relaxed), 1);
    // without overlap reduction: another scene, made of the same objects but for the copies
    let plain = go(&settings(4, false));
    assert!(!plain.reused);
    assert_eq!(plain.manifest.content, first.manifest.content);
    assert_eq!(plain.manifest.splits[..], first.manifest.splits[..4]);
    assert_eq!(plain.manifest.world, first.manifest.world);

    // a cut object is noticed and made again, a changed one is named when it is read
    let broken = first.manifest.splits[1].geometry;
    let path = store.path_of(&broken.hash);
    let body = std::fs::read(&path).unwrap();
    std::fs::write(&path, &body[..body.len() / 2]).unwrap();
    assert!(!go(&settings(4, true)).reused);
    assert_eq!(store.get(&broken).unwrap(), body);
    let mut changed = body.clone();
    changed[body.len() / 2] ^= 8;
    std::fs::write(&path, &changed).unwrap();
    let error = store.get(&broken).unwrap_err().to_string();
    assert!(error.contains(&broken.hash.to_string()) && error.contains("prepare the scene again"), "{error}");
}

#[test]
fn content_names_the_scene_however_it_was_cut() {
    let store = MemoryObjects::new();
    let records = scene(8, 500);
    let content = |records: &[Record], splits| run(records, &settings(splits, true), &store).unwrap().manifest.content;
    let one = content(&records, 1);
    // another store, as the list's fingerprint does not see its records
    let other = MemoryObjects::new();
    let of_other =
        |records: &[Record], splits| run(records, &settings(splits, false), &other).unwrap().manifest.content;
    assert_eq!(of_other(&records, 9), one);
    let mut moved = records.clone();
    let Record::Triangle(t) = &mut moved[100] else { panic!() };
    t.p[0][0] += 1e-3;
    assert_ne!(of_other(&moved, 10), one);
    let mut swapped = records;
    swapped.swap(100, 101);
    assert_ne!(of_other(&swapped, 11), one);
}

#[test]
fn attributes_and_lights_stay_with_their_primitives() {
    let records = scene(9, 1200);
    let store = MemoryObjects::new();
    let manifest = run(&records, &settings(6, true), &store).unwrap().manifest;
    for split in &manifest.splits {
        let bytes = store.get(&split.geometry).unwrap();
        let mut forest = Forest::new(64 << 20).unwrap();
        let block = forest.insert(&bytes).unwrap();
        let count = (split.triangles + split.spheres) as u32;
        let attributes = AttributeBlock::decode(&store.get(&split.attributes).unwrap(), count).unwrap();
        for slot in forest.slots(block).unwrap() {
            let (_, local) = forest.slot(slot);
            let i = local as usize;
            let (shape, n, uv) = match &records[forest.prim_id(slot) as usize] {
                Record::Triangle(t) => (t.shape, t.n, t.uv),
                Record::Sphere(s) => (s.shape, None, None),
            };
            assert_eq!(attributes.shapes[i], shape);
            assert_eq!(attributes.normals.get(i).copied().unwrap_or_default(), n.unwrap_or_default());
            assert_eq!(attributes.uv(i), uv);
        }
    }
    let world: World = serde_json::from_slice(&store.get(&manifest.world).unwrap()).unwrap();
    let lights: Vec<u64> = world.emissive.iter().map(|e| e.prim).collect();
    let expected: Vec<u64> = (0..1200).filter(|i| i % 50 == 7 && !(5..=8).contains(&(i % 40))).collect();
    assert_eq!(lights, expected);
}

#[test]
fn what_cannot_be_prepared_is_said() {
    let store = MemoryObjects::new();
    let nothing = run(&[], &settings(2, true), &store).unwrap_err();
    assert!(matches!(nothing, PrepareError::Empty { records: 0, .. }));
    let flat = Record::Triangle(TriangleRecord { p: [[1.0; 3]; 3], n: None, uv: None, attribute: None, shape: 0 });
    let far = Record::Triangle(TriangleRecord {
        p: [[1e30, 0.0, 0.0], [0.0; 3], [0.0; 3]],
        n: None,
        uv: None,
        attribute: None,
        shape: 0,
    });
    let empty = run(&[flat, far], &settings(2, true), &store).unwrap_err();
    assert!(matches!(empty, PrepareError::Empty { records: 2, degenerate: 1, out_of_range: 1, .. }), "{empty}");
    assert!(matches!(run(&[flat], &settings(0, true), &store), Err(PrepareError::Settings(_))));
    // a lamp of nothing that can be hit, and no other light
    let dark = Description { environment: None, ..description("list") };
    let triangle = |shape, x| {
        Record::Triangle(TriangleRecord {
            p: [[0.0; 3], [x, 0.0, 0.0], [0.0, 1.0, 0.0]],
            n: None,
            uv: None,
            attribute: None,
            shape,
        })
    };
    let prepared = |description: &Description, lamp: &[Record]| {
        let source = List::new([&[triangle(0, 1.0)][..], lamp].concat());
        prepare(description, &source, &settings(1, true), &SpoolSettings::default(), &store, &NoProgress)
    };
    for lamp in [vec![], vec![triangle(1, f64::NAN)], vec![triangle(1, 0.0)], vec![triangle(1, 1e30)]] {
        let error = prepared(&dark, &lamp).unwrap_err();
        assert!(matches!(&error, PrepareError::Dark { shape, .. } if shape == "list light"), "{lamp:?}: {error}");
        assert!(prepared(&description("list"), &lamp).is_ok(), "{lamp:?}");
    }
    assert!(prepared(&dark, &[triangle(1, 1.0)]).is_ok());
    let lost = SpoolSettings { memory: 0, folder: Some("/nowhere/at/all".into()), ..SpoolSettings::default() };
    let source = List::new(scene(1, 100));
    let error = prepare(&description("list"), &source, &settings(2, true), &lost, &store, &NoProgress).unwrap_err();
    assert!(matches!(error, PrepareError::Spool { .. }), "{error}");
}

#[test]
fn one_primitive_and_flat_scenes_are_scenes() {
    let wall = |x: f64| {
        Record::Triangle(TriangleRecord {
            p: [[x, 2.0, 0.0], [x + 1.0, 2.0, 0.0], [x, 2.0, 1.0]],
            n: None,
            uv: None,
            attribute: None,
            shape: 0,
        })
    };
    let store = MemoryObjects::new();
    let one = run(&[wall(0.0)], &settings(5, true), &store).unwrap().manifest;
    assert_eq!((one.splits.len(), one.grid.cells.len()), (1, 1));
    let records: Vec<Record> = (0..50).map(|i| wall(f64::from(i % 7))).collect();
    let flat = run(&records, &settings(6, true), &store).unwrap().manifest;
    assert_eq!((flat.lo[1], flat.hi[1]), (0.0, 0.0));
    Manifest::decode(&flat.encode()).unwrap();
}

/// Nearest hit as (t, id), of a forest of some splits.
fn trace(forest: &Forest, tracer: &mut Tracer, ray: &Ray) -> Option<(f32, u64)> {
    let mut hit = [Hit::miss(ray.tmax)];
    tracer.closest(forest, &[*ray], &mut hit);
    hit[0].is_hit().then(|| (hit[0].t, forest.prim_id(hit[0].prim)))
}

/// The point of it all: going from cell to cell finds the hit that the whole scene has, bit for bit.
#[test]
fn routing_finds_the_nearest_hit_of_the_whole_scene() {
    let records = scene(10, 4000);
    let mut random = Random::new(77);
    for reduce in [true, false] {
        let store = MemoryObjects::new();
        let manifest = run(&records, &settings(13, reduce), &store).unwrap().manifest;
        let grid = manifest.grid().unwrap();
        let mut whole = Forest::new(64 << 20).unwrap();
        let alone: Vec<Forest> = manifest
            .splits
            .iter()
            .map(|split| {
                let bytes = store.get(&split.geometry).unwrap();
                let mut forest = Forest::new(8 << 20).unwrap();
                forest.insert(&bytes).unwrap();
                forest.finish().unwrap();
                if !split.copied {
                    whole.insert(&bytes).unwrap();
                }
                forest
            })
            .collect();
        whole.finish().unwrap();
        let mut tracer = Tracer::new(Kernel::Auto).unwrap();
        let (mut hits, mut visits) = (0, 0);
        for i in 0..4000 {
            let mut point =
                |size: f64| -> [f32; 3] { std::array::from_fn(|_| (size * (unit(&mut random) - 0.5)) as f32) };
            let (o, target) = (point(if i % 3 == 0 { 200.0 } else { 8.0 }), point(6.0));
            let mut d: [f32; 3] = std::array::from_fn(|a| target[a] - o[a]);
            if i % 5 == 0 {
                d[i % 3] = 0.0;
            }
            let tmax = if i % 7 == 0 { 0.5 } else { f32::INFINITY };
            let mut ray = Ray { o, tmin: 0.0, d, tmax };
            let expected = trace(&whole, &mut tracer, &ray);
            // go where the grid says, with the best hit so far
            let mut best: Option<(f32, u64)> = None;
            let mut from = Progress::START;
            let mut resident = SplitSet::default();
            while let Some(next) = grid.next_foreign(&ray, from, &grid.outside(&resident)) {
                from = next.progress;
                resident = next.owners.iter().copied().collect();
                visits += 1;
                for &owner in next.owners {
                    if let Some(found) = trace(&alone[owner as usize], &mut tracer, &ray)
                        && best.is_none_or(|b| found < b)
                    {
                        best = Some(found);
                        ray.tmax = found.0;
                    }
                }
            }
            assert_eq!(best, expected, "ray {i}: {ray:?}");
            hits += u32::from(expected.is_some());
        }
        assert!(hits > 1000, "{hits}");
        assert!(visits < 4000 * 13, "{visits}");
    }
}

#[test]
fn a_lamp_far_away_does_not_stretch_the_grid() {
    let mut records = scene(3, 1500);
    // each in a store of its own: by name they are one scene
    let manifest = |records: &[Record]| run(records, &settings(23, true), &MemoryObjects::new()).unwrap().manifest;
    let near = manifest(&records);
    let lamp = |x: f64, shape: u32| {
        let corner = |dx: f64, dy: f64| [1000.0 + x + dx, 1000.0 + dy, 1000.0 + 0.1 * x];
        Record::Triangle(TriangleRecord {
            p: [corner(-1.0, -1.0), corner(1.0, -1.0), corner(0.0, 1.0)],
            n: None,
            uv: None,
            attribute: None,
            shape,
        })
    };
    records.extend([lamp(80.0, 1), lamp(-60.0, 1)]);
    let far = manifest(&records);
    assert_eq!(far.grid.subdiv, near.grid.subdiv);
    // the equal cells span what they did without the lamps, or less: emitters among the first records are not among what they fit
    let world = |at: [f32; 3], m: &Manifest| -> [f64; 3] { std::array::from_fn(|a| f64::from(at[a]) + m.offset[a]) };
    let (lo, hi) = (world(far.grid.inner_lo, &far), world(far.grid.inner_hi, &far));
    let (near_lo, near_hi) = (world(near.lo, &near), world(near.hi, &near));
    assert!((0..3).all(|a| lo[a] >= near_lo[a] - 1e-3 && hi[a] <= near_hi[a] + 1e-3), "{lo:?} {hi:?}");
    assert!(far.hi[0] - far.lo[0] > 100.0);
    // the lamps' cells belong to the outer layer
    let lattice = far.grid.lattice().unwrap();
    let outer: Vec<&CellData> = far
        .grid
        .cells
        .iter()
        .filter(|c| lattice.coordinates(c.index).is_some_and(|at| at[0] == 0 || at[0] + 1 == lattice.count(0)))
        .collect();
    assert!(!outer.is_empty());
    // the same two dark: now they are part of what the cells divide
    let end = records.len();
    records.splice(end - 2.., [lamp(80.0, 0), lamp(-60.0, 0)]);
    let dark = manifest(&records);
    assert!(dark.grid.subdiv > near.grid.subdiv);
    assert_eq!((dark.grid.inner_lo, dark.grid.inner_hi), (dark.lo, dark.hi));
}

/// Blocks that others build of what was packed make the manifest and the objects of a scene that one process prepares.
#[test]
fn a_draft_with_its_blocks_is_the_scene() {
    let records = scene(3, 3000);
    for (splits, reduce) in [(7, true), (7, false), (1, true)] {
        let (whole, parts) = (MemoryObjects::default(), MemoryObjects::default());
        let wanted = run(&records, &settings(splits, reduce), &whole).unwrap();
        let (source, packed) = (List::new(records.clone()), MemoryObjects::default());
        let keep = |bytes: &[u8]| packed.put(ObjectKind::Geometry, bytes);
        let of = |least| {
            let (description, settings) = (description("list"), settings(splits, reduce));
            let apart = Apart { least, keep: &keep };
            draft(&description, &source, &settings, &SpoolSettings::default(), (&parts, &apart), &NoProgress).unwrap()
        };
        let Outcome::Draft(first) = of(2) else {
            assert_eq!(splits, 1, "one split is built where it is cut");
            continue;
        };
        assert!(parts.names().unwrap().is_empty(), "a draft has no name");
        // a draft is a manifest in all but what it names
        let first = Manifest::decode(&first.encode()).unwrap();
        let blocks: Vec<ObjectRef> = (0..)
            .zip(&first.splits)
            .map(|(number, split)| {
                let bytes = packed.get(&split.geometry).unwrap();
                assert!(bytes.len() as u64 <= packed_most(split.triangles + split.spheres));
                assert!(matches!(build(number, &bytes[1..], false), Err(PrepareError::Inconsistent(_))));
                let block = build(number, &bytes, number % 2 == 0).unwrap();
                parts.put(ObjectKind::Geometry, &block).unwrap()
            })
            .collect();
        assert!(complete(first.clone(), &blocks[1..]).is_err());
        let weights: Vec<u64> = first.splits.iter().map(|s| s.weight()).collect();
        let made = complete(first, &blocks).unwrap();
        assert_eq!(made.encode(), wanted.manifest.encode());
        assert_eq!(made.splits.iter().map(|s| s.weight()).collect::<Vec<_>>(), weights, "known before");
        assert!(made.objects().all(|o| parts.get(o).is_ok()));
        assert!(matches!(of(u64::MAX), Outcome::Prepared(p) if p.manifest == made), "a small scene");
    }
}
