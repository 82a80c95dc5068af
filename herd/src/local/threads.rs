//! An executor that runs each attempt on a thread of its own.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::thread::{Builder, Scope};
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
    /// What threads are made with.
    builder: fn() -> Builder,
}

impl<'scope, 'env> Threads<'scope, 'env> {
    /// No thread runs yet. Reports go through the channel; what comes after the scope's end is left in it.
    pub fn new(
        scope: &'scope Scope<'scope, 'env>,
        shared: &'env Shared<'env>,
        gate: &'env Gate,
        (send, receive): (Sender<Finished>, &'env Receiver<Finished>),
    ) -> Self {
        Threads { scope, shared, gate, send, receive, builder: Builder::new }
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
        let work = move || {
            let permit = gate.enter();
            let before = usage::thread_cpu();
            // a panic must end the job with a message, not leave it waiting
            let result = catch_unwind(AssertUnwindSafe(|| run(shared, &attempt, &stop)))
                .unwrap_or_else(|_| Err(JobError::Internal("a task panicked".into())));
            let cpu = usage::thread_cpu() - before;
            drop(permit);
            // nobody listens when the job has failed; the nodes have counted the bytes
            let _ = send.send(Finished { task, number, result, cpu, bytes: Bytes::default() });
        };
        if let Err(e) = (self.builder)().spawn_scoped(self.scope, work) {
            let slots = shared.settings.slots();
            let message = format!(
                "no thread for a task: {e}; give fewer slots than {slots}, or let this user have more processes (ulimit -u)"
            );
            let result = Err(JobError::Settings(message));
            let _ = self.send.send(Finished { task, number, result, cpu: 0.0, bytes: Bytes::default() });
        }
    }
    fn next(&self, wait: Duration) -> Result<Option<Event>, JobError> {
        match self.receive.recv_timeout(wait) {
            Ok(finished) => Ok(Some(Event::Finished(finished.into()))),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(JobError::Internal("all threads are gone".into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::mpsc::channel;

    use super::*;
    use crate::job::{JobSettings, PreparedScene};
    use crate::ledger::TaskId;
    use crate::local::attempt::{Attempt, FilmUse};
    use crate::local::nodes::Nodes;
    use crate::local::slots::StopFlag;
    use crate::plan::Set;
    use crate::store::MemoryStore;
    use crate::testing;

    #[test]
    fn a_thread_that_is_refused_ends_its_attempt_with_a_message() {
        let scene: PreparedScene = testing::prepared(&testing::cornell(), 1, true);
        let (frame, settings) = (testing::frame(&scene, [8, 8], 1), JobSettings::default());
        let nodes = Nodes::new(&scene, &settings, Arc::new(MemoryStore::default())).unwrap();
        let shared = Shared {
            scene: &scene,
            frame: &frame,
            settings: &settings,
            nodes,
            film: FilmUse::Handed { stored: false },
            buckets: 1,
        };
        let (gate, (send, receive)) = (Gate::new(1), channel());
        std::thread::scope(|scope| {
            let threads = Threads::new(scope, &shared, &gate, (send, &receive));
            // no machine has so much room for a stack
            let threads = Threads { builder: || Builder::new().stack_size(1 << 60), ..threads };
            let attempt = Attempt { name: "a".into(), node: 0, set: Set::Any, groups: vec![], camera: vec![] };
            threads.launch(Launch { task: TaskId(3), number: 1, attempt, stop: StopFlag::default() });
            let Some(Event::Finished(finished)) = threads.next(Duration::ZERO).unwrap() else { panic!("nothing") };
            assert_eq!((finished.task, finished.number), (TaskId(3), 1));
            let error = finished.result.err().unwrap();
            assert!(error.is_users() && error.to_string().contains("slots"), "{error}");
        });
    }
}
