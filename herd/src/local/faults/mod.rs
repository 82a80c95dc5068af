//! A schedule of faults, a function of its seed: what befalls an attempt depends on what its task works on and on how often
//! that was tried, not on when it starts.
//!
//! With [one thread](crate::job::JobSettings::threads) a schedule runs attempts one after the other, so that the whole run
//! is a function of the seed. With more threads their race decides what later tasks are made of.

mod schedule;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::attempt::Attempt;
use crate::ledger::Destination;
use crate::plan::Set;
pub use schedule::Schedule;

/// What befalls an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// Nothing.
    Fine,
    /// It is killed after so many batches.
    Kill(u32),
    /// Its node loses its disk and memory when it reports.
    LoseNode,
    /// It starts after so many other attempts, if there are as many.
    Delay(u32),
    /// Its result arrives only after its task was committed by another attempt (never by chance: see [`Faults::first`]).
    Straggle,
    /// Its result arrives twice.
    Duplicate,
    /// Its result never arrives.
    LoseResult,
    /// A byte of a copy of an object that it made changes, or of a block of the scene on some node's disk.
    Corrupt,
}

/// A schedule. Clones share what has happened so far.
#[derive(Clone, Debug)]
pub struct Faults {
    seed: u64,
    first: Option<Fate>,
    told: Arc<Mutex<Told>>,
}

/// What has happened so far.
#[derive(Debug, Default)]
struct Told {
    tries: BTreeMap<u64, u32>,
    hits: u32,
    log: Vec<(u64, u32, Fate)>,
}

/// A task is hit at its first tries only, and a job so often, so that every schedule comes to an end.
const MOST_TRIES: u32 = 3;
const MOST_HITS: u32 = 40;

impl Faults {
    /// The schedule of a seed.
    pub fn new(seed: u64) -> Self {
        Faults { seed, first: None, told: Arc::default() }
    }
    /// One fault: what befalls the first attempt of the job, and nothing else.
    pub fn first(fate: Fate) -> Self {
        Faults { first: Some(fate), ..Faults::new(0) }
    }

    /// All attempts so far in the order in which they were started: what each worked on, how often that had been tried
    /// before, and what befell it.
    pub fn log(&self) -> Vec<(u64, u32, Fate)> {
        self.lock().log.clone()
    }

    /// A number below `n` (at least 1) for a choice that the seed leaves open.
    pub fn pick(&self, what: u64, n: u64) -> u64 {
        mix(self.seed.wrapping_add(1) ^ mix(what)) % n.max(1)
    }

    /// What befalls the next try of a task of this identity.
    fn next(&self, identity: u64) -> Fate {
        let mut told = self.lock();
        let first = told.log.is_empty();
        let tries = told.tries.entry(identity).or_default();
        let number = *tries;
        *tries += 1;
        let fate = match self.first {
            Some(fate) if first => fate,
            Some(_) => Fate::Fine,
            None if number >= MOST_TRIES || told.hits >= MOST_HITS => Fate::Fine,
            None => self.fate(identity, number),
        };
        told.hits += u32::from(fate != Fate::Fine);
        told.log.push((identity, number, fate));
        fate
    }

    /// Each seed has a mixture of its own: from none to seven of eight are hit.
    fn fate(&self, identity: u64, number: u32) -> Fate {
        let x = mix(self.seed ^ mix(identity.wrapping_add(u64::from(number))));
        if (x >> 8) % 8 >= mix(self.seed) % 8 {
            return Fate::Fine;
        }
        match x % 6 {
            0 => Fate::Kill((x >> 16) as u32 % 6),
            1 if (x >> 24).is_multiple_of(3) => Fate::LoseNode,
            2 => Fate::Delay(1 + (x >> 32) as u32 % 4),
            3 => Fate::Duplicate,
            4 => Fate::LoseResult,
            5 => Fate::Corrupt,
            _ => Fate::Fine,
        }
    }

    fn lock(&self) -> MutexGuard<'_, Told> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Names what a task works on, whatever its number and whoever made its rays: sizes tell groups apart well enough.
fn identity(attempt: &Attempt) -> u64 {
    let mut hash = match &attempt.set {
        Set::Resident(splits) => splits.iter().fold(1, |h, &s| mix(h ^ u64::from(s))),
        Set::Sharing(split) => mix(2 ^ u64::from(*split) << 8),
        Set::Any => 3,
        Set::Reduce => 4,
    };
    let mut add = |x: u64| hash = mix(hash ^ x);
    for unit in &attempt.camera {
        add(u64::from(unit.tile) << 32 | u64::from(unit.first));
        add(u64::from(unit.end));
    }
    let number = |to: Destination| match to {
        Destination::Split(s) => u64::from(s) << 1,
        Destination::Reduce(bucket) => u64::from(bucket) << 1 | 1,
    };
    // in an order that their names, which tell who made them when, have no part in
    let mut groups: Vec<_> = attempt.groups.iter().map(|g| (number(g.to), u64::from(g.rays), g.bytes)).collect();
    groups.sort_unstable();
    for (to, rays, bytes) in groups {
        add(to);
        add(rays << 32 | bytes);
    }
    hash
}

/// SplitMix64's finaliser.
fn mix(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
