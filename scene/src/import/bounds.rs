//! World-space bounds of a description.

use super::stream::{DescriptionSource, StreamOptions};
use crate::ImportError;
use crate::description::{Description, Geometry, Shape};
use crate::record::{Record, RecordSource};

/// Nothing: grows by any point.
pub(super) const EMPTY: [[f64; 3]; 2] = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];

/// Bounds of the finite primitives of a source, by a pass over it; least above greatest if there are none.
pub fn bounds(source: &dyn RecordSource) -> Result<([[f64; 3]; 2], u64), ImportError> {
    let mut out = EMPTY;
    let mut stream = source.open_places()?;
    let mut records = vec![];
    loop {
        records.clear();
        if stream.next(&mut records, 4096)? == 0 {
            return Ok((out, stream.bytes_read()));
        }
        records.iter().for_each(|record| {
            add(&mut out, record);
        });
    }
}

/// Grows by a primitive; false (and no growth) when it is not finite.
pub(super) fn add(bounds: &mut [[f64; 3]; 2], record: &Record) -> bool {
    match record {
        Record::Triangle(t) => {
            let finite = t.p.iter().flatten().all(|x| x.is_finite());
            if finite {
                t.p.iter().for_each(|p| grow(bounds, *p));
            }
            finite
        }
        Record::Sphere(s) => {
            let finite = s.center.iter().all(|x| x.is_finite()) && s.radius.is_finite();
            if finite {
                grow(bounds, s.center.map(|x| x - s.radius));
                grow(bounds, s.center.map(|x| x + s.radius));
            }
            finite
        }
    }
}

/// Bounds of a description; the bytes read for it are added to its count.
pub(super) fn measure(description: &mut Description) -> Result<[[f64; 3]; 2], ImportError> {
    let (bounds, bytes) = {
        let source = DescriptionSource::new(description, StreamOptions::default());
        bounds(&source)?
    };
    description.bytes_read += bytes;
    description.passes += 1;
    Ok(bounds)
}

/// Grows by the corners of an inline shape.
pub(super) fn add_corners(bounds: &mut [[f64; 3]; 2], shape: &Shape) {
    if let Geometry::Inline { positions, .. } = &shape.geometry {
        positions.iter().for_each(|p| grow(bounds, shape.to_world.point(*p)));
    }
}

fn grow(bounds: &mut [[f64; 3]; 2], p: [f64; 3]) {
    for k in 0..3 {
        bounds[0][k] = bounds[0][k].min(p[k]);
        bounds[1][k] = bounds[1][k].max(p[k]);
    }
}
