//! Where a prepared scene lies among a cluster's stores.
//!
//! A job that is to have W workers prepares its scene so that the first copy of every block lies on W stores, its homes: as many workers
//! beside them read nothing from afar. The store beside the worker that prepares is one of them, which stays where it is. They stand in the
//! manifest ([`Manifest::homes`]), so that all who read find the blocks, whatever the number of their workers; a scene without them has its
//! blocks on all stores. Blocks are dealt by what is known of them before they are built ([`SplitEntry::weight`]): so whoever builds one puts
//! it where it belongs at once.
//!
//! [`Manifest::homes`]: rayherd_scene::manifest::Manifest::homes
//! [`SplitEntry::weight`]: rayherd_scene::manifest::SplitEntry::weight

use crate::job::PreparedScene;
use crate::local::nodes::placement;
use crate::plan::place;
use crate::textures::tile_holders;

/// Stores of all blocks and tiles of a scene.
pub struct Homes {
    splits: Vec<Vec<u32>>,
    /// Homes first, then the other stores; none where all stores are homes.
    ranked: Option<(Vec<u32>, u32)>,
    stores: u32,
    replicas: u32,
}

impl Homes {
    /// Among so many stores, with so many copies: a function of these and the scene, so that all who ask agree.
    pub fn of(scene: &PreparedScene, stores: u32, replicas: u32) -> Self {
        let replicas = replicas.clamp(1, stores.max(1));
        let is_known = |homes: &&Vec<u32>| (homes.len() as u32) < stores && homes.iter().all(|&h| h < stores);
        let Some(homes) = scene.manifest.homes.as_ref().filter(is_known) else {
            return Homes { splits: placement(scene, stores, replicas), ranked: None, stores, replicas };
        };
        let ranked = ranked(scene, stores, homes);
        let homes = homes.len() as u32;
        let order = scene.owning_order();
        let sizes: Vec<u64> = order.iter().map(|&s| scene.manifest.splits[s as usize].weight()).collect();
        // what nobody ever reads lies anywhere
        let mut splits = vec![(0..replicas).collect::<Vec<u32>>(); scene.splits() as usize];
        for (&split, on) in order.iter().zip(place::gathered(&sizes, &ranked, homes, replicas)) {
            splits[split as usize] = on;
        }
        Homes { splits, ranked: Some((ranked, homes)), stores, replicas }
    }

    /// The homes of a scene that is prepared beside the store `here` for so many workers; none where all stores are.
    pub fn chosen(scene: &PreparedScene, stores: u32, workers: u32, here: Option<u32>) -> Option<Vec<u32>> {
        let mut all = ranked(scene, stores, here.as_slice());
        all.truncate(workers.max(1) as usize);
        Some(all).filter(|homes| (homes.len() as u32) < stores)
    }

    /// Stores of each split, the first copy first.
    pub fn splits(&self) -> &[Vec<u32>] {
        &self.splits
    }

    /// Stores of a texture tile: dealt in turn over the homes, its other copies over the other stores.
    pub fn tile(&self, number: u32) -> Vec<u32> {
        let Some((ranked, homes)) = &self.ranked else { return tile_holders(number, self.stores, self.replicas) };
        let home = number % homes;
        let others: Vec<u32> = (*homes..self.stores).chain((0..*homes).filter(|h| *h != home)).collect();
        let turn = (number / homes) as usize;
        let more = (0..self.replicas as usize - 1).map(|k| others[(turn + k) % others.len()]);
        std::iter::once(home).chain(more).map(|n| ranked[n as usize]).collect()
    }
}

/// Bytes by store of the blocks that lie so, each of a size that its split's number gives: those of splits that own no cell are not counted, since nobody
/// reads them, and nobody's place is to be chosen by them.
pub fn bytes_read(scene: &PreparedScene, places: &[Vec<u32>], stores: u32, size: impl Fn(u32) -> u64) -> Vec<u64> {
    let mut bytes = vec![0; stores as usize];
    for split in scene.owning_order() {
        places[split as usize].iter().for_each(|&n| bytes[n as usize] += size(split));
    }
    bytes
}

/// All stores, these first.
fn ranked(scene: &PreparedScene, stores: u32, first: &[u32]) -> Vec<u32> {
    let others = place::ranked(&scene.manifest.content.0, stores).into_iter().filter(|n| !first.contains(n));
    first.iter().copied().chain(others).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;
    use crate::testing::{cornell, prepared};

    #[test]
    fn a_scene_that_names_no_homes_lies_where_it_always_lay() {
        let mut scene = prepared(&cornell(), 6, true);
        for homes in [None, Some(vec![0, 1, 2, 3]), Some(vec![9])] {
            scene.manifest.homes = homes;
            let all = Homes::of(&scene, 4, 2);
            assert_eq!(all.splits(), placement(&scene, 4, 2));
            assert_eq!(
                (0..9).map(|n| all.tile(n)).collect::<Vec<_>>(),
                (0..9).map(|n| tile_holders(n, 4, 2)).collect::<Vec<_>>()
            );
        }
        assert_eq!(Homes::chosen(&scene, 2, 2, Some(1)), None);
        scene.manifest.homes = Homes::chosen(&scene, 6, 2, Some(4));
        assert_eq!(scene.manifest.homes.as_ref().map(|h| (h.len(), h[0])), Some((2, 4)));
        let two = Homes::of(&scene, 6, 2);
        let first = |on: &Vec<u32>| on[0];
        let order = scene.owning_order();
        let homes: BTreeSet<u32> = order.iter().map(|&s| first(&two.splits()[s as usize])).collect();
        let tiles: BTreeSet<u32> = (0..20).map(|n| first(&two.tile(n))).collect();
        assert_eq!((homes.len(), &tiles), (2, &homes));
        for n in 0..40 {
            let on: BTreeSet<u32> = two.tile(n).into_iter().collect();
            assert!(on.len() == 2 && on.iter().all(|&s| s < 6), "{n}: {on:?}");
        }
    }

    /// Of the blocks that nobody reads there may be more than of the others: they draw no worker to where they lie.
    #[test]
    fn workers_are_drawn_to_homes_by_what_is_read() {
        let mut scene = prepared(&cornell(), 24, true);
        let order = scene.owning_order();
        assert!((order.len() as u32) < scene.splits(), "some splits own no cell");
        for here in 0..6 {
            scene.manifest.homes = Homes::chosen(&scene, 6, 2, Some(here));
            let homes = scene.manifest.homes.clone().unwrap();
            let bytes = bytes_read(&scene, Homes::of(&scene, 6, 2).splits(), 6, |s| scene.split_bytes(s));
            assert_eq!(bytes.iter().sum::<u64>(), 2 * order.iter().map(|&s| scene.split_bytes(s)).sum::<u64>());
            let least = homes.iter().map(|&h| bytes[h as usize]).min().unwrap();
            let others = (0..6u32).filter(|n| !homes.contains(n)).map(|n| bytes[n as usize]).max().unwrap();
            assert!(least > others, "{homes:?} {bytes:?}");
        }
    }

    proptest! {
        #[test]
        fn every_block_has_its_copies_and_no_store_too_many(
            sizes in prop::collection::vec(1u64..100, 1..80),
            stores in 1u32..9,
            homes in 1u32..9,
            replicas in 1u32..4,
            name in any::<[u8; 4]>(),
        ) {
            let ranked = place::ranked(&name, stores);
            prop_assert_eq!(ranked.iter().copied().collect::<BTreeSet<_>>(), (0..stores).collect());
            let on = place::gathered(&sizes, &ranked, homes, replicas);
            let (homes, copies) = (homes.min(stores), replicas.min(stores) as usize);
            let (mut load, mut first) = (vec![0u64; stores as usize], vec![0u64; stores as usize]);
            for (on, size) in on.iter().zip(&sizes) {
                prop_assert_eq!(on.iter().collect::<BTreeSet<_>>().len(), copies);
                prop_assert!(ranked[..homes as usize].contains(&on[0]));
                first[on[0] as usize] += size;
                on.iter().for_each(|&n| load[n as usize] += size);
            }
            let (total, largest): (u64, u64) = (sizes.iter().sum(), *sizes.iter().max().unwrap());
            for &home in &ranked[..homes as usize] {
                prop_assert!(first[home as usize] <= total / u64::from(homes) + 2 * largest);
            }
            // the level that all copies would have if they could be cut anywhere
            let mut level = first.clone();
            for _ in 0..total * (copies as u64 - 1) {
                *level.iter_mut().min().unwrap() += 1;
            }
            for (load, level) in load.iter().zip(&level) {
                prop_assert!(*load <= level + 2 * largest, "{:?} where {:?} is level", load, level);
            }
        }
    }
}
