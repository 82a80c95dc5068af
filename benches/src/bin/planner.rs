//! The planner alone on a cluster that nobody has at hand: a job of 1 TB on 1,000 nodes, simulated without tracing.
//!
//! `planner [--nodes 1000] [--slots 16] [--terabytes 1] [--split-mib 64] [--rounds 40]` deals the camera rays of a picture to nodes that hold nothing yet, lets
//! tasks end, each of whose rays leads to half another one, of which one in four leaves its task's splits, and plans again. By strategy, and for `auto` by
//! memory: what all nodes hold several times, and what they do not hold. With a barrier all tasks of a round end together and each plan sees every slot free;
//! without one so many tasks end before each plan as finish in the time that a plan takes. Figures: milliseconds of this thread's CPU for a plan.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Context;
use rayherd_api::Strategy;
use rayherd_benches::{median, thread_cpu};
use rayherd_herd::plan::cost::Traffic;
use rayherd_herd::plan::{Assignment, NodeView, Set, SplitView, View, Waiting, Window, cut, place, plan};

/// Rays of a group, as the wire has them at most.
const GROUP: u64 = 65_536;
/// Other splits that a task's rays leave for.
const TARGETS: u64 = 32;

struct Settings {
    nodes: u32,
    slots: u32,
    splits: u32,
    bytes: u64,
    rounds: usize,
}

fn main() -> anyhow::Result<()> {
    let mut numbers =
        BTreeMap::from([("nodes", 1000), ("slots", 16), ("terabytes", 1), ("split-mib", 64), ("rounds", 40)]);
    let mut args = std::env::args().skip(1);
    while let Some(name) = args.next() {
        let known = name.strip_prefix("--").and_then(|n| numbers.get_mut(n));
        let value = known.with_context(|| format!("{name}: not one of nodes, slots, terabytes, split-mib, rounds"))?;
        let text = args.next().with_context(|| format!("{name} wants a number"))?;
        *value = text.parse::<u64>().with_context(|| format!("{name} {text}: no number"))?;
    }
    let bytes = numbers["split-mib"].max(1) << 20;
    let settings = Settings {
        nodes: numbers["nodes"].try_into()?,
        slots: numbers["slots"].try_into()?,
        splits: (numbers["terabytes"] * 1_000_000_000_000).div_ceil(bytes).try_into()?,
        bytes,
        rounds: numbers["rounds"] as usize,
    };
    println!("{} nodes of {} slots, {} splits of {} MiB", settings.nodes, settings.slots, settings.splits, bytes >> 20);
    println!(
        "| strategy | memory of a node | tasks that end before a plan | plans | tasks | cut, ms | plan, ms: median | most |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let scene = bytes * u64::from(settings.splits);
    let each = scene / u64::from(settings.nodes.max(1));
    let some = 16.min(settings.nodes as usize * settings.slots as usize);
    for (strategy, memory, end) in [
        (Strategy::DemandDriven, 4 * each, usize::MAX),
        (Strategy::SchedulingGrid, 4 * each, usize::MAX),
        (Strategy::SchedulingGridOverlapReduced, 4 * each, usize::MAX),
        (Strategy::Auto, 32 * each, usize::MAX),
        (Strategy::Auto, 32 * each, some),
        (Strategy::Auto, 4 * each, usize::MAX),
        (Strategy::Auto, 4 * each, some),
        (Strategy::Auto, each / 2, usize::MAX),
        (Strategy::Auto, each / 2, some),
    ] {
        Simulation::new(&settings, strategy, memory.max(bytes)).run(&settings, end)?;
    }
    Ok(())
}

struct Simulation {
    strategy: Strategy,
    splits: Vec<SplitView>,
    nodes: Vec<NodeView>,
    waiting: BTreeMap<u32, Vec<Waiting>>,
    camera: BTreeMap<u32, u64>,
    cut: Vec<Window>,
    running: Vec<(Assignment, u64)>,
    groups: BTreeMap<usize, (u32, u64)>,
    random: u64,
}

impl Simulation {
    fn new(settings: &Settings, strategy: Strategy, memory: u64) -> Simulation {
        let sizes = vec![settings.bytes; settings.splits as usize];
        let holders = place::holders(&sizes, settings.nodes, 2);
        let node = || NodeView { slots: settings.slots, free: settings.slots, memory, warm: BTreeSet::new() };
        // a third of the splits is in view: 4096 x 4096 pixels at 256 samples
        let seen = settings.splits.div_ceil(3).max(1);
        Simulation {
            strategy,
            splits: holders.into_iter().map(|holders| SplitView { bytes: settings.bytes, holders }).collect(),
            nodes: (0..settings.nodes).map(|_| node()).collect(),
            waiting: BTreeMap::new(),
            camera: (0..seen).map(|s| (s, (1 << 32) / u64::from(seen))).collect(),
            cut: Vec::new(),
            running: Vec::new(),
            groups: BTreeMap::new(),
            random: 1,
        }
    }

    fn view(&self) -> View<'_> {
        View {
            strategy: self.strategy,
            splits: &self.splits,
            nodes: &self.nodes,
            waiting: self.waiting.clone(),
            reduce: Vec::new(),
            camera: self.camera.clone(),
            // ten seconds of a slot
            task_rays: 10_000_000,
            task_camera: 5_000_000,
            least_rays: 16_384,
            replicas: 2,
            forest: 8 << 30,
            cut: &self.cut,
            traffic: Traffic::default(),
        }
    }

    fn run(mut self, settings: &Settings, end: usize) -> anyhow::Result<()> {
        let start = thread_cpu();
        if self.strategy == Strategy::Auto {
            self.cut = cut::choose(&self.view());
        }
        let choosing = thread_cpu() - start;
        let (mut times, mut tasks) = (Vec::new(), 0);
        while times.len() < settings.rounds {
            let view = self.view();
            let start = thread_cpu();
            let planned = plan(&view);
            times.push(thread_cpu() - start);
            if planned.is_empty() && self.running.is_empty() {
                break;
            }
            tasks += planned.len();
            planned.into_iter().for_each(|a| self.start(a));
            for _ in 0..end.min(self.running.len()) {
                let at = self.number() as usize % self.running.len();
                let (task, rays) = self.running.swap_remove(at);
                self.end(&task, rays);
            }
        }
        let most = times.iter().copied().fold(0.0, f64::max);
        let ending = if end == usize::MAX { "all".to_owned() } else { end.to_string() };
        let memory = self.nodes.first().map_or(0, |n| n.memory) as f64 / (1u64 << 30) as f64;
        println!(
            "| {} | {memory:.1} GiB | {ending} | {} | {tasks} | {:.1} | {:.2} | {:.2} |",
            self.strategy,
            times.len(),
            choosing * 1e3,
            median(times) * 1e3,
            most * 1e3
        );
        Ok(())
    }

    /// SplitMix64.
    fn number(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn set(&self, task: &Assignment) -> Vec<u32> {
        match &task.set {
            Set::Resident(splits) => splits.clone(),
            Set::Sharing(split) => vec![*split],
            Set::Any | Set::Reduce => Vec::new(),
        }
    }

    fn start(&mut self, task: Assignment) {
        let mut rays = 0;
        for id in &task.groups {
            if let Some((split, of)) = self.groups.remove(id) {
                rays += of;
                if let Some(queue) = self.waiting.get_mut(&split) {
                    queue.retain(|g| g.id != *id);
                }
            }
        }
        self.waiting.retain(|_, q| !q.is_empty());
        let set = self.set(&task);
        if let Some((mut left, from)) = task.camera.clone() {
            let from: Vec<u32> = if !from.is_empty() {
                from
            } else if set.is_empty() {
                self.camera.keys().copied().collect()
            } else {
                set.clone()
            };
            for s in from {
                let made = self.camera.get(&s).map_or(0, |&c| c.min(left));
                self.camera.entry(s).and_modify(|c| *c -= made);
                (left, rays) = (left - made, rays + made);
                if left == 0 {
                    break;
                }
            }
            self.camera.retain(|_, c| *c > 0);
        }
        let node = &mut self.nodes[task.node as usize];
        node.free -= 1;
        // as the driver remembers: beside what is held where there is room, else instead of it
        let mut both = node.warm.clone();
        both.extend(&set);
        let bytes: u64 = both.iter().map(|&s| self.splits[s as usize].bytes).sum();
        let beside = bytes <= node.memory && !(self.strategy == Strategy::Auto && self.cut.is_empty());
        node.warm = if beside { both } else { set.into_iter().collect() };
        self.running.push((task, rays));
    }

    fn end(&mut self, task: &Assignment, rays: u64) {
        self.nodes[task.node as usize].free += 1;
        let set = self.set(task);
        // what runs dry in its task stays there; a quarter of all, with what it leads to, leaves
        let leaves = rays / 4;
        if set.is_empty() || leaves == 0 {
            return;
        }
        let near = set[0];
        for k in 0..TARGETS.min(leaves.div_ceil(1024)) {
            // mostly neighbours along the curve
            let far = self.number() % if k % 4 == 0 { u64::from(self.splits.len() as u32) } else { 256 };
            let to = ((u64::from(near) + far) % self.splits.len() as u64) as u32;
            if set.contains(&to) {
                continue;
            }
            let mut left = leaves / TARGETS;
            while left > 0 {
                let rays = left.min(GROUP);
                left -= rays;
                let id = self.groups.last_key_value().map_or(0, |(id, _)| id + 1);
                self.groups.insert(id, (to, rays));
                self.waiting.entry(to).or_default().push(Waiting { id, rays });
            }
        }
    }
}
