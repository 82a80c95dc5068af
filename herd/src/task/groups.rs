//! Rays that leave a task, gathered by destination and stored as groups of bounded size.

use std::collections::BTreeMap;

use super::Outbox;
use crate::flight::{Flights, PathFlight, ShadowFlight};
use crate::job::JobError;
use crate::ledger::{Destination, GroupRef};

/// Stores a group and says where it is.
pub trait GroupSink {
    /// Stores the rays as group number `number` of the attempt.
    fn store(&self, to: Destination, number: u32, rays: &Flights) -> Result<GroupRef, JobError>;
}

/// Rays of a group: some MiB on the wire.
const GROUP_RAYS: usize = 65_536;

/// Gathers rays and stores them when there are enough.
pub struct Groups<'a> {
    sink: &'a dyn GroupSink,
    waiting: BTreeMap<Destination, Flights>,
    /// Rays that all destinations may hold together.
    limit: usize,
    held: usize,
    stored: Vec<GroupRef>,
    /// Rays that were gathered.
    pub rays: u64,
}

impl<'a> Groups<'a> {
    /// Gathers up to `memory` bytes of rays.
    pub fn new(sink: &'a dyn GroupSink, memory: u64) -> Self {
        let limit = (memory / size_of::<PathFlight>() as u64).max(1) as usize;
        Groups { sink, waiting: BTreeMap::new(), limit, held: 0, stored: Vec::new(), rays: 0 }
    }

    /// Takes a path's ray.
    pub fn add_path(&mut self, to: Destination, flight: PathFlight) -> Result<(), JobError> {
        let rays = self.waiting.entry(to).or_default();
        rays.paths.push(flight);
        let len = rays.len();
        self.added(to, len)
    }
    /// Takes a shadow ray.
    pub fn add_shadow(&mut self, to: Destination, flight: ShadowFlight) -> Result<(), JobError> {
        let rays = self.waiting.entry(to).or_default();
        rays.shadows.push(flight);
        let len = rays.len();
        self.added(to, len)
    }
    /// Stores what is left; all groups.
    pub fn finish(mut self) -> Result<Vec<GroupRef>, JobError> {
        let rest: Vec<Destination> = self.waiting.keys().copied().collect();
        rest.into_iter().try_for_each(|to| self.flush(to))?;
        Ok(self.stored)
    }

    fn added(&mut self, to: Destination, len: usize) -> Result<(), JobError> {
        self.held += 1;
        self.rays += 1;
        if len >= GROUP_RAYS {
            return self.flush(to);
        }
        if self.held >= self.limit
            && let Some(fullest) = self.waiting.iter().max_by_key(|(_, r)| r.len()).map(|(to, _)| *to)
        {
            return self.flush(fullest);
        }
        Ok(())
    }

    fn flush(&mut self, to: Destination) -> Result<(), JobError> {
        if let Some(rays) = self.waiting.remove(&to) {
            self.held -= rays.len();
            let group = self.sink.store(to, self.stored.len() as u32, &rays)?;
            self.stored.push(group);
        }
        Ok(())
    }
}

impl Outbox for Groups<'_> {
    fn path(&mut self, to: u32, flight: PathFlight) -> Result<(), JobError> {
        self.add_path(Destination::Split(to), flight)
    }
    fn shadow(&mut self, to: u32, flight: ShadowFlight) -> Result<(), JobError> {
        self.add_shadow(Destination::Split(to), flight)
    }
}
