//! What is done when nodes, copies or rays are lost.

use super::{Driver, Executor, FilmSum, Objects};
use crate::job::JobError;
use crate::ledger::{Outputs, Snapshot};
use crate::report::Kind;

impl<F: FilmSum> Driver<'_, '_, F> {
    /// Rays were lost with all their copies: back to the last state without rays on their way.
    ///
    /// Which task made a ray is not kept, so its place in the tree of tasks is not known; the film, which only adds, cannot be
    /// taken back in parts either. What was committed since then is computed again and counted ([`Report::tasks_redone`]).
    ///
    /// [`Report::tasks_redone`]: crate::report::Report::tasks_redone
    pub(crate) fn go_back(&mut self, why: &JobError) -> Result<(), JobError> {
        tracing::warn!("{why}; what was committed since no ray was on its way is computed again");
        let before: Objects =
            self.ledger.snapshot(Vec::new()).waiting.into_iter().map(|g| (g.key, g.holders)).collect();
        // what a step stands on is made again as it was
        let mut snapshot = Snapshot { step: self.ledger.step().cloned(), ..self.settled.clone() };
        self.film.go_back();
        self.redone += self.ledger.commits() - snapshot.commits;
        if self.is_durable() {
            let key = self.film_name();
            snapshot.film = self.film.store(&key)?;
        }
        let film = snapshot.film.clone();
        let record = self.ledger.record_of(snapshot);
        let name = self.write(&record)?;
        self.ledger.go_back(&record, name)?;
        self.note_stored(film);
        self.stop_all();
        self.running.clear();
        self.cameras.clear();
        self.cameras.add(&0.into(), &self.queued, self.ledger.taken());
        self.shared.nodes.delete(&before)
    }

    /// A node is gone with its disk and what ran on it, and comes back empty. What has other copies is copied again.
    pub(super) fn lose_node(&mut self, node: u32) -> Result<(), JobError> {
        let nodes = &self.shared.nodes;
        self.forget(node);
        self.live.values().filter(|l| l.node == node).for_each(|l| l.stop.set());
        for group in self.ledger.snapshot(Vec::new()).waiting {
            if group.holders.contains(&node) {
                let holders = nodes.copy_again(Kind::Rays, &group.key, &group.holders, node)?;
                self.ledger.relocate(&group.key, holders);
            }
        }
        if self.is_durable() {
            // film parts may have lain there; the sums are here
            self.write_snapshot()?;
        }
        Ok(())
    }

    /// A store is silent. What lay on it is copied again from where else it lies, so that another loss costs no work.
    pub(super) fn lose_copies(&mut self, executor: &dyn Executor, store: u32) -> Result<(), JobError> {
        let waiting = self.ledger.snapshot(Vec::new()).waiting;
        let groups = waiting.into_iter().filter(|g| g.holders.contains(&store)).map(|g| (g.key, g.holders));
        let objects: Objects = groups.chain(self.film.on_store(store)).collect();
        let (lay, copies) = (objects.len(), self.shared.settings.replicas as usize);
        let now = if objects.is_empty() { objects } else { executor.copy_again(objects, store)? };
        let few = lay - now.iter().filter(|(_, holders)| holders.len() >= copies).count();
        for (name, holders) in now {
            self.film.relocate(&name, &holders);
            self.ledger.relocate(&name, holders);
        }
        if self.is_durable() {
            // whoever goes on from here finds the copies
            self.write_snapshot()?;
        }
        executor.restore(store, few)
    }

    /// Deletes what an attempt made that does not count.
    pub(super) fn discard(&self, outputs: &Outputs) -> Result<(), JobError> {
        let groups = outputs.groups.iter().map(|g| (g.key.clone(), g.holders.clone()));
        let film = outputs.film.iter().map(|f| (f.key.clone(), f.holders.clone()));
        self.shared.nodes.delete(&groups.chain(film).collect::<Objects>())
    }
}
