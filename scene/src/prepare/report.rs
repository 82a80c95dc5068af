//! What preparing a scene took.

use std::time::Duration;

use serde::Serialize;

use super::counting::CountingStore;
use crate::manifest::Manifest;
use crate::objects::ObjectKind;

/// What preparing a scene took. What it found is in the manifest.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PrepareReport {
    /// Bytes by operation and kind, only those above 0.
    pub bytes: Vec<ByteRow>,
    /// CPU seconds in the tree builder of the threads that each began a split, added up; what other threads helped them
    /// with is not in it, so it is whole on one thread. (Seconds on the wall where the system does not tell.)
    pub tree_s: f64,
}

/// Bytes moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ByteRow {
    /// Read or written.
    pub op: ByteOp,
    /// Of what.
    pub kind: ByteKind,
    /// How many.
    pub bytes: u64,
}

/// Direction of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ByteOp {
    /// Into this process.
    Read,
    /// Out of it.
    Write,
}

/// What bytes are of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ByteKind {
    /// The scene's files.
    Source,
    /// Records in the temporary file.
    Spool,
    /// Manifest and world.
    Manifest,
    /// Geometry objects.
    Geometry,
    /// Attribute objects.
    Attributes,
    /// Tiles of textures and the picture of the sky.
    Texture,
}

impl PrepareReport {
    pub(super) fn new(manifest: &Manifest, store: &CountingStore, (written, read): (u64, u64), tree: Duration) -> Self {
        let rows = [
            (ByteOp::Read, ByteKind::Source, manifest.counts.source_bytes),
            (ByteOp::Write, ByteKind::Spool, written),
            (ByteOp::Read, ByteKind::Spool, read),
            (ByteOp::Write, ByteKind::Manifest, store.written(ObjectKind::Manifest)),
            (ByteOp::Write, ByteKind::Geometry, store.written(ObjectKind::Geometry)),
            (ByteOp::Write, ByteKind::Attributes, store.written(ObjectKind::Attributes)),
            (ByteOp::Write, ByteKind::Texture, store.written(ObjectKind::Texture)),
        ];
        let rows = rows.into_iter().filter(|r| r.2 > 0).map(|(op, kind, bytes)| ByteRow { op, kind, bytes });
        PrepareReport { bytes: rows.collect(), tree_s: tree.as_secs_f64() }
    }

    /// The scene was there: only its manifest was read.
    pub(super) fn reused(manifest_bytes: u64) -> Self {
        let row = ByteRow { op: ByteOp::Read, kind: ByteKind::Manifest, bytes: manifest_bytes };
        PrepareReport { bytes: vec![row], tree_s: 0.0 }
    }
}
