//! What is told while the job runs and at its end.

use std::collections::BTreeMap;

use rayherd_render::film::Samples;
use rayherd_render::skip::Skip;

use super::{Driver, FilmSum};
use crate::allot;
use crate::job::{JobError, Status};
use crate::local::usage;
use crate::report::Report;

impl<F: FilmSum> Driver<'_, '_, F> {
    pub(super) fn tell(&self) {
        let [w, h] = self.shared.frame.size;
        let pixels = u64::from(w) * u64::from(h);
        let rays = self.ledger.rays();
        self.progress.status(&Status {
            elapsed: self.start.elapsed(),
            rays,
            taken_over: self.taken_over,
            samples: rays.camera,
            samples_total: pixels * u64::from(self.sampling.spp),
            waiting: self.ledger.waiting().map(|g| u64::from(g.rays)).sum(),
            rounds: if self.shared.settings.has_barrier() { self.rounds } else { self.ledger.commits() },
            error: self.error,
        });
    }

    /// What was made, after [`Driver::run`]: the film, its samples per pixel, the report.
    ///
    /// # Errors
    /// When the film's error cannot be had.
    pub fn finish(mut self) -> Result<(F, Samples, Report), JobError> {
        // the picture is whole, and all that it is made of is committed: a store that fails now may not cost it
        if self.is_durable()
            && let Err(e) = self.write_snapshot()
        {
            tracing::warn!("the store stays as the last commit left it: {e}");
        }
        let samples = self.ledger.done().begin();
        let pixels = self.cameras.pixels();
        let made = allot::total(&samples, pixels);
        self.skipped.add(Skip::Tiles, allot::total(&samples.most().into(), pixels) - made);
        let settings = self.shared.settings;
        let counts = &self.shared.scene.manifest.counts;
        let rel_mse = self.film.rel_mse(&samples)?;
        let (bytes, nodes_detail) = self.shared.nodes.report();
        let skipped = [
            ("degenerate", counts.degenerate),
            ("non_finite", counts.non_finite),
            ("out_of_range", counts.out_of_range),
        ];
        let mut report = Report {
            strategy: settings.strategy.name().to_owned(),
            nodes: settings.nodes.len() as u32,
            slots: settings.slots(),
            rounds: if settings.has_barrier() { self.rounds } else { self.tasks },
            tasks: self.tasks,
            tasks_redone: self.redone,
            tasks_reused: self.reused,
            attempts_lost: self.ledger.attempts_lost(),
            wall_s: self.start.elapsed().as_secs_f64(),
            cpu_s: usage::process_cpu(),
            spp: samples.least(),
            most_spp: samples.most(),
            samples: made,
            rays: self.ledger.rays(),
            scene_bytes: self.shared.scene.manifest.scene_bytes(),
            hops: self.hops,
            bytes_per_hop: (self.hops > 0).then(|| self.hop_bytes as f64 / self.hops as f64),
            peak_memory_bytes: usage::peak_memory(),
            non_finite: self.ledger.non_finite(),
            rel_mse,
            target_reached: self.sampling.target_error.map(|t| rel_mse.is_some_and(|e| e <= t)),
            nodes_detail,
            skipped: skipped.into_iter().map(|(k, v)| (k.to_owned(), v)).collect(),
            ..Report::default()
        };
        report.set_bytes(&bytes);
        report.skips = self.skips();
        report.profile = self.profile;
        Ok((self.film, samples, report))
    }

    /// What committed tasks of this run left out; what is not known here is missing.
    fn skips(&self) -> BTreeMap<String, u64> {
        let mut skips = BTreeMap::from(self.skipped);
        // known to whoever prepared the scene
        skips.retain(|name, _| ![Skip::Prepared, Skip::Volume].map(Skip::name).contains(&name.as_str()));
        for (skip, count) in [Skip::Splits, Skip::Textures].into_iter().zip(self.never_read()) {
            match count {
                Some(count) => skips.insert(skip.name().to_owned(), count),
                None => skips.remove(skip.name()),
            };
        }
        skips
    }

    fn never_read(&self) -> [Option<u64>; 2] {
        self.shared.nodes.never_read().map_or([None; 2], |counts| counts.map(Some))
    }
}
