//! Threads of slots: how many compute at once, and how an attempt is told to stop.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};

use crate::job::JobError;
use crate::task::Stop;

/// Lets so many threads compute at once.
pub struct Gate {
    free: Mutex<usize>,
    freed: Condvar,
}

/// A place behind the gate, until it is dropped.
pub struct Permit<'a>(&'a Gate);

impl Gate {
    /// For `threads` threads.
    pub fn new(threads: usize) -> Self {
        Gate { free: Mutex::new(threads.max(1)), freed: Condvar::new() }
    }
    /// Waits for a place.
    pub fn enter(&self) -> Permit<'_> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        while *free == 0 {
            free = self.freed.wait(free).unwrap_or_else(PoisonError::into_inner);
        }
        *free -= 1;
        Permit(self)
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        *self.0.free.lock().unwrap_or_else(PoisonError::into_inner) += 1;
        self.0.freed.notify_one();
    }
}

/// Tells an attempt to stop.
#[derive(Clone, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// The attempt ends at its next batch.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Stop for StopFlag {
    fn check(&self) -> Result<(), JobError> {
        if self.0.load(Ordering::Relaxed) { Err(JobError::Stopped) } else { Ok(()) }
    }
}
