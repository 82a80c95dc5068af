//! A film that lies in parts on the workers' stores, and is added up by them.

use super::fleet::Fleet;
use super::message::{Done, Work};
use crate::driver::FilmSum;
use crate::job::JobError;
use crate::ledger::FilmRef;
use crate::local::attempt::Made;

/// References to the parts whose sum the film is.
pub struct Parts<'f> {
    fleet: &'f Fleet,
    now: Vec<FilmRef>,
    settled: Vec<FilmRef>,
}

/// The film, its estimated relMSE, and the keys of the picture's files.
type Merged = (Option<FilmRef>, Option<f64>, Vec<String>);

impl<'f> Parts<'f> {
    /// A film whose parts are these; `settled` is what to go back to.
    pub fn new(fleet: &'f Fleet, now: Vec<FilmRef>, settled: Vec<FilmRef>) -> Self {
        Parts { fleet, now, settled }
    }

    /// Has the parts added up.
    pub fn merge(&self, name: Option<&str>, spp: u32, picture: Option<String>) -> Result<Merged, JobError> {
        let work = Work::Merge { name: name.map(str::to_owned), parts: self.now.clone(), spp, picture };
        match self.fleet.call(work)? {
            Done::Merged { film, rel_mse, picture } => Ok((film, rel_mse, picture)),
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
        let (film, ..) = self.merge(Some(name), 1, None)?;
        self.now = film.iter().cloned().collect();
        Ok(film)
    }
    fn rel_mse(&mut self, spp: u32) -> Result<Option<f64>, JobError> {
        if self.now.is_empty() {
            return Ok(None);
        }
        Ok(self.merge(None, spp, None)?.1)
    }
    fn needs(&self, name: &str) -> bool {
        self.now.iter().chain(&self.settled).any(|p| p.key == name)
    }
}
