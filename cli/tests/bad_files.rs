//! Files that are missing, damaged or claim too much, through the built binary: 2 for what the user can put right and 1 for the rest, one short error
//! with file, place and remedy, no panic, no hang, no memory beyond a bound.

mod common;

use std::os::unix::fs::symlink;

use common::bed::{Bed, JPEG, LIT, TRIANGLE, noise};

#[test]
fn what_is_missing_empty_cut_or_noise() {
    let bed = Bed::new();
    let names = ["a.xml", "a.ply", "a.obj", "a.stl", "a.nrrd", "a.nhdr", "a.nii", "a.nii.gz", "a.dcm"];
    for name in names {
        let iso = if matches!(name, "a.xml" | "a.ply" | "a.obj" | "a.stl") { "" } else { " --iso 1" };
        bed.mistakes(&[(&format!("render none-{name}{iso}"), &[name, "No such file"])]);
        bed.write(&format!("empty-{name}"), "").mistakes(&[(&format!("render empty-{name}{iso}"), &[name, "empty"])]);
        for seed in 0..4 {
            bed.write(&format!("noise-{name}"), &noise(4096 + seed)[seed as usize..]);
            bed.mistakes(&[(&format!("render noise-{name}{iso}"), &[name])]);
        }
    }
    let ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    let mut whole = ply.to_vec();
    whole.extend([0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|x| x.to_le_bytes()));
    whole.push(3);
    whole.extend([0i32, 1, 2].iter().flat_map(|i| i.to_le_bytes()));
    bed.write("whole.ply", &whole);
    assert_eq!(bed.line("prepare whole.ply --store s").code, 0);
    for cut in [10, 100, ply.len(), ply.len() + 20, whole.len() - 1] {
        bed.write("cut.ply", &whole[..cut]).mistakes(&[("render cut.ply", &["cut.ply"])]);
    }
    let mut stl = vec![b' '; 80];
    stl.extend(2u32.to_le_bytes());
    stl.extend([0; 50]);
    bed.write("cut.stl", stl)
        .write("cut-text.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n")
        .write("cut.xml", "<scene version='3.0.0'>\n<shape type='rectangle'>")
        .write("cut.obj", "v 0 0 0\nv 1 0")
        .write("cut.nrrd", "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\0\0\0\0\0\0\0")
        .write("cut.ply.gz", b"\x1f\x8b\x08\0\0\0\0\0\0\x03");
    bed.mistakes(&[
        ("render cut.stl", &["cut.stl", "2 triangles", "truncated"]),
        ("render cut-text.stl", &["cut-text.stl:6:1: ", "truncated"]),
        ("render cut.xml", &["cut.xml:1", "not well-formed", "never closed"]),
        ("render cut.obj", &["cut.obj:2:5: v needs 3", "export the file again"]),
        ("render cut.nrrd --iso 5", &["cut.nrrd", "holds 69 bytes", "truncated"]),
        ("render cut.ply.gz", &["cut.ply.gz", "get the file again"]),
        ("render .", &["."]),
        ("render cut.nrrd", &["cut.nrrd", "--iso VALUE"]),
    ]);
}

#[test]
fn headers_that_claim_more_than_there_is() {
    let bed = Bed::new();
    let ply = |count: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        )
    };
    bed.write("huge.ply", ply("4000000000000")).write("beyond.ply", ply("99999999999999999999")).gz(
        "huge.ply.gz",
        ply("4000000000000").as_bytes(),
        100,
    );
    let mut stl = vec![0; 84 + 50];
    stl[80..84].fill(0xff);
    bed.write("huge.stl", stl);
    let nrrd = |sizes: &str, encoding: &str| {
        format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: {sizes}\nencoding: {encoding}\n\n00")
    };
    bed.write("huge.nrrd", nrrd("4000000000 4000000000 4000000000", "raw"))
        .write("deep.nrrd", nrrd("4000 4000 4000000000", "raw"))
        .write("packed.nrrd", nrrd("4000 4000 4000", "gzip"))
        .write("long.nrrd", format!("NRRD0004\n{}", "# padding\n".repeat(200_000)))
        .write(
            "list.nhdr",
            "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: a%d 0 9000000000 1\n",
        );
    let mut nii = vec![0u8; 352];
    nii[..4].copy_from_slice(&348i32.to_le_bytes());
    for (k, d) in [3i16, 32767, 32767, 32767].into_iter().enumerate() {
        nii[40 + 2 * k..42 + 2 * k].copy_from_slice(&d.to_le_bytes());
    }
    nii[70..72].copy_from_slice(&64i16.to_le_bytes());
    nii[344..348].copy_from_slice(b"n+1\0");
    bed.write("huge.nii", nii);
    // pictures: next to nothing that claims to be 16384 x 8192
    let mut hollow = vec![];
    let mut encoder = png::Encoder::new(&mut hollow, 16_384, 8192);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_chunk(png::chunk::IDAT, b"\x78\x9c\x03\0\0\0\0\x01").unwrap();
    let mut jpeg = JPEG.to_vec();
    let frame = jpeg.windows(2).position(|w| matches!(w, [0xff, 0xc0 | 0xc2])).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[8192u16.to_be_bytes(), 16_384u16.to_be_bytes()].concat());
    bed.write("huge.png", &hollow).write("huge.jpg", &jpeg);
    let texture = |name: &str| {
        format!(
            "<shape type='cube'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'>\n <string name='filename' value='{name}'/>\
             </texture></bsdf></shape>{LIT}"
        )
    };
    bed.xml("png.xml", &texture("huge.png")).xml("jpg.xml", &texture("huge.jpg")).xml(
        "sky.xml",
        "<shape type='cube'/>\n  <emitter type='envmap'><string name='filename' value='huge.png'/></emitter>",
    );
    let lies = "claims 402653184 bytes of texels in a file of ";
    bed.mistakes(&[
        ("render huge.ply", &["huge.ply", "4000000000000"]),
        ("render beyond.ply", &["beyond.ply:3"]),
        ("render huge.ply.gz", &["huge.ply.gz", "4000000000000"]),
        ("render huge.stl", &["huge.stl", "4294967295 triangles"]),
        ("render huge.nrrd --iso 1", &["huge.nrrd", "crop or resample"]),
        ("render deep.nrrd --iso 1", &["deep.nrrd", "truncated"]),
        ("render packed.nrrd --iso 1", &["packed.nrrd", "more than gzip can hold"]),
        ("render long.nrrd --iso 1", &["long.nrrd", "1048576 bytes"]),
        ("render list.nhdr --iso 1", &["list.nhdr:6", "too many"]),
        ("render huge.nii --iso 1", &["huge.nii", "crop or resample"]),
        ("render png.xml", &["png.xml:3:2: texture file \"huge.png\"", lies, "get it again"]),
        ("render jpg.xml", &["jpg.xml:3:2: texture file \"huge.jpg\"", lies, "get it again"]),
        ("render sky.xml", &["sky.xml:3:3: image ", "huge.png", lies, "get it again"]),
    ]);
}

/// Text that becomes much more than it is.
#[test]
fn bombs() {
    let bed = Bed::new();
    // 2^18 x 4 bytes from 18 lines, and then in some thousand attributes
    let doubling: String = (1..=18).map(|i| format!("<default name='a{i}x' value='$a{0}x$a{0}x'/>\n", i - 1)).collect();
    let start = "<default name='a0x' value='lol '/>\n";
    let many =
        |n: usize, value: &str| (0..n).map(|i| format!("<string name='s{i}' value='{value}'/>\n")).collect::<String>();
    bed.xml("doubling.xml", &format!("{start}{doubling}<default name='b' value='$a18x$a18x$a18x$a18x'/>"))
        .xml("sum.xml", &format!("{start}{doubling}{}", many(4000, "$a17x")))
        .xml("defaults.xml", &{
            let copies: String = (0..4000).map(|i| format!("<default name='c{i}x' value='$a17x'/>\n")).collect();
            format!("{start}{doubling}{copies}")
        })
        .write(
            "entities.xml",
            "<?xml version='1.0'?>\n <!DOCTYPE s [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'>]>\n<scene version='&b;'/>",
        )
        .write(
            "deep.xml",
            "<scene version='3.0.0'>".to_owned() + &"<a>".repeat(1_000_000) + &"</a>".repeat(1_000_000) + "</scene>",
        )
        .write(
            "deep-known.xml",
            "<scene version='3.0.0'>\n".to_owned()
                + &"<shape type='cube'><bsdf type='twosided'>".repeat(500_000)
                + &"</bsdf></shape>".repeat(500_000)
                + "</scene>",
        )
        .write("deep-shapes.xml", "<scene version='3.0.0'>\n".to_owned() + &"<shape type='cube'>\n".repeat(1_000_000))
        .xml("nested.xml", &("<bsdf type='twosided'>\n".repeat(1000) + &"</bsdf>".repeat(1000)))
        // from what is referred to and from what refers, and each more than once: 2^40 materials, 3^25 empty groups
        .xml("chain.xml", &{
            let links: String = (0..100_000)
                .map(|i| format!("<bsdf type='twosided' id='m{i}'><ref id='m{}'/></bsdf>\n", i + 1))
                .collect();
            format!("<bsdf type='diffuse' id='m100000'/>\n{links}<shape type='cube'><ref id='m0'/></shape>{LIT}")
        })
        .xml("groups.xml", &{
            let group = |i: usize, inside: &str| format!("<shape type='shapegroup' id='g{i}'>{inside}</shape>\n");
            let instance = |i: usize| format!("<shape type='instance'><ref id='g{i}'/></shape>");
            let links: String = (1..100_000).map(|i| group(i, &instance(i - 1))).collect();
            format!("{}{links}{}{LIT}", group(0, "<shape type='cube'/>"), instance(99_999))
        })
        .xml("blends.xml", &{
            let pair = |i: usize| format!("<ref id='m{0}'/><ref id='m{0}'/><float name='weight' value='0.5'/>", i - 1);
            let links: String =
                (1..=40).map(|i| format!("<bsdf type='blendbsdf' id='m{i}'>{}</bsdf>\n", pair(i))).collect();
            format!("<bsdf type='diffuse' id='m0'/>\n{links}<shape type='cube'><ref id='m40'/></shape>{LIT}")
        })
        .xml("empty.xml", &{
            let group = |i: usize, inside: &str| format!("<shape type='shapegroup' id='g{i}'>{inside}</shape>\n");
            let instance = |i: usize| format!("<shape type='instance'><ref id='g{i}'/></shape>");
            let links: String = (1..=25).map(|i| group(i, &instance(i - 1).repeat(3))).collect();
            format!("{}{links}{}{LIT}", group(0, ""), instance(25))
        })
        .write(
            "wide.xml",
            format!(
                "<scene version='3.0.0'>\n<shape {}/>",
                (0..20_000).map(|i| format!("a{i}='' ")).collect::<String>()
            ),
        )
        .gz("line.obj.gz", TRIANGLE.as_bytes(), 256 << 20)
        .gz("word.stl.gz", b"solid ", 256 << 20)
        .gz("word.ply.gz", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n", 256 << 20)
        .gz("zeros.nii.gz", &[0; 4], 256 << 20)
        .gz("scene.xml.gz", b"<scene version='3.0.0'/>", 0)
        .write("alias.yaml", {
            let rows: String = (1..40).map(|i| format!("a{i}: &a{i} [*a{0}, *a{0}, *a{0}]\n", i - 1)).collect();
            format!("a0: &a0 [x]\n{rows}")
        })
        .write("nested.yaml", "[".repeat(1_000_000));
    let most = bed.mistakes(&[
        ("render doubling.xml", &["doubling.xml:21", "$a18x", "1048576 bytes", "<default>"]),
        ("render sum.xml", &["sum.xml:1", "$a17x", "67108864 bytes", "shorten the <default>s"]),
        ("render defaults.xml", &["defaults.xml:1", "$a17x", "67108864 bytes"]),
        ("render entities.xml", &["entities.xml:2:2: a DOCTYPE is not read", "take it out"]),
        ("render deep.xml", &["deep.xml:1:24: element <a>"]),
        ("render deep-known.xml", &["deep-known.xml:2:1313: ", "nested deeper than 64", "use <ref>"]),
        ("render deep-shapes.xml", &["deep-shapes.xml:1:1: ", "never closed"]),
        ("render nested.xml", &["nested.xml:66:1: ", "nested deeper than 64", "use <ref>"]),
        ("render chain.xml", &["chain.xml:", "references nested deeper than 64"]),
        ("render groups.xml", &["groups.xml:", "references nested deeper than 64"]),
        ("render blends.xml", &["blends.xml:5:46: ", "262144 materials", "fewer instances inside of instances"]),
        ("render empty.xml", &["empty.xml:3:124: ", "4194304 objects", "fewer instances inside of instances"]),
        ("render wide.xml", &["wide.xml:2:1: ", "10000 attributes", "get the file again"]),
        ("render line.obj.gz", &["line.obj.gz:5", "longer than"]),
        ("render word.stl.gz", &["word.stl.gz"]),
        ("render word.ply.gz", &["word.ply.gz"]),
        ("render zeros.nii.gz --iso 1", &["zeros.nii.gz", "not a volume"]),
        ("render scene.xml.gz", &["scene.xml.gz", "UTF-8"]),
        ("render -f alias.yaml", &["alias.yaml"]),
        ("render -f nested.yaml", &["nested.yaml"]),
    ]);
    match most {
        // code alone takes some
        Some(most) => assert!(most > 4 << 20, "{most} bytes"),
        None => println!("this system does not tell a process's peak: only its address space is bounded"),
    }
}

/// A DICOM image of 2 x 2 pixels, explicit little endian.
fn dicom(series: &str, z: u32) -> Vec<u8> {
    let mut out = vec![0; 128];
    out.extend(b"DICM");
    let mut element = |group: u16, number: u16, vr: &[u8; 2], value: &[u8]| {
        let mut value = value.to_vec();
        if value.len() % 2 == 1 {
            value.push(if vr == b"UI" { 0 } else { b' ' });
        }
        out.extend(group.to_le_bytes());
        out.extend(number.to_le_bytes());
        out.extend(vr);
        if vr == b"OW" {
            out.extend([0, 0]);
            out.extend((value.len() as u32).to_le_bytes());
        } else {
            out.extend((value.len() as u16).to_le_bytes());
        }
        out.extend(value);
    };
    let short = |v: u16| v.to_le_bytes();
    element(2, 0x10, b"UI", b"1.2.840.10008.1.2.1");
    element(0x20, 0x0e, b"UI", series.as_bytes());
    element(0x20, 0x32, b"DS", format!("0\\0\\{z}").as_bytes());
    element(0x20, 0x37, b"DS", b"1\\0\\0\\0\\1\\0");
    element(0x28, 2, b"US", &short(1));
    element(0x28, 0x10, b"US", &short(2));
    element(0x28, 0x11, b"US", &short(2));
    element(0x28, 0x30, b"DS", b"1\\1");
    element(0x28, 0x100, b"US", &short(16));
    element(0x28, 0x101, b"US", &short(16));
    element(0x28, 0x102, b"US", &short(15));
    element(0x28, 0x103, b"US", &short(0));
    element(0x7fe0, 0x10, b"OW", &[z as u8, 0, 0, 0, 0, 0, 9, 0]);
    out
}

#[test]
fn dicom_folders() {
    let bed = Bed::new();
    for z in 0..3 {
        bed.write(&format!("good/{z}.dcm"), dicom("1.2.3", z)).write(&format!("mixed/a{z}.dcm"), dicom("1.2.3", z));
        bed.write(&format!("mixed/b{z}.dcm"), dicom("1.2.4", z));
        bed.write(&format!("cut/{z}.dcm"), dicom("1.2.3", z));
    }
    for z in [0, 1, 2, 4, 5] {
        bed.write(&format!("gap/{z}.dcm"), dicom("1.2.3", z));
    }
    let whole = dicom("1.2.3", 1);
    bed.write("cut/1.dcm", &whole[..whole.len() - 3]).write("none/readme.txt", "nothing here");
    // an image by a link that leads out of its folder: not read with the folder, but where it is named itself
    bed.write("linked/0.dcm", dicom("1.2.3", 0));
    symlink("../good/1.dcm", bed.path().join("linked/1.dcm")).unwrap();
    bed.write("within/real/1.dcm", &whole).write("within/0.dcm", dicom("1.2.3", 0));
    symlink("real/1.dcm", bed.path().join("within/1.dcm")).unwrap();
    assert_eq!(bed.line("render within --iso 1 --spp 1 --size 4x4").code, 0);
    assert_eq!(bed.line("render linked/1.dcm --iso 1 --spp 1 --size 4x4").code, 0);
    assert_eq!(bed.line("render good --iso 1 --spp 1 --size 4x4").code, 0);
    assert_eq!(bed.line("render mixed/b1.dcm --iso 1 --spp 1 --size 4x4").code, 0);
    bed.mistakes(&[
        ("render mixed --iso 1", &["mixed", "2 DICOM series", "give one file of the series", "a0.dcm", "b0.dcm"]),
        ("render gap --iso 1", &["gap/4.dcm", "gap/2.dcm", "an image is missing, or the spacing is uneven"]),
        ("render cut --iso 1", &["cut/1.dcm"]),
        ("render none --iso 1", &["none", "no DICOM image"]),
        ("render linked --iso 1", &["linked/1.dcm", "outside the scene's folder", "copy it there"]),
        ("render linked/0.dcm --iso 1", &["linked/1.dcm", "outside the scene's folder", "copy it there"]),
        ("render good", &["good", "--iso"]),
        ("render good --iso 99999", &["good", "both sides of the iso value"]),
    ]);
}
