//! Emitters of the scene: what their elements become.

use super::tests::{CUBE, message, scene};
use crate::description::{Affine, Beam, Environment};
use crate::import::tests::{folder, write};
use crate::import::{ImportOptions, import, sky_map};

/// A 2 x 2 picture of (1, 0.5, 0.25) times 1, 2, 4 and 8, in old RGBE.
const SKY: &[u8] =
    b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 2\n\x80\x40\x20\x81\x80\x40\x20\x82\x80\x40\x20\x83\x80\x40\x20\x84";

#[test]
fn an_envmap_is_a_picture_that_is_turned() {
    let dir = folder();
    std::fs::write(dir.path().join("sky.hdr"), SKY).unwrap();
    for (version, map) in [("3.0.0", "to_world"), ("0.6.0", "toWorld")] {
        let text = format!(
            "<scene version=\"{version}\">{CUBE}<emitter type=\"envmap\"><string name=\"filename\" value=\"sky.hdr\"/>\n\
             <float name=\"scale\" value=\"2.5\"/><transform name=\"{map}\"><rotate y=\"1\" angle=\"90\"/></transform></emitter></scene>"
        );
        let out = import(&write(&dir, "s.xml", text), &ImportOptions::default()).unwrap();
        let Some(Environment::Map { path, scale, to_world, .. }) = &out.environment else { panic!("no map") };
        assert!(path.ends_with("sky.hdr") && *scale == 2.5);
        // a direction of the world along x is one of the picture along z
        let rows = crate::import::to_map(to_world);
        let of_picture = rows.map(|r| r[0]);
        assert!((of_picture[2] - 1.0).abs() < 1e-6 && of_picture[0].abs() < 1e-6, "{of_picture:?}");
        let map = sky_map(out.environment.as_ref()).unwrap().unwrap();
        assert_eq!(map.size(), [2, 2]);
        // the upper pole is the mean of the first row
        let up = map.radiance([0.0, 1.0, 0.0].into());
        assert!((up.x - 1.5).abs() < 1e-5 && (up.y - 0.75).abs() < 1e-5, "{up}");
    }
}

#[test]
fn a_bad_envmap_is_refused_with_its_place() {
    let dir = folder();
    write(&dir, "sky.hdr", SKY);
    let whole = |inside: &str| {
        let text = format!("<scene version=\"3.0.0\">{CUBE}\n{inside}</scene>");
        import(&write(&dir, "s.xml", text), &ImportOptions::default()).unwrap_err().to_string()
    };
    let envmap = |inside: &str| whole(&format!("<emitter type=\"envmap\">{inside}</emitter>"));
    let file = "<string name=\"filename\" value=\"sky.hdr\"/>";
    assert!(envmap("").contains("s.xml:2:1: an envmap without a filename"), "{}", envmap(""));
    let bad = envmap(&format!("{file}<float name=\"scale\" value=\"-1\"/>"));
    assert!(bad.contains("s.xml:2:1: scale -1 should be above 0"), "{bad}");
    let sheared = "<transform name=\"to_world\"><scale x=\"2\"/></transform>";
    assert!(envmap(&format!("{file}{sheared}")).contains("should be a rotation"));
    let two = format!("<emitter type=\"envmap\">{file}</emitter><emitter type=\"constant\"/>");
    assert!(whole(&two).contains("a second environment emitter"));
    assert!(envmap(&file.replace("sky", "none")).contains("there is no such file"));
    // the picture itself is read when the scene is prepared or checked
    let text = format!("<scene version=\"3.0.0\">{CUBE}\n<emitter type=\"envmap\">{file}</emitter></scene>");
    let path = write(&dir, "s.xml", text);
    let error = || {
        let out = import(&path, &ImportOptions::default()).unwrap();
        sky_map(out.environment.as_ref()).unwrap_err().to_string()
    };
    std::fs::write(dir.path().join("sky.hdr"), &SKY[..SKY.len() - 1]).unwrap();
    assert!(error().contains("sky.hdr: "), "{}", error());
    std::fs::write(dir.path().join("sky.hdr"), b"#?RGBE\n\n-Y 1 +X 1\n\x80\x80\x80\x80").unwrap();
    assert!(error().contains("s.xml:2:1: ") && error().contains("1 x 2 at least"), "{}", error());
}

#[test]
fn a_constant_sky() {
    let out = scene(CUBE).unwrap();
    assert_eq!(out.environment, Some(Environment::Constant([1.0; 3])));
    assert!(sky_map(out.environment.as_ref()).unwrap().is_none());
    assert_eq!(crate::import::to_map(&Affine::IDENTITY), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
}

/// The beams of a scene with a cube and what is given.
fn beams(inside: &str) -> Vec<Beam> {
    scene(&format!("{CUBE}{inside}")).unwrap().beams
}

#[test]
fn lights_without_extent() {
    let point = "<emitter type=\"point\"><point name=\"position\" x=\"1\" y=\"2\" z=\"3\"/><rgb name=\"intensity\" value=\"4, 5, 6\"/></emitter>";
    let by_map = "<emitter type=\"point\"><transform name=\"toWorld\"><scale value=\"7\"/><translate x=\"1\" y=\"2\" z=\"3\"/></transform>\
                  <spectrum name=\"intensity\" value=\"4, 5, 6\"/></emitter>";
    let expected = Beam::Point { position: [1.0, 2.0, 3.0], intensity: [4.0, 5.0, 6.0] };
    assert_eq!(beams(&format!("{point}{by_map}")), [expected.clone(), expected]);

    let look =
        "<transform name=\"to_world\"><lookat origin=\"0, 5, 0\" target=\"0, 3, 0\" up=\"1, 0, 0\"/></transform>";
    let spot = format!("<emitter type=\"spot\">{look}<float name=\"intensity\" value=\"2\"/></emitter>");
    let Beam::Spot { position, axis, intensity, beam, cutoff, .. } = beams(&spot)[0] else { panic!("no spot") };
    assert_eq!((position, axis, intensity, beam, cutoff), ([0.0, 5.0, 0.0], [0.0, -1.0, 0.0], [2.0; 3], 15.0, 20.0));
    let sharp = spot.replace("<float", "<float name=\"beamWidth\" value=\"20\"/><float");
    let Beam::Spot { beam, .. } = beams(&sharp)[0] else { panic!("no spot") };
    assert!(beam < 20.0 && beam > 19.999);

    let sun = "<emitter type=\"directional\"><vector name=\"direction\" x=\"0\" y=\"-3\" z=\"4\"/><rgb name=\"irradiance\" value=\"1, 2, 3\"/></emitter>";
    assert_eq!(beams(sun), [Beam::Directional { direction: [0.0, -0.6, 0.8], irradiance: [1.0, 2.0, 3.0] }]);
    let turned = format!("<emitter type=\"directional\">{look}</emitter>");
    assert_eq!(beams(&turned), [Beam::Directional { direction: [0.0, -1.0, 0.0], irradiance: [1.0; 3] }]);
    // a black one is none
    assert_eq!(beams("<emitter type=\"point\"><float name=\"intensity\" value=\"0\"/></emitter>"), []);
}

#[test]
fn bad_lights_are_refused_with_their_place() {
    let bad = |plugin: &str, inside: &str| message(&format!("{CUBE}\n<emitter type=\"{plugin}\">{inside}</emitter>"));
    for (plugin, inside, what) in [
        ("point", "<float name=\"intensity\" value=\"-1\"/>", "intensity [-1.0, -1.0, -1.0] should be at least 0"),
        ("directional", "<vector name=\"direction\" value=\"0\"/>", "leaves it no direction"),
        ("spot", "<float name=\"cutoff_angle\" value=\"0\"/>", "cutoff_angle 0 should be above 0"),
        ("spot", "<float name=\"beam_width\" value=\"30\"/>", "beam_width 30 should lie between"),
        ("spot", "<transform name=\"to_world\"><scale value=\"0\"/></transform>", "leaves it no direction"),
        ("point", "<float name=\"wobble\" value=\"1\"/>", "property \"wobble\" of emitter \"point\""),
    ] {
        let told = bad(plugin, inside);
        assert!(told.contains("s.xml:3") && told.contains(what), "{told}");
    }
}

#[test]
fn a_light_without_extent_is_light_enough() {
    let dir = folder();
    let text = |light: &str| format!("<scene version=\"3.0.0\">{CUBE}{light}</scene>");
    let import = |light: &str| import(&write(&dir, "s.xml", text(light)), &ImportOptions::default());
    assert!(import("<emitter type=\"point\"/>").is_ok());
    assert!(import("").unwrap_err().to_string().contains("nothing in this scene emits light"));
}
