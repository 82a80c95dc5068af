//! Scenes made of triangles, and what becomes of them on the whole way: prepared, cut, traced.

use std::sync::Arc;

use rayherd_render::bvh::Forest;
use rayherd_scene::description::{Affine, Bsdf, Description, Environment, Geometry, Material, Place, Shape};
use rayherd_scene::import::{DescriptionSource, StreamOptions};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{MemoryObjects, ObjectStore};
use rayherd_scene::prepare::{NoProgress, PrepareSettings, SpoolSettings, prepare};

/// Vertices as a source has them.
pub type Wide = [[f64; 3]; 3];

/// A shape of triangles of their own.
pub fn shape(triangles: &[Wide], material: u32, emission: Option<[f32; 3]>) -> Shape {
    Shape {
        name: format!("material {material}"),
        place: Place::line("made", 1),
        geometry: Geometry::Inline {
            positions: triangles.as_flattened().to_vec(),
            normals: vec![],
            uv: vec![],
            triangles: (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        },
        to_world: Affine::IDENTITY,
        material,
        emission,
        emission_texture: None,
        flip_normals: false,
        face_normals: false,
    }
}

/// Two-sided diffuse.
pub fn diffuse(reflectance: f32) -> Material {
    Material::new("diffuse", Bsdf::Diffuse { reflectance: [reflectance; 3] }, true)
}

/// Shapes of one material of albedo one half, under a sky.
pub fn under_a_sky(shapes: Vec<Shape>, sky: Option<[f32; 3]>) -> Description {
    Description {
        shapes,
        materials: vec![diffuse(0.5)],
        environment: sky.map(Environment::Constant),
        ..Description::default()
    }
}

/// A description, prepared into memory.
pub fn prepared(description: &Description, settings: &PrepareSettings) -> (Manifest, Arc<MemoryObjects>) {
    let objects = Arc::new(MemoryObjects::default());
    let source = DescriptionSource::new(description, StreamOptions::default());
    let made = prepare(description, &source, settings, &SpoolSettings::default(), objects.as_ref(), &NoProgress);
    (made.expect("a sound scene").manifest, objects)
}

/// All splits of a prepared scene in one forest.
pub fn whole(manifest: &Manifest, objects: &MemoryObjects) -> Forest {
    let mut forest = Forest::new(1 << 30).expect("a GiB of addresses");
    for split in &manifest.splits {
        forest.insert(&objects.get(&split.geometry).expect("an object that was put")).expect("room");
    }
    forest.finish().expect("room for the top tree");
    forest
}

/// Triangles as preparing rounds them.
pub fn rounded(triangles: &[Wide], offset: [f64; 3]) -> Vec<super::numbers::Triangle> {
    triangles.iter().map(|t| t.map(|p| std::array::from_fn(|a| (p[a] - offset[a]) as f32))).collect()
}
