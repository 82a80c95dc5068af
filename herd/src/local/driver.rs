//! The loop over rounds: plan, run attempts on threads, commit, until every ray has come to its end.

use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::Scope;
use std::time::{Duration, Instant};

use rayherd_render::film::FilmPart;
use rayherd_render::frame::Frame;

use super::attempt::{Attempt, Made, Shared, run};
use super::cameras::Cameras;
use super::nodes::Nodes;
use super::slots::{Gate, StopFlag};
use super::{JobOutcome, check, usage};
use crate::job::{Image, JobError, JobSettings, NodeSpec, PreparedScene, Progress, Sampling, Status};
use crate::ledger::{Destination, GroupRef, Inputs, Ledger, TaskId};
use crate::plan::rate::Rate;
use crate::plan::{self, Assignment, NodeView, Set, SplitView, View, Waiting, place};
use crate::report::Report;
use crate::store::MemoryStore;
use crate::task::camera::tiles;
use crate::wave;

/// Largest forest that a task may hold (see `rayherd_render::bvh::Forest`), less room for its top tree.
const FOREST_BYTES: u64 = (8 << 30) - (64 << 20);

pub(super) fn render(
    scene: &PreparedScene,
    frame: &Frame,
    sampling: &Sampling,
    settings: &JobSettings,
    progress: &dyn Progress,
) -> Result<JobOutcome, JobError> {
    check(scene, frame, sampling, settings)?;
    let nodes = Nodes::new(scene, settings, Arc::new(MemoryStore::default()))?;
    let store_film = settings.nodes.len() > 1;
    let shared = Shared { scene, frame, settings, nodes, store_film, buckets: settings.slots() };
    let threads = settings
        .threads
        .map_or_else(|| std::thread::available_parallelism().map_or(1, |n| n.get()), |n| n.get() as usize);
    let gate = Gate::new(threads);
    let ledger = Ledger::new("image", tiles(frame));
    let (send, receive) = channel();
    let mut driver = Driver::new(&shared, &gate, ledger, sampling, progress, send);
    std::thread::scope(|scope| {
        let result = driver.run(scope, &receive);
        driver.stop_all();
        result
    })?;
    driver.finish()
}

/// What a thread reports.
struct Message {
    task: TaskId,
    number: u32,
    result: Result<Made, JobError>,
    cpu: f64,
}

/// A task that runs.
struct Running {
    attempts: BTreeMap<u32, Live>,
    spec: Attempt,
}

/// An attempt that runs.
struct Live {
    node: u32,
    stop: StopFlag,
}

struct Driver<'s, 'a> {
    shared: &'s Shared<'a>,
    gate: &'s Gate,
    ledger: Ledger,
    film: FilmPart,
    cameras: Cameras,
    sampling: &'s Sampling,
    progress: &'s dyn Progress,
    send: Sender<Message>,
    /// Samples whose units were queued.
    queued: u32,
    /// Splits along the curve, and back.
    order: Vec<u32>,
    rank: Vec<u32>,
    windows: Vec<BTreeSet<u32>>,
    free: Vec<u32>,
    running: BTreeMap<TaskId, Running>,
    rate: Rate,
    start: Instant,
    rounds: u64,
    tasks: u64,
    hops: u64,
    hop_bytes: u64,
    error: Option<f64>,
}

impl<'s, 'a> Driver<'s, 'a> {
    fn new(
        shared: &'s Shared<'a>,
        gate: &'s Gate,
        ledger: Ledger,
        sampling: &'s Sampling,
        progress: &'s dyn Progress,
        send: Sender<Message>,
    ) -> Self {
        let scene = shared.scene;
        let order = place::order(&scene.manifest.splits.iter().map(|s| (s.lo, s.hi)).collect::<Vec<_>>());
        let mut rank = vec![0; order.len()];
        order.iter().enumerate().for_each(|(r, &s)| rank[s as usize] = r as u32);
        let starts = scene.start_splits(shared.frame).into_iter().map(|s| rank[s as usize]).collect();
        Driver {
            shared,
            gate,
            ledger,
            film: FilmPart::new(shared.frame.size),
            cameras: Cameras::new(shared.frame, starts),
            sampling,
            progress,
            send,
            queued: 0,
            order,
            rank,
            windows: vec![BTreeSet::new(); shared.settings.nodes.len()],
            free: shared.settings.nodes.iter().map(|n| n.slots).collect(),
            running: BTreeMap::new(),
            rate: Rate::UNKNOWN,
            start: Instant::now(),
            rounds: 0,
            tasks: 0,
            hops: 0,
            hop_bytes: 0,
            error: None,
        }
    }

    fn run<'scope>(&mut self, scope: &'scope Scope<'scope, '_>, receive: &Receiver<Message>) -> Result<(), JobError>
    where
        's: 'scope,
        'a: 'scope,
    {
        let barrier = self.shared.settings.has_barrier();
        loop {
            self.queue_steps();
            if !barrier || self.running.is_empty() {
                let mut started = false;
                for task in self.plan() {
                    started |= self.start(scope, task)?;
                }
                self.rounds += u64::from(started && barrier);
            }
            if self.running.is_empty() {
                if !self.ledger.is_quiet() || !self.cameras.is_empty() {
                    return Err(JobError::Internal("rays wait, but nothing was planned".into()));
                }
                if self.step_done() {
                    return Ok(());
                }
                continue;
            }
            match receive.recv_timeout(Duration::from_millis(200)) {
                Ok(message) => self.handle(message)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(JobError::Internal("all threads are gone".into())),
            }
            self.tell();
        }
    }

    /// Queues camera units of the next steps, as far as they need not wait for what comes before.
    fn queue_steps(&mut self) {
        let spp = self.sampling.spp;
        while self.queued < spp {
            let first = self.queued == 0;
            let wait = self.sampling.target_error.is_some() && !(self.ledger.is_quiet() && self.running.is_empty());
            let late =
                self.sampling.time_limit.is_some_and(|limit| !first && self.start.elapsed().as_secs_f64() >= limit);
            let enough = (self.sampling.target_error.is_some() || self.sampling.time_limit.is_some())
                && (!self.cameras.is_empty() || (!first && self.queued > self.ledger.taken().complete()));
            if !first && (wait || late || enough) {
                return;
            }
            let end = self.step_end();
            self.cameras.add(self.queued..end, self.ledger.taken());
            self.queued = end;
            if self.sampling.target_error.is_some() || self.sampling.time_limit.is_some() {
                return;
            }
        }
    }

    /// Where the step that begins at `self.queued` ends: where the schedule says, or before, if time would run out.
    fn step_end(&self) -> u32 {
        let end = wave::step_end(self.queued).min(self.sampling.spp);
        let Some(limit) = self.sampling.time_limit else { return end };
        let elapsed = self.start.elapsed().as_secs_f64();
        if self.queued == 0 || elapsed <= 0.0 {
            return end;
        }
        let samples_left = f64::from(self.queued) / elapsed * (limit - elapsed).max(0.0);
        end.min(self.queued + (samples_left as u32).max(1))
    }

    /// After everything queued came to its end: whether the job is over.
    fn step_done(&mut self) -> bool {
        self.error = self.film.rel_mse(self.queued);
        let reached = match (self.sampling.target_error, self.error) {
            (Some(target), Some(error)) => error <= target,
            _ => false,
        };
        let late = self.sampling.time_limit.is_some_and(|limit| self.start.elapsed().as_secs_f64() >= limit);
        self.queued >= self.sampling.spp || reached || late
    }

    /// What to start now, with the keys of the groups that each takes.
    fn plan(&self) -> Vec<(Assignment, Vec<String>)> {
        let settings = self.shared.settings;
        let holders = self.shared.nodes.holders();
        let split =
            |&s: &u32| SplitView { bytes: self.shared.scene.split_bytes(s), holders: holders[s as usize].clone() };
        let splits: Vec<SplitView> = self.order.iter().map(split).collect();
        let node = |(n, spec): (usize, &NodeSpec)| {
            let memory = self.shared.nodes.memory(n as u32);
            let warm = if settings.strategy == plan::Strategy::Auto {
                self.windows[n].clone()
            } else {
                memory.warm().into_iter().map(|s| self.rank[s as usize]).collect()
            };
            NodeView { slots: spec.slots, free: self.free[n], memory: memory.capacity().min(FOREST_BYTES), warm }
        };
        let nodes: Vec<NodeView> = settings.nodes.iter().enumerate().map(node).collect();
        let groups: Vec<&GroupRef> = self.ledger.waiting().collect();
        let mut waiting: BTreeMap<u32, Vec<Waiting>> = BTreeMap::new();
        let mut reduce = Vec::new();
        for (id, group) in groups.iter().enumerate() {
            let entry = Waiting { id, rays: u64::from(group.rays) };
            match group.to {
                Destination::Split(s) => waiting.entry(self.rank[s as usize]).or_default().push(entry),
                Destination::Reduce(_) => reduce.push(entry),
            }
        }
        let view = View {
            strategy: settings.strategy,
            splits: &splits,
            nodes: &nodes,
            waiting,
            reduce,
            camera: self.cameras.rays(),
            task_rays: self.rate.rays(settings.task_seconds),
            task_camera: self.rate.camera(settings.task_seconds),
            least_rays: u64::from(settings.batch),
        };
        let plan = plan::plan(&view);
        plan.into_iter()
            .map(|a| {
                let keys = a.groups.iter().map(|&g| groups[g].key.clone()).collect();
                (a, keys)
            })
            .collect()
    }

    /// Starts a task as planned; false if there was nothing left for it to do.
    fn start<'scope>(
        &mut self,
        scope: &'scope Scope<'scope, '_>,
        (plan, groups): (Assignment, Vec<String>),
    ) -> Result<bool, JobError>
    where
        's: 'scope,
        'a: 'scope,
    {
        let camera = plan.camera.map_or_else(Vec::new, |(rays, from)| self.cameras.take(rays, &from));
        if groups.is_empty() && camera.is_empty() {
            return Ok(false);
        }
        let split = |rank: u32| self.order[rank as usize];
        let set = match plan.set {
            Set::Resident(ranks) => {
                self.windows[plan.node as usize] = ranks.iter().copied().collect();
                let mut splits: Vec<u32> = ranks.into_iter().map(split).collect();
                splits.sort_unstable();
                Set::Resident(splits)
            }
            Set::Sharing(rank) => Set::Sharing(split(rank)),
            other => other,
        };
        let (task, groups) = self.ledger.start(&Inputs { groups, camera: camera.clone() })?;
        let name = format!("t{:08}", task.0);
        let spec = Attempt { name, node: plan.node, set, groups, camera };
        self.running.insert(task, Running { attempts: BTreeMap::new(), spec: spec.clone() });
        self.launch(scope, task, 0, spec);
        Ok(true)
    }

    /// Starts an attempt on a thread of its own.
    fn launch<'scope>(&mut self, scope: &'scope Scope<'scope, '_>, task: TaskId, number: u32, mut attempt: Attempt)
    where
        's: 'scope,
        'a: 'scope,
    {
        attempt.name = format!("{}-a{number}", attempt.name);
        let (stop, node) = (StopFlag::default(), attempt.node);
        self.free[node as usize] -= 1;
        if let Some(running) = self.running.get_mut(&task) {
            running.attempts.insert(number, Live { node, stop: stop.clone() });
        }
        let (shared, gate, send) = (self.shared, self.gate, self.send.clone());
        scope.spawn(move || {
            let permit = gate.enter();
            let before = usage::thread_cpu();
            // a panic must end the job with a message, not leave it waiting
            let result = catch_unwind(AssertUnwindSafe(|| run(shared, &attempt, &stop)))
                .unwrap_or_else(|_| Err(JobError::Internal("a task panicked".into())));
            let cpu = usage::thread_cpu() - before;
            drop(permit);
            // nobody listens when the job has failed
            let _ = send.send(Message { task, number, result, cpu });
        });
    }

    fn handle(&mut self, message: Message) -> Result<(), JobError> {
        let Message { task, number, result, cpu } = message;
        let live = self.running.get_mut(&task).and_then(|r| r.attempts.remove(&number));
        let Some(live) = live else {
            return Err(JobError::Internal("an attempt reports that was never started".into()));
        };
        self.free[live.node as usize] += 1;
        self.shared.nodes.busy(live.node, cpu);
        match result {
            Ok(made) => self.commit(task, made, cpu),
            Err(JobError::Stopped) => Ok(()),
            Err(e) => Err(e),
        }
    }

    fn commit(&mut self, task: TaskId, made: Made, cpu: f64) -> Result<(), JobError> {
        let record = self.ledger.record(task, made.outputs)?;
        let name = format!("r{}", record.sequence);
        self.ledger.commit(task, &record, name)?;
        self.film.merge(&made.film)?;
        let made_rays = record.made.rays;
        self.rate.add(cpu, made_rays.closest + made_rays.shadow, made_rays.camera);
        self.tasks += 1;
        self.hops += made.hops;
        self.hop_bytes += record.made.groups.iter().map(|g| g.bytes).sum::<u64>();
        if let Some(running) = self.running.remove(&task) {
            running.attempts.values().for_each(|a| a.stop.set());
            let consumed: Vec<_> = running.spec.groups.into_iter().map(|g| (g.key, g.holders)).collect();
            self.shared.nodes.delete(&consumed)?;
        }
        if self.progress.wants_preview() {
            let spp = self.ledger.taken().reach().max(1);
            self.progress.preview(&image(&self.film, spp));
        }
        Ok(())
    }

    fn stop_all(&mut self) {
        self.running.values().flat_map(|r| r.attempts.values()).for_each(|a| a.stop.set());
    }

    fn tell(&self) {
        let [w, h] = self.shared.frame.size;
        let pixels = u64::from(w) * u64::from(h);
        let rays = self.ledger.rays();
        self.progress.status(&Status {
            elapsed: self.start.elapsed(),
            rays,
            samples: rays.camera,
            samples_total: pixels * u64::from(self.sampling.spp),
            waiting: self.ledger.waiting().map(|g| u64::from(g.rays)).sum(),
            rounds: if self.shared.settings.has_barrier() { self.rounds } else { self.ledger.commits() },
            error: self.error,
        });
    }

    fn finish(self) -> Result<JobOutcome, JobError> {
        let spp = self.ledger.done().complete();
        let [width, height] = self.shared.frame.size;
        let settings = self.shared.settings;
        let counts = &self.shared.scene.manifest.counts;
        let rel_mse = self.film.rel_mse(spp);
        let (bytes, nodes_detail) = self.shared.nodes.report();
        let skipped = [
            ("degenerate", counts.degenerate),
            ("non_finite", counts.non_finite),
            ("out_of_range", counts.out_of_range),
        ];
        let mut report = Report {
            strategy: settings.strategy.name().to_owned(),
            nodes: settings.nodes.len() as u32,
            slots: settings.slots(),
            rounds: if settings.has_barrier() { self.rounds } else { self.tasks },
            tasks: self.tasks,
            attempts_lost: self.ledger.attempts_lost(),
            wall_s: self.start.elapsed().as_secs_f64(),
            cpu_s: usage::process_cpu(),
            spp,
            samples: u64::from(width) * u64::from(height) * u64::from(spp),
            rays: self.ledger.rays(),
            scene_bytes: self.shared.scene.manifest.scene_bytes(),
            hops: self.hops,
            bytes_per_hop: (self.hops > 0).then(|| self.hop_bytes as f64 / self.hops as f64),
            peak_memory_bytes: usage::peak_memory(),
            non_finite: self.film.rejected().count,
            rel_mse,
            target_reached: self.sampling.target_error.map(|t| rel_mse.is_some_and(|e| e <= t)),
            nodes_detail,
            skipped: skipped.into_iter().map(|(k, v)| (k.to_owned(), v)).collect(),
            ..Report::default()
        };
        report.set_bytes(&bytes);
        for (pixel, sample) in &self.film.rejected().keys {
            let (x, y) = (pixel % width, pixel / width);
            tracing::warn!("pixel {x},{y} sample {sample}: a contribution is not finite or too large");
        }
        Ok(JobOutcome { image: image(&self.film, spp), film: self.film, spp, report })
    }
}

fn image(film: &FilmPart, spp: u32) -> Image {
    let [width, height] = film.size();
    Image { width, height, pixels: film.resolve(spp) }
}
