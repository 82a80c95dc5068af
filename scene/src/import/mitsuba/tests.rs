//! Scenes in small: dialects, conventions, what is unsupported, what is wrong.

use std::path::Path;

use crate::ImportError;
use crate::description::{Affine, Bsdf, Description, Distribution, Environment, Filter, Geometry, Projection};
use crate::import::tests::{folder, records, write};
use crate::import::{ImportOptions, import};
use crate::record::Record;

/// Imports the inside of a `<scene>`, with a sky.
pub(super) fn scene(inside: &str) -> Result<Description, ImportError> {
    scene_with(inside, &ImportOptions { sky: Some([1.0; 3]), ..ImportOptions::default() })
}

pub(super) fn scene_with(inside: &str, options: &ImportOptions) -> Result<Description, ImportError> {
    let dir = folder();
    import(&write(&dir, "s.xml", format!("<scene version=\"3.0.0\">\n{inside}\n</scene>")), options)
}

pub(super) fn message(inside: &str) -> String {
    scene(inside).unwrap_err().to_string()
}

/// The same with a whole line for each place of the scene.
pub(super) fn columnless(text: &str) -> String {
    let mut parts = text.split(".xml:");
    let mut out = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (line, rest) = part.split_once(':').unwrap_or((part, ""));
        let rest = rest.trim_start_matches(|c: char| c.is_ascii_digit());
        out += &format!(".xml:{line}{rest}");
    }
    out
}

pub(super) const CUBE: &str = "<shape type=\"cube\"/>";

/// Field of view of a pinhole.
fn fov_x(description: &Description) -> f64 {
    match description.camera.as_ref().unwrap().projection {
        Projection::Perspective { fov_x } => fov_x,
        other => panic!("{other:?}"),
    }
}

/// The example of this name, and its path.
fn example(name: &str) -> Description {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples").join(name);
    import(&path, &ImportOptions::default()).unwrap()
}

#[test]
fn cornell_box_example() {
    let description = example("cornell-box.xml");
    assert_eq!(description.size, Some([512, 512]));
    assert_eq!(description.spp, Some(64));
    assert_eq!(description.max_depth, Some(8));
    assert_eq!(description.filter, Some(Filter::Box));
    assert_eq!(description.shapes.len(), 8);
    let records = records(&description).unwrap();
    assert_eq!(records.len(), 6 * 2 + 2 * 12);
    // every wall's front looks into the box, every face of the boxes out of them
    for record in &records {
        let Record::Triangle(t) = record else { panic!("a sphere") };
        let shape = &description.shapes[t.shape as usize];
        let center = if shape.name.ends_with("-box") { shape.to_world.point([0.0; 3]) } else { [0.0; 3] };
        let inside = super::super::vector::dot(front(t.p), super::super::vector::sub(center, t.p[0])) > 0.0;
        assert_eq!(inside, !shape.name.ends_with("-box"), "{}", shape.name);
    }
}

#[test]
fn veach_mis_example() {
    let description = example("veach-mis.xml");
    let records = records(&description).unwrap();
    let spheres = records.iter().filter(|r| matches!(r, Record::Sphere(_))).count();
    assert_eq!((spheres, records.len() - spheres), (5, 2 * 2 + 4 * 12));
    let rough = |m: &&crate::description::Material| matches!(m.bsdf, Bsdf::RoughConductor { .. });
    assert_eq!(description.materials.iter().filter(rough).count(), 4);
}

fn front(p: [[f64; 3]; 3]) -> [f64; 3] {
    super::super::vector::cross(super::super::vector::sub(p[1], p[0]), super::super::vector::sub(p[2], p[0]))
}

#[test]
fn old_and_new_names_are_the_same_scene() {
    let dir = folder();
    let new = "<integrator type=\"path\"><integer name=\"max_depth\" value=\"5\"/><integer name=\"rr_depth\" value=\"3\"/></integrator>\
         <sensor type=\"perspective\"><float name=\"fov\" value=\"30\"/><string name=\"fov_axis\" value=\"y\"/>\
         <transform name=\"to_world\"><lookat origin=\"0,0,5\" target=\"0 0 0\" up=\"0, 1, 0\"/></transform>\
         <film type=\"hdrfilm\"><integer name=\"width\" value=\"20\"/><integer name=\"height\" value=\"10\"/>\
         <rfilter type=\"tent\"/></film></sensor>\
         <bsdf type=\"twosided\" id=\"m\"><bsdf type=\"roughconductor\"><float name=\"alpha_u\" value=\"0.1\"/>\
         <float name=\"alpha_v\" value=\"0.2\"/><string name=\"material\" value=\"Au\"/>\
         <spectrum name=\"specular_reflectance\" value=\"0.5\"/></bsdf></bsdf>\
         <shape type=\"rectangle\"><transform name=\"to_world\"><rotate x=\"1\" angle=\"90\"/></transform><ref id=\"m\"/>\
         <boolean name=\"flip_normals\" value=\"true\"/></shape>";
    let old = new
        .replace("max_depth", "maxDepth")
        .replace("rr_depth", "rrDepth")
        .replace("fov_axis", "fovAxis")
        .replace("to_world", "toWorld")
        .replace("lookat", "lookAt")
        .replace("alpha_u", "alphaU")
        .replace("alpha_v", "alphaV")
        .replace("specular_reflectance", "specularReflectance")
        .replace("flip_normals", "flipNormals");
    let read = |inside: &str, version: &str| {
        let options = ImportOptions { sky: Some([1.0; 3]), ..ImportOptions::default() };
        let path = write(&dir, "s.xml", format!("<scene version=\"{version}\">\n{inside}\n</scene>"));
        let mut out = import(&path, &options).unwrap();
        out.shapes.iter_mut().for_each(|shape| shape.place = Default::default());
        out.bytes_read = 0;
        out
    };
    let text = new;
    let new = read(text, "3.0.0");
    for (text, version) in [(text, "2.0.0"), (&old, "2.0.0"), (&old, "0.6.0"), (&old, "0.5.0"), (&old, "3.0.0")] {
        assert_eq!(new, read(text, version), "{version}");
    }
    assert_eq!((new.max_depth, new.rr_depth, new.size), (Some(5), Some(3), Some([20, 10])));
    assert!(new.materials[0].two_sided);
    let Bsdf::RoughConductor { distribution, alpha, eta, specular, .. } = new.materials[0].bsdf else { panic!() };
    assert_eq!((distribution, alpha, specular), (Distribution::Beckmann, [0.1, 0.2], [0.5; 3]));
    assert_eq!(eta, [0.14303598, 0.37530708, 1.4420453]);
    // a field of view along y, at twice the width
    let tan = libm::tan(fov_x(&new).to_radians() / 2.0);
    assert!((tan - 2.0 * libm::tan(15f64.to_radians())).abs() < 1e-12);
}

#[test]
fn fields_of_view() {
    let fov = |inside: &str, size: [u32; 2]| {
        let text = format!(
            "{CUBE}<sensor type=\"perspective\">{inside}<film type=\"hdrfilm\"><integer name=\"width\" value=\"{}\"/>\
             <integer name=\"height\" value=\"{}\"/></film></sensor>",
            size[0], size[1]
        );
        fov_x(&scene(&text).unwrap())
    };
    let axis = |axis: &str| format!("<float name=\"fov\" value=\"50\"/><string name=\"fov_axis\" value=\"{axis}\"/>");
    // values by mitsuba 3.9.1 (x_fov)
    for (inside, size, expected) in [
        (axis("x"), [300, 200], 50.0),
        (axis("y"), [300, 200], 69.942611),
        (axis("smaller"), [300, 200], 69.942611),
        (axis("smaller"), [200, 300], 50.0),
        (axis("larger"), [300, 200], 50.0),
        (axis("larger"), [200, 300], 34.537991),
        (axis("diagonal"), [300, 200], 42.411652),
        (String::new(), [300, 200], 39.597752),
        ("<string name=\"focal_length\" value=\"35mm\"/>".into(), [300, 200], 54.432223),
    ] {
        let got = fov(&inside, size);
        assert!((got - expected).abs() < 1e-4, "{inside}: {got}, not {expected}");
    }
    for (inside, what) in [
        (axis("up"), "fov_axis \"up\" should be"),
        ("<float name=\"fov\" value=\"180\"/>".into(), "between 0 and 180"),
        ("<float name=\"fov\" value=\"20\"/><string name=\"focal_length\" value=\"35mm\"/>".into(), "both fov"),
        ("<string name=\"focal_length\" value=\"-35mm\"/>".into(), "above 0"),
        (
            "<transform name=\"to_world\"><scale x=\"0\"/></transform>".into(),
            "singular, so that it looks nowhere: leave out the scale",
        ),
    ] {
        let error = message(&format!("{CUBE}<sensor type=\"perspective\">{inside}</sensor>"));
        assert!(error.contains(what), "{inside}: {error}");
    }
}

#[test]
fn parameters() {
    let text = "<default name=\"r\" value=\"2\"/><default name=\"ra\" value=\"3\"/><shape type=\"sphere\" id=\"\\$r\">\
                <float name=\"radius\" value=\"$ra\"/><point name=\"center\" value=\"$r $r 1\"/></shape>";
    let sphere = |defines: &[(&str, &str)]| {
        let defines = defines.iter().map(|(n, v)| (n.to_string(), v.to_string())).collect();
        scene_with(text, &ImportOptions { sky: Some([1.0; 3]), defines, ..ImportOptions::default() })
    };
    let out = sphere(&[]).unwrap();
    assert_eq!(out.shapes[0].name, "$r");
    assert_eq!(out.shapes[0].geometry, Geometry::Sphere { center: [2.0, 2.0, 1.0], radius: 3.0 });
    let out = sphere(&[("r", "5")]).unwrap();
    assert_eq!(out.shapes[0].geometry, Geometry::Sphere { center: [5.0, 5.0, 1.0], radius: 3.0 });
    let error = sphere(&[("spp", "5")]).unwrap_err().to_string();
    assert!(error.contains("-D spp") && error.contains("r, ra"), "{error}");
    let error = message("<shape type=\"$kind\"/>");
    assert!(error.contains("s.xml:2") && error.contains("-D kind="), "{error}");
}

#[test]
fn includes() {
    let dir = folder();
    let options = ImportOptions { sky: Some([1.0; 3]), ..ImportOptions::default() };
    std::fs::create_dir(dir.path().join("parts")).unwrap();
    write(&dir, "parts/box.xml", "<scene version=\"3.0.0\"><shape type=\"cube\"><ref id=\"m\"/></shape></scene>");
    write(&dir, "parts/m.xml", "<bsdf version=\"3.0.0\" type=\"diffuse\" id=\"m\"/>");
    let top =
        "<scene version=\"3.0.0\"><include filename=\"parts/m.xml\"/><include filename=\"parts/box.xml\"/></scene>";
    let out = import(&write(&dir, "s.xml", top), &options).unwrap();
    assert_eq!((out.shapes.len(), out.materials[0].name.as_str()), (1, "m"));
    assert!(out.bytes_read > top.len() as u64);

    write(&dir, "a.xml", "<scene><include filename=\"b.xml\"/></scene>");
    write(&dir, "b.xml", "<scene>\n<include filename=\"a.xml\"/></scene>");
    let error = import(&dir.path().join("a.xml"), &options).unwrap_err().to_string();
    let cycle = "b.xml:2:1: includes form a cycle: a.xml -> b.xml -> a.xml; take one of these <include>s out";
    assert!(error.contains(cycle), "{error}");
    let own = write(&dir, "own.xml", "<scene><include filename=\"own.xml\"/></scene>");
    assert!(import(&own, &options).unwrap_err().to_string().contains("cycle: own.xml -> own.xml"));

    // each of 12 files includes the next twice: without a bound that is 4096 files, with 40 it never ends
    for i in 0..12 {
        let next = format!("<include filename=\"d{}.xml\"/>", i + 1);
        write(&dir, &format!("d{i}.xml"), format!("<scene>{next}{next}</scene>"));
    }
    write(&dir, "d12.xml", "<scene/>");
    let error = import(&dir.path().join("d0.xml"), &options).unwrap_err().to_string();
    assert!(error.contains("includes"), "{error}");

    let outside = write(&dir, "outside.ply", "ply");
    std::fs::create_dir(dir.path().join("inner")).unwrap();
    for name in ["../outside.ply", outside.to_str().unwrap()] {
        let text = format!("<scene>\n<shape type=\"ply\"><string name=\"filename\" value=\"{name}\"/></shape></scene>");
        let error = import(&write(&dir, "inner/s.xml", text), &options).unwrap_err().to_string();
        assert!(error.contains("s.xml:2") && error.contains("outside the scene's folder"), "{error}");
    }
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&outside, dir.path().join("inner/link.ply")).unwrap();
        let text = "<scene><shape type=\"ply\"><string name=\"filename\" value=\"link.ply\"/></shape></scene>";
        let error = import(&write(&dir, "inner/s.xml", text), &options).unwrap_err().to_string();
        assert!(error.contains("outside the scene's folder"), "{error}");
    }
}

#[test]
fn transforms_apply_in_order() {
    let point = |steps: &str| {
        let text = format!("<shape type=\"cube\"><transform name=\"to_world\">{steps}</transform></shape>");
        scene(&text).unwrap().shapes[0].to_world.point([1.0, 2.0, 3.0])
    };
    let close = |a: [f64; 3], b: [f64; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-12);
    assert_eq!(point("<translate x=\"1\"/><scale value=\"2\"/>"), [4.0, 4.0, 6.0]);
    assert_eq!(point("<scale x=\"2\" z=\"-1\"/><translate value=\"1, 0 0\"/>"), [3.0, 2.0, -3.0]);
    assert!(close(point("<rotate z=\"3\" angle=\"90\"/>"), [-2.0, 1.0, 3.0]));
    assert_eq!(point("<matrix value=\"0 1 0 5 1 0 0 6 0 0 1 7 0 0 0 1\"/>"), [7.0, 7.0, 10.0]);
    assert_eq!(point("<matrix value=\"0,1,0, 1,0,0, 0,0,1\"/>"), [2.0, 1.0, 3.0]);
    // looking along -z with y up: the camera's x is to the left, the world's -x
    assert!(close(point("<lookat origin=\"0,0,4\" target=\"0,0,0\" up=\"0,1,0\"/>"), [-1.0, 2.0, 1.0]));
    for (steps, what) in [
        ("<rotate angle=\"4\"/>", "axis of a rotation is zero"),
        ("<rotate x=\"1\"/>", "lacks its attribute \"angle\""),
        ("<scale value=\"1 2\"/>", "neither one number nor three"),
        ("<scale value=\"1\" x=\"2\"/>", "write one of them"),
        ("<matrix value=\"1 2 3\"/>", "9 or 16 numbers, not 3"),
        ("<matrix value=\"1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1\"/>", "last row"),
        ("<lookat origin=\"0,0,0\" target=\"0,0,0\" up=\"0,1,0\"/>", "one point"),
        ("<lookat origin=\"0,0\" target=\"0,0,1\"/>", "needs three numbers"),
        ("<scale x=\"nan\"/>", "not finite"),
        ("<scale x=\"1e308\"/><scale x=\"1e308\"/>", "not finite"),
        ("<float name=\"x\" value=\"1\"/>", "<float> inside <transform>"),
    ] {
        let error = message(&format!("<shape type=\"cube\"><transform name=\"to_world\">{steps}</transform></shape>"));
        assert!(error.contains(what) && error.contains("s.xml:2"), "{steps}: {error}");
    }
}

/// Front directions of a rectangle under transforms, by src/shapes/rectangle.cpp and mesh.cpp.
#[test]
fn mirrored_and_flipped_shapes() {
    let z = |inside: &str| {
        let all = records(&scene(&format!("<shape type=\"rectangle\">{inside}</shape>")).unwrap()).unwrap();
        let z: Vec<f64> = all.iter().map(|r| if let Record::Triangle(t) = r { front(t.p)[2] } else { 0.0 }).collect();
        assert_eq!(z[0], z[1]);
        z[0].signum()
    };
    let flip = "<boolean name=\"flip_normals\" value=\"true\"/>";
    let mirror_x = "<transform name=\"to_world\"><scale x=\"-1\"/></transform>";
    let mirror_z = "<transform name=\"to_world\"><scale z=\"-1\"/></transform>";
    assert_eq!(z(""), 1.0);
    assert_eq!(z(flip), -1.0);
    assert_eq!(z(mirror_x), 1.0);
    assert_eq!(z(mirror_z), -1.0);
    assert_eq!(z(&format!("{flip}{mirror_z}")), 1.0);
    let flipped = |inside: &str| match records(&scene(&format!("<shape type=\"sphere\">{inside}</shape>")).unwrap())
        .unwrap()[0]
    {
        Record::Sphere(s) => s.flipped,
        Record::Triangle(_) => panic!(),
    };
    assert!(!flipped("") && flipped(flip) && flipped(mirror_x) && !flipped(&format!("{flip}{mirror_x}")));
    assert!(flipped("<float name=\"radius\" value=\"-1\"/>"));
}

#[test]
fn a_sphere_is_placed_by_its_transform() {
    let text = "<shape type=\"sphere\"><float name=\"radius\" value=\"0.5\"/><point name=\"center\" x=\"1\" y=\"2\" z=\"3\"/>\
                <transform name=\"to_world\"><scale value=\"2\"/><translate x=\"1\"/></transform></shape>";
    let out = scene(text).unwrap();
    assert_eq!(out.shapes[0].geometry, Geometry::Sphere { center: [3.0, 4.0, 6.0], radius: 1.0 });
    assert_eq!(out.shapes[0].to_world, Affine::IDENTITY);
    assert!(message("<shape type=\"sphere\"><float name=\"radius\" value=\"0\"/></shape>").contains("radius 0"));
    let squeezed = "<shape type=\"sphere\"><transform name=\"to_world\"><scale x=\"2\"/></transform></shape>";
    assert!(message(squeezed).contains("ellipsoid"));
}

#[test]
fn colours() {
    let reflectance = |value: &str| {
        let text = format!("<shape type=\"cube\"><bsdf type=\"diffuse\">{value}</bsdf></shape>");
        scene(&text).map(|s| match s.materials[0].bsdf {
            Bsdf::Diffuse { reflectance } => reflectance,
            _ => panic!(),
        })
    };
    let get = |tag: &str, value: &str| reflectance(&format!("<{tag} name=\"reflectance\" value=\"{value}\"/>"));
    assert_eq!(get("rgb", "0.1, 0.2, 0.3").unwrap(), [0.1, 0.2, 0.3]);
    assert_eq!(get("rgb", "0.1 0.2,0.3").unwrap(), [0.1, 0.2, 0.3]);
    assert_eq!(get("rgb", "0.4").unwrap(), [0.4; 3]);
    assert_eq!(get("spectrum", "0.4").unwrap(), [0.4; 3]);
    assert_eq!(get("float", "0.4").unwrap(), [0.4; 3]);
    let hex = get("rgb", "#ff8000").unwrap();
    assert!(hex[0] == 1.0 && (hex[1] - 0.2158605).abs() < 1e-6 && hex[2] == 0.0, "{hex:?}");
    assert_eq!(get("srgb", "1, 1, 0").unwrap(), [1.0, 1.0, 0.0]);
    assert_eq!(reflectance("").unwrap(), [0.5; 3]);
    for (tag, value, what) in [
        ("rgb", "0.1, 0.2", "one number or three, not 2"),
        ("rgb", "1.5", "in [0, 1]"),
        ("rgb", "-0.5", "in [0, 1]"),
        ("rgb", "#ff80", "#rrggbb"),
        ("rgb", "red", "is no number"),
        ("rgb", "inf", "not finite"),
        ("string", "x", "should be a colour"),
        ("spectrum", "400:0.1, 700:0.5", "spectrum \"400:0.1, 700:0.5\""),
    ] {
        let error = get(tag, value).unwrap_err().to_string();
        assert!(error.contains(what), "{value}: {error}");
    }
}

#[test]
fn all_that_is_unsupported_is_listed() {
    let text = "<integrator type=\"path\"><boolean name=\"hide_emitters\" value=\"true\"/></integrator>\n\
         <sensor type=\"fisheye\"/>\n\
         <bsdf type=\"ward\" id=\"p\"/>\n\
         <bsdf type=\"diffuse\" id=\"d\"><texture name=\"reflectance\" type=\"marble\"/></bsdf>\n\
         <shape type=\"hair\"/>\n\
         <shape type=\"cube\"><ref id=\"p\"/><medium name=\"interior\" type=\"homogeneous\"/></shape>\n\
         <shape type=\"cube\"><ref id=\"d\"/>\n<float name=\"wobble\" value=\"1\"/></shape>\n\
         <emitter type=\"envmap\"><string name=\"filename\" value=\"none.hdr\"/></emitter>\n\
         <emitter type=\"projector\"/>\n\
         <wurst/>";
    let Err(ImportError::Unsupported(list)) = scene(text) else { panic!("no list") };
    let got: Vec<(u32, &str)> = list.iter().map(|(p, what)| (p.line, what.as_str())).collect();
    assert_eq!(
        got,
        [
            (3, "sensor \"fisheye\""),
            (4, "bsdf \"ward\""),
            (5, "texture \"marble\" for \"reflectance\""),
            (6, "shape \"hair\""),
            (7, "medium \"homogeneous\" in shape \"cube\""),
            (9, "property \"wobble\" of shape \"cube\""),
            (10, "envmap file \"none.hdr\" (there is no such file)"),
            (11, "emitter \"projector\""),
            (12, "element <wurst>"),
        ]
    );
    let shown = ImportError::Unsupported(list).to_string();
    assert!(shown.starts_with("9 unsupported") && shown.contains("s.xml:9:1: property \"wobble\""), "{shown}");

    let options = ImportOptions { substitute: true, ..ImportOptions::default() };
    let out = scene_with(text, &options).unwrap();
    assert_eq!(out.substitutions.len(), 9);
    assert_eq!(out.environment, Some(Environment::Constant([1.0; 3])), "the sky that stands in");
    assert_eq!(out.shapes.len(), 2);
    assert!(out.substitutions.iter().all(|s| s.place.line > 0 && !s.stand_in.is_empty()));
}

#[test]
fn integrators() {
    let depth = |plugin: &str| {
        let text = format!(
            "{CUBE}<integrator type=\"{plugin}\"><integer name=\"max_depth\" value=\"7\"/><float name=\"other\" value=\"1\"/></integrator>"
        );
        scene(&text).map(|s| s.max_depth).map_err(|e| e.to_string())
    };
    assert_eq!(depth("path_guiding_integrator"), Ok(Some(7)));
    assert_eq!(depth("bdpt"), Ok(Some(7)));
    assert!(depth("path").unwrap_err().contains("property \"other\""));
    assert!(depth("ao").unwrap_err().contains("integrator \"ao\""));
    let unbounded = "<integrator type=\"path\"><integer name=\"max_depth\" value=\"-1\"/></integrator>";
    let out = scene(&format!("{CUBE}{unbounded}")).unwrap();
    assert_eq!(out.max_depth, None);
    assert!(out.notes.iter().any(|n| n.text.contains("unbounded") && n.text.contains("65")), "{:?}", out.notes);
    assert_eq!(scene(&format!("{CUBE}<integrator type=\"direct\"/>")).unwrap().max_depth, Some(2));
}

#[test]
fn a_scene_without_a_sensor_is_framed() {
    let out = scene(CUBE).unwrap();
    assert_eq!(out.bounds, Some([[-1.0; 3], [1.0; 3]]));
    assert!(out.camera.is_some());
    assert_eq!(out.shapes.len(), 1, "an XML scene gets no lights");
}

#[test]
fn what_is_wrong_has_file_line_and_remedy() {
    for (inside, what) in [
        ("<shape type=\"cube\"><ref id=\"nobody\"/></shape>", "nothing in the scene has this id"),
        ("<bsdf type=\"twosided\" id=\"a\"><ref id=\"a\"/></bsdf>", "cycle through \"a\": take this one out of it"),
        (
            "<bsdf type=\"twosided\" id=\"a\"><ref id=\"b\"/></bsdf><bsdf type=\"twosided\" id=\"b\"><ref id=\"a\"/></bsdf>",
            "cycle",
        ),
        ("<bsdf type=\"diffuse\" id=\"a\"/><bsdf type=\"diffuse\" id=\"a\"/>", "id \"a\" is taken"),
        ("<bsdf type=\"twosided\"/>", "needs one or two materials"),
        ("<shape/>", "lacks its attribute \"type\""),
        ("<shape type=\"ply\"/>", "lacks its filename"),
        (
            "<shape type=\"ply\"><string name=\"filename\" value=\"no.ply\"/></shape>",
            "mesh file \"no.ply\" (there is no such file)",
        ),
        (
            "<shape type=\"ply\"><string name=\"filename\" value=\"\"/></shape>",
            "mesh file \"\" (there is no such file)",
        ),
        ("<include filename=\"no.xml\"/>", "does not exist"),
        ("<shape type=\"cube\"><float name=\"flip_normals\" value=\"1\"/></shape>", "should be a <boolean>"),
        ("<shape type=\"cube\"><boolean name=\"flip_normals\" value=\"1\"/></shape>", "neither true nor false"),
        ("<integrator type=\"path\"><integer name=\"max_depth\" value=\"x\"/></integrator>", "no whole number"),
        ("<integrator type=\"path\"><integer name=\"max_depth\" value=\"-2\"/></integrator>", "max_depth"),
        ("<integrator type=\"path\"><integer name=\"rr_depth\" value=\"0\"/></integrator>", "rr_depth"),
        ("<shape type=\"cube\"><bsdf type=\"diffuse\"/><bsdf type=\"diffuse\"/></shape>", "a second bsdf"),
        ("<shape type=\"cube\"><emitter type=\"area\"/><emitter type=\"area\"/></shape>", "a second emitter"),
        (
            "<shape type=\"cube\"><emitter type=\"area\"><rgb name=\"radiance\" value=\"-1\"/></emitter></shape>",
            "at least 0",
        ),
        ("<emitter type=\"constant\"/><emitter type=\"constant\"/>", "one sky"),
        (
            "<shape type=\"cube\"><bsdf type=\"roughconductor\"><float name=\"alpha\" value=\"0\"/></bsdf></shape>",
            "(0, 1]",
        ),
        (
            "<shape type=\"cube\"><bsdf type=\"conductor\"><rgb name=\"eta\" value=\"-1\"/></bsdf></shape>",
            "between 0 and 100000",
        ),
        (
            "<shape type=\"cube\"><bsdf type=\"conductor\"><rgb name=\"k\" value=\"1e39\"/></bsdf></shape>",
            "between 0 and",
        ),
        ("<integrator type=\"path\"><integer name=\"max_depth\" value=\"65536\"/></integrator>", "0 to 65535"),
        ("<alias id=\"x\" as=\"y\"/>", "nothing above has this id"),
        ("<default name=\"\" value=\"y\"/>", "empty name"),
    ] {
        let error = message(inside);
        assert!(error.contains("s.xml:2:") && error.contains(what), "{inside}: {error}");
    }
    let film = |inside: &str| {
        message(&format!("{CUBE}<sensor type=\"perspective\"><film type=\"hdrfilm\">{inside}</film></sensor>"))
    };
    for (name, n) in [("width", 0), ("height", 0), ("width", 70_000), ("height", -1)] {
        let error = film(&format!("\n  <integer name=\"{name}\" value=\"{n}\"/>"));
        assert!(error.contains(&format!("s.xml:3:3: {name} {n} should lie between 1 and 65535")), "{error}");
    }
    assert!(film("<integer name=\"crop_width\" value=\"769\"/>").contains("the crop of 769 x "));
    assert!(film("<rfilter type=\"tent\"><float name=\"radius\" value=\"0\"/></rfilter>").contains("between 0 and 64"));
    assert!(film("<rfilter type=\"lanczos\"/>").contains("rfilter \"lanczos\""));
    let nested = format!("{}{}", "<bsdf type=\"twosided\">".repeat(100), "</bsdf>".repeat(100));
    assert!(message(&nested).contains("nested deeper than 64: give them ids"));
    let attributes: String = (0..20_000).map(|i| format!(" a{i}=\"\"")).collect();
    assert!(message(&format!("<shape{attributes}/>")).contains("attributes"));
    assert!(message("<!DOCTYPE x [<!ENTITY a \"b\">]>").contains("well-formed"));
}

#[test]
fn glass_and_plastic() {
    let bsdf = |text: &str| -> Result<Bsdf, ImportError> {
        let text = format!("<shape type=\"sphere\"><bsdf {text}</bsdf></shape>");
        scene(&text).map(|s| s.materials[0].bsdf.clone())
    };
    let eta = |b: Bsdf| match b {
        Bsdf::Dielectric { eta, .. } | Bsdf::ThinDielectric { eta, .. } | Bsdf::RoughDielectric { eta, .. } => eta,
        Bsdf::Plastic { eta, .. } | Bsdf::RoughPlastic { eta, .. } => eta,
        other => panic!("{other:?}"),
    };
    // as mitsuba 3.9.1 has them
    for (text, expected) in [
        ("type=\"dielectric\">", 1.5046 / 1.000277),
        ("type=\"thindielectric\"><string name=\"int_ior\" value=\"Water\"/>", 1.333 / 1.000277),
        ("type=\"roughdielectric\"><float name=\"intIOR\" value=\"1.8\"/><float name=\"ext_ior\" value=\"1.2\"/>", 1.5),
        ("type=\"plastic\">", 1.49 / 1.000277),
        (
            "type=\"roughplastic\"><integer name=\"int_ior\" value=\"2\"/><string name=\"ext_ior\" value=\"vacuum\"/>",
            2.0,
        ),
    ] {
        let found = eta(bsdf(text).unwrap());
        assert!((f64::from(found) - expected).abs() < 1e-6, "{text}: {found}");
    }
    let plastic = bsdf(
        "type=\"plastic\"><rgb name=\"diffuse_reflectance\" value=\"0.1, 0.2, 0.3\"/><boolean name=\"nonlinear\" value=\"true\"/>",
    )
    .unwrap();
    let Bsdf::Plastic { diffuse, specular, nonlinear, .. } = plastic else { panic!("{plastic:?}") };
    assert_eq!((diffuse, specular, nonlinear), ([0.1, 0.2, 0.3], [1.0; 3], true));
    let same = "type=\"roughdielectric\"><float name=\"int_ior\" value=\"1\"/><float name=\"ext_ior\" value=\"1\"/>\
        <float name=\"alpha\" value=\"0.3\"/>";
    assert!(matches!(bsdf(same).unwrap(), Bsdf::Dielectric { eta: 1.0, .. }));
    for (text, what) in [
        (
            "type=\"dielectric\"><string name=\"int_ior\" value=\"glass\"/>",
            "no index of refraction is known for \"glass\"; there are vacuum,",
        ),
        ("type=\"dielectric\"><float name=\"int_ior\" value=\"0\"/>", "should lie between 0.1 and 10"),
        ("type=\"plastic\"><float name=\"int_ior\" value=\"-1\"/>", "should lie between 0.1 and 10"),
        (
            "type=\"roughplastic\"><float name=\"alpha_u\" value=\"0.1\"/><float name=\"alpha_v\" value=\"0.2\"/>",
            "isotropic",
        ),
        ("type=\"plastic\"><rgb name=\"diffuse_reflectance\" value=\"1.5\"/>", "in [0, 1]"),
    ] {
        let error = bsdf(text).unwrap_err().to_string();
        assert!(error.contains(what), "{text}: {error}");
    }
}
