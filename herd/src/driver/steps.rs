//! Which samples are queued when, and when the job is over.

use rayherd_render::film::{ErrorSum, Samples};
use rayherd_render::skip::Skip;

use super::{Driver, FilmSum};
use crate::allot::{self, Step, covers, total};
use crate::job::JobError;
use crate::wave;

/// Camera units that are queued at once, about; steps are added as they are used up.
const QUEUED_UNITS: usize = 100_000;

impl<F: FilmSum> Driver<'_, '_, F> {
    /// Queues camera units of the next steps, as far as they need not wait for what comes before.
    ///
    /// # Errors
    /// When what a step stands on cannot be kept.
    pub(super) fn queue_steps(&mut self) -> Result<(), JobError> {
        let limited = self.sampling.target_error.is_some() || self.sampling.time_limit.is_some();
        while !self.is_all_queued() {
            let wait = self.sampling.target_error.is_some() && !(self.ledger.is_quiet() && self.running.is_empty());
            // of a run that goes on: what an earlier one began of a step is to be queued, and all of it may be under way
            let first = !(self.begun || wait && self.is_under_way());
            let enough = limited && (!self.cameras.is_empty() || (!first && !self.is_all_taken()));
            if !first && (wait || self.is_late() || enough || self.cameras.units() > QUEUED_UNITS) {
                return Ok(());
            }
            let end = match self.sampling.target_error {
                Some(target) if self.is_allotted() => self.step_end(target)?,
                _ => Some(Samples::Even(self.even_end())),
            };
            let Some(end) = end else { return Ok(()) };
            self.cameras.add(&self.queued, &end, self.ledger.taken());
            self.queued = end;
            self.begun = true;
            if limited {
                return Ok(());
            }
        }
        Ok(())
    }

    fn tiles(&self) -> usize {
        self.cameras.pixels().len()
    }

    fn is_late(&self) -> bool {
        self.sampling.time_limit.is_some_and(|limit| self.start.elapsed().as_secs_f64() >= limit)
    }

    /// Whether there are as many samples as may be: on average, where they are shared out by what tiles need.
    fn is_all_queued(&self) -> bool {
        match &self.queued {
            Samples::Even(n) => *n >= self.sampling.spp,
            each if self.sampling.target_error.is_none() => each.least() >= self.sampling.spp,
            each => total(each, self.cameras.pixels()) >= self.most_samples(),
        }
    }

    fn most_samples(&self) -> u64 {
        total(&self.sampling.spp.into(), self.cameras.pixels())
    }

    fn is_all_taken(&self) -> bool {
        covers(&self.ledger.taken().begin(), &self.queued, self.tiles())
    }

    /// Whether there are samples, and all that is queued was taken, and nothing else.
    fn is_under_way(&self) -> bool {
        self.queued.most() > 0 && self.is_all_taken() && covers(&self.queued, &self.ledger.taken().ends(), self.tiles())
    }

    /// Whether what comes next is shared out by what tiles need.
    fn is_allotted(&self) -> bool {
        match &self.queued {
            Samples::Even(n) => *n >= allot::EVEN && wave::is_step_end(*n) || self.planned().is_some(),
            Samples::Each(_) => true,
        }
    }

    /// The step that was planned last, if what is queued lies in it, and how many of its parts are queued.
    fn planned(&self) -> Option<(&Step, u32)> {
        let step = self.ledger.step().filter(|step| step.to != self.queued)?;
        Some((step, step.parts(&self.queued, self.tiles())?))
    }

    /// Where the next even step ends: where the schedule says, or before, if time would run out.
    fn even_end(&self) -> u32 {
        // what an earlier run began of a step is finished first
        let (first, reach) = (self.queued.least(), self.ledger.taken().reach());
        let end = wave::step_end(first).min(self.sampling.spp).max(reach);
        if self.sampling.time_limit.is_none() {
            return end;
        }
        let Some(samples) = self.samples_left() else {
            // one sample, to learn how long it takes
            return end.min(first.saturating_add(1)).max(reach);
        };
        let [w, h] = self.shared.frame.size;
        let left = samples / (f64::from(w) * f64::from(h));
        end.min(first.saturating_add((left as u32).max(1))).max(reach)
    }

    /// Camera samples that can be made in the time that is left; none when it is not known how long they take.
    fn samples_left(&self) -> Option<f64> {
        let limit = self.sampling.time_limit?;
        let elapsed = self.start.elapsed().as_secs_f64();
        if !self.begun || elapsed <= 0.0 {
            return None;
        }
        let made = self.ledger.rays().camera.saturating_sub(self.taken_over.camera);
        Some(made as f64 / elapsed * (limit - elapsed).max(0.0))
    }

    /// What tiles have where the error is looked at next; none when what comes before it must end first. All but the end of the job
    /// follows from what complete steps have found, so that with a lower target, or more samples, the same is gone on with.
    fn step_end(&mut self, target: f64) -> Result<Option<Samples>, JobError> {
        let begun = self.ledger.taken().ends();
        if self.planned().is_none() {
            if !self.is_step_over() {
                // a run without a target has begun more: that is finished as it was begun
                let more = !covers(&self.queued, &begun, self.tiles());
                return Ok(more.then(|| Samples::Even(self.even_end())));
            }
            self.plan_step()?;
        }
        let (step, parts) = self.planned().ok_or_else(|| JobError::Internal("a step has no samples".into()))?;
        let expected = step.first(target, self.shared.frame.size);
        // what an earlier run began is finished first
        let end = step.after(expected.max(parts + 1).max(step.holding(&begun, self.tiles())));
        let pixels = self.cameras.pixels();
        let (before, after, queued) = (total(&step.from, pixels), total(&step.to, pixels), total(&self.queued, pixels));
        let in_time = self.samples_left().map_or(u64::MAX, |samples| queued.saturating_add(samples as u64));
        // cutting rounds up, so that this adds to some tile
        let most = self.most_samples().min(in_time).max(queued + 1);
        if total(&end, pixels) <= most {
            return Ok(Some(end));
        }
        Ok(Some(step.cut(most.saturating_sub(before) as f64 / (after - before) as f64)))
    }

    /// Shares the samples of the next step out, and keeps that.
    fn plan_step(&mut self) -> Result<(), JobError> {
        let (from, pixels) = (self.queued.clone(), self.cameras.pixels());
        let mean = match self.ledger.step() {
            Some(step) if step.to == from => step.mean,
            _ => (total(&from, pixels) / total(&1.into(), pixels)) as u32,
        };
        let errors = match self.learned.take() {
            Some(errors) => errors,
            None => self.film.tile_errors(&from)?.unwrap_or_else(|| vec![ErrorSum::default(); self.tiles()]),
        };
        let shared = self.shared.scene.skips().makes(Skip::Tiles);
        let step = Step::plan(&errors, from, self.cameras.pixels(), wave::step_end(mean), shared);
        self.ledger.plan_step(step);
        if self.is_durable() {
            // another run could not find it any more once some of its samples are made
            self.write_snapshot()?;
        }
        Ok(())
    }

    /// Whether everything queued came to its end.
    pub(super) fn is_step_over(&self) -> bool {
        self.ledger.is_quiet() && self.cameras.is_empty() && self.ledger.done().ends() == self.queued
    }

    /// After everything queued came to its end: whether the job is over.
    pub(super) fn step_done(&mut self) -> Result<bool, JobError> {
        self.learned = None;
        self.error = if self.sampling.target_error.is_some() && self.queued.least() >= allot::EVEN {
            // what the next step stands on tells the error as well
            self.learned = self.film.tile_errors(&self.queued)?;
            self.learned.as_ref().map(|errors| ErrorSum::total(errors).mean(self.shared.frame.size))
        } else {
            self.film.rel_mse(&self.queued)?
        };
        let reached = match (self.sampling.target_error, self.error) {
            (Some(target), Some(error)) => error <= target,
            _ => false,
        };
        Ok(self.is_all_queued() || reached || self.is_late())
    }
}
