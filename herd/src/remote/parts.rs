//! A film that lies in parts on the workers' stores, and is added up by them, band by band.

use rayherd_render::film::{ErrorSum, Samples};

use super::bands::{self, Totals};
use super::fleet::Fleet;
use super::message::{Done, Work};
use crate::driver::{FilmSum, Objects};
use crate::job::{Image, JobError};
use crate::ledger::FilmRef;
use crate::local::attempt::Made;

/// A band of a film with several is added up when it has so many parts: each time all that it holds is read and written, and where tasks
/// touch all bands that would be most of their time.
const MANY: usize = 8;

/// References to the parts whose sum the film is.
pub struct Parts<'f> {
    fleet: &'f Fleet,
    size: [u32; 2],
    /// Tiles of a band, and how many bands there are.
    band: u32,
    bands: u32,
    now: Vec<FilmRef>,
    settled: Vec<FilmRef>,
    /// The last error that was found, and of how many samples; none when the film has changed since.
    error: Option<(Samples, Option<f64>)>,
    /// Where previews are written, and their exposure in stops.
    shown: Option<(String, f64)>,
}

/// A picture that was made.
pub struct Pictured {
    /// Pixel and sample of the first contributions that were not finite.
    pub non_finite: Vec<(u32, u32)>,
    /// Where it lies.
    pub at: Vec<String>,
}

impl<'f> Parts<'f> {
    /// A film of `size` pixels in bands of so many tiles whose parts are these; `settled` is what to go back to.
    pub fn new(fleet: &'f Fleet, (size, band): ([u32; 2], u32), now: Vec<FilmRef>, settled: Vec<FilmRef>) -> Self {
        Parts { fleet, size, band, bands: bands::count(size, band), now, settled, error: None, shown: None }
    }

    /// The same, of which previews are made for whoever asks the fleet for them.
    pub fn shown(self, key: String, exposure: f64) -> Self {
        Parts { shown: Some((key, exposure)), ..self }
    }

    /// In how many bands it is added up now: as a whole while a worker of a version without them is there.
    fn bands(&self) -> u32 {
        if self.fleet.knows_bands() { self.bands } else { 1 }
    }

    /// Each band that has something, with its parts.
    fn by_band(&self) -> impl Iterator<Item = (Option<u32>, Vec<FilmRef>)> {
        let bands = self.bands();
        let of_band = move |band: u32| {
            let several = (bands > 1).then_some(band);
            let parts = self.now.iter().filter(|p| several.is_none() || p.band.is_none() || p.band == several);
            (several, parts.cloned().collect::<Vec<_>>())
        };
        (0..bands).map(of_band).filter(|(_, parts)| !parts.is_empty())
    }

    /// Has all parts read and added up, and nothing stored.
    ///
    /// # Errors
    /// When one of them is lost.
    pub fn look(&self, samples: &Samples) -> Result<Option<f64>, JobError> {
        let work = |(band, parts)| looking(band, parts, samples, false);
        let (mut totals, mut plain) = (Totals::default(), None);
        for done in self.fleet.call_all(self.by_band().map(work).collect())? {
            let Done::Merged { rel_mse, error, .. } = done else { return Err(other()) };
            // a worker of a version without bands has divided by all pixels: its share of the mean, rounded otherwise
            match (error, rel_mse) {
                (None, Some(share)) => *plain.get_or_insert(0.0) += share,
                (error, _) => totals.add(error, []),
            }
        }
        let exact = totals.error.map(|e| e.mean(self.size));
        Ok(if plain.is_some() || exact.is_some() { Some(plain.unwrap_or(0.0) + exact.unwrap_or(0.0)) } else { None })
    }

    /// Has a picture made of the sum.
    ///
    /// # Errors
    /// When a part is lost, or no store takes the picture.
    pub fn picture(&self, samples: &Samples, key: &str) -> Result<Pictured, JobError> {
        let (parts, picture, spp) = (self.now.clone(), Some(key.to_owned()), samples.clone());
        match self.fleet.call(Work::Merge { name: None, parts, spp, picture, band: None, tiles: false })? {
            Done::Merged { non_finite, picture, .. } => Ok(Pictured { non_finite, at: picture }),
            _ => Err(other()),
        }
    }
}

/// Work that adds up and stores nothing.
fn looking(band: Option<u32>, parts: Vec<FilmRef>, samples: &Samples, tiles: bool) -> Work {
    Work::Merge { name: None, parts, spp: samples.clone(), picture: None, band, tiles }
}

fn other() -> JobError {
    JobError::Internal("a worker reports something else than it was to do".into())
}

impl FilmSum for Parts<'_> {
    fn add(&mut self, made: &Made) -> Result<(), JobError> {
        self.now.extend(made.outputs.film.clone());
        self.error = None;
        Ok(())
    }
    fn settle(&mut self) {
        self.settled.clone_from(&self.now);
    }
    fn go_back(&mut self) {
        self.now.clone_from(&self.settled);
        self.error = None;
    }
    fn store(&mut self, name: &str) -> Result<Vec<FilmRef>, JobError> {
        // what is of no band can only go when all bands have taken from it
        let by_band: Vec<_> = self.by_band().collect();
        let several = by_band.iter().any(|(band, _)| band.is_some());
        let of_all = several && self.now.iter().any(|p| p.band.is_none());
        let most = if several { MANY - 1 } else { 1 };
        let (many, few): (Vec<_>, Vec<_>) = by_band.into_iter().partition(|(_, p)| of_all || p.len() > most);
        let work = |(band, parts): (Option<u32>, Vec<FilmRef>)| {
            let name = Some(band.map_or_else(|| name.to_owned(), |b| format!("{name}-b{b:05}")));
            Work::Merge { name, parts, spp: 1.into(), picture: None, band, tiles: false }
        };
        let mut now: Vec<FilmRef> = few.into_iter().flat_map(|(_, parts)| parts).collect();
        for done in self.fleet.call_all(many.into_iter().map(work).collect())? {
            let Done::Merged { film, .. } = done else { return Err(other()) };
            now.extend(film);
        }
        self.now = now;
        Ok(self.now.clone())
    }
    fn rel_mse(&mut self, samples: &Samples) -> Result<Option<f64>, JobError> {
        // nothing to read for an error that there is not
        if self.now.is_empty() || samples.least() < 2 {
            return Ok(None);
        }
        if let Some((of, error)) = &self.error
            && of == samples
        {
            return Ok(*error);
        }
        let error = self.look(samples)?;
        self.error = Some((samples.clone(), error));
        Ok(error)
    }
    fn tile_errors(&mut self, samples: &Samples) -> Result<Option<Vec<ErrorSum>>, JobError> {
        if samples.least() < 2 {
            return Ok(None);
        }
        let mut all = vec![ErrorSum::default(); bands::count(self.size, 1) as usize];
        let by_band: Vec<_> = self.by_band().collect();
        let first = |band: &Option<u32>| band.map_or(0, |b| b as usize * self.band as usize);
        let firsts: Vec<usize> = by_band.iter().map(|(band, _)| first(band)).collect();
        let work = |(band, parts)| looking(band, parts, samples, true);
        for (first, done) in firsts.into_iter().zip(self.fleet.call_all(by_band.into_iter().map(work).collect())?) {
            let Done::Merged { tiles, .. } = done else { return Err(other()) };
            all.get_mut(first..first + tiles.len()).ok_or_else(other)?.copy_from_slice(&tiles);
        }
        self.error = Some((samples.clone(), Some(ErrorSum::total(&all).mean(self.size))));
        Ok(Some(all))
    }
    /// A worker makes it, when it has nothing else to do: there is no picture here.
    fn preview(&self, samples: &Samples) -> Option<Image> {
        if let Some((key, exposure)) = self.shown.clone().filter(|_| !self.now.is_empty()) {
            let (parts, spp) = (self.now.clone(), samples.clone());
            self.fleet.preview(Work::Preview { parts, spp, key, exposure });
        }
        None
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
