//! What is read and written, exactly: bytes by stage, operation, kind and place.

use std::sync::{Arc, Mutex, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, StoreError};
use crate::report::{Bytes as Sums, Kind, Op, Place, Stage};

/// Kind of an object, from the first segment of its key that names one, whatever job or scene stands before it.
///
/// What no segment names is small and names others: [`Kind::Manifest`].
pub fn kind_of_key(key: &str) -> Kind {
    let named = key.split('/').find_map(|segment| match segment {
        "source" => Some(Kind::Source),
        "geometry" => Some(Kind::Geometry),
        "attributes" => Some(Kind::Attributes),
        "texture" => Some(Kind::Texture),
        "rays" => Some(Kind::Rays),
        "film" | "records" => Some(Kind::Film),
        _ => None,
    });
    named.unwrap_or(Kind::Manifest)
}

/// Sums shared by all who count. Clones are handles on the same sums.
#[derive(Clone, Debug, Default)]
pub struct Counters(Arc<Mutex<Sums>>);

impl Counters {
    /// Sums at 0.
    pub fn new() -> Self {
        Self::default()
    }

    /// Counts an object of the key's kind.
    pub fn add(&self, stage: Stage, op: Op, key: &str, place: Place, bytes: u64) {
        self.lock().add(stage, op, kind_of_key(key), place, bytes);
    }

    /// The sums as they are now.
    pub fn sums(&self) -> Sums {
        self.lock().clone()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Sums> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Counts what goes through to a store that is all in one place. (A [`super::NodeView`] counts by node itself.)
pub struct Counting {
    inner: Arc<dyn BlockStore>,
    counters: Counters,
    stage: Stage,
    place: Place,
}

impl Counting {
    /// Around a store. Kinds come from the keys ([`kind_of_key`]).
    pub fn new(inner: Arc<dyn BlockStore>, counters: Counters, stage: Stage, place: Place) -> Self {
        Self { inner, counters, stage, place }
    }
}

#[async_trait]
impl BlockStore for Counting {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        let bytes = body.len() as u64;
        self.inner.put(key, body).await?;
        self.counters.add(self.stage, Op::Write, key, self.place, bytes);
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let body = self.inner.get(key).await?;
        self.counters.add(self.stage, Op::Read, key, self.place, body.len() as u64);
        Ok(body)
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        self.inner.size(key).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.inner.list(prefix).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.inner.delete(keys).await
    }

    fn describe(&self) -> String {
        self.inner.describe()
    }
}

#[cfg(test)]
mod tests {
    use super::super::MemoryStore;
    use super::super::conformance::conformance;
    use super::*;

    #[tokio::test]
    async fn conforms() {
        conformance(&Counting::new(Arc::new(MemoryStore::new()), Counters::new(), Stage::Trace, Place::Local)).await;
    }

    #[tokio::test]
    async fn counts_what_was_done() {
        let counters = Counters::new();
        let inner: Arc<dyn BlockStore> = Arc::new(MemoryStore::with_limit(100));
        let near = Counting::new(inner.clone(), counters.clone(), Stage::Prepare, Place::Local);
        let far = Counting::new(inner, counters.clone(), Stage::Trace, Place::Remote);
        near.put("scene/geometry/a", Bytes::from_static(&[0; 60])).await.unwrap();
        near.put("scene/geometry/b", Bytes::from_static(&[0; 60])).await.unwrap_err();
        for _ in 0..2 {
            far.get("scene/geometry/a").await.unwrap();
        }
        far.get("scene/geometry/b").await.unwrap_err();
        far.put("job/1/rays/2", Bytes::from_static(&[0; 7])).await.unwrap();
        let rows = counters.sums().rows();
        let text = serde_json::to_string(&rows).unwrap();
        assert_eq!(
            text,
            concat!(
                r#"[{"stage":"prepare","op":"write","kind":"geometry","place":"local","bytes":60},"#,
                r#"{"stage":"trace","op":"read","kind":"geometry","place":"remote","bytes":120},"#,
                r#"{"stage":"trace","op":"write","kind":"rays","place":"remote","bytes":7}]"#
            )
        );
        assert_eq!(counters.sums().sum(|_, _, _, place| place == Place::Remote), 127);
        assert_eq!(kind_of_key("job/owner"), Kind::Manifest);
        assert_eq!(kind_of_key("jobs/1/records/0000000003-ab"), Kind::Film);
    }
}
