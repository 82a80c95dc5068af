//! What is left of a job in the storage when it is deleted: nothing but its pictures.
//!
//! A server that does not answer keeps its copies for now: garbage that nobody reads, and that goes when the server is back. The others
//! remember the job meanwhile by an object of its name below [`DELETED`], so that an operator that is started anew finds it too.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rayherd_herd::remote::Depot;
use rayherd_herd::store::{BlockStore, StoreError};

use crate::run::prefix;

/// Names of jobs that are deleted and of which something is left.
const DELETED: &str = "deleted/";
/// Between two tries to delete what is left.
const AGAIN: Duration = Duration::from_secs(30);

/// Deletes a job's rays, film and records from every store; whether nothing of it is left. Stores that do not answer for now keep what
/// they have, and those that do remember that.
///
/// # Errors
/// When no store answers, or one refuses for good.
pub async fn clean(depot: &Depot, uid: &str) -> Result<bool, StoreError> {
    let mut silent = Vec::new();
    for (number, store) in depot.stores().iter().enumerate() {
        match remove(store.as_ref(), &format!("{}/", prefix(uid))).await {
            Ok(()) => {}
            Err(e @ StoreError::Unavailable { .. }) => {
                tracing::warn!("what is left of a deleted job goes later: {e}");
                silent.push((number, e));
            }
            Err(e) => return Err(e),
        }
    }
    let mark = format!("{DELETED}{uid}");
    let answers = depot.stores().iter().enumerate().filter(|(n, _)| silent.iter().all(|s| s.0 != *n));
    let mut remembered = false;
    for (_, store) in answers {
        let done = if silent.is_empty() {
            store.delete(std::slice::from_ref(&mark)).await
        } else {
            store.put(&mark, Bytes::new()).await.inspect(|()| remembered = true)
        };
        match done {
            // it was there a moment ago; what is remembered too long is only looked at once more
            Err(e @ (StoreError::Unavailable { .. } | StoreError::Full { .. })) => tracing::warn!("{e}"),
            done => done?,
        }
    }
    match silent.pop() {
        Some((_, e)) if !remembered => Err(e),
        Some(_) => Ok(false),
        None => Ok(true),
    }
}

async fn remove(store: &dyn BlockStore, below: &str) -> Result<(), StoreError> {
    let keys: Vec<String> = store.list(below).await?.into_iter().map(|(key, _)| key).collect();
    if keys.is_empty() { Ok(()) } else { store.delete(&keys).await }
}

/// Storages in which something of deleted jobs is left.
#[derive(Default)]
pub struct Leftovers(Mutex<Vec<(String, Depot)>>);

impl Leftovers {
    fn lock(&self) -> MutexGuard<'_, Vec<(String, Depot)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes a job.
    pub fn add(&self, uid: &str, depot: Depot) {
        let mut all = self.lock();
        if all.iter().all(|(known, _)| known != uid) {
            all.push((uid.to_owned(), depot));
        }
    }

    /// Notes what an earlier operator has left in a storage.
    pub async fn find(&self, depot: &Depot) {
        let mut found = BTreeSet::new();
        for store in depot.stores() {
            // one that does not answer remembers nothing that the others do not
            if let Ok(listed) = store.list(DELETED).await {
                found.extend(listed.into_iter().filter_map(|(key, _)| key.strip_prefix(DELETED).map(str::to_owned)));
            }
        }
        found.iter().for_each(|uid| self.add(uid, depot.clone()));
    }

    /// Tries once to delete all of it; how much is left.
    pub async fn again(&self) -> usize {
        let all = self.lock().clone();
        for (uid, depot) in all {
            match clean(&depot, &uid).await {
                Ok(true) => tracing::info!(uid, "what was left of a deleted job is gone"),
                Ok(false) | Err(StoreError::Unavailable { .. }) => continue,
                Err(e) => tracing::warn!(uid, "objects of a deleted job stay in its storage: {e}"),
            }
            self.lock().retain(|(known, _)| *known != uid);
        }
        self.lock().len()
    }

    /// Tries again and again, as long as the process lives. Where nothing is left, nobody is asked.
    pub async fn keep(&self) {
        loop {
            tokio::time::sleep(AGAIN).await;
            self.again().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rayherd_herd::store::{FaultPlan, Faulty, MemoryStore};

    use super::*;

    async fn storage() -> (Vec<Arc<Faulty>>, Depot) {
        let memory = || Arc::new(Faulty::new(Arc::new(MemoryStore::default()), FaultPlan::default()));
        let stores: Vec<Arc<Faulty>> = (0..3).map(|_| memory()).collect();
        for store in &stores {
            for key in ["jobs/u-1/0/film/a", "jobs/u-1/0/rays/b", "jobs/u-10/0/film/c", "output/n/j/j.exr"] {
                store.put(key, Bytes::from_static(b"x")).await.unwrap();
            }
        }
        let depot = Depot::new(stores.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect(), None).unwrap();
        (stores, depot)
    }

    async fn keys(store: &Faulty) -> Vec<String> {
        store.list("").await.unwrap().into_iter().map(|(key, _)| key).collect()
    }

    const OTHERS: [&str; 2] = ["jobs/u-10/0/film/c", "output/n/j/j.exr"];

    #[tokio::test]
    async fn what_a_server_that_was_away_kept_goes_when_it_is_back() {
        for anew in [false, true] {
            let (stores, depot) = storage().await;
            stores[1].lose();
            assert!(!clean(&depot, "u-1").await.unwrap());
            let with_mark = ["deleted/u-1", OTHERS[0], OTHERS[1]];
            assert_eq!(
                (keys(&stores[0]).await, keys(&stores[2]).await),
                (with_mark.map(str::to_owned).into(), with_mark.map(str::to_owned).into())
            );
            let left = Leftovers::default();
            if anew {
                // another operator, which is told by the storage
                left.find(&depot).await;
            } else {
                left.add("u-1", depot.clone());
                left.find(&depot).await;
            }
            assert_eq!((left.again().await, left.again().await), (1, 1), "it is away still");
            stores[1].restore(None);
            assert_eq!(keys(&stores[1]).await.len(), 4);
            assert_eq!(left.again().await, 0);
            for store in &stores {
                assert_eq!(keys(store).await, OTHERS);
            }
        }
    }

    #[tokio::test]
    async fn nothing_is_remembered_of_a_job_that_is_gone_at_once_and_nothing_forgotten_when_nobody_answers() {
        let (stores, depot) = storage().await;
        stores.iter().for_each(|s| s.lose());
        assert!(matches!(clean(&depot, "u-1").await, Err(StoreError::Unavailable { .. })));
        stores.iter().for_each(|s| s.restore(None));
        assert!(clean(&depot, "u-1").await.unwrap());
        for store in &stores {
            assert_eq!(keys(store).await, OTHERS);
        }
        let left = Leftovers::default();
        left.find(&depot).await;
        assert_eq!(left.again().await, 0);
    }
}
