//! Copies of objects that lie far away, on a disk that is near.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use rayherd_scene::objects::ObjectHash;

use super::{BlockStore, DirectoryStore, MemoryStore, promised_hash};

/// Files take whole blocks of a disk.
const BLOCK: u64 = 4096;
/// Below the folder that is given: what lies there is deleted when it is opened.
const FOLDER: &str = "copies";

/// Copies of objects that never change, up to a budget of bytes; what was used longest ago goes first. A copy that is lost, or is not what
/// was kept, is none. Failures of the store that holds them are counted and told of, and nobody's error.
pub struct Copies {
    near: Arc<dyn BlockStore>,
    budget: u64,
    /// A copy takes a multiple of so many bytes.
    block: u64,
    held: Mutex<Held>,
    /// Held while the near store is written to: what makes room is gone before what takes it comes.
    writing: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Held {
    copies: BTreeMap<String, Kept>,
    /// Keys by when they were used last.
    by_use: BTreeMap<u64, String>,
    clock: u64,
    bytes: u64,
    /// How often a copy came or went.
    changes: u64,
    failures: u64,
    /// Those that nobody has asked for yet.
    untold: u64,
}

struct Kept {
    bytes: u64,
    hash: ObjectHash,
    used: u64,
}

impl Held {
    fn touch(&mut self, key: &str) -> Option<ObjectHash> {
        let copy = self.copies.get_mut(key)?;
        self.clock += 1;
        self.by_use.remove(&copy.used);
        copy.used = self.clock;
        self.by_use.insert(self.clock, key.to_owned());
        Some(copy.hash)
    }

    fn is(&self, key: &str, hash: ObjectHash) -> bool {
        self.copies.get(key).is_some_and(|c| c.hash == hash)
    }

    fn forget(&mut self, key: &str) -> bool {
        let Some(copy) = self.copies.remove(key) else { return false };
        self.by_use.remove(&copy.used);
        self.bytes -= copy.bytes;
        self.changes += 1;
        true
    }

    /// Forgets an older copy of the key, and as many others as must go for so many bytes: which.
    fn make_room(&mut self, key: &str, bytes: u64, budget: u64) -> Vec<String> {
        let mut out: Vec<String> = self.forget(key).then(|| key.to_owned()).into_iter().collect();
        while self.bytes + bytes > budget {
            let Some(oldest) = self.by_use.values().next().cloned() else { break };
            self.forget(&oldest);
            out.push(oldest);
        }
        out
    }

    fn note(&mut self, key: &str, hash: ObjectHash, bytes: u64) {
        self.clock += 1;
        self.bytes += bytes;
        self.changes += 1;
        self.by_use.insert(self.clock, key.to_owned());
        self.copies.insert(key.to_owned(), Kept { bytes, hash, used: self.clock });
    }
}

impl Copies {
    /// In `near`, up to `budget` bytes of bodies.
    pub fn new(near: Arc<dyn BlockStore>, budget: u64) -> Self {
        Copies { near, budget, block: 1, held: Mutex::default(), writing: tokio::sync::Mutex::default() }
    }

    /// Files in a folder of its own below `folder`, that take up to `budget` bytes of disk; what an earlier process has left there is
    /// deleted. Where that cannot be, nothing is kept: this is told, and counts as a failure.
    pub fn in_folder(folder: &Path, budget: u64) -> Self {
        let own = folder.join(FOLDER);
        let emptied = match fs::remove_dir_all(&own) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(e.to_string()),
            _ => Ok(()),
        };
        match emptied.and_then(|()| DirectoryStore::open_unsynced(&own).map_err(|e| e.to_string())) {
            Ok(near) => Copies { block: BLOCK, ..Copies::new(Arc::new(near), budget) },
            Err(e) => {
                tracing::error!(
                    "no copies are kept in {}: {e}; all is read from the storage each time: mount a folder there that can be written to, or \
                     take the cache out of the storage's profile",
                    own.display()
                );
                let held = Mutex::new(Held { failures: 1, untold: 1, ..Held::default() });
                Copies { held, ..Copies::new(Arc::new(MemoryStore::with_limit(0)), 0) }
            }
        }
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        // nothing is changed half
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes that the copies take.
    pub fn bytes(&self) -> u64 {
        self.held().bytes
    }

    /// How often a copy came or went: what is held is the same as long as this is.
    pub fn changes(&self) -> u64 {
        self.held().changes
    }

    /// Hashes of the bodies that are held, and [`Copies::changes`] as it is with them.
    pub fn hashes(&self) -> (u64, Vec<ObjectHash>) {
        let held = self.held();
        (held.changes, held.copies.values().map(|c| c.hash).collect())
    }

    /// Copies that could not be kept, or were lost or damaged, since this was asked last.
    pub fn take_failures(&self) -> u64 {
        std::mem::take(&mut self.held().untold)
    }

    /// The copy of an object, checked against what was kept.
    pub async fn get(&self, key: &str) -> Option<Bytes> {
        let hash = self.held().touch(key)?;
        let why = match self.near.get(key).await {
            Ok(body) if ObjectHash::of(&body) == hash => return Some(body),
            Ok(_) => "it has changed".to_owned(),
            Err(e) => e.to_string(),
        };
        // one that made room meanwhile is missed by nobody
        if self.held().is(key, hash) {
            self.failed(key, &why);
            self.forget(&[key.to_owned()]).await;
        }
        None
    }

    /// Keeps a copy of an object, if there is room for it at all.
    pub async fn keep(&self, key: &str, body: &Bytes) {
        let (hash, bytes) = (ObjectHash::of(body), (body.len() as u64).next_multiple_of(self.block));
        // what is not what its name says is found out by whoever asked for it, and next time it may be
        if bytes > self.budget || promised_hash(key).is_some_and(|h| h != hash) {
            return;
        }
        let _one = self.writing.lock().await;
        if self.held().is(key, hash) {
            return;
        }
        let gone = self.held().make_room(key, bytes, self.budget);
        let made_room = if gone.is_empty() { Ok(()) } else { self.near.delete(&gone).await };
        let kept = match made_room {
            Ok(()) => self.near.put(key, body.clone()).await,
            Err(e) => Err(e),
        };
        match kept {
            Ok(()) => self.held().note(key, hash, bytes),
            Err(e) => self.failed(key, &e.to_string()),
        }
    }

    /// Of keys whose bodies may have changed or gone.
    pub async fn forget(&self, keys: &[String]) {
        let _one = self.writing.lock().await;
        let gone: Vec<String> = {
            let mut held = self.held();
            keys.iter().filter(|key| held.forget(key)).cloned().collect()
        };
        if !gone.is_empty()
            && let Err(e) = self.near.delete(&gone).await
        {
            tracing::warn!("copies in {} stay: {e}", self.near.describe());
        }
    }

    /// Counts a failure; of many the first, second, fourth, eighth, ... are told.
    fn failed(&self, key: &str, why: &str) {
        let mut held = self.held();
        (held.failures, held.untold) = (held.failures + 1, held.untold + 1);
        if held.failures.is_power_of_two() {
            let place = self.near.describe();
            tracing::warn!(
                "no copy of {key} in {place}: {why}; it is read from the storage ({} so far)",
                held.failures
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::object_key;
    use super::*;

    fn body(byte: u8, bytes: usize) -> Bytes {
        Bytes::from(vec![byte; bytes])
    }

    fn files(folder: &Path) -> usize {
        let entries = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
        entries.map(|p| if p.is_dir() { files(&p) } else { 1 }).sum()
    }

    #[tokio::test]
    async fn a_folder_holds_no_more_than_its_budget_of_blocks_and_begins_empty() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("other"), "not ours").unwrap();
        let copies = Copies::in_folder(folder.path(), 3 * BLOCK);
        for n in 0..5 {
            copies.keep(&format!("{n}"), &body(n, 5)).await;
            copies.keep(&format!("{n}"), &body(n, 5)).await;
        }
        // each takes a block
        assert_eq!((copies.bytes(), files(folder.path())), (3 * BLOCK, 3 + 1));
        assert_eq!((copies.get("1").await, copies.get("4").await), (None, Some(body(4, 5))));
        let (changes, hashes) = copies.hashes();
        assert_eq!((changes, hashes.len()), (copies.changes(), 3));
        copies.keep("large", &body(7, 3 * BLOCK as usize + 1)).await;
        assert_eq!((copies.changes(), copies.take_failures()), (changes, 0));
        // two blocks: the two that were used longest ago go
        copies.keep("two", &body(8, BLOCK as usize + 1)).await;
        assert_eq!((copies.bytes(), files(folder.path())), (3 * BLOCK, 2 + 1));
        assert_eq!((copies.get("3").await, copies.get("4").await), (None, Some(body(4, 5))));
        let next = Copies::in_folder(folder.path(), 3 * BLOCK);
        assert_eq!((next.get("4").await, files(folder.path()), next.changes()), (None, 1, 0));
    }

    #[tokio::test]
    async fn a_folder_that_cannot_be_written_to_is_counted_and_holds_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "no folder").unwrap();
        let copies = Copies::in_folder(&file, 1 << 20);
        copies.keep("a", &body(1, 10)).await;
        assert_eq!((copies.get("a").await, copies.bytes(), copies.take_failures()), (None, 0, 1));
        // one that vanishes later
        let gone = Copies::in_folder(folder.path(), 1 << 20);
        gone.keep("a", &body(1, 10)).await;
        fs::remove_dir_all(folder.path().join(FOLDER)).unwrap();
        fs::write(folder.path().join(FOLDER), "no folder").unwrap();
        gone.keep("b", &body(2, 10)).await;
        assert_eq!((gone.get("a").await, gone.get("b").await), (None, None));
        assert_eq!((gone.take_failures(), gone.bytes(), gone.hashes().1.len()), (2, 0, 0));
    }

    #[tokio::test]
    async fn what_is_not_what_its_name_says_is_not_kept() {
        let copies = Copies::new(Arc::new(MemoryStore::new()), 1000);
        let key = object_key(&ObjectHash::of(&body(1, 10)));
        copies.keep(&key, &body(2, 10)).await;
        assert_eq!(copies.get(&key).await, None);
        copies.keep(&key, &body(1, 10)).await;
        assert_eq!((copies.get(&key).await, copies.take_failures()), (Some(body(1, 10)), 0));
    }

    #[test]
    fn many_threads_never_hold_more_than_the_budget() {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(4).build().unwrap();
        let near = Arc::new(MemoryStore::with_limit(500));
        let copies = Arc::new(Copies::new(near.clone(), 500));
        let tasks: Vec<_> = (0..8u8)
            .map(|t| {
                let copies = copies.clone();
                runtime.spawn(async move {
                    for n in 0..200u32 {
                        let byte = (n * 7 + u32::from(t)) as u8 % 11;
                        let key = format!("{byte}");
                        match copies.get(&key).await {
                            Some(found) => assert_eq!(found, body(byte, 100)),
                            None => copies.keep(&key, &body(byte, 100)).await,
                        }
                    }
                })
            })
            .collect();
        runtime.block_on(async {
            for task in tasks {
                task.await.unwrap();
            }
            let lie: u64 = near.list("").await.unwrap().iter().map(|k| k.1).sum();
            assert_eq!((lie, copies.bytes()), (500, 500));
        });
    }
}
