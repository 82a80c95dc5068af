//! Seeded mutations of small files, for every parser of `import`: whatever a file holds, reading it ends in records or in an
//! error, without a panic, in bounded time and memory.
//!
//! 1,500 mutations a format in `cargo test`; `RAYHERD_FUZZ_SECONDS=N` makes it N seconds a format, from a seed that differs from
//! run to run; `RAYHERD_FUZZ_SEED=S` replays one mutation.

use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rayherd_scene::ImportError;
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import};
use rayherd_scene::record::RecordSource;

/// SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }
    fn range(&mut self, length: usize) -> std::ops::Range<usize> {
        let at = self.below(length + 1);
        at..at + self.below((length - at).min(64) + 1)
    }
}

/// Words that parsers stumble over.
const WORDS: &[&str] = &[
    "-1",
    "0",
    "1",
    "255",
    "256",
    "65536",
    "2147483648",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "-9223372036854775808",
    "1e999",
    "nan",
    "-inf",
    "1e-320",
    "0.0000001",
    "/",
    "//",
    "\\",
    "$",
    "$x",
    "#",
    "\0",
    "\n",
    "\r\n",
    " ",
    "\"",
    "<",
    ">",
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
    "v 1 1 1",
    "/dev/zero",
    "../a",
    "include",
    "ref",
    "id=\"m\"",
    "type=\"cube\"",
];

/// The word that begins at or after a place.
fn word(bytes: &[u8], at: usize) -> std::ops::Range<usize> {
    let part = |b: &u8| b.is_ascii_alphanumeric() || b"._-+#$".contains(b);
    let start = at + bytes[at..].iter().take_while(|b| !part(b)).count();
    start..start + bytes[start..].iter().take_while(|b| part(b)).count()
}

fn mutate(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let mut out = seed.to_vec();
    // mostly one change: two seldom get past the first check
    for _ in 0..1 + random.below(5) / 4 {
        let range = random.range(out.len());
        match random.below(11) {
            0 => out.truncate(range.start),
            1 => drop(out.drain(range)),
            2 => {
                let copy = out[range].to_vec();
                let at = random.below(out.len() + 1);
                out.splice(at..at, copy);
            }
            3 | 4 => {
                if let Some(byte) = out.get_mut(range.start) {
                    *byte ^= 1 << random.below(8);
                }
            }
            5 => {
                if let Some(byte) = out.get_mut(range.start) {
                    *byte = random.next() as u8;
                }
            }
            // a number becomes another
            6 => {
                let digits = |b: &u8| b.is_ascii_digit() || *b == b'.' || *b == b'-';
                let start = range.start + out[range.start..].iter().take_while(|b| !digits(b)).count();
                let end = start + out[start..].iter().take_while(|b| digits(b)).count();
                out.splice(start..end, WORDS[random.below(20)].bytes());
            }
            // a word becomes another of the same file
            7..=9 => {
                let from = word(&out, random.below(out.len() + 1));
                let new = out[from].to_vec();
                let to = word(&out, range.start);
                out.splice(to, new);
            }
            _ => {
                let at = range.start;
                out.splice(at..at, WORDS[random.below(WORDS.len())].bytes());
            }
        }
    }
    out
}

/// Says on a panic how to see it again.
struct Replay<'a>(&'a str, u64);

impl Drop for Replay<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("replay with RAYHERD_FUZZ_SEED={} on {}", self.1, self.0);
        }
    }
}

/// Reads a file to its end. No file here has more than a few hundred bytes, so none has more than a few thousand primitives.
fn read(path: &Path, substitute: bool) -> Result<usize, ImportError> {
    let options = ImportOptions { substitute, ..ImportOptions::default() };
    let description = import(path, &options)?;
    let stream_options = StreamOptions { vertex_budget: 1 << 16, spill_limit: 1 << 20, spill_folder: None };
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

/// Largest resident memory of this process so far, in KiB, where the system tells.
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().trim_end_matches("kB").trim().parse().ok()
}

fn fuzz(name: &str, seeds: &[Vec<u8>], beside: &[(&str, &str)]) {
    let dir = tempfile::tempdir().unwrap();
    for (name, content) in beside {
        std::fs::write(dir.path().join(name), content).unwrap();
    }
    let path = dir.path().join(name);
    let env = |name: &str| std::env::var(name).ok().and_then(|v| v.parse::<u64>().ok());
    let (mut seed, mut left, mut until) = (1, 1500, None);
    if let Some(seconds) = env("RAYHERD_FUZZ_SECONDS") {
        seed = SystemTime::now().duration_since(UNIX_EPOCH).map_or(1, |d| d.as_nanos() as u64);
        (left, until) = (u64::MAX, Some(Instant::now() + Duration::from_secs(seconds)));
    }
    if let Some(replay) = env("RAYHERD_FUZZ_SEED") {
        (seed, left, until) = (replay, 1, None);
    }
    for original in seeds {
        std::fs::write(&path, original).unwrap();
        assert!(read(&path, true).unwrap() > 0, "the seeds themselves are read");
    }
    let before = peak_memory();
    let (mut good, mut bad) = (0, 0);
    while left > 0 && until.is_none_or(|until| Instant::now() < until) {
        let _replay = Replay(name, seed);
        let mut random = Random(seed);
        let original = &seeds[random.below(seeds.len())];
        std::fs::write(&path, mutate(original, &mut random)).unwrap();
        match read(&path, random.below(2) == 0) {
            Ok(_) => good += 1,
            Err(e) => {
                bad += 1;
                let message = e.to_string();
                assert!(!message.is_empty() && message.len() < 100_000);
            }
        }
        seed = seed.wrapping_add(1);
        left -= 1;
    }
    println!("{name}: {good} read, {bad} refused");
    assert!(env("RAYHERD_FUZZ_SEED").is_some() || (good > 0 && bad > 0), "mutations are neither harmless nor hopeless");
    if let (Some(before), Some(after)) = (before, peak_memory()) {
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
    fuzz("a.ply", &[PLY.into(), binary_ply(false), binary_ply(true)], &[]);
}

#[test]
fn packed() {
    use std::io::Write;
    let mut packer = flate2::write::GzEncoder::new(vec![], flate2::Compression::default());
    packer.write_all(PLY.as_bytes()).unwrap();
    fuzz("a.ply.gz", &[packer.finish().unwrap()], &[]);
}

#[test]
fn obj() {
    let text = "mtllib a.mtl\no a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.5 0.5\nvn 0 0 1\nf 1 2 3 4\nf -4/1 -3/1 \\\n-2/1\n\
                f 1//1 2//1 3//1\nf 1/1/1 2/1/1 4/1/1\n";
    fuzz("a.obj", &[text.into()], &[]);
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
    fuzz("a.stl", &[text.into(), binary], &[]);
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
<shape type="ply"><string name="filename" value="a.ply"/></shape></scene>"##;
    let part = r#"<scene><alias id="m" as="n"/><shape type="ply"><string name="filename" value="a.ply"/><ref id="n"/></shape></scene>"#;
    fuzz("a.xml", &[text.into()], &[("part.xml", part), ("a.ply", PLY)]);
}
