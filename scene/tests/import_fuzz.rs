//! Seeded mutations of small files, for every parser of `import`: whatever a file holds, reading it ends in records or in an
//! error, without a panic, in bounded time and memory.
//!
//! 1,500 mutations a format in `cargo test`, 300 of materials and skies; `rayherd_tests::mutation` says how to run more, or one again.

use std::path::Path;

use rayherd_scene::ImportError;
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, Survey, import, sky_map};
use rayherd_scene::record::RecordSource;
use rayherd_tests::mutation;

/// Words of the formats.
const WORDS: &[&str] = &[
    "&lt;",
    "<a/>",
    "vertex",
    "face",
    "list",
    "uchar",
    "float",
    "double",
    "end_header",
    "element face 9",
    "property list uint uint vertex_indices",
    "endloop",
    "facet",
    "solid",
    "f 1 2 3",
    "usemtl red",
    "mtllib a.mtl",
    "property uchar green",
    "v 1 1 1",
    "/dev/zero",
    "../a",
    "include",
    "ref",
    "id=\"m\"",
    "type=\"cube\"",
];

/// Reads a file to its end. No file here has more than a few hundred bytes, so none has more than a few thousand primitives.
fn read(path: &Path, substitute: bool) -> Result<usize, ImportError> {
    let options = ImportOptions { substitute, ..ImportOptions::default() };
    let description = import(path, &options)?;
    sky_map(description.environment.as_ref())?;
    // textures, and what the camera sees
    Survey::of(&description);
    let stream_options = StreamOptions { vertex_budget: 1 << 16, spill_limit: 1 << 20, ..StreamOptions::default() };
    let source = DescriptionSource::new(&description, stream_options);
    let mut stream = source.open()?;
    let (mut records, mut n) = (vec![], 0);
    loop {
        records.clear();
        match stream.next(&mut records, 64)? {
            0 => return Ok(n),
            k => n += k,
        }
        assert!(n < 100_000, "a small file has no end");
    }
}

fn fuzz(name: &str, least: u64, seeds: &[Vec<u8>], beside: &[(&str, Vec<u8>)]) {
    let dir = tempfile::tempdir().unwrap();
    for (name, content) in beside {
        std::fs::write(dir.path().join(name), content).unwrap();
    }
    let path = dir.path().join(name);
    for original in seeds {
        std::fs::write(&path, original).unwrap();
        assert!(read(&path, true).unwrap() > 0, "the seeds themselves are read");
    }
    let before = mutation::peak_memory();
    let (mut good, mut bad) = (0, 0);
    let rounds = mutation::rounds(name, least, |random| {
        let original = &seeds[random.below(seeds.len())];
        std::fs::write(&path, mutation::text(original, WORDS, random)).unwrap();
        match read(&path, random.below(2) == 0) {
            Ok(_) => good += 1,
            Err(e) => {
                bad += 1;
                let message = e.to_string();
                assert!(!message.is_empty() && message.len() < 100_000);
            }
        }
    });
    println!("{name}: {good} read, {bad} refused");
    assert!(rounds.is_none() || (good > 0 && bad > 0), "mutations are neither harmless nor hopeless");
    if let (Some(before), Some(after)) = (before, mutation::peak_memory()) {
        let more = after.saturating_sub(before);
        assert!(more < 256 << 10, "reading small files took {} MiB more", more >> 10);
    }
}

const PLY: &str = "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty \
                   uchar red\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0 1\n1 0 0 2\n0 2 0 3\n0 0 3 4\n3 0 \
                   1 2\n4 0 1 2 3\n";

/// [`PLY`] in binary.
fn binary_ply(big: bool) -> Vec<u8> {
    let name = if big { "binary_big_endian" } else { "binary_little_endian" };
    let (header, _) = PLY.split_at(PLY.find("0 0 0 1").unwrap());
    let mut bytes = header.replace("ascii", name).into_bytes();
    let word = |x: [u8; 4]| if big { [x[3], x[2], x[1], x[0]] } else { x };
    for (p, red) in [([0f32, 0.0, 0.0], 1), ([1.0, 0.0, 0.0], 2), ([0.0, 2.0, 0.0], 3), ([0.0, 0.0, 3.0], 4)] {
        p.iter().for_each(|x| bytes.extend(word(x.to_le_bytes())));
        bytes.push(red);
    }
    for face in [&[0i32, 1, 2][..], &[0, 1, 2, 3]] {
        bytes.push(face.len() as u8);
        face.iter().for_each(|i| bytes.extend(word(i.to_le_bytes())));
    }
    bytes
}

#[test]
fn ply() {
    // colours of vertices, and of faces
    let bytes = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let colored = format!(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{bytes}element face 1\n\
         property list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 0 0 2 3 4\n0 2 0 3 4 5\n3 0 1 2\n"
    );
    let faces = format!(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n\
         property list uchar int vertex_indices\n{bytes}end_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2 7 8 9\n3 2 1 0 1 2 3\n"
    );
    fuzz("a.ply", 1500, &[PLY.into(), binary_ply(false), binary_ply(true), colored.into(), faces.into()], &[]);
}

#[test]
fn packed() {
    use std::io::Write;
    let mut packer = flate2::write::GzEncoder::new(vec![], flate2::Compression::default());
    packer.write_all(PLY.as_bytes()).unwrap();
    fuzz("a.ply.gz", 1500, &[packer.finish().unwrap()], &[]);
}

#[test]
fn obj() {
    let text = "mtllib a.mtl\no a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.5 0.5\nvn 0 0 1\nusemtl red\nf 1 2 3 4\nusemtl blue\nf -4/1 -3/1 \\\n-2/1\n\
                f 1//1 2//1 3//1\nf 1/1/1 2/1/1 4/1/1\n";
    fuzz("a.obj", 1500, &[text.into()], &[("a.mtl", b"newmtl red\nKd 1 0 0\nKe 1 1 1\nnewmtl blue\nillum 7\n".into())]);
}

#[test]
fn stl() {
    let text = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n";
    let mut binary = vec![b'x'; 80];
    binary.extend(2u32.to_le_bytes());
    for i in 0..2u8 {
        (0..12).for_each(|k| binary.extend(f32::from(i * 7 + k % 5).to_le_bytes()));
        binary.extend([0, 0]);
    }
    fuzz("a.stl", 1500, &[text.into(), binary], &[]);
}

/// Four texels.
fn exr() -> Vec<u8> {
    use exr::prelude::WritableImage;
    let channels = exr::prelude::SpecificChannels::rgb(|at: exr::math::Vec2<usize>| (at.0 as f32, at.1 as f32, 1f32));
    let mut bytes = std::io::Cursor::new(vec![]);
    exr::prelude::Image::from_channels((2, 2), channels).write().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

/// Four texels, grey.
fn png() -> Vec<u8> {
    let mut bytes = vec![];
    let mut encoder = png::Encoder::new(&mut bytes, 2, 2);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().unwrap().write_image_data(&[0, 80, 160, 255]).unwrap();
    bytes
}

/// A triangle of version 4, in single precision, with texture coordinates.
fn serialized() -> Vec<u8> {
    use std::io::Write;
    let mut packer = flate2::write::ZlibEncoder::new(vec![], flate2::Compression::default());
    let mut data = 0x1002u32.to_le_bytes().to_vec();
    data.extend(b"a\0");
    data.extend([3u64, 1].iter().flat_map(|n| n.to_le_bytes()));
    data.extend(
        [0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
            .iter()
            .flat_map(|x| x.to_le_bytes()),
    );
    data.extend([0u32, 1, 2].iter().flat_map(|i| i.to_le_bytes()));
    packer.write_all(&data).unwrap();
    let mut out = [0x1c, 4, 4, 0].to_vec();
    out.extend(packer.finish().unwrap());
    out.extend(0u64.to_le_bytes());
    out.extend(1u32.to_le_bytes());
    out
}

#[test]
fn mitsuba() {
    let text = r##"<scene version="3.0.0"><default name="x" value="0.5"/>
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
<sensor type="perspective"><float name="fov" value="40"/><transform name="toWorld"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="32"/><rfilter type="tent"/></film></sensor>
<bsdf type="twosided" id="m"><bsdf type="roughconductor"><float name="alpha" value="$x"/><rgb name="eta" value="1, 2, 3"/></bsdf></bsdf>
<include filename="part.xml"/>
<shape type="sphere"><point name="center" value="1 2 3"/><float name="radius" value="2"/><ref id="m"/></shape>
<shape type="cube"><transform name="to_world"><matrix value="1 0 0 1 0 2 0 1 0 0 3 1 0 0 0 1"/><rotate x="1" angle="20"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="#102030"/></bsdf></shape>
<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>
<shape type="ply"><string name="filename" value="a.ply"/></shape>
<shape type="ply"><string name="filename" value="b.ply"/><bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance">
<string name="name" value="vertex_heat"/><float name="scale" value="0.5"/></texture></bsdf></shape></scene>"##;
    let part = r#"<scene><alias id="m" as="n"/><shape type="ply"><string name="filename" value="a.ply"/><ref id="n"/></shape></scene>"#;
    // lights, sensors and shapes that are laid out
    let more = r#"<scene version="3.0.0"><integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>
<sensor type="thinlens"><float name="fov" value="40"/><float name="apertureRadius" value="0.1"/><float name="focusDistance" value="3"/>
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="32"/><integer name="cropOffsetX" value="3"/>
<integer name="cropWidth" value="9"/></film></sensor>
<emitter type="envmap"><string name="filename" value="sky.hdr"/><float name="scale" value="2"/>
<transform name="toWorld"><rotate y="1" angle="30"/></transform></emitter>
<emitter type="point"><point name="position" x="1" y="2" z="3"/><rgb name="intensity" value="1, 2, 3"/></emitter>
<emitter type="spot"><transform name="to_world"><lookat origin="0,5,0" target="0,0,0" up="1,0,0"/></transform>
<float name="cutoffAngle" value="30"/><float name="beamWidth" value="10"/>
<texture type="checkerboard" name="texture"><rgb name="color0" value="2, 0, 1"/></texture></emitter>
<emitter type="directional"><vector name="direction" x="0" y="-1" z="0.5"/><float name="irradiance" value="2"/></emitter>
<shape type="shapegroup" id="g"><shape type="sphere"/><shape type="ply"><string name="filename" value="a.ply"/></shape></shape>
<shape type="instance"><ref id="g"/><transform name="to_world"><translate x="4"/></transform></shape>
<shape type="instance"><ref id="g"/></shape><shape type="disk"/>
<shape type="cylinder"><point name="p0" value="0 0 1"/><point name="p1" value="0 2 1"/><float name="radius" value="0.5"/></shape></scene>"#;
    fuzz("a.xml", 1500, &[text.into(), more.into()], &beside(part));
}

/// Every material and texture, layers; the sky by its model, and by a picture in the other format. Fewer, as a sky and what light a rough coat lets
/// through are computed each time.
#[test]
fn mitsuba_materials_and_skies() {
    let rest = r#"<scene version="3.0.0"><integrator type="aov"><string name="aovs" value="dd.y:depth, n:sh_normal"/><integrator type="path">
<integer name="max_depth" value="-1"/></integrator></integrator>
<sensor type="orthographic"><transform name="to_world"><scale x="3" y="3"/><translate z="-5"/></transform><float name="near_clip" value="1"/>
<sampler type="independent"><integer name="sample_count" value="4"/></sampler></sensor><emitter type="constant"/>
<texture type="bitmap" id="t"><string name="filename" value="a.png"/><string name="wrap_mode" value="mirror"/><boolean name="raw" value="true"/>
<string name="filter_type" value="nearest"/><transform name="to_uv"><scale x="2" y="3"/></transform></texture>
<bsdf type="blendbsdf" id="b"><float name="weight" value="0.3"/><bsdf type="phong"><float name="exponent" value="9"/></bsdf>
<bsdf type="dielectric"><string name="int_ior" value="bk7"/></bsdf></bsdf><alias id="b" as="c"/><alias id="c" as="d"/>
<bsdf type="twosided" id="e"><bsdf type="bumpmap"><ref id="t"/><float name="scale" value="0.1"/><bsdf type="roughplastic">
<float name="alpha" value="0.2"/><ref id="t" name="diffuse_reflectance"/></bsdf></bsdf><bsdf type="normalmap"><ref id="t"/>
<bsdf type="conductor"><string name="material" value="Au"/></bsdf></bsdf></bsdf>
<bsdf type="mask" id="f"><ref id="t" name="opacity"/><bsdf type="principled"><rgb name="base_color" value="0.1 0.2 0.3"/><float name="roughness" value="0.4"/>
<float name="spec_trans" value="0.5"/><float name="clearcoat" value="1"/><float name="eta" value="1.4"/></bsdf></bsdf>
<shape type="cube"><ref id="d"/></shape><shape type="serialized"><string name="filename" value="a.serialized"/><integer name="shape_index" value="0"/>
<ref id="e"/></shape><shape type="sphere"><ref id="f"/></shape><shape type="rectangle"><bsdf type="roughdielectric"><string name="distribution"
value="ggx"/><float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.2"/></bsdf></shape>
<shape type="disk"><bsdf type="null"/></shape><shape type="cube"><bsdf type="thindielectric"/></shape>
<shape type="cube"><bsdf type="plastic"><boolean name="nonlinear" value="true"/></bsdf></shape></scene>"#;
    let sunsky = r#"<scene version="3.0.0"><emitter type="sunsky"><float name="turbidity" value="4"/>
<vector name="sun_direction" x="0.1" y="0.2" z="0.9"/></emitter><sensor type="perspective"/><shape type="cube"/></scene>"#;
    let envmap = "<scene version=\"0.6.0\"><sensor type=\"perspective\"/><shape type=\"cube\"><bsdf type=\"roughconductor\"><spectrum name=\"eta\" \
                  value=\"1.5\"/><string name=\"material\" value=\"Cu\"/></bsdf></shape><emitter type=\"envmap\"><string name=\"filename\" \
                  value=\"sky.exr\"/></emitter></scene>";
    fuzz("b.xml", 300, &[rest.into(), sunsky.into(), envmap.into()], &beside(""));
}

/// What scenes name: their files, and another XML.
fn beside(part: &str) -> Vec<(&'static str, Vec<u8>)> {
    let sky = "#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 2\nabc\u{7f}def\u{7f}ghi\u{7f}jkl\u{7f}";
    vec![
        ("part.xml", part.into()),
        ("a.ply", PLY.into()),
        ("b.ply", PLY.replace("uchar red", "float heat_x").into()),
        ("sky.hdr", sky.into()),
        ("sky.exr", exr()),
        ("a.png", png()),
        ("a.serialized", serialized()),
    ]
}
