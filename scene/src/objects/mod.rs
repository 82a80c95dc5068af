//! Immutable objects named by what is in them, and the small set of names that point at them.
//!
//! Preparing writes through this trait and knows no more about where objects live; `herd` adapts its stores to it.

mod directory;
mod memory;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

pub use directory::DirectoryObjects;
pub use memory::MemoryObjects;

/// BLAKE3 of an object's bytes; written as 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ObjectHash(pub [u8; 32]);

impl ObjectHash {
    /// Hash of `bytes`.
    pub fn of(bytes: &[u8]) -> Self {
        ObjectHash(*blake3::hash(bytes).as_bytes())
    }
}

impl fmt::Display for ObjectHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&blake3::Hash::from_bytes(self.0).to_hex())
    }
}

impl fmt::Debug for ObjectHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for ObjectHash {
    type Err = String;
    fn from_str(s: &str) -> Result<Self, String> {
        // blake3's parser takes upper-case digits too; one hash has one name here
        let canonical = s.len() == 64 && s.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        match blake3::Hash::from_hex(s) {
            Ok(hash) if canonical => Ok(ObjectHash(*hash.as_bytes())),
            _ => Err("an object's hash is 64 lower-case hexadecimal digits".to_owned()),
        }
    }
}

impl Serialize for ObjectHash {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ObjectHash {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = std::borrow::Cow::<'de, str>::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// Names an object and says how large it is, so that memory can be planned before anything is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRef {
    /// Hash of its bytes.
    pub hash: ObjectHash,
    /// Number of its bytes.
    pub bytes: u64,
}

impl ObjectRef {
    /// Reference to an object of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        ObjectRef { hash: ObjectHash::of(bytes), bytes: bytes.len() as u64 }
    }

    /// Checks that `bytes` are what this names; the message says what does not match.
    pub fn verify(&self, bytes: &[u8]) -> Result<(), String> {
        if bytes.len() as u64 != self.bytes {
            return Err(format!("it has {} bytes and should have {}", bytes.len(), self.bytes));
        }
        let hash = ObjectHash::of(bytes);
        if hash != self.hash { Err(format!("its bytes hash to {hash}")) } else { Ok(()) }
    }
}

/// What an object is, for counting bytes; the same object may be put as one kind only.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ObjectKind {
    /// A manifest, or the world object that it names.
    Manifest,
    /// A split's tree, triangles, spheres and ids.
    Geometry,
    /// A split's shading attributes.
    Attributes,
    /// A texture.
    Texture,
}

/// Where objects and names live. Calls may block; all may be made from several threads at once.
pub trait ObjectStore: Send + Sync {
    /// Stores an object; storing it again is no error. Atomic: readers see all of it or nothing.
    fn put(&self, kind: ObjectKind, bytes: &[u8]) -> Result<ObjectRef, ObjectError>;
    /// Reads an object, verified by length and hash.
    fn get(&self, object: &ObjectRef) -> Result<Vec<u8>, ObjectError>;
    /// Whether there is an object of that hash and size (its content is not read).
    fn has(&self, object: &ObjectRef) -> Result<bool, ObjectError>;
    /// Lets `name` (of `[a-z0-9-]`, 1 to 100 long) point to an object, in place of what it pointed to before. Atomic.
    fn set_name(&self, name: &str, object: &ObjectRef) -> Result<(), ObjectError>;
    /// What a name points to, `None` when there is no such name.
    fn name(&self, name: &str) -> Result<Option<ObjectRef>, ObjectError>;
    /// All names, ascending.
    fn names(&self) -> Result<Vec<String>, ObjectError>;
}

/// Why a store did not do it.
#[derive(Debug, thiserror::Error)]
pub enum ObjectError {
    /// There is no such object: prepare the scene again.
    #[error("{store}: no object {hash}; prepare the scene again")]
    Missing {
        /// Which store.
        store: String,
        /// Which object.
        hash: ObjectHash,
    },
    /// What is there is not what was written: read another copy, or prepare the scene again.
    #[error("{store}: object {hash} is corrupt: {message}; delete it and prepare the scene again")]
    Corrupt {
        /// Which store.
        store: String,
        /// Which object.
        hash: ObjectHash,
        /// What does not match.
        message: String,
    },
    /// A name breaks the rules, or what it holds cannot be read.
    #[error("{store}: name {name:?}: {message}")]
    Name {
        /// Which store.
        store: String,
        /// Which name.
        name: String,
        /// What is wrong.
        message: String,
    },
    /// The system below refused (disk full, no permission, network gone).
    #[error("{store}: cannot {action}: {source}")]
    Failed {
        /// Which store.
        store: String,
        /// What was tried, on what.
        action: String,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// Checks the rules of names; `store` is for the message.
pub fn check_name(store: &str, name: &str) -> Result<(), ObjectError> {
    let fits = (1..=100).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    if fits {
        return Ok(());
    }
    let message = "a name is 1 to 100 of a-z, 0-9 and -".to_owned();
    Err(ObjectError::Name { store: store.to_owned(), name: name.chars().take(120).collect(), message })
}
