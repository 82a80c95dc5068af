//! Small scenes for tests.

use std::path::Path;
use std::sync::Arc;

use rayherd_render::aov::Aovs;
use rayherd_render::camera::Camera;
use rayherd_render::filter::Filter;
use rayherd_render::frame::Frame;
use rayherd_scene::description::{
    Affine, Amount, Bsdf, Checkerboard, Description, Detail, Distribution, Environment, Geometry, Material,
    MeshAttribute, MeshFormat, Place, Relief, ReliefKind, Shape, Slot, TexelFilter, Texture, TextureKind, Textured,
    Transmittance, UvMap, Wrap,
};
use rayherd_scene::import::{DescriptionSource, StreamOptions};
use rayherd_scene::objects::MemoryObjects;
use rayherd_scene::prepare::{Cut, NoProgress, PrepareSettings, SpoolSettings, prepare};

use crate::job::PreparedScene;

/// A rectangle of `n` x `n` quads, from a corner along two edges; its front is on the side of `u x v`.
fn sheet(corner: [f64; 3], u: [f64; 3], v: [f64; 3], n: u32) -> Geometry {
    let at = |i: u32, j: u32| {
        let (s, t) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
        std::array::from_fn(|a| corner[a] + s * u[a] + t * v[a])
    };
    let mut positions = Vec::new();
    for j in 0..=n {
        positions.extend((0..=n).map(|i| at(i, j)));
    }
    let mut triangles = Vec::new();
    for j in 0..n {
        for i in 0..n {
            let p = |i: u32, j: u32| j * (n + 1) + i;
            triangles.push([p(i, j), p(i + 1, j), p(i + 1, j + 1)]);
            triangles.push([p(i, j), p(i + 1, j + 1), p(i, j + 1)]);
        }
    }
    Geometry::Inline { positions, normals: vec![], triangles, uv: vec![] }
}

fn shape(name: &str, geometry: Geometry, material: u32, emission: Option<[f32; 3]>) -> Shape {
    Shape {
        name: name.to_owned(),
        place: Place::default(),
        geometry,
        to_world: Affine::IDENTITY,
        material,
        emission,
        emission_texture: None,
        flip_normals: false,
        face_normals: false,
    }
}

fn material(name: &str, bsdf: Bsdf) -> Material {
    Material::new(name, bsdf, true)
}

/// A box with coloured walls, open to the camera, a light below its ceiling, a block, a matt and a metal ball.
pub fn cornell() -> Description {
    let wall = |r, g, b| Bsdf::Diffuse { reflectance: [r, g, b] };
    let metal = Bsdf::RoughConductor {
        distribution: Distribution::Ggx,
        alpha: [0.3, 0.3],
        eta: [0.2, 0.9, 1.1],
        k: [3.9, 2.5, 2.1],
        specular: [1.0; 3],
    };
    let materials = vec![
        material("white", wall(0.7, 0.7, 0.7)),
        material("red", wall(0.6, 0.1, 0.1)),
        material("green", wall(0.1, 0.5, 0.1)),
        material("metal", metal),
    ];
    let n = 5;
    let shapes = vec![
        shape("floor", sheet([-1.0, -1.0, -1.0], [0.0, 0.0, 2.0], [2.0, 0.0, 0.0], n), 0, None),
        shape("ball", Geometry::Sphere { center: [0.45, -0.7, -0.2], radius: 0.3 }, 0, None),
        shape("ceiling", sheet([-1.0, 1.0, -1.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0], n), 0, None),
        shape("left", sheet([-1.0, -1.0, -1.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0], n), 1, None),
        shape("light", sheet([-0.3, 0.95, -0.3], [0.6, 0.0, 0.0], [0.0, 0.0, 0.6], 2), 0, Some([9.0, 8.0, 6.0])),
        shape("back", sheet([-1.0, -1.0, -1.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], n), 0, None),
        shape("right", sheet([1.0, -1.0, -1.0], [0.0, 0.0, 2.0], [0.0, 2.0, 0.0], n), 2, None),
        shape("metal ball", Geometry::Sphere { center: [-0.4, -0.6, 0.2], radius: 0.4 }, 3, None),
        shape("block", sheet([-0.5, -1.0, -0.6], [0.6, 0.0, 0.2], [0.0, 1.1, 0.1], 4), 0, None),
    ];
    Description {
        shapes,
        materials,
        textures: vec![],
        beams: vec![],
        environment: Some(Environment::Constant([0.05, 0.06, 0.08])),
        sun: None,
        camera: None,
        size: None,
        filter: None,
        spp: None,
        max_depth: None,
        rr_depth: None,
        hide_emitters: false,
        aovs: None,
        substitutions: vec![],
        notes: vec![],
        bounds: None,
        bytes_read: 0,
        passes: 0,
    }
}

/// A sheet in the middle of the box whose vertices have colours, as a PLY file of this path.
fn colored_sheet(path: &Path) {
    const N: usize = 12;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty float r\n\
         property float g\nproperty float b\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
        N * N,
        (N - 1) * (N - 1)
    );
    for i in 0..N * N {
        let [s, t] = [i % N, i / N].map(|k| k as f64 / (N - 1) as f64);
        text += &format!("{} {} {} {s} {t} {}\n", s - 0.5, t - 0.6, 0.2 * s * t, 1.0 - s);
    }
    for i in (0..N * (N - 1)).filter(|i| i % N < N - 1) {
        text += &format!("4 {} {} {} {}\n", i, i + 1, i + N + 1, i + N);
    }
    std::fs::write(path, text).unwrap();
}

/// The box with pictures on its walls and in its lamp, holes, bumps, a textured coat and a coloured mesh; its files lie in the folder.
pub fn textured(folder: &Path) -> Description {
    let path = folder.join("wall.png");
    let mut png = Vec::new();
    let size = [300, 200];
    let mut encoder = png::Encoder::new(&mut png, size[0], size[1]);
    encoder.set_color(png::ColorType::Rgb);
    let texels: Vec<u8> = (0..size[0] * size[1] * 3).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    encoder.write_header().unwrap().write_image_data(&texels).unwrap();
    std::fs::write(&path, png).unwrap();
    let image = |raw, wrap| Texture {
        place: Place::default(),
        kind: TextureKind::Image {
            path: path.clone(),
            raw,
            wrap,
            filter: TexelFilter::Bilinear,
            to_uv: UvMap([[1.5, 0.2, 0.1], [0.0, 2.0, -0.3]]),
        },
    };
    let squares = Checkerboard { to_uv: UvMap::IDENTITY, colors: [[0.9, 0.2, 0.1], [0.1, 0.3, 0.8]] };
    let mut out = cornell();
    out.textures = vec![
        image(false, Wrap::Repeat),
        image(true, Wrap::Mirror),
        Texture { place: Place::default(), kind: TextureKind::Checkerboard(squares) },
    ];
    // the first stays without: its triangles are looked up at the hit's own coordinates, whoever lies in a split with them
    for shape in out.shapes.iter_mut().skip(1) {
        if let Geometry::Inline { positions, uv, .. } = &mut shape.geometry {
            let n = (positions.len() as f64).sqrt() as usize;
            let at = |i: usize| [i % n, i / n].map(|k| k as f32 / (n - 1) as f32);
            *uv = (0..positions.len()).map(at).collect();
        }
    }
    let painted = |texture| vec![Textured::new(Slot::Diffuse, texture)];
    let coat = Transmittance::new(Distribution::Ggx, 0.2, 1.5);
    let plastic = Bsdf::RoughPlastic {
        distribution: Distribution::Ggx,
        alpha: 0.2,
        eta: 1.5,
        diffuse: [0.5; 3],
        specular: [1.0; 3],
        nonlinear: true,
        coat,
    };
    let relief = Some(Relief { kind: ReliefKind::Bump(0.002), texture: 1, mirrored: false, shadowed: true });
    let grey = Bsdf::Diffuse { reflectance: [0.6; 3] };
    let details = [
        (grey.clone(), Detail { textured: painted(0), ..Detail::default() }),
        (plastic, Detail { textured: painted(1), ..Detail::default() }),
        (grey.clone(), Detail { opacity: Amount::Texture(1), textured: painted(2), ..Detail::default() }),
        (grey, Detail { relief, ..Detail::default() }),
    ];
    let first = out.materials.len() as u32;
    for (i, (bsdf, detail)) in details.into_iter().enumerate() {
        out.materials.push(Material { detail: Some(Box::new(detail)), ..material(&format!("detail {i}"), bsdf) });
    }
    for (i, shape) in (0..).zip(out.shapes.iter_mut().filter(|s| s.emission.is_none())) {
        shape.material = first + i % 4;
    }
    for shape in out.shapes.iter_mut().filter(|s| s.emission.is_some()) {
        shape.emission_texture = Some(0);
    }
    let sheet = folder.join("sheet.ply");
    colored_sheet(&sheet);
    out.textures.push(Texture {
        place: Place::default(),
        kind: TextureKind::Attribute { name: "vertex_color".into(), scale: 0.9 },
    });
    let detail = Detail { textured: painted(3), ..Detail::default() };
    let bsdf = Bsdf::Diffuse { reflectance: [0.5; 3] };
    out.materials.push(Material { detail: Some(Box::new(detail)), ..material("coloured", bsdf) });
    let geometry = Geometry::MeshFile {
        path: sheet,
        format: MeshFormat::Ply,
        flip_v: false,
        smooth: false,
        attribute: Some(MeshAttribute { of_faces: false, name: "color".into(), srgb: false }),
        parts: None,
    };
    out.shapes.push(shape("sheet", geometry, out.materials.len() as u32 - 1, None));
    out
}

/// A closed box whose walls all emit 1 and reflect half of what they get.
pub fn furnace() -> Description {
    let half = material("half", Bsdf::Diffuse { reflectance: [0.5; 3] });
    let corner = |x: f64| [x, x, x];
    let (u, v, w) = ([4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]);
    let minus = |a: [f64; 3]| a.map(|x| -x);
    let wall = |name, c, a, b| shape(name, sheet(c, a, b, 3), 0, Some([1.0; 3]));
    let (lo, hi) = (corner(-2.0), corner(2.0));
    Description {
        // fronts are inside
        shapes: vec![
            wall("back", lo, u, v),
            wall("left", lo, v, w),
            wall("floor", lo, w, u),
            wall("front", hi, minus(v), minus(u)),
            wall("right", hi, minus(w), minus(v)),
            wall("ceiling", hi, minus(u), minus(w)),
        ],
        materials: vec![half],
        environment: None,
        ..cornell()
    }
}

/// What lights the floor of [`floor`].
pub enum Lamp {
    /// A parallelogram from a corner along two edges, front below.
    Rectangle([[f64; 3]; 3]),
    /// A sphere.
    Sphere([f64; 3], f64),
    /// The sky alone.
    Sky,
}

/// A floor of albedo one half at y = 0, 40 wide, in many triangles, under a lamp of radiance 1.
pub fn floor(lamp: &Lamp) -> Description {
    let half = material("half", Bsdf::Diffuse { reflectance: [0.5; 3] });
    let black = material("black", Bsdf::Diffuse { reflectance: [0.0; 3] });
    let mut shapes = vec![shape("floor", sheet([-20.0, 0.0, -20.0], [0.0, 0.0, 40.0], [40.0, 0.0, 0.0], 24), 0, None)];
    match *lamp {
        Lamp::Rectangle([c, a, b]) => shapes.push(shape("lamp", sheet(c, a, b, 3), 1, Some([1.0; 3]))),
        Lamp::Sphere(center, radius) => {
            shapes.push(shape("lamp", Geometry::Sphere { center, radius }, 1, Some([1.0; 3])));
        }
        Lamp::Sky => {}
    }
    let environment = matches!(lamp, Lamp::Sky).then_some(Environment::Constant([1.0; 3]));
    Description { shapes, materials: vec![half, black], environment, ..cornell() }
}

/// The box with 60 small lamps, half of them on its left wall, half in its middle that shine to the left and to the right in turn; a
/// mirror and a glass ball, no sky.
pub fn lamps() -> Description {
    let mut out = Description { environment: None, ..cornell() };
    out.shapes.retain(|s| s.emission.is_none());
    let smooth = Bsdf::Dielectric { eta: 1.5, reflect: [1.0; 3], transmit: [1.0; 3] };
    let mirror = Bsdf::Conductor { eta: [0.2, 0.9, 1.1], k: [3.9, 2.5, 2.1], specular: [1.0; 3] };
    let first = out.materials.len() as u32;
    out.materials.extend([material("glass", smooth), material("mirror", mirror)]);
    for (shape, number) in out.shapes.iter_mut().filter(|s| s.name.ends_with("ball")).zip([first, first + 1]) {
        shape.material = number;
    }
    let s = 0.04;
    for i in 0..30 {
        let (y, z) = (-0.9 + 0.3 * f64::from(i % 6), -0.8 + 0.3 * f64::from(i / 6));
        let light = Some([20.0 + f64::from(i) as f32, 25.0, 30.0]);
        // neighbours in the middle have their backs to each other's side
        let left = sheet([-0.98, y, z], [0.0, s, 0.0], [0.0, 0.0, s], 1);
        let (u, v) = ([0.0, 0.0, s], [0.0, s, 0.0]);
        let (u, v) = if i % 2 == 0 { (u, v) } else { (v, u) };
        let middle = sheet([0.2, y, z], u, v, 1);
        out.shapes.push(shape(&format!("left lamp {i}"), left, 0, light));
        out.shapes.push(shape(&format!("middle lamp {i}"), middle, 0, light));
    }
    out
}

/// A closed bumpy surface of some thousand triangles, as from a scan, under a sky and a lamp.
pub fn scan() -> Description {
    let (across, down) = (60u32, 30u32);
    let mut positions = Vec::new();
    for j in 0..=down {
        for i in 0..across {
            let turns = f64::from(i) / f64::from(across) * std::f64::consts::TAU;
            let angle = f64::from(j) / f64::from(down) * std::f64::consts::PI;
            let r = 0.7 + 0.1 * libm::sin(5.0 * turns) * libm::sin(4.0 * angle);
            let ring = r * libm::sin(angle);
            positions.push([ring * libm::cos(turns), r * libm::cos(angle), ring * libm::sin(turns)]);
        }
    }
    let at = |i: u32, j: u32| j * across + i % across;
    let quads = (0..down).flat_map(|j| (0..across).map(move |i| (i, j)));
    let two = |(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]];
    let triangles = quads.flat_map(two).collect();
    let blob = Geometry::Inline { positions, normals: vec![], triangles, uv: vec![] };
    let lamp = sheet([-0.5, 1.5, -0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2);
    Description {
        shapes: vec![shape("blob", blob, 0, None), shape("lamp", lamp, 0, Some([4.0; 3]))],
        environment: Some(Environment::Constant([0.3; 3])),
        ..cornell()
    }
}

/// Prepares a description, cut into splits, into memory.
pub fn prepared(description: &Description, splits: u32, overlap_reduction: bool) -> PreparedScene {
    let objects = Arc::new(MemoryObjects::default());
    let source = DescriptionSource::new(description, StreamOptions::default());
    let settings = PrepareSettings { cut: Cut::Splits(splits), overlap_reduction, ..PrepareSettings::default() };
    let made =
        prepare(description, &source, &settings, &SpoolSettings::default(), objects.as_ref(), &NoProgress).unwrap();
    PreparedScene::open(made.manifest, objects).unwrap()
}

/// A view into the box.
pub fn frame(scene: &PreparedScene, size: [u32; 2], split: u32) -> Frame {
    // looks along -z of the world from in front of the box: camera z = -z, x to the left
    let to_world = [[-1.0, 0.0, 0.0, 0.05], [0.0, 1.0, 0.0, -0.1], [0.0, 0.0, -1.0, 3.3]];
    let camera = Camera::new(&to_world, 45.0, size, scene.manifest.offset).unwrap();
    let filter = Filter::Tent { radius: 1.0 };
    Frame { camera, size, filter, seed: 7, max_depth: 6, rr_depth: 3, split, hide_emitters: false, aovs: Aovs::NONE }
}
