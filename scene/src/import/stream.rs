//! The records of a description, shape after shape.

use super::placement::Placement;
use crate::ImportError;
use crate::description::{Description, Geometry, Shape};
use crate::record::{Record, RecordSource, RecordStream, SphereRecord};

/// How much memory reading may take.
#[derive(Clone, Copy, Debug)]
pub struct StreamOptions {
    /// Most bytes of one mesh's vertex arrays in memory; larger ones spill to a mapped temporary file.
    pub vertex_budget: u64,
}

impl Default for StreamOptions {
    fn default() -> Self {
        StreamOptions { vertex_budget: 512 << 20 }
    }
}

/// A description as a source of records.
#[derive(Clone, Copy, Debug)]
pub struct DescriptionSource<'a> {
    description: &'a Description,
    options: StreamOptions,
}

impl<'a> DescriptionSource<'a> {
    /// The records of `description`, in the order of its shapes.
    pub fn new(description: &'a Description, options: StreamOptions) -> Self {
        DescriptionSource { description, options }
    }
}

impl RecordSource for DescriptionSource<'_> {
    fn open(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        Ok(Box::new(DescriptionStream { source: *self, shape: 0, current: None, bytes_read: 0 }))
    }
}

struct DescriptionStream<'a> {
    source: DescriptionSource<'a>,
    /// The shape after the current one.
    shape: usize,
    current: Option<Box<dyn RecordStream + 'a>>,
    /// Of the shapes that are done.
    bytes_read: u64,
}

impl RecordStream for DescriptionStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let mut appended = 0;
        while appended < max {
            if let Some(current) = &mut self.current {
                match current.next(out, max - appended)? {
                    0 => {
                        self.bytes_read += current.bytes_read();
                        self.current = None;
                    }
                    n => appended += n,
                }
            } else if let Some(shape) = self.source.description.shapes.get(self.shape) {
                self.current = Some(open_shape(shape, self.shape as u32, self.source.options)?);
                self.shape += 1;
            } else {
                break;
            }
        }
        Ok(appended)
    }

    fn bytes_read(&self) -> u64 {
        self.bytes_read + self.current.as_ref().map_or(0, |c| c.bytes_read())
    }
}

/// The records of one shape.
fn open_shape(shape: &Shape, number: u32, options: StreamOptions) -> Result<Box<dyn RecordStream + '_>, ImportError> {
    let placement = Placement::new(shape, number);
    Ok(match &shape.geometry {
        Geometry::Inline { positions, uv, triangles } => {
            Box::new(InlineStream { placement, positions, uv, triangles: triangles.iter() })
        }
        Geometry::Sphere { center, radius } => Box::new(Once(Some(sphere(shape, number, *center, *radius)))),
        Geometry::MeshFile { path, .. } | Geometry::IsoSurface { path, .. } => {
            let message = format!("cannot be read yet (vertex budget {})", options.vertex_budget);
            return Err(ImportError::Limit { path: path.clone(), message });
        }
    })
}

/// A sphere under a similarity.
fn sphere(shape: &Shape, number: u32, center: [f64; 3], radius: f64) -> Record {
    let mirrored = shape.to_world.determinant() < 0.0;
    let scale = shape.to_world.vector([1.0, 0.0, 0.0]).iter().map(|x| x * x).sum::<f64>().sqrt();
    Record::Sphere(SphereRecord {
        center: shape.to_world.point(center),
        radius: radius * scale,
        flipped: mirrored != shape.flip_normals,
        shape: number,
    })
}

struct Once(Option<Record>);

impl RecordStream for Once {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let taken = if max > 0 { self.0.take() } else { None };
        out.extend(taken);
        Ok(usize::from(taken.is_some()))
    }
    fn bytes_read(&self) -> u64 {
        0
    }
}

struct InlineStream<'a> {
    placement: Placement,
    positions: &'a [[f64; 3]],
    uv: &'a [[f32; 2]],
    triangles: std::slice::Iter<'a, [u32; 3]>,
}

impl RecordStream for InlineStream<'_> {
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError> {
        let before = out.len();
        for triangle in self.triangles.by_ref().take(max) {
            let p = triangle.map(|i| self.positions[i as usize]);
            let uv = (!self.uv.is_empty()).then(|| triangle.map(|i| self.uv[i as usize]));
            out.push(self.placement.triangle(p, None, uv));
        }
        Ok(out.len() - before)
    }
    fn bytes_read(&self) -> u64 {
        0
    }
}
