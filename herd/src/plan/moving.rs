//! `auto` where the nodes' memory does not hold the scene: windows that move to the rays.
//!
//! Each node holds a window of neighbouring splits as large as its memory. A node whose window has (nearly) run dry
//! moves to where most rays wait.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use super::{Assignment, NodeView, Set, View, Waiting, free_slots, place, take};

/// A window that is left must have this many times fewer rays than the one that is taken up, so that nodes do not
/// swap blocks back and forth for a trickle of rays.
const MOVE: u64 = 4;

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let windows = windows(view);
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let mut out = Vec::new();
    let mut queues = view.waiting.clone();
    let mut camera = view.camera.clone();
    for slot in free_slots(view.nodes).into_iter().rev() {
        let window = &windows[slot as usize];
        let node = &view.nodes[slot as usize];
        let moves = !node.warm.iter().eq(window);
        if window.is_empty() || (moves && node.free < node.slots) {
            // nothing to hold, or the tasks that run still need what it holds
            continue;
        }
        let slots = u64::from(view.nodes[slot as usize].slots.max(1));
        let waiting: u64 = window.iter().filter_map(|s| queues.get(s)).flatten().map(|g| g.rays).sum();
        let to_make: u64 = window.iter().filter_map(|s| camera.get(s)).sum();
        let set = Set::Resident(window.clone());
        // few rays: make camera rays first, or wait for those that are on their way
        if waiting > 0 && (waiting >= view.least_rays || (to_make == 0 && idle)) {
            let share = waiting.div_ceil(slots).max(view.least_rays).min(view.task_rays);
            let mut groups: Vec<Waiting> = window.iter().filter_map(|s| queues.get(s)).flatten().copied().collect();
            groups.sort_by_key(|g| (Reverse(g.rays), g.id));
            let taken = take(&mut groups.into_iter(), share);
            let ids: BTreeSet<usize> = taken.iter().copied().collect();
            for s in window {
                if let Some(q) = queues.get_mut(s) {
                    q.retain(|g| !ids.contains(&g.id));
                }
            }
            out.push(Assignment { node: slot, set, groups: taken, camera: None });
        } else if to_make > 0 {
            let share = to_make.div_ceil(slots).min(view.task_camera).max(1);
            let mut left = share;
            for s in window {
                if let Some(c) = camera.get_mut(s) {
                    let n = left.min(*c);
                    *c -= n;
                    left -= n;
                }
            }
            out.push(Assignment { node: slot, set, groups: vec![], camera: Some((share, window.clone())) });
        }
    }
    out
}

/// The window of each node: what it holds, or, if it has nothing to do, what it should hold from now on.
fn windows(view: &View) -> Vec<Vec<u32>> {
    let sizes: Vec<u64> = view.splits.iter().map(|s| s.bytes).collect();
    let rays = |s: u32| {
        let waiting: u64 = view.waiting.get(&s).into_iter().flatten().map(|g| g.rays).sum();
        waiting + view.camera.get(&s).copied().unwrap_or(0)
    };
    let held = |n: &NodeView| if n.slots == 0 { Vec::new() } else { n.warm.iter().copied().collect() };
    let mut windows: Vec<Vec<u32>> = view.nodes.iter().map(held).collect();
    for n in 0..view.nodes.len() {
        let node = &view.nodes[n];
        if node.slots == 0 || node.free < node.slots {
            continue;
        }
        // what lies on the node's own disk counts double: reading it moves nothing
        let worth = |s: u32| rays(s) * if view.splits[s as usize].holders.contains(&(n as u32)) { 2 } else { 1 };
        let own: u64 = windows[n].iter().map(|&s| worth(s)).sum();
        let claimed: BTreeSet<u32> =
            windows.iter().enumerate().filter(|&(m, _)| m != n).flat_map(|(_, w)| w.iter().copied()).collect();
        let free = |s: u32| if claimed.contains(&s) { 0 } else { worth(s) };
        let best = place::fullest(&sizes, node.memory.min(view.forest), free);
        let there: u64 = best.iter().map(|&s| free(s)).sum();
        if there > MOVE * own || (own == 0 && there > 0) {
            windows[n] = best;
        }
    }
    windows
}
