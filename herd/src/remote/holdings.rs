//! What of a scene lies in a worker's cache, as the operator is told: a split of which most lies there is near for the planner.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use rayherd_scene::manifest::{Manifest, SplitEntry};
use rayherd_scene::objects::ObjectHash;

use super::message::Holds;
use crate::store::Copies;

/// The copies of a worker, seen as splits of one scene.
pub struct Holdings {
    copies: Arc<Copies>,
    /// Objects of splits by hash: each split that has it, and its bytes.
    of: Vec<(ObjectHash, u32, u64)>,
    /// By split: bytes of its objects.
    bytes: Vec<u64>,
    /// What was found last.
    last: Mutex<Option<Holds>>,
}

impl Holdings {
    /// Of the splits of this scene.
    pub fn new(manifest: &Manifest, copies: Arc<Copies>) -> Self {
        let splits = || (0u32..).zip(&manifest.splits);
        let objects = |(n, s): (u32, &SplitEntry)| [&s.geometry, &s.attributes].map(|o| (o.hash, n, o.bytes));
        let mut of: Vec<(ObjectHash, u32, u64)> = splits().flat_map(objects).collect();
        of.sort_unstable();
        let bytes = splits().map(|(_, s)| s.geometry.bytes + s.attributes.bytes).collect();
        Holdings { copies, of, bytes, last: Mutex::default() }
    }

    /// The splits of which more than half lies in the cache now.
    pub fn now(&self) -> Holds {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(last) = last.as_ref().filter(|l| l.version == self.copies.changes()) {
            return last.clone();
        }
        let (version, hashes) = self.copies.hashes();
        let mut held: BTreeMap<u32, u64> = BTreeMap::new();
        for hash in hashes {
            let from = self.of.partition_point(|o| o.0 < hash);
            let of_hash = self.of[from..].iter().take_while(|o| o.0 == hash);
            of_hash.for_each(|&(_, split, bytes)| *held.entry(split).or_default() += bytes);
        }
        let most = held.iter().filter(|&(&s, &bytes)| 2 * bytes > self.bytes[s as usize]);
        let holds = Holds::new(version, most.map(|m| *m.0));
        *last = Some(holds.clone());
        holds
    }
}

impl Holds {
    /// From splits in ascending order.
    pub fn new(version: u64, splits: impl Iterator<Item = u32>) -> Self {
        let mut runs: Vec<[u32; 2]> = Vec::new();
        for split in splits {
            match runs.last_mut() {
                Some([_, last]) if *last + 1 == split => *last = split,
                _ => runs.push([split, split]),
            }
        }
        Holds { version, splits: runs }
    }

    /// The splits, of a scene that has so many.
    pub fn splits(&self, count: usize) -> impl Iterator<Item = usize> {
        // whoever is wrong about their number does not make this run for ever
        let most = count.saturating_sub(1) as u32;
        let runs = self.splits.iter().filter(move |_| count > 0).map(move |&[first, last]| [first, last.min(most)]);
        runs.flat_map(|[first, last]| first as usize..last as usize + 1)
    }
}

#[cfg(test)]
mod tests {
    use rayherd_scene::objects::ObjectRef;

    use super::*;
    use crate::store::{MemoryStore, object_key};
    use crate::testing::{cornell, prepared};

    #[test]
    fn runs_are_written_short_and_read_within_bounds() {
        let holds = Holds::new(3, [0, 1, 2, 5, 7, 8].into_iter());
        assert_eq!(holds.splits, [[0, 2], [5, 5], [7, 8]]);
        assert_eq!(holds.splits(9).collect::<Vec<_>>(), [0, 1, 2, 5, 7, 8]);
        let wrong = Holds { version: 1, splits: vec![[1, u32::MAX], [9, 3]] };
        assert_eq!((wrong.splits(3).collect::<Vec<_>>(), wrong.splits(0).count()), (vec![1, 2], 0));
    }

    #[tokio::test]
    async fn a_split_is_held_when_most_of_it_is() {
        let scene = prepared(&cornell(), 4, true);
        let copies = Arc::new(Copies::new(Arc::new(MemoryStore::new()), u64::MAX));
        let holdings = Holdings::new(&scene.manifest, copies.clone());
        assert_eq!(holdings.now(), Holds::default());
        let keep = async |object: &ObjectRef| {
            let body = scene.objects.get(object).unwrap();
            copies.keep(&object_key(&object.hash), &body.into()).await;
        };
        let of = |split: u32| &scene.manifest.splits[split as usize];
        let (larger, smaller) = (&of(2).geometry, &of(2).attributes);
        assert!(larger.bytes > smaller.bytes);
        keep(smaller).await;
        assert_eq!(holdings.now().splits, [[0; 2]; 0]);
        keep(larger).await;
        let held = holdings.now();
        assert_eq!((&held.splits, &held), (&vec![[2, 2]], &holdings.now()));
        for split in [0, 1] {
            keep(&of(split).geometry).await;
        }
        let more = holdings.now();
        assert!(more.version > held.version && more.splits == [[0, 2]], "{more:?}");
        // what is not of this scene changes the version, and nothing else
        copies.keep("other", &vec![1].into()).await;
        assert_eq!(holdings.now().splits, more.splits);
        copies.forget(&[object_key(&of(1).geometry.hash)]).await;
        assert_eq!(holdings.now().splits, [[0, 0], [2, 2]]);
    }
}
