//! How long what failed rests before it is tried again: longer each time, and not all at once.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use k8s_openapi::jiff::{SignedDuration, Timestamp};

/// The longest rest.
pub const LONGEST: Duration = Duration::from_secs(120);

/// The rest after so many failures in a row: doubled each time up to [`LONGEST`], of which each has its own part from half to all.
pub fn rest(first: Duration, failures: u32, who: &str) -> Duration {
    part(first.saturating_mul(1 << failures.saturating_sub(1).min(16)).min(LONGEST), who, failures)
}

/// From half of a time to all of it: another part for each, and each time.
pub fn part(whole: Duration, who: &str, number: u32) -> Duration {
    let mut hasher = DefaultHasher::new();
    (who, number).hash(&mut hasher);
    let thousandths = (hasher.finish() % 1001) as u32;
    whole / 2 + whole / 2 * thousandths / 1000
}

/// Failures in a row, by who fails.
#[derive(Default)]
pub struct Failures(Mutex<BTreeMap<String, u32>>);

impl Failures {
    /// Somebody failed once more; how long that one rests.
    pub fn failed(&self, who: &str, first: Duration) -> Duration {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let failures = all.entry(who.to_owned()).or_default();
        *failures = failures.saturating_add(1);
        rest(first, *failures, who)
    }
    /// Somebody did not fail.
    pub fn succeeded(&self, who: &str) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(who);
    }
}

/// Workers whose pods failed or were refused, and until when none is made for them.
#[derive(Clone, Debug, Default)]
pub struct Rests(BTreeMap<u32, (u32, Timestamp)>);

impl Rests {
    /// A pod of a worker failed, or was not made.
    pub fn failed(&mut self, number: u32, job: &str, first: Duration, now: Timestamp) {
        let (failures, until) = self.0.entry(number).or_insert((0, now));
        *failures = failures.saturating_add(1);
        let rest = rest(first, *failures, &format!("{job} {number}"));
        *until = SignedDuration::try_from(rest).ok().and_then(|r| now.checked_add(r).ok()).unwrap_or(now);
    }
    /// A pod of it is well.
    pub fn well(&mut self, number: u32) {
        self.0.remove(&number);
    }
    /// Whether a pod may be made now.
    pub fn may(&self, number: u32, now: Timestamp) -> bool {
        self.0.get(&number).is_none_or(|(_, until)| now >= *until)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rests_grow_and_are_not_the_same_for_all() {
        let first = Duration::from_secs(3);
        let failures = Failures::default();
        for n in 0..10u32 {
            let whole = (first * (1 << n)).min(LONGEST);
            let rest = failures.failed("a", first);
            assert!(rest >= whole / 2 && rest <= whole, "{n}: {rest:?}");
        }
        failures.succeeded("a");
        assert!(failures.failed("a", first) <= first);
        let all: std::collections::BTreeSet<Duration> = (0..50).map(|n| rest(first, 1, &n.to_string())).collect();
        assert!(all.len() > 40, "{}", all.len());
    }

    #[test]
    fn a_worker_whose_pods_fail_waits_and_the_others_do_not() {
        let at = |second: i64| Timestamp::from_second(1_800_000_000 + second).unwrap();
        let mut rests = Rests::default();
        for _ in 0..4 {
            rests.failed(1, "j", Duration::from_secs(1), at(0));
        }
        assert!(!rests.may(1, at(3)) && rests.may(1, at(8)) && rests.may(0, at(0)));
        rests.well(1);
        assert!(rests.may(1, at(0)));
    }
}
