//! Nothing is read and then silently left out: each parameter that changes nothing has a note, and each that would change the picture is unsupported or wrong.

use super::tests::{CUBE, columnless, message, scene};
use crate::description::Bsdf;
use crate::import::tests::{folder, write};
use crate::import::{ImportOptions, import};

fn notes(inside: &str) -> String {
    let found = scene(inside).unwrap_or_else(|e| panic!("{inside}: {e}"));
    columnless(&found.notes.iter().map(|n| format!("{}: {}\n", n.place, n.text)).collect::<String>())
}

fn bsdf(inside: &str) -> String {
    format!("<shape type='cube'>\n{inside}</shape>")
}

#[test]
fn what_changes_nothing_has_a_note() {
    let film = |inside: &str| format!("{CUBE}\n<sensor type='perspective'>{inside}</sensor>");
    let integrator = |inside: &str| format!("{CUBE}\n<integrator {inside}</integrator>");
    let metal = "<string name='material' value='Au'/>";
    for (inside, part) in [
        (
            film("<float name='near_clip' value='1'/><float name='far_clip' value='9'/>"),
            "s.xml:3: near_clip, far_clip of sensor",
        ),
        (film("<float name='shutter_close' value='1'/>"), "s.xml:3: shutter_close of sensor"),
        (integrator("type='path'><boolean name='strict_normals' value='true'/>"), "s.xml:3: strict_normals"),
        (integrator("type='path'><integer name='timeout' value='9'/>"), "s.xml:3: timeout of integrator \"path\""),
        (
            integrator("type='bdpt'><boolean name='light_image' value='true'/>"),
            "s.xml:3: light_image of integrator \"bdpt\"",
        ),
        (integrator("type='direct'><integer name='max_depth' value='5'/>"), "s.xml:3: integrator \"direct\""),
        (
            integrator(
                "type='direct'><integer name='emitter_samples' value='4'/><integer name='bsdf_samples' value='2'/>",
            ),
            "s.xml:3: emitter_samples, bsdf_samples of integrator \"direct\"",
        ),
        (
            integrator("type='direct'><integer name='shading_samples' value='4'/>"),
            "s.xml:3: shading_samples of integrator",
        ),
        (integrator("type='path'><integer name='max_depth' value='-1'/>"), "s.xml:3: max_depth -1"),
        (
            bsdf(
                "<bsdf type='roughdielectric'><float name='int_ior' value='1'/><float name='ext_ior' value='1'/></bsdf>",
            ),
            "s.xml:3: roughdielectric between equal indices",
        ),
        (bsdf("<bsdf type='twosided'><bsdf type='dielectric'/></bsdf>"), "s.xml:3: twosided around"),
        (
            bsdf(
                "<bsdf type='twosided'><bsdf type='blendbsdf'><float name='weight' value='0.5'/><bsdf type='diffuse'/>\
                 <bsdf type='dielectric'/></bsdf></bsdf>",
            ),
            "s.xml:3: twosided around",
        ),
    ] {
        let notes = notes(&inside);
        assert!(notes.contains(part), "no {part:?} for {inside}: {notes:?}");
    }
    // what is as it is anyway has none
    for inside in [
        film("<film type='hdrfilm'><rfilter type='box'><float name='radius' value='0.5'/></rfilter></film>"),
        integrator("type='path'><boolean name='strict_normals' value='false'/>"),
        integrator("type='volpath'><integer name='max_depth' value='5'/>"),
        integrator("type='direct'>"),
        bsdf(&format!("<bsdf type='twosided'><bsdf type='conductor'>{metal}</bsdf></bsdf>")),
        bsdf("<bsdf type='roughdielectric'/>"),
    ] {
        assert_eq!(notes(&inside), "", "{inside}");
    }
}

#[test]
fn what_would_change_the_picture_is_refused() {
    let film = |inside: &str| format!("{CUBE}\n<sensor type='perspective'>{inside}</sensor>");
    let same = "<float name='int_ior' value='1'/><float name='ext_ior' value='1'/>";
    for (inside, part) in [
        (
            bsdf("<bsdf type='conductor'><string name='material' value='Au'/><rgb name='eta' value='1'/></bsdf>"),
            "s.xml:3: material beside eta or k",
        ),
        (film("<film type='specfilm'/>"), "s.xml:3: film \"specfilm\""),
        (
            film("<film type='hdrfilm'><rfilter type='box'><float name='radius' value='2'/></rfilter></film>"),
            "s.xml:3: rfilter \"box\" of radius 2",
        ),
        (film("<film type='hdrfilm'/><film type='hdrfilm'/>"), "s.xml:3: a second film"),
        (film("<sampler type='independent'/><sampler type='stratified'/>"), "s.xml:3: a second sampler"),
        (
            film("<sampler type='independent'>\n<integer name='sample_count' value='0'/></sampler>"),
            "s.xml:4: sample_count 0 should be at least 1",
        ),
        (film("\n<float name='principal_point_offset_x' value='0.1'/>"), "s.xml:4: principal_point_offset_x"),
        (film("\n<float name='principal_point_offset_y' value='-0.1'/>"), "s.xml:4: principal_point_offset_y"),
        (
            bsdf("<bsdf type='roughconductor'>\n<string name='distribution' value='phong'/></bsdf>"),
            "s.xml:4: distribution \"phong\"",
        ),
        (film("<film type='hdrfilm'><rfilter type='box'/><rfilter type='tent'/></film>"), "s.xml:3: a second rfilter"),
        (format!("{CUBE}<integrator type='path'/>\n<integrator type='path'/>"), "s.xml:3: a second integrator"),
        (
            format!(
                "{CUBE}<shape type='shapegroup' id='g'>\n<transform name='to_world'><scale value='2'/></transform></shape>"
            ),
            "s.xml:3: property \"to_world\" of shape \"shapegroup\"",
        ),
        (
            format!(
                "<shape type='shapegroup' id='g'>{CUBE}\n<float name='odd' value='2'/></shape><shape type='instance'><ref id='g'/></shape>"
            ),
            "s.xml:3: property \"odd\" of shape \"shapegroup\"",
        ),
        (
            bsdf("<bsdf type='diffuse'><texture type='uniform' name='reflectance'/></bsdf>"),
            "s.xml:3: a uniform texture lacks its value",
        ),
        (
            bsdf(
                "<bsdf type='diffuse'><texture type='uniform' name='reflectance'><float name='value' value='1'/><float name='odd' value='1'/></texture></bsdf>",
            ),
            "s.xml:3: property \"odd\" of texture \"uniform\"",
        ),
        (
            bsdf("<bsdf type='phong'><rgb name='exponent' value='1, 2, 3'/></bsdf>"),
            "s.xml:3: exponent [1.0, 2.0, 3.0] should be one number",
        ),
        // what equal indices make of no meaning is read all the same
        (
            bsdf(&format!("<bsdf type='roughdielectric'>{same}<float name='alpha' value='-1'/></bsdf>")),
            "s.xml:3: roughness [-1.0, -1.0]",
        ),
        (
            bsdf("<bsdf type='roughconductor'><float name='alpha' value='-1'/></bsdf>"),
            "s.xml:3: roughness [-1.0, -1.0]",
        ),
        (
            bsdf("<bsdf type='roughconductor'><float name='alpha' value='nan'/></bsdf>"),
            "s.xml:3: \"nan\" is not finite",
        ),
        (
            bsdf("<bsdf type='principled'><float name='roughness' value='-1'/></bsdf>"),
            "s.xml:3: roughness -1 should lie",
        ),
    ] {
        let message = columnless(&message(&inside));
        assert!(message.contains(part), "no {part:?} for {inside}: {message}");
    }
}

/// A number of a colour is its luminance; of 0.5 and 0.6 a metal's values win over its name.
#[test]
fn numbers_of_colours_and_values_beside_names() {
    let of = |text: &str, version: &str| {
        let dir = folder();
        let text =
            format!("<scene version='{version}'><shape type='cube'>{text}</shape><emitter type='constant'/></scene>");
        let out = import(&write(&dir, "s.xml", text), &ImportOptions::default()).unwrap();
        (out.materials[0].bsdf.clone(), out.notes.iter().map(|n| n.text.clone()).collect::<Vec<_>>())
    };
    let [gold, eta] = ["<string name='material' value='Au'/>", "<spectrum name='eta' value='1.5'/>"];
    let k = "<spectrum name='k' value='2'/>";
    let metal = |inside: &str, version: &str| of(&format!("<bsdf type='conductor'>{inside}</bsdf>"), version);
    let rough = "<bsdf type='roughconductor'><rgb name='alpha' value='0.1, 0.2, 0.3'/></bsdf>";
    let (Bsdf::RoughConductor { alpha, .. }, notes) = of(rough, "3.0.0") else { panic!() };
    assert!(notes.is_empty(), "{notes:?}");
    assert!((alpha[0] - (0.2126 * 0.1 + 0.7152 * 0.2 + 0.0722 * 0.3)).abs() < 1e-6, "{alpha:?}");
    let (Bsdf::Conductor { eta: of_gold, k: other, .. }, _) = metal(gold, "0.6.0") else { panic!() };
    let (Bsdf::Conductor { eta: given, k: kept, .. }, notes) = metal(&format!("{gold}{eta}"), "0.6.0") else {
        panic!()
    };
    assert!(
        notes.is_empty() && given == [1.5; 3] && of_gold != given && other == kept,
        "the name says what no value does"
    );
    let (Bsdf::Conductor { eta: given, k: other, .. }, notes) = metal(&format!("{gold}{eta}{k}"), "0.6.0") else {
        panic!()
    };
    assert_eq!((given, other), ([1.5; 3], [2.0; 3]));
    assert!(notes.len() == 1 && notes[0].contains("\"Au\" is passed over"), "{notes:?}");

    // without either: Mitsuba 3's mirror in all versions, of which the old are told
    let mirror = metal("", "3.0.0");
    assert_eq!(mirror, (Bsdf::Conductor { eta: [0.0; 3], k: [1.0; 3], specular: [1.0; 3] }, vec![]));
    let none = "<string name='material' value='none'/>";
    for (inside, version, told) in [
        ("", "0.6.0", true),
        ("", "0.5.0", true),
        (eta, "0.6.0", true),
        (none, "0.6.0", false),
        (&format!("{eta}{k}"), "0.6.0", false),
        (gold, "0.6.0", false),
        ("", "2.0.0", false),
        (eta, "3.0.0", false),
    ] {
        let (found, notes) = metal(inside, version);
        assert!(!inside.is_empty() || found == mirror.0, "{found:?}");
        let what = "conductor without a material is a perfect mirror, as Mitsuba 3 reads it; 0.5 and 0.6 made it of copper: write material \"Cu\"";
        assert_eq!(notes.iter().any(|n| n.starts_with(what)), told, "{inside} in {version}: {notes:?}");
        assert_eq!(notes.len(), usize::from(told), "{notes:?}");
    }
}

/// What meshes have, and a shape without a material of its own does not use.
#[test]
fn materials_and_colours_of_meshes_have_notes() {
    let dir = folder();
    let mut stl = vec![0; 84 + 50];
    stl[80] = 1;
    stl[96] = 0x80;
    stl[96 + 3] = 0x3f;
    stl[84 + 12 + 12 + 2..][..2].copy_from_slice(&[0x80, 0x3f]);
    stl[84 + 12 + 28 + 2..][..2].copy_from_slice(&[0x80, 0x3f]);
    write(&dir, "plain.stl", &stl);
    stl[84 + 48..].copy_from_slice(&[1, 0x80]);
    write(&dir, "c.stl", &stl);
    let faces = "v 1 0 0\nv 0 1 0\nf 1 2 3\n";
    write(&dir, "lib.obj", format!("mtllib a.mtl\nv 0 0 0\n{faces}"));
    write(&dir, "c.obj", format!("v 0 0 0 1 0 0\n{faces}"));
    write(&dir, "w.obj", format!("v 0 0 0 1 # weight\n{faces}"));
    write(&dir, "plain.obj", format!("v 0 0 0 # 1 2 3\n{faces}"));
    let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    let colors = "property float r\nproperty float g\nproperty float b\n";
    let faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    write(&dir, "c.ply", format!("{header}{colors}{faces}0 0 0 1 1 1\n1 0 0 1 1 1\n0 1 0 1 1 1\n3 0 1 2\n"));
    let text = format!("{header}{faces}0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n");
    write(&dir, "t.ply", text.replace("element v", "comment TextureFile skin.png\nelement v"));
    write(&dir, "plain.ply", text.replace("element v", "comment TextureFile\ncomment a TextureFile b\nelement v"));
    for (file, part) in [
        ("c.stl", "colours of the stl are passed over"),
        ("lib.obj", "names materials of its own"),
        ("c.obj", "colours of the obj's vertices are passed over"),
        ("w.obj", "weights of the obj's vertices are passed over"),
        ("c.ply", "colours of the ply are passed over"),
        ("t.ply", "the texture that the ply names is passed over"),
        ("plain.stl", ""),
        ("plain.obj", ""),
        ("plain.ply", ""),
    ] {
        let kind = file.rsplit('.').next().unwrap();
        let read = |version: &str, bsdf: &str| {
            let text = format!(
                "<scene version='{version}'><emitter type='constant'/>\n<shape type='{kind}'><string name='filename' value='{file}'/>{bsdf}\
                 </shape></scene>"
            );
            let notes = import(&write(&dir, "s.xml", text), &ImportOptions::default()).unwrap().notes;
            notes.iter().map(|n| format!("{}: {}", n.place, n.text)).collect::<String>()
        };
        let found = read("3.0.0", "");
        if part.is_empty() {
            assert_eq!(found, "", "{file}");
        } else {
            assert!(found.contains("s.xml:2:1: ") && found.contains(part), "{file}: {found:?}");
        }
        assert_eq!(read("3.0.0", "<bsdf type='diffuse'/>"), "", "{file} with a material of its own");
        // which counted for less in 0.5 and 0.6
        let old = read("0.6.0", "<bsdf type='diffuse'/>");
        assert_eq!(old.contains("0.5 and 0.6 gave to its parts"), file == "lib.obj", "{file}: {old:?}");
        // of a bare mesh colours are all the same, but a PLY's, which are read
        if file != "c.ply" && file != "lib.obj" {
            let notes = import(&dir.path().join(file), &ImportOptions::default()).unwrap().notes;
            assert_eq!(notes.iter().any(|n| n.text.contains(part)), !part.is_empty(), "{file}: {notes:?}");
            let place = notes.first().map_or_else(String::new, |n| n.place.to_string());
            assert!(file != "t.ply" || place.ends_with("t.ply:3:9"), "{place}");
        }
    }
}
