//! Virtual nodes: memory, disk and network of each, with every byte counted.
//!
//! A node's ray groups and film parts are in the job's store, in a folder for each node (`nodes/N/..`); its copies of the
//! scene's blocks are files on its [disk](super::disks) when there is more than one node. A single node reads blocks where
//! they were prepared.

use std::sync::{Arc, Mutex, PoisonError, RwLock};

use bytes::Bytes as Body;
use rayherd_render::skip::Skip;
use rayherd_scene::objects::ObjectRef;
use tokio::runtime::Runtime;

use super::disks::{Disks, damaged};
use crate::job::{JobError, JobSettings, PreparedScene};
use crate::plan::place;
use crate::report::{Bytes, Kind, NodeReport, Op, Place, Stage};
use crate::resident::{Blocks, Memory};
use crate::store::{BlockStore, StoreError, kind_of_key};
use crate::textures::{TileCache, Tiles, all_tile_bytes, tile_holders, tile_of};
use crate::wire::WireError;

/// Nodes that get a copy of each split: a function of the scene and their number, so that all who ask agree.
pub fn placement(scene: &PreparedScene, nodes: u32, replicas: u32) -> Vec<Vec<u32>> {
    let order = scene.owning_order();
    let sizes: Vec<u64> = order.iter().map(|&s| scene.manifest.splits[s as usize].weight()).collect();
    // what nobody ever reads lies on the first nodes
    let mut holders = vec![(0..replicas).collect::<Vec<u32>>(); scene.splits() as usize];
    for (&split, on) in order.iter().zip(place::holders(&sizes, nodes, replicas)) {
        holders[split as usize] = on;
    }
    holders
}

/// What an object of the scene belongs to, and so where it lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// A split, by number.
    Split(u32),
    /// A tile of a texture, by number.
    Tile(u32),
}

/// Reads blocks and tiles of the scene from the stores of real nodes.
pub trait Fetch: Send + Sync {
    /// An object, and whether it lay on the node that asks.
    ///
    /// # Errors
    /// When no copy can be had.
    fn fetch(&self, part: Part, object: &ObjectRef) -> Result<(Vec<u8>, Place), JobError>;
}

/// All nodes.
pub struct Nodes<'a> {
    scene: &'a PreparedScene,
    store: Arc<dyn BlockStore>,
    runtime: Runtime,
    replicas: u32,
    /// Nodes that hold rays and film: the first ones.
    keepers: u32,
    fetch: Option<Box<dyn Fetch + 'a>>,
    memories: Vec<Memory>,
    tiles: Vec<TileCache>,
    /// None for a single node, and for real ones.
    disks: Option<Disks>,
    /// Nodes that hold a split, by split number.
    holders: RwLock<Vec<Vec<u32>>>,
    counts: Mutex<Counts>,
    /// What was read at least once; not known where `fetch` reads, or others do.
    read: Option<Mutex<ReadOnce>>,
}

/// By number: whether it was read.
struct ReadOnce {
    splits: Vec<bool>,
    tiles: Vec<bool>,
    /// What was read for the first time since this was asked last.
    new: Vec<Part>,
}

#[derive(Default)]
struct Counts {
    bytes: Bytes,
    nodes: Vec<NodeReport>,
}

impl<'a> Nodes<'a> {
    /// Nodes with blocks placed on them along a curve through space.
    pub fn new(scene: &'a PreparedScene, settings: &JobSettings, store: Arc<dyn BlockStore>) -> Result<Self, JobError> {
        let mut nodes = Self::real(scene, settings, store, settings.nodes.len() as u32, None)?;
        if settings.nodes.len() > 1 {
            nodes.disks = Some(Disks::new(settings.nodes.len(), nodes.replicas as usize)?);
        }
        Ok(nodes.noting_reads())
    }

    /// The same; what is read is noted.
    #[must_use]
    pub fn noting_reads(mut self) -> Self {
        let (splits, tiles) = (self.scene.manifest.splits.len(), self.scene.manifest.tiles.len());
        let none = ReadOnce { splits: vec![false; splits], tiles: vec![false; tiles], new: Vec::new() };
        self.read = Some(Mutex::new(none));
        self
    }

    /// Nodes of which the first `keepers` hold rays and film, in stores of their own below `nodes/N/`; blocks come from `fetch`.
    pub fn real(
        scene: &'a PreparedScene,
        settings: &JobSettings,
        store: Arc<dyn BlockStore>,
        keepers: u32,
        fetch: Option<Box<dyn Fetch + 'a>>,
    ) -> Result<Self, JobError> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.map_err(|e| JobError::Internal(format!("no runtime for input and output: {e}")))?;
        let count = settings.nodes.len() as u32;
        let replicas = settings.replicas.clamp(1, count);
        let holders = placement(scene, count, replicas);
        let memory = settings.memory_per_node.unwrap_or(u64::MAX);
        let nodes = settings.nodes.iter().map(|n| NodeReport { slots: n.slots, ..NodeReport::default() }).collect();
        Ok(Nodes {
            disks: None,
            keepers: keepers.max(1),
            fetch,
            scene,
            store,
            runtime,
            replicas,
            memories: settings.nodes.iter().map(|_| Memory::new(memory)).collect(),
            tiles: settings
                .nodes
                .iter()
                .map(|_| TileCache::new(settings.texture_memory, all_tile_bytes(scene)))
                .collect(),
            holders: RwLock::new(holders),
            counts: Mutex::new(Counts { nodes, ..Counts::default() }),
            read: None,
        })
    }

    /// A node's memory.
    pub fn memory(&self, node: u32) -> &Memory {
        &self.memories[node as usize]
    }
    /// Bytes of scene data that all nodes of this process hold in memory.
    pub fn resident(&self) -> u64 {
        self.memories.iter().map(Memory::held).sum()
    }
    /// A node's texture tiles.
    pub fn tiles(&self, node: u32) -> &TileCache {
        &self.tiles[node as usize]
    }
    /// Nodes that hold each split.
    pub fn holders(&self) -> Vec<Vec<u32>> {
        self.holders.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
    /// The job's store.
    pub fn store(&self) -> &Arc<dyn BlockStore> {
        &self.store
    }
    /// Waits for an operation of the store.
    pub fn wait<T>(&self, operation: impl Future<Output = T>) -> T {
        self.runtime.block_on(operation)
    }
    /// Blocks as a node sees them.
    pub fn blocks(&self, node: u32) -> NodeBlocks<'_, 'a> {
        NodeBlocks { nodes: self, node }
    }

    fn note_read(&self, part: Part) {
        let Some(read) = &self.read else { return };
        let mut read = read.lock().unwrap_or_else(PoisonError::into_inner);
        let read = &mut *read;
        let known = match part {
            Part::Split(n) => &mut read.splits[n as usize],
            Part::Tile(n) => &mut read.tiles[n as usize],
        };
        if !std::mem::replace(known, true) {
            read.new.push(part);
        }
    }

    /// Splits and texture tiles that were read for the first time since this was asked last, by number.
    pub fn take_reads(&self) -> (Vec<u32>, Vec<u32>) {
        let Some(read) = &self.read else { return Default::default() };
        let new = std::mem::take(&mut read.lock().unwrap_or_else(PoisonError::into_inner).new);
        let (mut splits, mut tiles) = (Vec::new(), Vec::new());
        for part in new {
            match part {
                Part::Split(n) => splits.push(n),
                Part::Tile(n) => tiles.push(n),
            }
        }
        (splits, tiles)
    }

    /// How many splits and texture tiles no node has read; none if that is not known here.
    pub fn never_read(&self) -> Option<[u64; 2]> {
        let read = self.read.as_ref()?.lock().unwrap_or_else(PoisonError::into_inner);
        Some([&read.splits, &read.tiles].map(|list| list.iter().filter(|&&r| !r).count() as u64))
    }

    /// Reads what is read though nothing asks for it, as far as the scene's skips do not leave it out: on the first node.
    ///
    /// # Errors
    /// When something cannot be read.
    pub fn read_unasked(&self) -> Result<(), JobError> {
        let (skips, blocks) = (self.scene.skips(), self.blocks(0));
        if !skips.makes(Skip::Splits) {
            for split in 0..self.scene.splits() {
                blocks.geometry(split)?;
                blocks.attributes(split)?;
            }
        }
        if !skips.makes(Skip::Textures) {
            for tile in (0..).take(self.scene.manifest.tiles.len()) {
                self.tiles[0].get(tile, &blocks)?;
            }
        }
        Ok(())
    }

    /// Counts bytes that a node moved.
    pub fn count(&self, stage: Stage, op: Op, kind: Kind, node: u32, place: Place, bytes: u64) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.bytes.add(stage, op, kind, place, bytes);
        if op == Op::Read
            && place != Place::Cache
            && let Some(report) = counts.nodes.get_mut(node as usize)
        {
            report.reads += bytes;
            if place == Place::Remote {
                report.remote_reads += bytes;
            }
        }
    }
    /// Counts bytes that a node moved, as it has counted them itself.
    pub fn count_all(&self, node: u32, bytes: &Bytes) {
        bytes.rows().iter().for_each(|r| self.count(r.stage, r.op, r.kind, node, r.place, r.bytes));
    }
    /// Counts the time of a task.
    pub fn busy(&self, node: u32, seconds: f64) {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner).nodes[node as usize].busy += seconds;
    }
    /// The bytes counted since this was asked last.
    pub fn take_bytes(&self) -> Bytes {
        std::mem::take(&mut self.counts.lock().unwrap_or_else(PoisonError::into_inner).bytes)
    }
    /// All counts.
    pub fn report(&self) -> (Bytes, Vec<NodeReport>) {
        let counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let mut nodes = counts.nodes.clone();
        for ((report, memory), tiles) in nodes.iter_mut().zip(&self.memories).zip(&self.tiles) {
            report.peak_scene_bytes = memory.peak();
            report.peak_texture_bytes = tiles.peak();
        }
        (counts.bytes.clone(), nodes)
    }

    /// Stores an object on a node and on as many others as there are copies to be; the nodes that hold it.
    pub fn put(&self, node: u32, kind: Kind, name: &str, body: Body) -> Result<Vec<u32>, JobError> {
        let mut holders = Vec::new();
        let mut error = None;
        // one that does not take it is passed over as long as there are others
        for holder in (0..self.keepers).map(|k| (node + k) % self.keepers) {
            match self.wait(self.store.put(&disk_key(holder, name), body.clone())) {
                Ok(()) => {
                    let place = if holder == node { Place::Local } else { Place::Remote };
                    self.count(Stage::Trace, Op::Write, kind, node, place, body.len() as u64);
                    holders.push(holder);
                }
                Err(e @ (StoreError::Unavailable { .. } | StoreError::Full { .. })) if self.keepers > 1 => {
                    tracing::warn!("{e}");
                    error = Some(e);
                }
                Err(e) => return Err(e.into()),
            }
            if holders.len() as u32 >= self.replicas.min(self.keepers) {
                return Ok(holders);
            }
        }
        let few = || JobError::Internal(format!("{name} has {} copies", holders.len()));
        Err(error.map_or_else(few, JobError::from))
    }

    /// Reads an object, from the node itself if it holds a copy; a copy that is missing or broken is passed over.
    ///
    /// # Errors
    /// [`JobError::Lost`] when no copy is whole and every holder answers.
    pub fn get<T>(
        &self,
        node: u32,
        kind: Kind,
        name: &str,
        holders: &[u32],
        open: impl Fn(&Body) -> Result<T, WireError>,
    ) -> Result<T, JobError> {
        let own = holders.iter().filter(|&&h| h == node);
        let others = holders.iter().filter(|&&h| h != node);
        let mut why = "no node holds it".to_owned();
        let mut silent = None;
        for &holder in own.chain(others) {
            match self.wait(self.store.get(&disk_key(holder, name))) {
                Ok(body) => {
                    let place = if holder == node { Place::Local } else { Place::Remote };
                    self.count(Stage::Trace, Op::Read, kind, node, place, body.len() as u64);
                    match open(&body) {
                        Ok(opened) => return Ok(opened),
                        Err(e) => why = format!("copy on node {holder}: {e}"),
                    }
                    tracing::warn!("{name}: {why}");
                }
                Err(e @ (StoreError::NotFound { .. } | StoreError::Corrupt { .. })) => why = e.to_string(),
                // another holder may answer
                Err(e @ StoreError::Unavailable { .. }) => silent = Some(e),
                Err(e) => return Err(e.into()),
            }
        }
        if let Some(e) = silent {
            return Err(e.into());
        }
        Err(JobError::Lost { name: name.to_owned(), why })
    }

    /// After a node was lost: copies an object from another holder, if any is left, to a node without a copy; its holders.
    pub fn copy_again(&self, kind: Kind, name: &str, holders: &[u32], gone: u32) -> Result<Vec<u32>, JobError> {
        let mut left: Vec<u32> = holders.iter().copied().filter(|&h| h != gone).collect();
        let count = self.memories.len() as u32;
        let to = (1..=count).map(|k| (gone + k) % count).find(|n| !left.contains(n));
        if let (Some(&from), Some(to)) = (left.first(), to)
            && let Ok(body) = self.wait(self.store.get(&disk_key(from, name)))
        {
            self.count(Stage::Trace, Op::Write, kind, from, Place::Remote, body.len() as u64);
            self.wait(self.store.put(&disk_key(to, name), body))?;
            left.push(to);
        }
        Ok(left)
    }

    /// Copies an object that lies on a store which is silent to others that take it, until there are enough; who holds it then. None if
    /// no copy can be had. What is copied is checked by whoever reads it.
    ///
    /// # Errors
    /// When a store refuses for good.
    pub fn copy_elsewhere(&self, name: &str, holders: &[u32], gone: u32) -> Result<Option<Vec<u32>>, JobError> {
        let mut left: Vec<u32> = holders.iter().copied().filter(|&h| h != gone).collect();
        let found = left.iter().find_map(|&h| Some((h, self.wait(self.store.get(&disk_key(h, name))).ok()?)));
        let Some((from, body)) = found else { return Ok(None) };
        let enough = self.replicas.min(self.keepers) as usize;
        for to in (1..self.keepers).map(|k| (gone + k) % self.keepers) {
            if left.len() >= enough {
                break;
            }
            if left.contains(&to) {
                continue;
            }
            match self.wait(self.store.put(&disk_key(to, name), body.clone())) {
                Ok(()) => {
                    self.count(Stage::Trace, Op::Write, kind_of_key(name), from, Place::Remote, body.len() as u64);
                    left.push(to);
                }
                Err(e @ (StoreError::Unavailable { .. } | StoreError::Full { .. })) => tracing::warn!("{e}"),
                Err(e) => return Err(e.into()),
            }
        }
        Ok(Some(left))
    }

    /// Changes a byte of a copy, for tests.
    pub fn corrupt(&self, holder: u32, name: &str, at: u64) -> Result<(), JobError> {
        let key = disk_key(holder, name);
        if let Ok(body) = self.wait(self.store.get(&key)) {
            self.wait(self.store.put(&key, damaged(&body, at)))?;
        }
        Ok(())
    }

    /// Changes a byte of a copy of a block on a disk, for tests. `pick` chooses which: below the number it is given.
    pub fn corrupt_block(&self, pick: impl Fn(u64) -> u64) -> Result<(), JobError> {
        let Some(disks) = &self.disks else { return Ok(()) };
        let split = pick(self.scene.manifest.splits.len() as u64) as usize;
        let entry = &self.scene.manifest.splits[split];
        let object =
            if pick(2) == 0 { (Kind::Geometry, &entry.geometry) } else { (Kind::Attributes, &entry.attributes) };
        let holders = self.holders.read().unwrap_or_else(PoisonError::into_inner)[split].clone();
        let node = holders.get(pick(holders.len() as u64) as usize).copied().unwrap_or(0);
        self.wait(disks.corrupt(node, object, pick(object.1.bytes)))
    }

    /// Deletes all copies of objects.
    pub fn delete(&self, objects: &[(String, Vec<u32>)]) -> Result<(), JobError> {
        let keys: Vec<String> =
            objects.iter().flat_map(|(name, holders)| holders.iter().map(|&h| disk_key(h, name))).collect();
        if keys.is_empty() {
            return Ok(());
        }
        Ok(self.wait(self.store.delete(&keys))?)
    }

    /// A node loses its disk and its memory, and starts again empty; splits that it held are copied from others.
    pub fn lose(&self, node: u32) -> Result<(), JobError> {
        let keys = self.wait(self.store.list(&format!("nodes/{node}/")))?;
        let keys: Vec<String> = keys.into_iter().map(|k| k.0).collect();
        self.wait(self.store.delete(&keys))?;
        self.memories[node as usize].clear();
        self.tiles[node as usize].clear();
        let count = self.memories.len() as u32;
        let mut moved = Vec::new();
        {
            let mut holders = self.holders.write().unwrap_or_else(PoisonError::into_inner);
            for (split, on) in holders.iter_mut().enumerate() {
                let before = on.len();
                on.retain(|&h| h != node);
                // copied again, to the first node without a copy; from where the scene was prepared if there is none left
                if on.len() < before
                    && let Some(to) = (1..=count).map(|k| (node + k) % count).find(|n| !on.contains(n))
                {
                    on.push(to);
                    let entry = &self.scene.manifest.splits[split];
                    for (kind, object) in [(Kind::Geometry, &entry.geometry), (Kind::Attributes, &entry.attributes)] {
                        self.count(Stage::Trace, Op::Write, kind, to, Place::Remote, object.bytes);
                        moved.push((kind, object, on.clone()));
                    }
                }
            }
        }
        // tiles lie where their numbers say: the node, which is empty now, gets those that others hold
        for (number, object) in (0..).zip(&self.scene.manifest.tiles) {
            let on = tile_holders(number, count, self.replicas);
            if on.len() > 1 && on.contains(&node) {
                self.count(Stage::Trace, Op::Write, Kind::Texture, node, Place::Remote, object.bytes);
                moved.push((Kind::Texture, object, on));
            }
        }
        match &self.disks {
            Some(disks) => self.wait(disks.lose(node, moved.into_iter())),
            None => Ok(()),
        }
    }
}

/// Key of a node's copy of an object.
pub fn disk_key(node: u32, name: &str) -> String {
    format!("nodes/{node}/{name}")
}

/// Blocks of the scene, as one node reads them.
pub struct NodeBlocks<'n, 'a> {
    nodes: &'n Nodes<'a>,
    node: u32,
}

impl NodeBlocks<'_, '_> {
    fn read(&self, part: Part, kind: Kind, object: &ObjectRef) -> Result<Vec<u8>, JobError> {
        let (nodes, node) = (self.nodes, self.node);
        nodes.note_read(part);
        if let Some(fetch) = &nodes.fetch {
            let (bytes, place) = fetch.fetch(part, object)?;
            nodes.count(Stage::Trace, Op::Read, kind, node, place, bytes.len() as u64);
            return Ok(bytes);
        }
        let Some(disks) = &nodes.disks else {
            let bytes = nodes.scene.objects.get(object)?;
            nodes.count(Stage::Trace, Op::Read, kind, node, Place::Local, bytes.len() as u64);
            return Ok(bytes);
        };
        let holders = match part {
            Part::Split(n) => nodes.holders.read().unwrap_or_else(PoisonError::into_inner)[n as usize].clone(),
            Part::Tile(n) => tile_holders(n, nodes.memories.len() as u32, nodes.replicas),
        };
        let read = disks.read(node, (kind, object), &holders, nodes.scene.objects.as_ref());
        let (body, counted) = nodes.wait(read)?;
        counted.rows().iter().for_each(|r| nodes.count(r.stage, r.op, r.kind, node, r.place, r.bytes));
        Ok(body.into())
    }
    /// Counts a use of splits that are in memory already.
    pub fn count_warm(&self, splits: &[u32]) {
        for &split in splits {
            self.warm_object(Kind::Geometry, &self.nodes.scene.manifest.splits[split as usize].geometry);
        }
    }
    /// The same of their attributes.
    pub fn count_warm_attributes(&self, splits: impl Iterator<Item = u32>) {
        for split in splits {
            self.warm_object(Kind::Attributes, &self.nodes.scene.manifest.splits[split as usize].attributes);
        }
    }
    fn warm_object(&self, kind: Kind, object: &ObjectRef) {
        self.nodes.count(Stage::Trace, Op::Read, kind, self.node, Place::Cache, object.bytes);
    }
}

impl Blocks for NodeBlocks<'_, '_> {
    fn geometry(&self, split: u32) -> Result<Vec<u8>, JobError> {
        self.read(Part::Split(split), Kind::Geometry, &self.nodes.scene.manifest.splits[split as usize].geometry)
    }
    fn attributes(&self, split: u32) -> Result<Vec<u8>, JobError> {
        self.read(Part::Split(split), Kind::Attributes, &self.nodes.scene.manifest.splits[split as usize].attributes)
    }
}

impl Tiles for NodeBlocks<'_, '_> {
    fn tile(&self, number: u32) -> Result<Vec<u8>, JobError> {
        self.read(Part::Tile(number), Kind::Texture, tile_of(self.nodes.scene, number)?)
    }
    fn warm(&self, number: u32) {
        let bytes = self.nodes.scene.manifest.tiles.get(number as usize).map_or(0, |t| t.bytes);
        self.nodes.count(Stage::Trace, Op::Read, Kind::Texture, self.node, Place::Cache, bytes);
    }
}
