//! Whether the operator still sees what happens: a watch that cannot be begun again and again is dead.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use kube::runtime::watcher;

/// A watch that failed to begin for so long is dead: whoever looks after the process starts it anew.
const DEAD: Duration = Duration::from_secs(600);
/// One that is tried all the time fails as often as this: 30 s between two tries, and as long to find that nobody answers.
const GAP: Duration = Duration::from_secs(90);

/// When watches failed first and last in a row.
#[derive(Default)]
pub struct Watching(Mutex<Option<(Instant, Instant)>>);

impl Watching {
    /// A watch failed.
    pub fn failed(&self, error: &watcher::Error, now: Instant) {
        let began = match error {
            watcher::Error::WatchError(_) | watcher::Error::WatchFailed(_) => true,
            watcher::Error::InitialListFailed(_)
            | watcher::Error::WatchStartFailed(_)
            | watcher::Error::NoResourceVersion => false,
        };
        self.note(began, now);
    }

    /// One failed that had begun, or could not begin.
    fn note(&self, had_begun: bool, now: Instant) {
        let mut row = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *row = match *row {
            _ if had_begun => None,
            Some((first, last)) if now.duration_since(last) <= GAP => Some((first, now)),
            _ => Some((now, now)),
        };
    }

    /// Whether nothing is seen any more.
    pub fn is_dead(&self, now: Instant) -> bool {
        let row = *self.0.lock().unwrap_or_else(PoisonError::into_inner);
        row.is_some_and(|(first, last)| now.duration_since(last) <= GAP && last.duration_since(first) >= DEAD)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_watch_that_never_begins_is_dead() {
        let (watching, start) = (Watching::default(), Instant::now());
        let at = |second| start + Duration::from_secs(second);
        for second in (0..600).step_by(30) {
            watching.note(false, at(second));
            assert!(!watching.is_dead(at(second)));
        }
        watching.note(false, at(600));
        assert!(watching.is_dead(at(600)) && watching.is_dead(at(660)));
        assert!(!watching.is_dead(at(700)), "it does not fail any more");
        watching.note(true, at(610));
        assert!(!watching.is_dead(at(610)), "it had begun");
        // cut each few minutes by a proxy, and begun again
        for second in (1000..5000).step_by(100) {
            watching.note(false, at(second));
            assert!(!watching.is_dead(at(second)));
        }
        // none that fails once begun
        for second in (5000..7000).step_by(30) {
            watching.note(second % 60 == 20, at(second));
            assert!(!watching.is_dead(at(second)));
        }
    }
}
