//! A film that lies in parts on the workers' stores, and is added up by them.

use super::fleet::Fleet;
use super::message::{Done, Work};
use crate::driver::{FilmSum, Objects};
use crate::job::JobError;
use crate::ledger::FilmRef;
use crate::local::attempt::Made;

/// References to the parts whose sum the film is.
pub struct Parts<'f> {
    fleet: &'f Fleet,
    now: Vec<FilmRef>,
    settled: Vec<FilmRef>,
}

/// What adding up has found.
pub struct Merged {
    /// The film, if it was to be stored.
    pub film: Option<FilmRef>,
    /// Its estimated relMSE.
    pub rel_mse: Option<f64>,
    /// Pixel and sample of the first contributions that were not finite.
    pub non_finite: Vec<(u32, u32)>,
    /// Where the picture lies, if it was asked for.
    pub picture: Vec<String>,
}

impl<'f> Parts<'f> {
    /// A film whose parts are these; `settled` is what to go back to.
    pub fn new(fleet: &'f Fleet, now: Vec<FilmRef>, settled: Vec<FilmRef>) -> Self {
        Parts { fleet, now, settled }
    }

    /// Has the parts added up.
    pub fn merge(&self, name: Option<&str>, spp: u32, picture: Option<String>) -> Result<Merged, JobError> {
        let work = Work::Merge { name: name.map(str::to_owned), parts: self.now.clone(), spp, picture };
        match self.fleet.call(work)? {
            Done::Merged { film, rel_mse, non_finite, picture } => Ok(Merged { film, rel_mse, non_finite, picture }),
            _ => Err(JobError::Internal("a worker reports something else than it was to do".into())),
        }
    }
}

impl FilmSum for Parts<'_> {
    fn add(&mut self, made: &Made) -> Result<(), JobError> {
        self.now.extend(made.outputs.film.clone());
        Ok(())
    }
    fn settle(&mut self) {
        self.settled.clone_from(&self.now);
    }
    fn go_back(&mut self) {
        self.now.clone_from(&self.settled);
    }
    fn store(&mut self, name: &str) -> Result<Option<FilmRef>, JobError> {
        if self.now.is_empty() {
            return Ok(None);
        }
        let film = self.merge(Some(name), 1, None)?.film;
        self.now = film.iter().cloned().collect();
        Ok(film)
    }
    fn rel_mse(&mut self, spp: u32) -> Result<Option<f64>, JobError> {
        if self.now.is_empty() {
            return Ok(None);
        }
        Ok(self.merge(None, spp, None)?.rel_mse)
    }
    fn on_store(&self, store: u32) -> Objects {
        let mut all: Objects = Vec::new();
        for part in self.now.iter().chain(&self.settled).filter(|p| p.holders.contains(&store)) {
            if !all.iter().any(|(key, _)| *key == part.key) {
                all.push((part.key.clone(), part.holders.clone()));
            }
        }
        all
    }
    fn relocate(&mut self, name: &str, holders: &[u32]) {
        let parts = self.now.iter_mut().chain(&mut self.settled).filter(|p| p.key == name);
        parts.for_each(|p| p.holders = holders.to_vec());
    }
    fn needs(&self, name: &str) -> bool {
        self.now.iter().chain(&self.settled).any(|p| p.key == name)
    }
}
