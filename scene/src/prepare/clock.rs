//! CPU time of the calling thread.

use std::time::{Duration, Instant};

/// Measures from its making.
pub(crate) struct Clock {
    started: Instant,
    cpu: Option<u64>,
}

impl Clock {
    pub(crate) fn start() -> Self {
        Clock { started: Instant::now(), cpu: thread_nanoseconds() }
    }

    /// CPU time of this thread since; time on the wall where the system does not tell a thread's.
    pub(crate) fn elapsed(&self) -> Duration {
        match (self.cpu, thread_nanoseconds()) {
            (Some(before), Some(now)) => Duration::from_nanos(now.saturating_sub(before)),
            _ => self.started.elapsed(),
        }
    }
}

/// The kernel's account, brought up to date at each of its ticks.
fn thread_nanoseconds() -> Option<u64> {
    std::fs::read_to_string("/proc/thread-self/schedstat").ok()?.split(' ').next()?.parse().ok()
}
