//! Objects in this process's memory: for tests and for scenes that are prepared and rendered in one go.

use std::collections::BTreeMap;
use std::sync::Mutex;

use super::{ObjectError, ObjectHash, ObjectKind, ObjectRef, ObjectStore, check_name};

/// A store that lives as long as the value.
#[derive(Debug, Default)]
pub struct MemoryObjects {
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    objects: BTreeMap<ObjectHash, Vec<u8>>,
    names: BTreeMap<String, ObjectRef>,
}

const STORE: &str = "memory";

impl MemoryObjects {
    /// An empty store.
    pub fn new() -> Self {
        Self::default()
    }

    /// Every object by hash, for comparing what two runs made.
    pub fn snapshot(&self) -> BTreeMap<ObjectHash, Vec<u8>> {
        self.lock().objects.clone()
    }

    /// Puts other bytes in an object's place (or removes it with `None`): what tests of corruption do.
    pub fn tamper(&self, hash: ObjectHash, bytes: Option<Vec<u8>>) {
        let mut inner = self.lock();
        match bytes {
            Some(bytes) => inner.objects.insert(hash, bytes),
            None => inner.objects.remove(&hash),
        };
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        // a panic elsewhere cannot leave the maps half changed
        self.inner.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl ObjectStore for MemoryObjects {
    fn put(&self, _kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        let object = ObjectRef::of(bytes);
        self.lock().objects.insert(object.hash, bytes.to_vec());
        Ok(object)
    }

    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        let inner = self.lock();
        let bytes = inner
            .objects
            .get(&object.hash)
            .ok_or_else(|| ObjectError::Missing { store: STORE.to_owned(), hash: object.hash })?;
        object.verify(bytes).map_err(|message| ObjectError::Corrupt {
            store: STORE.to_owned(),
            hash: object.hash,
            message,
        })?;
        Ok(bytes.clone())
    }

    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        Ok(self.lock().objects.get(&object.hash).is_some_and(|b| b.len() as u64 == object.bytes))
    }

    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        check_name(STORE, name)?;
        self.lock().names.insert(name.to_owned(), *object);
        Ok(())
    }

    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        check_name(STORE, name)?;
        Ok(self.lock().names.get(name).copied())
    }

    fn names(&self) -> Result<Vec<String>, ObjectError> {
        Ok(self.lock().names.keys().cloned().collect())
    }
}
