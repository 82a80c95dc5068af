//! A scene's primitives as a stream in source order: what preparing reads.

use crate::ImportError;

/// A triangle with its attributes, in world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriangleRecord {
    /// Vertices, counter-clockwise from the front.
    pub p: [[f64; 3]; 3],
    /// Shading normals, unit length.
    pub n: Option<[[f32; 3]; 3]>,
    /// Texture coordinates.
    pub uv: Option<[[f32; 2]; 3]>,
    /// The mesh's attribute (a colour, say).
    pub attribute: Option<[[f32; 3]; 3]>,
    /// Index into the description's shapes.
    pub shape: u32,
}

/// An exact sphere, in world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SphereRecord {
    /// Centre.
    pub center: [f64; 3],
    /// Radius, above 0.
    pub radius: f64,
    /// Seen from inside.
    pub flipped: bool,
    /// Index into the description's shapes.
    pub shape: u32,
}

/// One primitive. Its place in the stream, counted from 0 over every record (skipped ones too), is its global id.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Record {
    /// A triangle.
    Triangle(TriangleRecord),
    /// A sphere.
    Sphere(SphereRecord),
}

/// A pass over the source.
pub trait RecordStream {
    /// Appends up to `max` records in source order; 0 at the end.
    fn next(&mut self, out: &mut Vec<Record>, max: usize) -> Result<usize, ImportError>;
    /// Bytes read from the source so far in this pass.
    fn bytes_read(&self) -> u64;
}

/// Something that can be streamed more than once, each time the same.
pub trait RecordSource: Sync {
    /// Starts a pass.
    fn open(&self) -> Result<Box<dyn RecordStream + '_>, ImportError>;
    /// Starts a pass of which only places count, not normals or texture coordinates: those may be left out where that is cheaper.
    fn open_places(&self) -> Result<Box<dyn RecordStream + '_>, ImportError> {
        self.open()
    }
}
