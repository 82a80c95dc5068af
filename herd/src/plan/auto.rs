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
use super::queues::{Line, Queues};
use super::{Assignment, Set, SplitView, View, Window, free_slots};

/// The windows of a cut, who holds them, and what there is to do in each split.
pub(super) struct Windows<'c> {
    cut: &'c [Window],
    bytes: Vec<u64>,
    /// By split: the windows that it is in.
    of_split: Vec<Vec<usize>>,
    /// By window: those that it shares a split with, itself among them, ascending.
    beside: Vec<Vec<usize>>,
    /// By window: bytes of it that lie on a node's disk, by ascending node.
    near: Vec<Vec<(u32, u64)>>,
    /// By split: rays that are expected ([`expected`]).
    work: Vec<f64>,
    /// By window: the same.
    work_in: Vec<f64>,
    /// By split: groups that wait.
    queues: Queues,
    /// By split: camera rays to be made.
    camera: Vec<u64>,
    /// By window: rays that wait.
    rays_in: Vec<u64>,
    /// By window: camera rays to be made.
    camera_in: Vec<u64>,
    /// By node: windows that it holds, ascending; they do not overlap.
    held: Vec<Vec<usize>>,
    /// By split: slots of the nodes that hold it.
    slots: Vec<u64>,
    /// By node: bytes that it holds.
    used: Vec<u64>,
}

/// Rays that are expected in each split: those that wait, camera rays to be made, and what follows from these. Of what follows, as many
/// as leave a split stay nowhere in particular: they are spread over the scene by bytes, so that a node whose splits no camera ray
/// starts in is not taken to be idle for ever.
fn expected(view: &View, queues: &Queues, camera: &[u64]) -> Vec<f64> {
    let follow = view.traffic.rays_per_camera() - 1.0;
    let leave = view.traffic.hops_per_ray(view.splits.len() as f64).min(1.0);
    let bytes: u64 = view.splits.iter().map(|s| s.bytes).sum();
    let spread = camera.iter().sum::<u64>() as f64 * follow * leave / bytes.max(1) as f64;
    let of_split = |((split, &waiting), &camera): ((&SplitView, &u64), &u64)| {
        waiting as f64 + camera as f64 * (1.0 + follow * (1.0 - leave)) + spread * split.bytes as f64
    };
    view.splits.iter().zip(&queues.rays).zip(camera).map(of_split).collect()
}

impl<'c> Windows<'c> {
    /// What nodes hold is what is warm, where `warm` says so; else they hold nothing yet.
    pub(super) fn new(view: &View, cut: &'c [Window], warm: bool) -> Self {
        let size = |s: &u32| view.splits[*s as usize].bytes;
        let queues = Queues::new(view);
        let camera: Vec<u64> =
            (0..view.splits.len() as u32).map(|s| view.camera.get(&s).copied().unwrap_or(0)).collect();
        let work = expected(view, &queues, &camera);
        let mut of_split: Vec<Vec<usize>> = vec![Vec::new(); view.splits.len()];
        for (j, window) in cut.iter().enumerate() {
            window.iter().for_each(|&s| of_split[s as usize].push(j));
        }
        let beside = |w: &Window| ascending(w.iter().flat_map(|&s| of_split[s as usize].iter().copied()));
        let mut windows = Windows {
            cut,
            bytes: cut.iter().map(|w| w.iter().map(size).sum()).collect(),
            beside: cut.iter().map(beside).collect(),
            near: cut.iter().map(|w| near(view, w)).collect(),
            work_in: cut.iter().map(|w| w.iter().map(|&s| work[s as usize]).sum()).collect(),
            rays_in: cut.iter().map(|w| w.iter().map(|&s| queues.rays[s as usize]).sum()).collect(),
            camera_in: cut.iter().map(|w| w.iter().map(|&s| camera[s as usize]).sum()).collect(),
            of_split,
            work,
            queues,
            camera,
            held: vec![Vec::new(); view.nodes.len()],
            slots: vec![0; view.splits.len()],
            used: vec![0; view.nodes.len()],
        };
        for (n, node) in (0u32..).zip(view.nodes).filter(|_| warm) {
            windows.used[n as usize] = node.warm.iter().map(size).sum();
            if node.slots == 0 {
                continue;
            }
            let of_split = &windows.of_split;
            for j in ascending(node.warm.iter().flat_map(|&s| of_split[s as usize].iter().copied())) {
                if cut[j].iter().all(|s| node.warm.contains(s)) && windows.is_apart(j, n) {
                    windows.mark(view, j, n);
                }
            }
        }
        windows
    }

    fn mark(&mut self, view: &View, j: usize, node: u32) {
        let held = &mut self.held[node as usize];
        held.insert(held.partition_point(|&h| h < j), j);
        self.cut[j].iter().for_each(|&s| self.slots[s as usize] += u64::from(view.nodes[node as usize].slots));
    }

    fn give(&mut self, view: &View, j: usize, node: u32) {
        self.mark(view, j, node);
        self.used[node as usize] += self.bytes[j];
    }

    /// Lets go of all that a node holds: the windows.
    fn clear(&mut self, view: &View, node: u32) -> Vec<usize> {
        let held = std::mem::take(&mut self.held[node as usize]);
        let slots = u64::from(view.nodes[node as usize].slots);
        held.iter().flat_map(|&j| &self.cut[j]).for_each(|&s| self.slots[s as usize] -= slots);
        self.used[node as usize] = 0;
        held
    }

    /// Windows by falling work.
    fn busiest(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.cut.len()).collect();
        order.sort_by(|&a, &b| self.work_in[b].total_cmp(&self.work_in[a]).then(a.cmp(&b)));
        order
    }

    /// What loading a window onto a node costs, and whether all of it lies on the node's disk.
    fn load(&self, j: usize, node: u32) -> (u64, bool) {
        let near = self.near[j].binary_search_by_key(&node, |n| n.0).map_or(0, |at| self.near[j][at].1);
        let far = self.bytes[j] - near;
        (self.bytes[j] + (REMOTE - 1) * far, far == 0)
    }

    /// What is won by one more node for a window, less what loading it costs; after whether it lies on the node's disk, as that
    /// comes first.
    fn gain(&self, view: &View, worth: &Worth, j: usize, node: u32) -> (bool, f64) {
        let (load, local) = self.load(j, node);
        (local, worth.share(view, j, node) * RAY as f64 - load as f64)
    }

    /// The window that is worth most to a node, if any is worth its loading.
    fn best(&self, view: &View, worth: &Worth, node: u32, windows: impl Iterator<Item = usize>) -> Option<usize> {
        let gains = windows.map(|j| (self.gain(view, worth, j, node), j)).filter(|((_, gain), _)| *gain > 0.0);
        let most = gains.max_by(|(a, i), (b, j)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(j.cmp(i)));
        most.map(|m| m.1)
    }

    /// The best place for a window that somebody must hold, of the nodes that `may`: on whose disk it lies, else few bytes to load and many slots.
    fn place(&self, view: &View, j: usize, pool: &Pool, may: impl Fn(u32) -> bool) -> Option<u32> {
        let cost = |n: u32| {
            let (load, local) = self.load(j, n);
            (!local, load as f64 + self.work_in[j] / view.slots(n) * RAY as f64)
        };
        let least = |a: &((bool, f64), u32), b: &((bool, f64), u32)| {
            a.0.0.cmp(&b.0.0).then(a.0.1.total_cmp(&b.0.1)).then(a.1.cmp(&b.1))
        };
        let is_near = |n: u32| self.near[j].binary_search_by_key(&n, |n| n.0).is_ok();
        let near = self.near[j].iter().map(|n| n.0).filter(|&n| pool.contains(view, n) && may(n));
        // those that have nothing of it differ by their slots alone
        let far = pool.0.values().filter_map(|alike| alike.iter().copied().find(|&n| !is_near(n) && may(n)));
        near.chain(far).map(|n| (cost(n), n)).min_by(least).map(|c| c.1)
    }

    fn holds_any(&self, node: u32) -> bool {
        !self.held[node as usize].is_empty()
    }

    fn holds(&self, j: usize, node: u32) -> bool {
        self.held[node as usize].binary_search(&j).is_ok()
    }

    /// Whether a window shares no split with what a node holds.
    fn is_apart(&self, j: usize, node: u32) -> bool {
        self.held[node as usize].iter().all(|held| self.beside[j].binary_search(held).is_err())
    }

    /// Whether a node can hold a window beside what it holds.
    fn has_room(&self, view: &View, j: usize, node: u32) -> bool {
        self.used[node as usize].saturating_add(self.bytes[j]) <= view.nodes[node as usize].memory
            && self.is_apart(j, node)
    }

    fn splits_on(&self, node: u32) -> impl Iterator<Item = usize> {
        self.held[node as usize].iter().flat_map(move |&j| &self.cut[j]).map(|&s| s as usize)
    }

    /// Whether every split of a node lies on another one too, or nothing is left to do in it.
    fn is_spare(&self, view: &View, node: u32) -> bool {
        let own = u64::from(view.nodes[node as usize].slots);
        self.splits_on(node).all(|s| self.work[s] == 0.0 || self.slots[s] > own)
    }

    /// Seconds (in rays of one slot) that a node has to do.
    fn time(&self, node: u32) -> f64 {
        let time: f64 = self.splits_on(node).map(|s| self.work[s] / self.slots[s] as f64).sum();
        // the sum of nothing is -0, which total_cmp would put before 0
        time + 0.0
    }

    /// Where the windows would lie if nothing were lacking but time: what loading them would cost, and what each node would have to do.
    pub(super) fn tried_out(mut self, view: &View) -> (f64, Vec<f64>) {
        let live: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].slots > 0).collect();
        let pool = Pool::new(view, live.iter().copied());
        let mut empty = Pool::new(view, live.iter().copied().filter(|&n| !self.holds_any(n)));
        let mut load = 0;
        for j in self.busiest() {
            if self.cut[j].iter().all(|&s| self.slots[s as usize] > 0) {
                continue;
            }
            let room = |n: u32| self.has_room(view, j, n);
            if let Some(n) = self.place(view, j, &empty, room).or_else(|| self.place(view, j, &pool, room)) {
                load += self.load(j, n).0;
                self.give(view, j, n);
                empty.remove(view, n);
            }
        }
        let mut order: Vec<(f64, u32)> = live.iter().map(|&n| (self.time(n), n)).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut worth = Worth::new(view, &self);
        for (_, n) in order {
            // a node with work of its own as long as others have theirs is not idle
            let busy = self.time(n);
            let may = |&j: &usize| busy < 0.5 * worth.time[j] && self.has_room(view, j, n);
            if let Some(j) = self.best(view, &worth, n, (0..self.cut.len()).filter(may)) {
                load += self.load(j, n).0;
                self.give(view, j, n);
                worth.refresh(&self, [j]);
            }
        }
        let times = (0..view.nodes.len() as u32).map(|n| self.time(n)).collect();
        (load as f64, times)
    }
}

/// What follows from who holds which splits, by window, kept so that it is not summed up again for each node.
struct Worth {
    /// Kinds of nodes: by their slots, at least 1, the rays of each window that one more of the kind would take over.
    shares: BTreeMap<u32, Vec<f64>>,
    /// What whoever holds a window has to do for it.
    time: Vec<f64>,
}

impl Worth {
    fn new(view: &View, windows: &Windows) -> Worth {
        let count = windows.cut.len();
        let kinds = view.nodes.iter().filter(|n| n.slots > 0).map(|n| (n.slots, vec![0.0; count]));
        let mut worth = Worth { shares: kinds.collect(), time: vec![0.0; count] };
        (0..count).for_each(|j| worth.find(windows, j));
        worth
    }

    fn find(&mut self, windows: &Windows, j: usize) {
        let splits = || windows.cut[j].iter().map(|&s| s as usize);
        for (&own, shares) in &mut self.shares {
            let own = f64::from(own);
            shares[j] = splits().map(|s| windows.work[s] * own / (windows.slots[s] as f64 + own)).sum();
        }
        let held = splits().filter(|&s| windows.slots[s] > 0);
        self.time[j] = held.map(|s| windows.work[s] / windows.slots[s] as f64).sum();
    }

    /// After somebody was given these windows, or let go of them.
    fn refresh(&mut self, windows: &Windows, changed: impl IntoIterator<Item = usize>) {
        for j in changed {
            windows.beside[j].iter().for_each(|&k| self.find(windows, k));
        }
    }

    fn share(&self, view: &View, j: usize, node: u32) -> f64 {
        self.shares.get(&view.nodes[node as usize].slots).map_or(0.0, |shares| shares[j])
    }
}

/// Nodes to choose from, by their slots.
struct Pool(BTreeMap<u32, BTreeSet<u32>>);

impl Pool {
    fn new(view: &View, nodes: impl Iterator<Item = u32>) -> Pool {
        let mut pool = Pool(BTreeMap::new());
        for n in nodes {
            pool.0.entry(view.nodes[n as usize].slots).or_default().insert(n);
        }
        pool
    }

    fn contains(&self, view: &View, node: u32) -> bool {
        view.nodes.get(node as usize).and_then(|n| self.0.get(&n.slots)).is_some_and(|alike| alike.contains(&node))
    }

    fn remove(&mut self, view: &View, node: u32) {
        if let Some(alike) = self.0.get_mut(&view.nodes[node as usize].slots) {
            alike.remove(&node);
        }
    }
}

/// In order, each once.
fn ascending(numbers: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut numbers: Vec<usize> = numbers.collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers
}

/// Bytes of a window that lie on a node's disk, by ascending node.
fn near(view: &View, window: &Window) -> Vec<(u32, u64)> {
    let mut near: Vec<(u32, u64)> = Vec::new();
    for split in window.iter().map(|&s| &view.splits[s as usize]) {
        for (k, holder) in split.holders.iter().enumerate() {
            match near.iter_mut().find(|n| n.0 == *holder) {
                // named twice, it holds it once
                _ if split.holders[..k].contains(holder) => {}
                Some((_, bytes)) => *bytes += split.bytes,
                None => near.push((*holder, split.bytes)),
            }
        }
    }
    near.sort_unstable();
    near
}

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut windows = Windows::new(view, view.cut, true);
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let least = if idle { 1 } else { view.least_rays };
    let ready: Vec<bool> =
        windows.camera_in.iter().zip(&windows.rays_in).map(|(&camera, &rays)| camera > 0 || rays >= least).collect();
    let rests = |n: u32| view.nodes[n as usize].free == view.nodes[n as usize].slots;
    let free: Vec<u32> = (0..view.nodes.len() as u32).filter(|&n| view.nodes[n as usize].free > 0).collect();
    let pool = Pool::new(view, free.iter().copied());
    let mut empty = Pool::new(view, free.iter().copied().filter(|&n| !windows.holds_any(n)));

    // windows with work that nobody holds
    for j in windows.busiest() {
        let lacking = |&s: &u32| windows.slots[s as usize] == 0 && windows.work[s as usize] > 0.0;
        if !ready[j] || !windows.cut[j].iter().any(lacking) {
            continue;
        }
        let room = |n: u32| windows.has_room(view, j, n);
        if let Some(n) = windows.place(view, j, &empty, room).or_else(|| windows.place(view, j, &pool, room)) {
            windows.give(view, j, n);
            empty.remove(view, n);
            continue;
        }
        // in the place of what others hold too
        let holds = |n: u32| rests(n) && windows.bytes[j] <= view.nodes[n as usize].memory;
        let spare = windows.place(view, j, &pool, |n| holds(n) && windows.is_spare(view, n));
        if let Some(n) = spare.or_else(|| windows.place(view, j, &pool, |n| idle && holds(n))) {
            windows.clear(view, n);
            windows.give(view, j, n);
            empty.remove(view, n);
        }
    }
    // windows for nodes that have nothing to do
    let mut worth = Worth::new(view, &windows);
    for &n in &free {
        if windows.held[n as usize].iter().any(|&j| ready[j]) {
            continue;
        }
        let instead = rests(n) && windows.is_spare(view, n);
        let may = |&j: &usize| {
            let instead = || instead && windows.bytes[j] <= view.nodes[n as usize].memory;
            ready[j] && !windows.holds(j, n) && (windows.has_room(view, j, n) || instead())
        };
        if let Some(j) = windows.best(view, &worth, n, (0..windows.cut.len()).filter(may)) {
            if !windows.has_room(view, j, n) {
                let left = windows.clear(view, n);
                worth.refresh(&windows, left);
            }
            windows.give(view, j, n);
            worth.refresh(&windows, [j]);
        }
    }
    deal(view, windows, least)
}

/// Deals groups, and camera rays where no groups wait, to the free slots of the nodes that hold them.
fn deal(view: &View, mut windows: Windows, least: u64) -> Vec<Assignment> {
    let mut out = Vec::new();
    let mut lines: Vec<Option<Line>> = windows.cut.iter().map(|_| None).collect();
    for node in free_slots(view.nodes).into_iter().rev() {
        let held = &windows.held[node as usize];
        let waiting = held.iter().map(|&j| (windows.rays_in[j], j)).filter(|w| w.0 >= least);
        let most = waiting.max_by_key(|&(rays, j)| (rays, Reverse(j)));
        let to_make = held.iter().map(|&j| (windows.camera_in[j], j)).filter(|c| c.0 > 0);
        let to_make = to_make.max_by_key(|&(c, j)| (c, Reverse(j)));
        let Some((_, j)) = most.or(to_make) else { continue };
        let window = &windows.cut[j];
        let set = Set::Resident(window.clone());
        let (of_split, rays_in, camera_in) = (&windows.of_split, &mut windows.rays_in, &mut windows.camera_in);
        if most.is_some() {
            let share = share(window, &windows.slots, &windows.queues.rays, 1).max(view.least_rays).min(view.task_rays);
            let line = lines[j].get_or_insert_with(|| windows.queues.line(window));
            let groups = windows.queues.take(line, share, |s, rays| {
                of_split[s as usize].iter().for_each(|&k| rays_in[k] -= rays);
            });
            out.push(Assignment { node, set, groups, camera: None });
        } else {
            // guided: a share of what is left, so that slots end together
            let share = share(window, &windows.slots, &windows.camera, 2).clamp(1, view.task_camera.max(1));
            let mut left = share;
            for &s in window {
                let made = left.min(windows.camera[s as usize]);
                windows.camera[s as usize] -= made;
                of_split[s as usize].iter().for_each(|&k| camera_in[k] -= made);
                left -= made;
            }
            let from = if windows.cut.len() == 1 { Vec::new() } else { window.clone() };
            out.push(Assignment { node, set, groups: vec![], camera: Some((share, from)) });
        }
    }
    out
}

/// What one slot takes of what waits in the splits of a window when all slots that hold a split share it, each so many times.
fn share(window: &[u32], slots: &[u64], waits: &[u64], times: u64) -> u64 {
    let mut by_slots: Vec<(u64, u64)> = Vec::new();
    for &s in window {
        let (slots, waits) = (slots[s as usize].max(1), waits[s as usize]);
        match by_slots.iter_mut().find(|b| b.0 == slots) {
            Some((_, sum)) => *sum += waits,
            None => by_slots.push((slots, waits)),
        }
    }
    by_slots.into_iter().map(|(slots, rays)| rays.div_ceil(times * slots)).sum()
}
