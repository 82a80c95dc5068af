//! Shapes beside mesh files: what their elements become.

use super::tests::{CUBE, message, scene};
use crate::import::tests::records;
use crate::record::Record;

/// The triangles of a scene: lower and upper corner of all, and how many there are.
fn bounds(inside: &str) -> ([f64; 3], [f64; 3], usize) {
    let records = records(&scene(inside).unwrap()).unwrap();
    let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for record in &records {
        let Record::Triangle(t) = record else { panic!("a sphere") };
        for p in t.p {
            (lo, hi) = ([0, 1, 2].map(|i| lo[i].min(p[i])), [0, 1, 2].map(|i| hi[i].max(p[i])));
        }
    }
    (lo, hi, records.len())
}

#[test]
fn disks_and_cylinders() {
    let close = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-4);
    let (lo, hi, n) = bounds(
        "<shape type=\"disk\"><transform name=\"to_world\"><scale value=\"2\"/><translate z=\"1\"/></transform></shape>",
    );
    assert!(close(lo, [-2.0, -2.0, 1.0]) && close(hi, [2.0, 2.0, 1.0]) && n == 512, "{lo:?} {hi:?} {n}");
    let (lo, hi, n) = bounds(
        "<shape type=\"cylinder\"><point name=\"p0\" x=\"1\" y=\"0\" z=\"0\"/><point name=\"p1\" x=\"4\" y=\"0\" z=\"0\"/>\
         <float name=\"radius\" value=\"0.5\"/></shape>",
    );
    assert!(close(lo, [1.0, -0.5, -0.5]) && close(hi, [4.0, 0.5, 0.5]) && n == 1024, "{lo:?} {hi:?} {n}");
    let bad = message("<shape type=\"cylinder\"><float name=\"radius\" value=\"0\"/></shape>");
    assert!(bad.contains("s.xml:2:1: a cylinder needs"), "{bad}");
}

#[test]
fn instances_are_laid_out() {
    let group = format!(
        "<shape type=\"shapegroup\" id=\"g\">{CUBE}<shape type=\"sphere\"><float name=\"radius\" value=\"0.5\"/></shape></shape>"
    );
    let instance = |x: i32| {
        format!(
            "<shape type=\"instance\"><ref id=\"g\"/><transform name=\"to_world\"><scale value=\"2\"/><translate x=\"{x}\"/></transform></shape>"
        )
    };
    let out = scene(&format!("{group}{}{}", instance(0), instance(10))).unwrap();
    assert_eq!(out.shapes.len(), 4, "the group itself is nowhere");
    let records = records(&out).unwrap();
    let spheres: Vec<_> = records
        .iter()
        .filter_map(|r| match r {
            Record::Sphere(s) => Some((s.center, s.radius)),
            Record::Triangle(_) => None,
        })
        .collect();
    assert_eq!(spheres, [([0.0; 3], 1.0), ([10.0, 0.0, 0.0], 1.0)]);
    let furthest = records
        .iter()
        .filter_map(|r| match r {
            Record::Triangle(t) => Some(t.p.iter().map(|p| p[0]).fold(0.0, f64::max)),
            Record::Sphere(_) => None,
        })
        .fold(0.0, f64::max);
    assert_eq!(furthest, 12.0);
    let wrong = message(&format!("{CUBE}\n<shape type=\"instance\"/>"));
    assert!(wrong.contains("s.xml:3:1: an instance needs one shapegroup"), "{wrong}");
    let wrong = message("<shape type=\"cube\" id=\"c\"/>\n<shape type=\"instance\"><ref id=\"c\"/></shape>");
    assert!(wrong.contains("s.xml:3:24: what an instance refers to"), "{wrong}");
}
