//! The texture tiles that a node holds in memory, and a task's way to them.
//!
//! Tiles are read when a look-up asks for them first. A node keeps what it read within a budget and drops what was used longest ago; a
//! task keeps a few tiles of its own at hand, so that most look-ups ask nobody.

use std::cell::{Ref, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Condvar, Mutex, PoisonError};

use bytes::{Bytes, BytesMut};
use rayherd_render::memory::widen;
use rayherd_render::texture::Textures;
use rayherd_scene::objects::ObjectRef;

use crate::job::{JobError, PreparedScene};

/// Bytes of tiles that a node keeps unless told otherwise.
pub const DEFAULT_BUDGET: u64 = 256 << 20;

/// Most tiles that a task has at hand.
const MOST_AT_HAND: u64 = 4096;

/// Gives tiles to whoever loads them, and counts them.
pub trait Tiles {
    /// A tile's bytes, verified, by its number.
    fn tile(&self, number: u32) -> Result<Vec<u8>, JobError>;
    /// A tile was in the node's memory already.
    fn warm(&self, number: u32);
}

/// Tiles straight from the scene's store, counted by nobody: for tools that look at one path.
pub struct StoredTiles<'a>(pub &'a PreparedScene);

impl Tiles for StoredTiles<'_> {
    fn tile(&self, number: u32) -> Result<Vec<u8>, JobError> {
        Ok(self.0.objects.get(tile_of(self.0, number)?)?)
    }
    fn warm(&self, _: u32) {}
}

/// Bytes of all tiles as a node holds them: equal ones each.
pub fn all_tile_bytes(scene: &PreparedScene) -> u64 {
    scene.manifest.tiles.iter().map(|t| t.bytes).sum()
}

/// The object of a tile.
pub fn tile_of(scene: &PreparedScene, number: u32) -> Result<&ObjectRef, JobError> {
    let missing = || JobError::Internal(format!("texture tile {number} was asked for"));
    scene.manifest.tiles.get(number as usize).ok_or_else(missing)
}

/// Nodes that hold a copy of a tile: dealt in turn, as the tiles of a picture are read together.
pub fn tile_holders(number: u32, nodes: u32, replicas: u32) -> Vec<u32> {
    (0..replicas.min(nodes)).map(|k| (number % nodes + k) % nodes).collect()
}

/// A node's tiles.
pub struct TileCache {
    budget: u64,
    /// Bytes of all tiles: where these are within the budget, none is ever dropped.
    all: u64,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    held: BTreeMap<u32, Held>,
    /// Tiles by when they were used last.
    by_use: BTreeMap<u64, u32>,
    loading: BTreeSet<u32>,
    slab: BytesMut,
    clock: u64,
    bytes: u64,
    peak: u64,
}

/// Tiles that are never dropped lie one beside the other in pieces of so many bytes, in huge pages where there are any: look-ups that go
/// from tile to tile need their pages at hand as well. Eight of these: what a piece has beside its whole ones is little of it.
const SLAB: usize = 16 << 20;

struct Held {
    tile: Bytes,
    used_at: u64,
}

impl TileCache {
    /// A cache of so many bytes, of tiles that have so many in `all`. One tile for each task is held even when that is more.
    pub fn new(budget: u64, all: u64) -> Self {
        TileCache { budget, all, state: Mutex::default(), changed: Condvar::new() }
    }

    /// The most bytes that it held at once.
    pub fn peak(&self) -> u64 {
        self.lock().peak
    }

    /// Forgets everything.
    pub fn clear(&self) {
        let mut state = self.lock();
        state.held.clear();
        state.by_use.clear();
        state.slab = BytesMut::new();
        state.bytes = 0;
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        // nothing is changed half
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A tile, read unless it is here. Several tasks that ask for one tile at once read it once.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn get(&self, number: u32, from: &dyn Tiles) -> Result<Bytes, JobError> {
        let mut state = self.lock();
        loop {
            if let Some(tile) = state.touch(number) {
                drop(state);
                from.warm(number);
                return Ok(tile);
            }
            if state.loading.insert(number) {
                break;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        drop(state);
        // a load that fails (or panics) must not leave others waiting for it
        struct Loading<'a>(&'a TileCache, u32);
        impl Drop for Loading<'_> {
            fn drop(&mut self) {
                self.0.lock().loading.remove(&self.1);
                self.0.changed.notify_all();
            }
        }
        let loading = Loading(self, number);
        let tile = from.tile(number)?;
        let mut state = self.lock();
        let tile =
            if self.all <= self.budget { state.lay(&tile, SLAB.min(self.all as usize)) } else { Bytes::from(tile) };
        state.insert(number, tile.clone(), self.budget);
        drop(state);
        drop(loading);
        Ok(tile)
    }
}

impl State {
    /// A tile that is held, now the last one used.
    fn touch(&mut self, number: u32) -> Option<Bytes> {
        let held = self.held.get_mut(&number)?;
        self.clock += 1;
        self.by_use.remove(&held.used_at);
        self.by_use.insert(self.clock, number);
        held.used_at = self.clock;
        Some(held.tile.clone())
    }

    /// A tile as part of a piece of memory of so many bytes, or of its own size if that is more; where the last piece has no room, of another.
    fn lay(&mut self, tile: &[u8], piece: usize) -> Bytes {
        if self.slab.capacity() < tile.len() {
            self.slab = BytesMut::with_capacity(piece.max(tile.len()));
            widen(self.slab.spare_capacity_mut());
        }
        self.slab.extend_from_slice(tile);
        self.slab.split().freeze()
    }

    fn insert(&mut self, number: u32, tile: Bytes, budget: u64) {
        let bytes = tile.len() as u64;
        // what a task has at hand is in memory whether it is held here or not
        let by_use = self.by_use.iter().take(if self.bytes + bytes > budget { usize::MAX } else { 0 });
        let idle: Vec<(u64, u32)> = by_use
            .filter(|(_, n)| self.held.get(n).is_some_and(|h| h.tile.is_unique()))
            .map(|(&at, &n)| (at, n))
            .take_while(|(_, n)| {
                let over = self.bytes + bytes > budget;
                if over {
                    self.bytes -= self.held.get(n).map_or(0, |h| h.tile.len() as u64);
                }
                over
            })
            .collect();
        for (at, n) in idle {
            self.by_use.remove(&at);
            self.held.remove(&n);
        }
        self.clock += 1;
        self.by_use.insert(self.clock, number);
        self.held.insert(number, Held { tile, used_at: self.clock });
        self.bytes += bytes;
        self.peak = self.peak.max(self.bytes);
    }
}

/// A tile and its number.
type AtHand = (u32, Bytes);

/// A task's textures: for one thread.
pub struct TaskTextures<'a> {
    cache: &'a TileCache,
    from: &'a dyn Tiles,
    /// Tiles by number modulo their count, a power of two.
    at_hand: RefCell<Vec<Option<AtHand>>>,
    error: RefCell<Option<JobError>>,
}

impl<'a> TaskTextures<'a> {
    /// Tiles of a scene through a node's cache, which so many tasks share.
    pub fn new(scene: &PreparedScene, cache: &'a TileCache, from: &'a dyn Tiles, tasks: u32) -> Self {
        let tiles = scene.manifest.tiles.len() as u64;
        let largest = scene.manifest.tiles.iter().map(|t| t.bytes).max().unwrap_or(1).max(1);
        // half of the budget, at most, is in tasks' hands: these tiles are not dropped
        let share = cache.budget / 2 / largest / u64::from(tasks.max(1));
        // a power of two, so that a look-up finds its place without a division
        let count = share.clamp(1, MOST_AT_HAND).min(tiles.max(1).next_power_of_two());
        let count = 1 << count.ilog2();
        let at_hand = RefCell::new(vec![None; count as usize]);
        TaskTextures { cache, from, at_hand, error: RefCell::default() }
    }

    /// The error of the first tile that could not be had, once: what was shaded since does not count.
    ///
    /// # Errors
    /// That one.
    pub fn check(&self) -> Result<(), JobError> {
        self.error.borrow_mut().take().map_or(Ok(()), Err)
    }
}

impl Textures for TaskTextures<'_> {
    #[inline]
    fn tile(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        self.at_hand(number).or_else(|| self.fetch(number))
    }

    #[inline]
    fn at_hand(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        Ref::filter_map(self.at_hand.borrow(), |tiles| {
            let held = tiles[number as usize & (tiles.len() - 1)].as_ref();
            held.filter(|(n, _)| *n == number).map(|(_, tile)| &**tile)
        })
        .ok()
    }
}

impl TaskTextures<'_> {
    #[cold]
    fn fetch(&self, number: u32) -> Option<Ref<'_, [u8]>> {
        if self.error.borrow().is_some() {
            // the task is over: nothing more is read for it
            return None;
        }
        // what lay here is let go first, so that there is room
        let place = number as usize & (self.at_hand.borrow().len() - 1);
        self.at_hand.borrow_mut()[place] = None;
        match self.cache.get(number, self.from) {
            Ok(tile) => self.at_hand.borrow_mut()[place] = Some((number, tile)),
            Err(e) => {
                self.error.replace(Some(e));
                return None;
            }
        }
        Ref::filter_map(self.at_hand.borrow(), |tiles| tiles[place].as_ref().map(|(_, tile)| &**tile)).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// Tiles of 100 bytes of their number; 7 cannot be read.
    #[derive(Default)]
    struct Numbered {
        read: AtomicU64,
        warm: AtomicU64,
    }

    impl Tiles for Numbered {
        fn tile(&self, number: u32) -> Result<Vec<u8>, JobError> {
            self.read.fetch_add(1, Ordering::Relaxed);
            if number == 7 { Err(JobError::Stopped) } else { Ok(vec![number as u8; 100]) }
        }
        fn warm(&self, _: u32) {
            self.warm.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn what_was_used_longest_ago_is_dropped() {
        let cache = TileCache::new(300, 700);
        let from = Numbered::default();
        let get = |n: u32| cache.get(n, &from).unwrap()[0];
        for n in [1, 2, 3, 1, 4, 1, 3] {
            assert_eq!(u32::from(get(n)), n);
        }
        // 2 made room for 4
        assert_eq!((from.read.load(Ordering::Relaxed), from.warm.load(Ordering::Relaxed)), (4, 3));
        get(2);
        assert_eq!(from.read.load(Ordering::Relaxed), 5);
        assert_eq!(cache.peak(), 300);
        assert!(cache.get(7, &from).is_err());
        assert!(cache.get(7, &from).is_err(), "and nobody waits for it");
        // in a task's hands: not dropped, and counted
        let held: Vec<_> = [1, 2, 3, 4].iter().map(|&n| cache.get(n, &from).unwrap()).collect();
        assert_eq!(cache.peak(), 400);
        drop(held);
        get(5);
        assert!(cache.lock().bytes <= 300);
        cache.clear();
        assert_eq!(cache.lock().bytes, 0);
    }

    #[test]
    fn tiles_that_stay_lie_together() {
        let mut state = State::default();
        let laid: Vec<(u8, Bytes)> = [100, 100, 57, 300, 1, 255, 256, 0]
            .iter()
            .zip(1..)
            .map(|(&n, k)| (k, state.lay(&vec![k; n], 256)))
            .collect();
        for (k, tile) in &laid {
            assert!(tile.iter().all(|b| b == k));
        }
        // 57 did not go beside the first two, and 300 is a piece of its own
        let at = |k: usize| laid[k].1.as_ptr();
        assert!(at(1) == at(0).wrapping_add(100) && at(2) != at(1).wrapping_add(100));
        // what is in somebody's hands stays when the cache is cleared
        state.slab = BytesMut::new();
        assert_eq!(laid[3].1, [4; 300].as_slice());
        assert_eq!(state.lay(&[9; 8], 256), [9; 8].as_slice());
    }

    #[test]
    fn a_tile_is_read_once_for_all_who_ask() {
        let cache = TileCache::new(1 << 20, 600);
        let from = Numbered::default();
        std::thread::scope(|scope| {
            for _ in 0..8 {
                // as many as it holds: they lie in one piece
                let get = |n: u32| cache.get(n, &from).unwrap();
                scope.spawn(move || (0..6).for_each(|n| assert_eq!(get(n), [n as u8; 100].as_slice())));
            }
        });
        assert_eq!((from.read.load(Ordering::Relaxed), from.warm.load(Ordering::Relaxed)), (6, 42));
    }

    #[test]
    fn holders_are_dealt_in_turn() {
        assert_eq!([0, 1, 2, 3].map(|n| tile_holders(n, 3, 2)), [vec![0, 1], vec![1, 2], vec![2, 0], vec![0, 1]]);
        assert_eq!(tile_holders(5, 1, 3), [0]);
    }
}
