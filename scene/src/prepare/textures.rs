//! Images to tiles in the store; and how much light a texture gives each primitive that it shines from.

use std::cell::{Ref, RefCell};
use std::collections::BTreeMap;

use rayherd_render::math::luminance;
use rayherd_render::texture::{At, Bitmap, NoTextures, TILE, Texture, Textures};
use rayherd_render::world::{Glow, Primitive, sphere_uv};
use rayon::prelude::*;

use super::PrepareError;
use super::counting::CountingStore;
use crate::description::{self, TextureKind};
use crate::image::{self, Image};
use crate::objects::{ObjectKind, ObjectRef, ObjectStore};

/// Stored textures.
pub(super) struct Stored {
    /// For the world.
    pub textures: Vec<Texture>,
    /// For the manifest, by number.
    pub tiles: Vec<ObjectRef>,
    /// Of image files.
    pub bytes_read: u64,
}

/// By number of a texture: the primitives whose emission it gives.
pub(super) type Shining<'a> = BTreeMap<u32, Vec<(&'a mut Glow, Primitive)>>;

/// Reads every image once, one at a time, and stores its tiles. Weighs what shines.
pub(super) fn store(
    textures: &[description::Texture],
    mut shining: Shining,
    store: &CountingStore,
) -> Result<Stored, PrepareError> {
    let mut out = Stored { textures: Vec::new(), tiles: Vec::new(), bytes_read: 0 };
    for (number, texture) in (0u32..).zip(textures) {
        let shining = shining.remove(&number).unwrap_or_default();
        let made = match &texture.kind {
            TextureKind::Checkerboard(checkerboard) => {
                let [a, b] = checkerboard.colors.map(|c| luminance(c.into()));
                let made = Texture::Checkerboard(checkerboard.clone());
                weigh(shining, &made, &NoTextures, 0.5 * (a + b));
                made
            }
            TextureKind::Attribute { scale, .. } => {
                let made = Texture::Attribute { scale: *scale };
                weigh(shining, &made, &NoTextures, 0.0);
                made
            }
            TextureKind::Image { path, raw, wrap, filter, to_uv } => {
                let failed = |why: String| image::error(path, &texture.place, &why);
                let image = image::read(path, *raw).map_err(failed)?;
                out.bytes_read += std::fs::metadata(path).map_or(0, |m| m.len());
                let first_tile = u32::try_from(out.tiles.len()).unwrap_or(u32::MAX);
                let bitmap = Bitmap {
                    size: image.header.size,
                    channels: image.header.channels,
                    texel: image.header.texel,
                    wrap: *wrap,
                    filter: *filter,
                    to_uv: *to_uv,
                    first_tile,
                };
                if bitmap.tiles().end >= 1 << 28 {
                    return Err(
                        failed("is one texture too many: 2^28 tiles of 128 x 128 texels are the most".into()).into()
                    );
                }
                let [across, _] = bitmap.tiles_each_way();
                let numbers = 0..bitmap.tiles().end - first_tile;
                let put = |n: u32| store.put(ObjectKind::Texture, &cut(&image, &bitmap, [n % across, n / across]));
                // in order, so that the first error is always the same one
                let stored: Vec<_> = numbers.into_par_iter().map(put).collect();
                for tile in stored {
                    out.tiles.push(tile?);
                }
                let made = Texture::Bitmap(bitmap);
                if let (false, Texture::Bitmap(bitmap)) = (shining.is_empty(), &made) {
                    let tiles = Cut::new(&image, bitmap);
                    weigh(shining, &made, &tiles, tiles.mean(bitmap));
                }
                made
            }
        };
        out.textures.push(made);
    }
    Ok(out)
}

/// Points of a primitive at which its texture is looked up to weigh it.
const POINTS: u32 = 64;
/// A primitive weighs at least this share of what the whole texture has in the mean, so that one on which no point met the light is chosen too.
const LEAST: f32 = 1.0 / 64.0;

/// Gives each primitive the mean luminance that the texture has on it. What is chosen by it is chosen with just the probability that is said
/// of it: a weight that is not exact costs noise only.
fn weigh(shining: Vec<(&mut Glow, Primitive)>, texture: &Texture, tiles: &dyn Textures, mean: f32) {
    for (glow, geometry) in shining {
        let mut sum = 0.0f64;
        for i in 0..POINTS {
            // a Hammersley point set
            let (x, y) = ((f64::from(i) + 0.5) / f64::from(POINTS), f64::from(i.reverse_bits()) / 4_294_967_296.0);
            let at = match geometry {
                Primitive::Triangle(_) => glow.on_triangle((x.sqrt() * (1.0 - y)) as f32, (x.sqrt() * y) as f32),
                Primitive::Sphere { .. } => {
                    let (z, turn) = (1.0 - 2.0 * x, std::f64::consts::TAU * y);
                    let r = (1.0 - z * z).max(0.0).sqrt();
                    At::uv(sphere_uv([r * libm::cos(turn), r * libm::sin(turn), z].map(|v| v as f32).into()))
                }
            };
            sum += f64::from(luminance(texture.light(tiles, at)));
        }
        glow.weight = (sum / f64::from(POINTS)).max(f64::from(LEAST * mean)) as f32;
    }
}

/// An image's tiles in memory.
struct Cut {
    tiles: RefCell<Vec<Vec<u8>>>,
    first: u32,
}

impl Cut {
    fn new(image: &Image, bitmap: &Bitmap) -> Cut {
        let [across, _] = bitmap.tiles_each_way();
        let tile = |n: u32| cut(image, bitmap, [n % across, n / across]);
        Cut { tiles: RefCell::new((0..bitmap.tiles().len() as u32).map(tile).collect()), first: bitmap.first_tile }
    }

    /// Mean luminance of all texels.
    fn mean(&self, bitmap: &Bitmap) -> f32 {
        let each = bitmap.texel_bytes();
        let (mut sum, mut count) = (0.0f64, 0u64);
        for tile in self.tiles.borrow().iter() {
            for at in (0..tile.len()).step_by(each) {
                let light = luminance(bitmap.texel.read(bitmap.channels, tile, at));
                sum += if light > 0.0 && light.is_finite() { f64::from(light) } else { 0.0 };
                count += 1;
            }
        }
        (sum / count.max(1) as f64) as f32
    }
}

impl Textures for Cut {
    fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        let n = number.checked_sub(self.first)? as usize;
        Ref::filter_map(self.tiles.borrow(), |tiles| tiles.get(n).map(Vec::as_slice)).ok()
    }
}

/// The bytes of a tile.
fn cut(image: &Image, bitmap: &Bitmap, at: [u32; 2]) -> Vec<u8> {
    let [w, h] = bitmap.tile_size(at).map(|n| n as usize);
    let [x, y] = at.map(|n| (n * TILE) as usize);
    let (width, each) = (bitmap.size[0] as usize, bitmap.texel_bytes());
    let row = |j: usize| {
        let start = ((y + j) * width + x) * each;
        &image.bytes[start..start + w * each]
    };
    (0..h).map(row).collect::<Vec<_>>().concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Header;
    use rayherd_render::texture::{Checkerboard, Filter, Texel, UvMap, Wrap};

    fn glow(uv: [[f32; 2]; 3]) -> Glow {
        Glow { prim: 0, uv: Some(uv), attribute: Some([[1.0; 3], [2.0; 3], [6.0; 3]]), weight: 0.0 }
    }

    fn weight(texture: &Texture, tiles: &dyn Textures, mean: f32, mut glow: Glow, geometry: Primitive) -> f32 {
        weigh(vec![(&mut glow, geometry)], texture, tiles, mean);
        glow.weight
    }

    #[test]
    fn weights_are_means_on_the_primitive() {
        let triangle = Primitive::Triangle([[0.0; 3]; 3]);
        // linear over the triangle: the mean of its corners
        let found = weight(&Texture::Attribute { scale: 2.0 }, &NoTextures, 0.0, glow([[0.0; 2]; 3]), triangle);
        assert!((found - 6.0).abs() < 0.1, "{found}");
        // a picture of 300 x 2 whose left third is lit by 0.6
        let header = Header { size: [300, 2], channels: 1, texel: Texel::Linear8 };
        let bytes = (0..600).map(|i| if i % 300 < 100 { 153 } else { 0 }).collect();
        let image = Image { header, bytes };
        let bitmap = Bitmap {
            size: header.size,
            channels: 1,
            texel: header.texel,
            wrap: Wrap::Clamp,
            filter: Filter::Nearest,
            to_uv: UvMap::IDENTITY,
            first_tile: 5,
        };
        let tiles = Cut::new(&image, &bitmap);
        let mean = tiles.mean(&bitmap);
        assert!((mean - 0.2).abs() < 1e-6, "{mean}");
        let texture = Texture::Bitmap(bitmap);
        let of = |uv| weight(&texture, &tiles, mean, glow(uv), triangle);
        // wholly lit; wholly dark: a little of the mean; a quarter of it lit
        assert!((of([[0.0, 0.0], [0.3, 0.0], [0.0, 1.0]]) - 0.6).abs() < 1e-6);
        assert_eq!(of([[0.5, 0.0], [0.9, 0.0], [0.5, 1.0]]), LEAST * mean);
        let quarter = of([[0.0, 0.0], [2.0 / 3.0, 0.0], [2.0 / 3.0, 1.0]]);
        assert!((quarter - 0.25 * 0.6).abs() < 0.02, "{quarter}");
        // a sphere whose upper half is lit
        let colors = [[1.0; 3], [0.0; 3]];
        let squares = Texture::Checkerboard(Checkerboard { to_uv: UvMap([[0.0; 3], [0.0, 1.0, 0.0]]), colors });
        let sphere = Primitive::Sphere { center: [0.0; 3], radius: 1.0, flipped: false };
        let found =
            weight(&squares, &NoTextures, 0.5, Glow { uv: None, attribute: None, ..glow([[0.0; 2]; 3]) }, sphere);
        assert!((found - 0.5).abs() < 0.03, "{found}");
        // dark everywhere is dark
        let dark = Texture::Checkerboard(Checkerboard { to_uv: UvMap::IDENTITY, colors: [[0.0; 3]; 2] });
        assert_eq!(weight(&dark, &NoTextures, 0.0, glow([[0.0; 2]; 3]), triangle), 0.0);
    }
}
