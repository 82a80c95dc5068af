//! What a description holds, without preparing it: counts, bounds, files that cannot be read.

use rayherd_render::camera::{Camera, View};

use super::Sight;
use super::stream::{DescriptionSource, StreamOptions};
use crate::ImportError;
use crate::description::{Description, TextureKind};
use crate::image;
use crate::record::{Record, Skip};

/// Of a geometry object a triangle takes about this (eight-wide nodes, vertices, ids; measured 51.8 on 8 million triangles).
const BYTES_PER_TRIANGLE: u64 = 52;
/// And at most: where primitives of all sizes cross each other, or lie in rows that trees halve badly, leaves hold fewer ([`crate::split`]).
const MOST_PER_TRIANGLE: u64 = 90;
/// Likewise a sphere.
const BYTES_PER_SPHERE: u64 = 28;

/// What was found in a description's shapes.
#[derive(Debug)]
pub struct Survey {
    /// By shape.
    pub shapes: Vec<ShapeSurvey>,
    /// By texture: bytes of its texels, or why it could not be read to its end.
    pub textures: Vec<Result<u64, ImportError>>,
    /// World-space box of all finite primitives; least above greatest if there are none.
    pub bounds: [[f64; 3]; 2],
    /// Bytes of the source that were read for it.
    pub bytes_read: u64,
    /// If the camera sees nothing but backs that take all light: which, and what to do.
    pub walled_in: Option<String>,
}

/// One shape.
#[derive(Debug, Default)]
pub struct ShapeSurvey {
    /// Triangles, skipped ones too.
    pub triangles: u64,
    /// Spheres.
    pub spheres: u64,
    /// Primitives of no area, as f64 sees them: skipped when preparing.
    pub flat: u64,
    /// Primitives with NaN or infinite coordinates: skipped when preparing.
    pub not_finite: u64,
    /// Primitives beyond 2^39 units: skipped when preparing.
    pub out_of_range: u64,
    /// Triangles with shading normals.
    pub with_normals: u64,
    /// Triangles with texture coordinates.
    pub with_uv: u64,
    /// Triangles with the mesh's attribute.
    pub with_attribute: u64,
    /// Why it could not be read to its end.
    pub error: Option<ImportError>,
}

impl ShapeSurvey {
    /// Primitives that can be hit.
    pub fn usable(&self) -> u64 {
        self.triangles + self.spheres - self.flat - self.not_finite - self.out_of_range
    }
}

impl Survey {
    /// Reads every shape and every texture once. What cannot be read is noted, and the next one is read.
    pub fn of(description: &Description) -> Survey {
        let source = DescriptionSource::new(description, StreamOptions::default());
        let mut out = Survey {
            shapes: Vec::new(),
            textures: Vec::new(),
            bounds: super::bounds::EMPTY,
            bytes_read: 0,
            walled_in: None,
        };
        let mut sight = sight(description);
        for texture in &description.textures {
            let TextureKind::Image { path, raw, .. } = &texture.kind else {
                out.textures.push(Ok(0));
                continue;
            };
            let read = image::read(path, *raw).map_err(|why| image::error(path, &texture.place, &why));
            out.bytes_read += std::fs::metadata(path).map_or(0, |m| m.len());
            out.textures.push(read.map(|image| image.header.bytes()));
        }
        out.shapes.resize_with(description.shapes.len(), ShapeSurvey::default);
        for number in 0..description.shapes.len() {
            match read(&source, number, &mut out.shapes, &mut out.bounds, sight.as_mut()) {
                Ok(bytes) => out.bytes_read += bytes,
                Err(error) => out.shapes[number].error = Some(error),
            }
        }
        out.walled_in = sight.and_then(|sight| sight.walled_in(description));
        out
    }

    /// A sum over the shapes.
    pub fn sum(&self, of: impl Fn(&ShapeSurvey) -> u64) -> u64 {
        self.shapes.iter().map(of).sum()
    }

    /// About what the prepared scene takes, bytes, without copies by overlap reduction: trees and vertices; shape numbers, normals and
    /// texture coordinates; texels.
    pub fn prepared_bytes(&self) -> u64 {
        let shapes = self.sum(|s| {
            let attributes = (s.with_normals + s.with_attribute) * 36 + s.with_uv * 24;
            s.triangles * (BYTES_PER_TRIANGLE + 4) + attributes + s.spheres * (BYTES_PER_SPHERE + 4)
        });
        shapes + self.texture_bytes()
    }

    /// What the largest split takes in a node's memory, bytes, least and most, where blocks take so many: all but the texels where one block holds all, else
    /// a block and what its primitives have beside it.
    pub fn split_bytes(&self, block: u64) -> [u64; 2] {
        let beside = self.prepared_bytes() - self.texture_bytes() - self.block_bytes(BYTES_PER_TRIANGLE);
        let mut out = [BYTES_PER_TRIANGLE, MOST_PER_TRIANGLE].map(|each| {
            let trees = self.block_bytes(each);
            // in u128, as both may be of any size
            let part = u128::from(trees + beside) * u128::from(block) / u128::from(trees.max(1));
            (trees + beside).min(u64::try_from(part).unwrap_or(u64::MAX))
        });
        // of several blocks those with fewer triangles have less beside them
        out.sort_unstable();
        out
    }

    /// Of all blocks, where a triangle takes so much.
    fn block_bytes(&self, each: u64) -> u64 {
        self.sum(|s| s.triangles * each + s.spheres * BYTES_PER_SPHERE)
    }

    /// Bytes of the texels of all textures.
    pub fn texture_bytes(&self) -> u64 {
        self.textures.iter().flatten().sum()
    }
}

/// What the scene's camera sees; none of a camera that cannot be, whose own error comes when it is used.
fn sight(description: &Description) -> Option<Sight> {
    let (camera, size) = (description.camera.as_ref()?, description.size?);
    let view = View { to_world: camera.to_world.0, projection: camera.projection, crop: camera.crop };
    Some(Sight::new(&Camera::of(&view, size, [0.0; 3]).ok()?, size, [0.0; 3]))
}

fn read(
    source: &DescriptionSource,
    number: usize,
    shapes: &mut [ShapeSurvey],
    bounds: &mut [[f64; 3]; 2],
    mut sight: Option<&mut Sight>,
) -> Result<u64, ImportError> {
    let mut stream = source.open_one(number)?;
    let mut records = vec![];
    loop {
        records.clear();
        if stream.next(&mut records, 4096)? == 0 {
            return Ok(stream.bytes_read());
        }
        for record in &records {
            super::bounds::add(bounds, record);
            // a file's parts are shapes of their own
            let shape = &mut shapes[record.shape() as usize];
            sight.iter_mut().for_each(|sight| sight.see(record));
            match record.sound().and_then(|()| if has_area(record) { Ok(()) } else { Err(Skip::Degenerate) }) {
                Ok(()) => {}
                Err(Skip::Degenerate) => shape.flat += 1,
                Err(Skip::NonFinite) => shape.not_finite += 1,
                Err(Skip::OutOfRange) => shape.out_of_range += 1,
            }
            match record {
                Record::Triangle(t) => {
                    shape.triangles += 1;
                    shape.with_normals += u64::from(t.n.is_some());
                    shape.with_uv += u64::from(t.uv.is_some());
                    shape.with_attribute += u64::from(t.attribute.is_some());
                }
                Record::Sphere(_) => shape.spheres += 1,
            }
        }
    }
}

fn has_area(record: &Record) -> bool {
    match record {
        Record::Triangle(t) => super::vector::cross(edge(t.p, 1), edge(t.p, 2)) != [0.0; 3],
        Record::Sphere(s) => s.radius > 0.0,
    }
}

fn edge(p: [[f64; 3]; 3], to: usize) -> [f64; 3] {
    super::vector::sub(p[to], p[0])
}
