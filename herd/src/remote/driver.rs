//! The loop over rounds, for any executor: plan, run attempts, commit, until every ray has come to its end.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayherd_render::frame::Frame;

use super::executor::{Executor, FilmSum, Finished, Launch, Pointer};
use crate::job::{JobError, NodeSpec, PreparedScene, Progress, Sampling, Status};
use crate::ledger::{Destination, GroupRef, Inputs, Ledger, Outputs, Record, Refused, Snapshot, TaskId};
use crate::local::attempt::{Attempt, Made, Shared};
use crate::local::cameras::Cameras;
use crate::local::slots::StopFlag;
use crate::local::{journal, usage};
use crate::plan::cost::Traffic;
use crate::plan::rate::Rate;
use crate::plan::{self, Assignment, NodeView, Set, SplitView, View, Waiting};
use crate::report::{RayCounts, Report};
use crate::wave;

/// Largest forest that a task may hold (see `rayherd_render::bvh::Forest`), less room for its top tree.
const FOREST_BYTES: u64 = (8 << 30) - (64 << 20);

/// Names what defines the image: the scene's content and the frame.
pub fn image_name(scene: &PreparedScene, frame: &Frame) -> Result<String, JobError> {
    let frame = serde_json::to_vec(frame).map_err(|e| JobError::Internal(e.to_string()))?;
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"rayherd image 1\0").update(&scene.manifest.content.0).update(&frame);
    Ok(hasher.finalize().to_hex().to_string())
}

/// Where a job begins: at nothing, or where an earlier run stopped.
pub struct Start<F> {
    /// The state.
    pub ledger: Ledger,
    /// The film of its commits.
    pub film: F,
    /// State to go back to when rays are lost: the last one without rays on their way, whose film is the one kept in `film`.
    pub settled: Snapshot,
    /// Where it is kept which record is the newest.
    pub pointer: Arc<dyn Pointer>,
    /// Names of this run's objects begin with it.
    pub session: String,
    /// Commits taken over from earlier runs.
    pub reused: u64,
    /// Commits whose outputs are lost.
    pub redone: u64,
}

/// A task that runs.
struct Running {
    spec: Attempt,
    started: Instant,
    attempts: u32,
}

/// An attempt that runs, of a task that may be committed already.
struct Live {
    node: u32,
    stop: StopFlag,
}

/// Objects by name, with the nodes that hold them.
type Objects = Vec<(String, Vec<u32>)>;

/// Camera units that are queued at once, about; steps are added as they are used up.
const QUEUED_UNITS: usize = 100_000;

/// Commits between two snapshots.
const SNAPSHOT_EVERY: u64 = 16;

/// The loop over rounds of one frame.
pub struct Driver<'s, 'a, F> {
    shared: &'s Shared<'a>,
    ledger: Ledger,
    film: F,
    cameras: Cameras,
    sampling: &'s Sampling,
    progress: &'s dyn Progress,
    /// Samples whose units were queued.
    queued: u32,
    /// Splits that rays can need along the curve through space, and their places in it.
    order: Vec<u32>,
    rank: Vec<u32>,
    /// How `auto` cuts the scene, in places along the curve, and what each node holds of it.
    cut: Option<Vec<Range<u32>>>,
    windows: Vec<BTreeSet<u32>>,
    traffic: Traffic,
    free: Vec<u32>,
    running: BTreeMap<TaskId, Running>,
    live: BTreeMap<(TaskId, u32), Live>,
    committed: BTreeSet<(TaskId, u32)>,
    pointer: Arc<dyn Pointer>,
    /// Films stored so far, so that none has the name of another.
    stored: u64,
    session: String,
    settled: Snapshot,
    /// Objects that the last snapshot made superfluous, and those that the next one will.
    superfluous: [Objects; 2],
    old_records: [Vec<String>; 2],
    rate: Rate,
    /// Rays of earlier runs.
    taken_over: RayCounts,
    start: Instant,
    begun: bool,
    rounds: u64,
    tasks: u64,
    reused: u64,
    redone: u64,
    hops: u64,
    hop_bytes: u64,
    error: Option<f64>,
}

impl<'s, 'a, F: FilmSum> Driver<'s, 'a, F> {
    /// A loop that has run nothing yet.
    pub fn new(shared: &'s Shared<'a>, begin: Start<F>, sampling: &'s Sampling, progress: &'s dyn Progress) -> Self {
        let scene = shared.scene;
        let order = scene.owning_order();
        let mut rank = vec![0; scene.splits() as usize];
        order.iter().enumerate().for_each(|(r, &s)| rank[s as usize] = r as u32);
        let starts = scene.start_splits(shared.frame).into_iter().map(|s| rank[s as usize]).collect();
        Driver {
            shared,
            queued: begin.ledger.done().complete(),
            settled: begin.settled,
            session: begin.session,
            taken_over: begin.ledger.rays(),
            ledger: begin.ledger,
            film: begin.film,
            pointer: begin.pointer,
            stored: 0,
            reused: begin.reused,
            redone: begin.redone,
            cameras: Cameras::new(shared.frame, starts),
            sampling,
            progress,
            order,
            rank,
            cut: None,
            windows: vec![BTreeSet::new(); shared.settings.nodes.len()],
            traffic: Traffic::default(),
            free: shared.settings.nodes.iter().map(|n| n.slots).collect(),
            running: BTreeMap::new(),
            live: BTreeMap::new(),
            committed: BTreeSet::new(),
            superfluous: Default::default(),
            old_records: Default::default(),
            rate: Rate::UNKNOWN,
            start: Instant::now(),
            begun: false,
            rounds: 0,
            tasks: 0,
            hops: 0,
            hop_bytes: 0,
            error: None,
        }
    }

    /// Runs the job to its end.
    ///
    /// # Errors
    /// When it cannot be finished; what was committed stays.
    pub fn run(&mut self, executor: &dyn Executor) -> Result<(), JobError> {
        let barrier = self.shared.settings.has_barrier();
        loop {
            if self.queued > 0 && self.is_step_over() && self.step_done()? {
                return Ok(());
            }
            self.queue_steps();
            let mut started = false;
            // asked before planning: one that comes up meanwhile was not planned for
            let all_up = (0..self.free.len() as u32).all(|n| executor.is_up(n));
            if !barrier || self.running.is_empty() {
                for task in self.plan(executor) {
                    started |= self.start(executor, task)?;
                }
                self.rounds += u64::from(started && barrier);
            }
            if self.live.is_empty() {
                if self.is_step_over() {
                    continue;
                }
                if all_up {
                    return Err(JobError::Internal("rays wait, but nothing was planned".into()));
                }
            }
            if !started {
                self.second_attempts(executor);
            }
            if let Some(finished) = executor.next(Duration::from_millis(100))? {
                self.handle(finished)?;
            }
            self.tell();
        }
    }

    /// Queues camera units of the next steps, as far as they need not wait for what comes before.
    fn queue_steps(&mut self) {
        let spp = self.sampling.spp;
        while self.queued < spp {
            let first = !self.begun;
            let wait = self.sampling.target_error.is_some() && !(self.ledger.is_quiet() && self.running.is_empty());
            let late =
                self.sampling.time_limit.is_some_and(|limit| !first && self.start.elapsed().as_secs_f64() >= limit);
            let enough = (self.sampling.target_error.is_some() || self.sampling.time_limit.is_some())
                && (!self.cameras.is_empty() || (!first && self.queued > self.ledger.taken().complete()));
            if !first && (wait || late || enough || self.cameras.units() > QUEUED_UNITS) {
                return;
            }
            let end = self.step_end();
            self.cameras.add(self.queued..end, self.ledger.taken());
            self.queued = end;
            self.begun = true;
            if self.sampling.target_error.is_some() || self.sampling.time_limit.is_some() {
                return;
            }
        }
    }

    /// Where the step that begins at `self.queued` ends: where the schedule says, or before, if time would run out.
    fn step_end(&self) -> u32 {
        // what an earlier run began of a step is finished first
        let reach = self.ledger.taken().reach();
        let end = wave::step_end(self.queued).min(self.sampling.spp).max(reach);
        let Some(limit) = self.sampling.time_limit else { return end };
        let elapsed = self.start.elapsed().as_secs_f64();
        if !self.begun || elapsed <= 0.0 {
            // one sample, to learn how long it takes
            return end.min(self.queued.saturating_add(1)).max(reach);
        }
        let [w, h] = self.shared.frame.size;
        let camera = self.ledger.rays().camera.saturating_sub(self.taken_over.camera);
        let made = camera as f64 / (f64::from(w) * f64::from(h));
        let samples_left = made / elapsed * (limit - elapsed).max(0.0);
        end.min(self.queued.saturating_add((samples_left as u32).max(1))).max(reach)
    }

    /// Whether everything queued came to its end.
    fn is_step_over(&self) -> bool {
        self.ledger.is_quiet() && self.cameras.is_empty() && self.ledger.done().reach() == self.queued
    }

    /// After everything queued came to its end: whether the job is over.
    fn step_done(&mut self) -> Result<bool, JobError> {
        self.error = self.film.rel_mse(self.queued)?;
        let reached = match (self.sampling.target_error, self.error) {
            (Some(target), Some(error)) => error <= target,
            _ => false,
        };
        let late = self.sampling.time_limit.is_some_and(|limit| self.start.elapsed().as_secs_f64() >= limit);
        Ok(self.queued >= self.sampling.spp || reached || late)
    }

    /// What to start now, with the keys of the groups that each takes.
    fn plan(&mut self, executor: &dyn Executor) -> Vec<(Assignment, Vec<String>)> {
        if (0..self.free.len() as u32).all(|n| !executor.is_up(n)) {
            return Vec::new();
        }
        let settings = self.shared.settings;
        let holders = executor.holders().unwrap_or_else(|| self.shared.nodes.holders());
        let split =
            |&s: &u32| SplitView { bytes: self.shared.scene.split_bytes(s), holders: holders[s as usize].clone() };
        let splits: Vec<SplitView> = self.order.iter().map(split).collect();
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
        let mut view = View {
            strategy: settings.strategy,
            splits: &splits,
            nodes: &self.nodes_as_seen(executor),
            waiting,
            reduce,
            camera: self.cameras.rays(),
            task_rays: self.rate.rays(settings.task_seconds),
            task_camera: self.rate.camera(settings.task_seconds),
            least_rays: u64::from(settings.batch),
            replicas: settings.replicas,
            forest: FOREST_BYTES,
            cut: self.cut.as_deref().unwrap_or_default(),
            traffic: self.traffic,
        };
        // a new cut is worth a thought when nothing is under way that was made for the old one
        let (mut cut, nodes) = (None, view.nodes.iter().map(|n| NodeView { warm: BTreeSet::new(), ..n.clone() }));
        let nodes: Vec<NodeView> = nodes.collect();
        if settings.strategy == plan::Strategy::Auto
            && (self.cut.is_none() || (self.live.is_empty() && groups.is_empty()))
        {
            cut = Some(plan::cut::choose(&view)).filter(|c| Some(c) != self.cut.as_ref());
        }
        if let Some(cut) = &cut {
            (view.cut, view.nodes) = (cut, &nodes);
        }
        let plan = plan::plan(&view);
        let keys = |a: &Assignment| a.groups.iter().map(|&g| groups[g].key.clone()).collect();
        let plan = plan.into_iter().map(|a| (keys(&a), a)).map(|(keys, a)| (a, keys)).collect();
        if cut.is_some() {
            self.windows.iter_mut().for_each(BTreeSet::clear);
            self.cut = cut;
        }
        plan
    }

    /// The nodes as the planner sees them.
    fn nodes_as_seen(&self, executor: &dyn Executor) -> Vec<NodeView> {
        let settings = self.shared.settings;
        let node = |(n, spec): (usize, &NodeSpec)| {
            let memory = self.shared.nodes.memory(n as u32);
            let warm = if settings.strategy == plan::Strategy::Auto {
                self.windows[n].clone()
            } else {
                memory.warm().into_iter().map(|s| self.rank[s as usize]).collect()
            };
            let up = |slots| if executor.is_up(n as u32) { slots } else { 0 };
            NodeView { slots: up(spec.slots), free: up(self.free[n]), memory: memory.capacity(), warm }
        };
        settings.nodes.iter().enumerate().map(node).collect()
    }

    /// Remembers the window that a node of `auto` is to hold: beside what it holds if there is room, else instead of it.
    fn hold(&mut self, node: u32, ranks: &[u32]) {
        let scene = self.shared.scene;
        let held = &mut self.windows[node as usize];
        let both: BTreeSet<u32> = held.iter().chain(ranks).copied().collect();
        let bytes: u64 = both.iter().map(|&r| scene.split_bytes(self.order[r as usize])).sum();
        let beside = bytes <= self.shared.nodes.memory(node).capacity() && !self.cut.as_ref().is_none_or(Vec::is_empty);
        *held = if beside { both } else { ranks.iter().copied().collect() };
    }

    /// Starts a task as planned; false if there was nothing left for it to do.
    fn start(&mut self, executor: &dyn Executor, (plan, groups): (Assignment, Vec<String>)) -> Result<bool, JobError> {
        let camera = plan.camera.map_or_else(Vec::new, |(rays, from)| self.cameras.take(rays, &from));
        if groups.is_empty() && camera.is_empty() {
            return Ok(false);
        }
        let set = match plan.set {
            Set::Resident(ranks) => {
                self.hold(plan.node, &ranks);
                let mut splits: Vec<u32> = ranks.into_iter().map(|r| self.order[r as usize]).collect();
                splits.sort_unstable();
                Set::Resident(splits)
            }
            Set::Sharing(rank) => Set::Sharing(self.order[rank as usize]),
            other => other,
        };
        let (task, groups) = self.ledger.start(&Inputs { groups, camera: camera.clone() })?;
        let name = format!("{}-t{:08}", self.session, task.0);
        let spec = Attempt { name, node: plan.node, set, groups, camera };
        let node = plan.node;
        self.running.insert(task, Running { spec, started: Instant::now(), attempts: 0 });
        self.launch(executor, task, node);
        Ok(true)
    }

    /// Starts an attempt of a running task.
    fn launch(&mut self, executor: &dyn Executor, task: TaskId, node: u32) {
        let Some(running) = self.running.get_mut(&task) else { return };
        let number = running.attempts;
        running.attempts += 1;
        let attempt = Attempt { name: format!("{}-a{number}", running.spec.name), node, ..running.spec.clone() };
        let stop = StopFlag::new(None);
        self.free[node as usize] -= 1;
        self.live.insert((task, number), Live { node, stop: stop.clone() });
        executor.launch(Launch { task, number, attempt, stop });
    }

    /// Starts a second attempt of tasks that take much longer than others did, where nothing else is to be done.
    fn second_attempts(&mut self, executor: &dyn Executor) {
        let settings = self.shared.settings;
        let late = settings.straggler_seconds.unwrap_or((3.0 * settings.task_seconds).max(1.0));
        let slow = self.running.iter().filter(|(_, r)| r.attempts < 2 && r.started.elapsed().as_secs_f64() > late);
        let slow: Vec<TaskId> = slow.map(|(&t, _)| t).collect();
        for task in slow {
            if !executor.has_room() {
                return;
            }
            let Some(first) = self.live.iter().find(|(k, _)| k.0 == task).map(|(_, l)| l.node) else { continue };
            let same_window = |n: u32| match &self.running[&task].spec.set {
                Set::Resident(set) if settings.strategy == plan::Strategy::Auto => {
                    let held = &self.windows[n as usize];
                    let moving = self.cut.as_ref().is_none_or(Vec::is_empty);
                    set.iter().all(|&s| held.contains(&self.rank[s as usize])) && (!moving || held.len() == set.len())
                }
                _ => true,
            };
            let nodes = (0..self.free.len() as u32)
                .filter(|&n| self.free[n as usize] > 0 && executor.is_up(n) && same_window(n));
            // on another node, if there is one
            if let Some(node) = nodes.max_by_key(|&n| (n != first, self.free[n as usize]))
                && self.ledger.again(task).is_ok()
            {
                self.launch(executor, task, node);
            }
        }
    }

    fn handle(&mut self, finished: Finished) -> Result<(), JobError> {
        let Finished { task, number, result, cpu, bytes } = finished;
        let Some(live) = self.live.remove(&(task, number)) else {
            return Err(JobError::Internal("an attempt reports that was never started".into()));
        };
        self.free[live.node as usize] += 1;
        self.shared.nodes.busy(live.node, cpu);
        self.shared.nodes.count_all(live.node, &bytes);
        let made = match result {
            Ok(made) => made,
            Err(JobError::Stopped) => return self.lost(task, number),
            // what a task that does not run any more read may be gone by right
            Err(e @ JobError::Lost { .. }) if self.running.contains_key(&task) => return self.go_back(&e),
            Err(JobError::Lost { .. }) => return Ok(()),
            // another attempt has done the work
            Err(e) if !self.running.contains_key(&task) && !matches!(e, JobError::Internal(_)) => {
                tracing::warn!("a second attempt failed after the first was committed: {e}");
                return Ok(());
            }
            Err(e) => return Err(e),
        };
        self.commit(task, number, made, cpu)
    }

    /// An attempt that does not count. If it was the task's last one, its inputs wait again.
    fn lost(&mut self, task: TaskId, number: u32) -> Result<(), JobError> {
        if self.ledger.lost(task, number)
            && let Some(running) = self.running.remove(&task)
        {
            self.cameras.give_back(&running.spec.camera);
        }
        Ok(())
    }

    fn commit(&mut self, task: TaskId, number: u32, made: Made, cpu: f64) -> Result<(), JobError> {
        let settled = self.ledger.is_settled();
        let record = match self.ledger.record(task, made.outputs.clone()) {
            Ok(record) => record,
            // beaten by another attempt, or arrived twice
            Err(Refused::NotRunning(_)) if self.committed.contains(&(task, number)) => return Ok(()),
            Err(Refused::NotRunning(_)) => return self.discard(&made.outputs),
            Err(e) => return Err(e.into()),
        };
        if settled && !record.made.groups.is_empty() {
            self.settled = self.ledger.snapshot(None);
            self.film.settle();
        }
        let name = self.write(&record)?;
        self.ledger.commit(task, &record, name)?;
        self.committed.insert((task, number));
        self.film.add(&made)?;
        let made_rays = record.made.rays;
        self.rate.add(cpu, made_rays.closest + made_rays.shadow, made_rays.camera);
        self.tasks += 1;
        let bytes = record.made.groups.iter().map(|g| g.bytes).sum::<u64>();
        let windows = self.cut.as_ref().map_or(0, Vec::len).max(1);
        self.traffic.add(made_rays.camera, made_rays.closest + made_rays.shadow, windows, made.hops, bytes);
        self.hops += made.hops;
        self.hop_bytes += bytes;
        if let Some(film) = record.made.film {
            self.superfluous[1].push((film.key, film.holders));
        }
        if let Some(running) = self.running.remove(&task) {
            self.live.iter().filter(|(k, _)| k.0 == task).for_each(|(_, l)| l.stop.set());
            let consumed: Objects = running.spec.groups.into_iter().map(|g| (g.key, g.holders)).collect();
            self.shared.nodes.delete(&consumed)?;
        }
        if self.tasks.is_multiple_of(SNAPSHOT_EVERY) {
            self.write_snapshot()?;
        }
        Ok(())
    }

    /// Makes a record durable, if the job keeps records; its name.
    fn write(&mut self, record: &Record) -> Result<String, JobError> {
        let name = journal::write(&self.shared.nodes, record)?;
        self.pointer.move_to(record.sequence, &name)?;
        self.old_records[1].push(journal::key(record.sequence, &name));
        Ok(name)
    }

    /// Writes the whole state, and deletes what the snapshot before this one made superfluous.
    fn write_snapshot(&mut self) -> Result<(), JobError> {
        let key = self.film_name();
        let nodes = &self.shared.nodes;
        let film = self.film.store(&key)?;
        let record = self.ledger.record_of(self.ledger.snapshot(film.clone()));
        let [old, mut new] = std::mem::take(&mut self.superfluous);
        let [old_records, new_records] = std::mem::take(&mut self.old_records);
        let name = self.write(&record)?;
        self.ledger.follow_snapshot(&record, name)?;
        let (needed, old): (Objects, Objects) = old.into_iter().partition(|(name, _)| self.film.needs(name));
        new.extend(needed);
        nodes.delete(&old)?;
        nodes.wait(nodes.store().delete(&old_records))?;
        self.superfluous = [new, film.into_iter().map(|f| (f.key, f.holders)).collect()];
        self.old_records[0] = new_records;
        Ok(())
    }

    /// Rays were lost with all their copies: back to the last state without rays on their way.
    fn go_back(&mut self, why: &JobError) -> Result<(), JobError> {
        tracing::warn!("{why}; what was committed since no ray was on its way is computed again");
        let before: Objects = self.ledger.snapshot(None).waiting.into_iter().map(|g| (g.key, g.holders)).collect();
        let mut snapshot = self.settled.clone();
        self.film.go_back();
        self.redone += self.ledger.commits() - snapshot.commits;
        let key = self.film_name();
        snapshot.film = self.film.store(&key)?;
        let record = self.ledger.record_of(snapshot);
        let name = self.write(&record)?;
        self.ledger.go_back(&record, name)?;
        self.stop_all();
        self.running.clear();
        self.cameras.clear();
        self.cameras.add(0..self.queued, self.ledger.taken());
        self.shared.nodes.delete(&before)
    }

    /// Deletes what an attempt made that does not count.
    fn discard(&mut self, outputs: &Outputs) -> Result<(), JobError> {
        let groups = outputs.groups.iter().map(|g| (g.key.clone(), g.holders.clone()));
        let film = outputs.film.iter().map(|f| (f.key.clone(), f.holders.clone()));
        self.shared.nodes.delete(&groups.chain(film).collect::<Objects>())
    }

    /// A name that no film of this run has.
    fn film_name(&mut self) -> String {
        self.stored += 1;
        format!("film/{}-s{:08}", self.session, self.stored)
    }

    /// Tells all attempts to stop.
    pub fn stop_all(&mut self) {
        self.live.values().for_each(|l| l.stop.set());
    }

    fn tell(&self) {
        let [w, h] = self.shared.frame.size;
        let pixels = u64::from(w) * u64::from(h);
        let rays = self.ledger.rays();
        self.progress.status(&Status {
            elapsed: self.start.elapsed(),
            rays,
            taken_over: self.taken_over,
            samples: rays.camera,
            samples_total: pixels * u64::from(self.sampling.spp),
            waiting: self.ledger.waiting().map(|g| u64::from(g.rays)).sum(),
            rounds: if self.shared.settings.has_barrier() { self.rounds } else { self.ledger.commits() },
            error: self.error,
        });
    }

    /// What was made, after [`Driver::run`]: the film, its samples per pixel, the report.
    ///
    /// # Errors
    /// When the last state cannot be written.
    pub fn finish(mut self) -> Result<(F, u32, Report), JobError> {
        self.write_snapshot()?;
        let spp = self.ledger.done().complete();
        let [width, height] = self.shared.frame.size;
        let settings = self.shared.settings;
        let counts = &self.shared.scene.manifest.counts;
        let rel_mse = self.film.rel_mse(spp)?;
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
            tasks_redone: self.redone,
            tasks_reused: self.reused,
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
            non_finite: self.ledger.non_finite(),
            rel_mse,
            target_reached: self.sampling.target_error.map(|t| rel_mse.is_some_and(|e| e <= t)),
            nodes_detail,
            skipped: skipped.into_iter().map(|(k, v)| (k.to_owned(), v)).collect(),
            ..Report::default()
        };
        report.set_bytes(&bytes);
        Ok((self.film, spp, report))
    }
}
