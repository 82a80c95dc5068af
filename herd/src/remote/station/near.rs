//! Blocks of a stage's scene, read as near as they lie.

use rayherd_scene::objects::ObjectRef;

use super::super::homes::Homes;
use super::Station;
use crate::job::JobError;
use crate::local::nodes::{Fetch, Part};
use crate::report::Place;
use crate::store::{StoreError, object_key};

/// Reads blocks from the cache and the store at home first, then from where they belong, then from anywhere.
pub(super) struct Near<'s, 'l> {
    pub station: &'s Station<'l>,
    pub homes: Homes,
    /// The store that is asked first, wherever the object belongs.
    pub home: Option<u32>,
}

impl Fetch for Near<'_, '_> {
    fn fetch(&self, part: Part, object: &ObjectRef) -> Result<(Vec<u8>, Place), JobError> {
        let Station { depot, copies, runtime, .. } = self.station;
        let key = object_key(&object.hash);
        // nothing is kept there that is not what this key promises, and it is checked again
        if let Some(body) = copies.as_ref().and_then(|c| runtime.block_on(c.get(&key))) {
            return Ok((body.into(), Place::Local));
        }
        let (home, first) = (depot.home(), self.home);
        let mut holders = match part {
            Part::Split(n) => self.homes.splits()[n as usize].clone(),
            Part::Tile(n) => self.homes.tile(n),
        };
        if first.is_none() && !holders.is_empty() {
            // nobody is near: the copies share what is read
            let turn = usize::from(blake3::hash(object.hash.to_string().as_bytes()).as_bytes()[0]) % holders.len();
            holders.rotate_left(turn);
        }
        let holders = holders.into_iter().filter(|&h| Some(h) != first);
        let mut order: Vec<u32> = first.into_iter().chain(holders).collect();
        order.extend((0..depot.len()).filter(|n| !order.contains(n)).collect::<Vec<u32>>());
        let mut error = None;
        for number in order {
            let store = &depot.stores()[number as usize];
            let why = match runtime.block_on(store.get(&key)) {
                Ok(body) => match object.verify(&body) {
                    Ok(()) if Some(number) == home => return Ok((body.into(), Place::Local)),
                    Ok(()) => {
                        if let Some(copies) = copies {
                            runtime.block_on(copies.keep(&key, &body));
                        }
                        return Ok((body.into(), Place::Remote));
                    }
                    Err(message) => StoreError::Corrupt { store: store.describe(), key: key.clone(), message },
                },
                Err(e) => e,
            };
            if !matches!(why, StoreError::NotFound { .. }) {
                tracing::warn!("{why}");
            }
            // the one that may pass tells whether to try again
            error = match error {
                Some(e @ StoreError::Unavailable { .. }) => Some(e),
                _ => Some(why),
            };
        }
        Err(error.map_or_else(|| JobError::Internal("no store was asked".into()), JobError::from))
    }
}
