//! Threads of slots: how many compute at once, and how an attempt is told to stop.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
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
    /// Whether a place is free.
    pub fn has_room(&self) -> bool {
        *self.free.lock().unwrap_or_else(PoisonError::into_inner) > 0
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
pub struct StopFlag {
    stop: Arc<AtomicBool>,
    /// Checks that are left before it stops of itself; none for no such end.
    left: Option<Arc<AtomicU32>>,
}

impl StopFlag {
    /// The same flag, for an attempt that is to stop after so many batches even if it is not set.
    pub fn limited(&self, batches: u32) -> Self {
        StopFlag { left: Some(Arc::new(AtomicU32::new(batches))), ..self.clone() }
    }
    /// Whether it was set.
    pub fn is_set(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
    /// The attempt ends at its next batch.
    pub fn set(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

impl Stop for StopFlag {
    fn check(&self) -> Result<(), JobError> {
        let used_up = self
            .left
            .as_ref()
            .is_some_and(|left| left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_err());
        if used_up || self.is_set() { Err(JobError::Stopped) } else { Ok(()) }
    }
}
