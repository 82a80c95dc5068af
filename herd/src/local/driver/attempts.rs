//! Attempts of tasks on threads, and second attempts of those that straggle.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::Scope;
use std::time::Instant;

use super::{Driver, Live, Message, Running};
use crate::job::JobError;
use crate::ledger::{Inputs, TaskId};
use crate::local::attempt::{Attempt, run};
use crate::local::faults::Fate;
use crate::local::slots::StopFlag;
use crate::local::usage;
use crate::plan::{self, Assignment, Set};

impl<'s, 'a> Driver<'s, 'a> {
    /// Starts a task as planned; false if there was nothing left for it to do.
    pub(super) fn start<'scope>(
        &mut self,
        scope: &'scope Scope<'scope, '_>,
        (plan, groups): (Assignment, Vec<String>),
    ) -> Result<bool, JobError>
    where
        's: 'scope,
        'a: 'scope,
    {
        let camera = plan.camera.map_or_else(Vec::new, |(rays, from)| self.cameras.take(rays, &from));
        if groups.is_empty() && camera.is_empty() {
            return Ok(false);
        }
        let set = match plan.set {
            Set::Resident(ranks) => {
                self.hold(plan.node, &ranks);
                let mut splits: Vec<u32> = ranks.into_iter().map(|r| self.order[r as usize]).collect();
                splits.sort_unstable();
                Set::Resident(splits)
            }
            Set::Sharing(rank) => Set::Sharing(self.order[rank as usize]),
            other => other,
        };
        let (task, groups) = self.ledger.start(&Inputs { groups, camera: camera.clone() })?;
        let name = format!("{}-t{:08}", self.session, task.0);
        let spec = Attempt { name, node: plan.node, set, groups, camera };
        let node = plan.node;
        self.running.insert(task, Running { spec, started: Instant::now(), attempts: 0 });
        self.launch(scope, task, node);
        Ok(true)
    }

    /// Starts an attempt of a running task on a thread of its own.
    pub(super) fn launch<'scope>(&mut self, scope: &'scope Scope<'scope, '_>, task: TaskId, node: u32)
    where
        's: 'scope,
        'a: 'scope,
    {
        let Some(running) = self.running.get_mut(&task) else { return };
        let number = running.attempts;
        running.attempts += 1;
        let attempt = Attempt { name: format!("{}-a{number}", running.spec.name), node, ..running.spec.clone() };
        let ordinal = self.launched;
        self.launched += 1;
        let fate = self.faults.map_or(Fate::Fine, |f| f.fate(ordinal));
        let stop = StopFlag::new(if let Fate::Kill(batches) = fate { Some(batches) } else { None });
        // one that straggles works to its end, though another one was faster
        let told = if fate == Fate::Straggle { StopFlag::new(None) } else { stop.clone() };
        self.free[node as usize] -= 1;
        self.live.insert((task, number), Live { node, stop: stop.clone(), ordinal });
        let (shared, gate, send) = (self.shared, self.gate, self.send.clone());
        scope.spawn(move || {
            if let Fate::Delay(time) = fate {
                std::thread::sleep(time);
            }
            let permit = gate.enter();
            let before = usage::thread_cpu();
            // a panic must end the job with a message, not leave it waiting
            let result = catch_unwind(AssertUnwindSafe(|| run(shared, &attempt, &told)))
                .unwrap_or_else(|_| Err(JobError::Internal("a task panicked".into())));
            let cpu = usage::thread_cpu() - before;
            drop(permit);
            if fate == Fate::Straggle {
                stop.wait();
            }
            // nobody listens when the job has failed
            let _ = send.send(Message { task, number, result, cpu });
        });
    }

    /// Starts a second attempt of tasks that take much longer than others did, where nothing else is to be done.
    pub(super) fn second_attempts<'scope>(&mut self, scope: &'scope Scope<'scope, '_>)
    where
        's: 'scope,
        'a: 'scope,
    {
        let settings = self.shared.settings;
        let late = settings.straggler_seconds.unwrap_or((3.0 * settings.task_seconds).max(1.0));
        let slow = self.running.iter().filter(|(_, r)| r.attempts < 2 && r.started.elapsed().as_secs_f64() > late);
        let slow: Vec<TaskId> = slow.map(|(&t, _)| t).collect();
        for task in slow {
            if !self.gate.has_room() {
                return;
            }
            let Some(first) = self.live.iter().find(|(k, _)| k.0 == task).map(|(_, l)| l.node) else { continue };
            let ranks: Vec<u32> = match &self.running[&task].spec.set {
                Set::Resident(set) if settings.strategy == plan::Strategy::Auto => {
                    set.iter().map(|&s| self.rank[s as usize]).collect()
                }
                _ => Vec::new(),
            };
            let holds = |n: u32| ranks.iter().all(|r| self.windows[n as usize].contains(r));
            // a node that rests may load what it lacks: there is nothing else for it to do
            let rests = |n: u32| self.free[n as usize] == settings.nodes[n as usize].slots;
            let nodes = (0..self.free.len() as u32).filter(|&n| self.free[n as usize] > 0 && (holds(n) || rests(n)));
            // on another node, if there is one
            let best = nodes.max_by_key(|&n| (n != first, holds(n), self.free[n as usize]));
            if let Some((node, held)) = best.map(|n| (n, holds(n)))
                && self.ledger.again(task).is_ok()
            {
                if !held {
                    self.hold(node, &ranks);
                }
                self.launch(scope, task, node);
            }
        }
    }
}
