//! Workers that die with work in their hands: how often the same work is tried, and with how much memory.
//!
//! Work that kills its worker each time must not be handed out for ever. It is known by what it works on, not by its task: what a lost
//! task was to do is planned anew, beside other things. A worker that falls silent and is heard of again has not died.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::message::Work;

/// So many workers die with the same work in hand before the job is given up: far more than nodes that fail by chance take of one task.
pub const MOST_DEATHS: u32 = 5;
/// So many are killed for lack of memory before it is.
pub const MOST_KILLED: u32 = 3;
/// Why a process ended is known so soon after its end: it is looked at each second.
const KNOWN_WITHIN: Duration = Duration::from_secs(30);

/// Work that was in a worker's hands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Held {
    /// What it works on.
    pub keys: Vec<String>,
    /// How often memory had been halved when it was handed out; none for work that holds no splits.
    pub level: Option<u32>,
}

/// What is to be done about a worker that was killed for lack of memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Its work is tried again as it is.
    Again,
    /// Tasks are to hold half of the splits.
    Less,
    /// Splits were halved as often as they are to be.
    TooMuch,
    /// Work that holds no splits has killed so many: this.
    Hopeless(String),
}

/// The end of a worker's process.
struct End {
    session: String,
    at: Instant,
    held: Vec<Held>,
    counted: bool,
    for_memory: bool,
}

/// Deaths of one job's workers.
#[derive(Default)]
pub struct Deaths {
    /// By what the work works on, since it last came out: all deaths, and those for lack of memory.
    counts: BTreeMap<String, [u32; 2]>,
    last: BTreeMap<u32, End>,
    level: u32,
}

/// What a piece of work works on, in words where there are any.
pub fn keys(work: &Work) -> Vec<String> {
    match work {
        Work::Prepare { .. } => vec!["preparing the scene".into()],
        Work::Build { splits, .. } => {
            let first = splits.first().map_or(0, |s| s.number);
            vec![format!("building {} blocks of the scene, from split {first} on", splits.len())]
        }
        Work::Attempt { attempt } => {
            let units = attempt.camera.iter().map(|u| format!("camera rays of tile {} from {}", u.tile, u.first));
            attempt.groups.iter().map(|g| format!("rays {}", g.key)).chain(units).collect()
        }
        Work::Merge { picture: Some(key), .. } => vec![format!("making the picture {key}")],
        Work::Merge { parts, band, .. } => {
            let first = parts.first().map_or("nothing", |p| p.key.as_str());
            vec![format!("adding up {} parts of the film (band {band:?}, from {first} on)", parts.len())]
        }
        // it is not tried again
        Work::Preview { .. } => Vec::new(),
        Work::Copy { gone, .. } => vec![format!("copying rays and film that lay on store {gone}")],
        Work::Restore { gone } => vec![format!("copying what of the scene lay on store {gone}")],
    }
}

fn idle(number: u32) -> String {
    format!("opening the scene, or waiting, as worker {number}")
}

impl Deaths {
    /// How often memory was halved.
    pub fn level(&self) -> u32 {
        self.level
    }

    /// A worker is gone, maybe for a while, and this was in its hands.
    pub fn left(&mut self, number: u32, session: &str, mut held: Vec<Held>) {
        if held.is_empty() {
            held.push(Held { keys: vec![idle(number)], level: None });
        }
        let end = End { session: session.to_owned(), at: Instant::now(), held, counted: false, for_memory: false };
        self.last.insert(number, end);
    }

    /// A worker is heard of, by a session that was not there a moment ago. What has killed too many, if anything has.
    pub fn began(&mut self, number: u32, session: &str) -> Option<String> {
        let end = self.last.get_mut(&number)?;
        if end.session == session {
            self.last.remove(&number);
            return None;
        }
        if std::mem::replace(&mut end.counted, true) {
            return None;
        }
        let mut worst = None;
        // one that had nothing to do may have been asked to go
        for key in end.held.iter().flat_map(|h| &h.keys).filter(|k| **k != idle(number)) {
            let count = self.counts.entry(key.clone()).or_default();
            count[0] += 1;
            if count[0] >= MOST_DEATHS {
                worst = Some(key.clone());
            }
        }
        worst
    }

    /// Whether a worker's last end is known, and not yet why.
    pub fn is_unexplained(&self, number: u32) -> bool {
        self.last.get(&number).is_some_and(|e| !e.for_memory && e.at.elapsed() < KNOWN_WITHIN)
    }

    /// The last end of a worker was for lack of memory.
    pub fn for_memory(&mut self, number: u32) -> Verdict {
        let Some(end) = self.last.get_mut(&number) else { return Verdict::Again };
        end.for_memory = true;
        let counted = std::mem::replace(&mut end.counted, true);
        let mut verdict = Verdict::Again;
        for held in &end.held {
            for key in &held.keys {
                let count = self.counts.entry(key.clone()).or_default();
                // it is counted once
                count[0] -= u32::from(counted && count[0] > 0);
                count[1] += u32::from(held.level.is_none());
                if count[1] >= MOST_KILLED {
                    verdict = Verdict::Hopeless(key.clone());
                }
            }
        }
        if matches!(verdict, Verdict::Hopeless(_)) || end.held.iter().all(|h| h.level != Some(self.level)) {
            return verdict;
        }
        if self.level + 1 >= MOST_KILLED {
            return Verdict::TooMuch;
        }
        self.level += 1;
        Verdict::Less
    }

    /// A worker has done something.
    pub fn came_out(&mut self, number: u32, keys: &[String]) {
        if !self.counts.is_empty() {
            self.counts.remove(&idle(number));
            for key in keys {
                self.counts.remove(key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(key: &str, level: Option<u32>) -> Vec<Held> {
        vec![Held { keys: vec![key.into()], level }]
    }

    #[test]
    fn work_that_kills_each_time_is_found_and_silence_is_no_death() {
        let mut deaths = Deaths::default();
        for _ in 0..20 {
            deaths.left(0, "a", held("x", Some(0)));
            assert_eq!(deaths.began(0, "a"), None, "it was silent for a while");
        }
        for n in 1..MOST_DEATHS {
            deaths.left(0, &n.to_string(), held("x", Some(0)));
            assert_eq!(deaths.began(0, "next"), None);
            assert_eq!(deaths.began(0, "after"), None, "each end counts once");
        }
        deaths.left(1, "b", held("x", Some(0)));
        assert_eq!(deaths.began(1, "c"), Some("x".into()), "whoever has it in hand");
        deaths.came_out(1, &["x".into()]);
        deaths.left(1, "c", held("x", Some(0)));
        assert_eq!(deaths.began(1, "d"), None, "it came out: counted anew");
        for n in 0..20 {
            deaths.left(2, &n.to_string(), Vec::new());
            assert_eq!(deaths.began(2, "z"), None, "it had nothing in hand");
        }
    }

    #[test]
    fn lack_of_memory_halves_twice_and_counts_once_for_tasks_that_ran_beside_each_other() {
        let mut deaths = Deaths::default();
        for (n, want) in [(0, Verdict::Less), (1, Verdict::Again), (2, Verdict::Again)] {
            deaths.left(n, "a", held("x", Some(0)));
            assert!(deaths.is_unexplained(n));
            assert_eq!(deaths.for_memory(n), want, "of one level all die of the same");
            assert!(!deaths.is_unexplained(n));
        }
        deaths.left(0, "b", held("x", Some(1)));
        assert_eq!((deaths.for_memory(0), deaths.level()), (Verdict::Less, 2));
        deaths.left(0, "c", held("y", Some(2)));
        assert_eq!(deaths.for_memory(0), Verdict::TooMuch);
        // what holds no splits has none to halve; nor has one that cannot even open the scene
        for held in [held("adding up", None), Vec::new()] {
            for n in 1..=MOST_KILLED {
                deaths.left(4, &n.to_string(), held.clone());
                let hopeless = matches!(deaths.for_memory(4), Verdict::Hopeless(_));
                assert_eq!(hopeless, n == MOST_KILLED);
            }
        }
    }
}
