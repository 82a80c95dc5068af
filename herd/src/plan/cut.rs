//! How `auto` cuts the scene into windows: neighbouring splits that a task holds together.
//!
//! Large windows: few rays travel, but each node that joins in must load much. Small windows: the scene is loaded about
//! once, but rays travel. A cut is judged by the bytes that a run would move with it and by how long slots would stand
//! idle ([`super::cost`]); which nodes would hold what is tried out by the same rule that [`super::auto`] follows.

use std::cmp::Reverse;
use std::ops::Range;

use super::cost::RAY;
use super::{View, auto};

/// The cut to work with from now on: windows that follow each other along the curve and cover it, at most one for each
/// node, none larger than what a node can hold. Empty when the nodes' memory does not hold the scene.
///
/// Stays with the cut that `view` has unless another one is cheaper, all its loading included.
pub fn choose(view: &View) -> Vec<Range<u32>> {
    let candidates = candidates(view);
    let present = candidates.iter().find(|c| *c == view.cut);
    let best = candidates.iter().map(|c| (cost(view, c), c)).min_by(|a, b| a.0.total_cmp(&b.0));
    match (best, present) {
        (Some((best, _)), Some(present)) if cost(view, present) <= best => present.clone(),
        (Some((_, cut)), _) => cut.clone(),
        (None, _) => Vec::new(),
    }
}

/// Cuts that the nodes can hold: into 1, 2, 3, .. parts of equal bytes (in larger steps when there are many nodes), and
/// as few windows as memory allows, each as full as can be.
fn candidates(view: &View) -> Vec<Vec<Range<u32>>> {
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
    let mut cuts: Vec<Vec<Range<u32>>> = counts.into_iter().map(|n| equal(&sizes, n)).collect();
    cuts.push(full(&sizes, rooms.last().copied().unwrap_or(0)));
    cuts.retain(|cut| !cut.is_empty() && fits(&sizes, cut, &rooms));
    cuts.dedup();
    cuts
}

/// Whether each window has a node of its own; rooms by falling size.
fn fits(sizes: &[u64], cut: &[Range<u32>], rooms: &[u64]) -> bool {
    let mut bytes: Vec<u64> = cut.iter().map(|w| bytes(sizes, w)).collect();
    bytes.sort_unstable_by_key(|&b| Reverse(b));
    bytes.len() <= rooms.len() && bytes.iter().zip(rooms).all(|(b, room)| b <= room)
}

fn bytes(sizes: &[u64], window: &Range<u32>) -> u64 {
    sizes[window.start as usize..window.end as usize].iter().sum()
}

/// Parts of about equal bytes: a split belongs to the part that its middle is in, the rule by which copies are placed.
fn equal(sizes: &[u64], parts: usize) -> Vec<Range<u32>> {
    let total = sizes.iter().map(|&s| u128::from(s)).sum::<u128>().max(1);
    let mut cut: Vec<Range<u32>> = Vec::new();
    let (mut before, mut last) = (0, None);
    for (s, &size) in (0u32..).zip(sizes) {
        let part = (before + u128::from(size) / 2) * parts as u128 / total;
        before += u128::from(size);
        match cut.last_mut() {
            Some(window) if last == Some(part) => window.end = s + 1,
            _ => cut.push(s..s + 1),
        }
        last = Some(part);
    }
    cut
}

/// Windows filled one after the other up to `memory`; none if a split is larger.
fn full(sizes: &[u64], memory: u64) -> Vec<Range<u32>> {
    let mut cut: Vec<Range<u32>> = Vec::new();
    let mut left = 0;
    for (s, &size) in (0u32..).zip(sizes) {
        if size > memory {
            return Vec::new();
        }
        match cut.last_mut() {
            Some(window) if size <= left => window.end = s + 1,
            _ => {
                cut.push(s..s + 1);
                left = memory;
            }
        }
        left -= size;
    }
    cut
}

/// Bytes moved with a cut, and time of slots that stand idle, until the work in sight is done.
fn cost(view: &View, cut: &[Range<u32>]) -> f64 {
    let windows = auto::Windows::new(view, cut);
    let work = windows.work.clone();
    let rays = work.iter().sum::<f64>();
    let (held, load) = windows.tried_out(view);
    let shared: Vec<f64> = held.iter().map(|on| on.iter().map(|&n| view.slots(n)).sum::<f64>().max(1.0)).collect();
    // slots of one window take equal parts of its work
    let mut time = vec![0.0; view.nodes.len()];
    for (j, on) in held.iter().enumerate() {
        on.iter().for_each(|&n| time[n as usize] += work[j] / shared[j]);
    }
    let longest = time.iter().copied().fold(0.0, f64::max);
    let idle: f64 = time.iter().enumerate().map(|(n, t)| view.slots(n as u32) * (longest - t)).sum();
    let hops = rays * view.traffic.hops_per_ray(cut.len());
    load + hops * view.traffic.hop(view.replicas) + idle * RAY as f64
}
