//! What a prepared scene is: every object by hash, the grid, and what was counted.

mod check;
#[cfg(test)]
pub(crate) mod tests;

use std::collections::BTreeSet;

use rayherd_render::aov::Aovs;
use rayherd_render::filter::Filter;
use rayherd_render::ray::PrimId;
use serde::{Deserialize, Serialize};

use crate::description::{Camera, Description, Substitution};
pub use crate::grid::{Candidate, StoppedBy};
use crate::grid::{Grid, GridData};
use crate::objects::{ObjectError, ObjectHash, ObjectKind, ObjectRef, ObjectStore};
use crate::prepare::PrepareSettings;
use crate::split::MESH_BYTES;

/// Version of the manifest and of everything it names. A change of any layout, of recentring, of the order of records
/// or of the grid's rules changes it; scenes of other versions are prepared again.
pub const FORMAT: u32 = 5;

/// A prepared scene. Its bytes are canonical ([`Manifest::encode`]); its name is their hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`FORMAT`].
    pub format: u32,
    /// How it was made.
    pub settings: PrepareSettings,
    /// Fingerprint of the source: see [`crate::prepare::fingerprint`].
    pub source: ObjectHash,
    /// Hash of every usable record (id, recentred f32 geometry, attributes) in source order and of the world: what
    /// defines the picture, the same however the scene was cut and wherever its files lie.
    pub content: ObjectHash,
    /// Centre of the source's bounds, source coordinates: `recentred = source - offset`.
    pub offset: [f64; 3],
    /// Lower corner of the scene's box, recentred.
    pub lo: [f32; 3],
    /// Upper corner of the scene's box, recentred.
    pub hi: [f32; 3],
    /// The world object: [`rayherd_render::world::World`] as JSON, put as [`ObjectKind::Manifest`].
    pub world: ObjectRef,
    /// The picture of the sky, [`rayherd_render::light::SkyMap`], if the world has one; put as [`ObjectKind::Texture`].
    pub sky_map: Option<ObjectRef>,
    /// Tiles of textures, by their number in the world.
    pub tiles: Vec<ObjectRef>,
    /// Splits by number: those cut from the source, in its order, then the copied ones.
    pub splits: Vec<SplitEntry>,
    /// The scheduling grid.
    pub grid: GridData,
    /// How the grid was chosen.
    pub choice: GridChoice,
    /// What the source says about camera, film and paths.
    pub defaults: Defaults,
    /// What was counted.
    pub counts: Counts,
    /// On a cluster: the stores, by number, on which the first copies of all blocks lie; on all of them without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub homes: Option<Vec<u32>>,
}

/// One split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitEntry {
    /// Block with tree, triangles, spheres and ids.
    pub geometry: ObjectRef,
    /// Shape numbers, normals, texture coordinates.
    pub attributes: ObjectRef,
    /// Triangles in it.
    pub triangles: u64,
    /// Spheres in it.
    pub spheres: u64,
    /// Lower corner of its primitives' box.
    pub lo: [f32; 3],
    /// Upper corner of its primitives' box.
    pub hi: [f32; 3],
    /// Least global id in it.
    pub first_id: PrimId,
    /// Largest global id in it.
    pub last_id: PrimId,
    /// Made by overlap reduction: every primitive in it is in another split as well.
    pub copied: bool,
}

impl SplitEntry {
    /// Bytes that it takes, but for how good its tree is: known before that is built, so that its place can be.
    pub fn weight(&self) -> u64 {
        (self.triangles + self.spheres) * MESH_BYTES + self.attributes.bytes
    }
}

/// How the grid was chosen, and what overlap reduction did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridChoice {
    /// The chosen subdivision.
    pub subdiv: u32,
    /// Subdivisions that were counted, ascending.
    pub candidates: Vec<Candidate>,
    /// Why the chosen one was taken.
    pub stopped_by: StoppedBy,
    /// Primitives that a split holds (condition 1).
    pub capacity: u64,
    /// Contested cells before overlap reduction.
    pub contested_cells: u64,
    /// Cells that were copied: contested ones and those that a split would have been left with.
    pub copied_cells: u64,
    /// Primitives in at least one contested cell, each counted once, before overlap reduction.
    pub contested_primitives: u64,
    /// Primitives in copied splits, each counted once per split.
    pub copies: u64,
    /// Geometry and attribute bytes of copied splits.
    pub rewritten_bytes: u64,
}

/// What the source says about camera, film and paths. The camera is in source coordinates: subtract
/// [`Manifest::offset`] from its position.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Defaults {
    /// The camera, if the source has one.
    pub camera: Option<Camera>,
    /// Width and height in pixels.
    pub size: Option<[u32; 2]>,
    /// Pixel filter.
    pub filter: Option<Filter>,
    /// Samples per pixel.
    pub spp: Option<u32>,
    /// As in [`Description::max_depth`].
    pub max_depth: Option<u32>,
    /// As in [`Description::rr_depth`].
    pub rr_depth: Option<u32>,
    /// As in [`Description::hide_emitters`].
    pub hide_emitters: bool,
    /// As in [`Description::aovs`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aovs: Option<Aovs>,
    /// Stand-ins that were made on request.
    pub substitutions: Vec<Substitution>,
}

impl Defaults {
    /// What `description` says.
    pub fn of(description: &Description) -> Self {
        Defaults {
            camera: description.camera.clone(),
            size: description.size,
            filter: description.filter,
            spp: description.spp,
            max_depth: description.max_depth,
            rr_depth: description.rr_depth,
            hide_emitters: description.hide_emitters,
            aovs: description.aovs,
            substitutions: description.substitutions.clone(),
        }
    }
}

/// What was counted while preparing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Records in the source, skipped ones too: global ids are below this.
    pub records: u64,
    /// Usable triangles.
    pub triangles: u64,
    /// Usable spheres.
    pub spheres: u64,
    /// Skipped: triangles of zero area, spheres of radius 0.
    pub degenerate: u64,
    /// Skipped: NaN or infinity in a coordinate.
    pub non_finite: u64,
    /// Skipped: a coordinate beyond what tracing can compute with.
    pub out_of_range: u64,
    /// Times that the source was read.
    pub source_reads: u32,
    /// Bytes of all these reads.
    pub source_bytes: u64,
}

/// Why a manifest is refused.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The bytes are no manifest.
    #[error("not a manifest: {0}; prepare the scene again")]
    Malformed(String),
    /// Made by another version.
    #[error("the scene was prepared in format {found}, this program reads format {FORMAT}; prepare it again")]
    Format {
        /// Its format.
        found: u64,
    },
    /// The store has a problem.
    #[error(transparent)]
    Store(#[from] ObjectError),
}

impl Manifest {
    /// Its bytes: the same manifest has the same bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec(self).unwrap_or_default();
        bytes.push(b'\n');
        bytes
    }

    /// Reads and checks a manifest: every index is in range, every number makes sense, and the bytes are canonical.
    /// Never panics.
    pub fn decode(bytes: &[u8]) -> Result<Manifest, ManifestError> {
        #[derive(Deserialize)]
        struct Head {
            format: u64,
        }
        let malformed = |e: serde_json::Error| ManifestError::Malformed(e.to_string());
        let head: Head = serde_json::from_slice(bytes).map_err(malformed)?;
        if head.format != u64::from(FORMAT) {
            return Err(ManifestError::Format { found: head.format });
        }
        let manifest: Manifest = serde_json::from_slice(bytes).map_err(malformed)?;
        manifest.check().map_err(ManifestError::Malformed)?;
        if manifest.encode() != bytes {
            return Err(ManifestError::Malformed("its bytes are not canonical".to_owned()));
        }
        Ok(manifest)
    }

    /// Its name: reference to its bytes.
    pub fn reference(&self) -> ObjectRef {
        ObjectRef::of(&self.encode())
    }

    /// Stores it and lets [`Manifest::lookup_name`] point to it.
    pub fn store(&self, store: &dyn ObjectStore) -> Result<ObjectRef, ObjectError> {
        let object = store.put(ObjectKind::Manifest, &self.encode())?;
        store.set_name(&Self::lookup_name(&self.source, &self.settings), &object)?;
        Ok(object)
    }

    /// Reads the manifest that a reference names.
    pub fn load(store: &dyn ObjectStore, object: &ObjectRef) -> Result<Manifest, ManifestError> {
        Self::decode(&store.get(object)?)
    }

    /// The name under which a scene of this source and these settings is found.
    pub fn lookup_name(source: &ObjectHash, settings: &PrepareSettings) -> String {
        let settings = serde_json::to_vec(settings).unwrap_or_default();
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"rayherd prepared scene\0").update(&FORMAT.to_le_bytes()).update(&source.0).update(&settings);
        format!("scene-{}", hasher.finalize().to_hex())
    }

    /// Looks for a scene that was prepared from this source with these settings, and whose objects are all there.
    pub fn find(
        store: &dyn ObjectStore,
        source: &ObjectHash,
        settings: &PrepareSettings,
    ) -> Result<Option<(ObjectRef, Manifest)>, ManifestError> {
        let Some(object) = store.name(&Self::lookup_name(source, settings))? else { return Ok(None) };
        let manifest = match Self::load(store, &object) {
            Ok(manifest) => manifest,
            // what is broken or old is prepared again
            Err(ManifestError::Store(e @ (ObjectError::Failed { .. } | ObjectError::Name { .. }))) => {
                return Err(e.into());
            }
            Err(reason) => {
                tracing::warn!("the scene that was prepared before cannot be used: {reason}");
                return Ok(None);
            }
        };
        for needed in manifest.objects() {
            if !store.has(needed)? {
                tracing::warn!("object {} of the scene that was prepared before is missing", needed.hash);
                return Ok(None);
            }
        }
        Ok((manifest.source == *source && manifest.settings == *settings).then_some((object, manifest)))
    }

    /// Every object that it names, but itself.
    pub fn objects(&self) -> impl Iterator<Item = &ObjectRef> {
        let splits = self.splits.iter().flat_map(|s| [&s.geometry, &s.attributes]);
        std::iter::once(&self.world).chain(&self.sky_map).chain(&self.tiles).chain(splits)
    }

    /// Bytes of geometry, attributes and texture tiles, copies left out and equal tiles once: what a pass over the scene reads.
    pub fn scene_bytes(&self) -> u64 {
        let splits: u64 = self.splits.iter().filter(|s| !s.copied).map(|s| s.geometry.bytes + s.attributes.bytes).sum();
        splits + self.texture_bytes()
    }

    /// Bytes of texture tiles, equal ones once.
    pub fn texture_bytes(&self) -> u64 {
        self.tiles.iter().collect::<BTreeSet<_>>().into_iter().map(|t| t.bytes).sum()
    }

    /// Its grid, ready to be walked.
    pub fn grid(&self) -> Result<Grid, ManifestError> {
        Grid::new(&self.grid, self.splits.len() as u32).map_err(|e| ManifestError::Malformed(e.to_string()))
    }
}
