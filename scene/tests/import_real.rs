//! Real scenes made by others (`../shared/data`, not part of the repository): how many triangles they have. Where a scene is
//! absent the test says so and passes.

use std::path::{Path, PathBuf};
use std::process::Command;

use rayherd_scene::description::Description;
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import, import_surface};
use rayherd_scene::record::{Record, RecordSource};

/// Unpacks a set into a folder that vanishes; none if it is not there.
fn unpack(name: &str) -> Option<(tempfile::TempDir, PathBuf)> {
    let archive =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name).join(format!("{name}.tar.xz"));
    if !archive.exists() {
        println!("{} is absent: not tested", archive.display());
        return None;
    }
    let dir = tempfile::tempdir().unwrap();
    let status = Command::new("tar").arg("xf").arg(&archive).arg("-C").arg(dir.path()).status().unwrap();
    assert!(status.success(), "tar cannot unpack {}", archive.display());
    let folder = dir.path().join(name);
    Some((dir, folder))
}

/// Triangles and spheres.
fn count(description: &Description) -> (u64, u64) {
    let source = DescriptionSource::new(description, StreamOptions::default());
    let mut stream = source.open().unwrap();
    let (mut records, mut triangles, mut spheres) = (vec![], 0, 0);
    loop {
        records.clear();
        if stream.next(&mut records, 4096).unwrap() == 0 {
            return (triangles, spheres);
        }
        let n = records.iter().filter(|r| matches!(r, Record::Sphere(_))).count() as u64;
        spheres += n;
        triangles += records.len() as u64 - n;
    }
}

fn scene(name: &str, substitute: bool, expected: (u64, u64)) {
    let Some((_dir, folder)) = unpack(name) else { return };
    let options = ImportOptions { substitute, ..ImportOptions::default() };
    let description = import(&folder.join("scene.xml"), &options).unwrap();
    assert!(description.camera.is_some() && description.bounds.is_none());
    assert_eq!(substitute, !description.substitutions.is_empty());
    assert_eq!(count(&description), expected, "{name}");
}

#[test]
fn cornell_box() {
    scene("scene-cornell-box", false, (36, 0));
}

#[test]
fn veach_mis() {
    scene("scene-veach-mis", false, (52, 3));
}

// 262,661 triangles in OBJ files, and a rectangle
#[test]
fn staircase() {
    scene("scene-staircase", true, (262_663, 0));
}

#[test]
fn living_room() {
    scene("scene-living-room", true, (143_163, 0));
}

// 269,536 triangles in OBJ files, and a rectangle
#[test]
fn dining_room() {
    scene("scene-dining-room", true, (269_538, 0));
}

#[test]
fn classroom() {
    scene("scene-classroom", true, (103_832, 0));
}

#[test]
fn meshes() {
    let Some((_dir, folder)) = unpack("meshes") else { return };
    for (name, expected) in [("bunny.ply", 69_451), ("lucy.ply", 99_970), ("dragon_vrip.ply.gz", 871_414)] {
        let description = import_surface(&folder.join(name), &ImportOptions::default()).unwrap();
        assert_eq!(count(&description), (expected, 0), "{name}");
    }
}
