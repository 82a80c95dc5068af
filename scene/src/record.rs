//! A scene's primitives as a stream in source order: what preparing reads.

use rayherd_render::bvh::MAX_COORDINATE;

use crate::ImportError;

/// Coordinates beyond this are not used. Recentring at most doubles it, which blocks can still hold.
pub(crate) const LARGEST: f64 = (MAX_COORDINATE / 2.0) as f64;

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

/// Why a record is skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Skip {
    Degenerate,
    NonFinite,
    OutOfRange,
}

impl Record {
    /// Index into the description's shapes.
    pub(crate) fn shape(&self) -> u32 {
        let (Record::Triangle(TriangleRecord { shape, .. }) | Record::Sphere(SphereRecord { shape, .. })) = self;
        *shape
    }

    /// Whether its numbers can be computed with.
    pub(crate) fn sound(&self) -> Result<(), Skip> {
        let (finite, within) = match self {
            Record::Triangle(t) => {
                let largest = t.p.as_flattened().iter().fold(0.0f64, |m, x| m.max(x.abs()));
                // max() ignores NaN
                (t.p.as_flattened().iter().all(|x| x.is_finite()), largest <= LARGEST)
            }
            Record::Sphere(s) => {
                let largest = s.center.iter().fold(0.0f64, |m, x| m.max(x.abs())) + s.radius;
                (s.center.iter().all(|x| x.is_finite()) && s.radius.is_finite(), largest <= LARGEST)
            }
        };
        match (finite, within) {
            (false, _) => Err(Skip::NonFinite),
            (true, false) => Err(Skip::OutOfRange),
            (true, true) => Ok(()),
        }
    }
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
