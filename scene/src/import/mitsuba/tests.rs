use std::path::Path;

use super::super::{DescriptionSource, ImportOptions, StreamOptions, import};
use crate::description::{Bsdf, Description};
use crate::record::{Record, RecordSource};

fn records(description: &Description) -> Vec<Record> {
    let source = DescriptionSource::new(description, StreamOptions::default());
    let mut stream = source.open().unwrap();
    let mut out = vec![];
    while stream.next(&mut out, 7).unwrap() > 0 {}
    out
}

#[test]
fn cornell_box_example() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/cornell-box.xml");
    let description = import(&path, &ImportOptions::default()).unwrap();
    assert_eq!(description.size, Some([512, 512]));
    assert_eq!(description.spp, Some(64));
    assert_eq!(description.max_depth, Some(8));
    assert_eq!(description.shapes.len(), 8);
    assert!(matches!(description.materials[0].bsdf, Bsdf::Diffuse { .. }));
    let records = records(&description);
    assert_eq!(records.len(), 6 * 2 + 2 * 12);
}
