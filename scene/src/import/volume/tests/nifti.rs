use super::*;

/// A NIfTI-1 or -2 file that is written field by field.
#[derive(Clone)]
pub(super) struct Nifti {
    pub big_endian: bool,
    pub second: bool,
    pub bytes: Vec<u8>,
}

macro_rules! put {
    ($file:expr, $at:expr, $value:expr) => {{
        let v = $value;
        let b = if $file.big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        $file.bytes[$at..$at + b.len()].copy_from_slice(&b);
    }};
}

impl Nifti {
    /// 3 x 2 x 4 samples of `datatype` with no placement.
    pub(super) fn new(second: bool, big_endian: bool, datatype: i16) -> Self {
        let mut f = Nifti { big_endian, second, bytes: vec![0; if second { 544 } else { 352 }] };
        let dim = [3i16, 3, 2, 4, 1, 1, 1, 1];
        if second {
            put!(f, 0, 540i32);
            f.bytes[4..12].copy_from_slice(b"n+2\0\r\n\x1a\n");
            put!(f, 12, datatype);
            (0..8).for_each(|k| put!(f, 16 + 8 * k, i64::from(dim[k])));
            (0..8).for_each(|k| put!(f, 104 + 8 * k, 1.0f64));
            put!(f, 168, 544i64);
        } else {
            put!(f, 0, 348i32);
            f.bytes[344..348].copy_from_slice(b"n+1\0");
            put!(f, 70, datatype);
            (0..8).for_each(|k| put!(f, 40 + 2 * k, dim[k]));
            (0..8).for_each(|k| put!(f, 76 + 4 * k, 1.0f32));
            put!(f, 108, 352.0f32);
        }
        f
    }
    /// Slope and intercept.
    fn scale(mut self, slope: f32, intercept: f32) -> Self {
        if self.second {
            put!(self, 176, f64::from(slope));
            put!(self, 184, f64::from(intercept));
        } else {
            put!(self, 112, slope);
            put!(self, 116, intercept);
        }
        self
    }
    fn sform(mut self, rows: [[f32; 4]; 3]) -> Self {
        for (i, v) in rows.as_flattened().iter().enumerate() {
            if self.second {
                put!(self, 400 + 8 * i, f64::from(*v));
            } else {
                put!(self, 280 + 4 * i, *v);
            }
        }
        if self.second {
            put!(self, 348, 1i32);
        } else {
            put!(self, 254, 1i16);
        }
        self
    }
    /// With the samples 0, 1, 2, .. as shorts.
    pub(super) fn shorts(mut self) -> Vec<u8> {
        for v in 0..24i16 {
            self.bytes.extend(if self.big_endian { v.to_be_bytes() } else { v.to_le_bytes() });
        }
        self.bytes
    }
}

#[test]
fn both_versions_and_byte_orders() {
    let folder = Folder::new();
    let rows = [[0.0, -2.0, 0.0, 5.0], [3.0, 0.0, 0.0, 6.0], [0.0, 0.0, 4.0, 7.0]];
    for second in [false, true] {
        for big_endian in [false, true] {
            let plain = Nifti::new(second, big_endian, 4).scale(0.5, -3.0).sform(rows).shorts();
            for (name, content) in [("a.nii", plain.clone()), ("a.nii.gz", gzip(&plain))] {
                let path = folder.write(name, &content);
                assert!(is_volume(&path).unwrap());
                let file = open(&path).unwrap();
                let scaled: Vec<Vec<f64>> =
                    counting(4).into_iter().map(|s| s.into_iter().map(|v| v * 0.5 - 3.0).collect()).collect();
                assert_eq!(slices(&file).unwrap(), scaled);
                assert_eq!(slices(&file).unwrap(), scaled);
                // RAS to LPS
                let lps = [[0.0, 2.0, 0.0, -5.0], [-3.0, 0.0, 0.0, -6.0], [0.0, 0.0, 4.0, 7.0]];
                assert_eq!(file.volume().to_world.0, lps);
            }
        }
    }
}

#[test]
fn a_slope_of_zero_is_none() {
    let folder = Folder::new();
    let path = folder.write("a.nii", &Nifti::new(false, false, 4).scale(0.0, 9.0).shorts());
    assert_eq!(slices(&open(&path).unwrap()).unwrap(), counting(4));
}

#[test]
fn quaternion_and_units() {
    let folder = Folder::new();
    let mut f = Nifti::new(false, false, 4);
    put!(f, 252, 1i16);
    // a turn by 90 degrees about z, slices turned over, in metres
    put!(f, 256, 0.0f32);
    put!(f, 260, 0.0f32);
    put!(f, 264, std::f32::consts::FRAC_1_SQRT_2);
    put!(f, 268, 0.001f32);
    put!(f, 76, -1.0f32);
    put!(f, 84, 0.002f32);
    f.bytes[123] = 1;
    let m = open(&folder.write("a.nii", &f.clone().shorts())).unwrap().volume().to_world.0;
    // x -> y, y -> -x in RAS
    let expected = [[0.0, 2.0, 0.0, -1.0], [-1000.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1000.0, 0.0]];
    for r in 0..3 {
        for c in 0..4 {
            // f32 in the file
            assert!((m[r][c] - expected[r][c]).abs() < 1e-3, "{m:?}");
        }
    }
    put!(f, 260, 2.0f32);
    assert!(error(&folder.write("b.nii", &f.shorts())).contains("longer than 1"));
}

#[test]
fn pairs() {
    let folder = Folder::new();
    let mut f = Nifti::new(false, false, 4);
    f.bytes[344..348].copy_from_slice(b"ni1\0");
    put!(f, 108, 0.0f32);
    let all = f.shorts();
    let path = folder.write("a.hdr", &all[..348]);
    assert!(error(&path).contains("cannot read"));
    folder.write("a.img", &all[352..]);
    assert_eq!(slices(&open(&path).unwrap()).unwrap(), counting(4));
    assert!(error(&folder.write("b.xyz", &all[..348])).contains("does not end with .hdr"));
}

#[test]
fn errors() {
    let folder = Folder::new();
    let check = |change: &dyn Fn(&mut Nifti), expected: &str| {
        let mut f = Nifti::new(false, false, 4);
        change(&mut f);
        let got = error(&folder.write("e.nii", &f.shorts()));
        assert!(got.contains(expected), "{got}");
    };
    check(&|f| put!(f, 40, 9i16), "9 dimensions");
    check(&|f| put!(f, 40, 2i16), "are not one volume");
    check(&|f| (put!(f, 40, 4i16), put!(f, 48, 2i16)).0, "[3, 2, 4, 2] are not one volume");
    check(&|f| put!(f, 42, -3i16), "a size is 0");
    check(&|f| put!(f, 46, 5i16), "truncated");
    check(&|f| (put!(f, 42, 32767i16), put!(f, 44, 32767i16)).0, "a slice may have");
    check(&|f| put!(f, 70, 128i16), "data type 128 is not supported");
    check(&|f| put!(f, 108, f32::NAN), "not a number of bytes");
    check(&|f| put!(f, 108, 1e9f32), "truncated");
    check(&|f| put!(f, 112, f32::INFINITY), "not finite");
    check(&|f| put!(f, 80, 0f32), "flat or not finite");
    check(&|f| put!(f, 80, f32::NAN), "flat or not finite");
    let four = {
        let mut f = Nifti::new(false, false, 4);
        put!(f, 40, 4i16);
        f.shorts()
    };
    assert_eq!(slices(&open(&folder.write("four.nii", &four)).unwrap()).unwrap(), counting(4));
    let packed = gzip(&four);
    assert!(error(&folder.write("cut.nii.gz", &gzip(&four[..380]))).contains("ends before slice 2"));
    assert!(error(&folder.write("half.nii.gz", &packed[..packed.len() / 2])).contains("not a volume"));
}
