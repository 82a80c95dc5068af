//! Faults between the loop over rounds and whoever runs its attempts.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::{Fate, Faults, identity};
use crate::driver::{Event, Executor, Finished, Launch};
use crate::job::JobError;
use crate::ledger::{Outputs, TaskId};
use crate::local::nodes::Nodes;
use crate::local::slots::StopFlag;

/// CPU-seconds that a ray takes, as the planner is told: what it plans must not depend on how fast the machine was.
const RAY_SECONDS: f64 = 1e-6;

/// An executor whose attempts meet with what a schedule holds for them.
pub struct Schedule<'e, 'a> {
    faults: Faults,
    inner: &'e dyn Executor,
    nodes: &'e Nodes<'a>,
    /// One attempt after the other.
    serial: bool,
    state: RefCell<State>,
}

#[derive(Default)]
struct State {
    doing: BTreeMap<(TaskId, u32), Doing>,
    /// Launches that wait, with the number of others that each lets pass.
    waiting: VecDeque<(u32, Launch, Fate, u64)>,
    /// Results of stragglers that are not beaten yet.
    held: Vec<Finished>,
    events: VecDeque<Event>,
}

struct Doing {
    node: u32,
    fate: Fate,
    identity: u64,
    stop: StopFlag,
}

impl<'e, 'a> Schedule<'e, 'a> {
    /// Around an executor; `serial` when what happens is to be a function of the seed alone.
    pub fn new(faults: Faults, inner: &'e dyn Executor, nodes: &'e Nodes<'a>, serial: bool) -> Self {
        Schedule { faults, inner, nodes, serial, state: RefCell::default() }
    }

    /// What attempts have reported and nobody was told.
    pub fn left(self) -> Vec<Finished> {
        let State { held, events, .. } = self.state.into_inner();
        let finished = |e| if let Event::Finished(f) = e { Some(*f) } else { None };
        held.into_iter().chain(events.into_iter().filter_map(finished)).collect()
    }

    /// Starts what has waited long enough, and the first one when nothing else is under way.
    fn release(&self, state: &mut State) {
        // what runs reads what whoever is told of events deletes and copies: one after the other, too
        while !self.serial || (state.doing.is_empty() && state.events.is_empty()) {
            let due = state.waiting.iter().position(|w| w.0 == 0);
            let next = due.or((state.doing.is_empty() && !state.waiting.is_empty()).then_some(0));
            let Some((_, mut launch, fate, identity)) = next.and_then(|at| state.waiting.remove(at)) else { return };
            state.waiting.iter_mut().for_each(|w| w.0 = w.0.saturating_sub(1));
            let stop = launch.stop.clone();
            match fate {
                Fate::Kill(batches) => launch.stop = stop.limited(batches),
                // one that straggles works to its end, though another one was faster
                Fate::Straggle => launch.stop = StopFlag::default(),
                _ => {}
            }
            let doing = Doing { node: launch.attempt.node, fate, identity, stop };
            state.doing.insert((launch.task, launch.number), doing);
            self.inner.launch(launch);
        }
    }

    /// What becomes of a result.
    fn meet(&self, state: &mut State, mut finished: Finished) -> Result<(), JobError> {
        let Some(doing) = state.doing.remove(&(finished.task, finished.number)) else {
            return Err(JobError::Internal("an attempt reports that was never started".into()));
        };
        let made = match &finished.result {
            Ok(made) => made,
            Err(_) => {
                state.events.push_back(Event::Finished(finished.into()));
                return Ok(());
            }
        };
        let rays = made.outputs.rays;
        finished.cpu = RAY_SECONDS * (rays.camera + rays.closest + rays.shadow) as f64;
        let lost = |f: &Finished| Finished { result: Err(JobError::Stopped), bytes: f.bytes.clone(), ..*f };
        match doing.fate {
            Fate::Straggle if !doing.stop.is_set() => {
                state.doing.insert((finished.task, finished.number), doing);
                state.held.push(finished);
                return Ok(());
            }
            Fate::LoseResult => {
                self.discard(&made.outputs)?;
                finished = lost(&finished);
            }
            Fate::LoseNode => {
                self.discard(&made.outputs)?;
                self.nodes.lose(doing.node)?;
                state.events.push_back(Event::Finished(lost(&finished).into()));
                state.events.push_back(Event::NodeLost(doing.node));
                return Ok(());
            }
            Fate::Corrupt => self.corrupt(doing.identity, &made.outputs)?,
            Fate::Duplicate => state.events.push_back(Event::Finished(twin(&finished).into())),
            _ => {}
        }
        state.events.push_back(Event::Finished(finished.into()));
        Ok(())
    }

    /// Deletes what an attempt made.
    fn discard(&self, outputs: &Outputs) -> Result<(), JobError> {
        let groups = outputs.groups.iter().map(|g| (g.key.clone(), g.holders.clone()));
        let film = outputs.film.iter().map(|f| (f.key.clone(), f.holders.clone()));
        self.nodes.delete(&groups.chain(film).collect::<Vec<_>>())
    }

    /// A byte of one copy of something that an attempt made changes, or of a block on some node's disk.
    fn corrupt(&self, what: u64, outputs: &Outputs) -> Result<(), JobError> {
        if self.faults.pick(what.wrapping_add(3), 2) == 0 {
            // each question is another one
            let asked = std::cell::Cell::new(what.wrapping_add(4));
            return self.nodes.corrupt_block(|n| self.faults.pick(asked.replace(asked.get().wrapping_add(1)), n));
        }
        let groups = outputs.groups.iter().map(|g| (&g.key, &g.holders, g.bytes));
        let made: Vec<_> = groups.chain(outputs.film.iter().map(|f| (&f.key, &f.holders, f.bytes))).collect();
        if made.is_empty() {
            return Ok(());
        }
        let pick = |i: u64, n: u64| self.faults.pick(what.wrapping_add(i), n);
        let (key, holders, bytes) = made[pick(0, made.len() as u64) as usize];
        let holder = holders[pick(1, holders.len() as u64) as usize];
        self.nodes.corrupt(holder, key, pick(2, bytes))
    }
}

/// The same report once more.
fn twin(finished: &Finished) -> Finished {
    let result = match &finished.result {
        Ok(made) => Ok(made.clone()),
        Err(_) => Err(JobError::Stopped),
    };
    Finished { result, bytes: finished.bytes.clone(), ..*finished }
}

impl Executor for Schedule<'_, '_> {
    fn is_up(&self, node: u32) -> bool {
        self.inner.is_up(node)
    }
    fn holders(&self) -> Option<Vec<Vec<u32>>> {
        self.inner.holders()
    }
    fn has_room(&self) -> bool {
        // a second attempt comes when the clock says so
        !self.serial && self.inner.has_room()
    }
    fn launch(&self, launch: Launch) {
        let identity = identity(&launch.attempt);
        let fate = self.faults.next(identity);
        let after = if let Fate::Delay(others) = fate { others } else { 0 };
        let mut state = self.state.borrow_mut();
        state.waiting.push_back((after, launch, fate, identity));
        self.release(&mut state);
    }
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError> {
        let mut state = self.state.borrow_mut();
        // all that was told so far has been dealt with
        self.release(&mut state);
        let beaten = |f: &Finished, s: &State| s.doing.get(&(f.task, f.number)).is_some_and(|d| d.stop.is_set());
        while let Some(at) = state.held.iter().position(|f| beaten(f, &state)) {
            let finished = state.held.remove(at);
            self.meet(&mut state, finished)?;
        }
        if state.events.is_empty() {
            drop(state);
            let event = self.inner.next(wait)?;
            state = self.state.borrow_mut();
            match event {
                Some(Event::Finished(finished)) => self.meet(&mut state, *finished)?,
                Some(event) => state.events.push_back(event),
                None => {}
            }
        }
        if !self.serial {
            self.release(&mut state);
        }
        Ok(state.events.pop_front())
    }
}
