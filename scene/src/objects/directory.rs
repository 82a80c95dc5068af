//! Objects as files: `objects/HH/HASH` (HH: the hash's first two digits) and `names/NAME` below one folder.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use super::{ObjectError, ObjectHash, ObjectKind, ObjectRef, ObjectStore, check_name};

/// A store in a folder. Files appear by rename, after their bytes are on disk: a crash leaves whole objects or none.
#[derive(Clone, Debug)]
pub struct DirectoryObjects {
    root: PathBuf,
}

/// No file of a name is larger: a reference is some 100 bytes.
const LARGEST_NAME_FILE: u64 = 4096;
/// Files that are being written begin with it; no object and no name does.
const UNFINISHED: &str = ".writing-";

impl DirectoryObjects {
    /// Opens the folder, which is made if it is not there.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self, ObjectError> {
        let store = DirectoryObjects { root: root.into() };
        for folder in ["objects", "names"] {
            let path = store.root.join(folder);
            fs::create_dir_all(&path).map_err(|e| store.failed("make folder", &path, e))?;
        }
        Ok(store)
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where an object's file is or would be.
    pub fn path_of(&self, hash: &ObjectHash) -> PathBuf {
        let hex = hash.to_string();
        self.root.join("objects").join(&hex[..2]).join(hex)
    }

    /// Deletes what writers that were killed left half-written; how many files and bytes. Nobody may be writing.
    ///
    /// # Errors
    /// When the folder cannot be read, or a file cannot be deleted.
    pub fn remove_unfinished(&self) -> Result<(u64, u64), ObjectError> {
        let objects = self.root.join("objects");
        let mut folders = vec![self.root.join("names")];
        let list = |path: &Path| -> io::Result<Vec<fs::DirEntry>> { fs::read_dir(path)?.collect() };
        for entry in list(&objects).map_err(|e| self.failed("list", &objects, e))? {
            if entry.path().is_dir() {
                folders.push(entry.path());
            }
        }
        let (mut files, mut bytes) = (0, 0);
        for folder in folders {
            for entry in list(&folder).map_err(|e| self.failed("list", &folder, e))? {
                if entry.file_name().to_string_lossy().starts_with(UNFINISHED) {
                    let path = entry.path();
                    let size = entry.metadata().map_or(0, |m| m.len());
                    fs::remove_file(&path).map_err(|e| self.failed("delete", &path, e))?;
                    (files, bytes) = (files + 1, bytes + size);
                }
            }
        }
        Ok((files, bytes))
    }

    fn describe(&self) -> String {
        self.root.display().to_string()
    }

    fn failed(&self, action: &str, path: &Path, source: io::Error) -> ObjectError {
        ObjectError::Failed {
            store: self.describe(),
            action: format!("{action} {}", path.display()),
            source: Box::new(source),
        }
    }

    /// Writes `bytes` so that `path` is either what it was or all of them, also after a crash.
    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), ObjectError> {
        let attempt = || -> io::Result<()> {
            let folder = path.parent().ok_or_else(|| io::Error::other("path without folder"))?;
            if !folder.is_dir() {
                fs::create_dir_all(folder)?;
                if let Some(above) = folder.parent() {
                    File::open(above)?.sync_all()?;
                }
            }
            // dropped on an error, which deletes it
            let mut file = tempfile::Builder::new().prefix(UNFINISHED).tempfile_in(folder)?;
            file.write_all(bytes)?;
            file.as_file().sync_all()?;
            file.persist(path).map_err(|e| e.error)?;
            // the rename is durable when the folder is
            File::open(folder)?.sync_all()
        };
        attempt().map_err(|e| self.failed("write", path, e))
    }
}

impl ObjectStore for DirectoryObjects {
    fn put(&self, _kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError> {
        let object = ObjectRef::of(bytes);
        // one that is there and whole stays; a broken one is replaced
        match self.get(&object) {
            Ok(_) => Ok(object),
            Err(ObjectError::Missing { .. } | ObjectError::Corrupt { .. }) => {
                self.write(&self.path_of(&object.hash), bytes)?;
                Ok(object)
            }
            Err(other) => Err(other),
        }
    }

    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError> {
        let path = self.path_of(&object.hash);
        let corrupt = |message| ObjectError::Corrupt { store: self.describe(), hash: object.hash, message };
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                return Err(ObjectError::Missing { store: self.describe(), hash: object.hash });
            }
            Err(e) => return Err(self.failed("read", &path, e)),
        };
        let found = file.metadata().map_err(|e| self.failed("read", &path, e))?.len();
        if found != object.bytes {
            return Err(corrupt(format!("it has {found} bytes and should have {}", object.bytes)));
        }
        let mut bytes = Vec::with_capacity(object.bytes as usize);
        file.take(object.bytes + 1).read_to_end(&mut bytes).map_err(|e| self.failed("read", &path, e))?;
        object.verify(&bytes).map_err(corrupt)?;
        Ok(bytes)
    }

    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError> {
        let path = self.path_of(&object.hash);
        match fs::metadata(&path) {
            Ok(meta) => Ok(meta.is_file() && meta.len() == object.bytes),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(e) => Err(self.failed("look for", &path, e)),
        }
    }

    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError> {
        check_name(&self.describe(), name)?;
        let text = serde_json::to_vec(object).map_err(|e| ObjectError::Name {
            store: self.describe(),
            name: name.to_owned(),
            message: e.to_string(),
        })?;
        self.write(&self.root.join("names").join(name), &text)
    }

    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError> {
        check_name(&self.describe(), name)?;
        let path = self.root.join("names").join(name);
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(self.failed("read", &path, e)),
        };
        let mut text = Vec::new();
        file.take(LARGEST_NAME_FILE).read_to_end(&mut text).map_err(|e| self.failed("read", &path, e))?;
        serde_json::from_slice(&text).map(Some).map_err(|e| ObjectError::Name {
            store: self.describe(),
            name: name.to_owned(),
            message: format!("{}: {e}; delete it and prepare the scene again", path.display()),
        })
    }

    fn names(&self) -> Result<Vec<String>, ObjectError> {
        let path = self.root.join("names");
        let list = || -> io::Result<Vec<String>> {
            let mut names = Vec::new();
            for entry in fs::read_dir(&path)? {
                if let Ok(name) = entry?.file_name().into_string()
                    && check_name("", &name).is_ok()
                {
                    names.push(name);
                }
            }
            names.sort();
            Ok(names)
        };
        list().map_err(|e| self.failed("list", &path, e))
    }
}
