//! CPU time of the calling thread.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

/// Measures from its making, on the thread that made it.
pub(crate) struct Clock(Duration);

impl Clock {
    pub(crate) fn start() -> Self {
        Clock(now())
    }

    /// CPU time of this thread since.
    pub(crate) fn elapsed(&self) -> Duration {
        now().saturating_sub(self.0)
    }
}

fn now() -> Duration {
    let t = clock_gettime(ClockId::ThreadCPUTime);
    // never negative
    Duration::new(t.tv_sec.unsigned_abs(), t.tv_nsec as u32)
}
