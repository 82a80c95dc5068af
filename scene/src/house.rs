//! A house of any size, textured, in badly ordered files: Mitsuba XML (version 3), an OBJ file for each material, MTL, PNG textures.
//!
//! The house stays as large as it is; what grows is how finely its surfaces are cut. Neighbours in a file lie far apart in the scene, so that every
//! split of it spans the house, as in files that grew over years.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::import::vector::{add_scaled, cross, dot, normalize, sub};
use crate::tools::ToolError;

/// Most squares along a metre: some 83 million triangles.
pub const MOST_PER_METRE: u32 = 256;

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct House {
    /// Triangles in all meshes.
    pub triangles: u64,
    /// Bytes of all files.
    pub bytes: u64,
}

/// Writes the house into a folder, which is made, with `per_metre` (1 to [`MOST_PER_METRE`]) squares along a metre of its walls. The same every time.
///
/// # Errors
/// A file cannot be written.
pub fn house(per_metre: u32, folder: &Path) -> Result<House, ToolError> {
    let per_metre = per_metre.clamp(1, MOST_PER_METRE);
    let mut out = House::default();
    let failed = |path: PathBuf| move |source| ToolError::Write { path, source };
    fs::create_dir_all(folder).map_err(failed(folder.into()))?;
    let mut put = |name: &str, bytes: &[u8]| {
        let path = folder.join(name);
        fs::write(&path, bytes).map_err(failed(path))?;
        out.bytes += bytes.len() as u64;
        Ok::<(), ToolError>(())
    };
    let (mut shapes, mut library) = (String::new(), String::from("# made by `rayherd scene house`\n"));
    for material in MATERIALS {
        if let Some(texture) = material.texture {
            put(&format!("{}.png", material.name), &picture(texture).map_err(failed(folder.join(material.name)))?)?;
        }
        shapes += &material.shape();
        library += &material.library();
    }
    put("house.xml", format!("{HEAD}{shapes}</scene>\n").as_bytes())?;
    put("house.mtl", library.as_bytes())?;
    let patches = patches();
    for material in MATERIALS {
        let path = folder.join(format!("{}.obj", material.name));
        let mine: Vec<&Patch> = patches.iter().filter(|p| p.material == material.name).collect();
        let (squares, bytes) = mesh(&path, material.name, &mine, per_metre).map_err(failed(path.clone()))?;
        out.triangles += 2 * squares;
        out.bytes += bytes;
    }
    Ok(out)
}

/// Four corners of a surface, in the order of a polygon seen from its front; cut into squares.
struct Patch {
    material: &'static str,
    corners: [[f64; 3]; 4],
    /// Share of the squares along a metre that it gets.
    detail: f64,
}

impl Patch {
    /// Squares along its first and its second side.
    fn squares(&self, per_metre: u32) -> [u64; 2] {
        let [a, b, _, d] = self.corners;
        [sub(b, a), sub(d, a)].map(|side| {
            let n = (dot(side, side).sqrt() * f64::from(per_metre) * self.detail).ceil();
            (n as u64).max(1)
        })
    }

    /// A point and its texture coordinates, which are metres along the first side and at right angles to it.
    fn point(&self, s: f64, t: f64) -> ([f64; 3], [f64; 2]) {
        let [a, b, c, d] = self.corners;
        let below = add_scaled(a, s, sub(b, a));
        let above = add_scaled(d, s, sub(c, d));
        let p = add_scaled(below, t, sub(above, below));
        let along = normalize(sub(b, a)).unwrap_or([1.0, 0.0, 0.0]);
        let normal = normalize(cross(sub(b, a), sub(d, a))).unwrap_or([0.0, 1.0, 0.0]);
        let (u, v) = (dot(sub(p, a), along), dot(sub(p, a), cross(normal, along)));
        // tiles of the roof are round
        let raise = if self.material == "roof" { 0.03 * libm::sin(u * 12.0).abs() * t * (1.0 - t) * 4.0 } else { 0.0 };
        (add_scaled(p, raise, normal), [u, v])
    }
}

/// Writes the squares of patches, far ones beside each other; how many there are, and bytes.
fn mesh(path: &Path, material: &str, patches: &[&Patch], per_metre: u32) -> io::Result<(u64, u64)> {
    let mut ends = vec![];
    for patch in patches {
        let [across, up] = patch.squares(per_metre);
        ends.push(ends.last().copied().unwrap_or(0) + across * up);
    }
    let total = ends.last().copied().unwrap_or(0);
    let mut out = BufWriter::new(File::create(path)?);
    let mut bytes = 0;
    let mut text = format!("mtllib house.mtl\nusemtl {material}\n");
    let step = step(total);
    let mut at = 0;
    for done in 0..total {
        let number = ends.partition_point(|&end| end <= at);
        let patch = patches[number];
        let first = if number == 0 { 0 } else { ends[number - 1] };
        let [across, up] = patch.squares(per_metre);
        let (i, j) = ((at - first) % across, (at - first) / across);
        for (x, y) in [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)] {
            let ([px, py, pz], [u, v]) = patch.point(x as f64 / across as f64, y as f64 / up as f64);
            // writing to a string cannot fail
            let _ = writeln!(text, "v {px:.6} {py:.6} {pz:.6}\nvt {u:.5} {v:.5}");
        }
        // counted from the first: Mitsuba reads no others
        let [a, b, c, d] = [1, 2, 3, 4].map(|k| 4 * done + k);
        let _ = writeln!(text, "f {a}/{a} {b}/{b} {c}/{c} {d}/{d}");
        if text.len() > 1 << 16 {
            bytes += text.len() as u64;
            out.write_all(text.as_bytes())?;
            text.clear();
        }
        at = (at + step) % total;
    }
    bytes += text.len() as u64;
    out.write_all(text.as_bytes())?;
    out.flush()?;
    Ok((total, bytes))
}

/// A step through `n` things that meets each once: near n over the golden ratio, and without a common divisor.
fn step(n: u64) -> u64 {
    let gcd = |mut a: u64, mut b: u64| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let start = (n as f64 * 0.618_033_988_75) as u64;
    (start.max(1)..).find(|&s| gcd(s, n.max(1)) == 1).unwrap_or(1)
}

/// A rectangle from a corner along two sides.
fn sheet(material: &'static str, corner: [f64; 3], a: [f64; 3], b: [f64; 3]) -> Patch {
    let beside = add_scaled(corner, 1.0, a);
    let corners = [corner, beside, add_scaled(beside, 1.0, b), add_scaled(corner, 1.0, b)];
    Patch { material, corners, detail: 1.0 }
}

/// A wall from a corner along a level side, with openings (from, to, below, above) in metres, sorted by where they begin.
fn wall(
    out: &mut Vec<Patch>,
    material: &'static str,
    corner: [f64; 3],
    along: [f64; 3],
    height: f64,
    openings: &[[f64; 4]],
) {
    let length = dot(along, along).sqrt();
    let mut piece = |from: f64, to: f64, below: f64, above: f64| {
        if to > from && above > below {
            let mut corner = add_scaled(corner, from / length, along);
            corner[1] += below;
            out.push(sheet(material, corner, along.map(|x| x * (to - from) / length), [0.0, above - below, 0.0]));
        }
    };
    let mut at = 0.0;
    for &[from, to, below, above] in openings {
        piece(at, from, 0.0, height);
        piece(from, to, 0.0, below);
        piece(from, to, above, height);
        at = to;
    }
    piece(at, length, 0.0, height);
}

/// Six faces.
fn block(out: &mut Vec<Patch>, material: &'static str, lo: [f64; 3], hi: [f64; 3]) {
    let [x, y, z] = sub(hi, lo);
    let (x, y, z) = ([x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]);
    let minus = |v: [f64; 3]| v.map(|c| -c);
    out.extend([(y, x), (z, y), (x, z)].map(|(a, b)| sheet(material, lo, a, b)));
    out.extend([(x, y), (y, z), (z, x)].map(|(a, b)| sheet(material, hi, minus(a), minus(b))));
}

/// Every surface: a house of 10 x 8 metres with its front towards +z, on a lawn.
fn patches() -> Vec<Patch> {
    let mut out = vec![];
    let (w, d, h, ridge) = (5.0, 4.0, 3.0, 5.2);
    out.push(Patch { detail: 0.25, ..sheet("grass", [-20.0, 0.0, 20.0], [40.0, 0.0, 0.0], [0.0, 0.0, -40.0]) });
    let (door, window) = ([4.4, 5.6, 0.0, 2.2], |at: f64| [at, at + 1.6, 0.9, 2.2]);
    wall(&mut out, "brick", [-w, 0.0, d], [2.0 * w, 0.0, 0.0], h, &[window(1.2), door, window(7.2)]);
    wall(&mut out, "brick", [w, 0.0, d], [0.0, 0.0, -2.0 * d], h, &[window(3.2)]);
    wall(&mut out, "brick", [w, 0.0, -d], [-2.0 * w, 0.0, 0.0], h, &[window(1.2), window(7.2)]);
    wall(&mut out, "brick", [-w, 0.0, -d], [0.0, 0.0, 2.0 * d], h, &[]);
    // gables: polygons of which two corners are one
    for x in [w, -w] {
        let (front, back) = if x > 0.0 { (d, -d) } else { (-d, d) };
        let top = [x, ridge, 0.0];
        out.push(Patch { material: "brick", corners: [[x, h, front], [x, h, back], top, top], detail: 1.0 });
    }
    // the roof reaches over the walls by half a metre
    let (over, drop) = (d + 0.5, h - 0.5 * (ridge - h) / d);
    let eaves = |z: f64, x: f64| [x, drop + 0.02, z];
    let top = |x: f64| [x, ridge + 0.02, 0.0];
    let (left, right) = (-w - 0.4, w + 0.4);
    out.push(Patch {
        material: "roof",
        corners: [eaves(over, left), eaves(over, right), top(right), top(left)],
        detail: 1.0,
    });
    out.push(Patch {
        material: "roof",
        corners: [eaves(-over, right), eaves(-over, left), top(left), top(right)],
        detail: 1.0,
    });
    block(&mut out, "brick", [2.6, 3.6, -1.4], [3.3, 5.9, -0.7]);
    out.push(sheet("wood", [-w, 0.01, d], [2.0 * w, 0.0, 0.0], [0.0, 0.0, -2.0 * d]));
    out.push(sheet("plaster", [-w, h, -d], [2.0 * w, 0.0, 0.0], [0.0, 0.0, 2.0 * d]));
    wall(&mut out, "plaster", [1.0, 0.0, d], [0.0, 0.0, -2.0 * d], h, &[[3.0, 4.1, 0.0, 2.1]]);
    // a door that stands open, a path, a table, a bench
    out.push(sheet("wood", [-0.6, 0.02, d], [-0.4, 0.0, 1.1], [0.0, 2.15, 0.0]));
    block(&mut out, "plaster", [-0.8, -0.1, d], [0.8, 0.04, d + 5.0]);
    block(&mut out, "wood", [-3.6, 0.72, -1.0], [-1.6, 0.78, 0.4]);
    for (x, z) in [(-3.5, -0.9), (-1.8, -0.9), (-3.5, 0.2), (-1.8, 0.2)] {
        block(&mut out, "wood", [x, 0.0, z], [x + 0.1, 0.72, z + 0.1]);
    }
    block(&mut out, "wood", [2.4, 0.4, d + 0.5], [4.2, 0.46, d + 0.9]);
    for x in [2.5, 4.0] {
        block(&mut out, "wood", [x, 0.0, d + 0.55], [x + 0.1, 0.4, d + 0.85]);
    }
    // a fence
    for k in 0..33 {
        let x = f64::from(k) * 0.5 - 8.0;
        if !(-1.2..=1.2).contains(&x) {
            block(&mut out, "wood", [x, 0.0, 10.0], [x + 0.12, 0.9, 10.04]);
        }
    }
    for (from, to) in [(-8.0, -1.3), (1.4, 8.1)] {
        block(&mut out, "wood", [from, 0.6, 9.96], [to, 0.68, 10.0]);
    }
    // panes
    for x in [1.2, 7.2] {
        out.push(sheet("glass", [x - w, 0.9, d - 0.02], [1.6, 0.0, 0.0], [0.0, 1.3, 0.0]));
        out.push(sheet("glass", [w - x, 0.9, 0.02 - d], [-1.6, 0.0, 0.0], [0.0, 1.3, 0.0]));
    }
    out.push(sheet("glass", [w - 0.02, 0.9, d - 3.2], [0.0, 0.0, -1.6], [0.0, 1.3, 0.0]));
    out
}

/// A pattern: its texel at (x, y) of 128 x 128, y upwards.
type Texture = fn(u32, u32) -> [u8; 3];

struct Look {
    name: &'static str,
    texture: Option<Texture>,
    /// Metres that a texture covers.
    metres: f64,
    /// Inside of the bsdf, in the place of TEXTURE the texture.
    bsdf: &'static str,
    /// Of the material in MTL, but for its map.
    mtl: &'static str,
}

const MATERIALS: &[Look] = &[
    Look {
        name: "brick",
        texture: Some(|x, y| {
            let (row, shift) = (y / 16, (y / 16 % 2) * 16);
            let (column, in_x, in_y) = ((x + shift) / 32, (x + shift) % 32, y % 16);
            if in_x < 2 || in_y < 2 {
                return shade([170, 165, 155], noise(x, y, 3), 20);
            }
            shade([150, 70, 50], (noise(row, column % 4, 1) + noise(x, y, 2)) / 2, 70)
        }),
        metres: 1.0,
        bsdf: r#"<bsdf type="twosided"><bsdf type="diffuse">TEXTURE</bsdf></bsdf>"#,
        mtl: "illum 1\nKd 1 1 1\n",
    },
    Look {
        name: "roof",
        texture: Some(|x, y| {
            shade([120, 55, 40], (noise(x / 16, y / 16, 4) + noise(x, y, 5)) / 2, (y % 16) as i32 * 4 + 20)
        }),
        metres: 2.0,
        bsdf: r#"<bsdf type="twosided"><bsdf type="diffuse">TEXTURE</bsdf></bsdf>"#,
        mtl: "illum 1\nKd 1 1 1\n",
    },
    Look {
        name: "wood",
        texture: Some(|x, y| {
            if y % 32 == 0 {
                return [50, 32, 18];
            }
            shade([140, 95, 55], (noise(y / 32, 0, 6) + noise(x / 24, y, 7)) / 2, 60)
        }),
        metres: 0.8,
        bsdf: r#"<bsdf type="twosided"><bsdf type="roughplastic"><float name="alpha" value="0.2"/>TEXTURE</bsdf></bsdf>"#,
        mtl: "illum 2\nKd 0.9 0.9 0.9\nKs 0.04 0.04 0.04\nNs 60\n",
    },
    Look {
        name: "plaster",
        texture: None,
        metres: 1.0,
        bsdf: r#"<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.75, 0.73, 0.68"/></bsdf></bsdf>"#,
        mtl: "illum 1\nKd 0.75 0.73 0.68\n",
    },
    Look {
        name: "grass",
        texture: Some(|x, y| shade([70, 110, 40], (noise(x, y, 8) + noise(x / 8, y / 8, 9)) / 2, 60)),
        metres: 3.0,
        bsdf: r#"<bsdf type="twosided"><bsdf type="diffuse">TEXTURE</bsdf></bsdf>"#,
        mtl: "illum 1\nKd 1 1 1\n",
    },
    Look {
        name: "glass",
        texture: None,
        metres: 1.0,
        bsdf: r#"<bsdf type="thindielectric"/>"#,
        mtl: "illum 1\nKd 0.1 0.1 0.1\nd 0.1\n",
    },
];

impl Look {
    fn shape(&self) -> String {
        let parameter = if self.name == "wood" { "diffuse_reflectance" } else { "reflectance" };
        let (name, scale) = (self.name, 1.0 / self.metres);
        let texture = format!(
            "<texture type=\"bitmap\" name=\"{parameter}\"><string name=\"filename\" value=\"{name}.png\"/>\
             <transform name=\"to_uv\"><scale x=\"{scale}\" y=\"{scale}\"/></transform></texture>"
        );
        format!(
            "<shape type=\"obj\" id=\"{name}\"><string name=\"filename\" value=\"{name}.obj\"/>{}</shape>\n",
            self.bsdf.replace("TEXTURE", &texture)
        )
    }

    fn library(&self) -> String {
        let (name, scale) = (self.name, 1.0 / self.metres);
        let map = match self.texture {
            Some(_) => format!("map_Kd -s {scale} {scale} {name}.png\n"),
            None => String::new(),
        };
        format!("newmtl {name}\n{}{map}", self.mtl)
    }
}

/// A number below 256 for a place (SplitMix64's last steps).
fn noise(x: u32, y: u32, seed: u32) -> i32 {
    let mut z = (u64::from(x) << 40) ^ (u64::from(y) << 16) ^ u64::from(seed);
    z = (z ^ (z >> 30)).wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) & 255) as i32
}

/// A colour made lighter or darker by up to half of `range`.
fn shade(color: [u8; 3], noise: i32, range: i32) -> [u8; 3] {
    color.map(|c| (i32::from(c) + (noise - 128) * range / 256).clamp(0, 255) as u8)
}

fn picture(texture: Texture) -> io::Result<Vec<u8>> {
    const SIZE: u32 = 128;
    let texels: Vec<u8> = (0..SIZE).rev().flat_map(|y| (0..SIZE).flat_map(move |x| texture(x, y))).collect();
    let mut out = vec![];
    let mut encoder = png::Encoder::new(&mut out, SIZE, SIZE);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&texels)?;
    writer.finish()?;
    Ok(out)
}

const HEAD: &str = r#"<scene version="3.0.0">
<!-- made by `rayherd scene house` -->
<default name="spp" value="64"/><default name="res" value="512"/><default name="max_depth" value="8"/>
<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="perspective"><float name="fov" value="52"/>
<transform name="to_world"><lookat origin="-7, 3.2, 13.5" target="-0.3, 1.9, 0" up="0, 1, 0"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/><rfilter type="box"/></film></sensor>
<emitter type="constant"><rgb name="radiance" value="0.35, 0.45, 0.65"/></emitter>
<emitter type="directional"><vector name="direction" x="0.5" y="-0.8" z="-0.55"/><rgb name="irradiance" value="2.6, 2.4, 2"/></emitter>
"#;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::{ImportOptions, Survey, import};
    use crate::record::{Record, RecordSource};

    #[test]
    fn the_house_is_read_both_ways_and_badly_ordered() {
        let folder = tempfile::tempdir().unwrap();
        let written = house(1, folder.path()).unwrap();
        let finer = tempfile::tempdir().unwrap();
        let four = house(2, finer.path()).unwrap();
        assert!(four.triangles > 3 * written.triangles, "{written:?} {four:?}");
        assert_eq!(house(1, folder.path()).unwrap(), written, "again");
        let on_disk: u64 = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().metadata().unwrap().len()).sum();
        assert_eq!(on_disk, written.bytes);

        let scene = import(&folder.path().join("house.xml"), &ImportOptions::default()).unwrap();
        let survey = Survey::of(&scene);
        assert_eq!(survey.sum(|s| s.triangles), written.triangles);
        // the tips of the gables
        assert!(survey.sum(|s| s.flat) < 30 && survey.shapes.iter().all(|s| s.error.is_none()));
        assert_eq!((scene.shapes.len(), scene.textures.len()), (6, 4));

        // as a folder of meshes with a library
        let bare = import(folder.path(), &ImportOptions::default()).unwrap();
        let survey = Survey::of(&bare);
        assert!(survey.shapes.iter().all(|s| s.error.is_none()));
        let brick = |s: &(usize, &crate::description::Shape)| s.1.name == "brick";
        let bricks: u64 = bare.shapes.iter().enumerate().filter(brick).map(|(i, _)| survey.shapes[i].triangles).sum();
        assert!(bricks > 100 && bricks < written.triangles);
        let own = bare.shapes.iter().enumerate().filter(|(_, s)| s.name.ends_with(".obj"));
        assert!(
            own.clone().count() == 6 && own.clone().all(|(i, _)| survey.shapes[i].triangles == 0),
            "all have a material"
        );

        // neighbours in the file are far apart: more than two metres in the mean
        let source = crate::import::DescriptionSource::new(&scene, crate::import::StreamOptions::default());
        let mut records = vec![];
        let mut stream = source.open().unwrap();
        while stream.next(&mut records, 1000).unwrap() > 0 {}
        let at = |r: &Record| if let Record::Triangle(t) = r { t.p[0] } else { unreachable!() };
        // two triangles make a square
        let far: Vec<f64> = records
            .chunks(2)
            .map(|c| at(&c[0]))
            .collect::<Vec<_>>()
            .windows(2)
            .map(|w| {
                let d = sub(w[1], w[0]);
                dot(d, d).sqrt()
            })
            .collect();
        let mean = far.iter().sum::<f64>() / far.len() as f64;
        assert!(mean > 2.0, "{mean}");
    }
}
