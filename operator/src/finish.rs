//! What is left of a job in the storage when it is deleted: nothing but its pictures.

use rayherd_herd::remote::Depot;
use rayherd_herd::store::StoreError;

use crate::run::prefix;

/// Deletes a job's rays, film and records from every store. One that does not answer is passed over: its copies are garbage that
/// nobody reads.
pub async fn clean(depot: &Depot, uid: &str) -> Result<(), StoreError> {
    let below = format!("{}/", prefix(uid));
    let mut silent = Vec::new();
    for store in depot.stores() {
        let listed = match store.list(&below).await {
            Ok(listed) => listed,
            Err(e @ StoreError::Unavailable { .. }) => {
                tracing::warn!("{e}");
                silent.push(e);
                continue;
            }
            Err(e) => return Err(e),
        };
        let keys: Vec<String> = listed.into_iter().map(|(key, _)| key).collect();
        if !keys.is_empty() {
            store.delete(&keys).await?;
        }
    }
    match silent.pop() {
        Some(e) if silent.len() + 1 == depot.stores().len() => Err(e),
        _ => Ok(()),
    }
}
