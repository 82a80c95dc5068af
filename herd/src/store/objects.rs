//! A [`BlockStore`] as the object store that preparing writes to.
//!
//! The layout is that of scene's own folder store (`objects/HH/HASH`, `names/NAME`), so that a folder prepared by the one
//! is read by the other, and a copy of it in a bucket too.

use std::future::Future;
use std::sync::{Arc, mpsc};

use bytes::Bytes;
use rayherd_scene::objects::{ObjectError, ObjectHash, ObjectKind, ObjectRef, ObjectStore, check_name};
use tokio::runtime::{Handle, RuntimeFlavor};

use super::{BlockStore, StoreError};

/// Blocking calls on an asynchronous store. May be called from any thread, also from those of rayon; not from async code,
/// which it would block.
#[derive(Clone)]
pub struct SceneObjects {
    store: Arc<dyn BlockStore>,
    runtime: Handle,
}

/// Whether the user can put right what a scene's objects suffer from; see [`StoreError::is_users`].
pub fn object_is_users(error: &ObjectError) -> bool {
    use std::io::ErrorKind::{InvalidFilename, InvalidInput, IsADirectory, NotADirectory, NotFound, PermissionDenied};
    match error {
        // what is gone or broken is prepared again, as the message says
        ObjectError::Missing { .. } | ObjectError::Corrupt { .. } | ObjectError::Name { .. } => true,
        ObjectError::Failed { source, .. } => match (source.downcast_ref(), source.downcast_ref::<std::io::Error>()) {
            (Some(store), _) => StoreError::is_users(store),
            (_, Some(io)) => matches!(
                io.kind(),
                NotFound | PermissionDenied | NotADirectory | IsADirectory | InvalidInput | InvalidFilename
            ),
            _ => false,
        },
    }
}

/// Key of an object.
pub fn object_key(hash: &ObjectHash) -> String {
    let hex = hash.to_string();
    format!("objects/{}/{hex}", &hex[..2])
}

/// The hash that a key of [`object_key`] promises of its body; none for other keys.
pub fn promised_hash(key: &str) -> Option<ObjectHash> {
    key.strip_prefix("objects/")?.split_once('/')?.1.parse().ok()
}

impl SceneObjects {
    /// Over a store whose calls run on `runtime`, which must have threads of its own.
    pub fn new(store: Arc<dyn BlockStore>, runtime: Handle) -> Result<Self, StoreError> {
        // one that runs on the thread that waits for it would wait for ever
        if runtime.runtime_flavor() == RuntimeFlavor::CurrentThread {
            let message = "preparing needs a tokio runtime with threads of its own (multi-thread)".to_owned();
            return Err(StoreError::Misconfigured { store: store.describe(), message });
        }
        Ok(Self { store, runtime })
    }

    fn wait<T, F>(&self, action: &str, call: impl FnOnce(Arc<dyn BlockStore>) -> F) -> Result<T, Failure>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, StoreError>> + Send + 'static,
    {
        let (sender, receiver) = mpsc::sync_channel(1);
        let call = call(self.store.clone());
        self.runtime.spawn(async move {
            // nobody waits any more: nothing to tell
            let _ = sender.send(call.await);
        });
        let done = receiver.recv().map_err(|_| Failure::Stopped(action.to_owned()))?;
        done.map_err(|error| Failure::Store(action.to_owned(), error))
    }

    fn failed(&self, failure: Failure) -> ObjectError {
        let store = self.store.describe();
        match failure {
            Failure::Store(action, error) => ObjectError::Failed { store, action, source: Box::new(error) },
            Failure::Stopped(action) => ObjectError::Failed { store, action, source: "the runtime has ended".into() },
        }
    }

    fn name_key(&self, name: &str) -> Result<String, ObjectError> {
        check_name(&self.store.describe(), name)?;
        Ok(format!("names/{name}"))
    }

    fn wrong_name(&self, name: &str, message: String) -> ObjectError {
        ObjectError::Name { store: self.store.describe(), name: name.to_owned(), message }
    }
}

enum Failure {
    Store(String, StoreError),
    Stopped(String),
}

impl ObjectStore for SceneObjects {
    fn put(&self, _kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        let object = ObjectRef::of(bytes);
        let (key, body) = (object_key(&object.hash), Bytes::copy_from_slice(bytes));
        // also when it is there: looking whether it is whole would move as many bytes, and a broken one is replaced
        let done = self.wait(&format!("put {key}"), |store| async move { store.put(&key, body).await });
        done.map(|()| object).map_err(|e| self.failed(e))
    }

    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        let (key, hash) = (object_key(&object.hash), object.hash);
        let store = || self.store.describe();
        let body = match self.wait(&format!("get {key}"), |store| async move { store.get(&key).await }) {
            Ok(body) => body,
            Err(Failure::Store(_, StoreError::NotFound { .. })) => {
                return Err(ObjectError::Missing { store: store(), hash });
            }
            Err(Failure::Store(_, StoreError::Corrupt { message, .. })) => {
                return Err(ObjectError::Corrupt { store: store(), hash, message });
            }
            Err(other) => return Err(self.failed(other)),
        };
        object.verify(&body).map_err(|message| ObjectError::Corrupt { store: store(), hash, message })?;
        Ok(body.into())
    }

    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        let key = object_key(&object.hash);
        let size = self.wait(&format!("look for {key}"), |store| async move { store.size(&key).await });
        size.map(|size| size == Some(object.bytes)).map_err(|e| self.failed(e))
    }

    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        let key = self.name_key(name)?;
        let text = serde_json::to_vec(object).map_err(|e| self.wrong_name(name, e.to_string()))?;
        let done = self.wait(&format!("put {key}"), |store| async move { store.put(&key, text.into()).await });
        done.map_err(|e| self.failed(e))
    }

    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        let key = self.name_key(name)?;
        let text = match self.wait(&format!("get {key}"), |store| async move { store.get(&key).await }) {
            Ok(text) => text,
            Err(Failure::Store(_, StoreError::NotFound { .. })) => return Ok(None),
            Err(other) => return Err(self.failed(other)),
        };
        let wrong = |e| self.wrong_name(name, format!("{e}; delete it and prepare the scene again"));
        serde_json::from_slice(&text).map(Some).map_err(wrong)
    }

    fn names(&self) -> Result<Vec<String>, ObjectError> {
        let listed = self.wait("list names/", |store| async move { store.list("names/").await });
        let keys = listed.map_err(|e| self.failed(e))?.into_iter();
        let names = keys.filter_map(|(key, _)| key.strip_prefix("names/").map(str::to_owned));
        Ok(names.filter(|name| check_name("", name).is_ok()).collect())
    }
}

#[cfg(test)]
mod tests {
    use rayherd_scene::objects::DirectoryObjects;

    use super::super::{DirectoryStore, FaultPlan, Faulty, MemoryStore};
    use super::*;

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
    }

    #[test]
    fn a_folder_is_the_same_through_both() {
        let (runtime, folder) = (runtime(), tempfile::tempdir().unwrap());
        let plain = DirectoryObjects::open(folder.path()).unwrap();
        let store = DirectoryStore::open(folder.path()).unwrap();
        let ours = SceneObjects::new(Arc::new(store), runtime.handle().clone()).unwrap();
        for (writer, reader) in [(&plain as &dyn ObjectStore, &ours as &dyn ObjectStore), (&ours, &plain)] {
            for body in [&b""[..], b"a block", &[7; 100_000]] {
                let object = writer.put(ObjectKind::Geometry, body).unwrap();
                assert_eq!(reader.get(&object).unwrap(), body);
                assert!(reader.has(&object).unwrap());
                assert_eq!(reader.put(ObjectKind::Geometry, body).unwrap(), object);
                writer.set_name("scene-1", &object).unwrap();
                assert_eq!(reader.name("scene-1").unwrap(), Some(object));
            }
            assert_eq!(reader.names().unwrap(), ["scene-1"]);
            assert_eq!(reader.name("other").unwrap(), None);
            assert!(matches!(reader.name("../x"), Err(ObjectError::Name { .. })));
            let absent = ObjectRef::of(b"absent");
            assert!(!reader.has(&absent).unwrap());
            assert!(matches!(reader.get(&absent), Err(ObjectError::Missing { .. })));
        }
    }

    #[test]
    fn says_what_is_wrong() {
        let runtime = runtime();
        let faulty = Arc::new(Faulty::new(Arc::new(MemoryStore::new()), FaultPlan::default()));
        let objects = SceneObjects::new(faulty.clone(), runtime.handle().clone()).unwrap();
        let object = objects.put(ObjectKind::Geometry, b"a block").unwrap();
        runtime.block_on(faulty.damage(&object_key(&object.hash))).unwrap();
        assert!(matches!(objects.get(&object), Err(ObjectError::Corrupt { .. })));
        objects.put(ObjectKind::Geometry, b"a block").unwrap();
        assert_eq!(objects.get(&object).unwrap(), b"a block", "written again, it is whole");
        faulty.lose();
        assert!(objects.get(&object).unwrap_err().to_string().contains("the node is lost"));
        drop(runtime);
        assert!(objects.get(&object).unwrap_err().to_string().contains("the runtime has ended"));
    }

    #[tokio::test]
    async fn refuses_a_runtime_that_would_wait_for_itself() {
        assert!(SceneObjects::new(Arc::new(MemoryStore::new()), Handle::current()).is_err());
    }
}
