//! Counts what is written while a scene is prepared.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::objects::{ObjectError, ObjectKind, ObjectRef, ObjectStore};

/// A store that counts the bytes put, by kind.
pub(crate) struct CountingStore<'a> {
    inner: &'a dyn ObjectStore,
    manifest: AtomicU64,
    geometry: AtomicU64,
    attributes: AtomicU64,
    texture: AtomicU64,
}

impl<'a> CountingStore<'a> {
    pub(crate) fn new(inner: &'a dyn ObjectStore) -> Self {
        CountingStore {
            inner,
            manifest: AtomicU64::new(0),
            geometry: AtomicU64::new(0),
            attributes: AtomicU64::new(0),
            texture: AtomicU64::new(0),
        }
    }

    fn counter(&self, kind: ObjectKind) -> &AtomicU64 {
        match kind {
            ObjectKind::Manifest => &self.manifest,
            ObjectKind::Geometry => &self.geometry,
            ObjectKind::Attributes => &self.attributes,
            ObjectKind::Texture => &self.texture,
        }
    }

    /// Bytes put so far.
    pub(crate) fn written(&self, kind: ObjectKind) -> u64 {
        self.counter(kind).load(Ordering::Relaxed)
    }
}

impl ObjectStore for CountingStore<'_> {
    fn put(&self, kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        let object = self.inner.put(kind, bytes)?;
        self.counter(kind).fetch_add(object.bytes, Ordering::Relaxed);
        Ok(object)
    }
    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        self.inner.get(object)
    }
    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        self.inner.has(object)
    }
    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        self.inner.set_name(name, object)
    }
    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        self.inner.name(name)
    }
    fn names(&self) -> Result<Vec<String>, ObjectError> {
        self.inner.names()
    }
}
