//! `auto`: windows of neighbouring splits, kept warm; rays wait only for what is in another window.
//!
//! One idea with two ends. The scene is cut into windows ([`super::cut`]), each of which lies on one node at first. A
//! node with nothing to do takes a copy of a window where work waits, if its share of that work is worth more than
//! loading the window. With one window each node that joins in holds the whole scene and no ray is ever queued; with as
//! many windows as nodes the scene is read once. What does not fit all nodes together is [`super::moving`]'s.

use std::cmp::Reverse;
use std::ops::Range;

use super::cost::{RAY, REMOTE};
use super::{Assignment, Set, View, Waiting, free_slots, take};

/// The windows of a cut, with what there is to do in each.
pub(super) struct Windows<'c> {
    cut: &'c [Range<u32>],
    bytes: Vec<u64>,
    /// Rays that are expected: those that wait, and camera rays to be made with all that follows from them.
    pub(super) work: Vec<f64>,
    groups: Vec<Vec<Waiting>>,
    camera: Vec<u64>,
    /// Nodes that hold it.
    on: Vec<Vec<u32>>,
    /// Bytes that each node holds.
    used: Vec<u64>,
}

impl<'c> Windows<'c> {
    pub(super) fn new(view: &View, cut: &'c [Range<u32>]) -> Self {
        let mut w = Windows {
            cut,
            bytes: Vec::new(),
            work: Vec::new(),
            groups: Vec::new(),
            camera: Vec::new(),
            on: Vec::new(),
            used: view.nodes.iter().map(|n| n.warm.iter().map(|&s| view.splits[s as usize].bytes).sum()).collect(),
        };
        for window in cut {
            let splits = &view.splits[window.start as usize..window.end as usize];
            let mut groups: Vec<Waiting> = view.waiting.range(window.clone()).flat_map(|(_, g)| g).copied().collect();
            groups.sort_by_key(|g| (Reverse(g.rays), g.id));
            let camera: u64 = view.camera.range(window.clone()).map(|(_, c)| c).sum();
            let waiting: u64 = groups.iter().map(|g| g.rays).sum();
            let holds = |n: &u32| {
                let node = &view.nodes[*n as usize];
                node.slots > 0 && node.warm.range(window.clone()).count() == window.len()
            };
            w.bytes.push(splits.iter().map(|s| s.bytes).sum());
            w.work.push(waiting as f64 + camera as f64 * view.traffic.rays_per_camera());
            w.groups.push(groups);
            w.camera.push(camera);
            w.on.push((0..view.nodes.len() as u32).filter(holds).collect());
        }
        w
    }

    /// Windows by falling work.
    fn busiest(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.cut.len()).collect();
        order.sort_by(|&a, &b| self.work[b].total_cmp(&self.work[a]).then(a.cmp(&b)));
        order
    }

    /// What loading a window onto a node costs.
    fn load(&self, view: &View, j: usize, node: u32) -> u64 {
        let splits = &view.splits[self.cut[j].start as usize..self.cut[j].end as usize];
        splits.iter().map(|s| if s.holders.contains(&node) { s.bytes } else { REMOTE * s.bytes }).sum()
    }

    fn slots(&self, view: &View, j: usize) -> f64 {
        self.on[j].iter().map(|&n| view.slots(n)).sum()
    }

    /// What is won by one more node for a window, less what loading it costs.
    fn gain(&self, view: &View, j: usize, node: u32) -> f64 {
        let own = view.slots(node);
        let share = self.work[j] * own / (self.slots(view, j) + own);
        share * RAY as f64 - self.load(view, j, node) as f64
    }

    /// The best place for a window that nobody holds: few bytes to load, many slots.
    fn place(&self, view: &View, j: usize, nodes: impl Iterator<Item = u32>) -> Option<u32> {
        let cost = |n: u32| self.load(view, j, n) as f64 + self.work[j] / view.slots(n) * RAY as f64;
        nodes.map(|n| (cost(n), n)).min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).map(|c| c.1)
    }

    fn holds(&self, node: u32) -> bool {
        self.on.iter().any(|on| on.contains(&node))
    }

    fn has_room(&self, view: &View, j: usize, node: u32) -> bool {
        self.used[node as usize].saturating_add(self.bytes[j]) <= view.nodes[node as usize].memory
    }

    fn give(&mut self, j: usize, node: u32) {
        self.on[j].push(node);
        self.used[node as usize] += self.bytes[j];
    }

    /// Lets go of all that a node holds.
    fn clear(&mut self, node: u32) {
        self.on.iter_mut().for_each(|on| on.retain(|&n| n != node));
        self.used[node as usize] = 0;
    }

    /// Whether every window of a node lies on another one too, or nothing is left to do in it.
    fn is_spare(&self, node: u32) -> bool {
        self.on.iter().zip(&self.work).all(|(on, &work)| work == 0.0 || !on.contains(&node) || on.len() > 1)
    }

    /// Where the windows would lie if nothing were lacking but time, and what loading them would cost.
    pub(super) fn tried_out(mut self, view: &View) -> (Vec<Vec<u32>>, f64) {
        let live: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].slots > 0).collect();
        if self.cut != view.cut {
            live.iter().for_each(|&n| self.clear(n));
        }
        let mut load = 0;
        for j in self.busiest() {
            if self.on[j].is_empty() {
                let room = live.iter().copied().filter(|&n| self.has_room(view, j, n));
                let empty = live.iter().copied().filter(|&n| !self.holds(n) && self.has_room(view, j, n));
                if let Some(n) = self.place(view, j, empty).or_else(|| self.place(view, j, room)) {
                    load += self.load(view, j, n);
                    self.give(j, n);
                }
            }
        }
        let own = |w: &Self, n: u32| -> f64 {
            let held = (0..w.cut.len()).filter(|&j| w.on[j].contains(&n));
            held.map(|j| w.work[j] / w.slots(view, j)).sum()
        };
        let mut order: Vec<(f64, u32)> = live.iter().map(|&n| (own(&self, n), n)).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for (_, n) in order {
            // a node with work of its own as long as others have theirs is not idle
            let busy = own(&self, n);
            let idle = |w: &Self, j: usize| busy < 0.5 * w.work[j] / w.slots(view, j);
            let better = (0..self.cut.len()).filter(|&j| {
                !self.on[j].contains(&n) && !self.on[j].is_empty() && self.has_room(view, j, n) && idle(&self, j)
            });
            let best =
                better.map(|j| (self.gain(view, j, n), j)).max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
            if let Some((gain, j)) = best
                && gain > 0.0
            {
                load += self.load(view, j, n);
                self.give(j, n);
            }
        }
        (self.on, load as f64)
    }
}

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut windows = Windows::new(view, view.cut);
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let least = if idle { 1 } else { view.least_rays };
    let ready = |w: &Windows, j: usize| w.camera[j] > 0 || w.groups[j].iter().map(|g| g.rays).sum::<u64>() >= least;
    let rests = |n: u32| view.nodes[n as usize].free == view.nodes[n as usize].slots;
    let free: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].free > 0).collect();

    // windows that nobody holds
    for j in windows.busiest() {
        if !windows.on[j].is_empty() || !ready(&windows, j) {
            continue;
        }
        let empty = free.iter().copied().filter(|&n| !windows.holds(n) && windows.has_room(view, j, n));
        let room = free.iter().copied().filter(|&n| windows.has_room(view, j, n));
        if let Some(n) = windows.place(view, j, empty).or_else(|| windows.place(view, j, room)) {
            windows.give(j, n);
            continue;
        }
        // in the place of what others hold too
        let holds = |n: &u32| rests(*n) && windows.bytes[j] <= view.nodes[*n as usize].memory;
        let spare = free.iter().copied().filter(|n| holds(n) && windows.is_spare(*n));
        let any = free.iter().copied().filter(|n| idle && holds(n));
        if let Some(n) = windows.place(view, j, spare).or_else(|| windows.place(view, j, any)) {
            windows.clear(n);
            windows.give(j, n);
        }
    }
    // copies on nodes that have nothing to do
    for &n in &free {
        if (0..windows.cut.len()).any(|j| windows.on[j].contains(&n) && ready(&windows, j)) {
            continue;
        }
        let may = |j: usize| {
            let room = windows.has_room(view, j, n);
            let instead = rests(n) && windows.is_spare(n) && windows.bytes[j] <= view.nodes[n as usize].memory;
            ready(&windows, j) && !windows.on[j].is_empty() && (room || instead)
        };
        let better = (0..windows.cut.len()).filter(|&j| may(j)).map(|j| (windows.gain(view, j, n), j));
        if let Some((gain, j)) = better.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
            && gain > 0.0
        {
            if !windows.has_room(view, j, n) {
                windows.clear(n);
            }
            windows.give(j, n);
        }
    }
    deal(view, windows, least)
}

/// Deals groups, and camera rays where no groups wait, to the free slots of the nodes that hold them.
fn deal(view: &View, mut windows: Windows, least: u64) -> Vec<Assignment> {
    let mut out = Vec::new();
    for node in free_slots(view.nodes).into_iter().rev() {
        let held = (0..windows.cut.len()).filter(|&j| windows.on[j].contains(&node));
        let rays = |j: usize| windows.groups[j].iter().map(|g| g.rays).sum::<u64>();
        let waiting = held.clone().map(|j| (rays(j), j)).filter(|w| w.0 >= least);
        let most = waiting.max_by_key(|&(rays, j)| (rays, Reverse(j)));
        let to_make = held.map(|j| (windows.camera[j], j)).filter(|c| c.0 > 0).max_by_key(|&(c, j)| (c, Reverse(j)));
        let Some((_, j)) = most.or(to_make) else { continue };
        let (slots, window) = (windows.slots(view, j) as u64, windows.cut[j].clone());
        let set = Set::Resident(window.clone().collect());
        if let Some((rays, _)) = most {
            let share = rays.div_ceil(slots).max(view.least_rays).min(view.task_rays);
            let taken = take(&mut windows.groups[j].iter().copied(), share);
            windows.groups[j].drain(..taken.len());
            out.push(Assignment { node, set, groups: taken, camera: None });
        } else {
            // guided: a share of what is left, so that slots end together
            let share = windows.camera[j].div_ceil(2 * slots).clamp(1, view.task_camera.max(1));
            windows.camera[j] -= share.min(windows.camera[j]);
            let from = if windows.cut.len() == 1 { Vec::new() } else { window.collect() };
            out.push(Assignment { node, set, groups: vec![], camera: Some((share, from)) });
        }
    }
    out
}
