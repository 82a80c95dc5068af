//! `sunsky`, `sky` and `sun`: what their elements become.

use super::tests::{CUBE, message, scene_with};
use crate::description::{Beam, Description, Environment, Skylight, Sun};
use crate::import::tests::{folder, write};
use crate::import::{ImportOptions, import, sky_map};

fn read(version: &str, inside: &str) -> Description {
    let text = format!("<scene version=\"{version}\">{CUBE}{inside}</scene>");
    import(&write(&folder(), "s.xml", text), &ImportOptions::default()).unwrap()
}

fn sky(out: &Description) -> &Skylight {
    let Some(Environment::Sky(sky)) = &out.environment else { panic!("{:?}", out.environment) };
    sky
}

fn sun(out: &Description) -> &Sun {
    out.sun.as_ref().expect("a sun")
}

fn close(a: [f64; 3], b: [f64; 3]) -> bool {
    (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9)
}

/// The classroom's, from a file of 0.5: y is up, and the sun's power stays when it grows.
#[test]
fn old_files_have_y_up() {
    let text = |radius: &str| {
        format!(
            "<emitter type=\"sunsky\"><float name=\"turbidity\" value=\"3\"/>\
             <vector name=\"sunDirection\" x=\"-0.6\" y=\"0.64\" z=\"-0.48\"/>\
             <float name=\"skyScale\" value=\"6\"/><float name=\"sunScale\" value=\"10\"/>{radius}</emitter>"
        )
    };
    let large = "<float name=\"sunRadiusScale\" value=\"20\"/>";
    let out = read("0.5.0", &text(large));
    let direction = [-0.6, 0.64, -0.48];
    assert!(close(sun(&out).direction, direction) && close(sun(&out).up, [0.0, 1.0, 0.0]), "{:?}", out.sun);
    assert!((sun(&out).half_angle.to_degrees() - 5.358).abs() < 1e-9);
    let of_sky = sky(&out);
    assert!((of_sky.sun[2] - 0.64).abs() < 1e-9 && of_sky.scale == 6.0 && of_sky.albedo == [0.15; 3]);
    // the sky's own directions are turned so that its sun is the world's
    assert!(close(of_sky.to_world.vector(of_sky.sun), direction));
    let small = read("0.5.0", &text(""));
    let power = |s: &Sun| f64::from(s.radiance[1]) * (0.5 * s.half_angle).sin().powi(2);
    assert!((power(sun(&small)) / power(sun(&out)) - 1.0).abs() < 1e-6);
    // a sun of no size is parallel light of the same irradiance
    let none = read("0.5.0", &text("<float name=\"sunRadiusScale\" value=\"0\"/>"));
    let [Beam::Directional { direction: along, irradiance }] = none.beams[..] else { panic!("{:?}", none.beams) };
    assert!(none.sun.is_none() && close(along.map(|v| -v), direction));
    assert!((f64::from(irradiance[1]) / (power(sun(&out)) * 4.0 * std::f64::consts::PI) - 1.0).abs() < 1e-6);
}

#[test]
fn new_files_have_z_up() {
    let direction = "<vector name=\"sun_direction\" x=\"0\" y=\"3\" z=\"4\"/>";
    let out = read("3.0.0", &format!("<emitter type=\"sunsky\">{direction}</emitter>"));
    assert!(close(sun(&out).direction, [0.0, 0.6, 0.8]) && close(sun(&out).up, [0.0, 0.0, 1.0]));
    assert!(close(sky(&out).sun, [0.0, 0.6, 0.8]) && sky(&out).turbidity == 3.0);
    let turned = "<transform name=\"to_world\"><rotate x=\"1\" angle=\"-90\"/></transform>";
    let out = read("3.0.0", &format!("<emitter type=\"sunsky\">{direction}{turned}</emitter>"));
    // z of the sky is y of the world; the sun's direction is the world's
    assert!(close(sun(&out).direction, [0.0, 0.6, 0.8]) && close(sun(&out).up, [0.0, 1.0, 0.0]), "{:?}", out.sun);
    assert!(close(sky(&out).sun, [0.0, -0.8, 0.6]), "{:?}", sky(&out).sun);
    assert!(sky_map(out.environment.as_ref()).unwrap().is_some());
    // one without the other, beside another sky too
    let only = read(
        "3.0.0",
        &format!("<emitter type=\"sunsky\">{direction}<float name=\"sky_scale\" value=\"0\"/></emitter>"),
    );
    assert!(only.environment.is_none() && only.sun.is_some());
    let both = read(
        "0.6.0",
        "<emitter type=\"constant\"/><emitter type=\"sun\"><float name=\"scale\" value=\"2\"/></emitter>",
    );
    assert!(matches!(both.environment, Some(Environment::Constant(_))) && both.sun.is_some());
    let only = read("0.6.0", "<emitter type=\"sky\"><integer name=\"resolution\" value=\"64\"/></emitter>");
    assert!(only.environment.is_some() && only.sun.is_none());
}

/// By time and place Mitsuba 3.9.1 says (0.0513854, 0.691748, 0.720308) by default; its date is rounded to quarters of a day.
#[test]
fn the_time_says_where_the_sun_is() {
    let out = read("3.0.0", "<emitter type=\"sunsky\"/>");
    let expected = [0.0513854, 0.691748, 0.720308];
    assert!((0..3).all(|i| (sun(&out).direction[i] - expected[i]).abs() < 3e-3), "{:?}", sun(&out).direction);
    let text = "<emitter type=\"sunsky\"><float name=\"hour\" value=\"9.5\"/><float name=\"minute\" value=\"20\"/>\
                <integer name=\"month\" value=\"3\"/><float name=\"latitude\" value=\"-33\"/><float name=\"longitude\" value=\"151\"/>\
                <float name=\"timezone\" value=\"10\"/></emitter>";
    let expected = [-0.387833, -0.559232, 0.732697];
    let found = sun(&read("3.0.0", text)).direction;
    assert!((0..3).all(|i| (found[i] - expected[i]).abs() < 3e-3), "{found:?}");
    // 0.6, y up: in the afternoon in the west, -x, and from Tokyo in the south, +z
    let old = sun(&read("0.6.0", "<emitter type=\"sunsky\"/>")).direction;
    assert!(old[0] < -0.5 && old[1] > 0.5 && old[2] > 0.0, "{old:?}");
    // at midnight there is neither
    let dark = "<emitter type=\"sunsky\"><float name=\"hour\" value=\"0\"/></emitter><emitter type=\"point\"/>";
    let out = read("3.0.0", dark);
    assert!(out.environment.is_none() && out.sun.is_none());
}

#[test]
fn bad_daylight_is_refused_with_its_place() {
    let bad = |inside: &str| message(&format!("{CUBE}\n<emitter type=\"sunsky\">{inside}</emitter>"));
    let float = |name: &str, value: &str| format!("<float name=\"{name}\" value=\"{value}\"/>");
    let up = "<vector name=\"sun_direction\" x=\"0\" y=\"0\" z=\"1\"/>";
    for (inside, what) in [
        (float("turbidity", "0.5"), "turbidity 0.5 should lie between 1 and 10"),
        (float("sky_scale", "-1"), "sky_scale -1 should lie"),
        (float("sun_aperture", "0"), "sun_aperture 0 should lie"),
        (float("latitude", "91"), "latitude 91 should lie"),
        (float("wobble", "1"), "property \"wobble\" of emitter \"sunsky\""),
        (float("stretch", "1.5"), "stretch of a sky"),
        ("<rgb name=\"albedo\" value=\"2, 0, 0\"/>".into(), "albedo [2.0, 0.0, 0.0] should lie in [0, 1]"),
        (format!("{up}{}", float("hour", "3")), "both sun_direction and hour"),
        ("<vector name=\"sun_direction\" x=\"0\" y=\"0\" z=\"0\"/>".into(), "has no length"),
        (format!("{}{}", float("sun_aperture", "1"), float("sun_radius_scale", "1")), "give one of them"),
        ("<boolean name=\"complex_sun\" value=\"true\"/>".into(), "complex_sun"),
        ("<transform name=\"to_world\"><scale x=\"2\"/></transform>".into(), "should be a rotation"),
    ] {
        let told = bad(&inside);
        assert!(told.contains("s.xml:3") && told.contains(what), "{told}");
    }
    let two = format!("{CUBE}<emitter type=\"sunsky\"/><emitter type=\"constant\"/>");
    assert!(
        scene_with(&two, &ImportOptions::default()).unwrap_err().to_string().contains("a second environment emitter")
    );
    let two = format!("{CUBE}<emitter type=\"sun\"/><emitter type=\"sun\"/>");
    assert!(scene_with(&two, &ImportOptions::default()).unwrap_err().to_string().contains("a second sun"));
    // --sky stands in for both
    let options = ImportOptions { sky: Some([1.0; 3]), ..ImportOptions::default() };
    let out = scene_with(&format!("{CUBE}<emitter type=\"sunsky\"/>"), &options).unwrap();
    assert!(out.sun.is_none() && out.environment == Some(Environment::Constant([1.0; 3])));
}
