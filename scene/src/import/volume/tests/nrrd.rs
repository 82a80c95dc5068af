use super::*;

fn header(sizes: &str, kind: &str, more: &str) -> Vec<u8> {
    format!("NRRD0004\n# a comment\ndimension: 3\nsizes: {sizes}\ntype: {kind}\n{more}key:=value\n").into_bytes()
}

fn attached(more: &str, data: &[u8]) -> Vec<u8> {
    [header("3 2 4", "short", more), b"\n".to_vec(), data.to_vec()].concat()
}

fn shorts(big_endian: bool) -> Vec<u8> {
    (0..24i16).flat_map(|v| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
}

#[test]
fn attached_and_detached() {
    let folder = Folder::new();
    let raw = shorts(false);
    let packed = gzip(&raw);
    let files = [
        folder.write("a.nrrd", &attached("encoding: raw\nendian: little\n", &raw)),
        folder.write("b.nrrd", &attached("encoding: gzip\nendian: little\n", &packed)),
        folder.write("c.nrrd", &attached("encoding: raw\nendian: big\n", &shorts(true))),
        folder.write(
            "d.nrrd",
            &attached("encoding: raw\nendian: little\nbyte skip: 5\n", &[b"12345", &raw[..]].concat()),
        ),
        folder
            .write("e.nrrd", &attached("encoding: raw\nendian: little\nbyte skip: -1\n", &[b"any", &raw[..]].concat())),
        folder.write(
            "f.nrrd",
            &attached("encoding: raw\nendian: little\nline skip: 2\nbyte skip: 1\n", &[b"x\n\nz", &raw[..]].concat()),
        ),
        folder.write(
            "g.nrrd",
            &attached("encoding: gz\nendian: little\nbyte skip: 3\n", &gzip(&[b"123", &raw[..]].concat())),
        ),
        folder.write("h.nhdr", &header("3 2 4", "int16", "encoding: raw\nendian: little\ndata file: h.raw\n")),
        folder.write("i.nhdr", &header("3 2 4", "int16", "encoding: gzip\nendian: little\ndatafile: ./i.raw.gz\n")),
    ];
    folder.write("h.raw", &raw);
    folder.write("i.raw.gz", &packed);
    for path in files {
        let file = open(&path).unwrap();
        assert_eq!(file.volume().dims, [3, 2, 4], "{path:?}");
        assert_eq!(file.volume().sample, SampleType::I16);
        // twice: a pass leaves nothing behind
        for _ in 0..2 {
            assert_eq!(slices(&file).unwrap(), counting(4), "{path:?}");
        }
    }
    let file = open(&folder.path().join("h.nhdr")).unwrap();
    let mut pass = file.slices();
    assert!(pass.next(&mut Vec::new()).unwrap());
    assert_eq!(pass.bytes_read(), 12);
}

#[test]
fn every_type() {
    let folder = Folder::new();
    macro_rules! check {
        ($type:ty, $name:expr) => {
            for (endian, big) in [("little", false), ("big", true)] {
                let values: [$type; 4] = [<$type>::MIN, 0 as $type, 7 as $type, <$type>::MAX];
                let bytes = |v: &$type| if big { v.to_be_bytes() } else { v.to_le_bytes() };
                let mut content = header("2 2 1", $name, &format!("encoding: raw\nendian: {endian}\n"));
                content.push(b'\n');
                content.extend(values.iter().flat_map(bytes));
                let path = folder.write("t.nrrd", &content);
                assert_eq!(slices(&open(&path).unwrap()).unwrap(), [values.map(|v| v as f64).to_vec()]);
            }
        };
    }
    check!(u8, "uchar");
    check!(i8, "signed char");
    check!(u16, "unsigned short");
    check!(i16, "short");
    check!(u32, "uint");
    check!(i32, "int32_t");
    check!(u64, "unsigned long long");
    check!(i64, "longlong");
    check!(f32, "float");
    check!(f64, "double");
}

#[test]
fn lists_of_files() {
    let folder = Folder::new();
    let raw = shorts(false);
    for (i, slice) in raw.chunks(12).enumerate() {
        folder.write(&format!("s{}", 10 - 2 * i), slice);
        folder.write(&format!("s{i:03}.raw"), slice);
    }
    folder.write("low", &raw[..24]);
    folder.write("high", &raw[24..]);
    for (i, list) in [
        "data file: s%d 10 4 -2",
        "data file: s%03d.raw 0 3 1",
        "data file: s%03d.raw 0 3 1 2",
        "data file: LIST\ns000.raw\ns001.raw\ns002.raw\ns003.raw",
        "data file: LIST 3\nlow\nhigh",
    ]
    .into_iter()
    .enumerate()
    {
        let more = format!("encoding: raw\nendian: little\nkey2:=value\n{list}\n");
        let mut content = header("3 2 4", "short", &more);
        content.truncate(content.len() - "key:=value\n".len());
        let path = folder.write(&format!("{i}.nhdr"), &content);
        assert_eq!(slices(&open(&path).unwrap()).unwrap(), counting(4), "{list}");
    }
}

#[test]
fn placement() {
    let folder = Folder::new();
    let place = |more: &str| {
        let content = attached(&format!("encoding: raw\nendian: little\n{more}"), &shorts(false));
        open(&folder.write("p.nrrd", &content)).unwrap().volume().to_world.0
    };
    // no orientation: the first slice on top, and a turn, not a mirror
    let plain = |[x, y, z]: [f64; 3]| [[-x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, -z, 0.0]];
    assert_eq!(place(""), plain([1.0; 3]));
    assert_eq!(place("spacings: 3.5 2 1e-1\n"), plain([3.5, 2.0, 0.1]));
    let upright = [[3.5, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0]];
    assert_eq!(place("space: LPS\nspacings: 3.5 2 1e-1\n"), upright);
    let directions = "space directions: (0,1,2) (-3,4, 5) (6,7,-8.5)\nspace origin: (10,20,30)\n";
    let lps = [[0.0, -3.0, 6.0, 10.0], [1.0, 4.0, 7.0, 20.0], [2.0, 5.0, -8.5, 30.0]];
    assert_eq!(place(&format!("space: left-posterior-superior\n{directions}")), lps);
    assert_eq!(place(&format!("space: LPS\n{directions}")), lps);
    assert_eq!(place(&format!("space dimension: 3\n{directions}")), lps);
    let negated = |rows: &[usize]| {
        let mut m = lps;
        for &r in rows {
            m[r] = m[r].map(|v| -v);
        }
        m
    };
    assert_eq!(place(&format!("space: right-anterior-superior\n{directions}")), negated(&[0, 1]));
    assert_eq!(place(&format!("space: LAS\n{directions}")), negated(&[1]));
    assert_eq!(place(&format!("space: 3D-left-handed\n{directions}")), negated(&[0]));
}

#[test]
fn links_do_not_lead_outside() {
    let folder = Folder::new();
    std::fs::create_dir(folder.path().join("in")).unwrap();
    folder.write("secret.raw", &shorts(false));
    folder.write("in/own.raw", &shorts(false));
    let link = |to: &str, name: &str| std::os::unix::fs::symlink(to, folder.path().join("in").join(name)).unwrap();
    link("../secret.raw", "file.raw");
    link("..", "up");
    link("own.raw", "inside.raw");
    let header = |data: &str| {
        let more = format!("encoding: raw\nendian: little\ndata file: {data}\n");
        folder.write("in/h.nhdr", &header("3 2 4", "short", &more))
    };
    for data in ["own.raw", "inside.raw", "./own.raw"] {
        assert_eq!(slices(&open(&header(data)).unwrap()).unwrap(), counting(4), "{data}");
    }
    for data in ["file.raw", "up/secret.raw"] {
        assert!(error(&header(data)).contains("outside the header's folder"), "{data}");
    }
}

#[test]
fn errors() {
    let folder = Folder::new();
    let raw = shorts(false);
    let good = "encoding: raw\nendian: little\n";
    let message = |content: &[u8]| error(&folder.write("e.nrrd", content));
    let with = |more: &str| message(&attached(more, &raw));
    for (more, expected) in [
        ("encoding: raw\n", "no field `endian`"),
        ("endian: little\n", "no field `encoding`"),
        ("encoding: bzip2\n", "e.nrrd:6: encoding `bzip2` is not supported: convert"),
        ("endian: middle\n", "not little or big"),
        ("dimension: 4\nencoding: raw\nendian: little\n", "dimension is not 3"),
        ("dimension: x\n", "`x` is not a number"),
        ("type: block\n", "type `block` is not supported"),
        ("nonsense: 1\n", "unknown field `nonsense`"),
        ("nonsense\n", "not a field"),
        ("space: 4D-time\n", "space `4D-time` is not supported"),
        ("sizes: 3 2\nencoding: raw\nendian: little\n", "not three numbers"),
        ("sizes: 3 0 2\nencoding: raw\nendian: little\n", "a size is 0 in 3 x 0 x 2"),
        ("sizes: 99999999 99999999 9\nencoding: raw\nendian: little\n", "a slice may have"),
        ("sizes: 1000 1000 1000\nencoding: raw\nendian: little\n", "truncated, or the sizes are wrong"),
        ("encoding: gzip\nendian: little\nsizes: 1000 1000 1000\n", "more than gzip can hold"),
        ("encoding: gzip\nendian: little\n", "bad data in slice 0"),
        ("encoding: raw\nendian: little\nspacings: 1 0 1\n", "spacing is not a positive number"),
        ("encoding: raw\nendian: little\nspacings: 1 nan 1\n", "spacing is not a positive number"),
        ("encoding: raw\nendian: little\nspace directions: (1,0,0) (2,0,0) (0,0,1)\n", "flat or not finite"),
        ("space directions: (1,0,0) none (0,0,1)\n", "not vectors of three numbers"),
        ("space origin: (1,inf,0)\n", "not vectors of three numbers"),
        ("byte skip: -2\n", "below -1"),
        ("encoding: gzip\nendian: little\nbyte skip: -1\n", "goes with raw data"),
        ("encoding: raw\nendian: little\nbyte skip: 18446744073709551615\n", "not a number"),
        ("encoding: raw\nendian: little\nbyte skip: 9223372036854775807\n", "truncated"),
        ("encoding: raw\nendian: little\nline skip: 18446744073709551615\n", "truncated"),
        ("encoding: raw\nendian: little\nline skip: 30\n", "ends before slice 0"),
        ("encoding: raw\nendian: little\ndata file: ../secret\n", "outside the header's folder"),
        ("encoding: raw\nendian: little\ndata file: /etc/passwd\n", "outside the header's folder"),
        ("encoding: raw\nendian: little\ndata file: a/../../b\n", "outside the header's folder"),
        ("encoding: raw\nendian: little\ndata file: absent\n", "cannot read"),
        ("encoding: raw\nendian: little\ndata file: .\n", "is not a file"),
        ("encoding: raw\nendian: little\ndata file: s%d 1 3 1\n", "3 data files do not hold 4 slices evenly"),
        ("data file: s%d 1 3 0\n", "cannot be had in steps of 0"),
        ("data file: s%d 3 1 1\n", "cannot be had in steps of 1"),
        ("data file: s%d 0 9223372036854775807 1\n", "too many"),
        ("data file: LONG%d 0 99999 1\n", "too many"),
        ("data file: s%s 0 3 1\n", "not a file name with one %d"),
        ("data file: s%999999999d 0 3 1\n", "not a file name with one %d"),
    ] {
        let got = with(&more.replace("LONG", &"x".repeat(1000)));
        assert!(got.contains(expected), "{more}: {got}");
    }
    // what is cut off is named by slice
    let cut = message(&attached("encoding: gzip\nendian: little\n", &gzip(&raw[..30])));
    assert!(cut.contains("ends before slice 2"), "{cut}");
    let cut = message(&attached(good, &raw[..30]));
    assert!(cut.contains("truncated"), "{cut}");
    let packed = gzip(&raw);
    let cut = message(&attached("encoding: gzip\nendian: little\n", &packed[..packed.len() - 20]));
    assert!(cut.contains("ends before slice"), "{cut}");
    // the checksum of gzip counts
    let mut bad = gzip(&raw);
    let at = bad.len() - 6;
    bad[at] ^= 1;
    let sum = message(&attached("encoding: gzip\nendian: little\n", &bad));
    assert!(sum.contains("bad data in slice 3"), "{sum}");
    assert!(message(b"NRRD0009\n").contains("first line"));
    assert!(message(b"NRRD0004\n\xff\n").contains("not text"));
    let long = [b"NRRD0004\n#".to_vec(), vec![b'x'; 1 << 21]].concat();
    assert!(message(&long).contains("more than"));
}

/// What is packed in a few bytes is not unpacked beyond the sizes of the header.
#[test]
fn gzip_bomb() {
    let folder = Folder::new();
    let bomb = gzip(&vec![0; 16 << 20]);
    let path = folder.write("bomb.nrrd", &attached("encoding: gzip\nendian: little\n", &bomb));
    let file = open(&path).unwrap();
    let mut pass = file.slices();
    while pass.next(&mut Vec::new()).unwrap() {}
    // one buffer of input, of the 16 KiB that the bomb has
    assert!(pass.bytes_read() < 8_500, "{}", pass.bytes_read());
    assert!(bomb.len() > 15_000);
}
