use proptest::prelude::*;
use proptest::strategy::ValueTree;
use rayherd_render::aov::Aovs;
use rayherd_render::camera::Camera;
use rayherd_render::filter::Filter;
use rayherd_render::light::Lights;
use rayherd_render::material::{Bsdf, Material};
use rayherd_render::path::{Context, Outcome, Surface, Surfaces, shade};
use rayherd_render::ray::{Hit, PrimId, Ray};
use rayherd_render::world::{EmissivePrimitive, Environment, Primitive, ShapeInfo, World};
use rayherd_tests::mutation;

use super::*;

const SIZE: [u32; 2] = [96, 64];

fn frame() -> Frame {
    let to_world = [[-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, -1.0, 9.0]];
    Frame {
        camera: Camera::new(&to_world, 50.0, SIZE, [0.0; 3]).unwrap(),
        size: SIZE,
        filter: Filter::Box,
        seed: 1,
        max_depth: 20,
        rr_depth: 5,
        split: 1,
        hide_emitters: false,
        aovs: Aovs::NONE,
    }
}

fn key() -> impl Strategy<Value = PathKey> {
    let vertex = prop_oneof![Just(0u16), 1u16..9, any::<u16>()];
    (0..SIZE[0] * SIZE[1], 0..MAX_SAMPLES, prop_oneof![Just(0u16), 0..MAX_SPLIT as u16], vertex)
        .prop_map(|(pixel, sample, branch, vertex)| PathKey { pixel, sample, branch, vertex })
}

fn float() -> impl Strategy<Value = f32> {
    // NaN too, with and without its sign and its payload: who reads a group sees what was written
    let nan = prop_oneof![Just(f32::NAN), Just(-f32::NAN), Just(f32::from_bits(0x7f80_0001))];
    prop_oneof![-10f32..10.0, Just(0.0), Just(-0.0), Just(f32::INFINITY), any::<f32>(), nan]
}

fn triple() -> impl Strategy<Value = [f32; 3]> {
    prop_oneof![[float(), float(), float()], float().prop_map(|x| [x; 3])]
}

fn direction() -> impl Strategy<Value = UnitDir> {
    [-1f32..1.0, -1f32..1.0, -1f32..1.0].prop_filter_map("a direction", |v| {
        let length = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        (length > 0.1).then(|| UnitDir::encode(v.map(|x| x / length)))
    })
}

fn visit() -> impl Strategy<Value = Visit> {
    prop_oneof![
        Just(Visit::START),
        Just(Visit::DECIDED),
        (any::<u32>(), any::<u16>()).prop_map(|(p, owner)| Visit { progress: Progress(p), owner })
    ]
}

fn path_flight() -> impl Strategy<Value = PathFlight> {
    let candidate = prop_oneof![
        Just(Candidate::NONE),
        (float(), any::<u64>(), any::<u32>()).prop_map(|(t, prim, split)| Candidate { t, prim, split })
    ];
    (triple(), direction(), key(), triple(), float(), candidate, visit(), any::<bool>()).prop_map(
        |(o, dir, key, throughput, pdf, candidate, visit, camera)| {
            let ray = PathRay { o, dir, key, throughput, pdf };
            let ray = if camera { camera_ray(&frame(), key.pixel, key.sample) } else { ray };
            PathFlight { ray, candidate, visit }
        },
    )
}

fn shadow_flight() -> impl Strategy<Value = ShadowFlight> {
    (triple(), direction(), key(), triple(), float(), visit()).prop_map(|(o, dir, key, contribution, tmax, visit)| {
        ShadowFlight { ray: ShadowRay { o, dir, tmax, contribution, key }, visit }
    })
}

fn flights() -> impl Strategy<Value = Flights> {
    let (paths, shadows) = (prop::collection::vec(path_flight(), 0..60), prop::collection::vec(shadow_flight(), 0..60));
    (paths, shadows).prop_map(|(paths, shadows)| Flights { paths, shadows })
}

/// The plain twin: one after the other, field by field, sorted as text.
fn plain(rays: &Flights) -> Vec<String> {
    let paths = rays
        .paths
        .iter()
        .map(|f| format!("{:?} {} {:?}", bytemuck::bytes_of(&f.ray), f.candidate.t.to_bits(), (f.candidate, f.visit)));
    let shadows = rays.shadows.iter().map(|f| format!("{:?} {:?}", bytemuck::bytes_of(&f.ray), f.visit));
    let mut all: Vec<String> = paths.chain(shadows).collect();
    all.sort();
    all
}

proptest! {
    #[test]
    fn every_ray_comes_back_to_the_bit(mut rays in flights()) {
        let frame = frame();
        let payload = encode_payload(&frame, &rays);
        prop_assert!(payload.len() <= MAX_BYTES * rays.len() + 100);
        let back = decode(&frame, &encode(&frame, &rays).unwrap()).unwrap();
        prop_assert_eq!(plain(&rays), plain(&back));
        rays.paths.reverse();
        rays.shadows.reverse();
        prop_assert_eq!(&encode_payload(&frame, &rays), &payload, "order is nothing");
        prop_assert_eq!(encode_payload(&frame, &back), payload);
    }

    #[test]
    fn columns_come_back(values in prop::collection::vec(prop_oneof![0u64..300, any::<u64>()], 0..50)) {
        let small: Vec<u32> = values.iter().map(|&v| v as u32).collect();
        let mut w = Writer::default();
        w.narrow(values.iter().copied());
        w.narrow(columns::zigzag_steps(small.iter().copied()));
        w.narrow(columns::changes(values.iter().copied()));
        w.bits(values.iter().map(|v| v % 2 == 1));
        let mut r = Reader::new(&w.bytes);
        prop_assert_eq!(&r.narrow::<u64>(values.len()).unwrap(), &values);
        prop_assert_eq!(columns::undo_zigzag_steps(r.narrow(values.len()).unwrap()), small);
        prop_assert_eq!(&columns::undo_changes::<u64>(r.narrow(values.len()).unwrap()), &values);
        prop_assert_eq!(r.bits(values.len()).unwrap(), values.iter().map(|v| v % 2 == 1).collect::<Vec<_>>());
        prop_assert!(r.end().is_ok());
    }
}

/// What is read without an error is what would be written: no two bodies for the same rays, no panic, no large allocation.
fn check_mutant(frame: &Frame, payload: &[u8]) -> bool {
    match decode_payload(frame, payload) {
        Ok(rays) => {
            assert_eq!(encode_payload(frame, &rays), payload, "read, but written differently");
            true
        }
        Err(WireError::Corrupt(_) | WireError::TooLarge { .. }) => false,
        Err(other) => panic!("{other}"),
    }
}

/// Mutations of good payloads, past the checksum.
#[test]
fn mutants_are_read_or_refused() {
    let frame = frame();
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let seeds: Vec<Vec<u8>> = (0..8)
        .map(|_| encode_payload(&frame, &flights().new_tree(&mut runner).unwrap().current()))
        .chain([encode_payload(&frame, &Flights::default())])
        .collect();
    let mut read = 0;
    let rounds = mutation::rounds("ray group", 20_000, |random| {
        let mut payload = seeds[random.below(seeds.len())].clone();
        if random.below(4) == 0 {
            // the counts
            let at = random.below(payload.len().min(16));
            payload[at] = random.bits() as u8;
        } else {
            payload = mutation::bytes(&payload, random);
        }
        read += u64::from(check_mutant(&frame, &payload));
    });
    assert!(
        rounds.is_none_or(|n| read > n / 100 && read < n),
        "{read} of {rounds:?} mutants were read: they test nothing"
    );
}

#[test]
fn what_is_not_this_pictures_is_refused() {
    let frame = frame();
    let rays = Flights { paths: vec![PathFlight::new(camera_ray(&frame, SIZE[0] * SIZE[1] - 1, 3))], shadows: vec![] };
    let body = encode(&frame, &rays).unwrap();
    assert!(decode(&frame, &body).is_ok());
    let smaller = Frame { size: [SIZE[0], SIZE[1] - 1], ..frame.clone() };
    assert!(matches!(decode(&smaller, &body), Err(WireError::Corrupt(_))));
    let mut many = [u32::MAX, 0, 0, 0].map(u32::to_le_bytes).concat();
    assert!(matches!(decode_payload(&frame, &many), Err(WireError::TooLarge { what: "rays", .. })));
    many[..4].copy_from_slice(&1_000_000u32.to_le_bytes());
    assert!(matches!(decode_payload(&frame, &many), Err(WireError::Corrupt(_))));
}

/// Spheres in a heap under a sky and a lamp, by trying every one.
struct Heap {
    spheres: Vec<([f32; 3], f32)>,
}

impl Heap {
    fn new() -> Self {
        let place = |i: u32| {
            let h = |k: u32| f64::from(i.wrapping_mul(2_654_435_761).wrapping_add(k * 40_503).reverse_bits()) / 4.3e9;
            let (x, y, z) = (h(1) * 8.0 - 4.0, h(7) * 3.0 - 1.0, h(13) * 8.0 - 4.0);
            ([x as f32, y as f32, z as f32], (0.2 + 0.3 * h(29)) as f32)
        };
        let ground = ([0.0, -1001.0, 0.0], 1000.0);
        Heap { spheres: [ground, ([0.0, 6.0, 0.0], 1.0)].into_iter().chain((0..200).map(place)).collect() }
    }

    fn world(&self, albedo: impl Fn(usize) -> [f32; 3]) -> World {
        let sphere = |(center, radius): ([f32; 3], f32)| Primitive::Sphere { center, radius, flipped: false };
        let n = self.spheres.len();
        let material = |i: usize| {
            let bsdf = Bsdf::Diffuse { reflectance: albedo(i) };
            Material::new("", bsdf, true)
        };
        let shape = |i: usize| ShapeInfo {
            name: String::new(),
            material: i as u32,
            emission: (i == 1).then_some([20.0; 3]),
            emission_texture: None,
        };
        World {
            materials: (0..n).map(material).collect(),
            shapes: (0..n).map(shape).collect(),
            emissive: vec![EmissivePrimitive { prim: 1, shape: 1, geometry: sphere(self.spheres[1]) }],
            beams: vec![],
            environment: Some(Environment::Constant([0.5; 3])),
            sun: None,
            lo: [-1001.0; 3],
            hi: [1001.0; 3],
            ..World::default()
        }
    }

    fn closest(&self, ray: &Ray) -> Hit {
        let mut hit = Hit::miss(ray.tmax);
        for (i, (c, r)) in self.spheres.iter().enumerate() {
            let o: [f64; 3] = std::array::from_fn(|k| f64::from(ray.o[k]) - f64::from(c[k]));
            let d = ray.d.map(f64::from);
            let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            let (a, b, c) = (dot(d, d), dot(o, d), dot(o, o) - f64::from(*r) * f64::from(*r));
            let root = (b * b - a * c).max(0.0).sqrt();
            for t in [(-b - root) / a, (-b + root) / a] {
                if b * b > a * c && t > 1e-4 && (t as f32) < hit.t {
                    hit = Hit { t: t as f32, u: 0.0, v: 0.0, prim: i as u32, leaf: 0, lane: 0 };
                }
            }
        }
        hit
    }
}

struct Seen<'a>(&'a Heap);

impl Surfaces for Seen<'_> {
    fn surface(&self, _index: usize, hit: &Hit) -> Surface {
        let (center, radius) = self.0.spheres[hit.prim as usize];
        let geometry = Primitive::Sphere { center, radius, flipped: false };
        Surface { geometry, normals: None, uv: None, attribute: None }
    }
    fn shape(&self, _index: usize, hit: &Hit) -> u32 {
        hit.prim
    }
    fn prim(&self, _: usize, hit: &Hit) -> PrimId {
        hit.prim.into()
    }
}

/// Rays that wait for one split of a path traced heap: those that come into one corner of space.
fn real_rays(albedo: impl Fn(usize) -> [f32; 3]) -> Flights {
    let (frame, heap) = (frame(), Heap::new());
    let world = heap.world(albedo);
    let lights = Lights::new(&world);
    let context = Context::new(&world, &lights, &frame);
    let mut rays: Vec<PathRay> = Vec::new();
    for pixel in 0..SIZE[0] * SIZE[1] {
        rays.extend((0..16).map(|sample| camera_ray(&frame, pixel, sample)));
    }
    let mut out = Outcome::default();
    let mut flights = Flights::default();
    // a grid of 16^3 cells of edge 0.5 around the heap; where the ray is half way to its hit
    let cell = |o: [f32; 3], d: [f32; 3], t: f32| {
        let at: [u32; 3] =
            std::array::from_fn(|k| (((o[k] + d[k] * t.min(4.0) * 0.5) + 4.0) * 2.0).clamp(0.0, 15.0) as u32);
        ((at[2] * 16 + at[1]) * 16 + at[0], at)
    };
    for _ in 0..6 {
        let hits: Vec<Hit> = rays.iter().map(|ray| heap.closest(&ray.ray())).collect();
        for (ray, hit) in rays.iter().zip(&hits) {
            let (number, at) = cell(ray.o, ray.dir.decode(), hit.t);
            if at[0] < 8 && at[2] < 8 && ray.key.vertex > 0 {
                let visit = Visit { progress: Progress(number + 1), owner: 0 };
                // every third has found something on its way, in a mesh of 8 million triangles in source order
                let prim = PrimId::from(hit.prim) * 40_000 + u64::from(ray.key.pixel.wrapping_mul(2_654_435_761) >> 18);
                let found = hit.is_hit() && ray.key.sample % 3 == 0;
                let split = (prim / 250_000) as u32;
                let candidate = if found { Candidate { t: hit.t, prim, split } } else { Candidate::NONE };
                flights.paths.push(PathFlight { ray: *ray, candidate, visit });
            }
        }
        shade(&context, &Seen(&heap), &rays, &hits, &mut out);
        for ray in &out.shadow {
            let (number, at) = cell(ray.o, ray.dir.decode(), ray.tmax);
            if at[0] < 8 && at[2] < 8 {
                flights
                    .shadows
                    .push(ShadowFlight { ray: *ray, visit: Visit { progress: Progress(number + 1), owner: 0 } });
            }
        }
        rays = std::mem::take(&mut out.next);
        out.clear();
    }
    flights
}

#[test]
fn real_rays_take_less_than_40_bytes() {
    let grey = |_: usize| [0.7; 3];
    let coloured = |i: usize| std::array::from_fn(|c| 0.2 + 0.6 * ((i * 7 + c * 5) % 11) as f32 / 11.0);
    let frame = frame();
    for (name, all) in [("grey", real_rays(grey)), ("coloured", real_rays(coloured))] {
        let paths = Flights { paths: all.paths.clone(), shadows: vec![] };
        let shadows = Flights { paths: vec![], shadows: all.shadows.clone() };
        for (kind, rays) in [("paths", &paths), ("shadows", &shadows), ("both", &all)] {
            assert!(rays.len() > 5000, "{} {name} {kind}", rays.len());
            let (raw, packed) = (encode_payload(&frame, rays).len(), encode(&frame, rays).unwrap().len());
            let each = |bytes: usize| bytes as f64 / rays.len() as f64;
            println!("{name} {kind}: {} rays, {:.1} bytes each, packed {:.1}", rays.len(), each(raw), each(packed));
            assert!(raw <= 64 * rays.len() && packed < 40 * rays.len(), "{name} {kind}");
        }
    }
}
