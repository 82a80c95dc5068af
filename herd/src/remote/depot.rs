//! The stores of a cluster's nodes, as one of its machines sees them.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;

use crate::job::JobError;
use crate::local::nodes::disk_key;
use crate::report::Stage;
use crate::store::{BlockStore, Counters, NodeView, Prefixed, Replicated, StoreError, Verify, Watched};

/// All stores, numbered; one of them may be on this machine.
#[derive(Clone)]
pub struct Depot {
    stores: Vec<Arc<dyn BlockStore>>,
    home: Option<u32>,
    /// The stores again, where their machines are watched.
    watched: Vec<Arc<Watched>>,
}

impl Depot {
    /// From the stores of all nodes that have one, in the order that all machines agree on.
    ///
    /// # Errors
    /// When there is none.
    pub fn new(stores: Vec<Arc<dyn BlockStore>>, home: Option<u32>) -> Result<Self, JobError> {
        if stores.is_empty() {
            return Err(JobError::Settings("the storage has no endpoint: name one, or wait until its pods run".into()));
        }
        Ok(Depot { home: home.filter(|&h| (h as usize) < stores.len()), stores, watched: Vec::new() })
    }

    /// From stores that are watched: one whose machine is silent costs no waiting.
    ///
    /// # Errors
    /// When there is none.
    pub fn watched(stores: Vec<Arc<Watched>>, home: Option<u32>) -> Result<Self, JobError> {
        let plain = stores.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect();
        Ok(Depot { watched: stores, ..Depot::new(plain, home)? })
    }

    /// Stores whose machines are known to be silent for at least so long, or that have lost what they held.
    pub fn silent(&self, least: Duration) -> Vec<u32> {
        let silent = |s: &Arc<Watched>| s.is_emptied() || s.silent_for().is_some_and(|t| t >= least);
        (0..).zip(&self.watched).filter(|(_, s)| silent(s)).map(|(n, _)| n).collect()
    }

    /// Whether a store was seen last without its bucket.
    pub fn is_emptied(&self, store: u32) -> bool {
        self.watched.get(store as usize).is_some_and(|s| s.is_emptied())
    }

    /// When none of the stores has the bucket, that is what is wrong, and not that one of them lacks something.
    pub fn without_bucket(&self) -> Option<StoreError> {
        let all = !self.watched.is_empty() && self.watched.iter().all(|s| s.is_emptied());
        let message =
            "none of the job's servers has the bucket that its storage profile names: create it on each".to_owned();
        all.then(|| StoreError::Misconfigured { store: self.stores[0].describe(), message })
    }

    /// Looks, where it is time to, whether machines that were silent are back.
    pub async fn look(&self) {
        futures::future::join_all(self.watched.iter().map(|s| s.look())).await;
    }

    /// Number of stores.
    pub fn len(&self) -> u32 {
        self.stores.len() as u32
    }
    /// Whether there is no store; there always is.
    pub fn is_empty(&self) -> bool {
        self.stores.is_empty()
    }
    /// The stores.
    pub fn stores(&self) -> &[Arc<dyn BlockStore>] {
        &self.stores
    }
    /// The one on this machine.
    pub fn home(&self) -> Option<u32> {
        self.home
    }

    /// All stores as one, with so many copies of each object.
    pub fn replicated(&self, copies: u32) -> Result<NodeView, StoreError> {
        self.view(copies, None, None)
    }

    /// The same; bodies may be checked against their keys, and what is moved counted.
    pub fn view(
        &self,
        copies: u32,
        verify: Option<Verify>,
        counters: Option<(Counters, Stage)>,
    ) -> Result<NodeView, StoreError> {
        let copies = copies.clamp(1, self.len()) as usize;
        let all = Arc::new(Replicated::new(self.stores.clone(), copies, verify)?);
        Ok(all.view(self.home.map(|h| h as usize), counters))
    }

    /// What lies below a prefix: `nodes/N/KEY` is `KEY` on store N alone, every other key has so many copies.
    pub fn part(&self, prefix: &str, copies: u32) -> Result<Part, StoreError> {
        let below = |s: &Arc<dyn BlockStore>| Ok(Arc::new(Prefixed::new(s.clone(), prefix)?) as Arc<dyn BlockStore>);
        let stores: Vec<Arc<dyn BlockStore>> = self.stores.iter().map(below).collect::<Result<_, StoreError>>()?;
        let shared = Depot { stores: stores.clone(), home: self.home, watched: Vec::new() }.replicated(copies)?;
        Ok(Part { stores, shared })
    }
}

/// A part of all stores, in the layout of a job's virtual nodes.
pub struct Part {
    stores: Vec<Arc<dyn BlockStore>>,
    shared: NodeView,
}

/// One store, and a key there.
type Alone<'s, 'k> = (&'s Arc<dyn BlockStore>, &'k str);

impl Part {
    /// What lies on no store alone.
    pub fn shared(&self) -> &NodeView {
        &self.shared
    }

    /// The store that a key lies on alone, and its key there.
    fn alone<'k>(&self, key: &'k str) -> Result<Option<Alone<'_, 'k>>, StoreError> {
        let Some((number, rest)) = key.strip_prefix("nodes/").and_then(|k| k.split_once('/')) else { return Ok(None) };
        let store = number.parse().ok().and_then(|n: usize| self.stores.get(n));
        let none = || StoreError::InvalidKey { key: key.to_owned(), message: "there is no such node".into() };
        Ok(Some((store.ok_or_else(none)?, rest)))
    }
}

#[async_trait]
impl BlockStore for Part {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        match self.alone(key)? {
            Some((store, rest)) => store.put(rest, body).await,
            None => self.shared.put(key, body).await,
        }
    }
    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        match self.alone(key)? {
            Some((store, rest)) => store.get(rest).await,
            None => self.shared.get(key).await,
        }
    }
    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        match self.alone(key)? {
            Some((store, rest)) => store.size(rest).await,
            None => self.shared.size(key).await,
        }
    }
    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        match self.alone(prefix)? {
            Some((store, rest)) => {
                let number = prefix.split('/').nth(1).and_then(|n| n.parse().ok()).unwrap_or(0);
                let listed = store.list(rest).await?;
                Ok(listed.into_iter().map(|(key, bytes)| (disk_key(number, &key), bytes)).collect())
            }
            None => self.shared.list(prefix).await,
        }
    }
    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        let mut alone: Vec<Vec<String>> = vec![Vec::new(); self.stores.len()];
        let mut shared = Vec::new();
        for key in keys {
            match self.alone(key)? {
                Some((store, rest)) => {
                    let number = self.stores.iter().position(|s| Arc::ptr_eq(s, store)).unwrap_or(0);
                    alone[number].push(rest.to_owned());
                }
                None => shared.push(key.clone()),
            }
        }
        for (store, keys) in self.stores.iter().zip(alone).filter(|(_, keys)| !keys.is_empty()) {
            match store.delete(&keys).await {
                // garbage that stays until the job is deleted
                Err(e @ StoreError::Unavailable { .. }) => tracing::warn!("{e}"),
                done => done?,
            }
        }
        if shared.is_empty() { Ok(()) } else { self.shared.delete(&shared).await }
    }
    fn describe(&self) -> String {
        self.shared.describe()
    }
}
