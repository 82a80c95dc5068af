//! Whether a record can be: what is asked of each before it is believed, by whoever resumes a job, collects its garbage or goes on
//! with it on a cluster. A checksum says that a record is what was written; this says that what was written makes sense.

use std::collections::BTreeSet;

use super::{Destination, FilmRef, GroupRef, Ledger, Record, Refused, Snapshot, bad};
use crate::report::RayCounts;
use crate::wave::{CameraUnit, Done, MAX_SPP};

/// What the records of a job may name.
#[derive(Clone, Debug, Default)]
pub struct Scope {
    /// Tiles of the film.
    pub tiles: u32,
    /// Pixels of each tile, where the frame is known.
    pub pixels: Option<Vec<u64>>,
    /// Name of the scene's cut and how many splits it has, where the scene is known. Rays that wait for splits of another cut are
    /// not asked which.
    pub splits: Option<(String, u32)>,
}

impl Scope {
    /// Checks a record against the state before it, then replays it.
    ///
    /// # Errors
    /// [`Refused::BadRecord`], which names it.
    pub fn replay(&self, ledger: &mut Ledger, record: &Record, name: String) -> Result<(), Refused> {
        self.check(ledger, record).map_err(|message| bad(record, &name, &message))?;
        ledger.replay(record, name)
    }

    /// What is wrong with a record that follows a state (that of a new ledger, if it is the first that is replayed).
    fn check(&self, ledger: &Ledger, record: &Record) -> Result<(), String> {
        let taken: BTreeSet<&String> = record.took.groups.iter().collect();
        if taken.len() < record.took.groups.len() {
            return Err("it consumes a ray group twice".into());
        }
        let takes = !taken.is_empty() || !record.took.camera.is_empty();
        let makes = !record.made.groups.is_empty() || !record.made.film.is_empty();
        match &record.snapshot {
            Some(_) if takes || makes => return Err("it is a snapshot, and consumes or makes something as well".into()),
            Some(snapshot) => return self.check_snapshot(record, snapshot),
            None if !takes => return Err("it consumes nothing".into()),
            None => {}
        }
        let mut rays = 0u64;
        for unit in &record.took.camera {
            if unit.tile >= self.tiles || unit.first >= unit.end || unit.end > MAX_SPP {
                let CameraUnit { tile, first, end } = unit;
                return Err(format!("it makes samples {first}..{end} of tile {tile}, which there are not"));
            }
            let samples = u64::from(unit.end - unit.first);
            rays = rays.saturating_add(samples * self.pixels.as_ref().map_or(0, |p| p[unit.tile as usize]));
        }
        self.check_counts(&record.made.rays, rays)?;
        // the sums that follow from it must be numbers
        let sum = |a: u64, b: u64| a.checked_add(b).ok_or("it counts more rays than there can be");
        let (before, made) = (ledger.rays(), record.made.rays);
        sum(before.closest, made.closest)?;
        sum(before.shadow, made.shadow)?;
        sum(before.camera, made.camera)?;
        sum(before.merged, made.merged)?;
        sum(ledger.non_finite(), record.made.non_finite)?;
        self.check_groups(&record.made.groups)?;
        let known = |g: &&GroupRef| ledger.waiting.contains_key(&g.key) || taken.contains(&g.key);
        if let Some(group) = record.made.groups.iter().find(known) {
            return Err(format!("it makes {}, which is there already", group.key));
        }
        record.made.film.iter().try_for_each(check_film)
    }

    fn check_snapshot(&self, record: &Record, snapshot: &Snapshot) -> Result<(), String> {
        if snapshot.done.tiles() != self.tiles {
            return Err(format!("it is of {} film tiles and not of {}", snapshot.done.tiles(), self.tiles));
        }
        if !snapshot.done.is_sound(MAX_SPP) {
            return Err("its samples are out of order or out of range".into());
        }
        if snapshot.step.as_ref().is_some_and(|step| !step.is_sound(self.tiles as usize)) {
            return Err("its step is not one of its film tiles, or out of range".into());
        }
        if snapshot.commits > record.sequence {
            return Err(format!("it counts {} commits at place {}", snapshot.commits, record.sequence));
        }
        let camera = self.pixels.as_ref().map_or(0, |p| camera_rays(&snapshot.done, p));
        self.check_counts(&snapshot.rays, camera)?;
        self.check_groups(&snapshot.waiting)?;
        if snapshot.done.reach() == 0 && (!snapshot.film.is_empty() || !snapshot.waiting.is_empty()) {
            return Err("it has rays or film, and no sample was made".into());
        }
        snapshot.film.iter().try_for_each(check_film)
    }

    /// Rays traced in all, of which so many camera rays.
    fn check_counts(&self, rays: &RayCounts, camera: u64) -> Result<(), String> {
        if self.pixels.is_some() && rays.camera != camera {
            return Err(format!("it counts {} camera rays where {camera} were made", rays.camera));
        }
        if rays.closest < rays.camera {
            return Err(format!("it counts {} rays, {} of them camera rays", rays.closest, rays.camera));
        }
        Ok(())
    }

    fn check_groups(&self, groups: &[GroupRef]) -> Result<(), String> {
        let mut keys = BTreeSet::new();
        for group in groups {
            let key = &group.key;
            if !keys.insert(key) {
                return Err(format!("it names {key} twice"));
            }
            if group.rays == 0 || group.bytes == 0 {
                return Err(format!("{key} has {} rays and {} bytes", group.rays, group.bytes));
            }
            check_holders(key, &group.holders)?;
            if let (Destination::Split(to), Some((cut, splits))) = (group.to, &self.splits)
                && is_of_cut(group, cut)
                && to >= *splits
            {
                return Err(format!("{key} waits for split {to} of {splits}"));
            }
        }
        Ok(())
    }
}

/// Whether a group's rays wait for splits of this cut of the scene: their numbers mean something else in any other.
pub fn is_of_cut(group: &GroupRef, cut: &str) -> bool {
    group.key.strip_prefix("rays/").and_then(|k| k.split_once('-')).is_some_and(|(of, _)| of == cut)
}

fn check_film(film: &FilmRef) -> Result<(), String> {
    if film.bytes == 0 {
        return Err(format!("{} has no bytes", film.key));
    }
    check_holders(&film.key, &film.holders)
}

fn check_holders(key: &str, holders: &[u32]) -> Result<(), String> {
    let distinct: BTreeSet<&u32> = holders.iter().collect();
    if key.is_empty() || distinct.len() < holders.len() {
        return Err(format!("{key:?} lies on nodes {holders:?}"));
    }
    Ok(())
}

/// Camera rays of all samples that are done.
fn camera_rays(done: &Done, pixels: &[u64]) -> u64 {
    let of_tile = |tile: u32| u64::from(done.samples(tile)).saturating_mul(pixels[tile as usize]);
    (0..done.tiles()).map(of_tile).fold(0, u64::saturating_add)
}
