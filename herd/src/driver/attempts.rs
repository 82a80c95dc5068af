//! Attempts of tasks, and second attempts of those that straggle.

use std::time::Instant;

use super::{Driver, Executor, FilmSum, Launch, Live, Running};
use crate::job::JobError;
use crate::ledger::{Inputs, TaskId};
use crate::local::attempt::Attempt;
use crate::local::slots::StopFlag;
use crate::plan::{self, Assignment, Set};

impl<F: FilmSum> Driver<'_, '_, F> {
    /// Starts a task as planned; false if there was nothing left for it to do.
    pub(super) fn start(
        &mut self,
        executor: &dyn Executor,
        (plan, groups): (Assignment, Vec<String>),
    ) -> Result<bool, JobError> {
        let camera = plan.camera.map_or_else(Vec::new, |(rays, from)| self.cameras.take(rays, &from));
        if groups.is_empty() && camera.is_empty() {
            return Ok(false);
        }
        let set = match plan.set {
            Set::Resident(ranks) => {
                self.hold(plan.node, &ranks);
                self.remember(plan.node, &ranks);
                let mut splits: Vec<u32> = ranks.into_iter().map(|r| self.order[r as usize]).collect();
                splits.sort_unstable();
                Set::Resident(splits)
            }
            Set::Sharing(rank) => {
                self.remember(plan.node, &[rank]);
                Set::Sharing(self.order[rank as usize])
            }
            other => other,
        };
        let (task, groups) = self.ledger.start(&Inputs { groups, camera: camera.clone() })?;
        let name = format!("{}-t{:08}", self.session, task.0);
        let spec = Attempt { name, node: plan.node, set, groups, camera };
        let node = plan.node;
        self.running.insert(task, Running { spec, started: Instant::now(), attempts: 0 });
        self.launch(executor, task, node);
        Ok(true)
    }

    /// Starts an attempt of a running task.
    fn launch(&mut self, executor: &dyn Executor, task: TaskId, node: u32) {
        let Some(running) = self.running.get_mut(&task) else { return };
        let number = running.attempts;
        running.attempts += 1;
        let attempt = Attempt { name: format!("{}-a{number}", running.spec.name), node, ..running.spec.clone() };
        let stop = StopFlag::default();
        self.free[node as usize] -= 1;
        self.live.insert((task, number), Live { node, stop: stop.clone() });
        executor.launch(Launch { task, number, attempt, stop });
    }

    /// Starts a second attempt of tasks that take much longer than others did, where nothing else is to be done.
    pub(super) fn second_attempts(&mut self, executor: &dyn Executor) {
        let settings = self.shared.settings;
        let late = settings.straggler_seconds.unwrap_or((3.0 * settings.task_seconds).max(1.0));
        let slow = self.running.iter().filter(|(_, r)| r.attempts < 2 && r.started.elapsed().as_secs_f64() > late);
        let slow: Vec<TaskId> = slow.map(|(&t, _)| t).collect();
        if slow.is_empty() {
            return;
        }
        let holders = executor.holders().unwrap_or_else(|| self.shared.nodes.holders());
        for task in slow {
            if !executor.has_room() {
                return;
            }
            // what was planned when there was more memory ends where it is, or is planned anew
            let bytes = match &self.running[&task].spec.set {
                Set::Resident(set) => set.iter().map(|&s| self.shared.scene.split_bytes(s)).sum(),
                Set::Any | Set::Sharing(_) | Set::Reduce => 0,
            };
            if bytes > self.memory {
                continue;
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
            let may = |n: u32| self.free[n as usize] > 0 && executor.is_up(n) && (holds(n) || rests(n));
            let nodes = (0..self.free.len() as u32).filter(|&n| may(n));
            // on another node, if there is one, and where the data lies
            let set: &[u32] = if let Set::Resident(set) = &self.running[&task].spec.set { set } else { &[] };
            let near = |n: u32| set.iter().filter(|&&s| holders[s as usize].contains(&n)).count();
            let best = nodes.max_by_key(|&n| (n != first, holds(n), near(n), self.free[n as usize]));
            if let Some((node, held)) = best.map(|n| (n, holds(n)))
                && self.ledger.again(task).is_ok()
            {
                if !held {
                    self.hold(node, &ranks);
                }
                self.launch(executor, task, node);
            }
        }
    }
}
