//! The world object: what a description says beside its primitives, recentred.

use rayherd_render::texture::Texture;
use rayherd_render::world::{Beam, Environment, ShapeInfo, Slide, Sun, World};

use super::PrepareError;
use super::ingest::Ingested;
use super::textures::Shining;
use crate::description::{self, Description};
use crate::import;
use crate::manifest::FORMAT;
use crate::objects::{ObjectHash, ObjectRef};

/// What is small of a scene and needed everywhere.
pub(super) fn world(
    description: &Description,
    offset: &[f64; 3],
    ingested: &mut Ingested,
    textures: Vec<Texture>,
) -> Result<World, PrepareError> {
    let materials = description.materials.len();
    if let Some(shape) = description.shapes.iter().find(|s| s.material as usize >= materials) {
        let message = format!("shape {:?} has material {} of {materials}", shape.name, shape.material);
        return Err(PrepareError::Inconsistent(message));
    }
    let shapes = description.shapes.iter().map(|s| ShapeInfo {
        name: s.name.clone(),
        material: s.material,
        emission: s.emission,
        emission_texture: s.emission_texture,
    });
    let world = World {
        materials: description.materials.clone(),
        textures,
        shapes: shapes.collect(),
        emissive: std::mem::take(&mut ingested.emissive),
        glows: std::mem::take(&mut ingested.glows),
        beams: description.beams.iter().map(|b| beam(b, offset)).collect(),
        environment: description.environment.as_ref().map(|sky| match sky {
            description::Environment::Constant(radiance) => Environment::Constant(*radiance),
            description::Environment::Map { scale, to_world, .. } => {
                Environment::Map { scale: *scale, to_map: import::to_map(to_world), upper: false }
            }
            description::Environment::Sky(sky) => Environment::Map {
                scale: sky.scale,
                to_map: import::to_map(&sky.to_world.after(&import::PICTURE_TO_SKY)),
                upper: true,
            },
        }),
        sun: description.sun.as_ref().map(|sun| Sun {
            direction: sun.direction.map(|x| x as f32),
            up: sun.up.map(|x| x as f32),
            // as 2 sin^2 of the half: small angles keep their digits
            cap: (2.0 * libm::sin(0.5 * sun.half_angle) * libm::sin(0.5 * sun.half_angle)) as f32,
            radiance: sun.radiance,
        }),
        lo: ingested.lo,
        hi: ingested.hi,
    };
    world.check().map_err(PrepareError::Inconsistent)?;
    Ok(world)
}

/// By texture: the primitives whose emission it gives, to be weighed.
pub(super) fn shining<'a>(description: &Description, ingested: &'a mut Ingested) -> Shining<'a> {
    let mut out = Shining::new();
    let mut emissive = ingested.emissive.iter();
    for glow in &mut ingested.glows {
        // both by ascending id
        let Some(e) = emissive.find(|e| e.prim == glow.prim) else { break };
        if let Some(texture) = description.shapes[e.shape as usize].emission_texture {
            out.entry(texture).or_default().push((glow, e.geometry));
        }
    }
    out
}

/// A beam in recentred f32.
fn beam(beam: &description::Beam, offset: &[f64; 3]) -> Beam {
    let place = |p: &[f64; 3]| std::array::from_fn(|i| (p[i] - offset[i]) as f32);
    match beam {
        description::Beam::Point { position, intensity } => {
            Beam::Point { position: place(position), intensity: *intensity }
        }
        description::Beam::Spot { position, axis, intensity, beam, cutoff, slide } => Beam::Spot {
            position: place(position),
            axis: axis.map(|x| x as f32),
            intensity: *intensity,
            beam: beam.to_radians() as f32,
            cutoff: cutoff.to_radians() as f32,
            slide: slide.as_ref().map(|slide| Slide {
                texture: slide.texture,
                to_local: slide.to_local.map(|row| row.map(|x| x as f32)),
                tan: libm::tan(cutoff.to_radians()) as f32,
            }),
        },
        description::Beam::Directional { direction, irradiance } => {
            Beam::Directional { direction: direction.map(|x| x as f32), irradiance: *irradiance }
        }
    }
}

/// Hash of what defines the picture.
pub(super) fn content_hash(
    offset: &[f64; 3],
    records: &blake3::Hash,
    world: &[u8],
    sky_map: Option<&ObjectRef>,
    tiles: &[ObjectRef],
) -> ObjectHash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"rayherd content\0").update(&FORMAT.to_le_bytes());
    for x in offset {
        hasher.update(&x.to_le_bytes());
    }
    hasher.update(records.as_bytes());
    // the world says how many there are, and whether there is a picture of the sky
    for object in sky_map.into_iter().chain(tiles) {
        hasher.update(&object.hash.0);
    }
    hasher.update(world);
    ObjectHash(*hasher.finalize().as_bytes())
}
