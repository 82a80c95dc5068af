//! Sensors and films: what their elements become.

use super::tests::{CUBE, message, scene};
use crate::description::{Camera, Projection};

fn camera(sensor: &str, inside: &str, film: &str) -> (Camera, [u32; 2]) {
    let text = format!(
        "{CUBE}<sensor type=\"{sensor}\">{inside}<film type=\"hdrfilm\"><integer name=\"width\" value=\"200\"/>\
         <integer name=\"height\" value=\"100\"/>{film}</film></sensor>"
    );
    let out = scene(&text).unwrap();
    (out.camera.unwrap(), out.size.unwrap())
}

#[test]
fn lenses_and_parallel_projection() {
    let lens = "<float name=\"fov\" value=\"30\"/><float name=\"apertureRadius\" value=\"0.25\"/>";
    let (camera, _) = camera("thinlens", &format!("{lens}<float name=\"focusDistance\" value=\"5\"/>"), "");
    assert_eq!(camera.projection, Projection::ThinLens { fov_x: 30.0, aperture: 0.25, focus: 5.0 });
    let (camera, _) = self::camera("thinlens", lens, "");
    assert_eq!(camera.projection, Projection::ThinLens { fov_x: 30.0, aperture: 0.25, focus: 10_000.0 });
    let map = "<transform name=\"to_world\"><scale value=\"3\"/></transform>";
    let (camera, size) = self::camera("orthographic", map, "");
    assert_eq!((camera.projection, camera.to_world.0[0][0], size), (Projection::Orthographic, 3.0, [200, 100]));
    let bad = format!("{CUBE}\n<sensor type=\"thinlens\"/>");
    assert!(message(&bad).contains("s.xml:3:1: a thinlens without an aperture_radius"), "{}", message(&bad));
    let bad = format!("{CUBE}\n<sensor type=\"thinlens\"><float name=\"aperture_radius\" value=\"-1\"/></sensor>");
    assert!(message(&bad).contains("aperture_radius -1"), "{}", message(&bad));
    let bad = format!("{CUBE}\n<sensor type=\"orthographic\"><float name=\"fov\" value=\"40\"/></sensor>");
    assert!(message(&bad).contains("property \"fov\" of sensor \"orthographic\""), "{}", message(&bad));
}

#[test]
fn a_crop_is_the_picture() {
    let number = |name: &str, n: i32| format!("<integer name=\"{name}\" value=\"{n}\"/>");
    let crop = |x, y, w, h| {
        ["cropOffsetX", "cropOffsetY", "cropWidth", "cropHeight"]
            .iter()
            .zip([x, y, w, h])
            .map(|(n, v)| number(n, v))
            .collect::<String>()
    };
    let fov = "<float name=\"fov\" value=\"40\"/><string name=\"fov_axis\" value=\"y\"/>";
    let (whole, size) = camera("perspective", fov, &crop(0, 0, 200, 100));
    assert_eq!((whole.crop, size), (None, [200, 100]));
    let (part, size) = camera("perspective", fov, &crop(30, 20, 50, 60));
    assert_eq!((part.crop, size), (Some(([200, 100], [30, 20, 50, 60])), [50, 60]));
    assert_eq!(part.projection, whole.projection, "the field of view is the film's");
    for bad in [crop(151, 0, 50, 10), crop(0, 0, 0, 10), crop(-1, 0, 10, 10), crop(0, 41, 10, 60)] {
        let text = format!(
            "{CUBE}<sensor type=\"perspective\"><film type=\"hdrfilm\">{}{}{bad}</film></sensor>",
            number("width", 200),
            number("height", 100)
        );
        assert!(message(&text).contains("should lie on the film of 200 x 100"), "{}", message(&text));
    }
}

#[test]
fn emitters_can_be_hidden() {
    let hide =
        |inside: &str| scene(&format!("{CUBE}<integrator type=\"path\">{inside}</integrator>")).unwrap().hide_emitters;
    assert!(!hide("") && !hide("<boolean name=\"hideEmitters\" value=\"false\"/>"));
    assert!(hide("<boolean name=\"hide_emitters\" value=\"true\"/>"));
}

#[test]
fn aovs_are_read_around_an_integrator() {
    use rayherd_render::aov::{Aov, Aovs};
    let around = |aovs: &str, inside: &str| {
        format!("{CUBE}<integrator type=\"aov\"><string name=\"aovs\" value=\"{aovs}\"/>{inside}</integrator>")
    };
    let path = "<integrator type=\"path\" name=\"img\"><integer name=\"max_depth\" value=\"3\"/></integrator>";
    let read = scene(&around("dd.y:depth,nn:sh_normal, a:albedo,,p:position,t:uv,s:shape_index", path)).unwrap();
    let all = [Aov::Albedo, Aov::Normal, Aov::Depth, Aov::Position, Aov::Uv, Aov::ObjectId];
    assert_eq!((read.aovs, read.max_depth), (Some(all.into_iter().collect()), Some(3)));
    assert!(read.notes.iter().any(|n| n.text.contains("albedo, normal, depth")), "{:?}", read.notes);
    assert_eq!(scene(&around("", path)).unwrap().aovs, Some(Aovs::NONE));
    assert_eq!(scene(&format!("{CUBE}{path}")).unwrap().aovs, None);
    assert!(message(&around("depth", path)).contains("should be NAME:KIND"));
    for (text, what) in [
        (around("x:prim_index", path), "AOV \"prim_index\""),
        (around("x:depth", &format!("{path}{path}")), "another integrator"),
        (around("x:depth", "<integrator type=\"aov\"/>"), "integrator \"aov\" in integrator \"aov\""),
        (around("x:depth", "<integer name=\"max_depth\" value=\"3\"/>"), "property \"max_depth\""),
    ] {
        assert!(message(&text).contains(what), "{}", message(&text));
    }
}
