//! The splits that a node holds in memory, and how they come and go.

use std::collections::BTreeSet;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};

use rayherd_render::attributes::AttributeBlock;
use rayherd_render::bvh::Forest;
use rayherd_render::memory::prefetch;
use rayherd_render::path::{Surface, Surfaces};
use rayherd_render::ray::{Hit, PrimId};
use rayherd_scene::grid::SplitSet;

use crate::job::{JobError, PreparedScene};
use crate::shapes::Shapes;

/// Gives a split's objects to whoever loads it, and counts them.
pub trait Blocks {
    /// The geometry object.
    fn geometry(&self, split: u32) -> Result<Vec<u8>, JobError>;
    /// The attributes object.
    fn attributes(&self, split: u32) -> Result<Vec<u8>, JobError>;
}

/// Straight from the scene's store, uncounted.
impl Blocks for PreparedScene {
    fn geometry(&self, split: u32) -> Result<Vec<u8>, JobError> {
        Ok(self.objects.get(&self.manifest.splits[split as usize].geometry)?)
    }
    fn attributes(&self, split: u32) -> Result<Vec<u8>, JobError> {
        Ok(self.objects.get(&self.manifest.splits[split as usize].attributes)?)
    }
}

/// Splits in memory, ready to be traced and shaded.
pub struct Resident {
    splits: SplitSet,
    /// No ray can need another split.
    complete: bool,
    forest: Forest,
    /// First slot and split of each block, by ascending slot.
    blocks: Vec<(u32, u32)>,
    attributes: OnceLock<Vec<Attributes>>,
    /// Held while attributes are read, so that they are read once.
    reading: Mutex<()>,
}

/// Room in a forest's arena for what its top tree takes of a block of so many primitives: two trees of some 20 KiB, and
/// alignment; and for the guide to shapes of its attributes, of 4 KiB. A block of few primitives is opened into no more entries than it has, and a node (256 bytes) has two at least.
pub(crate) fn top_bytes(primitives: u64) -> u64 {
    (primitives.max(1) * 256).min(64 << 10)
}

/// Largest forest that a task can hold (see [`Forest`]).
pub(crate) const FOREST_BYTES: u64 = 8 << 30;

impl Resident {
    /// Reads and checks the geometry of the splits.
    pub fn load(scene: &PreparedScene, splits: &[u32], blocks: &dyn Blocks) -> Result<Self, JobError> {
        let entries = splits.iter().map(|&s| &scene.manifest.splits[s as usize]);
        let bytes: u64 = entries.map(|e| e.geometry.bytes + top_bytes(e.triangles + e.spheres)).sum();
        let first = splits.first().copied().unwrap_or(0);
        let mut forest = Forest::new(bytes).map_err(|source| JobError::Forest { split: first, source })?;
        let mut handles = Vec::with_capacity(splits.len());
        for &split in splits {
            let geometry = blocks.geometry(split)?;
            let wrong = |source| JobError::Forest { split, source };
            handles.push((forest.insert(&geometry).map_err(wrong)?, split));
        }
        forest.finish().map_err(|source| JobError::Forest { split: first, source })?;
        let mut table: Vec<(u32, u32)> =
            handles.iter().filter_map(|&(h, s)| forest.slots(h).map(|slots| (slots.start, s))).collect();
        table.sort_unstable();
        let set: SplitSet = splits.iter().copied().collect();
        let complete = scene.grid.covered_by(&set);
        let (attributes, reading) = (OnceLock::new(), Mutex::new(()));
        Ok(Resident { splits: set, complete, forest, blocks: table, attributes, reading })
    }

    /// Which splits.
    pub fn splits(&self) -> &SplitSet {
        &self.splits
    }
    /// Whether no ray can need another split.
    pub fn is_complete(&self) -> bool {
        self.complete
    }
    /// To be traced.
    pub fn forest(&self) -> &Forest {
        &self.forest
    }
    /// The split of a slot.
    pub fn split_of(&self, slot: u32) -> u32 {
        self.blocks[self.block_of(slot)].1
    }
    /// Whether its attributes are in memory.
    pub fn has_attributes(&self) -> bool {
        self.attributes.get().is_some()
    }
    /// To be shaded: reads the attributes when they are asked for first.
    ///
    /// # Errors
    /// When they cannot be read, or do not go with the geometry.
    pub fn surfaces(&self, scene: &PreparedScene, blocks: &dyn Blocks) -> Result<ResidentSurfaces<'_>, JobError> {
        self.surfaces_in(None, scene, blocks)
    }

    /// The same, in a memory where others may be loading.
    fn surfaces_in(
        &self,
        memory: Option<&Memory>,
        scene: &PreparedScene,
        blocks: &dyn Blocks,
    ) -> Result<ResidentSurfaces<'_>, JobError> {
        if self.attributes.get().is_none() {
            let _one = lock(&self.reading);
            if self.attributes.get().is_none() {
                let _alone = memory.and_then(Memory::loading);
                let read = self.blocks.iter().map(|&(_, split)| {
                    let entry = &scene.manifest.splits[split as usize];
                    let bytes = blocks.attributes(split)?;
                    let block = AttributeBlock::decode(&bytes, (entry.triangles + entry.spheres) as u32)
                        .map_err(|source| JobError::Attributes { split, source })?;
                    if block.shapes.iter().any(|&s| s as usize >= scene.world.shapes.len()) {
                        return Err(JobError::Scene(format!("split {split} names a shape that the world lacks")));
                    }
                    Ok(Attributes::new(block))
                });
                let read: Vec<Attributes> = read.collect::<Result<_, JobError>>()?;
                // nobody else sets it: `reading` is held
                let _ = self.attributes.set(read);
            }
        }
        let attributes = self.attributes.get().ok_or_else(|| JobError::Internal("attributes vanished".into()))?;
        let is_far = attributes.iter().map(Attributes::bytes).sum::<usize>() > NEAR_BYTES;
        Ok(ResidentSurfaces { resident: self, attributes, is_far })
    }

    #[inline(always)]
    fn block_of(&self, slot: u32) -> usize {
        if self.blocks.len() == 1 { 0 } else { self.blocks.partition_point(|b| b.0 <= slot) - 1 }
    }
}

/// Attributes of a split. They take no more memory than the object, but for the guide to shapes, which is in [`top_bytes`].
struct Attributes {
    /// Without shapes.
    block: AttributeBlock,
    shapes: Shapes,
}

impl Attributes {
    fn new(mut block: AttributeBlock) -> Self {
        let shapes = Shapes::new(std::mem::take(&mut block.shapes));
        Attributes { block, shapes }
    }

    fn bytes(&self) -> usize {
        let AttributeBlock { shapes: _, normals, uvs, attributes } = &self.block;
        self.shapes.bytes() + 36 * (normals.capacity() + attributes.capacity()) + 24 * uvs.capacity()
    }

    #[inline(always)]
    fn shape(&self, local: usize) -> u32 {
        self.shapes.get(local)
    }

    #[inline(always)]
    fn normals(&self, local: usize) -> Option<[[f32; 3]; 3]> {
        // zeros: this one has none
        self.block.normals.get(local).copied().filter(|n| n.as_flattened().iter().any(|&x| x != 0.0))
    }
}

/// Attributes of so many bytes stay in a core's own caches.
const NEAR_BYTES: usize = 256 << 10;

/// Surfaces of resident splits.
pub struct ResidentSurfaces<'a> {
    resident: &'a Resident,
    attributes: &'a [Attributes],
    is_far: bool,
}

impl ResidentSurfaces<'_> {
    /// Attributes of the split of a primitive, and its local index.
    #[inline(always)]
    fn at(&self, slot: u32) -> (&Attributes, usize) {
        let block = self.resident.block_of(slot);
        (&self.attributes[block], (slot - self.resident.blocks[block].0) as usize)
    }
}

impl Surfaces for ResidentSurfaces<'_> {
    #[inline(always)]
    fn surface(&self, _index: usize, hit: &Hit) -> Surface {
        let (attributes, local) = self.at(hit.prim);
        Surface {
            geometry: self.resident.forest.primitive(hit),
            normals: attributes.normals(local),
            uv: attributes.block.uv(local),
            attribute: attributes.block.attributes.get(local).copied(),
        }
    }
    #[inline(always)]
    fn shape(&self, _index: usize, hit: &Hit) -> u32 {
        let (attributes, local) = self.at(hit.prim);
        attributes.shape(local)
    }
    fn is_far(&self) -> bool {
        self.is_far
    }
    #[inline(always)]
    fn foresee(&self, hit: &Hit) {
        let (attributes, local) = self.at(hit.prim);
        let block = &attributes.block;
        // the last value too: it may begin on another line
        if let Some([first, _, last]) = block.normals.get(local) {
            prefetch(first);
            prefetch(last);
        }
        if let Some([first, _, last]) = block.uvs.get(local) {
            prefetch(first);
            prefetch(last);
        }
        attributes.shapes.foresee(local);
    }
    fn prim(&self, _index: usize, hit: &Hit) -> PrimId {
        self.resident.forest.prim_id(hit.prim)
    }
}

/// The memory of a node: sets of splits that tasks share, within a budget. What no task uses stays until its room is
/// needed.
///
/// An object that is being loaded is there twice for a moment: as it came, and where it is to stay. With a limit, loading is for one
/// task at a time, so that what comes on top is one object.
pub struct Memory {
    capacity: u64,
    state: Mutex<State>,
    changed: Condvar,
    loading: Mutex<()>,
}

#[derive(Default)]
struct State {
    held: Vec<Held>,
    clock: u64,
    peak: u64,
}

struct Held {
    set: Vec<u32>,
    bytes: u64,
    users: u32,
    used_at: u64,
    /// None while it is being loaded.
    resident: Option<Arc<Resident>>,
}

/// A use of resident splits; they stay in memory as long as it lives.
pub struct Lease<'a> {
    memory: &'a Memory,
    resident: Arc<Resident>,
    set: Vec<u32>,
    /// Whether they were in memory already.
    pub warm: bool,
}

impl Lease<'_> {
    /// As [`Resident::surfaces`], while no other task of the node loads anything if its memory has a limit.
    ///
    /// # Errors
    /// As there.
    pub fn surfaces(&self, scene: &PreparedScene, blocks: &dyn Blocks) -> Result<ResidentSurfaces<'_>, JobError> {
        self.resident.surfaces_in(Some(self.memory), scene, blocks)
    }
}

impl std::ops::Deref for Lease<'_> {
    type Target = Resident;
    fn deref(&self) -> &Resident {
        &self.resident
    }
}

impl Drop for Lease<'_> {
    fn drop(&mut self) {
        let mut state = lock(&self.memory.state);
        if let Some(held) = state.held.iter_mut().find(|h| h.set == self.set) {
            held.users -= 1;
        }
        self.memory.changed.notify_all();
    }
}

impl Memory {
    /// Memory for so many bytes of splits.
    pub fn new(capacity: u64) -> Self {
        Memory { capacity, state: Mutex::default(), changed: Condvar::new(), loading: Mutex::new(()) }
    }
    /// Held while objects are loaded.
    fn loading(&self) -> Option<MutexGuard<'_, ()>> {
        (self.capacity < u64::MAX).then(|| lock(&self.loading))
    }
    /// What it may hold.
    pub fn capacity(&self) -> u64 {
        self.capacity
    }
    /// The most that it held at once.
    pub fn peak(&self) -> u64 {
        lock(&self.state).peak
    }
    /// Bytes of the splits that it holds, or is loading.
    pub fn held(&self) -> u64 {
        lock(&self.state).held.iter().map(|h| h.bytes).sum()
    }
    /// The splits that it holds, or is loading.
    pub fn warm(&self) -> BTreeSet<u32> {
        lock(&self.state).held.iter().flat_map(|h| h.set.iter().copied()).collect()
    }
    /// Forgets everything that no task uses.
    pub fn clear(&self) {
        lock(&self.state).held.retain(|h| h.users > 0);
        self.changed.notify_all();
    }

    /// The splits (ascending, of so many bytes), loaded unless they are there. Waits while other tasks need the room.
    ///
    /// # Errors
    /// When they take more than there is, or loading fails.
    pub fn acquire(
        &self,
        set: &[u32],
        bytes: u64,
        load: impl FnOnce() -> Result<Resident, JobError>,
    ) -> Result<Lease<'_>, JobError> {
        if bytes > self.capacity {
            return Err(JobError::Memory { needed: bytes, given: self.capacity });
        }
        let mut state = lock(&self.state);
        loop {
            state.clock += 1;
            let clock = state.clock;
            if let Some(held) = state.held.iter_mut().find(|h| h.set == set) {
                if let Some(resident) = held.resident.clone() {
                    held.users += 1;
                    held.used_at = clock;
                    return Ok(Lease { memory: self, resident, set: set.to_vec(), warm: true });
                }
            } else if self.make_room(&mut state, bytes) {
                break;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        let used_at = state.clock;
        state.held.push(Held { set: set.to_vec(), bytes, users: 1, used_at, resident: None });
        let used = state.held.iter().map(|h| h.bytes).sum();
        state.peak = state.peak.max(used);
        drop(state);

        // a load that fails (or panics) must not leave others waiting for it
        struct Undo<'a>(Option<(&'a Memory, &'a [u32])>);
        impl Drop for Undo<'_> {
            fn drop(&mut self) {
                if let Some((memory, set)) = self.0 {
                    lock(&memory.state).held.retain(|h| h.set != set);
                    memory.changed.notify_all();
                }
            }
        }
        let mut undo = Undo(Some((self, set)));
        let one = self.loading();
        let resident = Arc::new(load()?);
        drop(one);
        undo.0 = None;
        let mut state = lock(&self.state);
        if let Some(held) = state.held.iter_mut().find(|h| h.set == set) {
            held.resident = Some(resident.clone());
        }
        self.changed.notify_all();
        Ok(Lease { memory: self, resident, set: set.to_vec(), warm: false })
    }

    /// Drops what was unused longest until there is room; false when tasks use too much.
    fn make_room(&self, state: &mut State, bytes: u64) -> bool {
        loop {
            let used: u64 = state.held.iter().map(|h| h.bytes).sum();
            if used + bytes <= self.capacity {
                return true;
            }
            let idle =
                (0..state.held.len()).filter(|&i| state.held[i].users == 0).min_by_key(|&i| state.held[i].used_at);
            let Some(oldest) = idle else { return false };
            state.held.swap_remove(oldest);
        }
    }
}

/// A lock; what a thread that panicked left behind is still consistent here, because nothing is changed half.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_take_no_more_than_their_object() {
        let runs = |n: usize, len: usize| (0..n * len).map(|i| (i / len) as u32 % 7).collect::<Vec<u32>>();
        let kinds = [vec![], vec![5], vec![1, 1, 2], runs(256, 3), runs(257, 1), runs(1000, 2), runs(1000, 9)];
        for shapes in kinds {
            let block = AttributeBlock { shapes: shapes.clone(), ..Default::default() };
            // what the object takes is what `--memory` counts
            let encoded = block.encode().len();
            let attributes = Attributes::new(AttributeBlock::decode(&block.encode(), shapes.len() as u32).unwrap());
            let found: Vec<u32> = (0..shapes.len()).map(|i| attributes.shape(i)).collect();
            assert_eq!(found, shapes);
            // and the guide to them
            assert!(
                attributes.bytes() <= encoded + (4 << 10) + 4,
                "{} bytes of an object of {encoded}",
                attributes.bytes()
            );
        }
    }

    #[test]
    fn one_set_is_loaded_at_a_time_where_memory_is_limited() {
        let loading = std::sync::atomic::AtomicU32::new(0);
        let memory = Memory::new(100);
        std::thread::scope(|scope| {
            for set in 0..8 {
                let (memory, loading) = (&memory, &loading);
                scope.spawn(move || {
                    // fails on purpose: what counts is who was in there with it
                    let load = || {
                        let before = loading.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                        std::thread::yield_now();
                        loading.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                        Err(JobError::Internal(before.to_string()))
                    };
                    let Err(JobError::Internal(others)) = memory.acquire(&[set], 10, load) else { panic!("it failed") };
                    assert_eq!(others, "0");
                });
            }
        });
    }
}
