//! How `auto` cuts the scene into windows: neighbouring splits that a task holds together.
//!
//! Large windows: few rays travel, but each node that joins in must load much. Small windows: the scene is loaded about
//! once, but rays travel. And where the nodes' disks hold copies: each node a window of what it holds, so that nothing is loaded from
//! another. A cut is judged by the bytes that a run would move with it and by how long slots would stand
//! idle ([`super::cost`]); which nodes would hold what is tried out by the same rule that [`super::auto`] follows.

use std::cmp::Reverse;

use super::cost::{RAY, WALK};
use super::{View, Window, auto};

/// The cut to work with from now on: windows that cover the scene, at most one for each node, none larger than what a node can
/// hold. Empty when the nodes' memory does not hold the scene.
///
/// Stays with the cut that `view` has unless another one is cheaper, all its loading included.
pub fn choose(view: &View) -> Vec<Window> {
    let mut candidates = candidates(view);
    let bounds: Vec<f64> = candidates.iter().map(|c| ways(view, c)).collect();
    let mut order: Vec<usize> = (0..candidates.len()).collect();
    order.sort_by(|&a, &b| bounds[a].total_cmp(&bounds[b]));
    let mut costs = vec![f64::INFINITY; candidates.len()];
    let mut least = f64::INFINITY;
    for i in order {
        // what rays on their way cost is a part of what a cut costs: this one cannot be cheaper, nor can those after it
        if bounds[i] > least {
            break;
        }
        costs[i] = cost(view, &candidates[i]);
        least = least.min(costs[i]);
    }
    let present = candidates.iter().position(|c| *c == view.cut).filter(|&i| costs[i] <= least);
    match present.or_else(|| costs.iter().position(|&c| c <= least)) {
        Some(best) => candidates.swap_remove(best),
        None => Vec::new(),
    }
}

/// In how many parts a cut divides the scene, as rays see it: windows that overlap are fewer than they are.
pub fn parts(sizes: impl Iterator<Item = u64>, cut: &[Window]) -> f64 {
    let sizes: Vec<u64> = sizes.collect();
    let all: u64 = sizes.iter().sum();
    let held: u64 = cut.iter().map(|w| bytes(&sizes, w)).sum();
    if held == 0 { 1.0 } else { (cut.len() as f64 * all as f64 / held as f64).max(1.0) }
}

/// Cuts that the nodes can hold: into 1, 2, 3, .. parts of equal bytes (in larger steps when there are many nodes), as few
/// windows as memory allows, each as full as can be, and what each node has on its disk.
pub(super) fn candidates(view: &View) -> Vec<Vec<Window>> {
    let mut rooms: Vec<u64> = view.nodes.iter().filter(|n| n.slots > 0).map(|n| n.memory.min(view.forest)).collect();
    rooms.sort_unstable_by_key(|&m| Reverse(m));
    let sizes: Vec<u64> = view.splits.iter().map(|s| s.bytes).collect();
    let mut counts = Vec::new();
    let mut next = 1;
    while next <= rooms.len() {
        counts.push(next);
        next += (next / 16).max(1);
    }
    counts.push(rooms.len());
    let mut cuts: Vec<Vec<Window>> = counts.into_iter().map(|n| equal(&sizes, n)).collect();
    cuts.push(full(&sizes, rooms.last().copied().unwrap_or(0)));
    cuts.retain(|cut| !cut.is_empty() && fits(&sizes, cut, &rooms));
    cuts.extend(at_home(view));
    cuts.dedup();
    cuts
}

/// For each node what lies on its disk: that of which it is the first holder, and then, as far as memory goes, what follows along the
/// curve of what it holds else. None if that does not cover the scene.
fn at_home(view: &View) -> Option<Vec<Window>> {
    let count = view.splits.len() as u32;
    let mut covered = vec![false; view.splits.len()];
    // by node: the splits of which it is the first holder, and those that it holds else
    let mut disks: Vec<[Vec<u32>; 2]> = vec![Default::default(); view.nodes.len()];
    for (s, split) in (0u32..).zip(view.splits) {
        for (k, &n) in split.holders.iter().enumerate() {
            if let Some(disk) = disks.get_mut(n as usize).filter(|_| !split.holders[..k].contains(&n)) {
                disk[usize::from(k > 0)].push(s);
            }
        }
    }
    let mut windows: Vec<Window> = Vec::new();
    for ([own, mut others], node) in disks.into_iter().zip(view.nodes).filter(|(_, node)| node.slots > 0) {
        let after = own.last().map_or(0, |&s| s + 1);
        others.sort_by_key(|&s| (s + count - after) % count);
        let mut left = node.memory.min(view.forest);
        let mut window = Window::new();
        for s in own.into_iter().chain(others) {
            let Some(room) = left.checked_sub(view.splits[s as usize].bytes) else { break };
            left = room;
            covered[s as usize] = true;
            window.push(s);
        }
        window.sort_unstable();
        if !window.is_empty() && !windows.contains(&window) {
            windows.push(window);
        }
    }
    (covered.iter().all(|&c| c) && !windows.is_empty()).then_some(windows)
}

/// Whether each window has a node of its own; rooms by falling size.
fn fits(sizes: &[u64], cut: &[Window], rooms: &[u64]) -> bool {
    let mut bytes: Vec<u64> = cut.iter().map(|w| bytes(sizes, w)).collect();
    bytes.sort_unstable_by_key(|&b| Reverse(b));
    bytes.len() <= rooms.len() && bytes.iter().zip(rooms).all(|(b, room)| b <= room)
}

fn bytes(sizes: &[u64], window: &[u32]) -> u64 {
    window.iter().map(|&s| sizes[s as usize]).sum()
}

/// Parts of about equal bytes: a split belongs to the part that its middle is in, the rule by which copies are placed.
fn equal(sizes: &[u64], parts: usize) -> Vec<Window> {
    let total = sizes.iter().map(|&s| u128::from(s)).sum::<u128>().max(1);
    // division of 128 bits is slow, and hardly ever needed
    let small = u64::try_from(total * parts as u128).is_ok();
    let mut cut: Vec<Window> = Vec::new();
    let (mut before, mut last) = (0, None);
    for (s, &size) in (0u32..).zip(sizes) {
        let middle = (before + u128::from(size) / 2) * parts as u128;
        let part = if small { u128::from(middle as u64 / total as u64) } else { middle / total };
        before += u128::from(size);
        match cut.last_mut() {
            Some(window) if last == Some(part) => window.push(s),
            _ => cut.push(vec![s]),
        }
        last = Some(part);
    }
    cut
}

/// Windows filled one after the other up to `memory`; none if a split is larger.
fn full(sizes: &[u64], memory: u64) -> Vec<Window> {
    let mut cut: Vec<Window> = Vec::new();
    let mut left = 0;
    for (s, &size) in (0u32..).zip(sizes) {
        if size > memory {
            return Vec::new();
        }
        match cut.last_mut() {
            Some(window) if size <= left => window.push(s),
            _ => {
                cut.push(vec![s]);
                left = memory;
            }
        }
        left -= size;
    }
    cut
}

/// Bytes moved with a cut, and time of slots that stand idle, until the work in sight is done.
pub(super) fn cost(view: &View, cut: &[Window]) -> f64 {
    let (load, times) = auto::Windows::new(view, cut, cut == view.cut).tried_out(view);
    let longest = times.iter().copied().fold(0.0, f64::max);
    let slots = |n: usize| f64::from(view.nodes[n].slots.max(1));
    let idle: f64 = times.iter().enumerate().map(|(n, t)| slots(n) * (longest - t)).sum();
    load + ways(view, cut) + idle * RAY as f64
}

/// What rays on their way between the windows of a cut cost, and finding out which of them have to go.
fn ways(view: &View, cut: &[Window]) -> f64 {
    let waiting: u64 = view.waiting.values().flatten().map(|g| g.rays).sum();
    let camera: u64 = view.camera.values().sum();
    let rays = waiting as f64 + camera as f64 * view.traffic.rays_per_camera();
    let hops = rays * view.traffic.hops_per_ray(parts(view.splits.iter().map(|s| s.bytes), cut));
    let asked = if cut.len() > 1 { rays } else { 0.0 };
    hops * view.traffic.hop(view.replicas) + asked * WALK as f64
}
