use std::cell::{Ref, RefCell};

use super::*;
use crate::testing::Rng;

/// Tiles in memory; and an image by texel, from which they were cut.
#[derive(Default)]
pub(crate) struct Tiles(RefCell<Vec<Vec<u8>>>);

impl Tiles {
    /// Adds a tile; its number.
    pub fn push(&self, bytes: Vec<u8>) -> u32 {
        self.0.borrow_mut().push(bytes);
        self.0.borrow().len() as u32 - 1
    }
}

impl Textures for Tiles {
    fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        Ref::filter_map(self.0.borrow(), |tiles| tiles.get(number as usize).map(Vec::as_slice)).ok()
    }
}

/// A random image of a format: its description, its tiles, and its decoded channels by row and column.
pub(crate) fn image(
    size: [u32; 2],
    channels: u8,
    texel: Texel,
    wrap: Wrap,
    filter: Filter,
) -> (Bitmap, Tiles, Vec<[f64; 3]>) {
    let mut rng = Rng(u64::from(size[0] * 7 + size[1]));
    let bitmap = Bitmap { size, channels, texel, wrap, filter, to_uv: UvMap::IDENTITY, first_tile: 0 };
    let n = (size[0] * size[1]) as usize;
    let mut raw = Vec::new();
    let mut values = Vec::new();
    for _ in 0..n {
        let mut value = [0.0; 3];
        for c in 0..usize::from(channels) {
            value[c] = if texel == Texel::Float {
                let x = rng.f32() * 3.0;
                raw.extend(x.to_le_bytes());
                f64::from(x)
            } else {
                let byte = rng.u32() as u8;
                raw.push(byte);
                let v = f64::from(byte) / 255.0;
                match texel {
                    Texel::Srgb8 if v <= 0.04045 => v / 12.92,
                    Texel::Srgb8 => ((v + 0.055) / 1.055).powf(2.4),
                    _ => v,
                }
            };
        }
        values.push(if channels == 1 { [value[0]; 3] } else { value });
    }
    let each = bitmap.texel_bytes();
    let [across, down] = bitmap.tiles_each_way();
    let mut tiles = Vec::new();
    for ty in 0..down {
        for tx in 0..across {
            let [w, h] = bitmap.tile_size([tx, ty]);
            let mut tile = Vec::new();
            for y in 0..h {
                let at = ((ty * TILE + y) * size[0] + tx * TILE) as usize * each;
                tile.extend(&raw[at..at + w as usize * each]);
            }
            assert_eq!(tile.len() as u64, bitmap.tile_bytes(ty * across + tx));
            tiles.push(tile);
        }
    }
    (bitmap, Tiles(RefCell::new(tiles)), values)
}

/// The definition, in f64: the image is a function on all whole numbers by its wrap mode, and between them by its filter.
fn plain(bitmap: &Bitmap, values: &[[f64; 3]], u: f64, v: f64) -> [f64; 3] {
    let [w, h] = bitmap.size.map(i64::from);
    let turn = |i: i64, n: i64| match bitmap.wrap {
        Wrap::Repeat => i.rem_euclid(n),
        Wrap::Clamp => i.clamp(0, n - 1),
        Wrap::Mirror => {
            let period = i.rem_euclid(2 * n);
            period.min(2 * n - 1 - period)
        }
    };
    let at = |x: i64, y: i64| values[(turn(y, h) * w + turn(x, w)) as usize];
    let (x, y) = (u * w as f64, v * h as f64);
    match bitmap.filter {
        Filter::Nearest => at(x.floor() as i64, y.floor() as i64),
        Filter::Bilinear => {
            // each texel is a tent of width 2 about its centre
            let mut sum = [0.0; 3];
            for j in -2..=2 {
                for i in -2..=2 {
                    let (cx, cy) = (x.floor() as i64 + i, y.floor() as i64 + j);
                    let tent = |d: f64| (1.0 - d.abs()).max(0.0);
                    let weight = tent(x - (cx as f64 + 0.5)) * tent(y - (cy as f64 + 0.5));
                    let value = at(cx, cy);
                    (0..3).for_each(|c| sum[c] += weight * value[c]);
                }
            }
            sum
        }
    }
}

const WRAPS: [Wrap; 3] = [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp];
const FORMATS: [(u8, Texel); 6] = [
    (3, Texel::Srgb8),
    (1, Texel::Srgb8),
    (3, Texel::Linear8),
    (1, Texel::Linear8),
    (1, Texel::Float),
    (3, Texel::Float),
];

#[test]
fn look_ups_are_the_definition() {
    let mut rng = Rng(3);
    for size in [[1, 1], [4, 3], [2, 300], [257, 129]] {
        for (channels, texel) in FORMATS {
            for wrap in WRAPS {
                for filter in [Filter::Bilinear, Filter::Nearest] {
                    let (mut bitmap, tiles, values) = image(size, channels, texel, wrap, filter);
                    bitmap.to_uv = UvMap([[1.5, 0.25, -0.5], [-0.125, 2.0, 0.75]]);
                    for _ in 0..300 {
                        let uv = [rng.range(-2.0, 3.0), rng.range(-2.0, 3.0)];
                        let at = bitmap.to_uv.point(uv);
                        let expected = plain(&bitmap, &values, f64::from(at[0]), f64::from(at[1]));
                        let found = bitmap.color(&tiles, uv);
                        // the place is rounded to 2^-24 of its texels, a step at a texel's edge is possible when nearest
                        let on_edge = |a: usize| {
                            let x = f64::from(at[a]) * f64::from(size[a]);
                            (x - x.round()).abs() < 1e-3
                        };
                        if filter == Filter::Nearest && (on_edge(0) || on_edge(1)) {
                            continue;
                        }
                        for c in 0..3 {
                            let error = (f64::from(found[c]) - expected[c]).abs();
                            assert!(error < 1e-3, "{bitmap:?} {uv:?}: {found} {expected:?}");
                        }
                    }
                }
            }
        }
    }
}

/// At texel centres a look-up is the texel to the bit, whatever the filter: bytes decode exactly.
#[test]
fn centres_are_texels() {
    for (channels, texel) in FORMATS {
        for filter in [Filter::Bilinear, Filter::Nearest] {
            // powers of two, so that centres are exact
            let (bitmap, tiles, values) = image([256, 128], channels, texel, Wrap::Repeat, filter);
            for y in [0, 1, 64, 127] {
                for x in [0, 1, 127, 128, 255] {
                    let uv = [(x as f32 + 0.5) / 256.0, (y as f32 + 0.5) / 128.0];
                    let found = bitmap.color(&tiles, uv).to_array();
                    assert_eq!(found, values[(y * 256 + x) as usize].map(|v| v as f32), "{texel:?} {x} {y}");
                }
            }
        }
    }
}

#[test]
fn gradients_are_differences_of_look_ups() {
    let mut rng = Rng(9);
    for wrap in WRAPS {
        let (mut bitmap, tiles, values) = image([40, 20], 3, Texel::Linear8, wrap, Filter::Bilinear);
        bitmap.to_uv = UvMap([[2.0, 0.5, 0.1], [-0.25, 1.0, 0.2]]);
        let texture = Texture::Bitmap(bitmap.clone());
        let height = |u: f64, v: f64| {
            let m = bitmap.to_uv.0.map(|row| row.map(f64::from));
            let [x, y] = m.map(|row| row[0] * u + row[1] * v + row[2]);
            let [r, g, b] = plain(&bitmap, &values, x, y);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        let mut compared = 0;
        for _ in 0..500 {
            let uv = [rng.range(-1.0, 2.0), rng.range(-1.0, 2.0)];
            let at = bitmap.to_uv.point(uv);
            // a difference across a centre is of two slopes
            let centre = |a: usize| {
                let x = f64::from(at[a]) * f64::from(bitmap.size[a]) - 0.5;
                (x - x.round()).abs() < 0.01
            };
            if centre(0) || centre(1) {
                continue;
            }
            let h = 1e-5;
            let (u, v) = (f64::from(uv[0]), f64::from(uv[1]));
            let expected =
                [(height(u + h, v) - height(u - h, v)) / (2.0 * h), (height(u, v + h) - height(u, v - h)) / (2.0 * h)];
            let found = texture.gradient(&tiles, uv);
            for k in 0..2 {
                assert!((f64::from(found[k]) - expected[k]).abs() < 2e-3, "{uv:?}: {found:?} {expected:?}");
            }
            compared += 1;
        }
        assert!(compared > 300, "{compared}");
    }
}

/// What Mitsuba 3.9.1 says for the same images (scalar_rgb, PNG files of these bytes).
#[test]
fn values_are_mitsubas() {
    let texels: [[u8; 3]; 4] = [[0, 0, 0], [255, 255, 255], [0, 100, 0], [255, 100, 255]];
    let tiles = Tiles(RefCell::new(vec![texels.as_flattened().to_vec()]));
    let bitmap = |texel| {
        Texture::Bitmap(Bitmap {
            size: [2, 2],
            channels: 3,
            texel,
            wrap: Wrap::Repeat,
            filter: Filter::Bilinear,
            to_uv: UvMap::IDENTITY,
            first_tile: 0,
        })
    };
    let rows = [
        (Texel::Srgb8, [0.5, 0.5], [0.5, 0.313_719, 0.5], 0.366_779_24, [1.284_84, -0.532_883]),
        (Texel::Srgb8, [0.25, 0.75], [0.0, 0.127_438, 0.0], 0.091_138_4, [0.569_68, -0.182_277]),
        (Texel::Linear8, [0.5, 0.5], [0.5, 0.446_078, 0.5], 0.461_437_43, [1.284_84, -0.154_25]),
        (Texel::Linear8, [0.25, 0.75], [0.0, 0.392_157, 0.0], 0.280_454_93, [0.569_68, -0.560_91]),
    ];
    for (texel, uv, color, amount, gradient) in rows {
        let texture = bitmap(texel);
        let found = texture.color(&tiles, At::uv(uv)).to_array();
        assert!((0..3).all(|c| (found[c] - color[c] as f32).abs() < 2e-6), "{found:?} {color:?}");
        // its luminance is 0.212671 R + 0.715160 G + 0.072169 B
        assert!((texture.amount(&tiles, At::uv(uv)) - amount as f32).abs() < 1e-4);
        let found = texture.gradient(&tiles, uv);
        assert!((0..2).all(|k| (found[k] - gradient[k] as f32).abs() < 2e-4), "{found:?} {gradient:?}");
    }
    let checkerboard = Texture::Checkerboard(Checkerboard { to_uv: UvMap::IDENTITY, colors: [[0.3; 3], [0.6; 3]] });
    for (uv, color, amount) in [([0.25, 0.25], 0.3, 0.6), ([0.75, 0.25], 0.6, 0.3), ([0.5, 0.25], 0.3, 0.6)] {
        assert_eq!(checkerboard.color(&NoTextures, At::uv(uv)).x, color);
        assert!((checkerboard.amount(&NoTextures, At::uv(uv)) - amount).abs() < 1e-6);
    }
}

/// The squares in f64: by which half of the mapped unit square each coordinate lies in.
#[test]
fn squares_are_the_definition() {
    let mut rng = Rng(12);
    let (mut compared, mut seen) = (0, [0; 2]);
    for _ in 0..40 {
        let colors = [0, 1].map(|_| [rng.f32() * 2.0, rng.f32(), rng.f32()]);
        let to_uv = UvMap([0, 1].map(|_| [rng.range(-6.0, 6.0), rng.range(-6.0, 6.0), rng.range(-2.0, 2.0)]));
        let texture = Texture::Checkerboard(Checkerboard { to_uv, colors });
        for _ in 0..200 {
            let uv = [rng.range(-2.0, 3.0), rng.range(-2.0, 3.0)];
            let halves = to_uv.0.map(|row| {
                let [a, b, c] = row.map(f64::from);
                2.0 * (a * f64::from(uv[0]) + b * f64::from(uv[1]) + c)
            });
            // a coordinate of at most 32 is rounded thrice to 2^-24 of it
            if halves.iter().any(|h| (h - h.round()).abs() < 1e-4) {
                continue;
            }
            let odd = (halves[0].floor() + halves[1].floor()).rem_euclid(2.0) as usize;
            assert_eq!(texture.color(&NoTextures, At::uv(uv)).to_array(), colors[odd], "{texture:?} {uv:?}");
            // of a number that of the other square
            let amount = texture.amount(&NoTextures, At::uv(uv));
            let expected: f64 =
                [0.2126, 0.7152, 0.0722].iter().zip(colors[1 - odd]).map(|(w, c)| w * f64::from(c)).sum();
            assert!((f64::from(amount) - expected).abs() < 1e-6, "{texture:?} {uv:?}: {amount} {expected}");
            assert_eq!(texture.gradient(&NoTextures, uv), [0.0; 2]);
            seen[odd] += 1;
            compared += 1;
        }
    }
    assert!(compared > 7900 && seen.iter().all(|n| *n > 3000), "{compared} {seen:?}");
}

/// A mesh's attribute is what it is at the place, times the scale, wherever the coordinates are; its number is the luminance, as light it is not negative.
#[test]
fn attributes_are_scaled() {
    let mut rng = Rng(13);
    for _ in 0..1000 {
        let scale = rng.range(-1.0, 3.0);
        let texture = Texture::Attribute { scale };
        let at = At { uv: [rng.range(-9.0, 9.0), rng.range(-9.0, 9.0)], attribute: rng.vec3(4.0) };
        let expected = at.attribute.as_dvec3() * f64::from(scale);
        let close = |found: f32, expected: f64| (f64::from(found) - expected).abs() <= 2e-6;
        let (color, light) = (texture.color(&NoTextures, at), texture.light(&NoTextures, at));
        for c in 0..3 {
            assert!(
                close(color[c], expected[c]) && close(light[c], expected[c].max(0.0)),
                "{texture:?} {at:?}: {color}"
            );
        }
        let luminance = 0.2126 * expected.x + 0.7152 * expected.y + 0.0722 * expected.z;
        assert!(close(texture.amount(&NoTextures, at), luminance), "{texture:?} {at:?}");
        assert_eq!(texture.gradient(&NoTextures, at.uv), [0.0; 2]);
    }
}

/// Coordinates that say nothing, and tiles that are not there, are no panic.
#[test]
fn nonsense_has_a_value() {
    for wrap in WRAPS {
        for filter in [Filter::Bilinear, Filter::Nearest] {
            let (bitmap, tiles, _) = image([130, 7], 3, Texel::Srgb8, wrap, filter);
            for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e9, 3e4, -3e4, 0.0, -0.0, 1.0] {
                for y in [f32::NAN, 1e30, -7.0, 1.0] {
                    let color = bitmap.color(&tiles, [x, y]);
                    assert!(color.cmpge(Vec3::ZERO).all() && color.cmple(Vec3::ONE).all(), "{x} {y}: {color}");
                    assert_eq!(bitmap.color(&NoTextures, [x, y]), Vec3::ZERO);
                    assert!(bitmap.gradient(&tiles, [x, y]).iter().all(|g| g.is_finite()));
                }
            }
        }
    }
}
