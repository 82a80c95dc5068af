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
    looking: Mutex<Looking>,
    ended: Condvar,
}

/// Who has to do with scenes just now: jobs that find out which theirs is, or somebody who deletes some.
#[derive(Default)]
struct Looking {
    jobs: u32,
    alone: bool,
}

/// A job finds out which scene it has, or prepares it: nobody deletes any as long as this lives.
pub struct Look<'t>(&'t Turns);

/// Somebody deletes a scene: jobs wait with looking for theirs as long as this lives.
pub struct Alone<'t>(&'t Turns);

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

    fn looking(&self) -> MutexGuard<'_, Looking> {
        self.looking.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until nobody deletes scenes; then nobody does until the job has its own.
    ///
    /// # Errors
    /// Those of `go_on`, which is asked again and again meanwhile.
    pub fn look(&self, go_on: impl Fn() -> Result<(), JobError>) -> Result<Look<'_>, JobError> {
        let mut looking = self.looking();
        while looking.alone {
            go_on()?;
            looking = self.ended.wait_timeout(looking, LOOK).unwrap_or_else(PoisonError::into_inner).0;
        }
        looking.jobs += 1;
        Ok(Look(self))
    }

    /// Keeps jobs from looking for scenes, if none does just now.
    pub fn alone(&self) -> Option<Alone<'_>> {
        let mut looking = self.looking();
        let free = looking.jobs == 0 && !looking.alone;
        looking.alone |= free;
        free.then(|| Alone(self))
    }
}

impl Drop for Look<'_> {
    fn drop(&mut self) {
        self.0.looking().jobs -= 1;
    }
}

impl Drop for Alone<'_> {
    fn drop(&mut self) {
        self.0.looking().alone = false;
        self.0.ended.notify_all();
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

    #[test]
    fn nobody_deletes_scenes_while_a_job_looks_and_no_job_looks_meanwhile() {
        let turns = Turns::default();
        let (one, two) = (turns.look(|| Ok(())).unwrap(), turns.look(|| Ok(())).unwrap());
        assert!(turns.alone().is_none());
        drop(one);
        assert!(turns.alone().is_none());
        drop(two);
        let alone = turns.alone().unwrap();
        assert!(turns.alone().is_none());
        assert!(matches!(turns.look(|| Err(JobError::Stopped)), Err(JobError::Stopped)));
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| turns.look(|| Ok(())).map(drop));
            drop(alone);
            waits.join().unwrap().unwrap();
        });
        assert!(turns.alone().is_some());
    }
}
