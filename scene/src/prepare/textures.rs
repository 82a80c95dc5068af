//! Images to tiles in the store.

use rayherd_render::texture::{Bitmap, TILE, Texture};
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

/// Reads every image once, one at a time, and stores its tiles.
pub(super) fn store(textures: &[description::Texture], store: &CountingStore) -> Result<Stored, PrepareError> {
    let mut out = Stored { textures: Vec::new(), tiles: Vec::new(), bytes_read: 0 };
    for texture in textures {
        let made = match &texture.kind {
            TextureKind::Checkerboard(checkerboard) => Texture::Checkerboard(checkerboard.clone()),
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
                Texture::Bitmap(bitmap)
            }
        };
        out.textures.push(made);
    }
    Ok(out)
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
