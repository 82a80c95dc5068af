//! Where a render without `--store` keeps its prepared scene: in memory while it is small, then in a temporary folder.

use std::sync::{Mutex, PoisonError};

use rayherd_scene::objects::{DirectoryObjects, MemoryObjects, ObjectError, ObjectKind, ObjectRef, ObjectStore};
use tempfile::TempDir;

use crate::interrupt;

/// Objects of a run, gone when it ends.
pub struct SpillingObjects {
    memory: MemoryObjects,
    budget: u64,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    used: u64,
    folder: Option<(TempDir, DirectoryObjects)>,
}

impl SpillingObjects {
    /// Up to so many bytes of objects stay in memory.
    pub fn new(budget: u64) -> Self {
        SpillingObjects { memory: MemoryObjects::new(), budget, state: Mutex::default() }
    }

    /// The folder's store, if there is one.
    fn folder(&self) -> Option<DirectoryObjects> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.folder.as_ref().map(|(_, store)| store.clone())
    }

    /// The store that an object of so many bytes goes to: `None` is memory.
    fn place(&self, bytes: u64) -> Result<Option<DirectoryObjects>, ObjectError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if state.used + bytes <= self.budget {
            state.used += bytes;
            return Ok(None);
        }
        if let Some((_, store)) = &state.folder {
            return Ok(Some(store.clone()));
        }
        let folder = tempfile::Builder::new().prefix("rayherd-").tempdir().map_err(|source| ObjectError::Failed {
            store: std::env::temp_dir().display().to_string(),
            action: "make a folder for the prepared scene (set TMPDIR, or pass --store)".into(),
            source: Box::new(source),
        })?;
        interrupt::remove_at_end(folder.path());
        let store = DirectoryObjects::open(folder.path())?;
        state.folder = Some((folder, store.clone()));
        Ok(Some(store))
    }
}

impl ObjectStore for SpillingObjects {
    fn put(&self, kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        let object = ObjectRef::of(bytes);
        if self.has(&object)? {
            return Ok(object);
        }
        match self.place(object.bytes)? {
            None => self.memory.put(kind, bytes),
            Some(folder) => folder.put(kind, bytes),
        }
    }
    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        match (self.memory.has(object)?, self.folder()) {
            (false, Some(folder)) => folder.get(object),
            _ => self.memory.get(object),
        }
    }
    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        Ok(self.memory.has(object)? || self.folder().map_or(Ok(false), |folder| folder.has(object))?)
    }
    // names are few and short: they stay in memory
    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        self.memory.set_name(name, object)
    }
    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        self.memory.name(name)
    }
    fn names(&self) -> Result<Vec<String>, ObjectError> {
        self.memory.names()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_memory_does_not_hold_is_in_a_folder_that_goes() {
        let store = SpillingObjects::new(10);
        let small = store.put(ObjectKind::Geometry, b"12345678").unwrap();
        assert!(store.folder().is_none());
        let large = store.put(ObjectKind::Geometry, b"123456789").unwrap();
        let root = store.folder().unwrap().root().to_path_buf();
        assert!(root.is_dir());
        // again is nothing new
        store.put(ObjectKind::Geometry, b"12345678").unwrap();
        assert_eq!(store.get(&small).unwrap(), b"12345678");
        assert_eq!(store.get(&large).unwrap(), b"123456789");
        assert!(matches!(store.get(&ObjectRef::of(b"other")), Err(ObjectError::Missing { .. })));
        store.set_name("a", &large).unwrap();
        assert_eq!(store.name("a").unwrap(), Some(large));
        drop(store);
        assert!(!root.exists());
    }
}
