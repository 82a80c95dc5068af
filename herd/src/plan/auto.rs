//! `auto`: windows of neighbouring splits, kept warm; rays wait only for what is in no window of the node where they are.
//!
//! One idea with two ends. The scene is cut into windows ([`super::cut`]), each of which lies on one node at first, where its copies
//! are on disk if there is such a node. A node with nothing to do takes a window where work waits, if its share of that work is
//! worth more than loading the window: one that lies on its disk before any other. With one window each node that joins in holds the
//! whole scene and no ray is ever queued; with as many windows as nodes the scene is read once. Windows may overlap: then each
//! split's rays go to whichever node that holds it is free. What does not fit all nodes together is [`super::moving`]'s.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use super::cost::{RAY, REMOTE};
use super::{Assignment, Set, SplitView, View, Waiting, Window, free_slots, take};

/// The windows of a cut, who holds them, and what there is to do in each split.
pub(super) struct Windows<'c> {
    cut: &'c [Window],
    bytes: Vec<u64>,
    /// By split: rays that are expected ([`expected`]).
    work: Vec<f64>,
    /// By split: groups that wait.
    groups: Vec<Vec<Waiting>>,
    /// By split: camera rays to be made.
    camera: Vec<u64>,
    /// By window: nodes that hold it. What a node holds does not overlap.
    on: Vec<Vec<u32>>,
    /// By split: slots of the nodes that hold it.
    slots: Vec<u64>,
    /// By node: bytes that it holds.
    used: Vec<u64>,
}

/// Rays that are expected in each split: those that wait, camera rays to be made, and what follows from these. Of what follows, as many
/// as leave a split stay nowhere in particular: they are spread over the scene by bytes, so that a node whose splits no camera ray
/// starts in is not taken to be idle for ever.
fn expected(view: &View, groups: &[Vec<Waiting>], camera: &[u64]) -> Vec<f64> {
    let follow = view.traffic.rays_per_camera() - 1.0;
    let leave = view.traffic.hops_per_ray(view.splits.len() as f64).min(1.0);
    let bytes: u64 = view.splits.iter().map(|s| s.bytes).sum();
    let spread = camera.iter().sum::<u64>() as f64 * follow * leave / bytes.max(1) as f64;
    let of_split = |((split, groups), &camera): ((&SplitView, &Vec<Waiting>), &u64)| {
        let waiting: u64 = groups.iter().map(|g| g.rays).sum();
        waiting as f64 + camera as f64 * (1.0 + follow * (1.0 - leave)) + spread * split.bytes as f64
    };
    view.splits.iter().zip(groups).zip(camera).map(of_split).collect()
}

impl<'c> Windows<'c> {
    pub(super) fn new(view: &View, cut: &'c [Window]) -> Self {
        let splits = view.splits.len();
        let size = |s: &u32| view.splits[*s as usize].bytes;
        let groups: Vec<Vec<Waiting>> =
            (0..splits as u32).map(|s| view.waiting.get(&s).cloned().unwrap_or_default()).collect();
        let camera: Vec<u64> = (0..splits as u32).map(|s| view.camera.get(&s).copied().unwrap_or(0)).collect();
        let mut windows = Windows {
            cut,
            bytes: cut.iter().map(|w| w.iter().map(size).sum()).collect(),
            work: expected(view, &groups, &camera),
            groups,
            camera,
            on: vec![Vec::new(); cut.len()],
            slots: vec![0; splits],
            used: view.nodes.iter().map(|n| n.warm.iter().map(size).sum()).collect(),
        };
        for (n, node) in (0u32..).zip(view.nodes).filter(|(_, node)| node.slots > 0) {
            let mut held: BTreeSet<u32> = BTreeSet::new();
            for (j, window) in cut.iter().enumerate() {
                if window.iter().all(|s| node.warm.contains(s) && !held.contains(s)) {
                    held.extend(window);
                    windows.mark(view, j, n);
                }
            }
        }
        windows
    }

    fn mark(&mut self, view: &View, j: usize, node: u32) {
        self.on[j].push(node);
        self.cut[j].iter().for_each(|&s| self.slots[s as usize] += u64::from(view.nodes[node as usize].slots));
    }

    fn give(&mut self, view: &View, j: usize, node: u32) {
        self.mark(view, j, node);
        self.used[node as usize] += self.bytes[j];
    }

    /// Lets go of all that a node holds.
    fn clear(&mut self, view: &View, node: u32) {
        for (window, on) in self.cut.iter().zip(&mut self.on) {
            let before = on.len();
            on.retain(|&n| n != node);
            if on.len() < before {
                let slots = u64::from(view.nodes[node as usize].slots);
                window.iter().for_each(|&s| self.slots[s as usize] -= slots);
            }
        }
        self.used[node as usize] = 0;
    }

    fn work_in(&self, j: usize) -> f64 {
        self.cut[j].iter().map(|&s| self.work[s as usize]).sum()
    }

    fn rays_in(&self, j: usize) -> u64 {
        self.cut[j].iter().flat_map(|&s| &self.groups[s as usize]).map(|g| g.rays).sum()
    }

    fn camera_in(&self, j: usize) -> u64 {
        self.cut[j].iter().map(|&s| self.camera[s as usize]).sum()
    }

    /// Windows by falling work.
    fn busiest(&self) -> Vec<usize> {
        let mut order: Vec<(f64, usize)> = (0..self.cut.len()).map(|j| (self.work_in(j), j)).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        order.into_iter().map(|o| o.1).collect()
    }

    /// What loading a window onto a node costs, and whether all of it lies on the node's disk.
    fn load(&self, view: &View, j: usize, node: u32) -> (u64, bool) {
        let splits = self.cut[j].iter().map(|&s| &view.splits[s as usize]);
        let far: u64 = splits.filter(|s| !s.holders.contains(&node)).map(|s| s.bytes).sum();
        (self.bytes[j] + (REMOTE - 1) * far, far == 0)
    }

    /// What is won by one more node for a window, less what loading it costs; after whether it lies on the node's disk, as that
    /// comes first.
    fn gain(&self, view: &View, j: usize, node: u32) -> (bool, f64) {
        let own = view.slots(node);
        let share = |&s: &u32| self.work[s as usize] * own / (self.slots[s as usize] as f64 + own);
        let (load, local) = self.load(view, j, node);
        (local, self.cut[j].iter().map(share).sum::<f64>() * RAY as f64 - load as f64)
    }

    /// The window that is worth most to a node, if any is worth its loading.
    fn best(&self, view: &View, node: u32, windows: impl Iterator<Item = usize>) -> Option<usize> {
        let gains = windows.map(|j| (self.gain(view, j, node), j)).filter(|((_, gain), _)| *gain > 0.0);
        let most = gains.max_by(|(a, i), (b, j)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(j.cmp(i)));
        most.map(|m| m.1)
    }

    /// The best place for a window that somebody must hold: on whose disk it lies, else few bytes to load and many slots.
    fn place(&self, view: &View, j: usize, nodes: impl Iterator<Item = u32>) -> Option<u32> {
        let work = self.work_in(j);
        let cost = |n: u32| {
            let (load, local) = self.load(view, j, n);
            (!local, load as f64 + work / view.slots(n) * RAY as f64)
        };
        let least = |a: &((bool, f64), u32), b: &((bool, f64), u32)| {
            a.0.0.cmp(&b.0.0).then(a.0.1.total_cmp(&b.0.1)).then(a.1.cmp(&b.1))
        };
        nodes.map(|n| (cost(n), n)).min_by(least).map(|c| c.1)
    }

    fn holds_any(&self, node: u32) -> bool {
        self.on.iter().any(|on| on.contains(&node))
    }

    /// Whether a node can hold a window beside what it holds.
    fn has_room(&self, view: &View, j: usize, node: u32) -> bool {
        let apart = || {
            let held = self.on.iter().zip(self.cut).filter(|(on, _)| on.contains(&node));
            held.flat_map(|(_, w)| w).all(|s| self.cut[j].binary_search(s).is_err())
        };
        self.used[node as usize].saturating_add(self.bytes[j]) <= view.nodes[node as usize].memory && apart()
    }

    /// Whether every split of a node lies on another one too, or nothing is left to do in it.
    fn is_spare(&self, view: &View, node: u32) -> bool {
        let own = u64::from(view.nodes[node as usize].slots);
        let held = self.on.iter().zip(self.cut).filter(|(on, _)| on.contains(&node));
        held.flat_map(|(_, w)| w).all(|&s| self.work[s as usize] == 0.0 || self.slots[s as usize] > own)
    }

    /// Seconds (in rays of one slot) that a node has to do.
    fn time(&self, node: u32) -> f64 {
        let held = self.on.iter().zip(self.cut).filter(|(on, _)| on.contains(&node));
        let time: f64 = held.flat_map(|(_, w)| w).map(|&s| self.work[s as usize] / self.slots[s as usize] as f64).sum();
        // the sum of nothing is -0, which total_cmp would put before 0
        time + 0.0
    }

    /// Where the windows would lie if nothing were lacking but time: what loading them would cost, and what each node would have to do.
    pub(super) fn tried_out(mut self, view: &View) -> (f64, Vec<f64>) {
        let live: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].slots > 0).collect();
        if self.cut != view.cut {
            live.iter().for_each(|&n| self.clear(view, n));
        }
        let mut load = 0;
        for j in self.busiest() {
            if self.cut[j].iter().all(|&s| self.slots[s as usize] > 0) {
                continue;
            }
            let room = live.iter().copied().filter(|&n| self.has_room(view, j, n));
            let empty = live.iter().copied().filter(|&n| !self.holds_any(n) && self.has_room(view, j, n));
            if let Some(n) = self.place(view, j, empty).or_else(|| self.place(view, j, room)) {
                load += self.load(view, j, n).0;
                self.give(view, j, n);
            }
        }
        let mut order: Vec<(f64, u32)> = live.iter().map(|&n| (self.time(n), n)).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for (_, n) in order {
            // a node with work of its own as long as others have theirs is not idle
            let busy = self.time(n);
            let time = |w: &Self, j: usize| {
                let held = w.cut[j].iter().map(|&s| s as usize).filter(|&s| w.slots[s] > 0);
                held.map(|s| w.work[s] / w.slots[s] as f64).sum::<f64>()
            };
            let may = |&j: &usize| !self.on[j].contains(&n) && self.has_room(view, j, n) && busy < 0.5 * time(&self, j);
            if let Some(j) = self.best(view, n, (0..self.cut.len()).filter(may)) {
                load += self.load(view, j, n).0;
                self.give(view, j, n);
            }
        }
        let times = (0..view.nodes.len() as u32).map(|n| self.time(n)).collect();
        (load as f64, times)
    }
}

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut windows = Windows::new(view, view.cut);
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let least = if idle { 1 } else { view.least_rays };
    let ready = |w: &Windows, j: usize| w.camera_in(j) > 0 || w.rays_in(j) >= least;
    let rests = |n: u32| view.nodes[n as usize].free == view.nodes[n as usize].slots;
    let free: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].free > 0).collect();

    // windows with work that nobody holds
    for j in windows.busiest() {
        let lacking = |&s: &u32| windows.slots[s as usize] == 0 && windows.work[s as usize] > 0.0;
        if !windows.cut[j].iter().any(lacking) || !ready(&windows, j) {
            continue;
        }
        let empty = free.iter().copied().filter(|&n| !windows.holds_any(n) && windows.has_room(view, j, n));
        let room = free.iter().copied().filter(|&n| windows.has_room(view, j, n));
        if let Some(n) = windows.place(view, j, empty).or_else(|| windows.place(view, j, room)) {
            windows.give(view, j, n);
            continue;
        }
        // in the place of what others hold too
        let holds = |n: &u32| rests(*n) && windows.bytes[j] <= view.nodes[*n as usize].memory;
        let spare = free.iter().copied().filter(|n| holds(n) && windows.is_spare(view, *n));
        let any = free.iter().copied().filter(|n| idle && holds(n));
        if let Some(n) = windows.place(view, j, spare).or_else(|| windows.place(view, j, any)) {
            windows.clear(view, n);
            windows.give(view, j, n);
        }
    }
    // windows for nodes that have nothing to do
    for &n in &free {
        if (0..windows.cut.len()).any(|j| windows.on[j].contains(&n) && ready(&windows, j)) {
            continue;
        }
        let may = |&j: &usize| {
            let instead = || rests(n) && windows.is_spare(view, n) && windows.bytes[j] <= view.nodes[n as usize].memory;
            ready(&windows, j) && !windows.on[j].contains(&n) && (windows.has_room(view, j, n) || instead())
        };
        if let Some(j) = windows.best(view, n, (0..windows.cut.len()).filter(may)) {
            if !windows.has_room(view, j, n) {
                windows.clear(view, n);
            }
            windows.give(view, j, n);
        }
    }
    deal(view, windows, least)
}

/// Deals groups, and camera rays where no groups wait, to the free slots of the nodes that hold them.
fn deal(view: &View, mut windows: Windows, least: u64) -> Vec<Assignment> {
    let mut out = Vec::new();
    for node in free_slots(view.nodes).into_iter().rev() {
        let held = (0..windows.cut.len()).filter(|&j| windows.on[j].contains(&node));
        let waiting = held.clone().map(|j| (windows.rays_in(j), j)).filter(|w| w.0 >= least);
        let most = waiting.max_by_key(|&(rays, j)| (rays, Reverse(j)));
        let to_make = held.map(|j| (windows.camera_in(j), j)).filter(|c| c.0 > 0).max_by_key(|&(c, j)| (c, Reverse(j)));
        let Some((_, j)) = most.or(to_make) else { continue };
        let window = &windows.cut[j];
        let set = Set::Resident(window.clone());
        if most.is_some() {
            let rays = |s: u32| windows.groups[s as usize].iter().map(|g| g.rays).sum();
            let share = windows.share(window, rays, 1).max(view.least_rays).min(view.task_rays);
            let mut groups: Vec<Waiting> = window.iter().flat_map(|&s| &windows.groups[s as usize]).copied().collect();
            groups.sort_by_key(|g| (Reverse(g.rays), g.id));
            let taken = take(&mut groups.into_iter(), share);
            let ids: BTreeSet<usize> = taken.iter().copied().collect();
            window.iter().for_each(|&s| windows.groups[s as usize].retain(|g| !ids.contains(&g.id)));
            out.push(Assignment { node, set, groups: taken, camera: None });
        } else {
            // guided: a share of what is left, so that slots end together
            let share = windows.share(window, |s| windows.camera[s as usize], 2).clamp(1, view.task_camera.max(1));
            let mut left = share;
            for &s in window {
                let made = left.min(windows.camera[s as usize]);
                windows.camera[s as usize] -= made;
                left -= made;
            }
            let from = if windows.cut.len() == 1 { Vec::new() } else { window.clone() };
            out.push(Assignment { node, set, groups: vec![], camera: Some((share, from)) });
        }
    }
    out
}

impl Windows<'_> {
    /// What one slot takes of what waits in a window when all slots that hold a split share it, each so many times.
    fn share(&self, window: &[u32], waits: impl Fn(u32) -> u64, times: u64) -> u64 {
        let mut by_slots: BTreeMap<u64, u64> = BTreeMap::new();
        window.iter().for_each(|&s| *by_slots.entry(self.slots[s as usize].max(1)).or_default() += waits(s));
        by_slots.into_iter().map(|(slots, rays)| rays.div_ceil(times * slots)).sum()
    }
}
