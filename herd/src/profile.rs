//! What a path costs by stage: CPU-seconds and items of each. Clocks are read only when that was asked for, a few times a batch.

use std::collections::BTreeMap;
use std::ops::AddAssign;

use serde::{Deserialize, Serialize};

use crate::local::usage::thread_cpu;

/// A stage of the work of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Part {
    /// Making camera rays. Items: rays.
    Camera,
    /// Finding nearest hits. Items: rays, once for each time that one was tested against a task's splits.
    Closest,
    /// Shading: what was hit, its light, the rays that go on. Items: rays, each once.
    Shading,
    /// Asking whether anything is in a shadow ray's way. Items: rays, once for each time that one was tested.
    Shadow,
    /// Adding light to the film. Items: contributions.
    Film,
    /// Asking the grid where rays go next, sending them there, adding the light of shadow rays that go nowhere. Items: rays.
    Walk,
    /// Loading geometry and attributes, or finding them in memory. Items: splits, once for each time that a task took one.
    Load,
    /// Rays from the store and into it: decoded, encoded. Items: rays.
    Rays,
    /// The film into the store. Items: its parts.
    Store,
}

impl Part {
    /// All of them.
    pub const ALL: [Part; 9] = [
        Part::Camera,
        Part::Closest,
        Part::Shading,
        Part::Shadow,
        Part::Film,
        Part::Walk,
        Part::Load,
        Part::Rays,
        Part::Store,
    ];

    /// Its name in the report.
    pub const fn name(self) -> &'static str {
        match self {
            Part::Camera => "camera",
            Part::Closest => "closest",
            Part::Shading => "shading",
            Part::Shadow => "shadow",
            Part::Film => "film",
            Part::Walk => "walk",
            Part::Load => "load",
            Part::Rays => "rays",
            Part::Store => "store",
        }
    }
}

/// What a part took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// CPU-seconds of the tasks' threads.
    pub cpu_s: f64,
    /// How many things they were spent on.
    pub items: u64,
}

/// What each part took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "BTreeMap<String, Cost>", into = "BTreeMap<String, Cost>")]
pub struct Profile([Cost; Part::ALL.len()]);

impl Profile {
    /// Of one part.
    pub fn of(&self, part: Part) -> Cost {
        self.0[part as usize]
    }
    /// CPU-seconds of all.
    pub fn cpu_s(&self) -> f64 {
        self.0.iter().map(|c| c.cpu_s).sum()
    }
    /// Takes seconds away from a part that another one has counted too.
    pub fn less(&mut self, part: Part, cpu_s: f64) {
        let cost = &mut self.0[part as usize];
        // both were read from one clock, at other places: a rounding may be left
        cost.cpu_s = (cost.cpu_s - cpu_s).max(0.0);
    }
}

impl AddAssign<&Profile> for Profile {
    fn add_assign(&mut self, other: &Profile) {
        for (a, b) in self.0.iter_mut().zip(other.0) {
            a.cpu_s += b.cpu_s;
            a.items += b.items;
        }
    }
}

impl From<Profile> for BTreeMap<String, Cost> {
    fn from(profile: Profile) -> Self {
        Part::ALL.into_iter().map(|p| (p.name().to_owned(), profile.of(p))).collect()
    }
}

impl From<BTreeMap<String, Cost>> for Profile {
    /// Names that this version does not know are left out.
    fn from(map: BTreeMap<String, Cost>) -> Self {
        Profile(Part::ALL.map(|p| map.get(p.name()).copied().unwrap_or_default()))
    }
}

/// Laps of one thread: each books the time since the last one.
#[derive(Debug, Default)]
pub struct Clock {
    profile: Option<Profile>,
    last: f64,
}

impl Clock {
    /// One that runs, or one that is never read.
    pub fn new(runs: bool) -> Self {
        Clock { profile: runs.then(Profile::default), last: 0.0 }
    }
    /// From here on; what was before belongs to no part.
    pub fn start(&mut self) {
        if self.profile.is_some() {
            self.last = thread_cpu();
        }
    }
    /// Books the time since the last lap, and what it was spent on.
    pub fn lap(&mut self, part: Part, items: usize) {
        if let Some(profile) = &mut self.profile {
            let now = thread_cpu();
            profile.0[part as usize].cpu_s += now - self.last;
            profile.0[part as usize].items += items as u64;
            self.last = now;
        }
    }
    /// Counts items whose time is booked elsewhere.
    pub fn count(&mut self, part: Part, items: usize) {
        if let Some(profile) = &mut self.profile {
            profile.0[part as usize].items += items as u64;
        }
    }
    /// What was booked; none of a clock that does not run.
    pub fn profile(&self) -> Option<Profile> {
        self.profile
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_add_up_and_come_back_from_the_wire() {
        let begun = thread_cpu();
        let mut clock = Clock::new(true);
        clock.start();
        for (i, part) in Part::ALL.into_iter().enumerate() {
            assert_eq!(part as usize, i);
            clock.lap(part, i);
        }
        clock.count(Part::Film, 100);
        let profile = clock.profile().unwrap();
        assert_eq!(Part::ALL.map(|p| profile.of(p).items), [0, 1, 2, 3, 104, 5, 6, 7, 8]);
        assert!(profile.cpu_s() >= 0.0 && profile.cpu_s() <= thread_cpu() - begun);
        let mut sum = profile;
        sum += &profile;
        assert!(Part::ALL.iter().all(|&p| sum.of(p).items == 2 * profile.of(p).items));
        let text = serde_json::to_string(&sum).unwrap();
        assert_eq!(serde_json::from_str::<Profile>(&text).unwrap(), sum);
        let later = r#"{"of a later version": {"cpu_s": 3, "items": 2}}"#;
        assert_eq!(serde_json::from_str::<Profile>(later).unwrap(), Profile::default());
        sum.less(Part::Walk, f64::MAX);
        assert_eq!(sum.of(Part::Walk).cpu_s, 0.0);
    }

    #[test]
    fn a_clock_that_was_not_asked_for_counts_nothing() {
        let mut clock = Clock::new(false);
        clock.start();
        clock.lap(Part::Camera, 7);
        clock.count(Part::Film, 7);
        assert_eq!((clock.profile(), clock.last), (None, 0.0));
    }
}
