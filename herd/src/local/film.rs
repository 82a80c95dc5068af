//! A film summed in memory.

use rayherd_render::film::{ErrorSum, FilmPart, Samples};

use super::attempt::Made;
use super::journal;
use super::nodes::Nodes;
use crate::driver::FilmSum;
use crate::job::{Image, JobError};
use crate::ledger::FilmRef;

/// The sum of all committed parts, and the one to go back to.
pub struct MemoryFilm<'n, 'a> {
    nodes: &'n Nodes<'a>,
    now: FilmPart,
    settled: FilmPart,
}

impl<'n, 'a> MemoryFilm<'n, 'a> {
    /// Begins with a sum; `settled` is what to go back to.
    pub fn new(nodes: &'n Nodes<'a>, now: FilmPart, settled: FilmPart) -> Self {
        MemoryFilm { nodes, now, settled }
    }
    /// The sum.
    pub fn into_sum(self) -> FilmPart {
        self.now
    }
}

impl FilmSum for MemoryFilm<'_, '_> {
    fn add(&mut self, made: &Made) -> Result<(), JobError> {
        let part = made.film.as_ref().ok_or_else(|| JobError::Internal("a task hands no film over".into()))?;
        Ok(self.now.merge(part)?)
    }
    fn settle(&mut self) {
        self.settled.clone_from(&self.now);
    }
    fn go_back(&mut self) {
        self.now.clone_from(&self.settled);
    }
    fn store(&mut self, name: &str) -> Result<Vec<FilmRef>, JobError> {
        journal::store_film(self.nodes, &self.now, name)
    }
    fn rel_mse(&mut self, samples: &Samples) -> Result<Option<f64>, JobError> {
        Ok(self.now.rel_mse(samples))
    }
    fn tile_errors(&mut self, samples: &Samples) -> Result<Option<Vec<ErrorSum>>, JobError> {
        Ok(self.now.tile_errors(samples))
    }
    fn needs(&self, _: &str) -> bool {
        // all of it is here
        false
    }
    fn shown_error(&self, samples: &Samples) -> Option<f64> {
        self.now.rel_mse(samples)
    }
    fn preview(&self, samples: &Samples) -> Option<Image> {
        Some(image(&self.now, samples))
    }
}

/// The picture of a film.
pub fn image(film: &FilmPart, samples: &Samples) -> Image {
    let [width, height] = film.size();
    Image { width, height, pixels: film.resolve(samples) }
}
