//! Objects as files below a folder.
//!
//! A key is a path. `put` writes a temporary file beside the objects (`.tmp` in the root), syncs it, renames it to its
//! place and syncs the folder: readers see the old object, the new one or none, also after the power was cut.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use bytes::Bytes;

use super::{BlockStore, StoreError, check_key, check_prefix};

/// Folder of unfinished files below the root; no key begins with a dot.
const TEMPORARY: &str = ".tmp";
/// Unfinished files older than this were left by a process that died.
const STALE: Duration = Duration::from_secs(24 * 3600);

/// Objects as files below a folder. The file system's calls run on tokio's blocking threads.
#[derive(Clone)]
pub struct DirectoryStore {
    inner: Arc<Inner>,
}

struct Inner {
    root: PathBuf,
    sync: bool,
    /// Tells this process's temporary files from those of others on the same folder (other machines too).
    run: u64,
    next: AtomicU64,
}

impl DirectoryStore {
    /// Opens a folder, making it when it is not there. What is put is on the disk when `put` returns.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self, StoreError> {
        Self::with_sync(root.into(), true)
    }

    /// The same without syncing: survives the end of the process, not of the machine. For what can be made again
    /// (caches, the disks of virtual nodes).
    pub fn open_unsynced(root: impl Into<PathBuf>) -> Result<Self, StoreError> {
        Self::with_sync(root.into(), false)
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.inner.root
    }

    fn with_sync(root: PathBuf, sync: bool) -> Result<Self, StoreError> {
        let inner = Inner { root, sync, run: unique(), next: AtomicU64::new(0) };
        let temporary = inner.root.join(TEMPORARY);
        fs::create_dir_all(&temporary).map_err(|e| inner.error("open", "", 0, &e))?;
        remove_stale(&temporary).map_err(|e| inner.error("open", "", 0, &e))?;
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Runs `work` on a blocking thread.
    async fn blocking<T: Send + 'static>(
        &self,
        action: &'static str,
        key: &str,
        work: impl FnOnce(&Inner) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        let inner = self.inner.clone();
        let done = tokio::task::spawn_blocking(move || work(&inner)).await;
        done.unwrap_or_else(|stopped| {
            Err(StoreError::Unavailable {
                store: self.describe(),
                action,
                key: key.to_owned(),
                message: format!("the file thread stopped: {stopped}"),
            })
        })
    }
}

#[async_trait]
impl BlockStore for DirectoryStore {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        check_key(key)?;
        let name = key.to_owned();
        self.blocking("put", key, move |inner| inner.put(&name, &body)).await
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        check_key(key)?;
        let (name, file) = (key.to_owned(), file.to_owned());
        self.blocking("put", key, move |inner| inner.put_file(&name, &file)).await
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        check_key(key)?;
        let name = key.to_owned();
        self.blocking("get", key, move |inner| inner.get(&name)).await
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        check_key(key)?;
        let name = key.to_owned();
        self.blocking("size", key, move |inner| inner.size(&name)).await
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        check_prefix(prefix)?;
        let name = prefix.to_owned();
        self.blocking("list", prefix, move |inner| inner.list(&name)).await
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        keys.iter().try_for_each(|key| check_key(key))?;
        let names = keys.to_vec();
        let first = keys.first().map_or("", String::as_str);
        self.blocking("delete", first, move |inner| names.iter().try_for_each(|key| inner.delete(key))).await
    }

    fn describe(&self) -> String {
        self.inner.describe()
    }
}

impl Inner {
    fn describe(&self) -> String {
        self.root.display().to_string()
    }

    fn put(&self, key: &str, body: &[u8]) -> Result<(), StoreError> {
        self.put_by(key, body.len() as u64, |temporary| self.write(temporary, &mut &body[..]))
    }

    /// Through a buffer: a file of any size.
    fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        let unreadable = |e: &io::Error| super::unreadable(self.root.display().to_string(), file, e);
        let mut source = File::open(file).map_err(|e| unreadable(&e))?;
        let bytes = source.metadata().map_err(|e| unreadable(&e))?.len();
        self.put_by(key, bytes, |temporary| self.write(temporary, &mut source))
    }

    fn put_by(&self, key: &str, bytes: u64, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), StoreError> {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let temporary = self.root.join(TEMPORARY).join(format!("{:016x}-{number}", self.run));
        let written = write(&temporary).and_then(|()| self.rename(&temporary, key));
        written.map_err(|e| {
            // what is left of a failed put would only take room; if even that fails, `open` removes it later
            let _ = fs::remove_file(&temporary);
            self.error("put", key, bytes, &e)
        })
    }

    fn write(&self, temporary: &Path, body: &mut dyn io::Read) -> io::Result<()> {
        let open = || File::options().write(true).create_new(true).open(temporary);
        let mut file = match open() {
            // somebody cleaned the store while we were running
            Err(e) if e.kind() == ErrorKind::NotFound => {
                fs::create_dir_all(self.root.join(TEMPORARY))?;
                open()?
            }
            other => other?,
        };
        io::copy(body, &mut file)?;
        if self.sync { file.sync_all() } else { Ok(()) }
    }

    fn rename(&self, temporary: &Path, key: &str) -> io::Result<()> {
        let path = self.root.join(key);
        let folder = path.parent().unwrap_or(&self.root);
        // a concurrent `delete` may remove the folder, empty again, between the two calls
        let mut attempts = 0;
        loop {
            match fs::rename(temporary, &path) {
                Err(e) if e.kind() == ErrorKind::NotFound && attempts < 100 => fs::create_dir_all(folder)?,
                done => {
                    done?;
                    break;
                }
            }
            attempts += 1;
        }
        if !self.sync {
            return Ok(());
        }
        // the folder's entry, and those of the folders that were made for it
        let mut folder = Some(folder);
        while let Some(level) = folder {
            match File::open(level).and_then(|f| f.sync_all()) {
                // emptied and removed by a concurrent `delete`, so there is nothing to keep
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                done => done?,
            }
            folder = if attempts > 0 && level != self.root { level.parent() } else { None };
        }
        Ok(())
    }

    fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        match self.size(key)? {
            Some(_) => fs::read(self.root.join(key)).map(Bytes::from).map_err(|e| self.error("get", key, 0, &e)),
            None => Err(StoreError::NotFound { store: self.describe(), key: key.to_owned() }),
        }
    }

    fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        match fs::metadata(self.root.join(key)) {
            Ok(m) => Ok(m.is_file().then_some(m.len())),
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
            Err(e) => Err(self.error("size", key, 0, &e)),
        }
    }

    fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        // whole segments name a folder; the rest is compared below
        let folder = prefix.rfind('/').map_or("", |i| &prefix[..=i]);
        let mut found = Vec::new();
        let mut folders = vec![folder.to_owned()];
        while let Some(folder) = folders.pop() {
            let at = self.root.join(&folder);
            let entries = match fs::read_dir(&at) {
                Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => continue,
                entries => entries.map_err(|e| self.error("list", &folder, 0, &e))?,
            };
            for entry in entries {
                let entry = entry.map_err(|e| self.error("list", &folder, 0, &e))?;
                // names that no key has are not ours
                let Some(name) = entry.file_name().to_str().map(|n| format!("{folder}{n}")) else { continue };
                if check_key(&name).is_err() || !(name.starts_with(prefix) || prefix.starts_with(&name)) {
                    continue;
                }
                match entry.metadata() {
                    Ok(m) if m.is_dir() => folders.push(format!("{name}/")),
                    Ok(m) if m.is_file() && name.starts_with(prefix) => found.push((name, m.len())),
                    Ok(_) => {}
                    // deleted meanwhile
                    Err(e) if e.kind() == ErrorKind::NotFound => {}
                    Err(e) => return Err(self.error("list", &name, 0, &e)),
                }
            }
        }
        found.sort_unstable();
        Ok(found)
    }

    fn delete(&self, key: &str) -> Result<(), StoreError> {
        let path = self.root.join(key);
        match fs::remove_file(&path) {
            Ok(()) => {}
            // not there, or a folder: no object of that name
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(()),
            Err(_) if path.is_dir() => return Ok(()),
            Err(e) => return Err(self.error("delete", key, 0, &e)),
        }
        // folders that are empty now; the first that is not ends it
        let mut folder = path.parent();
        while let Some(level) = folder.filter(|level| *level != self.root) {
            if fs::remove_dir(level).is_err() {
                break;
            }
            folder = level.parent();
        }
        Ok(())
    }

    fn error(&self, action: &'static str, key: &str, bytes: u64, error: &io::Error) -> StoreError {
        let (store, key, message) = (self.describe(), key.to_owned(), error.to_string());
        match error.kind() {
            ErrorKind::NotFound => StoreError::NotFound { store, key },
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
                StoreError::Full { store, key, bytes }
            }
            ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
                StoreError::Denied { store, action, key, message }
            }
            ErrorKind::NotADirectory | ErrorKind::IsADirectory | ErrorKind::DirectoryNotEmpty if action == "put" => {
                let message = format!("a key cannot be a folder of another ({message})");
                StoreError::InvalidKey { key, message }
            }
            // the root is a file, say: trying again will not help
            ErrorKind::NotADirectory | ErrorKind::AlreadyExists | ErrorKind::InvalidInput => {
                StoreError::Denied { store, action, key, message }
            }
            _ => StoreError::Unavailable { store, action, key, message },
        }
    }
}

/// A number that no other run has, from the clock, the process and the allocator's addresses.
fn unique() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_nanos());
    // RandomState's keys come from the operating system's generator
    RandomState::new().hash_one((now, std::process::id()))
}

fn remove_stale(temporary: &Path) -> io::Result<()> {
    for entry in fs::read_dir(temporary)? {
        let entry = entry?;
        let age = entry.metadata().and_then(|m| m.modified()).ok().and_then(|t| t.elapsed().ok());
        if age.is_some_and(|age| age > STALE) {
            match fs::remove_file(entry.path()) {
                // another process was faster
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                done => done?,
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::conformance::conformance;
    use super::*;

    #[tokio::test]
    async fn conforms() {
        let folder = tempfile::tempdir().unwrap();
        conformance(&DirectoryStore::open(folder.path()).unwrap()).await;
    }

    #[tokio::test]
    async fn conforms_unsynced_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        conformance(&DirectoryStore::open_unsynced(folder.path().join("new/folder")).unwrap()).await;
        let left: Vec<_> = fs::read_dir(folder.path().join("new/folder")).unwrap().map(|e| e.unwrap().path()).collect();
        assert_eq!(left, [folder.path().join("new/folder/.tmp")]);
        assert_eq!(fs::read_dir(&left[0]).unwrap().count(), 0);
    }

    #[tokio::test]
    async fn keeps_to_its_own_files() {
        let folder = tempfile::tempdir().unwrap();
        let store = DirectoryStore::open(folder.path()).unwrap();
        store.put("a/b", Bytes::from_static(b"x")).await.unwrap();
        fs::write(folder.path().join(".hidden"), "").unwrap();
        fs::write(folder.path().join("not a key"), "").unwrap();
        std::os::unix::fs::symlink("/", folder.path().join("link")).unwrap();
        assert_eq!(store.list("").await.unwrap(), [("a/b".to_owned(), 1)]);
        store.delete(&["a".to_owned()]).await.unwrap();
        assert_eq!(store.size("a").await.unwrap(), None);
        assert!(matches!(store.get("a").await, Err(StoreError::NotFound { .. })));
        assert!(matches!(store.get("a/b/c").await, Err(StoreError::NotFound { .. })));
    }

    #[tokio::test]
    async fn says_what_the_system_refuses() {
        let folder = tempfile::tempdir().unwrap();
        let store = DirectoryStore::open(folder.path()).unwrap();
        store.put("a/b", Bytes::new()).await.unwrap();
        assert!(matches!(store.put("a", Bytes::new()).await, Err(StoreError::InvalidKey { .. })));
        assert!(matches!(store.put("a/b/c", Bytes::new()).await, Err(StoreError::InvalidKey { .. })));
        fs::write(folder.path().join("file"), "").unwrap();
        assert!(matches!(DirectoryStore::open(folder.path().join("file")), Err(StoreError::Denied { .. })));
        let kinds = [
            (ErrorKind::StorageFull, "no room for k (7 bytes)"),
            (ErrorKind::PermissionDenied, "put k refused"),
            (ErrorKind::TimedOut, "put k failed for now"),
        ];
        for (kind, text) in kinds {
            let message = store.inner.error("put", "k", 7, &kind.into()).to_string();
            assert!(message.contains(text), "{kind:?}: {message}");
        }
    }

    #[test]
    fn removes_what_a_dead_process_left() {
        let folder = tempfile::tempdir().unwrap();
        let temporary = folder.path().join(TEMPORARY);
        fs::create_dir(&temporary).unwrap();
        let old = File::create(temporary.join("old")).unwrap();
        old.set_modified(SystemTime::now() - 2 * STALE).unwrap();
        File::create(temporary.join("new")).unwrap();
        DirectoryStore::open(folder.path()).unwrap();
        assert!(!temporary.join("old").exists() && temporary.join("new").exists());
    }
}
