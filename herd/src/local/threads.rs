//! An executor that runs each attempt on a thread of its own.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::thread::Scope;
use std::time::Duration;

use super::attempt::{Shared, run};
use super::slots::Gate;
use super::usage;
use crate::driver::{Event, Executor, Finished, Launch};
use crate::job::JobError;
use crate::report::Bytes;

/// Threads that live as long as `scope`.
pub struct Threads<'scope, 'env> {
    scope: &'scope Scope<'scope, 'env>,
    shared: &'env Shared<'env>,
    /// As many compute at once as it lets through.
    gate: &'env Gate,
    send: Sender<Finished>,
    receive: &'env Receiver<Finished>,
}

impl<'scope, 'env> Threads<'scope, 'env> {
    /// No thread runs yet. Reports go through the channel; what comes after the scope's end is left in it.
    pub fn new(
        scope: &'scope Scope<'scope, 'env>,
        shared: &'env Shared<'env>,
        gate: &'env Gate,
        (send, receive): (Sender<Finished>, &'env Receiver<Finished>),
    ) -> Self {
        Threads { scope, shared, gate, send, receive }
    }
}

impl Executor for Threads<'_, '_> {
    fn is_up(&self, _: u32) -> bool {
        true
    }
    fn has_room(&self) -> bool {
        self.gate.has_room()
    }
    fn launch(&self, launch: Launch) {
        let Launch { task, number, attempt, stop } = launch;
        let (shared, gate, send) = (self.shared, self.gate, self.send.clone());
        self.scope.spawn(move || {
            let permit = gate.enter();
            let before = usage::thread_cpu();
            // a panic must end the job with a message, not leave it waiting
            let result = catch_unwind(AssertUnwindSafe(|| run(shared, &attempt, &stop)))
                .unwrap_or_else(|_| Err(JobError::Internal("a task panicked".into())));
            let cpu = usage::thread_cpu() - before;
            drop(permit);
            // nobody listens when the job has failed; the nodes have counted the bytes
            let _ = send.send(Finished { task, number, result, cpu, bytes: Bytes::default() });
        });
    }
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError> {
        match self.receive.recv_timeout(wait) {
            Ok(finished) => Ok(Some(Event::Finished(finished.into()))),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(JobError::Internal("all threads are gone".into())),
        }
    }
}
