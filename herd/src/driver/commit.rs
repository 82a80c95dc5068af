//! From what an attempt reports to what counts.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use super::{Driver, FilmSum, Finished, Objects};
use crate::job::JobError;
use crate::ledger::{FilmRef, Record, Refused, TaskId, record_key};
use crate::local::attempt::Made;
use crate::local::journal;

/// The error that is shown is not found more often.
const ERROR_EVERY: Duration = Duration::from_secs(1);
/// Nor does finding it take more than one part in so many of the time.
const ERROR_SHARE: u32 = 50;

/// Commits between two snapshots.
const SNAPSHOT_EVERY: u64 = 16;

impl<F: FilmSum> Driver<'_, '_, F> {
    pub(super) fn handle(&mut self, finished: Finished) -> Result<(), JobError> {
        let Finished { task, number, result, cpu, bytes } = finished;
        let Some(live) = self.live.remove(&(task, number)) else {
            // a report that arrives twice: all was done about it the first time
            if self.reported.contains(&(task, number)) {
                return Ok(());
            }
            return Err(JobError::Internal("an attempt reports that was never started".into()));
        };
        self.reported.insert((task, number));
        self.free[live.node as usize] += 1;
        self.shared.nodes.busy(live.node, cpu);
        self.shared.nodes.count_all(live.node, &bytes);
        let made = match result {
            Ok(made) => made,
            Err(JobError::Stopped) => return self.lost(task, number),
            // what a task that does not run any more read may be gone by right
            Err(e @ JobError::Lost { .. }) if self.running.contains_key(&task) => return self.go_back(&e),
            Err(JobError::Lost { .. }) => return Ok(()),
            // another attempt has done the work
            Err(e) if !self.running.contains_key(&task) && !matches!(e, JobError::Internal(_)) => {
                tracing::warn!("a second attempt failed after the first was committed: {e}");
                return Ok(());
            }
            Err(e) => return Err(e),
        };
        self.commit(task, number, made, cpu)
    }

    /// An attempt that does not count. If it was the task's last one, its inputs wait again.
    fn lost(&mut self, task: TaskId, number: u32) -> Result<(), JobError> {
        if self.ledger.lost(task, number)
            && let Some(running) = self.running.remove(&task)
        {
            self.cameras.give_back(&running.spec.camera);
        }
        Ok(())
    }

    fn commit(&mut self, task: TaskId, number: u32, made: Made, cpu: f64) -> Result<(), JobError> {
        let settled = self.ledger.is_settled();
        let record = match self.ledger.record(task, made.outputs.clone()) {
            Ok(record) => record,
            // beaten by another attempt
            Err(Refused::NotRunning(_)) => return self.discard(&made.outputs),
            Err(e) => return Err(e.into()),
        };
        if settled && !record.made.groups.is_empty() {
            self.settled = self.ledger.snapshot(Vec::new());
            self.film.settle();
        }
        let name = self.write(&record)?;
        self.ledger.commit(task, &record, name)?;
        self.committed.insert((task, number));
        self.film.add(&made)?;
        let made_rays = record.made.rays;
        self.rate.add(cpu, made_rays.closest + made_rays.shadow, made_rays.camera);
        self.tasks += 1;
        let bytes = record.made.groups.iter().map(|g| g.bytes).sum::<u64>();
        self.traffic.add(made_rays.camera, made_rays.closest + made_rays.shadow, self.parts, made.hops, bytes);
        self.hops += made.hops;
        self.skipped += &made.skipped;
        if let (Some(all), Some(made)) = (&mut self.profile, &made.profile) {
            *all += made;
        }
        self.hop_bytes += bytes;
        let film = record.made.film.into_iter().map(|f| (f.key, f.holders));
        if self.is_durable() {
            self.superfluous[1].extend(film);
        } else {
            self.shared.nodes.delete(&film.collect::<Objects>())?;
        }
        if let Some(running) = self.running.remove(&task) {
            self.live.iter().filter(|(k, _)| k.0 == task).for_each(|(_, l)| l.stop.set());
            let consumed: Objects = running.spec.groups.into_iter().map(|g| (g.key, g.holders)).collect();
            self.shared.nodes.delete(&consumed)?;
        }
        if self.is_durable() && self.tasks.is_multiple_of(SNAPSHOT_EVERY) {
            self.write_snapshot()?;
        }
        if self.progress.wants_preview()
            && let Some(image) = self.film.preview(&self.ledger.taken().ends())
        {
            self.progress.preview(&image);
        }
        // for the display: about, since some pixels may wait for samples that others have. What decides is in `step_done`
        if self.progress.wants_error() && Instant::now() >= self.next_error {
            let begun = Instant::now();
            self.error = self.film.shown_error(&self.ledger.taken().ends()).or(self.error);
            self.next_error = Instant::now() + ERROR_EVERY.max(ERROR_SHARE * begun.elapsed());
        }
        Ok(())
    }

    /// After the last attempt has ended: deletes what those made that reported too late to count.
    ///
    /// # Errors
    /// When the store fails.
    pub fn discard_late(&self, late: impl Iterator<Item = Finished>) -> Result<(), JobError> {
        for finished in late {
            if let Ok(made) = finished.result
                && !self.committed.contains(&(finished.task, finished.number))
            {
                self.discard(&made.outputs)?;
            }
        }
        Ok(())
    }

    /// Makes a record durable, if the job keeps records; its name.
    pub(super) fn write(&mut self, record: &Record) -> Result<String, JobError> {
        let Some(pointer) = &self.pointer else { return Ok(record.sequence.to_string()) };
        pointer.check()?;
        let name = journal::write(&self.shared.nodes, record)?;
        pointer.move_to(record.sequence, &name)?;
        self.old_records[1].push(record_key(record.sequence, &name));
        Ok(name)
    }

    /// Writes the whole state, and deletes what the snapshot before this one made superfluous.
    pub(super) fn write_snapshot(&mut self) -> Result<(), JobError> {
        let key = self.film_name();
        let film = self.film.store(&key)?;
        let record = self.ledger.record_of(self.ledger.snapshot(film.clone()));
        let [old, mut new] = std::mem::take(&mut self.superfluous);
        let [old_records, new_records] = std::mem::take(&mut self.old_records);
        let name = self.write(&record)?;
        self.ledger.follow_snapshot(&record, name)?;
        // the snapshot before this one must stay readable: what it names may have been added up since
        let stays = |name: &String| self.film.needs(name) || self.named.contains(name);
        let (needed, old): (Objects, Objects) = old.into_iter().partition(|(name, _)| stays(name));
        new.extend(needed);
        let nodes = &self.shared.nodes;
        nodes.delete(&old)?;
        nodes.wait(nodes.store().delete(&old_records))?;
        self.named.clear();
        self.superfluous = [new, Vec::new()];
        self.note_stored(film);
        self.old_records[0] = new_records;
        Ok(())
    }

    /// A snapshot names these parts: they go when they are needed no more, but not before the next snapshot but one.
    pub(super) fn note_stored(&mut self, film: Vec<FilmRef>) {
        let known: BTreeSet<&String> = self.superfluous.iter().flatten().map(|(name, _)| name).collect();
        let (old, new): (Vec<FilmRef>, Vec<FilmRef>) = film.into_iter().partition(|f| known.contains(&f.key));
        self.named.extend(old.into_iter().chain(new.iter().cloned()).map(|f| f.key));
        self.superfluous[1].extend(new.into_iter().map(|f| (f.key, f.holders)));
    }

    /// A name that no film of this run has.
    pub(super) fn film_name(&mut self) -> String {
        self.stored += 1;
        format!("film/{}-s{:08}", self.session, self.stored)
    }
}
