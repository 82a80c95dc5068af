use super::*;

/// Tag, value representation, value.
type Element = ((u16, u16), &'static [u8; 2], Vec<u8>);

/// A DICOM file of 3 x 2 pixels.
#[derive(Clone)]
pub(super) struct Image {
    pub syntax: &'static str,
    pub series: String,
    pub elements: Vec<Element>,
    pub pixels: Vec<u8>,
}

pub(super) const IMPLICIT: &str = "1.2.840.10008.1.2";
pub(super) const EXPLICIT: &str = "1.2.840.10008.1.2.1";
pub(super) const BIG: &str = "1.2.840.10008.1.2.2";

impl Image {
    pub(super) fn new(syntax: &'static str, z: f64, values: [i16; 6]) -> Self {
        let short = |v: u16| if syntax == BIG { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let elements = vec![
            ((0x0008, 0x103e), b"LO", b"chest".to_vec()),
            ((0x0020, 0x0032), b"DS", format!("-10\\20\\{z}").into_bytes()),
            ((0x0020, 0x0037), b"DS", b"1\\0\\0\\0\\1\\0 ".to_vec()),
            ((0x0028, 0x0002), b"US", short(1)),
            ((0x0028, 0x0004), b"CS", b"MONOCHROME2".to_vec()),
            ((0x0028, 0x0010), b"US", short(2)),
            ((0x0028, 0x0011), b"US", short(3)),
            ((0x0028, 0x0030), b"DS", b"0.5\\0.25".to_vec()),
            ((0x0028, 0x0100), b"US", short(16)),
            ((0x0028, 0x0101), b"US", short(16)),
            ((0x0028, 0x0102), b"US", short(15)),
            ((0x0028, 0x0103), b"US", short(1)),
            ((0x0028, 0x1052), b"DS", b"-1000 ".to_vec()),
            ((0x0028, 0x1053), b"DS", b"2".to_vec()),
        ];
        let bytes = |v: i16| if syntax == BIG { v.to_be_bytes() } else { v.to_le_bytes() };
        Image { syntax, series: "1.2.3".into(), elements, pixels: values.into_iter().flat_map(bytes).collect() }
    }

    /// Replaces, adds or (empty) removes an element.
    pub(super) fn with(mut self, tag: (u16, u16), vr: &'static [u8; 2], value: &[u8]) -> Self {
        self.elements.retain(|e| e.0 != tag);
        if !value.is_empty() {
            self.elements.push((tag, vr, value.to_vec()));
        }
        self
    }

    fn series(mut self, uid: &str) -> Self {
        self.series = uid.into();
        self
    }

    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut out = vec![0; 128];
        out.extend(b"DICM");
        element(&mut out, EXPLICIT, (2, 0x10), b"UI", self.syntax.as_bytes());
        let mut elements = self.elements.clone();
        elements.push(((0x0020, 0x000e), b"UI", self.series.clone().into_bytes()));
        elements.sort_by_key(|e| e.0);
        for (tag, vr, value) in &elements {
            if tag.0 == 0x20 && tag.1 == 0x32 {
                self.sequences(&mut out);
            }
            element(&mut out, self.syntax, *tag, vr, value);
        }
        element(&mut out, self.syntax, (0x7fe0, 0x10), b"OW", &self.pixels);
        out
    }

    /// A sequence without lengths which holds elements that must not be taken for the image's, and one within it.
    fn sequences(&self, out: &mut Vec<u8>) {
        let open = |out: &mut Vec<u8>, tag: (u16, u16)| {
            element(out, self.syntax, tag, b"SQ", &[]);
            let at = out.len() - 4;
            out[at..].fill(0xff);
        };
        let item = |out: &mut Vec<u8>, tag: u16, length: u32| {
            for v in [0xfffe, tag] {
                out.extend(if self.syntax == BIG { v.to_be_bytes() } else { u16::to_le_bytes(v) });
            }
            out.extend(if self.syntax == BIG { length.to_be_bytes() } else { length.to_le_bytes() });
        };
        open(out, (0x0008, 0x1140));
        item(out, 0xe000, u32::MAX);
        element(out, self.syntax, (0x0020, 0x0032), b"DS", b"7\\7\\7 ");
        open(out, (0x0008, 0x1199));
        item(out, 0xe000, 4);
        out.extend([1, 2, 3, 4]);
        item(out, 0xe0dd, 0);
        item(out, 0xe00d, 0);
        item(out, 0xe0dd, 0);
    }
}

fn element(out: &mut Vec<u8>, syntax: &str, tag: (u16, u16), vr: &[u8; 2], value: &[u8]) {
    let big = syntax == BIG;
    let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
    let mut value = value.to_vec();
    if !value.len().is_multiple_of(2) {
        value.push(if vr == b"UI" { 0 } else { b' ' });
    }
    out.extend(short(tag.0));
    out.extend(short(tag.1));
    if syntax != IMPLICIT {
        out.extend(vr);
    }
    if syntax != IMPLICIT && !matches!(vr, b"OW" | b"SQ" | b"UN" | b"OB") {
        out.extend(short(value.len() as u16));
    } else {
        if syntax != IMPLICIT {
            out.extend([0, 0]);
        }
        let length = value.len() as u32;
        out.extend(if big { length.to_be_bytes() } else { length.to_le_bytes() });
    }
    out.extend(value);
}

fn values(z: i16) -> [i16; 6] {
    std::array::from_fn(|i| z * 6 + i as i16)
}

fn expected(slices: usize) -> Vec<Vec<f64>> {
    counting(slices).into_iter().map(|s| s.into_iter().map(|v| v * 2.0 - 1000.0).collect()).collect()
}

#[test]
fn series_of_every_syntax() {
    for syntax in [IMPLICIT, EXPLICIT, BIG] {
        let folder = Folder::new();
        // names in another order than places
        for (name, z) in [("c", 0), ("a", 1), ("d", 2), ("b", 3)] {
            folder.write(name, &Image::new(syntax, 5.0 + 1.5 * f64::from(z), values(z)).bytes());
        }
        folder.write("readme.txt", b"not DICOM");
        for path in [folder.path().to_owned(), folder.path().join("d")] {
            assert!(is_volume(&path).unwrap());
            let file = open(&path).unwrap();
            let v = file.volume();
            assert_eq!((v.dims, v.skipped_files, v.slope, v.intercept), ([3, 2, 4], 1, 2.0, -1000.0));
            // columns are 0.25 apart, rows 0.5
            let place = [[0.25, 0.0, 0.0, -10.0], [0.0, 0.5, 0.0, 20.0], [0.0, 0.0, 1.5, 5.0]];
            assert_eq!(v.to_world.0, place);
            assert_eq!(slices(&file).unwrap(), expected(4));
            assert_eq!(slices(&file).unwrap(), expected(4));
            let mut pass = file.slices();
            while pass.next(&mut Vec::new()).unwrap() {}
            assert_eq!(pass.bytes_read(), 48);
        }
    }
}

#[test]
fn turned_and_sheared() {
    let folder = Folder::new();
    for z in 0..3 {
        // rows to the head, columns to the back: the normal is to the right; each slice is moved up
        let image = Image::new(EXPLICIT, 0.0, values(z)).with((0x0020, 0x0037), b"DS", b"0\\1\\0\\0\\0\\1").with(
            (0x0020, 0x0032),
            b"DS",
            format!("{}\\0\\{}", 2 * z, f64::from(z) * 0.5).as_bytes(),
        );
        folder.write(&format!("{z}"), &image.bytes());
    }
    let place = [[0.0, 0.0, 2.0, 0.0], [0.25, 0.0, 0.0, 0.0], [0.0, 0.5, 0.5, 0.0]];
    assert_eq!(open(folder.path()).unwrap().volume().to_world.0, place);
}

#[test]
fn bits_that_are_not_stored() {
    let folder = Folder::new();
    let short = |v: u16| v.to_le_bytes();
    // 12 bits up to bit 13, signed; what is around them is something else
    let stored = [0x0fff_u16, 0x07ff, 0x0800, 0, 1, 0x0ffe].map(|v| (v << 2 | 0xc003) as i16);
    let image = Image::new(IMPLICIT, 0.0, stored)
        .with((0x0028, 0x0101), b"US", &short(12))
        .with((0x0028, 0x0102), b"US", &short(13))
        .with((0x0028, 0x1052), b"DS", b"")
        .with((0x0028, 0x1053), b"DS", b"");
    let path = folder.write("a", &image.bytes());
    assert_eq!(slices(&open(&path).unwrap()).unwrap(), [[-1.0, 2047.0, -2048.0, 0.0, 1.0, -2.0]]);
    let image = image.with((0x0028, 0x0103), b"US", &short(0));
    let path = folder.write("a", &image.bytes());
    assert_eq!(slices(&open(&path).unwrap()).unwrap(), [[4095.0, 2047.0, 2048.0, 0.0, 1.0, 4094.0]]);
}

#[test]
fn mixed_series() {
    let folder = Folder::new();
    for z in 0..3 {
        folder.write(&format!("a{z}"), &Image::new(EXPLICIT, f64::from(z), values(z)).series("1.2.3").bytes());
        // one that could not be a volume does not stand in the way of the other
        let other = Image::new(EXPLICIT, 0.0, values(z)).series("9.8.7").with((0x0020, 0x0032), b"DS", b"");
        folder.write(&format!("b{z}"), &other.bytes());
    }
    let message = error(folder.path());
    assert!(message.contains("2 DICOM series: give one file of the series you want"), "{message}");
    assert!(message.contains("a0: 3 image(s), chest 1.2.3") && message.contains("b0: 3 image(s), chest 9.8.7"));
    let file = open(&folder.path().join("a1")).unwrap();
    assert_eq!(slices(&file).unwrap(), expected(3));
    assert!(error(&folder.path().join("b1")).contains("no position (0020,0032)"));
}

#[test]
fn uneven_series() {
    let check = |places: &[f64], expected: &[&str]| {
        let folder = Folder::new();
        for (i, &z) in places.iter().enumerate() {
            folder.write(&format!("f{i}"), &Image::new(EXPLICIT, z, values(0)).bytes());
        }
        let message = error(folder.path());
        assert!(expected.iter().all(|e| message.contains(e)), "{message}");
    };
    check(&[0.0, 1.0, 2.0, 4.0, 5.0], &["f3", "2.0000 mm after", "f2", "1.0000 mm are usual", "is missing"]);
    check(&[0.0, 1.0, 1.0, 2.0, 3.0], &["f2", "two images of one place"]);
    let folder = Folder::new();
    for z in 0..4 {
        let image = Image::new(EXPLICIT, 0.0, values(z));
        let x = if z == 2 { 3 } else { 0 };
        folder.write(&format!("f{z}"), &image.with((0x0020, 0x0032), b"DS", format!("{x}\\0\\{z}").as_bytes()).bytes());
    }
    assert!(error(folder.path()).contains("beside the line of its series"));
}

#[test]
fn errors() {
    let short = |v: u16| v.to_le_bytes();
    let good = Image::new(EXPLICIT, 0.0, values(0));
    let check = |image: Image, expected: &str| {
        let folder = Folder::new();
        folder.write("good", &good.bytes());
        folder.write("odd", &image.bytes());
        let message = error(folder.path());
        assert!(message.contains(expected), "{message}");
        assert!(message.contains("odd"), "{message}");
    };
    let next = || Image::new(EXPLICIT, 1.0, values(1));
    check(next().with((0x0028, 0x0002), b"US", &short(3)), "a colour image");
    check(next().with((0x0028, 0x0008), b"IS", b"7"), "many frames");
    check(next().with((0x0028, 0x3000), b"SQ", b"xxxx"), "by a table");
    check(next().with((0x0028, 0x0100), b"US", &short(12)), "12 bits per pixel are not supported");
    check(next().with((0x0028, 0x0101), b"US", &short(17)), "do not lie within");
    check(next().with((0x0028, 0x0102), b"US", &short(16)), "do not lie within");
    check(next().with((0x0028, 0x0103), b"US", &short(2)), "neither 0 nor 1");
    check(next().with((0x0028, 0x0103), b"US", &short(0)), "the kind of pixel differs");
    check(next().with((0x0028, 0x0010), b"US", &short(1)), "the size 3 x 1 (from 3 x 2) differs");
    check(next().with((0x0028, 0x0010), b"US", &short(4)), "12 bytes where 3 x 4 pixels need 24");
    check(next().with((0x0028, 0x0010), b"US", b""), "(0028,0010) is missing");
    check(next().with((0x0028, 0x0030), b"DS", b"0.5\\0.5"), "the pixel spacing differs");
    check(next().with((0x0028, 0x0030), b"DS", b"0.5"), "not 2 number(s)");
    check(next().with((0x0028, 0x0030), b"DS", b"a\\nan"), "not 2 number(s)");
    check(next().with((0x0028, 0x0030), b"DS", b""), "no pixel spacing");
    check(next().with((0x0020, 0x0037), b"DS", b"0\\1\\0\\0\\0\\1"), "the orientation differs");
    check(next().with((0x0028, 0x1053), b"DS", b"0"), "the rescale slope is 0");
    for (syntax, name) in [
        ("1.2.840.10008.1.2.4.70", "JPEG"),
        ("1.2.840.10008.1.2.4.90", "JPEG 2000"),
        ("1.2.840.10008.1.2.5", "run lengths"),
        ("1.2.840.10008.1.2.1.99", "decompress first"),
    ] {
        check(Image { syntax, ..next() }, name);
    }
    // a slice at the end of a series that is empty, cut or something else leaves no gap, but its name tells
    for bytes in [&b""[..], &good.bytes()[..100], &[7; 400]] {
        let folder = Folder::new();
        folder.write("slice1.dcm", &good.bytes());
        folder.write("slice2.dcm", bytes);
        folder.write("notes.txt", b"");
        let message = error(folder.path());
        assert!(message.contains("slice2.dcm") && message.contains("get it again"), "{message}");
    }
    // no file that holds no image is in the way
    let folder = Folder::new();
    let whole = good.bytes();
    folder.write("a", &whole);
    folder.write("DICOMDIR", &whole[..whole.len() - 24]);
    let file = open(folder.path()).unwrap();
    assert_eq!((file.volume().dims, file.volume().skipped_files), ([3, 2, 1], 1));
    // but one that is cut is
    for cut in [133, 150, 200, whole.len() - 5, whole.len() - 13] {
        folder.write("a", &whole[..cut]);
        let message = error(folder.path());
        assert!(
            message.contains("ends within")
                || message.contains("truncated")
                || message.contains("beyond the end")
                || message.contains("no transfer syntax"),
            "{cut}: {message}"
        );
    }
    let mut deep = whole[..whole.len() - 24].to_vec();
    for _ in 0..100_000 {
        deep.extend([8, 0, 0x40, 0x11, b'S', b'Q', 0, 0, 255, 255, 255, 255, 0xfe, 0xff, 0, 0xe0, 255, 255, 255, 255]);
    }
    folder.write("a", &deep);
    assert!(error(folder.path()).contains("nested more than 32 deep"));
}
