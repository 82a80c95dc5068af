//! Bad input through the built binary: 2 for what the user can put right and 1 for the rest, one short error with file, place and
//! remedy, no panic, no hang, no memory beyond a bound.

mod common;

use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use common::{Run, rayherd_bounded, repository};
use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;

/// Address space of a run. Most of it is threads' stacks and reserves; the inputs below ask for far more.
const MIB: u64 = 4096;
/// Memory of a run that is refused, at most: what is read of a bad input stays within the limits of its reader, the largest of which is that
/// of XML: some 300 MiB with the program itself, which takes a few more where it is not optimised.
const MOST_MEMORY: u64 = 320 << 20;
/// The longest error: what a terminal shows.
const MOST_TEXT: usize = 2000;

const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
const LIT: &str = "<emitter type='constant'/>";
/// A picture of one texel.
const HDR: &[u8] = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\x80\x40\x20\x81";

/// A JPEG of 37 x 29 texels.
const JPEG: &[u8] = include_bytes!("../../scene/src/image/fixtures/waves.jpg");

/// A folder with the inputs of one table.
struct Bed(tempfile::TempDir);

impl Bed {
    fn new() -> Self {
        Bed(tempfile::tempdir().unwrap())
    }
    fn path(&self) -> &Path {
        self.0.path()
    }
    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> &Self {
        let path = self.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
        self
    }
    fn xml(&self, name: &str, inner: &str) -> &Self {
        self.write(name, format!("<scene version='3.0.0'>\n{inner}\n</scene>"))
    }
    fn gz(&self, name: &str, head: &[u8], zeros: u64) -> &Self {
        let mut out = GzEncoder::new(File::create(self.path().join(name)).unwrap(), Compression::fast());
        out.write_all(head).unwrap();
        std::io::copy(&mut std::io::Read::take(std::io::repeat(b'0'), zeros), &mut out).unwrap();
        out.finish().unwrap();
        self
    }
    fn pipe(&self, name: &str) -> &Self {
        assert!(Command::new("mkfifo").arg(self.path().join(name)).status().unwrap().success());
        self
    }
    fn run(&self, arguments: &[&str]) -> Run {
        rayherd_bounded(self.path(), MIB, arguments)
    }
    /// Runs a command line.
    fn line(&self, line: &str) -> Run {
        self.run(&line.split(' ').collect::<Vec<_>>())
    }

    /// Runs each row's command line, which must end with a mistake that names its parts, and within [`MOST_MEMORY`]; the most that one took,
    /// bytes.
    #[track_caller]
    fn mistakes(&self, rows: &[(&str, &[&str])]) -> Option<u64> {
        let mut most = None;
        for (line, parts) in rows {
            let run = self.line(line);
            assert_error(line, &run, 2, parts);
            let peak = run.peak.map(|kib| kib << 10);
            assert!(peak < Some(MOST_MEMORY), "{line}: {} MiB", peak.unwrap_or(0) >> 20);
            most = most.max(peak);
        }
        most
    }
}

#[track_caller]
fn assert_error(line: &str, run: &Run, code: i32, parts: &[&str]) {
    let told = &run.err;
    assert_eq!(run.code, code, "{line}: {told}");
    let errors = told.lines().filter(|l| l.starts_with("error: ")).count();
    assert!(errors == 1, "{line}: {errors} errors in: {told}");
    assert!(told.len() < MOST_TEXT, "{line}: {} bytes of errors: {told}", told.len());
    assert!(!told.contains("panicked") && !told.contains("defect"), "{line}: {told}");
    for part in parts {
        assert!(told.contains(part), "{line}: no {part:?} in: {told}");
    }
}

fn noise(n: u32) -> Vec<u8> {
    (0..n).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

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

#[test]
fn cycles_and_references_to_nothing() {
    let bed = Bed::new();
    bed.xml("self.xml", "<include filename='self.xml'/>")
        .xml("one.xml", "\n<include filename='two.xml'/>")
        .xml("two.xml", "<include filename='one.xml'/>")
        .xml(
            "ref.xml",
            &format!(
                "<bsdf type='twosided' id='m'><ref id='m'/></bsdf>\n<shape type='cube'><ref id='m'/></shape>{LIT}"
            ),
        )
        .xml(
            "pair.xml",
            &format!(
                "<bsdf type='twosided' id='a'><ref id='b'/></bsdf><bsdf type='twosided' id='b'>\n<ref id='a'/></bsdf>\
                 <shape type='cube'><ref id='a'/></shape>{LIT}"
            ),
        )
        .xml(
            "group.xml",
            &format!(
                "<shape type='shapegroup' id='g'><shape type='cube'/>\n<shape type='instance'><ref id='g'/></shape></shape>\
                 <shape type='instance'><ref id='g'/></shape>{LIT}"
            ),
        )
        .xml("nothing.xml", &format!("<shape type='cube'>\n<ref id='no'/></shape>{LIT}"))
        .xml("twice.xml", &format!("<bsdf type='diffuse' id='m'/>\n<bsdf type='diffuse' id='m'/>{LIT}"))
        .write("beyond.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 4\n")
        .write("zero.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n")
        .write("back.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n")
        .write("huge.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n");
    let ply = |index: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 {index}\n"
        )
    };
    bed.write("beyond.ply", ply("3")).write("minus.ply", ply("-1"));
    bed.mistakes(&[
        ("render self.xml", &["self.xml:2:1: ", "cycle: self.xml -> self.xml", "take one of these <include>s out"]),
        (
            "render one.xml",
            &["two.xml:2:1: ", "cycle: one.xml -> two.xml -> one.xml", "take one of these <include>s out"],
        ),
        ("render ref.xml", &["ref.xml:2:30: ", "cycle through \"m\": take this one out"]),
        ("render pair.xml", &["pair.xml:3:1: ", "cycle through \"a\": take this one out"]),
        ("render group.xml", &["group.xml:3:24: ", "cycle through \"g\": take this one out"]),
        ("render nothing.xml", &["nothing.xml:3:1: ", "ref to \"no\"", "nothing in the scene has this id"]),
        ("render twice.xml", &["twice.xml:3:1: ", "id \"m\" is taken", "its own"]),
        ("render beyond.obj", &["beyond.obj:5:7: index 4 of v, but 3", "a face names what stands before it"]),
        ("render zero.obj", &["zero.obj:4:3: index 0"]),
        ("render back.obj", &["back.obj:4:9: index -4"]),
        ("render huge.obj", &["huge.obj:4:7: "]),
        ("render beyond.ply", &["beyond.ply:13:7: ", "vertex index 3, but the file has 3", "export the file again"]),
        ("render minus.ply", &["minus.ply:13:7: ", "vertex index -1"]),
    ]);
}

#[test]
fn nothing_to_see_or_to_see_by() {
    let bed = Bed::new();
    let film = |n: u32| {
        format!(
            "<sensor type='perspective'><film type='hdrfilm'>\n <integer name='width' value='{n}'/><integer name='height' value='{n}'/>\
             </film></sensor><shape type='cube'/>{LIT}"
        )
    };
    let lamp = |kind: &str, file: &str, more: &str| {
        format!(
            "<shape type='cube'/>\n  <shape type='{kind}' id='lamp'><string name='filename' value='{file}'/><emitter type='area'/></shape>{more}"
        )
    };
    let rough = |alpha: &str| {
        format!(
            "<shape type='cube'><bsdf type='roughconductor'><float name='alpha' value='{alpha}'/></bsdf></shape>{LIT}"
        )
    };
    bed.write("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("inf.obj", "v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n")
        .write("far.obj", "v 0 0 0\nv 1e30 0 0\nv 0 1e30 0\nf 1 2 3\n")
        .write("points.obj", "v 0 0 0\nv 1 0 0\n")
        .xml("dark.xml", "<shape type='cube'/>")
        .xml("empty.xml", LIT)
        .xml("black.xml", "<shape type='cube'/><emitter type='constant'><rgb name='radiance' value='0'/></emitter>")
        .xml(
            "flat.xml",
            &format!("<shape type='cube'>\n<transform name='to_world'><scale value='0'/></transform></shape>{LIT}"),
        )
        .xml(
            "flat-seen.xml",
            &format!("<sensor type='perspective'/>\n <shape type='cube'><transform name='to_world'><scale value='0'/></transform></shape>{LIT}"),
        )
        .xml(
            "nan.xml",
            &format!("<shape type='cube'>\n<transform name='to_world'><scale value='nan'/></transform></shape>{LIT}"),
        )
        .xml("film-0.xml", &film(0))
        .xml("film-large.xml", &film(100_000))
        .write("t.obj", TRIANGLE)
        .xml("rough.xml", &rough("-1"))
        .xml("rough-nan.xml", &rough("NaN").replace("NaN", "nan"))
        .xml("ior.xml", &format!("<shape type='cube'><bsdf type='dielectric'>\n <float name='int_ior' value='0'/></bsdf></shape>{LIT}"))
        .xml("albedo.xml", &format!("<shape type='cube'><bsdf type='diffuse'>\n <rgb name='reflectance' value='2'/></bsdf></shape>{LIT}"))
        .xml("factor.xml", &format!("<shape type='cube'><bsdf type='plastic'>\n\n  <rgb name='specular_reflectance' value='1, 1, -1'/></bsdf></shape>{LIT}"))
        .xml("line-light.xml", {
            "<shape type='cube'/><shape type='rectangle' id='lamp'>\n<transform name='to_world'><scale x='0'/></transform>\
             <emitter type='area'/></shape>"
        })
        .xml("flat-sensor.xml", &format!("<shape type='cube'/><sensor type='perspective'>\n <transform name='to_world'><scale z='0'/></transform></sensor>{LIT}"))
        // a lamp of vertices that are none, and one of no triangles
        .write("nan-lamp.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        .write("no-lamp.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 0\n\
            property list uchar int vertex_indices\nend_header\n")
        .xml("nan-lamp.xml", &lamp("obj", "nan-lamp.obj", ""))
        .xml("no-lamp.xml", &lamp("ply", "no-lamp.ply", ""))
        .xml("nan-lamp-lit.xml", &lamp("obj", "nan-lamp.obj", LIT))
        .xml("no-lamp-lit.xml", &lamp("ply", "no-lamp.ply", "<shape type='sphere'><emitter type='area'/></shape>"))
        .xml("flat-lamp-lit.xml", &format!("{}{LIT}", "<shape type='cube'/>\n<shape type='rectangle' id='lamp'><transform name='to_world'>\
            <scale x='0'/></transform><emitter type='area'/></shape>"))
        .xml("point.xml", &format!("<shape type='sphere'>\n<float name='radius' value='0'/></shape>{LIT}"))
        .write("even.nrrd", "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\0\0\0\0\0\0\0\0");
    bed.mistakes(&[
        ("render nan.obj", &["nan.obj", "finite"]),
        ("render inf.obj", &["inf.obj", "finite"]),
        ("render flat.obj", &["flat.obj", "have no area"]),
        ("render far.obj", &["far.obj", "scale is sane"]),
        ("render points.obj", &["points.obj"]),
        ("render dark.xml", &["dark.xml", "emits light", "--light or --sky"]),
        ("render black.xml", &["black.xml", "emits light"]),
        ("render empty.xml", &["empty.xml", "no shapes"]),
        ("render flat.xml", &["flat.xml: no primitive with finite vertices and an extent", "check its transforms"]),
        (
            "render flat-seen.xml",
            &["flat-seen.xml:3:2: to_world flattens", "flat-seen.xml: the scene has no primitive", "12 have no area"],
        ),
        (
            "check flat-seen.xml",
            &["flat-seen.xml:3:2: to_world flattens", "flat-seen.xml: the scene has no primitive", "12 have no area"],
        ),
        ("check flat.obj", &["flat.obj: the scene has no primitive", "2 have no area", "1 problem in flat.obj"]),
        ("check far.obj", &["far.obj: the scene has no primitive", "5 lie beyond", "scale is sane"]),
        ("render nan.xml", &["nan.xml:3:28: \"nan\" is not finite"]),
        ("render flat-sensor.xml", &["flat-sensor.xml:3:2: ", "to_world is singular", "leave out the scale of 0"]),
        ("render point.xml", &["point.xml:2:1: ", "radius 0"]),
        ("render line-light.xml", &["line-light.xml:2:21: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check line-light.xml", &["line-light.xml:2:21: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render nan-lamp.xml", &["nan-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check nan-lamp.xml", &["nan-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render no-lamp.xml", &["no-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("check no-lamp.xml", &["no-lamp.xml:3:3: ", "\"lamp\" emits, but has no area", "--light or --sky"]),
        ("render even.nrrd --iso 5", &["even.nrrd", "both sides of the iso value"]),
        ("render even.nrrd --iso nan", &["iso"]),
        ("render film-0.xml", &["film-0.xml:3:2: ", "width 0 should lie between 1 and 65535"]),
        ("render film-large.xml", &["film-large.xml:3:2: ", "width 100000 should lie between 1 and 65535"]),
        ("render t.obj --size 0x0", &["0x0", "--size"]),
        ("render t.obj --size 100000x100000", &["100000x100000", "--size"]),
        ("render ior.xml", &["ior.xml:3:2: ", "int_ior over ext_ior is 0; it should lie between 0.1 and 10"]),
        ("check ior.xml", &["ior.xml:3:2: "]),
        ("render albedo.xml", &["albedo.xml:3:2: ", "reflectance [2.0, 2.0, 2.0] should lie in [0, 1]"]),
        ("check albedo.xml", &["albedo.xml:3:2: "]),
        ("render factor.xml", &["factor.xml:4:3: ", "specular_reflectance [1.0, 1.0, -1.0] should lie in [0, 1]"]),
        ("render rough.xml", &["rough.xml:2:48: roughness [-1.0, -1.0] should lie in (0, 1]"]),
        ("render rough-nan.xml", &["rough-nan.xml:2:48: ", "\"nan\" is not finite"]),
    ]);

    // beside other light it is dark, and that is told
    for (name, place) in [("nan-lamp-lit", "3:3"), ("no-lamp-lit", "3:3"), ("flat-lamp-lit", "3:1")] {
        let told =
            format!("{name}.xml:{place}: shape \"lamp\" emits, but has no area that can be hit: it gives no light");
        for line in [format!("render {name}.xml --spp 1 --size 8x8"), format!("check {name}.xml")] {
            let run = bed.line(&line);
            assert!(run.code == 0 && run.err.contains(&told), "{line}: {}", run.err);
        }
    }

    // without a camera a scene is framed; what is unusable is skipped, counted and reported
    bed.write("some.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 2 5\n");
    bed.xml("plain.xml", &format!("<shape type='obj'><string name='filename' value='some.obj'/></shape>{LIT}"));
    let run = bed.line("check plain.xml");
    assert!(
        run.code == 0 && run.out.contains("camera       perspective"),
        "a camera is placed: {}{}",
        run.out,
        run.err
    );
    let run = bed.line("render plain.xml --spp 1 --size 8x8 --report r.json");
    assert_eq!(run.code, 0, "{}", run.err);
    // it sees the triangle, and what is around it
    let pixels = exr::prelude::read_first_rgba_layer_from_file(
        bed.path().join("plain.exr"),
        |_, _| vec![],
        |values: &mut Vec<f32>, _, (r, ..): (f32, f32, f32, f32)| values.push(r),
    );
    let pixels = pixels.unwrap().layer_data.channel_data.pixels;
    let sky = pixels.iter().filter(|v| **v == 1.0).count();
    assert!(pixels.len() == 64 && (8..=62).contains(&sky), "{sky} of {} pixels see the sky", pixels.len());
    let report: Value = serde_json::from_slice(&fs::read(bed.path().join("r.json")).unwrap()).unwrap();
    let counts = &report["prepare"]["counts"];
    let found = ["records", "triangles", "degenerate", "non_finite"].map(|key| counts[key].as_u64());
    assert_eq!(found, [3, 1, 1, 1].map(Some), "{counts}");
    assert_eq!(
        (report["skipped"]["degenerate"].as_u64(), report["skipped"]["non_finite"].as_u64()),
        (Some(1), Some(1))
    );
}

/// A camera inside of a wall is a black picture and no error: it is told, with the shape and what to do. So is any other black picture, and a shape that
/// its transform flattens. A picture is what its content says, whatever it is called.
#[test]
fn what_is_odd_is_told() {
    let bed = Bed::new();
    let sensor = "<sensor type='perspective'><transform name='to_world'><lookat origin='0, 0, 0' target='0, 0, 1' up='0, 1, 0'/>\
                  </transform></sensor>";
    let cube = |bsdf: &str| format!("{sensor}\n<shape type='cube' id='wall'>{bsdf}</shape>{LIT}");
    let away = "<shape type='rectangle'><transform name='to_world'><translate z='5'/></transform></shape>";
    bed.xml("wall.xml", &cube(""))
        .xml("room.xml", &cube("<bsdf type='twosided'><bsdf type='diffuse'/></bsdf>"))
        .xml("black.xml", &format!("{}{away}", cube("<bsdf type='diffuse'><rgb name='reflectance' value='0'/></bsdf><boolean name='flip_normals' value='true'/>")))
        .xml("flat.xml", &format!("<shape type='cube'/>\n<shape type='sphere'/><shape type='cube'>\n<transform name='to_world'><scale value='0'/></transform></shape>{LIT}"))
        .xml("sheet.xml", &format!("<shape type='rectangle'><transform name='to_world'><scale x='2' y='2' z='0'/></transform></shape>{LIT}"));
    let render = |name: &str| bed.line(&format!("render {name} --spp 1 --size 8x8"));
    let (run, checked) = (render("wall.xml"), bed.line("check wall.xml"));
    for run in [&run, &checked] {
        assert_eq!(run.code, 0, "{}", run.err);
        for part in ["wall.xml:3", "\"wall\"", "one-sided", "--camera", "twosided"] {
            assert!(run.err.contains(part), "no {part:?} in {}", run.err);
        }
    }
    assert!(run.err.contains("wall.exr is black") && checked.err.contains("warning: "), "{}{}", run.err, checked.err);
    let run = render("wall.xml --camera 0,0,5,0,0,0,0,1,0,40");
    assert!(run.code == 0 && run.err.is_empty(), "from outside: {}", run.err);
    let (run, checked) = (render("room.xml"), bed.line("check room.xml"));
    assert!(!run.err.contains("one-sided") && checked.err.is_empty(), "{}{}", run.err, checked.err);
    let (run, checked) = (render("black.xml"), bed.line("check black.xml"));
    assert!(run.code == 0 && run.err.contains("black.exr is black: no light reached the camera"), "{}", run.err);
    assert!(!run.err.contains("one-sided") && checked.err.is_empty(), "{}{}", run.err, checked.err);
    let (run, checked) = (render("flat.xml"), bed.line("check flat.xml"));
    for run in [&run, &checked] {
        assert!(
            run.code == 0 && run.err.contains("flat.xml:3:23: to_world flattens this shape \"cube\""),
            "{}",
            run.err
        );
    }
    let run = render("sheet.xml");
    assert!(run.code == 0 && run.err.is_empty(), "{}", run.err);

    let mut png = vec![];
    let mut encoder = png::Encoder::new(&mut png, 1, 1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&[255, 0, 0]).unwrap();
    let textured = "<shape type='cube'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'><string name='filename' value='red.jpg'/>\
                    </texture></bsdf></shape>";
    bed.write("red.jpg", png).xml("lying.xml", &format!("{textured}{LIT}"));
    let run = render("lying.xml");
    assert!(run.code == 0 && run.err.is_empty(), "a PNG named .jpg: {}", run.err);
}

/// Files that a scene must not read, and things that are no files.
#[test]
fn what_lies_outside_or_is_no_file() {
    let bed = Bed::new();
    bed.write("secret.obj", TRIANGLE).write("in/a.obj", TRIANGLE).write("secret.raw", [0; 8]);
    let mesh = |name: &str| format!("<shape type='obj'>\n<string name='filename' value='{name}'/></shape>{LIT}");
    let absolute = bed.path().join("secret.obj");
    symlink("../secret.obj", bed.path().join("in/link.obj")).unwrap();
    symlink("/dev/zero", bed.path().join("in/zero.xml")).unwrap();
    fs::create_dir(bed.path().join("in/folder.obj")).unwrap();
    let nhdr =
        |file: &str| format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: {file}\n\n");
    bed.xml("in/up.xml", &mesh("../secret.obj"))
        .xml("in/absolute.xml", &mesh(absolute.to_str().unwrap()))
        .xml("in/link.xml", &mesh("link.obj"))
        .xml("in/gone.xml", &mesh("gone.obj"))
        .xml("in/folder.xml", &mesh("folder.obj"))
        .xml("in/include.xml", "<include filename='../secret.obj'/>")
        .xml("in/device.xml", "<include filename='zero.xml'/>")
        .pipe("in/pipe.xml")
        .xml("in/piped.xml", "\n<include filename='pipe.xml'/>")
        .pipe("in/pipe.obj")
        .xml("in/piped-mesh.xml", &mesh("pipe.obj"))
        .pipe("in/pipe.png")
        .xml(
            "in/piped-texture.xml",
            &format!(
                "<shape type='cube'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'>\n\
                 <string name='filename' value='pipe.png'/></texture></bsdf></shape>{LIT}"
            ),
        )
        .xml(
            "in/piped-sky.xml",
            "<shape type='cube'/><emitter type='envmap'>\n<string name='filename' value='pipe.png'/></emitter>",
        )
        .write("in/up.nhdr", nhdr("../secret.raw"))
        .pipe("in/pipe.raw")
        .write("in/pipe.nhdr", nhdr("pipe.raw"));
    // a mesh's materials and maps
    bed.write("secret.mtl", "hunter2 is the password\n").write("secret.hdr", HDR);
    symlink("../secret.mtl", bed.path().join("in/link.mtl")).unwrap();
    symlink("../secret.hdr", bed.path().join("in/link.hdr")).unwrap();
    let [mtl, hdr] = ["secret.mtl", "secret.hdr"].map(|name| bed.path().join(name));
    let library = |name: &str, file: &str| {
        bed.write(&format!("in/{name}.obj"), format!("# a mesh\nmtllib {file}\n{TRIANGLE}"));
    };
    let map = |name: &str, file: &str| {
        bed.write(&format!("in/{name}.mtl"), format!("newmtl m\nmap_Kd {file}\n"));
        library(name, &format!("{name}.mtl"));
    };
    library("library-up", "../secret.mtl");
    library("library-absolute", mtl.to_str().unwrap());
    library("library-link", "link.mtl");
    library("library-back", "..\\secret.mtl");
    library("library-two", "none.mtl ../secret.mtl");
    map("map-up", "../secret.hdr");
    map("map-absolute", hdr.to_str().unwrap());
    map("map-link", "-clamp on link.hdr");
    // what lies inside may be named through a folder, by a link, and from a library in a folder
    bed.write("in/maps/m.hdr", HDR).write("in/parts/m.mtl", "newmtl m\nmap_Kd ../maps/link.hdr\n");
    symlink("m.hdr", bed.path().join("in/maps/link.hdr")).unwrap();
    library("inside", "parts/m.mtl");
    assert_eq!(bed.line("check in/inside.obj").code, 0);
    for line in ["library-up", "library-absolute", "library-link", "library-back", "library-two"] {
        for more in ["", " --substitute"] {
            let line = format!("check in/{line}.obj{more}");
            let run = bed.line(&line);
            assert_error(&line, &run, 2, &[".obj:2", "outside the scene's folder", "copy it there"]);
            assert!(!run.err.contains("hunter2"), "{}", run.err);
        }
    }
    // links among the meshes of a folder
    bed.write("linked/a.obj", TRIANGLE);
    symlink("a.obj", bed.path().join("linked/b.obj")).unwrap();
    assert_eq!(bed.line("check linked").code, 0);
    symlink("../secret.obj", bed.path().join("linked/c.obj")).unwrap();
    let outside = &["outside the scene's folder", "copy it there"][..];
    bed.mistakes(&[
        ("render in/up.xml", &[&["in/up.xml:3"], outside].concat()),
        ("render in/absolute.xml", &[&["in/absolute.xml:3"], outside].concat()),
        ("render in/link.xml", &[&["in/link.xml:3"], outside].concat()),
        ("render in/gone.xml", &["in/gone.xml:3", "mesh file \"gone.obj\" (there is no such file)"]),
        ("render in/folder.xml", &["folder.obj", "not a regular file"]),
        ("render in/include.xml", &[&["in/include.xml:2"], outside].concat()),
        ("render in/device.xml", &["in/device.xml:2", "outside"]),
        ("render in/piped.xml", &["pipe.xml", "not a regular file"]),
        ("render in/piped-mesh.xml", &["pipe.obj", "not a regular file"]),
        ("render in/piped-texture.xml", &["in/piped-texture.xml:", "pipe.png", "not a regular file"]),
        ("render in/piped-sky.xml", &["pipe.png", "not a regular file"]),
        ("render in/up.nhdr --iso 1", &["up.nhdr:6", "outside"]),
        ("render in/map-up.obj", &[&["in/map-up.mtl:2"], outside].concat()),
        ("render in/map-absolute.obj", &[&["in/map-absolute.mtl:2"], outside].concat()),
        ("render in/map-link.obj", &[&["in/map-link.mtl:2"], outside].concat()),
        ("render linked", &[&["linked/c.obj"], outside].concat()),
        ("render in/pipe.nhdr --iso 1", &["pipe.raw", "not a file"]),
        ("render in/pipe.xml", &["pipe.xml", "not a regular file"]),
        ("check in/pipe.obj", &["pipe.obj", "not a regular file"]),
        ("render /dev/zero", &["/dev/zero", "not a regular file"]),
        ("compare in/pipe.xml in/pipe.xml", &["pipe.xml", "no regular file"]),
        ("compare /dev/zero /dev/zero", &["/dev/zero", "no regular file"]),
        ("render -f /dev/zero", &["/dev/zero", "4194304 bytes", "no job file"]),
        ("render -f in", &["cannot read in"]),
    ]);
    let huge = File::create(bed.path().join("huge.exr")).unwrap();
    if huge.set_len(1 << 42).is_ok() {
        bed.mistakes(&[("compare huge.exr huge.exr", &["huge.exr", "memory"])]);
    } else {
        println!("this file system has no files of 4 TiB: comparing one is not tested");
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

/// What cannot be written or held.
#[test]
fn outputs_and_memory() {
    let bed = Bed::new();
    bed.write("t.obj", TRIANGLE).write("file", "");
    let render = "render t.obj --spp 1 --size 8x8 --sky 1";
    bed.mistakes(&[
        (&format!("{render} -o none/a.exr"), &["cannot write none/a.exr", "-o"]),
        (&format!("{render} -o file/a.exr"), &["cannot write file/a.exr", "-o"]),
        (&format!("{render} -o /proc/a.exr"), &["cannot write /proc/a.exr", "-o"]),
        (&format!("{render} --report none/r.json"), &["cannot write none/r.json"]),
        (&format!("{render} --store file"), &["file"]),
        ("prepare t.obj --store file/s", &["file/s"]),
        (&format!("{render} --memory 100"), &["100 bytes", "largest split takes", "--memory"]),
        (&format!("{render} --memory 0"), &["--memory is 0"]),
    ]);
    // what it takes is said, is enough, and a byte less is not
    let told = bed.line(&format!("{render} --memory 100")).err;
    let needed = told.split("largest split takes ").nth(1).and_then(|t| t.split(';').next()).unwrap();
    let needed: u64 = needed.parse().unwrap_or_else(|_| panic!("{needed:?} in {told}"));
    assert_eq!(bed.line(&format!("{render} --memory {needed}")).code, 0);
    assert_eq!(bed.line(&format!("{render} --memory {}", needed - 1)).code, 2);

    if !Path::new("/dev/full").exists() {
        println!("this system has no /dev/full: full output is not tested");
        return;
    }
    // nothing rendered is lost
    assert_eq!(bed.line(&format!("{render} -o good.exr")).code, 0);
    symlink("/dev/full", bed.path().join("full.exr")).unwrap();
    let run = bed.line(&format!("{render} -o full.exr"));
    assert_error("full", &run, 1, &["cannot write full.exr", "No space left", "it was written to ./full.exr."]);
    let kept = run.err.split("written to ").nth(1).unwrap().split(' ').next().unwrap();
    assert_eq!(fs::read(bed.path().join(kept)).unwrap(), fs::read(bed.path().join("good.exr")).unwrap());
    assert!(fs::metadata("/dev/full").is_ok_and(|m| !m.is_file()));
    let code = Command::new("sh")
        .args(["-c", "exec \"$0\" check t.obj > /dev/full", env!("CARGO_BIN_EXE_rayherd")])
        .current_dir(bed.path())
        .output()
        .unwrap();
    let err = String::from_utf8(code.stderr).unwrap();
    assert_eq!(code.status.code(), Some(1), "{err}");
    assert!(err.contains("standard output") && err.contains("No space left"), "{err}");
}

/// A job file's mistakes are told by line or field.
#[test]
fn job_files() {
    let bed = Bed::new();
    let cornell = repository("examples/cornell-box.xml");
    let job = format!(
        "apiVersion: rayherd.io/v1alpha1\nkind: RenderJob\nspec:\n  scene: {{source: {}}}\n",
        cornell.display()
    );
    bed.write("good.yaml", format!("{job}  image: {{size: 8x8, output: good.exr}}\n  sampling: {{spp: 1}}\n"));
    assert_eq!(bed.line("render -f good.yaml").code, 0);
    bed.write("noise.yaml", noise(3000))
        .write("empty.yaml", "")
        .write("cut.yaml", "apiVersion: rayherd.io/v1alpha1\nkind: RenderJob\nspec:\n  scene: {source")
        .write("kind.yaml", job.replace("RenderJob", "Pod"))
        .write("twice.yaml", format!("{job}  strategy: Auto\n  strategy: Auto\n"))
        .write("gone.yaml", job.replace("cornell-box", "gone"))
        .write("list.yaml", "- 1\n- 2\n")
        .write("long.yaml", format!("{job}# {}\n", "x".repeat(5 << 20)));
    bed.mistakes(&[
        ("render -f noise.yaml", &["noise.yaml"]),
        ("render -f empty.yaml", &["empty.yaml"]),
        ("render -f cut.yaml", &["cut.yaml", "line 4"]),
        ("render -f kind.yaml", &["kind.yaml", "kind"]),
        ("render -f twice.yaml", &["twice.yaml", "strategy"]),
        ("render -f gone.yaml", &["gone.xml", "No such file"]),
        ("render -f list.yaml", &["list.yaml"]),
        ("render -f long.yaml", &["long.yaml", "no job file"]),
    ]);
}
