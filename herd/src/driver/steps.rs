//! Which samples are queued when, and when the job is over.

use super::{Driver, FilmSum};
use crate::job::JobError;
use crate::wave;

/// Camera units that are queued at once, about; steps are added as they are used up.
const QUEUED_UNITS: usize = 100_000;

impl<F: FilmSum> Driver<'_, '_, F> {
    /// Queues camera units of the next steps, as far as they need not wait for what comes before.
    pub(super) fn queue_steps(&mut self) {
        let spp = self.sampling.spp;
        while self.queued < spp {
            let first = !self.begun;
            let wait = self.sampling.target_error.is_some() && !(self.ledger.is_quiet() && self.running.is_empty());
            let late =
                self.sampling.time_limit.is_some_and(|limit| !first && self.start.elapsed().as_secs_f64() >= limit);
            let enough = (self.sampling.target_error.is_some() || self.sampling.time_limit.is_some())
                && (!self.cameras.is_empty() || (!first && self.queued > self.ledger.taken().complete()));
            if !first && (wait || late || enough || self.cameras.units() > QUEUED_UNITS) {
                return;
            }
            let end = self.step_end();
            self.cameras.add(self.queued..end, self.ledger.taken());
            self.queued = end;
            self.begun = true;
            if self.sampling.target_error.is_some() || self.sampling.time_limit.is_some() {
                return;
            }
        }
    }

    /// Where the step that begins at `self.queued` ends: where the schedule says, or before, if time would run out.
    fn step_end(&self) -> u32 {
        // what an earlier run began of a step is finished first
        let reach = self.ledger.taken().reach();
        let end = wave::step_end(self.queued).min(self.sampling.spp).max(reach);
        let Some(limit) = self.sampling.time_limit else { return end };
        let elapsed = self.start.elapsed().as_secs_f64();
        if !self.begun || elapsed <= 0.0 {
            // one sample, to learn how long it takes
            return end.min(self.queued.saturating_add(1)).max(reach);
        }
        let [w, h] = self.shared.frame.size;
        let camera = self.ledger.rays().camera.saturating_sub(self.taken_over.camera);
        let made = camera as f64 / (f64::from(w) * f64::from(h));
        let samples_left = made / elapsed * (limit - elapsed).max(0.0);
        end.min(self.queued.saturating_add((samples_left as u32).max(1))).max(reach)
    }

    /// Whether everything queued came to its end.
    pub(super) fn is_step_over(&self) -> bool {
        self.ledger.is_quiet() && self.cameras.is_empty() && self.ledger.done().reach() == self.queued
    }

    /// After everything queued came to its end: whether the job is over.
    pub(super) fn step_done(&mut self) -> Result<bool, JobError> {
        self.error = self.film.rel_mse(self.queued)?;
        let reached = match (self.sampling.target_error, self.error) {
            (Some(target), Some(error)) => error <= target,
            _ => false,
        };
        let late = self.sampling.time_limit.is_some_and(|limit| self.start.elapsed().as_secs_f64() >= limit);
        Ok(self.queued >= self.sampling.spp || reached || late)
    }
}
