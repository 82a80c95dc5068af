use rayherd_tests::mutation;

use crate::ImportError;
use crate::description::{
    Amount, Bsdf, Description, Detail, Geometry, Material, Relief, ReliefKind, Slot, TextureKind, Textured, UvMap, Wrap,
};
use crate::import::tests::{folder, records, write};
use crate::import::{ImportOptions, Survey, import};
use crate::record::Record;

/// A picture of one texel in three channels, and one of grey.
const COLORED: &[u8] = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\x80\x40\x20\x81";

fn grey_png() -> Vec<u8> {
    let mut out = vec![];
    let mut encoder = png::Encoder::new(&mut out, 1, 1);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().unwrap().write_image_data(&[128]).unwrap();
    out
}

const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0.25\nvt 1 0\nvt 0 1\n";

/// An OBJ file beside the library `a.mtl` of this text and the pictures `c.hdr` and `g.png`.
fn import_with(library: &str, obj: &str, options: &ImportOptions) -> Result<Description, ImportError> {
    let dir = folder();
    write(&dir, "a.mtl", library);
    write(&dir, "c.hdr", COLORED);
    write(&dir, "g.png", grey_png());
    let out = import(&write(&dir, "a.obj", format!("mtllib a.mtl\n{TRIANGLE}{obj}")), options)?;
    // what a stream finds out is found while the files are there
    let survey = Survey::of(&out);
    assert!(survey.textures.iter().all(Result::is_ok));
    match survey.shapes.into_iter().find_map(|s| s.error) {
        Some(error) => Err(error),
        None => Ok(out),
    }
}

/// The material that these statements make.
fn described(statements: &str) -> (Description, Material) {
    let text = format!("# by hand\nnewmtl m\n{statements}\n");
    let out = import_with(&text, "usemtl m\nf 1/1 2/2 3/3\n", &ImportOptions::default()).unwrap();
    let shape = out.shapes.iter().find(|s| s.name == "m").unwrap();
    let material = out.materials[shape.material as usize].clone();
    (out, material)
}

fn material(statements: &str) -> Material {
    described(statements).1
}

fn refused(library: &str) -> String {
    import_with(library, "f 1 2 3\n", &ImportOptions::default()).unwrap_err().to_string()
}

#[test]
fn statements_choose_the_model() {
    let grey = [0.7; 3];
    assert_eq!(material("Kd 0.1 0.2 0.3").bsdf, Bsdf::Diffuse { reflectance: [0.1, 0.2, 0.3] });
    assert_eq!(material("").bsdf, Bsdf::Diffuse { reflectance: grey });
    assert_eq!(material("Kd 0.5\nKs 0 0 0\nNs 10\nillum 2").bsdf, Bsdf::Diffuse { reflectance: [0.5; 3] });
    assert_eq!(material("Kd 0.5\nKs 1 1 1\nillum 1").bsdf, Bsdf::Diffuse { reflectance: [0.5; 3] }, "no highlights");
    let phong = |exponent| Bsdf::Phong { diffuse: [0.5; 3], specular: [0.25; 3], exponent };
    assert_eq!(material("Kd 0.5\nKs 0.25\nNs 96\nillum 2").bsdf, phong(96.0));
    assert_eq!(material("kd 0.5\nKS 0.25").bsdf, phong(30.0), "in small letters, and by default");
    let mirror = Bsdf::Conductor { eta: [0.0; 3], k: [1.0; 3], specular: [0.9; 3] };
    assert_eq!(material("Kd 0 0 0\nKs 0.9\nillum 3").bsdf, mirror);
    let glass = |eta, transmit| Bsdf::Dielectric { eta, reflect: [1.0; 3], transmit };
    assert_eq!(material("illum 4\nNi 1.33\nd 0.1").bsdf, glass(1.33, [1.0; 3]));
    assert_eq!(material("illum 7\nTf 0.5 0.6 0.7").bsdf, glass(1.5, [0.5, 0.6, 0.7]));
    assert!(!material("illum 6\nNi 1.5").two_sided && material("Kd 0.5").two_sided);
    let Bsdf::RoughDielectric { alpha, .. } = material("illum 7\nNi 1.5\nPr 0.5").bsdf else { panic!() };
    assert_eq!(alpha, [0.25; 2]);
    let Bsdf::Principled(p) = material("Kd 0.2\nPr 0.3\nPm 0.75\nPc 0.5\nPcr 0.25\nPs 0.125\naniso 0.0625").bsdf else {
        panic!()
    };
    assert_eq!((p.base_color, p.roughness, p.metallic, p.eta), ([0.2; 3], 0.3, 0.75, 1.5));
    assert_eq!((p.clearcoat, p.clearcoat_gloss, p.sheen, p.anisotropic), (0.5, 0.75, 0.125, 0.0625));
}

#[test]
fn maps_take_the_place_of_numbers() {
    let detail = |statements| *material(statements).detail.unwrap();
    let painted = |slot, scale| vec![Textured { slot, texture: 0, scale }];
    let (out, m) = described("Kd 0.5 1 0.25\nmap_Kd -s 2 3 -o 0.5 0.25 0 -clamp on c.hdr");
    assert_eq!(m.detail.unwrap().textured, painted(Slot::Diffuse, [0.5, 1.0, 0.25]));
    let TextureKind::Image { raw, wrap, to_uv, path, .. } = &out.textures[0].kind else { panic!() };
    assert!(!raw && *wrap == Wrap::Clamp && path.ends_with("c.hdr") && out.textures[0].place.line == 4);
    // 2 u + 0.5, and of v upwards 3 v + 0.25: with v = 1 - v' that is 1 - (3 - 3 v' + 0.25) from the top
    assert_eq!(*to_uv, UvMap([[2.0, 0.0, 0.5], [0.0, 3.0, -2.25]]));
    assert_eq!(detail("map_Kd c.hdr").textured, painted(Slot::Diffuse, [1.0; 3]));
    assert_eq!(detail("Ks 0.5\nmap_Ks c.hdr\nNs 5").textured, painted(Slot::Specular, [0.5; 3]));
    assert_eq!(
        detail("Pm 0\nmap_Pm g.png").textured,
        painted(Slot::Metallic, [1.0; 3]),
        "what stands beside it is idle"
    );
    assert_eq!(detail("map_Pr g.png").textured, painted(Slot::Roughness, [1.0; 3]));
    assert_eq!(detail("d 0.25").opacity, Amount::Constant(0.25));
    assert_eq!(detail("Tr 0.25").opacity, Amount::Constant(0.75));
    assert_eq!(detail("map_d g.png").opacity, Amount::Texture(0));
    let relief = |kind| Some(Relief { kind, texture: 0, mirrored: true, shadowed: true });
    assert_eq!(detail("map_Bump -bm 0.5 g.png").relief, relief(ReliefKind::Bump(0.5)));
    assert_eq!(detail("norm g.png").relief, relief(ReliefKind::Normals));
    let raw = |out: &Description| matches!(out.textures[0].kind, TextureKind::Image { raw: true, .. });
    assert!(raw(&described("bump g.png").0) && raw(&described("map_Pr g.png").0) && raw(&described("map_d g.png").0));
    assert_eq!(material("d 1").detail, None);
    let notes = described("Ka 1 1 1\nbump c.hdr\nKd 2").0.notes;
    let texts: Vec<&str> = notes.iter().map(|n| n.text.as_str()).collect();
    assert!(texts[0].starts_with("ka is passed over") && texts[1].contains("normal map by norm"), "{texts:?}");
    assert!(texts[2].contains("brought to 1") && notes[2].place.line == 5, "{notes:?}");
}

#[test]
fn faces_have_the_material_above_them() {
    let library = "newmtl red\nKd 1 0 0\nnewmtl lamp\nKe 2 3 4\nmap_Ke c.hdr\nnewmtl dark lamp\nKe 0 0 0\n";
    let obj =
        "f 1 2 3\nusemtl red\nf 1 2 3 1\nusemtl lamp\nf 1 2 3\nusemtl red\nf 1 2 3\nusemtl dark lamp\nf 1/1 2/2 3/3\n";
    let out = import_with(library, obj, &ImportOptions::default()).unwrap();
    let names: Vec<&str> = out.shapes.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["a.obj", "red", "lamp", "dark lamp"], "and no lights around it: it has its own");
    assert!(out.environment.is_some());
    assert_eq!((out.shapes[2].emission, out.shapes[2].emission_texture), (Some([2.0, 3.0, 4.0]), Some(0)));
    assert_eq!(out.shapes[3].emission, None);
    let dir = folder();
    write(&dir, "a.mtl", library);
    let path = write(&dir, "a.obj", format!("mtllib a.mtl\n{TRIANGLE}{obj}"));
    let mut out = out;
    if let Geometry::MeshFile { path: p, .. } = &mut out.shapes[0].geometry {
        *p = path;
    }
    let all = records(&out).unwrap();
    let shapes: Vec<u32> = all.iter().map(|r| if let Record::Triangle(t) = r { t.shape } else { 9 }).collect();
    assert_eq!(shapes, [0, 1, 1, 2, 1, 3]);
    let Record::Triangle(last) = all[5] else { panic!() };
    assert_eq!(last.uv, Some([[0.0, 0.75], [1.0, 1.0], [0.0, 0.0]]), "v is turned round");

    // an albedo that is asked for is that of all
    let options = ImportOptions { albedo: Some([0.5; 3]), ..ImportOptions::default() };
    let out = import_with(library, obj, &options).unwrap();
    assert_eq!((out.materials.len(), out.shapes.len(), out.notes.len()), (2, 3, 0));
    // and tools that want the surface alone do not look for libraries
    let lost = write(&dir, "c.obj", format!("mtllib none.mtl\n{TRIANGLE}f 1 2 3\n"));
    assert!(import(&lost, &ImportOptions::default()).is_err());
    assert_eq!(crate::import::import_surface(&lost, &ImportOptions::default()).unwrap().shapes.len(), 1);
    // files that name no library are of one material
    let dir = folder();
    let path = write(&dir, "b.obj", format!("{TRIANGLE}usemtl red\nf 1 2 3\n"));
    assert_eq!(import(&path, &ImportOptions::default()).unwrap().shapes.len(), 3);
}

#[test]
fn what_cannot_be_read_is_named() {
    for (library, what) in [
        ("Kd 1 1 1\n", "a.mtl:1:1: \"Kd\" before the first newmtl"),
        ("newmtl\n", "a.mtl:1:1: newmtl needs a name"),
        ("newmtl m\nKd 1 2\n", "a.mtl:2:4: kd: 2 numbers"),
        ("newmtl m\n \tKd nan 0 0\n", "a.mtl:2:6: kd: \"nan\" is no finite number"),
        ("newmtl m\nKd 0 -1 0\n", "a.mtl:2:6: kd: -1 should not be negative"),
        ("newmtl m\nKe 1e39\n", "fit a float"),
        ("newmtl m\nNi 0\n", "should lie between 0.1 and 10"),
        ("newmtl m\nPr  x \n", "a.mtl:2:5: pr: \"x\" is no finite number"),
        ("newmtl m\nNs -3\n", "ns: -3 should not be negative"),
        ("newmtl m\nillum 11\n", "no illumination model"),
        ("newmtl m\nmap_Kd -q 1 c.hdr\n", "a.mtl:2:8: map_kd: no option -q is known"),
        ("newmtl m\nmap_Kd -s c.hdr\n", "a.mtl:2:11: map_kd: an option lacks its numbers"),
        ("newmtl m\nmap_Kd -s 1 1 1\n", "it names no file"),
        ("newmtl m\nmap_Kd none.png\n", "a.mtl:2:1: texture file \"none.png\" (it is not there)"),
        ("newmtl m\nmap_Kd a.obj\n", "is no PNG, JPEG, OpenEXR or Radiance HDR image"),
        ("newmtl m\nfoo 1\n", "a.mtl:2:1: foo in a material library"),
        ("newmtl m\nd -halo  1 x\n", "a.mtl:2:10: d: \"1 x\" is no finite number"),
        ("newmtl m\ndisp c.hdr\nKd spectral a.rfl\n", "2 unsupported element(s)"),
        ("newmtl m\nmap_Kd -mm 0 2 c.hdr\n", "-mm 0 2 of map_kd"),
        ("newmtl m\nillum 4\nNi 1.5\nmap_Kd c.hdr\n", "a map on the glass \"m\""),
    ] {
        let error = refused(library);
        assert!(error.contains(what), "{library}: {error}");
        let options = ImportOptions { substitute: true, ..ImportOptions::default() };
        match import_with(library, "usemtl m\nf 1 2 3\n", &options) {
            Ok(out) => assert!(error.contains("unsupported") && !out.substitutions.is_empty(), "{library}"),
            Err(_) => assert!(!error.contains("unsupported"), "{library}"),
        }
    }
    let strict = ImportOptions::default();
    let lenient = ImportOptions { substitute: true, ..ImportOptions::default() };
    let unknown = "usemtl red\nf 1 2 3\n";
    let error = import_with("newmtl m\n", unknown, &strict).unwrap_err().to_string();
    assert!(error.contains("a.obj:8:8: usemtl \"red\", which no mtllib of this file defines"), "{error}");
    assert!(import_with("newmtl m\n", unknown, &lenient).is_ok());
    let late = "f 1 2 3\nmtllib b.mtl\n";
    let error = import_with("newmtl m\n", late, &strict).unwrap_err().to_string();
    assert!(error.contains("a.obj:9:8: mtllib \"b.mtl\" stands after the first vertex"), "{error}");
    // one that is found when the vertices have been read is not passed over
    let dir = folder();
    let path = write(&dir, "a.obj", format!("{TRIANGLE}mtllib b.mtl\nusemtl m\nf 1 2 3\n"));
    let error = import(&path, &strict).unwrap_err().to_string();
    assert!(error.contains("a.obj:7:8: mtllib \"b.mtl\" stands after the first vertex"), "{error}");
    let dir = folder();
    let path = write(&dir, "a.obj", format!("mtllib b.mtl c.mtl\n{TRIANGLE}f 1 2 3\n"));
    let error = import(&path, &strict).unwrap_err().to_string();
    assert!(error.contains("a.obj:1:8: material library \"b.mtl\"") && error.contains("\"c.mtl\""), "{error}");
    assert_eq!(import(&path, &lenient).unwrap().substitutions.len(), 2);
    // names with blanks are one file if there is one
    write(&dir, "b.mtl c.mtl", "newmtl only\n");
    assert_eq!(import(&path, &strict).unwrap().shapes[1].name, "only");
}

#[test]
fn damaged_libraries_are_errors_or_materials() {
    let good = "newmtl a\nKd 0.5 0.5 0.5\nKs 0.1\nNs 10\nNi 1.5\nd 0.5\nillum 2\nmap_Kd -s 1 1 1 -o 0 0 c.hdr\nmap_Bump -bm 0.1 g.png\n\
                newmtl b\nillum 7\nTf 0.5 0.6 0.7\nnewmtl c\nPr 0.5\nPm 1\nmap_Pr g.png\nKe 1 1 1\n";
    assert!(import_with(good, "usemtl b\nf 1 2 3\n", &ImportOptions::default()).is_ok());
    let dir = folder();
    write(&dir, "c.hdr", COLORED);
    write(&dir, "g.png", grey_png());
    let path = write(&dir, "a.obj", format!("mtllib a.mtl\n{TRIANGLE}f 1 2 3\n"));
    let mut read = 0;
    let rounds = mutation::rounds("mtl", 2000, |random| {
        std::fs::write(dir.path().join("a.mtl"), mutation::bytes(good.as_bytes(), random)).unwrap();
        if let Ok(out) = import(&path, &ImportOptions::default()) {
            read += 1;
            for material in &out.materials {
                let Some(Detail { opacity: Amount::Constant(x), .. }) = material.detail.as_deref() else { continue };
                assert!((0.0..=1.0).contains(x));
            }
        }
    });
    assert!(rounds.is_none_or(|n| read > n / 20 && read < n), "{read} of {rounds:?}");
}

/// Statements that the chosen model has no place for are told, once for each library, and not where they say what is so anyway.
#[test]
fn what_says_nothing_has_a_note() {
    for (statements, part) in [
        ("Kd 0.5\nKs 0.1\nNs 10\nPr 0.3", "Ks, map_Ks and Ns say nothing beside Pr"),
        ("Kd 0.5\nTf 0.5 0.5 0.5", "Tf is passed over"),
        ("Kd 0.5\nNi 1.45", "Ni is passed over"),
        ("Kd 0.5\nKs 0.5\nillum 9\nd 0.5", "illum 9"),
        ("illum 7\nNi 1.5\nPm 1", "say nothing of glass"),
        ("illum 7\nNi 1.5\nd 0.5", "d says nothing of glass"),
        ("illum 4\nNi 1.5\nKs 0.5", "Kd, Ks and Ns say nothing of glass"),
        ("Kd 0.5\nmap_d a.png", "alpha channel"),
    ] {
        let dir = folder();
        let mut image = vec![];
        let mut encoder = png::Encoder::new(&mut image, 1, 1);
        encoder.set_color(png::ColorType::Rgba);
        encoder.write_header().unwrap().write_image_data(&[128; 4]).unwrap();
        write(&dir, "a.png", &image);
        write(&dir, "a.mtl", format!("newmtl m\n{statements}\nnewmtl n\n{statements}\n"));
        let path = write(&dir, "a.obj", format!("mtllib a.mtl\n{TRIANGLE}usemtl m\nf 1/1 2/2 3/3\n"));
        let notes = import(&path, &ImportOptions::default()).unwrap().notes;
        let found: Vec<_> = notes.iter().filter(|n| n.text.contains(part)).collect();
        assert_eq!(found.len(), 1, "{statements}: {notes:?}");
        assert!(found[0].place.line == 1 || statements.contains("map_d"), "{notes:?}");
    }
    for statements in [
        "Kd 0.5",
        "Kd 0.5\nNi 1",
        "Kd 0.5\nKs 0.1\nNs 10\nd 0.5",
        "Kd 0.5\nPr 0.4\nNi 1.4",
        "illum 7\nNi 1.5\nTf 1 0.5 0.5\nPr 0.2",
        "Kd 0.5\nmap_d g.png",
    ] {
        assert_eq!(described(statements).0.notes, [], "{statements}");
    }
}
