//! NaN, infinities and their like in what comes from another worker: refused with the object's name, or counted and named by sample, never in a pixel.

use std::sync::Arc;

use rayherd_render::attributes::{AttributeBlock, NO_UV};
use rayherd_render::film::FilmPart;
use rayherd_render::path::{ShadowRay, camera_ray};
use rayherd_render::ray::PathKey;
use rayherd_render::skip::{Skip, Skips};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{MemoryObjects, ObjectKind, ObjectStore};

use super::attempt::{Attempt, FilmUse, Made, Shared, run};
use super::nodes::Nodes;
use super::*;
use crate::flight::{Candidate, Flights, PathFlight, ShadowFlight, Visit};
use crate::job::{NodeSpec, Silent};
use crate::ledger::{Destination, GroupRef};
use crate::plan::Set;
use crate::report::Kind;
use crate::store::MemoryStore;
use crate::task::codec;
use crate::testing;
use crate::wire::ray_group;

/// No number that a throughput or an origin can be.
const POISON: [f32; 4] = [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

struct Never;

impl crate::task::Stop for Never {
    fn check(&self) -> Result<(), JobError> {
        Ok(())
    }
}

/// One bounce of every third pixel: as if each had left a mirror before the camera. They must be sorted by key.
fn bounced(frame: &Frame, sample: u32) -> Flights {
    let flight = |pixel: u32| {
        let ray = camera_ray(frame, pixel, sample);
        PathFlight::new(rayherd_render::path::PathRay { key: PathKey { vertex: 1, ..ray.key }, pdf: 1.0, ..ray })
    };
    Flights { paths: (0..frame.size[0] * frame.size[1]).step_by(3).map(flight).collect(), shadows: Vec::new() }
}

/// Stores rays as a group and has a task trace them, which holds some of the splits.
fn traced(scene: &PreparedScene, frame: &Frame, rays: &Flights, set: &[u32]) -> Result<Made, JobError> {
    let settings = JobSettings { nodes: vec![NodeSpec { slots: 1 }], batch: 64, ..JobSettings::default() };
    let nodes = Nodes::new(scene, &settings, Arc::new(MemoryStore::default()))?;
    let body = ray_group::encode(frame, rays).unwrap();
    let bytes = body.len() as u64;
    let holders = nodes.put(0, Kind::Rays, "rays/poisoned", body)?;
    let group = GroupRef {
        key: "rays/poisoned".into(),
        to: Destination::Split(set[0]),
        rays: rays.len() as u32,
        bytes,
        holders,
    };
    let shared =
        Shared { scene, frame, settings: &settings, nodes, film: FilmUse::Handed { stored: false }, buckets: 1 };
    let set = Set::Resident(set.to_vec());
    run(&shared, &Attempt { name: "a".into(), node: 0, set, groups: vec![group], camera: Vec::new() }, &Never)
}

fn sums(film: &FilmPart) -> Vec<u32> {
    film.resolve(1).as_flattened().iter().map(|x| x.to_bits()).collect()
}

/// All splits with and without asking the grid, and one of several.
fn cases() -> Vec<(PreparedScene, Vec<u32>)> {
    let mut out = Vec::new();
    for (splits, held) in [(1, 1), (9, usize::MAX), (9, 2)] {
        for skips in [Skips::ALL, Skips::ALL.without(Skip::Walk)] {
            let scene = testing::prepared(&testing::cornell(), splits, true).skipping(skips);
            let set = scene.grid.owning().iter().take(held).collect();
            out.push((scene, set));
        }
    }
    out
}

#[test]
fn light_that_is_no_number_is_counted_and_named_wherever_it_comes_from() {
    for (scene, set) in cases() {
        let frame = testing::frame(&scene, [24, 18], 1);
        let clean = bounced(&frame, 0);
        let alone = traced(&scene, &frame, &clean, &set).unwrap();
        let film = alone.film.unwrap();
        assert_eq!(film.rejected().count, 0);
        assert!(sums(&film).iter().any(|&x| x > 0));
        for poison in [&POISON[..], &[-1.0, f32::MAX]].concat() {
            let mut both = bounced(&frame, 1);
            both.paths.iter_mut().for_each(|f| f.ray.throughput = [poison; 3]);
            let mut sorted = Flights { paths: clean.paths.clone(), shadows: Vec::new() };
            sorted.append(&mut both);
            let made = traced(&scene, &frame, &sorted, &set).unwrap();
            let found = made.film.unwrap();
            let rejected = found.rejected();
            // where splits are missing all of it may have gone on in shadow rays
            let whole = scene.grid.owning().iter().all(|s| set.contains(&s));
            let (count, name) = (rejected.count, format!("{poison} in {} of {} splits", set.len(), scene.splits()));
            assert!(count > 0 || (!whole && made.hops > 0), "{name}: {count} and {} hops", made.hops);
            assert_eq!(made.outputs.non_finite, count, "{name}");
            assert!(
                rejected.keys.iter().all(|&(pixel, sample)| pixel % 3 == 0 && sample == 1),
                "{poison}: {rejected:?}"
            );
            // the others bring what they brought alone
            assert!(sums(&found) == sums(&film), "{poison}");
        }
        // in shadow rays: upwards from the floor, where nothing or something is in the way
        let key = |sample| PathKey { pixel: 7, sample, branch: 0, vertex: 1 };
        let shadow = |poison: f32, sample: u32| ShadowFlight {
            ray: ShadowRay { contribution: [poison; 3], tmax: 1e-3, key: key(sample), ..shadow_ray(&frame) },
            visit: Visit::START,
        };
        let rays = Flights { paths: Vec::new(), shadows: (0..4).map(|s| shadow(POISON[s], s as u32)).collect() };
        let made = traced(&scene, &frame, &rays, &set).unwrap();
        // a ray that goes on is not added here
        assert_eq!(made.film.unwrap().rejected().count + made.hops, 4);
    }
}

fn shadow_ray(frame: &Frame) -> ShadowRay {
    let ray = camera_ray(frame, 7, 0);
    ShadowRay { o: ray.o, dir: ray.dir, tmax: f32::INFINITY, contribution: [1.0; 3], key: ray.key }
}

#[test]
fn rays_that_cannot_be_are_refused_by_name() {
    let scene = testing::prepared(&testing::cornell(), 9, true);
    let set: Vec<u32> = scene.grid.owning().iter().collect();
    let frame = testing::frame(&scene, [24, 18], 1);
    let mut wrong: Vec<(&str, Flights)> = Vec::new();
    for poison in POISON {
        for axis in 0..3 {
            let mut rays = bounced(&frame, 0);
            rays.paths[5].ray.o[axis] = poison;
            wrong.push(("an origin", rays));
            let mut ray = shadow_ray(&frame);
            ray.o[axis] = poison;
            wrong.push((
                "an origin",
                Flights { paths: vec![], shadows: vec![ShadowFlight { ray, visit: Visit::START }] },
            ));
        }
        let mut rays = bounced(&frame, 0);
        rays.paths[5].candidate = Candidate { t: poison, prim: 1, split: 0 };
        wrong.push(("a hit", rays));
    }
    for poison in [f32::NAN, -1.0, f32::NEG_INFINITY] {
        let mut rays = bounced(&frame, 0);
        rays.paths[5].ray.pdf = poison;
        wrong.push(("a density", rays));
        let ray = ShadowRay { tmax: poison, ..shadow_ray(&frame) };
        wrong.push(("an end", Flights { paths: vec![], shadows: vec![ShadowFlight { ray, visit: Visit::START }] }));
    }
    for (what, rays) in wrong {
        let error = traced(&scene, &frame, &rays, &set).err().unwrap_or_else(|| panic!("{what} was taken")).to_string();
        let pixel = rays.paths.get(5).map_or(7, |f| f.ray.key.pixel);
        for part in ["rays/poisoned", &format!("of pixel {pixel} has {what} that no ray has")] {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
    // a sky's shadow ray ends nowhere, a density may be too large for a float
    let mut rays = bounced(&frame, 0);
    rays.paths[5].ray.pdf = f32::INFINITY;
    rays.shadows.push(ShadowFlight { ray: shadow_ray(&frame), visit: Visit::START });
    traced(&scene, &frame, &rays, &set).unwrap();
}

/// What a worker that prepared put into normals and texture coordinates: no pixel of it is no number.
#[test]
fn attributes_that_are_no_numbers_reach_no_pixel() {
    let scene = testing::prepared(&testing::cornell(), 4, true);
    for poison in [&POISON[..], &[f32::MAX, 1e-45]].concat() {
        let objects = Arc::new(MemoryObjects::default());
        let mut manifest: Manifest = scene.manifest.clone();
        for object in scene.manifest.objects() {
            objects.put(ObjectKind::Geometry, &scene.objects.get(object).unwrap()).unwrap();
        }
        for split in &mut manifest.splits {
            let n = (split.triangles + split.spheres) as u32;
            let mut block = AttributeBlock::decode(&scene.objects.get(&split.attributes).unwrap(), n).unwrap();
            block.normals = (0..n)
                .map(|i| {
                    [[poison, 1.0, 0.0], [0.0, poison, 1.0], [1.0; 3]].map(|v| if i % 2 == 0 { v } else { [poison; 3] })
                })
                .collect();
            block.uvs = (0..n).map(|i| if i % 3 == 0 { NO_UV } else { [[0.5, poison]; 3] }).collect();
            block.attributes = vec![[[poison; 3]; 3]; n as usize];
            split.attributes = objects.put(ObjectKind::Attributes, &block.encode()).unwrap();
        }
        let poisoned = PreparedScene::open(manifest, objects).unwrap();
        let frame = testing::frame(&poisoned, [24, 18], 1);
        let sampling = Sampling { spp: 2, target_error: None, time_limit: None };
        let made = render_local(&poisoned, &frame, &sampling, &JobSettings::default(), &Silent).unwrap();
        let bad = made.image.pixels.as_flattened().iter().filter(|x| !x.is_finite() || **x < 0.0).count();
        assert_eq!(bad, 0, "{poison}");
        let rejected = made.film.rejected();
        assert_eq!((made.report.non_finite, rejected.count), (rejected.count, made.report.non_finite));
        assert_eq!(rejected.count == 0, rejected.keys.is_empty(), "{poison}");
        println!("{poison}: {} counted", rejected.count);
    }
}

/// Sums are integers: a film part has no place for what is no number. What it says of contributions that were none comes with it.
#[test]
fn a_film_part_brings_its_counts_and_no_others() {
    let scene = testing::prepared(&testing::cornell(), 1, true);
    let frame = testing::frame(&scene, [24, 18], 1);
    let mut part = FilmPart::new(frame.layout());
    part.add(5, 2, [f32::NAN, 1.0, 1.0]);
    part.add(9, 3, [1.0, 1.0, f32::INFINITY]);
    part.add(11, 3, [1.0; 3]);
    let sealed = codec::seal_film(&part.encode());
    let mut film = FilmPart::new(frame.layout());
    film.add_encoded(&codec::open_film(frame.layout(), &sealed).unwrap(), 0..u32::MAX).unwrap();
    assert_eq!((film.rejected().count, film.rejected().keys.len()), (2, 2));
    assert_eq!(sums(&film), sums(&part));
    // keys of a larger picture
    let larger = Frame { size: [240, 180], ..frame.clone() };
    let mut part = FilmPart::new(larger.layout());
    part.add(40_000, 2, [f32::NAN; 3]);
    let mut bytes = part.encode();
    for (at, size) in [(4, 24u32), (8, 18)] {
        bytes[at..at + 4].copy_from_slice(&size.to_le_bytes());
    }
    let error = codec::open_film(frame.layout(), &codec::seal_film(&bytes)).unwrap_err().to_string();
    assert!(error.starts_with("corrupt"), "{error}");
}
