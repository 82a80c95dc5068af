//! What counts: which rays wait, which samples are done, which attempt of which task was committed. Pure.
//!
//! A task takes waiting ray groups and camera units; one of its attempts is committed, the others are garbage. A
//! commit replaces what the task took by what it made, in one step and at most once. Each commit is a [`Record`] that
//! holds the hash of its parent, so the state is what replaying the chain of records gives; a record now and then
//! holds the whole state ([`Snapshot`]), so that older ones, and what only they name, can be deleted.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::allot::Step;
use crate::report::RayCounts;
use crate::wave::{CameraUnit, Done};

mod chain;
mod check;

pub use chain::{Chain, ChainError, Fork, newest, record_key};
pub use check::{Scope, is_of_cut};

/// Whom a ray group waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Destination {
    /// A task that holds the split.
    Split(u32),
    /// A reduce task, which merges what the splits of one cell found.
    Reduce(u32),
}

/// A stored ray group.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupRef {
    /// Its object.
    pub key: String,
    /// Whom it waits for.
    pub to: Destination,
    /// Rays in it.
    pub rays: u32,
    /// Size of the object.
    pub bytes: u64,
    /// Nodes that hold a copy.
    pub holders: Vec<u32>,
}

/// A stored part of the film.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FilmRef {
    /// Its object.
    pub key: String,
    /// The band of tiles that it has something of ([`crate::remote::bands`]); of any tiles without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band: Option<u32>,
    /// Size of the object.
    pub bytes: u64,
    /// Nodes that hold a copy.
    pub holders: Vec<u32>,
}

/// What a task works on.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Inputs {
    /// Keys of ray groups.
    pub groups: Vec<String>,
    /// Camera rays to make.
    pub camera: Vec<CameraUnit>,
}

/// What an attempt made.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outputs {
    /// Rays that left.
    pub groups: Vec<GroupRef>,
    /// What it added to the film, if anything: one part for each band that it touched.
    #[serde(with = "film_refs", default)]
    pub film: Vec<FilmRef>,
    /// Rays traced.
    pub rays: RayCounts,
    /// Contributions that were not finite or too large.
    pub non_finite: u64,
}

/// Number of a task, never used twice in a ledger.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TaskId(pub u64);

/// One commit. Its name is the hash of its bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// What defines the image: the same in all records of a chain.
    pub image: String,
    /// Place in the chain, from 0.
    pub sequence: u64,
    /// Name of the record before; for the first one, the image's.
    pub parent: String,
    /// What it took.
    pub took: Inputs,
    /// What it made.
    pub made: Outputs,
    /// The whole state after it, if written.
    pub snapshot: Option<Snapshot>,
}

/// The state of a ledger, but for running tasks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Parts whose sum is that of all committed ones; none if there were none.
    #[serde(with = "film_refs", default)]
    pub film: Vec<FilmRef>,
    /// Groups that wait.
    pub waiting: Vec<GroupRef>,
    /// Samples whose camera rays were made.
    pub done: Done,
    /// The last step that was planned by what tiles needed; none while all get the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<Step>,
    /// Commits so far.
    pub commits: u64,
    /// Rays traced so far.
    pub rays: RayCounts,
    /// Contributions not finite so far.
    pub non_finite: u64,
}

/// Why the ledger refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// Another task has it, or it was consumed.
    #[error("ray group {0} does not wait")]
    NotWaiting(String),
    /// Those samples were made, or are being made.
    #[error("camera rays of tile {}, samples {}..{} are taken", .0.tile, .0.first, .0.end)]
    NotFree(CameraUnit),
    /// It was committed or given up: the attempt is garbage.
    #[error("task {} does not run", .0.0)]
    NotRunning(TaskId),
    /// A record that does not follow from the state.
    #[error(
        "{} does not follow from what was committed before: {message}; delete it and what comes after it to go on from there, or \
         use another store",
        record_key(*.sequence, .name)
    )]
    BadRecord {
        /// Its place.
        sequence: u64,
        /// Its name.
        name: String,
        /// What does not fit.
        message: String,
    },
}

#[derive(Clone, Debug)]
struct Running {
    inputs: Vec<GroupRef>,
    camera: Vec<CameraUnit>,
    live: BTreeSet<u32>,
    attempts: u32,
}

/// The state machine.
#[derive(Clone, Debug)]
pub struct Ledger {
    image: String,
    head: String,
    sequence: u64,
    waiting: BTreeMap<String, GroupRef>,
    // camera units of running tasks are in `taken`, not in `done`
    done: Done,
    taken: Done,
    step: Option<Step>,
    running: BTreeMap<TaskId, Running>,
    next_task: u64,
    commits: u64,
    rays: RayCounts,
    non_finite: u64,
    attempts_lost: u64,
}

impl Ledger {
    /// An empty ledger for an image, named by what defines it, of so many tiles.
    pub fn new(image: &str, tiles: u32) -> Self {
        Ledger {
            image: image.to_owned(),
            head: image.to_owned(),
            sequence: 0,
            waiting: BTreeMap::new(),
            done: Done::none(tiles),
            taken: Done::none(tiles),
            step: None,
            running: BTreeMap::new(),
            next_task: 0,
            commits: 0,
            rays: RayCounts::default(),
            non_finite: 0,
            attempts_lost: 0,
        }
    }

    /// Names what defines the image.
    pub fn image(&self) -> &str {
        &self.image
    }
    /// Groups that wait and that no task has taken, by key.
    pub fn waiting(&self) -> impl Iterator<Item = &GroupRef> {
        self.waiting.values()
    }
    /// Samples made or being made.
    pub fn taken(&self) -> &Done {
        &self.taken
    }
    /// Samples whose camera rays were made by committed tasks.
    pub fn done(&self) -> &Done {
        &self.done
    }
    /// The last step that was planned by what tiles needed.
    pub fn step(&self) -> Option<&Step> {
        self.step.as_ref()
    }
    /// Such a step was planned. It counts from the next snapshot on.
    pub fn plan_step(&mut self, step: Step) {
        self.step = Some(step);
    }
    /// Tasks that run.
    pub fn running(&self) -> usize {
        self.running.len()
    }
    /// Rays of committed tasks.
    pub fn rays(&self) -> RayCounts {
        self.rays
    }
    /// Contributions of committed tasks that were not finite.
    pub fn non_finite(&self) -> u64 {
        self.non_finite
    }
    /// Commits in the chain.
    pub fn commits(&self) -> u64 {
        self.commits
    }
    /// Attempts that were started and did not count.
    pub fn attempts_lost(&self) -> u64 {
        self.attempts_lost
    }
    /// Whether a snapshot is of the state as it is now, wherever its objects lie, and whatever step is planned.
    pub fn is_as(&self, s: &Snapshot) -> bool {
        let waiting =
            s.waiting.len() == self.waiting.len() && s.waiting.iter().all(|g| self.waiting.contains_key(&g.key));
        let counts = (s.commits, s.rays, s.non_finite) == (self.commits, self.rays, self.non_finite);
        waiting && counts && s.done == self.done
    }
    /// Place of the next record.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }
    /// Whether every ray of the samples made so far has come to its end.
    pub fn is_quiet(&self) -> bool {
        self.waiting.is_empty() && self.running.is_empty()
    }

    /// Starts a task with attempt 0.
    pub fn start(&mut self, inputs: &Inputs) -> Result<(TaskId, Vec<GroupRef>), Refused> {
        let distinct: BTreeSet<&String> = inputs.groups.iter().collect();
        if let Some(key) = inputs.groups.iter().find(|k| !self.waiting.contains_key(*k)) {
            return Err(Refused::NotWaiting(key.clone()));
        }
        if distinct.len() < inputs.groups.len() {
            return Err(Refused::NotWaiting(inputs.groups[0].clone()));
        }
        for (i, &unit) in inputs.camera.iter().enumerate() {
            if !self.taken.add(unit) {
                inputs.camera[..i].iter().for_each(|&u| self.taken.remove(u));
                return Err(Refused::NotFree(unit));
            }
        }
        let groups: Vec<GroupRef> = inputs.groups.iter().filter_map(|k| self.waiting.remove(k)).collect();
        let id = TaskId(self.next_task);
        self.next_task += 1;
        self.running.insert(
            id,
            Running { inputs: groups.clone(), camera: inputs.camera.clone(), live: BTreeSet::from([0]), attempts: 1 },
        );
        Ok((id, groups))
    }

    /// Starts one more attempt of a running task; its number.
    pub fn again(&mut self, id: TaskId) -> Result<u32, Refused> {
        let task = self.running.get_mut(&id).ok_or(Refused::NotRunning(id))?;
        let attempt = task.attempts;
        task.attempts += 1;
        task.live.insert(attempt);
        Ok(attempt)
    }

    /// An attempt will not report. When it was the last one, the task is given up and its inputs wait again: true.
    pub fn lost(&mut self, id: TaskId, attempt: u32) -> bool {
        let Some(task) = self.running.get_mut(&id) else { return false };
        if !task.live.remove(&attempt) {
            return false;
        }
        self.attempts_lost += 1;
        if !task.live.is_empty() {
            return false;
        }
        let task = self.running.remove(&id).expect("it was found above");
        self.waiting.extend(task.inputs.into_iter().map(|g| (g.key.clone(), g)));
        task.camera.into_iter().for_each(|u| self.taken.remove(u));
        true
    }

    /// What the commit of a task would be recorded as. The record must be durable before [`Ledger::commit`].
    pub fn record(&self, id: TaskId, made: Outputs) -> Result<Record, Refused> {
        let task = self.running.get(&id).ok_or(Refused::NotRunning(id))?;
        let took = Inputs { groups: task.inputs.iter().map(|g| g.key.clone()).collect(), camera: task.camera.clone() };
        Ok(self.next_record(took, made, None))
    }

    /// A record that changes nothing but holds the whole state, or takes the ledger back to an earlier one.
    pub fn record_of(&self, snapshot: Snapshot) -> Record {
        self.next_record(Inputs::default(), Outputs::default(), Some(snapshot))
    }

    fn next_record(&self, took: Inputs, made: Outputs, snapshot: Option<Snapshot>) -> Record {
        let (image, parent) = (self.image.clone(), self.head.clone());
        Record { image, sequence: self.sequence, parent, took, made, snapshot }
    }

    /// The state as it is, with the film of all commits; what running tasks hold waits in it.
    pub fn snapshot(&self, film: Vec<FilmRef>) -> Snapshot {
        let held = self.running.values().flat_map(|t| &t.inputs);
        let mut waiting: Vec<GroupRef> = self.waiting.values().chain(held).cloned().collect();
        waiting.sort_by(|a, b| a.key.cmp(&b.key));
        let (commits, rays, non_finite) = (self.commits, self.rays, self.non_finite);
        Snapshot { film, waiting, done: self.done.clone(), step: self.step.clone(), commits, rays, non_finite }
    }

    /// Gives up all running tasks and takes the state of a snapshot, whose record is durable.
    pub fn go_back(&mut self, record: &Record, name: String) -> Result<(), Refused> {
        if record.parent != self.head || record.sequence != self.sequence {
            return Err(bad(record, &name, "its parent is not the newest record"));
        }
        let given_up: usize = self.running.values().map(|t| t.live.len()).sum();
        self.attempts_lost += given_up as u64;
        self.running.clear();
        self.replay(record, name)
    }

    /// A group lies elsewhere now. Whether it waits, or a running task has it.
    pub fn relocate(&mut self, key: &str, holders: Vec<u32>) -> bool {
        let held = self.running.values_mut().flat_map(|t| &mut t.inputs).find(|g| g.key == key);
        match self.waiting.get_mut(key).or(held) {
            Some(group) => {
                group.holders = holders;
                true
            }
            None => false,
        }
    }

    /// Whether no ray is on its way: nothing waits, and running tasks only make camera rays.
    pub fn is_settled(&self) -> bool {
        self.waiting.is_empty() && self.running.values().all(|t| t.inputs.is_empty())
    }

    /// Commits a running task by its (durable) record; `name` is the record's hash. Other attempts become garbage.
    pub fn commit(&mut self, id: TaskId, record: &Record, name: String) -> Result<(), Refused> {
        let task = self.running.get(&id).ok_or(Refused::NotRunning(id))?;
        if record.parent != self.head || record.sequence != self.sequence {
            return Err(bad(record, &name, "its parent is not the newest record"));
        }
        self.attempts_lost += task.live.len() as u64 - 1;
        let task = self.running.remove(&id).expect("it was found above");
        for unit in task.camera {
            self.done.add(unit);
        }
        self.follow(record, name);
        Ok(())
    }

    /// Appends a record that holds the state as it is; running tasks go on.
    pub fn follow_snapshot(&mut self, record: &Record, name: String) -> Result<(), Refused> {
        if record.parent != self.head || record.sequence != self.sequence {
            return Err(bad(record, &name, "its parent is not the newest record"));
        }
        (self.head, self.sequence) = (name, record.sequence + 1);
        Ok(())
    }

    /// Applies the next record of a chain that is replayed. No task may run.
    pub fn replay(&mut self, record: &Record, name: String) -> Result<(), Refused> {
        if record.image != self.image {
            return Err(bad(record, &name, "it is of another image"));
        }
        if let Some(s) = &record.snapshot {
            // a snapshot stands for all records up to its own
            self.waiting = s.waiting.iter().map(|g| (g.key.clone(), g.clone())).collect();
            self.done = s.done.clone();
            self.taken = s.done.clone();
            self.step.clone_from(&s.step);
            (self.commits, self.rays, self.non_finite) = (s.commits, s.rays, s.non_finite);
            (self.head, self.sequence) = (name, record.sequence + 1);
            return Ok(());
        }
        if record.parent != self.head || record.sequence != self.sequence {
            return Err(bad(record, &name, "its parent is not the record before"));
        }
        if let Some(key) = record.took.groups.iter().find(|k| !self.waiting.contains_key(*k)) {
            return Err(bad(record, &name, &format!("it consumes {key}, which does not wait")));
        }
        for &unit in &record.took.camera {
            if !self.done.add(unit) || !self.taken.add(unit) {
                return Err(bad(record, &name, "it makes camera rays a second time"));
            }
        }
        record.took.groups.iter().for_each(|k| {
            self.waiting.remove(k);
        });
        self.follow(record, name);
        Ok(())
    }

    fn follow(&mut self, record: &Record, name: String) {
        self.waiting.extend(record.made.groups.iter().map(|g| (g.key.clone(), g.clone())));
        self.rays.merge(&record.made.rays);
        self.non_finite += record.made.non_finite;
        self.commits += 1;
        self.sequence += 1;
        self.head = name;
    }
}

/// One part is written as itself and none as null, as when there was one at most; so records of small films are the same in all versions.
mod film_refs {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    use super::FilmRef;

    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Either {
        Many(Vec<FilmRef>),
        One(FilmRef),
    }

    pub fn serialize<S: Serializer>(film: &Vec<FilmRef>, to: S) -> Result<S::Ok, S::Error> {
        match film.as_slice() {
            [] => to.serialize_none(),
            [one] => one.serialize(to),
            many => many.serialize(to),
        }
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<FilmRef>, D::Error> {
        Ok(match Option::<Either>::deserialize(from)? {
            None => Vec::new(),
            Some(Either::One(one)) => vec![one],
            Some(Either::Many(many)) => many,
        })
    }
}

fn bad(record: &Record, name: &str, message: &str) -> Refused {
    Refused::BadRecord { sequence: record.sequence, name: name.to_owned(), message: message.to_owned() }
}

#[cfg(test)]
mod tests;
