//! What each material and each texture look-up costs: nanoseconds of one thread.
//!
//! `looks [REPETITIONS]` prints, for every model, a direction sampled with its value and density (`sample` and `eval`, one by one), then a whole vertex of a
//! path under a sky: by the blocks that jobs shade with, and one by one (the twin that takes what blocks do not). Then look-ups by kind of texture, where
//! they lie close together and where each is somewhere else. Medians with the interval that holds them with 95 %.

use std::cell::{Ref, RefCell};
use std::hint::black_box;

use anyhow::Context as _;
use rayherd_benches::{interval, median, thread_cpu};
use rayherd_render::aov::Aovs;
use rayherd_render::camera::Camera;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;
use rayherd_render::light::Lights;
use rayherd_render::material::{
    Amount, Blend, Bsdf, Detail, Distribution, Material, Principled, Relief, ReliefKind, Slot, Textured, Transmittance,
};
use rayherd_render::math::UnitDir;
use rayherd_render::path::{Context, Outcome, PathRay, Surface, Surfaces, shade_traced};
use rayherd_render::ray::{Hit, PathKey, PrimId, Ray};
use rayherd_render::skip::{Skip, Skips};
use rayherd_render::texture::{
    At, Bitmap, Checkerboard, Filter as TexelFilter, TILE, Texel, Texture, Textures, UvMap, Wrap,
};
use rayherd_render::world::{Environment, Primitive, ShapeInfo, World};

/// Rays of a batch, about as many as a job's.
const BATCH: usize = 4096;
/// Look-ups and samples of one measurement.
const MANY: usize = 1 << 20;
/// A triangle whose front is +z.
const TRIANGLE: [[f32; 3]; 3] = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]];

fn main() -> anyhow::Result<()> {
    let repetitions = std::env::args().nth(1).map_or(Ok(9), |n| n.parse()).context("usage: looks [REPETITIONS]")?;
    println!("| material | sample and eval | vertex in a block | vertex one by one |\n|---|---|---|---|");
    for (name, bsdf, detail) in materials() {
        let plain = if detail == Detail::default() { told(repetitions, || samples(&bsdf)) } else { String::new() };
        let vertex = |skips: Skips| {
            let scene = Scene::new(bsdf.clone(), detail.clone());
            scene.world.check().map_err(anyhow::Error::msg)?;
            anyhow::Ok(told(repetitions, || scene.vertices(skips)))
        };
        println!("| {name} | {plain} | {} | {} |", vertex(Skips::ALL)?, vertex(Skips::ALL.without(Skip::Details))?);
    }
    println!("\n| look-up | close together | anywhere |\n|---|---|---|");
    for (name, texture) in textures() {
        let tiles = Tiles(RefCell::default());
        if let Texture::Bitmap(image) = &texture {
            tiles.add(image, &mut Random(3));
        }
        let cost = |far: bool| told(repetitions, || look_ups(&texture, &tiles, far));
        println!("| {name} | {} | {} |", cost(false), cost(true));
    }
    Ok(())
}

/// Median and interval, ns.
fn told(repetitions: usize, mut measure: impl FnMut() -> f64) -> String {
    // the first one warms up
    measure();
    let found: Vec<f64> = (0..repetitions.max(1)).map(|_| measure()).collect();
    let (low, high) = interval(&found);
    format!("{:.1} ({low:.1} to {high:.1})", median(found))
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }
    /// In [0, 1).
    fn number(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / 16_777_216.0
    }
    /// A unit direction over the surface, by its cosine.
    fn direction(&mut self) -> [f32; 3] {
        let z = (1.0 - self.number()).sqrt();
        let (r, phi) = ((1.0 - z * z).sqrt(), std::f64::consts::TAU * f64::from(self.number()));
        [r * libm::cos(phi) as f32, r * libm::sin(phi) as f32, z]
    }
}

fn materials() -> Vec<(&'static str, Bsdf, Detail)> {
    let (grey, white, copper) = ([0.5; 3], [1.0; 3], ([0.2, 0.92, 1.1], [3.9, 2.45, 2.14]));
    let rough =
        |distribution, alpha| Bsdf::RoughConductor { distribution, alpha, eta: copper.0, k: copper.1, specular: white };
    let glass = |distribution| Bsdf::RoughDielectric {
        distribution,
        alpha: [0.2; 2],
        eta: 1.5,
        reflect: white,
        transmit: white,
    };
    let (beckmann, ggx) = (Distribution::Beckmann, Distribution::Ggx);
    let coated = |distribution| {
        let coat = Transmittance::new(distribution, 0.2, 1.5);
        Bsdf::RoughPlastic { distribution, alpha: 0.2, eta: 1.5, diffuse: grey, specular: white, nonlinear: true, coat }
    };
    let principled = Principled {
        base_color: grey,
        eta: 1.5,
        roughness: 0.4,
        anisotropic: 0.0,
        metallic: 0.3,
        spec_trans: 0.0,
        spec_tint: 0.0,
        sheen: 0.3,
        sheen_tint: 0.0,
        clearcoat: 0.5,
        clearcoat_gloss: 0.5,
        flatness: 0.0,
    };
    let diffuse = Bsdf::Diffuse { reflectance: grey };
    let plain = Detail::default;
    // texture 0 is colours, 1 numbers
    let painted = || Detail { textured: vec![Textured::new(Slot::Diffuse, 0)], ..plain() };
    let relief = |kind| Detail { relief: Some(Relief { kind, texture: 1, mirrored: true, shadowed: true }), ..plain() };
    // materials 0 and 1 of the world
    let blend = Detail { blend: Some(Blend { weight: Amount::Constant(0.5), parts: [0, 1] }), ..plain() };
    vec![
        ("diffuse", diffuse.clone(), plain()),
        ("conductor", Bsdf::Conductor { eta: copper.0, k: copper.1, specular: white }, plain()),
        ("roughconductor, Beckmann", rough(beckmann, [0.2; 2]), plain()),
        ("roughconductor, GGX", rough(ggx, [0.2; 2]), plain()),
        ("roughconductor, GGX, anisotropic", rough(ggx, [0.1, 0.3]), plain()),
        ("dielectric", Bsdf::Dielectric { eta: 1.5, reflect: white, transmit: white }, plain()),
        ("thindielectric", Bsdf::ThinDielectric { eta: 1.5, reflect: white, transmit: white }, plain()),
        ("roughdielectric, Beckmann", glass(beckmann), plain()),
        ("roughdielectric, GGX", glass(ggx), plain()),
        ("plastic", Bsdf::Plastic { eta: 1.5, diffuse: grey, specular: white, nonlinear: true }, plain()),
        ("roughplastic, Beckmann", coated(beckmann), plain()),
        ("roughplastic, GGX", coated(ggx), plain()),
        ("phong", Bsdf::Phong { diffuse: grey, specular: [0.3; 3], exponent: 30.0 }, plain()),
        ("principled", Bsdf::Principled(principled), plain()),
        ("principled, glass", Bsdf::Principled(Principled { spec_trans: 0.8, ..principled }), plain()),
        ("diffuse of a bitmap", diffuse.clone(), painted()),
        ("roughplastic, GGX, of a bitmap", coated(ggx), painted()),
        ("principled of a bitmap", Bsdf::Principled(principled), painted()),
        ("mask of 0.5 of diffuse", diffuse.clone(), Detail { opacity: Amount::Constant(0.5), ..plain() }),
        ("mask of a bitmap of diffuse", diffuse.clone(), Detail { opacity: Amount::Texture(1), ..plain() }),
        ("bumpmap of diffuse", diffuse.clone(), relief(ReliefKind::Bump(0.05))),
        ("normalmap of diffuse", diffuse.clone(), relief(ReliefKind::Normals)),
        ("blendbsdf of diffuse and roughconductor", diffuse.clone(), blend),
        ("two materials", diffuse, Detail { back: Some(1), ..plain() }),
    ]
}

/// ns of a direction with its value and density.
fn samples(bsdf: &Bsdf) -> f64 {
    let mut random = Random(1);
    let inputs: Vec<_> =
        (0..BATCH).map(|_| (random.direction(), [random.number(), random.number()], random.number())).collect();
    let begin = thread_cpu();
    for _ in 0..MANY / BATCH {
        for (wo, u, lobe) in &inputs {
            let wo = (*wo).into();
            if let Some(sampled) = black_box(bsdf).sample(wo, true, *u, *lobe) {
                black_box(bsdf.eval(wo, sampled.wi, true));
            }
        }
    }
    (thread_cpu() - begin) * 1e9 / MANY as f64
}

struct Tiles(RefCell<Vec<Vec<u8>>>);

impl Textures for Tiles {
    fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        Ref::filter_map(self.0.borrow(), |tiles| tiles.get(number as usize).map(Vec::as_slice)).ok()
    }
    fn at_hand(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        self.tile(number)
    }
}

impl Tiles {
    /// Tiles of noise for an image, which follow those that are there.
    fn add(&self, bitmap: &Bitmap, random: &mut Random) {
        let floats = matches!(bitmap.texel, Texel::Float);
        for number in bitmap.tiles() {
            let bytes = bitmap.tile_bytes(number) as usize;
            let tile: Vec<u8> = if floats {
                (0..bytes / 4).flat_map(|_| random.number().to_le_bytes()).collect()
            } else {
                (0..bytes).map(|_| random.bits() as u8).collect()
            };
            self.0.borrow_mut().push(tile);
        }
    }
}

fn bitmap(size: u32, channels: u8, texel: Texel, filter: TexelFilter, first_tile: u32) -> Bitmap {
    Bitmap { size: [size; 2], channels, texel, wrap: Wrap::Repeat, filter, to_uv: UvMap::IDENTITY, first_tile }
}

/// A triangle of one material under a sky, and rays that hit it.
struct Scene {
    world: World,
    tiles: Tiles,
    rays: Vec<PathRay>,
    traced: Vec<Ray>,
    hits: Vec<Hit>,
}

impl Scene {
    fn new(bsdf: Bsdf, detail: Detail) -> Scene {
        let mut random = Random(2);
        let colors = bitmap(512, 3, Texel::Srgb8, TexelFilter::Bilinear, 0);
        let numbers = bitmap(512, 1, Texel::Linear8, TexelFilter::Bilinear, colors.tiles().end);
        let tiles = Tiles(RefCell::default());
        [&colors, &numbers].iter().for_each(|b| tiles.add(b, &mut random));
        let (beside, plain) = (Bsdf::Diffuse { reflectance: [0.3; 3] }, detail == Detail::default());
        let metal = Bsdf::RoughConductor {
            distribution: Distribution::Ggx,
            alpha: [0.3; 2],
            eta: [0.0; 3],
            k: [1.0; 3],
            specular: [1.0; 3],
        };
        let mut materials =
            vec![Material::new("", beside, true), Material::new("", metal, true), Material::new("", bsdf, true)];
        materials[2].two_sided = !materials[2].bsdf.transmits();
        materials[2].detail = (!plain).then(|| Box::new(detail));
        let world = World {
            materials,
            textures: vec![Texture::Bitmap(colors), Texture::Bitmap(numbers)],
            shapes: vec![ShapeInfo { name: String::new(), material: 2, emission: None, emission_texture: None }],
            emissive: vec![],
            glows: vec![],
            beams: vec![],
            environment: Some(Environment::Constant([1.0; 3])),
            sun: None,
            lo: [-1.0; 3],
            hi: [1.0; 3],
        };
        let mut scene = Scene { world, tiles, rays: vec![], traced: vec![], hits: vec![] };
        for i in 0..BATCH as u32 {
            let (mut u, mut v) = (random.number(), random.number());
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            let point = [0, 1, 2].map(|a| {
                TRIANGLE[0][a] + u * (TRIANGLE[1][a] - TRIANGLE[0][a]) + v * (TRIANGLE[2][a] - TRIANGLE[0][a])
            });
            let (away, t) = (random.direction(), 1.0 + random.number());
            let ray = PathRay {
                o: [0, 1, 2].map(|a| point[a] + t * away[a]),
                dir: UnitDir::encode(away.map(|x| -x)),
                key: PathKey { pixel: i, sample: i % 7, branch: 0, vertex: 1 },
                throughput: [1.0; 3],
                pdf: 1.0,
            };
            scene.rays.push(ray);
            scene.traced.push(ray.ray());
            scene.hits.push(Hit { t, u, v, prim: 0, leaf: 0, lane: 0 });
        }
        scene
    }

    /// ns of a vertex: a shadow ray to the sky, a next ray.
    fn vertices(&self, skips: Skips) -> f64 {
        let lights = Lights::new(&self.world);
        let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -5.0]];
        let size = [BATCH as u32, 1];
        let camera = Camera::new(&rows, 40.0, size, [0.0; 3]).expect("a camera that can be");
        let frame = Frame {
            camera,
            size,
            filter: Filter::Box,
            seed: 1,
            max_depth: 100,
            rr_depth: 100,
            split: 1,
            hide_emitters: false,
            aovs: Aovs::NONE,
        };
        let context = Context::new(&self.world, &lights, &frame).with(&self.tiles).skipping(skips);
        let (mut out, rounds) = (Outcome::default(), 64);
        let begin = thread_cpu();
        for _ in 0..rounds {
            shade_traced(&context, self, &self.rays, &self.traced, &self.hits, &mut out);
            black_box(&out);
            out.clear();
        }
        (thread_cpu() - begin) * 1e9 / (rounds * BATCH) as f64
    }
}

impl Surfaces for Scene {
    fn surface(&self, _: usize, _: &Hit) -> Surface {
        let uv = Some([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
        Surface { geometry: Primitive::Triangle(TRIANGLE), normals: None, uv, attribute: None }
    }
    fn shape(&self, _: usize, _: &Hit) -> u32 {
        0
    }
    fn prim(&self, _: usize, _: &Hit) -> PrimId {
        0
    }
}

fn textures() -> Vec<(String, Texture)> {
    let mut out = vec![];
    // 16 million texels are in no cache
    let size = 32 * TILE;
    for (texel, kind) in [(Texel::Srgb8, "sRGB bytes"), (Texel::Linear8, "bytes"), (Texel::Float, "floats")] {
        for (filter, how) in [(TexelFilter::Nearest, "nearest"), (TexelFilter::Bilinear, "bilinear")] {
            for channels in [1, 3] {
                let image = bitmap(size, channels, texel, filter, 0);
                out.push((format!("bitmap, {channels} x {kind}, {how}"), Texture::Bitmap(image)));
            }
        }
    }
    let squares = Checkerboard { to_uv: UvMap::IDENTITY, colors: [[0.2; 3], [0.8; 3]] };
    out.push(("checkerboard".into(), Texture::Checkerboard(squares)));
    out.push(("mesh attribute".into(), Texture::Attribute { scale: 0.5 }));
    out
}

/// ns of a look-up: along a line, or anywhere.
fn look_ups(texture: &Texture, tiles: &Tiles, far: bool) -> f64 {
    let mut random = Random(4);
    let places: Vec<At> = (0..MANY / 8)
        .map(|i| {
            let x = i as f32 / (MANY / 8) as f32;
            At::uv(if far { [random.number(), random.number()] } else { [0.1 + 0.05 * x, 0.2 + 0.03 * x] })
        })
        .collect();
    let begin = thread_cpu();
    for at in &places {
        black_box(texture.color(tiles, black_box(*at)));
    }
    (thread_cpu() - begin) * 1e9 / places.len() as f64
}
