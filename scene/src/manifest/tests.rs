use rayherd_tests::mutation;

use super::*;
use crate::description::Affine;
use crate::grid::CellData;
use crate::objects::MemoryObjects;
use crate::prepare::Cut;

/// A small manifest that passes every check.
pub(crate) fn sample() -> Manifest {
    let object = |text: &str| ObjectRef::of(text.as_bytes());
    let split = |i: u64, copied| SplitEntry {
        geometry: object(&format!("geometry {i}")),
        attributes: object(&format!("attributes {i}")),
        triangles: 3,
        spheres: 1,
        lo: [-1.0; 3],
        hi: [0.1, 0.3, 1.0],
        first_id: if copied { 0 } else { i * 5 },
        last_id: if copied { 9 } else { i * 5 + 4 },
        copied,
    };
    let cell = |index, lo: f32, owner| CellData {
        index,
        lo: [lo, -1.0, -1.0],
        hi: [lo + 0.125, -0.1, 0.0],
        primitives: 2,
        owners: vec![owner],
    };
    Manifest {
        format: FORMAT,
        settings: PrepareSettings { cut: Cut::Splits(2), ..Default::default() },
        source: ObjectHash::of(b"source"),
        content: ObjectHash::of(b"content"),
        offset: [0.1, 1e300, -2.5],
        lo: [-1.0; 3],
        hi: [1.0; 3],
        world: object("world"),
        sky_map: Some(object("sky")),
        tiles: vec![object("tile"), object("tile"), object("other tile")],
        splits: vec![split(0, false), split(1, false), split(2, true)],
        grid: GridData {
            subdiv: 2,
            inner_lo: [-1.0; 3],
            inner_hi: [1.0; 3],
            lo: [-1.0; 3],
            hi: [1.0; 3],
            cells: vec![cell(0, -0.7, 2), cell(1, 0.3, 1)],
        },
        choice: GridChoice {
            subdiv: 2,
            candidates: vec![Candidate { subdiv: 2, occupied: 2, fullest: 4, pairs: 8, contested_pairs: 4 }],
            stopped_by: StoppedBy::Several,
            capacity: 4,
            contested_cells: 1,
            copied_cells: 1,
            contested_primitives: 4,
            copies: 4,
            rewritten_bytes: 200,
        },
        defaults: Defaults {
            camera: Some(Camera::perspective(Affine::IDENTITY, 39.3)),
            filter: Some(Filter::Gaussian { stddev: 0.5 }),
            ..Default::default()
        },
        counts: Counts { records: 10, triangles: 6, spheres: 2, degenerate: 2, ..Default::default() },
        homes: None,
    }
}

#[test]
fn a_manifest_comes_back_to_the_byte() {
    let manifest = sample();
    let bytes = manifest.encode();
    let again = Manifest::decode(&bytes).unwrap();
    assert_eq!(again, manifest);
    assert_eq!(again.encode(), bytes);
    assert_eq!(again.reference(), ObjectRef::of(&bytes));
}

#[test]
fn a_scene_is_found_only_when_it_is_whole() {
    let store = MemoryObjects::new();
    let manifest = sample();
    let find = |store: &MemoryObjects, m: &Manifest| Manifest::find(store, &m.source, &m.settings).unwrap();
    assert!(find(&store, &manifest).is_none());
    let name = manifest.store(&store).unwrap();
    assert!(find(&store, &manifest).is_none(), "its objects are missing");
    store.put(ObjectKind::Manifest, b"world").unwrap();
    store.put(ObjectKind::Texture, b"sky").unwrap();
    store.put(ObjectKind::Texture, b"tile").unwrap();
    store.put(ObjectKind::Texture, b"other tile").unwrap();
    for i in 0..3 {
        store.put(ObjectKind::Geometry, format!("geometry {i}").as_bytes()).unwrap();
        store.put(ObjectKind::Attributes, format!("attributes {i}").as_bytes()).unwrap();
    }
    assert_eq!(find(&store, &manifest), Some((name, manifest.clone())));
    let mut other = manifest.clone();
    other.settings.several = 17;
    assert!(find(&store, &other).is_none());
    store.tamper(name.hash, Some(b"{}".to_vec()));
    assert!(find(&store, &manifest).is_none(), "a broken manifest is as none");
}

#[test]
fn broken_manifests_are_refused_with_a_reason() {
    let changes: Vec<fn(&mut Manifest)> = vec![
        |m| m.settings.several = 0,
        |m| m.settings.overlap_threshold = 1.5,
        |m| m.splits.clear(),
        |m| m.splits[0].triangles = u64::MAX,
        |m| m.splits[0].triangles = 4,
        |m| m.splits[0].last_id = 7,
        |m| m.splits[0].first_id = 3,
        |m| m.splits[2].last_id = 10,
        |m| m.splits[0].copied = true,
        |m| m.splits[1].lo[0] = 0.5,
        |m| m.splits[1].hi[2] = 1.5,
        |m| m.splits[1].attributes = ObjectRef { bytes: 1, ..m.splits[0].attributes },
        |m| m.splits[1].geometry.bytes = 1 << 50,
        |m| m.tiles[1].bytes = 1,
        |m| m.tiles[2].bytes = 1 << 50,
        |m| m.grid.lo[0] = -2.0,
        |m| m.grid.cells[0].owners[0] = 3,
        |m| m.grid.cells[0].owners.push(2),
        |m| m.settings.overlap_reduction = false,
    ];
    for (i, change) in changes.iter().enumerate() {
        let mut bad = sample();
        change(&mut bad);
        assert!(matches!(Manifest::decode(&bad.encode()), Err(ManifestError::Malformed(_))), "change {i}");
    }
    let mut old = sample();
    old.format = 0;
    assert!(matches!(Manifest::decode(&old.encode()), Err(ManifestError::Format { found: 0 })));
}

#[test]
fn mutated_bytes_are_refused_or_canonical_and_never_panic() {
    let bytes = sample().encode();
    let words = ["1e400", "1e39", "\"x\"", "{}", "[]", "\"Auto\"", "\"format\":0,"];
    let mut read = 0;
    let rounds = mutation::rounds("manifest", 20_000, |random| {
        let mutated = mutation::text(&bytes, &words, random);
        if let Ok(manifest) = Manifest::decode(&mutated) {
            assert_eq!(manifest.encode(), mutated);
            manifest.grid().unwrap();
            read += 1;
        }
    });
    assert!(rounds.is_none_or(|n| read > n / 100 && read < n), "{read} of {rounds:?}");
}

#[test]
fn homes_are_written_where_there_are_any_and_never_none() {
    let manifest = sample();
    assert!(!String::from_utf8(manifest.encode()).unwrap().contains("homes"), "scenes of one machine keep their names");
    let with = |homes: &[u32]| Manifest::decode(&Manifest { homes: Some(homes.to_vec()), ..sample() }.encode());
    assert_eq!(with(&[3, 1]).unwrap().homes, Some(vec![3, 1]));
    for wrong in [&[][..], &[3, 3]] {
        assert!(with(wrong).unwrap_err().to_string().contains("lie on no store"));
    }
}
