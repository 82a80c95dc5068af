//! What a document is before it is a scene: its head, folders to look in, second names.

use std::path::Path;

use super::tests::{CUBE, message, scene};
use crate::ImportError;
use crate::description::{Bsdf, Description, Geometry};
use crate::import::tests::{folder, write};
use crate::import::{ImportOptions, import};

fn read(path: &Path) -> Result<Description, ImportError> {
    import(path, &ImportOptions { sky: Some([1.0; 3]), ..ImportOptions::default() })
}

#[test]
fn a_doctype_is_refused_where_it_stands() {
    let dir = folder();
    let bomb = "<!DOCTYPE s [<!ENTITY a 'aaaa'><!ENTITY b '&a;&a;'>]>\n<scene version='&b;'/>";
    for (head, at) in [
        ("", "1:1"),
        ("<?xml version='1.0'?>\n", "2:1"),
        ("\u{feff}<?xml version='1.0'?>\n<!-- <!DOCTYPE comes -->\n\n  <?pi <!DOCTYPE ?> ", "4:21"),
    ] {
        let error = read(&write(&dir, "s.xml", format!("{head}{bomb}"))).unwrap_err().to_string();
        let told =
            format!("s.xml:{at}: a DOCTYPE is not read, as its entities may stand for text without bound: take it out");
        assert!(error.contains(&told), "{error}");
    }
}

#[test]
fn files_are_looked_for_in_the_folders_that_paths_name() {
    let dir = folder();
    for (name, size) in [("a", 1), ("b", 2), ("c", 3)] {
        std::fs::create_dir_all(dir.path().join("sub").join(name)).unwrap();
        write(&dir, &format!("sub/{name}/m.obj"), format!("v 0 0 0\nv {size} 0 0\nv 0 1 0\nf 1 2 3\n"));
    }
    write(&dir, "sub/b/only.obj", "v 0 0 0\nv 7 0 0\nv 0 1 0\nf 1 2 3\n");
    write(&dir, "n.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    write(
        &dir,
        "sub/a/part.xml",
        "<scene version='3.0.0'><shape type='obj'><string name='filename' value='m.obj'/></shape></scene>",
    );
    let mesh = |name: &str| format!("<shape type='obj'><string name='filename' value='{name}'/></shape>");
    let found = |inside: &str| -> Result<Vec<String>, String> {
        let text = format!("<scene version='2.0.0'>\n{inside}</scene>");
        let out = read(&write(&dir, "s.xml", text)).map_err(|e| e.to_string())?;
        let root = dir.path().canonicalize().unwrap();
        let of = |geometry: &Geometry| match geometry {
            Geometry::MeshFile { path, .. } => path.strip_prefix(&root).unwrap().display().to_string(),
            other => panic!("{other:?}"),
        };
        Ok(out.shapes.iter().map(|s| of(&s.geometry)).collect())
    };
    let [a, b] = ["a", "b"].map(|name| format!("<path value='sub/{name}'/>"));
    assert_eq!(found(&format!("{a}{}{}", mesh("m.obj"), mesh("n.obj"))).unwrap(), ["sub/a/m.obj", "n.obj"]);
    // the last one foremost, wherever it stands; what it lacks is in those before
    assert_eq!(
        found(&format!("{b}{a}{}{}", mesh("m.obj"), mesh("only.obj"))).unwrap(),
        ["sub/a/m.obj", "sub/b/only.obj"]
    );
    assert_eq!(found(&format!("{a}{}{b}", mesh("m.obj"))).unwrap(), ["sub/b/m.obj"]);
    // and before those beside the file that names it
    assert_eq!(found("<path value='sub/c'/><include filename='sub/a/part.xml'/>").unwrap(), ["sub/c/m.obj"]);
    assert_eq!(found(&format!("{a}<include filename='part.xml'/>")).unwrap(), ["sub/a/m.obj"]);

    let outside = folder();
    let elsewhere = outside.path().to_str().unwrap();
    for (path, told) in [
        (elsewhere, "lies outside the scene's folder"),
        ("..", "lies outside the scene's folder"),
        ("sub/none", "\"sub/none\" does not exist beside the scene"),
        ("n.obj", "<path> should name a folder"),
        ("", "is no file name"),
    ] {
        let error = found(&format!(" <path value='{path}'/>{CUBE}")).unwrap_err();
        assert!(error.contains("s.xml:2:2: ") && error.contains(told), "{path}: {error}");
    }
    // a folder inside leads nowhere else
    let error = found(&format!("{a}{}", mesh(&format!("{elsewhere}/x.obj")))).unwrap_err();
    assert!(error.contains("x.obj"), "{error}");
}

#[test]
fn an_alias_is_another_name() {
    let red = "<bsdf type='diffuse' id='m'><rgb name='reflectance' value='1, 0, 0'/></bsdf>";
    let out = scene(&format!("{red}<alias id='m' as='n'/><shape type='cube'><ref id='n'/></shape>")).unwrap();
    let material = &out.materials[out.shapes[0].material as usize];
    assert_eq!((&material.bsdf, out.materials.len()), (&Bsdf::Diffuse { reflectance: [1.0, 0.0, 0.0] }, 1));
    let taken = message(&format!("{red}\n<alias id='m' as='m'/>"));
    assert!(taken.contains("s.xml:3:1: the id \"m\" is taken already"), "{taken}");
}
