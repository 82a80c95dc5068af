//! Textures in XML, and the materials around them.

use std::path::Path;

use crate::ImportError;
use crate::description::{
    Amount, Beam, Bsdf, Description, Detail, Geometry, Material, MeshAttribute, Relief, ReliefKind, Slot, TexelFilter,
    Texture, TextureKind, Textured, UvMap, Wrap,
};
use crate::import::tests::folder;
use crate::import::{ImportOptions, import};

/// A scene of these elements beside a picture `a.hdr`, with a sky.
fn scene_with(inside: &str, substitute: bool) -> Result<Description, ImportError> {
    let folder = folder();
    let text = format!("<scene version=\"0.6.0\">\n{inside}\n</scene>");
    std::fs::write(folder.path().join("s.xml"), text).unwrap();
    std::fs::write(
        folder.path().join("a.hdr"),
        "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\u{1}\u{2}\u{3}\u{4}",
    )
    .unwrap();
    std::fs::write(folder.path().join("b.png"), "no picture").unwrap();
    let options = ImportOptions { sky: Some([1.0; 3]), substitute, ..ImportOptions::default() };
    import(&folder.path().join("s.xml"), &options)
}

fn scene(inside: &str) -> Description {
    scene_with(inside, false).unwrap()
}

/// A shape of a material.
fn shape(bsdf: &str) -> String {
    format!("<shape type=\"cube\">{bsdf}</shape>")
}

fn bitmap(name: &str, more: &str) -> String {
    format!("<texture type=\"bitmap\" name=\"{name}\"><string name=\"filename\" value=\"a.hdr\"/>{more}</texture>")
}

fn detail(material: &Material) -> &Detail {
    material.detail.as_deref().unwrap()
}

fn textured(slot: Slot, texture: u32) -> Textured {
    Textured::new(slot, texture)
}

#[test]
fn bitmaps_in_both_spellings() {
    let kind = |more: &str| {
        let out = scene(&shape(&format!("<bsdf type=\"diffuse\">{}</bsdf>", bitmap("reflectance", more))));
        assert_eq!(detail(&out.materials[0]).textured, [textured(Slot::Diffuse, 0)]);
        assert!(detail(&out.materials[0]).is_paint());
        let [Texture { kind: TextureKind::Image { path, raw, wrap, filter, to_uv }, place }] = &out.textures[..] else {
            panic!("{:?}", out.textures)
        };
        assert_eq!((path.file_name(), place.line), (Some("a.hdr".as_ref()), 2));
        (*raw, *wrap, *filter, *to_uv)
    };
    assert_eq!(kind(""), (false, Wrap::Repeat, TexelFilter::Bilinear, UvMap::IDENTITY));
    let new = "<boolean name=\"raw\" value=\"true\"/><string name=\"wrap_mode\" value=\"mirror\"/>\
        <string name=\"filter_type\" value=\"nearest\"/><transform name=\"to_uv\"><translate x=\"0.1\" y=\"0.2\"/>\
        <rotate z=\"1\" angle=\"30\"/><scale x=\"3\" y=\"5\"/></transform>";
    let (raw, wrap, filter, UvMap(map)) = kind(new);
    assert_eq!((raw, wrap, filter), (true, Wrap::Mirror, TexelFilter::Nearest));
    // Mitsuba 3.9.1's matrix for this
    let expected = [[2.598_08, -1.5, -0.040_192_4], [2.5, 4.330_13, 1.116_03]];
    for (found, expected) in map.iter().flatten().zip(expected.iter().flatten()) {
        assert!((f64::from(*found) - expected).abs() < 1e-5, "{map:?}");
    }
    let old = "<float name=\"gamma\" value=\"1\"/><string name=\"wrapMode\" value=\"clamp\"/>\
        <string name=\"filterType\" value=\"nearest\"/><float name=\"uscale\" value=\"3\"/>\
        <float name=\"vscale\" value=\"5\"/><float name=\"uoffset\" value=\"0.1\"/><float name=\"voffset\" value=\"0.2\"/>";
    let (raw, wrap, filter, UvMap(map)) = kind(old);
    assert_eq!((raw, wrap, filter), (true, Wrap::Clamp, TexelFilter::Nearest));
    assert_eq!(map, [[3.0, 0.0, 0.3], [0.0, 5.0, 1.0]].map(|row| row.map(|x: f64| x as f32)));
}

/// By model every parameter that takes a texture, and the slot that it goes to; which field of the model a slot gives is `render`'s to know
/// (`a_texture_reaches_its_parameter_alone`).
const PARAMETERS: &[(&str, &[(&str, Slot)])] = &[
    ("diffuse", &[("reflectance", Slot::Diffuse), ("diffuse_reflectance", Slot::Diffuse)]),
    ("conductor", &[("specular_reflectance", Slot::Specular)]),
    ("roughconductor", &[("specular_reflectance", Slot::Specular), ("alpha", Slot::Alpha)]),
    ("roughconductor", &[("alpha_u", Slot::AlphaU), ("alpha_v", Slot::AlphaV)]),
    ("dielectric", &[("specular_reflectance", Slot::Specular), ("specular_transmittance", Slot::Transmit)]),
    ("thindielectric", &[("specular_reflectance", Slot::Specular), ("specular_transmittance", Slot::Transmit)]),
    ("roughdielectric", &[("specular_reflectance", Slot::Specular), ("specular_transmittance", Slot::Transmit)]),
    ("roughdielectric", &[("alpha", Slot::Alpha)]),
    ("roughdielectric", &[("alpha_u", Slot::AlphaU), ("alpha_v", Slot::AlphaV)]),
    ("plastic", &[("diffuse_reflectance", Slot::Diffuse), ("specular_reflectance", Slot::Specular)]),
    ("roughplastic", &[("diffuse_reflectance", Slot::Diffuse), ("specular_reflectance", Slot::Specular)]),
    ("phong", &[("diffuse_reflectance", Slot::Diffuse), ("specular_reflectance", Slot::Specular)]),
    (
        "principled",
        &[
            ("base_color", Slot::Diffuse),
            ("roughness", Slot::Roughness),
            ("anisotropic", Slot::Anisotropic),
            ("metallic", Slot::Metallic),
            ("spec_trans", Slot::SpecTrans),
            ("spec_tint", Slot::SpecTint),
            ("sheen", Slot::Sheen),
            ("sheen_tint", Slot::SheenTint),
            ("clearcoat", Slot::Clearcoat),
            ("clearcoat_gloss", Slot::ClearcoatGloss),
            ("flatness", Slot::Flatness),
        ],
    ),
];

/// A name as 0.5 and 0.6 have it.
fn camel(name: &str) -> String {
    let mut words = name.split('_');
    let first = words.next().unwrap_or_default().to_owned();
    words.fold(first, |out, word| out + &word[..1].to_uppercase() + &word[1..])
}

#[test]
fn every_parameter_that_takes_one() {
    for (plugin, parameters) in PARAMETERS {
        for spelling in [str::to_owned, camel] {
            for (name, slot) in *parameters {
                // the other roughness must be there
                let other = match *slot {
                    Slot::AlphaU => "<float name=\"alpha_v\" value=\"0.3\"/>",
                    Slot::AlphaV => "<float name=\"alpha_u\" value=\"0.3\"/>",
                    _ => "",
                };
                let bsdf = format!("<bsdf type=\"{plugin}\">{}{other}</bsdf>", bitmap(&spelling(name), ""));
                let out = scene(&shape(&bsdf));
                assert_eq!(detail(&out.materials[0]).textured, [textured(*slot, 0)], "{bsdf}");
                let mut model = out.materials[0].bsdf.clone();
                let there = match slot {
                    Slot::Diffuse | Slot::Specular | Slot::Transmit => model.color_mut(*slot).is_some(),
                    Slot::Alpha | Slot::AlphaU | Slot::AlphaV => model.alpha_mut().is_some(),
                    _ => model.number_mut(*slot).is_some(),
                };
                assert!(there, "{model:?} has no {slot:?}");
            }
        }
    }
    // one file looked at one way is one texture
    let both: String = ["specular_reflectance", "alpha"].map(|name| bitmap(name, "")).concat();
    let out = scene(&shape(&format!("<bsdf type=\"roughconductor\">{both}</bsdf>")));
    assert_eq!(detail(&out.materials[0]).textured, [textured(Slot::Specular, 0), textured(Slot::Alpha, 0)]);
    assert_eq!(out.textures.len(), 1);
    let named = format!(
        "{}<bsdf type=\"diffuse\" id=\"m\"><ref name=\"reflectance\" id=\"t\"/></bsdf>{}",
        bitmap("", "").replace("<texture", "<texture id=\"t\""),
        shape("<ref id=\"m\"/>")
    );
    assert_eq!(detail(&scene(&named).materials[0]).textured, [textured(Slot::Diffuse, 0)]);
    let squares = "<bsdf type=\"diffuse\"><texture type=\"checkerboard\" name=\"reflectance\">\
        <rgb name=\"color0\" value=\"1, 0, 0\"/><transform name=\"to_uv\"><scale x=\"4\" y=\"2\"/></transform></texture></bsdf>";
    let out = scene(&shape(squares));
    let TextureKind::Checkerboard(c) = &out.textures[0].kind else { panic!("{:?}", out.textures) };
    assert_eq!((c.colors, c.to_uv.0[0]), ([[1.0, 0.0, 0.0], [0.2; 3]], [4.0, 0.0, 0.0]));
}

#[test]
fn masks_reliefs_and_two_sides() {
    let grey = "<bsdf type=\"diffuse\"/>";
    let mask = |inside: &str| scene(&shape(&format!("<bsdf type=\"mask\">{inside}</bsdf>")));
    assert_eq!(detail(&mask(grey).materials[0]).opacity, Amount::Constant(0.5));
    let quarter = format!("<float name=\"opacity\" value=\"0.25\"/>{grey}");
    assert_eq!(detail(&mask(&quarter).materials[0]).opacity, Amount::Constant(0.25));
    // opaque: nothing to look up
    assert!(mask(&format!("<float name=\"opacity\" value=\"1\"/>{grey}")).materials[0].detail.is_none());
    let leaf = mask(&format!(
        "{}<bsdf type=\"twosided\"><bsdf type=\"diffuse\">{}</bsdf></bsdf>",
        bitmap("opacity", ""),
        bitmap("reflectance", "")
    ));
    assert!(leaf.materials[0].two_sided);
    assert_eq!(detail(&leaf.materials[0]).opacity, Amount::Texture(0));
    assert_eq!(detail(&leaf.materials[0]).textured, [textured(Slot::Diffuse, 0)]);

    let bump = |inside: &str| {
        format!("<bsdf type=\"bumpmap\">{}<float name=\"scale\" value=\"2\"/>{inside}</bsdf>", bitmap("map", ""))
    };
    let two = |inside: &str| format!("<bsdf type=\"twosided\">{inside}</bsdf>");
    let relief = |mirrored| Some(Relief { kind: ReliefKind::Bump(2.0), texture: 0, mirrored, shadowed: true });
    assert_eq!(detail(&scene(&shape(&bump(&two(grey)))).materials[0]).relief, relief(false));
    assert_eq!(detail(&scene(&shape(&two(&bump(grey)))).materials[0]).relief, relief(true));
    let normals = format!(
        "<bsdf type=\"normalmap\">{}{grey}</bsdf>",
        bitmap("normalmap", "<boolean name=\"raw\" value=\"true\"/>")
    );
    assert_eq!(detail(&scene(&shape(&normals)).materials[0]).relief.unwrap().kind, ReliefKind::Normals);

    // both sides get the relief around them
    let plastic = format!("<bsdf type=\"plastic\">{}</bsdf>", bitmap("diffuse_reflectance", ""));
    let out = scene(&shape(&bump(&two(&format!("{grey}{plastic}")))));
    let front = out.materials.iter().find(|m| m.detail.as_ref().is_some_and(|d| d.back.is_some())).unwrap();
    let back = &out.materials[detail(front).back.unwrap() as usize];
    assert!(matches!(back.bsdf, Bsdf::Plastic { .. }) && back.two_sided && front.two_sided);
    assert_eq!((detail(front).relief, detail(back).relief), (relief(false), relief(false)));
}

#[test]
fn what_is_missing_or_wrong_is_listed() {
    let file = |name: &str| {
        format!(
            "<bsdf type=\"diffuse\"><texture type=\"bitmap\" name=\"reflectance\">\n<string name=\"filename\" value=\"{name}\"/></texture></bsdf>"
        )
    };
    let text = format!("{}\n{}\n{}", shape(&file("gone.png")), shape(&file("b.png")), shape(&file("lost.jpg")));
    let Err(ImportError::Unsupported(list)) = scene_with(&text, false) else { panic!("no list") };
    let got: Vec<(u32, &str)> = list.iter().map(|(p, what)| (p.line, what.as_str())).collect();
    assert_eq!(got.len(), 3, "{got:?}");
    assert!(got[0].0 == 3 && got[0].1.contains("\"gone.png\" (there is no such file)"), "{got:?}");
    assert!(got[1].0 == 5 && got[1].1.contains("\"b.png\" (it is no PNG"), "{got:?}");
    assert!(got[2].0 == 7 && got[2].1.contains("lost.jpg"), "{got:?}");
    // with a stand-in: grey
    let out = scene_with(&text, true).unwrap();
    assert_eq!(out.materials[0].bsdf, Bsdf::Diffuse { reflectance: [0.5; 3] });
    assert!(out.materials[0].detail.is_none() && out.textures.is_empty() && out.substitutions.len() == 3);

    let message = |bsdf: &str| scene_with(&shape(bsdf), false).unwrap_err().to_string();
    let grey = "<bsdf type=\"diffuse\"/>";
    for (bsdf, what) in [
        (format!("<bsdf type=\"diffuse\">{}</bsdf>", bitmap("reflectance", "<string name=\"wrap_mode\" value=\"zero\"/>")), "wrap_mode \"zero\""),
        (format!("<bsdf type=\"diffuse\">{}</bsdf>", bitmap("reflectance", "<string name=\"filter_type\" value=\"cubic\"/>")), "filter_type \"cubic\""),
        (format!("<bsdf type=\"diffuse\">{}</bsdf>", bitmap("reflectance", "<float name=\"gamma\" value=\"2\"/>")), "gamma 2"),
        ("<bsdf type=\"diffuse\"><texture type=\"bitmap\" name=\"reflectance\"/></bsdf>".into(), "lacks its filename"),
        ("<bsdf type=\"diffuse\"><texture type=\"bitmap\" name=\"reflectance\"><string name=\"filename\" value=\"../../etc/passwd\"/></texture></bsdf>".into(), "etc/passwd"),
        (format!("<bsdf type=\"roughplastic\">{}</bsdf>", bitmap("alpha", "")), "alpha of a roughplastic"),
        (format!("<bsdf type=\"diffuse\"><texture type=\"checkerboard\" name=\"reflectance\">{}</texture></bsdf>", bitmap("color0", "")), "texture \"bitmap\" for \"color0\""),
        (format!("<bsdf type=\"mask\"><float name=\"opacity\" value=\"1.5\"/>{grey}</bsdf>"), "[0, 1]"),
        ("<bsdf type=\"mask\"/>".into(), "one material inside"),
        (format!("<bsdf type=\"bumpmap\">{grey}</bsdf>"), "needs a texture"),
        (format!("<bsdf type=\"bumpmap\">{}{}{grey}</bsdf>", bitmap("a", ""), bitmap("b", "")), "second texture"),
        (format!("<bsdf type=\"bumpmap\">{}<bsdf type=\"bumpmap\">{}{grey}</bsdf></bsdf>", bitmap("a", ""), bitmap("b", "")), "around another relief"),
        (format!("<bsdf type=\"mask\"><bsdf type=\"mask\">{grey}</bsdf></bsdf>"), "around another mask"),
        (format!("<bsdf type=\"twosided\"><bsdf type=\"mask\">{grey}</bsdf>{grey}</bsdf>"), "takes no mask"),
    ] {
        let error = message(&bsdf);
        assert!(error.contains(what) && error.contains("s.xml:2"), "{bsdf}: {error}");
    }
    assert!(!Path::new("a.hdr").exists());
}

/// A triangle whose vertices have red, and its face a heat.
const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float r\n\
                   property float g\nproperty float b\nelement face 1\nproperty list uchar int vertex_indices\nproperty float heat_x\n\
                   end_header\n0 0 0 1 0 0\n1 0 0 1 0 0\n0 1 0 1 0 0\n3 0 1 2 7\n";

fn with_mesh(inside: &str, substitute: bool) -> Result<Description, ImportError> {
    let folder = folder();
    std::fs::write(folder.path().join("m.ply"), PLY).unwrap();
    std::fs::write(folder.path().join("m.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    let text = format!("<scene version=\"3.0.0\">\n{inside}\n</scene>");
    let path = folder.path().join("s.xml");
    std::fs::write(&path, text).unwrap();
    import(&path, &ImportOptions { sky: Some([1.0; 3]), substitute, ..ImportOptions::default() })
}

fn attribute(parameter: &str, name: &str) -> String {
    format!(
        "<texture type=\"mesh_attribute\" name=\"{parameter}\"><string name=\"name\" value=\"{name}\"/>\
         <float name=\"scale\" value=\"0.5\"/></texture>"
    )
}

fn mesh(file: &str, inside: &str) -> String {
    let plugin = &file[file.len() - 3..];
    format!("<shape type=\"{plugin}\"><string name=\"filename\" value=\"{file}\"/>\n{inside}</shape>")
}

#[test]
fn attributes_are_what_the_mesh_is_read_for() {
    let diffuse = |name| format!("<bsdf type=\"diffuse\">{}</bsdf>", attribute("reflectance", name));
    let out = with_mesh(&mesh("m.ply", &diffuse("vertex_color")), false).unwrap();
    assert_eq!(out.textures[0].kind, TextureKind::Attribute { name: "vertex_color".into(), scale: 0.5 });
    assert_eq!(detail(&out.materials[0]).textured, [textured(Slot::Diffuse, 0)]);
    let wanted = |out: &Description| {
        let Geometry::MeshFile { attribute, .. } = &out.shapes[0].geometry else { panic!() };
        attribute.clone().unwrap()
    };
    assert_eq!(wanted(&out), MeshAttribute { of_faces: false, name: "color".into(), srgb: false });
    // inside of others, and as light
    let inside = format!(
        "<bsdf type=\"twosided\"><bsdf type=\"mask\"><float name=\"opacity\" value=\"0.5\"/>{}</bsdf></bsdf>",
        diffuse("face_heat")
    );
    assert_eq!(wanted(&with_mesh(&mesh("m.ply", &inside), false).unwrap()).name, "heat");
    let light = format!("<emitter type=\"area\">{}</emitter>", attribute("radiance", "face_heat"));
    let out = with_mesh(&mesh("m.ply", &light), false).unwrap();
    assert!(
        wanted(&out).of_faces && out.shapes[0].emission == Some([1.0; 3]) && out.shapes[0].emission_texture == Some(0)
    );

    let two = format!("{}{light}", diffuse("vertex_color"));
    let bump = format!("<bsdf type=\"bumpmap\"><bsdf type=\"diffuse\"/>{}</bsdf>", attribute("", "vertex_color"));
    for (scene, what) in [
        (
            mesh("m.obj", &diffuse("vertex_color")),
            "s.xml:2:1: mesh attribute \"vertex_color\" of shape \"obj\", which has none",
        ),
        (mesh("m.ply", &two), "mesh attribute \"face_heat\" beside \"vertex_color\" on one shape"),
        (mesh("m.ply", &bump), "mesh_attribute as a bumpmap"),
        (
            format!("{}<emitter type=\"spot\">\n{}</emitter>", mesh("m.ply", ""), attribute("texture", "vertex_color")),
            "s.xml:4:1: mesh_attribute as the texture of a spot",
        ),
    ] {
        let error = with_mesh(&scene, false).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
        assert_eq!(with_mesh(&scene, true).unwrap().substitutions.len(), 1);
    }
    for (name, what) in [("color", "should begin with vertex_ or face_"), ("vertex_", "should begin with")] {
        let error = with_mesh(&mesh("m.ply", &diffuse(name)), false).unwrap_err().to_string();
        assert!(error.contains("s.xml:3") && error.contains(what), "{error}");
    }
    let unnamed = diffuse("vertex_color").replace("<string name=\"name\" value=\"vertex_color\"/>", "");
    assert!(with_mesh(&mesh("m.ply", &unnamed), false).unwrap_err().to_string().contains("lacks its name"));
    // what the file lacks is found when it is read
    let out = with_mesh(&mesh("m.ply", &diffuse("vertex_tone")), false);
    assert!(out.unwrap_err().to_string().contains("no properties tone_x tone_y tone_z"));
}

#[test]
fn light_may_be_textured() {
    let area = format!("<emitter type=\"area\">{}</emitter>", bitmap("radiance", ""));
    let out = scene(&shape(&area));
    assert_eq!((out.shapes[0].emission, out.shapes[0].emission_texture), (Some([1.0; 3]), Some(0)));
    assert!(matches!(&out.textures[0].kind, TextureKind::Image { raw: false, .. }));
    let squares = "<emitter type=\"area\"><texture type=\"checkerboard\" name=\"radiance\"><rgb name=\"color0\" value=\"5, 6, 7\"/></texture></emitter>";
    let out = scene(&shape(squares));
    let TextureKind::Checkerboard(c) = &out.textures[0].kind else { panic!() };
    assert_eq!(c.colors, [[5.0, 6.0, 7.0], [0.2; 3]]);
    let missing = area.replace("a.hdr", "none.hdr");
    let error = scene_with(&shape(&missing), false).unwrap_err().to_string();
    assert!(error.contains("s.xml:2:80: texture file \"none.hdr\" (there is no such file)"), "{error}");
    let out = scene_with(&shape(&missing), true).unwrap();
    assert_eq!((out.shapes[0].emission, out.shapes[0].emission_texture), (Some([1.0; 3]), None));
    let negative = squares.replace("5, 6", "5, -6");
    assert!(scene_with(&shape(&negative), false).unwrap_err().to_string().contains("should be at least 0"));

    let spot = |more: &str| {
        let map = "<transform name=\"to_world\"><scale value=\"2\"/><lookat origin=\"0,0,0\" target=\"0,0,-1\" up=\"0,1,0\"/></transform>";
        let picture = bitmap("texture", "");
        scene_with(&format!("{}<emitter type=\"spot\">{map}{picture}{more}</emitter>", shape("")), false)
    };
    let out = spot("").unwrap();
    let Beam::Spot { slide: Some(slide), .. } = &out.beams[0] else { panic!("{:?}", out.beams) };
    // looks along -z: half of each direction, as it is twice as large
    let expected = [[-0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, -0.5]];
    let off = slide.to_local.iter().flatten().zip(expected.iter().flatten()).map(|(a, b): (&f64, &f64)| (a - b).abs());
    assert!(slide.texture == 0 && off.fold(0.0, f64::max) < 1e-12, "{slide:?}");
    let error = spot("<float name=\"cutoff_angle\" value=\"90\"/>").unwrap_err().to_string();
    assert!(error.contains("below 90 degrees with a texture"), "{error}");
}

/// Coordinates of a sphere are those of one that is not turned: where that shows it is said.
#[test]
fn turned_spheres_with_textures_are_unsupported() {
    let paint = format!("<bsdf type=\"diffuse\">{}</bsdf>", bitmap("reflectance", ""));
    let lamp = format!("<emitter type=\"area\">{}</emitter>", bitmap("radiance", ""));
    let plain = "<bsdf type=\"diffuse\"/>";
    let sphere = |map: &str, inside: &str| {
        let text = format!("<shape type=\"sphere\"><transform name=\"to_world\">{map}</transform>{inside}</shape>");
        scene_with(&text, false).map(|_| ()).map_err(|e| e.to_string())
    };
    let turn = "<rotate z=\"1\" angle=\"30\"/>";
    let moved = "<scale value=\"2\"/><translate x=\"1\" y=\"2\"/>";
    for inside in [&paint[..], &lamp[..], plain] {
        assert_eq!(sphere(moved, inside), Ok(()));
    }
    assert_eq!(sphere(turn, plain), Ok(()));
    for map in [turn, "<rotate y=\"1\" angle=\"180\"/>"] {
        for inside in [&paint, &lamp] {
            assert!(sphere(map, inside).unwrap_err().contains("a turned sphere with a texture"), "{map} {inside}");
        }
    }
}
