//! One after the other where two at once would do the same work: jobs that name one scene prepare it once.

use std::collections::BTreeSet;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::job::JobError;

/// Between two looks whether whoever waits is to stop.
const LOOK: Duration = Duration::from_millis(200);

/// What is being worked on, by name. Shared by all jobs of an operator.
#[derive(Default)]
pub struct Turns {
    taken: Mutex<BTreeSet<String>>,
    freed: Condvar,
}

/// A name that nobody else has as long as this lives.
pub struct Turn<'t> {
    turns: &'t Turns,
    name: String,
}

impl Turns {
    fn lock(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until nobody has the name, then takes it.
    ///
    /// # Errors
    /// Those of `go_on`, which is asked again and again meanwhile.
    pub fn take(&self, name: &str, go_on: impl Fn() -> Result<(), JobError>) -> Result<Turn<'_>, JobError> {
        let mut taken = self.lock();
        while !taken.insert(name.to_owned()) {
            go_on()?;
            taken = self.freed.wait_timeout(taken, LOOK).unwrap_or_else(PoisonError::into_inner).0;
        }
        Ok(Turn { turns: self, name: name.to_owned() })
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.turns.lock().remove(&self.name);
        self.turns.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_at_a_time_has_a_name_and_who_is_stopped_does_not_wait() {
        let turns = Turns::default();
        let first = turns.take("a", || Ok(())).unwrap();
        let _other = turns.take("b", || Ok(())).unwrap();
        let stopped = turns.take("a", || Err(JobError::Stopped));
        assert!(matches!(stopped, Err(JobError::Stopped)));
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| turns.take("a", || Ok(())).map(drop));
            drop(first);
            waits.join().unwrap().unwrap();
        });
        assert_eq!(turns.lock().len(), 1);
    }
}
