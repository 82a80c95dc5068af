//! The workers as an executor, with an eye on the stores: what lay on one that is silent for long is copied again.
//!
//! While there are fewer copies than asked for, another loss may cost work, and whoever watches the job is told
//! ([`Keeper::below`]). Copying is work for workers; the operator reads round records only.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::runtime::Handle;

use super::depot::{Depot, Part};
use super::fleet::Fleet;
use super::frames::Keeper;
use super::message::{Done, Work};
use crate::driver::{Event, Executor, Launch, Objects};
use crate::job::JobError;
use crate::store::BlockStore;

/// Between two looks whether a silent machine is back, by whoever has nothing to ask it.
const LOOK: Duration = Duration::from_secs(1);
/// Round records lie below this.
const RECORDS: &str = "records/";

/// A fleet and the stores that its workers use.
pub struct Guard<'a> {
    fleet: &'a Fleet,
    depot: &'a Depot,
    part: &'a Part,
    keeper: &'a dyn Keeper,
    runtime: &'a Handle,
    /// A store that is silent for so long is lost, until it is back.
    patience: Duration,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Stores that are lost: none until all was copied, then the objects that have too few copies all the same.
    lost: BTreeMap<u32, Option<u64>>,
    looked: Option<Instant>,
    said: Option<String>,
}

impl<'a> Guard<'a> {
    /// Around a fleet whose jobs' objects lie in `part` of a depot.
    pub fn new(
        (fleet, depot, part): (&'a Fleet, &'a Depot, &'a Part),
        keeper: &'a dyn Keeper,
        runtime: &'a Handle,
        patience: Duration,
    ) -> Self {
        Guard { fleet, depot, part, keeper, runtime, patience, state: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A store that was not lost before and is now.
    fn newly_lost(&self) -> Option<u32> {
        let mut state = self.lock();
        if self.depot.silent(Duration::ZERO).is_empty() && state.lost.is_empty() {
            return None;
        }
        if state.looked.is_none_or(|t| t.elapsed() >= LOOK) {
            state.looked = Some(Instant::now());
            let depot = self.depot.clone();
            self.runtime.spawn(async move { depot.look().await });
        }
        let silent: BTreeSet<u32> = self.depot.silent(self.patience).into_iter().collect();
        let known = state.lost.len();
        state.lost.retain(|n, _| silent.contains(n));
        let new = silent.into_iter().find(|n| !state.lost.contains_key(n));
        if let Some(new) = new {
            state.lost.insert(new, None);
        }
        if new.is_some() || state.lost.len() != known {
            self.tell(&mut state);
        }
        new
    }

    /// What there is too little of, if that changed.
    fn tell(&self, state: &mut State) {
        let of = |(n, few): (&u32, &Option<u64>)| {
            let why = if self.depot.is_emptied(*n) {
                "has lost its bucket and all that was in it (create the bucket, and it is used again)"
            } else {
                "is silent"
            };
            match few {
                None => Some(format!("store {n} {why}: what lay on it has a copy less, and is being copied")),
                Some(0) => None,
                Some(few) => Some(format!("store {n} {why}: {few} object(s) of the job have too few copies, or none")),
            }
        };
        let below: Vec<String> = state.lost.iter().filter_map(of).collect();
        let said = (!below.is_empty()).then(|| below.join("; "));
        if said != state.said {
            self.keeper.below(said.as_deref());
            state.said = said;
        }
    }

    fn other() -> JobError {
        JobError::Internal("a worker reports something else than it was to do".into())
    }
}

impl Executor for Guard<'_> {
    fn is_up(&self, node: u32) -> bool {
        self.fleet.is_up(node)
    }
    fn holders(&self) -> Option<Vec<Vec<u32>>> {
        self.fleet.holders()
    }
    fn memory(&self) -> Option<u64> {
        self.fleet.memory()
    }
    fn copy_again(&self, objects: Objects, gone: u32) -> Result<Objects, JobError> {
        match self.fleet.call(Work::Copy { objects, gone })? {
            Done::Copied { objects } => Ok(objects),
            _ => Err(Self::other()),
        }
    }
    fn restore(&self, gone: u32, few: usize) -> Result<(), JobError> {
        let Done::Restored { copies, few: of_scene } = self.fleet.call(Work::Restore { gone })? else {
            return Err(Self::other());
        };
        let shared = self.part.shared();
        let records = async {
            let mut few = 0;
            for (key, _) in shared.list(RECORDS).await? {
                few += u64::from(!shared.replicated().keep_up(&key).await.1);
            }
            Ok::<u64, JobError>(few)
        };
        let of_records = self.runtime.block_on(records)?;
        let few = few as u64 + of_scene + of_records;
        tracing::info!(store = gone, copies, few, "what lay on a silent store was copied");
        let mut state = self.lock();
        if let Some(entry) = state.lost.get_mut(&gone) {
            *entry = Some(few);
        }
        self.tell(&mut state);
        Ok(())
    }
    fn has_room(&self) -> bool {
        self.fleet.has_room()
    }
    fn launch(&self, launch: Launch) {
        self.fleet.launch(launch);
    }
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError> {
        match self.newly_lost() {
            Some(store) => Ok(Some(Event::StoreLost(store))),
            None => self.fleet.next(wait),
        }
    }
}
