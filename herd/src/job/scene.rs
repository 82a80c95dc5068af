//! A prepared scene, opened: what every task of a job shares.

use std::sync::Arc;

use rayherd_render::film::TILE;
use rayherd_render::frame::Frame;
use rayherd_render::light::{Lights, SkyMap};
use rayherd_render::path::Context;
use rayherd_render::ray::Ray;
use rayherd_render::skip::{Skip, Skips};
use rayherd_render::texture::Texture;
use rayherd_render::world::{Environment, World};
use rayherd_scene::grid::Grid;
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::ObjectStore;

use super::JobError;
use crate::plan::place;
use crate::resident::top_bytes;

/// Changes whenever another picture is made of the same scene and frame: no run goes on with another program's film, and no worker adds to it.
pub const PICTURE: u32 = 4;

/// A prepared scene with its small parts in memory: world, lights, grid. Blocks stay in the store.
pub struct PreparedScene {
    /// What it is made of.
    pub manifest: Manifest,
    /// Materials, shapes, emitters.
    pub world: World,
    /// Tables over the emitters.
    pub lights: Lights,
    /// Who owns which cell.
    pub grid: Grid,
    /// Where the objects are.
    pub objects: Arc<dyn ObjectStore>,
    /// Names how it is cut into splits: rays that wait for a split of one cut mean nothing in another.
    pub cut: String,
    skips: Skips,
}

impl PreparedScene {
    /// Reads the world and makes the grid ready.
    ///
    /// # Errors
    /// When an object is missing or corrupt, or the manifest makes no sense.
    pub fn open(manifest: Manifest, objects: Arc<dyn ObjectStore>) -> Result<Self, JobError> {
        let bytes = objects.get(&manifest.world)?;
        let malformed =
            |e: serde_json::Error| JobError::Scene(format!("its world cannot be read: {e}; prepare it again"));
        let world: World = serde_json::from_slice(&bytes).map_err(malformed)?;
        let broken = |what: String| JobError::Scene(format!("its world cannot be used: {what}; prepare it again"));
        world.check().map_err(broken)?;
        let mut sizes = world.textures.iter().flat_map(|texture| {
            let of = |n| match texture {
                Texture::Bitmap(bitmap) => bitmap.tile_bytes(n),
                Texture::Checkerboard(_) | Texture::Attribute { .. } => 0,
            };
            texture.tiles().map(of)
        });
        if !manifest.tiles.iter().map(|t| Some(t.bytes)).eq(sizes.by_ref().map(Some)) {
            return Err(broken("its textures have other tiles than the manifest".into()));
        }
        let most = manifest.grid.cells.iter().map(|c| c.owners.len()).max().unwrap_or(0);
        // a ray on its way names the owner that it goes to by 16 bits
        if most > usize::from(u16::MAX) {
            return Err(JobError::Scene(format!(
                "a cell of its grid has {most} owners, {} are the most: prepare it with fewer splits or a larger block size, or \
                 with overlap reduction (strategy scheduling-grid-overlap-reduced or auto)",
                u16::MAX
            )));
        }
        let sky_map = match &manifest.sky_map {
            Some(object) => {
                let map = SkyMap::decode(&objects.get(object)?);
                Some(Arc::new(map.map_err(|e| JobError::Scene(e.to_string()))?))
            }
            None => None,
        };
        if sky_map.is_some() != matches!(world.environment, Some(Environment::Map { .. })) {
            return Err(JobError::Scene("its world and its sky map do not belong together; prepare it again".into()));
        }
        let lights = Lights::with_sky_map(&world, sky_map);
        let grid = manifest.grid()?;
        let cut =
            serde_json::to_vec(&(&manifest.splits, &manifest.grid)).map_err(|e| JobError::Internal(e.to_string()))?;
        let cut = blake3::hash(&cut).to_hex()[..12].to_owned();
        Ok(PreparedScene { manifest, world, lights, grid, objects, cut, skips: Skips::ALL })
    }

    /// The same where only these skips are made by whatever renders it.
    pub fn skipping(mut self, skips: Skips) -> Self {
        self.skips = skips;
        if !skips.makes(Skip::Cells) {
            self.grid = self.grid.with_whole_cells();
            // rays visit cells in another order
            self.cut.push('w');
        }
        if !skips.makes(Skip::Lights) {
            self.lights = self.lights.leaving_out_none();
        }
        self
    }

    /// What is left out when it is rendered.
    pub fn skips(&self) -> Skips {
        self.skips
    }

    /// Number of splits.
    pub fn splits(&self) -> u32 {
        self.manifest.splits.len() as u32
    }
    /// Memory that a split takes: geometry and attributes, bytes.
    pub fn split_bytes(&self, split: u32) -> u64 {
        let s = &self.manifest.splits[split as usize];
        s.geometry.bytes + s.attributes.bytes
    }
    /// Room that the top trees of all splits take at most, were all of them in one task's memory.
    pub(crate) fn top_bytes(&self) -> u64 {
        self.grid
            .owning()
            .iter()
            .map(|s| &self.manifest.splits[s as usize])
            .map(|e| top_bytes(e.triangles + e.spheres))
            .sum()
    }
    /// The splits that rays can need, neighbours in space beside each other: those that own a cell. After overlap
    /// reduction a source split may own none, as all its primitives are in copies.
    pub fn owning_order(&self) -> Vec<u32> {
        let owning: Vec<u32> = self.grid.owning().iter().collect();
        let entry = |&s: &u32| &self.manifest.splits[s as usize];
        let boxes: Vec<_> = owning.iter().map(entry).map(|s| (s.lo, s.hi)).collect();
        place::order(&boxes).into_iter().map(|i| owning[i as usize]).collect()
    }
    /// Names what defines an image: the scene's content and the frame.
    ///
    /// # Errors
    /// When the frame cannot be written down, which is a mistake of Rayherd.
    pub fn image_name(&self, frame: &Frame) -> Result<String, JobError> {
        let frame = serde_json::to_vec(frame).map_err(|e| JobError::Internal(e.to_string()))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(format!("rayherd image {PICTURE}\0").as_bytes()).update(&self.manifest.content.0).update(&frame);
        if !self.skips.makes(Skip::Lights) {
            hasher.update(b"\0every light");
        }
        Ok(hasher.finalize().to_hex().to_string())
    }
    /// What every path of a frame shares, but for textures.
    pub fn context<'a>(&'a self, frame: &'a Frame) -> Context<'a> {
        Context::new(&self.world, &self.lights, frame).skipping(self.skips)
    }

    /// The split where each film tile's camera rays start: the owner of the first cell on the ray through the middle of
    /// the tile; the first owner of all for a tile that looks past the scene.
    pub fn start_splits(&self, frame: &Frame) -> Vec<u32> {
        let [w, h] = frame.size;
        let first = self.grid.owning().iter().next().unwrap_or(0);
        let mut out = Vec::new();
        for y in (0..h).step_by(TILE as usize) {
            for x in (0..w).step_by(TILE as usize) {
                let middle = |a: u32, end: u32| f64::from(a) + 0.5 * f64::from(TILE.min(end - a));
                // about the middle of a lens
                let (o, d) = frame.camera.ray(middle(x, w), middle(y, h), || [1 << 31; 2]);
                let ray = Ray { o, tmin: 0.0, d, tmax: f32::INFINITY };
                let cell = self.grid.first_cell(&ray);
                out.push(cell.and_then(|c| c.owners.first().copied()).unwrap_or(first));
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{cornell, prepared};

    #[test]
    fn owners_that_16_bits_cannot_number_are_refused() {
        let scene = prepared(&cornell(), 3, false);
        let open = |owners: u32| {
            let mut manifest = scene.manifest.clone();
            manifest.grid.cells[0].owners = (0..owners).collect();
            PreparedScene::open(manifest, scene.objects.clone()).err()
        };
        let error = open(65_536).unwrap();
        assert!(error.is_users());
        assert!(
            error.to_string().contains("65536 owners, 65535 are the most: prepare it with fewer splits"),
            "{error}"
        );
        // so many can be numbered, but three splits do not have them
        assert!(!open(65_535).unwrap().to_string().contains("are the most"));
    }

    #[test]
    fn small_blocks_take_little_of_a_top_tree() {
        assert_eq!([0, 1, 7, 256, 1 << 20].map(top_bytes), [256, 256, 1792, 65_536, 65_536]);
        let scene = prepared(&cornell(), 3, true);
        assert!(scene.top_bytes() > 0 && scene.top_bytes() <= 256 * (scene.manifest.counts.triangles + 1000));
    }
}
