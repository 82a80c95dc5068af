//! Objects on several nodes' stores, each on R of them.
//!
//! A `put` counts when R copies on R different nodes are acknowledged. A `get` takes the copy of the node that asks, else
//! any; a copy that is missing or corrupt is read elsewhere and written again, counted. A node that does not answer
//! costs copies, not answers, as long as fewer than R are gone.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;
use futures::future::join_all;

use super::{BlockStore, Counters, StoreError};
use crate::report::{Op, Place, Stage};

/// Checks a body against its key; the message says what does not match. (Names that are hashes, sealed envelopes.)
pub type Verify = Arc<dyn Fn(&str, &[u8]) -> Result<(), String> + Send + Sync>;

/// Locks that order the writes of one key; more than there are threads.
const LOCKS: usize = 64;

/// The stores of N nodes as one, each object on R of them.
///
/// Which nodes hold a key is remembered from this process's own reads and writes, and asked for when it is not known.
/// A key that is written again with another body must be written by the same process (content-addressed and
/// attempt-numbered keys never are).
pub struct Replicated {
    nodes: Vec<Arc<dyn BlockStore>>,
    copies: usize,
    verify: Option<Verify>,
    holders: Mutex<HashMap<String, Vec<usize>>>,
    locks: Vec<tokio::sync::Mutex<()>>,
    counts: Atomics,
}

#[derive(Default)]
struct Atomics {
    corrupt: AtomicU64,
    missing: AtomicU64,
    rewritten: AtomicU64,
    elsewhere: AtomicU64,
    undeleted: AtomicU64,
}

/// What went wrong with copies and was made good.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReplicationCounts {
    /// Copies that were read and did not match their name.
    pub corrupt: u64,
    /// Copies that a node should have had and did not.
    pub missing: u64,
    /// Copies written because there were too few.
    pub rewritten: u64,
    /// Writes that went to another node than planned because one did not take them.
    pub elsewhere: u64,
    /// Copies that could not be deleted because their node did not answer.
    pub undeleted: u64,
}

impl Replicated {
    /// Over the stores of nodes 0.. with `copies` (R) of each object, 1 to the number of nodes.
    pub fn new(nodes: Vec<Arc<dyn BlockStore>>, copies: usize, verify: Option<Verify>) -> Result<Self, StoreError> {
        if !(1..=nodes.len()).contains(&copies) {
            let message = format!("{copies} copies on {} nodes: give 1 to as many copies as nodes", nodes.len());
            return Err(StoreError::Misconfigured { store: "replicated".to_owned(), message });
        }
        Ok(Replicated {
            nodes,
            copies,
            verify,
            holders: Mutex::default(),
            locks: (0..LOCKS).map(|_| tokio::sync::Mutex::default()).collect(),
            counts: Atomics::default(),
        })
    }

    /// The store as node `node` sees it (`None`: from outside): its own copies come first and are local, and what it
    /// writes has its first copy there. Bytes are counted if counters are given.
    pub fn view(self: &Arc<Self>, node: Option<usize>, counters: Option<(Counters, Stage)>) -> NodeView {
        NodeView { store: self.clone(), node, counters }
    }

    /// The nodes' stores.
    pub fn nodes(&self) -> &[Arc<dyn BlockStore>] {
        &self.nodes
    }

    /// What went wrong and was made good, so far.
    pub fn counts(&self) -> ReplicationCounts {
        let get = |n: &AtomicU64| n.load(Ordering::Relaxed);
        ReplicationCounts {
            corrupt: get(&self.counts.corrupt),
            missing: get(&self.counts.missing),
            rewritten: get(&self.counts.rewritten),
            elsewhere: get(&self.counts.elsewhere),
            undeleted: get(&self.counts.undeleted),
        }
    }

    /// The nodes that hold a key, as remembered or else asked for; nodes that do not answer are taken to hold nothing.
    pub async fn holders(&self, key: &str) -> Result<Vec<usize>, StoreError> {
        Ok(self.locate(key).await?.0)
    }

    /// A good copy, wherever it is; nothing is counted or made good.
    pub async fn any_copy(&self, key: &str) -> Result<Bytes, StoreError> {
        Ok(self.read(key, None, &mut |_, _| ()).await?.0)
    }

    /// Forgets what a node holds: it was lost with its disk. The next read or [`Replicated::restore`] makes new copies.
    pub fn forget_node(&self, node: usize) {
        self.lock().values_mut().for_each(|holders| holders.retain(|&n| n != node));
    }

    /// Makes sure that a key has R good copies where enough nodes answer, and returns how many were written.
    pub async fn restore(&self, key: &str) -> Result<u64, StoreError> {
        let before = self.counts.rewritten.load(Ordering::Relaxed);
        self.lock().remove(key);
        let (body, bad) = self.read(key, None, &mut |_, _| ()).await?;
        self.refill(key, &body, &bad, &mut |_, _| ()).await;
        Ok(self.counts.rewritten.load(Ordering::Relaxed) - before)
    }

    /// Makes sure that a key has R copies on nodes that answer, reading it only if it has fewer: copies written, and whether there are
    /// enough now.
    pub async fn keep_up(&self, key: &str) -> (u64, bool) {
        self.lock().remove(key);
        match self.locate(key).await {
            Ok((holders, _)) if holders.len() >= self.copies => return (0, true),
            Ok((holders, _)) if holders.is_empty() => return (0, false),
            _ => {}
        }
        let written = self.restore(key).await.unwrap_or_else(|error| {
            tracing::warn!(%key, %error, "it cannot be copied");
            0
        });
        (written, self.lock().get(key).is_some_and(|h| h.len() >= self.copies))
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, Vec<usize>>> {
        self.holders.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn order_of(&self, key: &str) -> &tokio::sync::Mutex<()> {
        &self.locks[blake3::hash(key.as_bytes()).as_bytes()[0] as usize % LOCKS]
    }

    fn describe(&self) -> String {
        let first = self.nodes[0].describe();
        format!("{} copies on {} nodes ({first}, ..)", self.copies, self.nodes.len())
    }

    /// Nodes in the order in which a key is offered to them: the preferred ones, then by rendezvous hashing (Thaler and
    /// Ravishankar 1998), which spreads keys evenly and moves few when a node goes.
    fn candidates(&self, key: &str, preferred: &[usize]) -> Vec<usize> {
        let weight = |node: usize| {
            let mut hasher = blake3::Hasher::new();
            hasher.update(&(node as u64).to_le_bytes()).update(key.as_bytes());
            *hasher.finalize().as_bytes()
        };
        let mut rest: Vec<usize> = (0..self.nodes.len()).filter(|n| !preferred.contains(n)).collect();
        rest.sort_by_cached_key(|&node| weight(node));
        let mut order: Vec<usize> = Vec::with_capacity(self.nodes.len());
        for &node in preferred.iter().filter(|&&n| n < self.nodes.len()).chain(&rest) {
            if !order.contains(&node) {
                order.push(node);
            }
        }
        order
    }

    /// Holders, and the first error of a node that could not be asked.
    async fn locate(&self, key: &str) -> Result<(Vec<usize>, Option<StoreError>), StoreError> {
        super::check_key(key)?;
        let known = self.lock().get(key).cloned();
        if let Some(known) = known.filter(|nodes| !nodes.is_empty()) {
            return Ok((known, None));
        }
        let mut holders = Vec::new();
        let mut error = None;
        for (node, size) in join_all(self.nodes.iter().map(|n| n.size(key))).await.into_iter().enumerate() {
            match size {
                Ok(Some(_)) => holders.push(node),
                Ok(None) => {}
                Err(e) => error = error.or(Some(e)),
            }
        }
        // a node that does not answer counts as one that has no copy, so that there will be enough without it
        if !holders.is_empty() {
            // a put that ended meanwhile knows better
            self.lock().entry(key.to_owned()).or_insert_with(|| holders.clone());
        }
        Ok((holders, error))
    }

    /// Writes copies to nodes of `order` until there are `wanted`; returns who took one and the last error.
    async fn write(
        &self,
        key: &str,
        body: &Bytes,
        order: &[usize],
        wanted: usize,
        count: &mut (dyn FnMut(usize, u64) + Send),
    ) -> (Vec<usize>, Option<StoreError>) {
        let mut taken = Vec::new();
        let mut error = None;
        let mut next = order.iter().copied();
        while taken.len() < wanted {
            let batch: Vec<usize> = next.by_ref().take(wanted - taken.len()).collect();
            if batch.is_empty() {
                break;
            }
            if error.is_some() {
                self.counts.elsewhere.fetch_add(batch.len() as u64, Ordering::Relaxed);
            }
            let done = join_all(batch.iter().map(|&node| self.nodes[node].put(key, body.clone()))).await;
            for (node, done) in batch.into_iter().zip(done) {
                match done {
                    Ok(()) => {
                        count(node, body.len() as u64);
                        taken.push(node);
                    }
                    Err(e) => error = Some(e),
                }
            }
        }
        (taken, error)
    }

    async fn put(
        &self,
        key: &str,
        body: Bytes,
        preferred: &[usize],
        count: &mut (dyn FnMut(usize, u64) + Send),
    ) -> Result<(), StoreError> {
        super::check_key(key)?;
        let _order = self.order_of(key).lock().await;
        let old = self.lock().get(key).cloned().unwrap_or_default();
        // where it is already, if it is: copies elsewhere would have to be removed
        let mut first = old.clone();
        first.extend(preferred);
        let (taken, error) = self.write(key, &body, &self.candidates(key, &first), self.copies, count).await;
        let stale: Vec<usize> = old.into_iter().filter(|node| !taken.contains(node)).collect();
        let enough = taken.len() >= self.copies;
        if enough {
            self.lock().insert(key.to_owned(), taken.clone());
        } else {
            self.lock().remove(key);
        }
        for node in stale {
            if self.nodes[node].delete(&[key.to_owned()]).await.is_err() {
                self.counts.undeleted.fetch_add(1, Ordering::Relaxed);
            }
        }
        match error {
            _ if enough => Ok(()),
            Some(full @ StoreError::Full { .. }) => Err(full),
            Some(denied @ (StoreError::Denied { .. } | StoreError::InvalidKey { .. })) => Err(denied),
            error => {
                let why = error.map(|e| e.to_string()).unwrap_or_default();
                let message = format!("{} of {} copies acknowledged: {why}", taken.len(), self.copies);
                Err(StoreError::Unavailable { store: self.describe(), action: "put", key: key.to_owned(), message })
            }
        }
    }

    /// Reads a good copy, the reader's own first; returns it and the nodes whose copy was none, which are forgotten.
    async fn read(
        &self,
        key: &str,
        node: Option<usize>,
        count: &mut (dyn FnMut(usize, u64) + Send),
    ) -> Result<(Bytes, Vec<usize>), StoreError> {
        let (mut holders, unknown) = self.locate(key).await?;
        // its own first, then the same order for all keys of one set of holders
        holders.sort_by_key(|&holder| (Some(holder) != node, holder));
        let (mut unavailable, mut corrupt, mut bad) = (unknown, None, Vec::new());
        for holder in holders {
            let got = match (self.nodes[holder].get(key).await, &self.verify) {
                (Ok(body), Some(verify)) => match verify(key, &body) {
                    Ok(()) => Ok(body),
                    Err(message) => {
                        let store = self.nodes[holder].describe();
                        Err(StoreError::Corrupt { store, key: key.to_owned(), message })
                    }
                },
                (got, _) => got,
            };
            let error = match got {
                Ok(body) => {
                    count(holder, body.len() as u64);
                    return Ok((body, bad));
                }
                Err(error) => error,
            };
            tracing::warn!(%key, node = holder, %error, "a copy cannot be read");
            let counter = match error {
                StoreError::NotFound { .. } => &self.counts.missing,
                StoreError::Corrupt { .. } => {
                    corrupt = Some(error);
                    &self.counts.corrupt
                }
                error => {
                    unavailable = unavailable.or(Some(error));
                    continue;
                }
            };
            counter.fetch_add(1, Ordering::Relaxed);
            bad.push(holder);
            if let Some(holders) = self.lock().get_mut(key) {
                holders.retain(|&known| known != holder);
            }
        }
        // a node that does not answer may have a good copy: that is for now, the others are for good
        let not_found = StoreError::NotFound { store: self.describe(), key: key.to_owned() };
        Err(unavailable.or(corrupt).unwrap_or(not_found))
    }

    /// Writes the copies that are missing, as far as nodes take them, the preferred ones first.
    async fn refill(&self, key: &str, body: &Bytes, preferred: &[usize], count: &mut (dyn FnMut(usize, u64) + Send)) {
        let holders = self.lock().get(key).cloned();
        let Some(holders) = holders.filter(|holders| holders.len() < self.copies) else { return };
        let _order = self.order_of(key).lock().await;
        // a put may have come first
        if self.lock().get(key) != Some(&holders) {
            return;
        }
        let mut order = self.candidates(key, preferred);
        order.retain(|candidate| !holders.contains(candidate));
        let (taken, error) = self.write(key, body, &order, self.copies - holders.len(), count).await;
        self.counts.rewritten.fetch_add(taken.len() as u64, Ordering::Relaxed);
        if let Some(error) = error {
            tracing::warn!(%key, %error, copies = holders.len() + taken.len(), "too few copies");
        }
        self.lock().insert(key.to_owned(), holders.into_iter().chain(taken).collect());
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        super::check_prefix(prefix)?;
        let mut union = BTreeMap::new();
        let mut silent = Vec::new();
        for listed in join_all(self.nodes.iter().map(|n| n.list(prefix))).await {
            match listed {
                Ok(keys) => union.extend(keys),
                Err(e) => silent.push(e),
            }
        }
        // each object is on R nodes, so R - 1 silent ones hide none
        if silent.len() >= self.copies {
            return Err(silent.remove(0));
        }
        Ok(union.into_iter().collect())
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        keys.iter().try_for_each(|key| super::check_key(key))?;
        keys.iter().for_each(|key| drop(self.lock().remove(key)));
        let done = join_all(self.nodes.iter().map(|n| n.delete(keys))).await;
        let mut silent: Vec<StoreError> = done.into_iter().filter_map(Result::err).collect();
        self.counts.undeleted.fetch_add((silent.len() * keys.len()) as u64, Ordering::Relaxed);
        // what a lost node keeps is garbage on its disk; nobody reads it
        if silent.len() == self.nodes.len() { Err(silent.remove(0)) } else { Ok(()) }
    }
}

/// [`Replicated`] as one node sees it.
#[derive(Clone)]
pub struct NodeView {
    store: Arc<Replicated>,
    node: Option<usize>,
    counters: Option<(Counters, Stage)>,
}

impl NodeView {
    /// Stores an object with its first copies on these nodes, the rest anywhere.
    pub async fn put_on(&self, nodes: &[usize], key: &str, body: Bytes) -> Result<(), StoreError> {
        self.store.put(key, body, nodes, &mut |node, bytes| self.count(Op::Write, key, node, bytes)).await
    }

    /// The store behind.
    pub fn replicated(&self) -> &Arc<Replicated> {
        &self.store
    }

    fn count(&self, op: Op, key: &str, node: usize, bytes: u64) {
        if let Some((counters, stage)) = &self.counters {
            let place = if Some(node) == self.node { Place::Local } else { Place::Remote };
            counters.add(*stage, op, key, place, bytes);
        }
    }
}

#[async_trait]
impl BlockStore for NodeView {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        self.put_on(self.node.as_slice(), key, body).await
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let store = &self.store;
        let mut count = |node, bytes| self.count(Op::Read, key, node, bytes);
        let (body, mut preferred) = store.read(key, self.node, &mut count).await?;
        // a copy that is bad is written over; else the reader has shown that it wants one
        preferred.extend(self.node);
        store.refill(key, &body, &preferred, &mut |node, bytes| self.count(Op::Write, key, node, bytes)).await;
        Ok(body)
    }

    /// Where bodies are not checked; else it goes through memory. Nothing is made good.
    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        if self.store.verify.is_some() {
            let body = self.get(key).await?;
            tokio::fs::write(file, &body).await.map_err(|e| super::unwritable(self.describe(), file, &e))?;
            return Ok(body.len() as u64);
        }
        let (mut holders, mut error) = self.store.locate(key).await?;
        holders.sort_by_key(|&holder| (Some(holder) != self.node, holder));
        for holder in holders {
            match self.store.nodes[holder].get_file(key, file).await {
                Ok(bytes) => {
                    self.count(Op::Read, key, holder, bytes);
                    return Ok(bytes);
                }
                Err(StoreError::NotFound { .. }) => {}
                Err(e) => error = error.or(Some(e)),
            }
        }
        Err(error.unwrap_or_else(|| StoreError::NotFound { store: self.describe(), key: key.to_owned() }))
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        let (mut holders, mut error) = self.store.locate(key).await?;
        holders.sort_by_key(|&holder| (Some(holder) != self.node, holder));
        for holder in holders {
            match self.store.nodes[holder].size(key).await {
                Ok(Some(size)) => return Ok(Some(size)),
                Ok(None) => {}
                Err(e) => error = error.or(Some(e)),
            }
        }
        error.map_or(Ok(None), Err)
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.store.list(prefix).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.store.delete(keys).await
    }

    fn describe(&self) -> String {
        self.store.describe()
    }
}

#[cfg(test)]
mod tests;
