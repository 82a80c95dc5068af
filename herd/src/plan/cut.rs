//! How `auto` cuts the scene into windows: neighbouring splits that a task holds together.
//!
//! Large windows: few rays travel, but each node that joins in must load much. Small windows: the scene is loaded about
//! once, but rays travel. And where the nodes' disks hold copies: each node a window of what it holds, so that nothing is loaded from
//! another. A cut is judged by the bytes that a run would move with it and by how long slots would stand
//! idle ([`super::cost`]); which nodes would hold what is tried out by the same rule that [`super::auto`] follows.

use std::cmp::Reverse;

use super::cost::RAY;
use super::{View, Window, auto};

/// The cut to work with from now on: windows that cover the scene, at most one for each node, none larger than what a node can
/// hold. Empty when the nodes' memory does not hold the scene.
///
/// Stays with the cut that `view` has unless another one is cheaper, all its loading included.
pub fn choose(view: &View) -> Vec<Window> {
    let candidates = candidates(view);
    let present = candidates.iter().find(|c| *c == view.cut);
    let best = candidates.iter().map(|c| (cost(view, c), c)).min_by(|a, b| a.0.total_cmp(&b.0));
    match (best, present) {
        (Some((best, _)), Some(present)) if cost(view, present) <= best => present.clone(),
        (Some((_, cut)), _) => cut.clone(),
        (None, _) => Vec::new(),
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
    let mut windows: Vec<Window> = Vec::new();
    for (n, node) in (0u32..).zip(view.nodes).filter(|(_, node)| node.slots > 0) {
        let held = |s: &u32| view.splits[*s as usize].holders.contains(&n);
        let first = |s: &u32| view.splits[*s as usize].holders.first() == Some(&n);
        let (own, mut others): (Vec<u32>, Vec<u32>) = (0..count).filter(held).partition(first);
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
    let mut cut: Vec<Window> = Vec::new();
    let (mut before, mut last) = (0, None);
    for (s, &size) in (0u32..).zip(sizes) {
        let part = (before + u128::from(size) / 2) * parts as u128 / total;
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
    let (load, times) = auto::Windows::new(view, cut).tried_out(view);
    let longest = times.iter().copied().fold(0.0, f64::max);
    let slots = |n: usize| f64::from(view.nodes[n].slots.max(1));
    let idle: f64 = times.iter().enumerate().map(|(n, t)| slots(n) * (longest - t)).sum();
    let waiting: u64 = view.waiting.values().flatten().map(|g| g.rays).sum();
    let camera: u64 = view.camera.values().sum();
    let rays = waiting as f64 + camera as f64 * view.traffic.rays_per_camera();
    let hops = rays * view.traffic.hops_per_ray(parts(view.splits.iter().map(|s| s.bytes), cut));
    load + hops * view.traffic.hop(view.replicas) + idle * RAY as f64
}
