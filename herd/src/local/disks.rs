//! Disks of virtual nodes: a folder each, with the copies of the scene's blocks that lie there as files.
//!
//! A block is copied to the nodes that are to hold it when it is asked for first, so a scene that is never read costs no
//! room. What a node reads comes from its own folder or from another node's, checked against the block's hash; a copy that
//! is broken or gone is passed over and made again from a good one.

use std::collections::BTreeSet;
use std::sync::Arc;

use bytes::Bytes as Body;
use rayherd_scene::objects::{ObjectHash, ObjectRef, ObjectStore};
use tokio::sync::Mutex;

use crate::job::JobError;
use crate::report::{Bytes, Kind, Op, Place, Stage};
use crate::store::{BlockStore, Counters, DirectoryStore, Replicated, StoreError, TemporaryFolder};

/// Locks of blocks that are being copied; more than there are threads.
const LOCKS: usize = 64;

/// The folders of all nodes, gone with this value.
pub struct Disks {
    copies: Arc<Replicated>,
    /// Keys of the blocks that were copied to their nodes.
    placed: Vec<Mutex<BTreeSet<String>>>,
    #[cfg_attr(not(test), expect(dead_code, reason = "it goes when this is dropped"))]
    folder: TemporaryFolder,
}

impl Disks {
    /// Empty folders for so many nodes; each block will lie on `replicas` of them.
    pub fn new(nodes: usize, replicas: usize) -> Result<Self, StoreError> {
        let folder = TemporaryFolder::new("nodes-")?;
        let open = |n: usize| -> Result<Arc<dyn BlockStore>, StoreError> {
            Ok(Arc::new(DirectoryStore::open_unsynced(folder.path().join(n.to_string()))?))
        };
        let stores = (0..nodes).map(open).collect::<Result<_, _>>()?;
        let copies = Arc::new(Replicated::new(stores, replicas, Some(Arc::new(verify)))?);
        Ok(Disks { copies, placed: (0..LOCKS).map(|_| Mutex::default()).collect(), folder })
    }

    /// The folder that holds those of the nodes, by number.
    #[cfg(test)]
    pub fn folder(&self) -> &std::path::Path {
        self.folder.path()
    }

    /// Changes a byte of a node's copy of a block, if it has one, for tests.
    pub async fn corrupt(&self, node: u32, (kind, object): (Kind, &ObjectRef), at: u64) -> Result<(), JobError> {
        let (disk, key) = (&self.copies.nodes()[node as usize], key(kind, object));
        match disk.get(&key).await {
            Ok(body) if !body.is_empty() => Ok(disk.put(&key, damaged(&body, at)).await?),
            _ => Ok(()),
        }
    }

    fn placed(&self, object: &ObjectRef) -> &Mutex<BTreeSet<String>> {
        &self.placed[usize::from(object.hash.0[0]) % LOCKS]
    }

    /// Reads a block for a node, and counts where from. `holders` are to have a copy; a block that lies on none yet is
    /// copied there from where the scene was prepared.
    pub async fn read(
        &self,
        node: u32,
        (kind, object): (Kind, &ObjectRef),
        holders: &[u32],
        source: &dyn ObjectStore,
    ) -> Result<(Body, Bytes), JobError> {
        let key = key(kind, object);
        let view = |counters| self.copies.view(Some(node as usize), counters);
        let place = async || -> Result<Body, JobError> {
            let body = Body::from(source.get(object)?);
            view(None).put_on(&indices(holders), &key, body.clone()).await?;
            Ok(body)
        };
        {
            let mut placed = self.placed(object).lock().await;
            if !placed.contains(&key) {
                place().await?;
                placed.insert(key.clone());
            }
        }
        let gone = |e: &StoreError| matches!(e, StoreError::NotFound { .. } | StoreError::Corrupt { .. });
        let counters = Counters::new();
        let counted = view(Some((counters.clone(), Stage::Trace)));
        let body = match counted.get(&key).await {
            Err(e) if gone(&e) => {
                tracing::warn!("{e}; it is copied again from where the scene was prepared");
                let body = place().await?;
                match counted.get(&key).await {
                    // its node was lost once more meanwhile: what was copied is as good
                    Err(e) if gone(&e) => {
                        counters.add(Stage::Trace, Op::Read, &key, Place::Remote, body.len() as u64);
                        body
                    }
                    got => got?,
                }
            }
            got => got?,
        };
        Ok((body, counters.sums()))
    }

    /// A node is gone with its disk; blocks that lay there are copied from others to their holders of now.
    pub async fn lose<'b>(
        &self,
        node: u32,
        blocks: impl Iterator<Item = (Kind, &'b ObjectRef, Vec<u32>)>,
    ) -> Result<(), JobError> {
        let disk = &self.copies.nodes()[node as usize];
        let keys: Vec<String> = disk.list("").await?.into_iter().map(|k| k.0).collect();
        disk.delete(&keys).await?;
        self.copies.forget_node(node as usize);
        for (kind, object, holders) in blocks {
            let key = key(kind, object);
            let mut placed = self.placed(object).lock().await;
            if !placed.contains(&key) {
                continue;
            }
            let view = self.copies.view(None, None);
            match self.copies.any_copy(&key).await {
                Ok(body) => view.put_on(&indices(&holders), &key, body).await?,
                // the next who reads it copies it from where the scene was prepared
                Err(StoreError::NotFound { .. } | StoreError::Corrupt { .. }) => {
                    placed.remove(&key);
                }
                Err(e) => return Err(e.into()),
            }
        }
        Ok(())
    }
}

/// A body with another byte.
pub fn damaged(body: &Body, at: u64) -> Body {
    let mut bytes = body.to_vec();
    let at = at as usize % bytes.len().max(1);
    if let Some(byte) = bytes.get_mut(at) {
        *byte ^= 0x10;
    }
    bytes.into()
}

fn indices(nodes: &[u32]) -> Vec<usize> {
    nodes.iter().map(|&n| n as usize).collect()
}

/// Key of a block: its kind, then its hash.
fn key(kind: Kind, object: &ObjectRef) -> String {
    let kind = match kind {
        Kind::Geometry => "geometry",
        Kind::Texture => "texture",
        _ => "attributes",
    };
    format!("{kind}/{}", object.hash)
}

fn verify(key: &str, body: &[u8]) -> Result<(), String> {
    let hash = ObjectHash::of(body).to_string();
    if key.ends_with(&hash) { Ok(()) } else { Err(format!("its bytes hash to {hash}")) }
}

#[cfg(test)]
mod tests {
    use rayherd_scene::objects::{MemoryObjects, ObjectKind};

    use super::*;
    use crate::store::{FaultPlan, Faulty, MemoryStore};

    fn placed(bytes: &Bytes, op: Op) -> [u64; 2] {
        [Place::Local, Place::Remote].map(|at| bytes.sum(|_, o, _, p| o == op && p == at))
    }

    #[tokio::test]
    async fn copies_are_files_of_their_nodes_checked_and_made_again() {
        let source = MemoryObjects::new();
        let object = source.put(ObjectKind::Geometry, &[7; 1000]).unwrap();
        let block = (Kind::Geometry, &object);
        let disks = Disks::new(3, 2).unwrap();
        let (root, hash) = (disks.folder().to_path_buf(), object.hash.to_string());
        let file = |n: u32| root.join(n.to_string()).join("geometry").join(&hash);

        let (body, counted) = disks.read(2, block, &[2, 1], &source).await.unwrap();
        assert_eq!((body.len(), placed(&counted, Op::Read)), (1000, [1000, 0]));
        assert_eq!([0, 1, 2].map(|n| file(n).is_file()), [false, true, true]);
        let (_, counted) = disks.read(0, block, &[2, 1], &source).await.unwrap();
        assert_eq!(placed(&counted, Op::Read), [0, 1000]);

        // the own copy is broken: another node's is read, and written over it
        std::fs::write(file(2), [8; 1000]).unwrap();
        let (body, counted) = disks.read(2, block, &[2, 1], &source).await.unwrap();
        assert_eq!((body[0], placed(&counted, Op::Read), placed(&counted, Op::Write)), (7, [0, 1000], [1000, 0]));
        assert_eq!(std::fs::read(file(2)).unwrap(), [7; 1000]);

        // a node is lost: what lay there lies on another one
        disks.lose(1, [(Kind::Geometry, &object, vec![2, 0])].into_iter()).await.unwrap();
        assert_eq!([0, 1, 2].map(|n| file(n).is_file()), [true, false, true]);
        // all are lost: the scene as it was prepared is left
        for n in [0, 2] {
            disks.lose(n, std::iter::empty()).await.unwrap();
        }
        assert_eq!(disks.read(1, block, &[1, 2], &source).await.unwrap().0[0], 7);
        assert_eq!([0, 1, 2].map(|n| file(n).is_file()), [false, true, true]);
        drop(disks);
        assert!(!root.exists());
    }

    #[tokio::test]
    async fn a_copy_that_is_lost_again_at_once_is_not_needed() {
        let source = MemoryObjects::new();
        let object = source.put(ObjectKind::Geometry, &[7; 1000]).unwrap();
        // every copy that is read is broken
        let plan = FaultPlan { corrupt: 1000, ..FaultPlan::default() };
        let disk = || Arc::new(Faulty::new(Arc::new(MemoryStore::default()), plan)) as Arc<dyn BlockStore>;
        let copies = Replicated::new(vec![disk(), disk()], 1, Some(Arc::new(verify))).unwrap();
        let disks = Disks { copies: Arc::new(copies), ..Disks::new(2, 1).unwrap() };
        let (body, counted) = disks.read(0, (Kind::Geometry, &object), &[0], &source).await.unwrap();
        assert_eq!((body.len(), placed(&counted, Op::Read)), (1000, [0, 1000]));
    }
}
